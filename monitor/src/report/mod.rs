//! The status stream: the monitor dials the main service, sends a summary, more while somebody
//! looks, and answers questions about this node. It uses nothing of the data plane.
//!
//! ```text
//! health, values, flows ─▶ summary ─▶ Summary   ┐
//! admin ports of this node ◀─ Query ─ QueryAnswer ├─ StatusService.Report ─ main service
//!                          period ◀─ Interest   ┘
//! ```

mod question;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use blaze_domain::FlowId;
use blaze_proto::v1;
use blaze_proto::v1::report_request::Msg as Outgoing;
use blaze_proto::v1::report_response::Msg as Incoming;
use blaze_proto::v1::status_service_client::StatusServiceClient;
use blaze_runtime::main_service::{Backoff, ConnectError, MainService, words};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::Instant;
use tokio_stream::wrappers::ReceiverStream;
use tonic::codec::CompressionEncoding;
use tonic::{Request, Status, Streaming};

use crate::limits::{
    INTEREST, INTEREST_MS, MAX_ANSWER_BYTES, MAX_SUMMARY_BYTES, QUERIES, REPORT, REPORT_CHANGE,
};

pub use question::Targets;

/// Version of the protocol.
const PROTOCOL: u32 = 1;
/// Messages on their way into the stream: a summary, the answers, and room.
const OUTGOING: usize = 2 * QUERIES;
/// Time for the main service to accept a Hello.
const WELCOME: Duration = Duration::from_secs(10);
/// A stream that ended sooner was none: the next one is not tried at once.
const GOOD: Duration = Duration::from_secs(10);
/// Room for what surrounds an answer in its message.
const ENVELOPE_BYTES: usize = 4096;

/// What the stream needs of the monitor.
pub trait Site: Send + Sync + 'static {
    /// The JSON of a summary.
    fn summary(&self) -> String;
    /// Where questions about this node are put.
    fn targets(&self) -> Targets;
}

/// The node that reports.
#[derive(Debug, Clone)]
pub struct Reporter {
    /// Layer and node.
    pub me: FlowId,
    /// Larger after each start.
    pub epoch: u64,
    /// `HOST:PORT` of the admin port, if other machines reach it; else empty.
    pub metrics_address: String,
}

/// What became of the stream, for metrics.
#[derive(Debug, Default)]
pub struct ReportState {
    connected: AtomicBool,
    too_large: AtomicU64,
}

impl ReportState {
    /// Whether the main service has accepted the stream.
    #[must_use]
    pub fn is_connected(&self) -> bool {
        self.connected.load(Ordering::Relaxed)
    }

    /// Summaries that were not sent, because they were above 256 KiB.
    #[must_use]
    pub fn too_large(&self) -> u64 {
        self.too_large.load(Ordering::Relaxed)
    }
}

/// Why there is no stream.
#[derive(Debug, thiserror::Error)]
enum StreamError {
    #[error(transparent)]
    Connect(#[from] ConnectError),
    #[error("no connection: no answer to Hello within 10 s")]
    Silent,
    #[error("refused: {}", words(.0))]
    Refused(Status),
}

/// How a stream ended.
struct End {
    reason: String,
    again: Option<Duration>,
}

/// Reports as long as there is a main service in `main`; ends when its sender does. `changed` is
/// marked when the health changed.
pub async fn report(
    reporter: Reporter,
    site: Arc<dyn Site>,
    state: Arc<ReportState>,
    mut main: watch::Receiver<Option<MainService>>,
    mut changed: watch::Receiver<u64>,
) {
    let (mut backoff, mut contact) = (Backoff::default(), Instant::now());
    let mut last = String::new();
    loop {
        let Some(service) = main.borrow_and_update().clone() else {
            if main.changed().await.is_err() {
                return;
            }
            continue;
        };
        let opened = open(&reporter, &service).await;
        let (reason, again) = match opened {
            Ok((outgoing, incoming)) => {
                state.connected.store(true, Ordering::Relaxed);
                tracing::info!("reporting to the main service");
                let began = Instant::now();
                let stream = Stream { site: &site, state: &state, outgoing, incoming };
                let end = stream.run(&mut main, &mut changed).await;
                state.connected.store(false, Ordering::Relaxed);
                contact = Instant::now();
                if began.elapsed() >= GOOD {
                    backoff.reset();
                }
                (end.reason, end.again)
            }
            Err(error) => (error.to_string(), None),
        };
        if reason != last {
            tracing::warn!(reason, "not reporting to the main service");
            last = reason;
        }
        let pause = backoff.next(Some(contact.elapsed()), rand::random());
        tokio::select! {
            () = tokio::time::sleep(again.unwrap_or(pause)) => {}
            changed = main.changed() => {
                if changed.is_err() {
                    return;
                }
                backoff.reset();
            }
        }
    }
}

type Opened = (mpsc::Sender<v1::ReportRequest>, Streaming<v1::ReportResponse>);

async fn open(reporter: &Reporter, service: &MainService) -> Result<Opened, StreamError> {
    let (channel, token) = service.connect().await?;
    let (outgoing, requests) = mpsc::channel(OUTGOING);
    let hello = v1::MonitorHello {
        protocol: PROTOCOL,
        layer: reporter.me.layer.to_string(),
        node: reporter.me.node.to_string(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        epoch: reporter.epoch,
        metrics_address: reporter.metrics_address.clone(),
    };
    // The channel is new: there is room.
    let _ = outgoing.try_send(v1::ReportRequest { msg: Some(Outgoing::Hello(hello)) });
    let mut request = Request::new(ReceiverStream::new(requests));
    if let Some(token) = token {
        request.metadata_mut().insert("authorization", token);
    }
    let mut client = StatusServiceClient::new(channel)
        .max_decoding_message_size(MAX_ANSWER_BYTES)
        .send_compressed(CompressionEncoding::Gzip)
        .accept_compressed(CompressionEncoding::Gzip);
    match tokio::time::timeout(WELCOME, client.report(request)).await {
        Ok(Ok(response)) => Ok((outgoing, response.into_inner())),
        Ok(Err(status)) => Err(StreamError::Refused(status)),
        Err(_) => Err(StreamError::Silent),
    }
}

/// A stream that is open.
struct Stream<'a> {
    site: &'a Arc<dyn Site>,
    state: &'a ReportState,
    outgoing: mpsc::Sender<v1::ReportRequest>,
    incoming: Streaming<v1::ReportResponse>,
}

impl Stream<'_> {
    async fn run(
        mut self,
        main: &mut watch::Receiver<Option<MainService>>,
        changed: &mut watch::Receiver<u64>,
    ) -> End {
        let mut rhythm = Rhythm::new(Instant::now());
        let mut answers = JoinSet::new();
        let end = |reason: &str| End { reason: reason.to_owned(), again: None };
        loop {
            let message = tokio::select! {
                () = tokio::time::sleep_until(rhythm.next()) => {
                    self.summary();
                    rhythm.sent(Instant::now());
                    continue;
                }
                Ok(()) = changed.changed() => {
                    rhythm.hurry(Instant::now());
                    continue;
                }
                Some(Ok(answer)) = answers.join_next() => {
                    self.send(Outgoing::Answer(answer));
                    continue;
                }
                _ = main.changed() => {
                    main.mark_changed();
                    return end("config or monitor.report was changed");
                }
                message = self.incoming.message() => message,
            };
            match message {
                Ok(Some(v1::ReportResponse { msg })) => match msg {
                    Some(Incoming::Interest(interest)) => {
                        rhythm.interest(Instant::now(), interest.period_ms);
                    }
                    Some(Incoming::Query(query)) => self.ask(query, &mut answers),
                    Some(Incoming::GoAway(away)) => {
                        let again = Duration::from_millis(away.retry_after_ms.into());
                        return End { reason: away.reason, again: Some(again) };
                    }
                    // A message of a newer protocol.
                    None => {}
                },
                Ok(None) => return end("the main service has ended the stream"),
                Err(status) => return end(&StreamError::Refused(status).to_string()),
            }
        }
    }

    /// Sends the newest summary. If the last ones are still on their way, the next one is newer.
    fn summary(&self) {
        let json = self.site.summary();
        if json.len() > MAX_SUMMARY_BYTES {
            if self.state.too_large.fetch_add(1, Ordering::Relaxed) == 0 {
                tracing::warn!(bytes = json.len(), "a summary is above 256 KiB and is not sent");
            }
            return;
        }
        self.send(Outgoing::Summary(v1::Summary { json }));
    }

    fn send(&self, msg: Outgoing) {
        let _ = self.outgoing.try_send(v1::ReportRequest { msg: Some(msg) });
    }

    fn ask(&self, query: v1::Query, answers: &mut JoinSet<v1::QueryAnswer>) {
        let v1::Query { id, name } = query;
        if answers.len() >= QUERIES {
            let (status, json) = question::refusal(503, "too_many_queries", "8 are under way");
            self.send(Outgoing::Answer(v1::QueryAnswer { id, status, json }));
            return;
        }
        let targets = self.site.targets();
        answers.spawn(async move {
            let (status, json) = question::answer(&targets, &name).await;
            let (status, json) = match json.len() + ENVELOPE_BYTES > MAX_ANSWER_BYTES {
                true => question::refusal(413, "too_large", "the answer is above 1 MiB"),
                false => (status, json),
            };
            v1::QueryAnswer { id, status, json }
        });
    }
}

/// When the next summary is due.
struct Rhythm {
    next: Instant,
    period: Duration,
    interest_ends: Instant,
}

impl Rhythm {
    /// The first one goes at once.
    fn new(now: Instant) -> Self {
        Self { next: now, period: REPORT, interest_ends: now }
    }

    fn next(&self) -> Instant {
        self.next
    }

    fn sent(&mut self, now: Instant) {
        if now >= self.interest_ends {
            self.period = REPORT;
        }
        self.next = now + self.period;
    }

    /// Something changed.
    fn hurry(&mut self, now: Instant) {
        self.next = self.next.min(now + REPORT_CHANGE);
    }

    fn interest(&mut self, now: Instant, period_ms: u32) {
        let (shortest, longest) = INTEREST_MS;
        self.period = Duration::from_millis(period_ms.clamp(shortest, longest).into());
        self.interest_ends = now + INTEREST;
        self.next = self.next.min(now + self.period);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interest_quickens_the_summaries_for_thirty_seconds() {
        let start = Instant::now();
        let at = |seconds: f64| start + Duration::from_secs_f64(seconds);
        let mut rhythm = Rhythm::new(start);
        assert_eq!(rhythm.next(), start);
        rhythm.sent(start);
        assert_eq!(rhythm.next(), at(15.0));
        rhythm.interest(at(1.0), 100);
        assert_eq!(rhythm.next(), at(1.5));
        rhythm.sent(at(30.9));
        assert_eq!(rhythm.next(), at(31.4));
        rhythm.sent(at(31.4));
        assert_eq!(rhythm.next(), at(46.4));
        rhythm.hurry(at(40.0));
        assert_eq!(rhythm.next(), at(40.5));
    }
}
