//! What the clients of librdkafka call back.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use parking_lot::Mutex;
use rdkafka::ClientContext;
use rdkafka::config::RDKafkaLogLevel;
use rdkafka::consumer::ConsumerContext;
use rdkafka::error::{KafkaError, RDKafkaErrorCode};

use super::identity::Identities;

/// The last error of any client of one broker, for people.
#[derive(Debug, Default)]
pub(super) struct LastError {
    text: Mutex<Option<String>>,
    /// A broker has refused a password or a certificate.
    refused: AtomicBool,
}

impl LastError {
    pub(super) fn note(&self, text: String) {
        *self.text.lock() = Some(text);
    }

    /// What a client calls back. That all brokers are down says less than why the last one is, as
    /// the name that it gave of itself and that is unknown here.
    pub(super) fn note_event(&self, error: &KafkaError, reason: &str) {
        let code = error.rdkafka_error_code();
        if matches!(code, Some(RDKafkaErrorCode::Authentication | RDKafkaErrorCode::SSL)) {
            self.refused.store(true, Ordering::Relaxed);
        }
        let mut last = self.text.lock();
        if last.is_none() || code != Some(RDKafkaErrorCode::AllBrokersDown) {
            *last = Some(format!("{error}: {reason}"));
        }
    }

    pub(super) fn get(&self) -> Option<String> {
        self.text.lock().clone()
    }

    /// Whether a broker has refused a password or a certificate since the last call.
    pub(super) fn take_refused(&self) -> bool {
        self.refused.swap(false, Ordering::Relaxed)
    }

    pub(super) fn take(&self) -> Option<String> {
        self.text.lock().take()
    }
}

/// Routes the log of a client into ours. librdkafka repeats itself at each attempt to connect, so
/// all but what makes it useless is for those who debug: what matters is told once, as the broker's
/// status.
pub(super) fn log(level: RDKafkaLogLevel, facility: &str, line: &str) {
    match level {
        RDKafkaLogLevel::Emerg | RDKafkaLogLevel::Alert | RDKafkaLogLevel::Critical => {
            tracing::warn!(target: "librdkafka", facility, "{line}");
        }
        RDKafkaLogLevel::Error | RDKafkaLogLevel::Warning => {
            tracing::debug!(target: "librdkafka", facility, "{line}");
        }
        RDKafkaLogLevel::Notice | RDKafkaLogLevel::Info | RDKafkaLogLevel::Debug => {
            tracing::trace!(target: "librdkafka", facility, "{line}");
        }
    }
}

/// For clients that read and ask.
pub(super) struct ReadContext {
    /// What this client knows of its topics' identities.
    pub(super) identities: Arc<Identities>,
    /// Where errors are noted.
    pub(super) last_error: Arc<LastError>,
    /// Lines of the log and errors so far.
    served: AtomicUsize,
}

impl ReadContext {
    pub(super) fn new(identities: &Arc<Identities>, last_error: &Arc<LastError>) -> Self {
        Self {
            identities: Arc::clone(identities),
            last_error: Arc::clone(last_error),
            served: AtomicUsize::new(0),
        }
    }

    /// How many lines of the log and errors the client has been served so far.
    pub(super) fn served(&self) -> usize {
        self.served.load(Ordering::Relaxed)
    }
}

impl ClientContext for ReadContext {
    fn log(&self, level: RDKafkaLogLevel, facility: &str, line: &str) {
        self.served.fetch_add(1, Ordering::Relaxed);
        if matches!(level, RDKafkaLogLevel::Debug) && facility == "METADATA" {
            self.identities.read_log(line);
        }
        log(level, facility, line);
    }

    fn error(&self, error: KafkaError, reason: &str) {
        self.served.fetch_add(1, Ordering::Relaxed);
        self.last_error.note_event(&error, reason);
    }
}

impl ConsumerContext for ReadContext {}

#[cfg(test)]
mod tests {
    use super::*;

    /// What the client says of a name that the server gave of itself comes before, and tells more.
    #[test]
    fn why_a_broker_is_down_outlives_that_all_are() {
        let last = LastError::default();
        let all = KafkaError::Global(RDKafkaErrorCode::AllBrokersDown);
        let resolve = KafkaError::Global(RDKafkaErrorCode::Resolve);
        last.note_event(&all, "1/1 brokers are down");
        assert!(last.get().is_some_and(|text| text.contains("1/1 brokers are down")));
        last.note_event(&resolve, "kafka-1.internal:9092/1: Failed to resolve");
        last.note_event(&all, "1/1 brokers are down");
        assert!(last.get().is_some_and(|text| text.contains("kafka-1.internal:9092")));
        last.take();
        last.note_event(&all, "1/1 brokers are down");
        assert!(last.get().is_some_and(|text| text.contains("brokers are down")));
    }
}
