//! What became of the connections.

use std::fmt::Write as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// What a connection is counted as. All but the first two are ends other than by the client's wish.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Outcome {
    Accepted,
    /// Over the limit of connections.
    Refused,
    /// The TLS handshake failed: no TLS, no common version, no client certificate.
    Handshake,
    /// The TLS handshake took too long.
    HandshakeTimeout,
    /// The first request did not come, or a head did not end, or a PING was not answered.
    Timeout,
    /// Nothing was asked for long.
    Idle,
    /// The client did not read.
    Stalled,
    /// No HTTP.
    Malformed,
    /// It broke off within a request or an answer.
    Broken,
    /// A handler panicked.
    Panicked,
}

const OUTCOMES: [(Outcome, &str); 10] = [
    (Outcome::Accepted, "accepted"),
    (Outcome::Refused, "refused"),
    (Outcome::Handshake, "handshake_failed"),
    (Outcome::HandshakeTimeout, "handshake_timeout"),
    (Outcome::Timeout, "timeout"),
    (Outcome::Idle, "idle"),
    (Outcome::Stalled, "stalled"),
    (Outcome::Malformed, "malformed"),
    (Outcome::Broken, "broken"),
    (Outcome::Panicked, "panicked"),
];

/// Connections of one port.
#[derive(Debug)]
pub struct ListenCounters {
    listener: &'static str,
    open: AtomicU64,
    outcomes: [AtomicU64; OUTCOMES.len()],
}

impl ListenCounters {
    pub(super) fn new(listener: &'static str) -> Self {
        Self {
            listener,
            open: AtomicU64::new(0),
            outcomes: Default::default(),
        }
    }

    pub(super) fn count(&self, outcome: Outcome) {
        self.outcomes[outcome as usize].fetch_add(1, Ordering::Relaxed);
    }

    #[cfg(test)]
    pub(super) fn get(&self, outcome: Outcome) -> u64 {
        self.outcomes[outcome as usize].load(Ordering::Relaxed)
    }

    /// Connections that are open now.
    #[must_use]
    pub fn open(&self) -> u64 {
        self.open.load(Ordering::Relaxed)
    }

    /// Counts a connection as open as long as it lives.
    pub(super) fn opened(self: &Arc<Self>) -> Open {
        self.open.fetch_add(1, Ordering::Relaxed);
        Open(Arc::clone(self))
    }
}

pub(super) struct Open(Arc<ListenCounters>);

impl Drop for Open {
    fn drop(&mut self) {
        self.0.open.fetch_sub(1, Ordering::Relaxed);
    }
}

/// The counters of all ports in the text format of Prometheus.
#[must_use]
pub fn metrics_text(ports: &[Arc<ListenCounters>]) -> String {
    let mut text = "# HELP blaze_config_connections_total Connections by what became of them.\n\
                    # TYPE blaze_config_connections_total counter\n"
        .to_owned();
    for port in ports {
        for ((_, result), count) in OUTCOMES.iter().zip(&port.outcomes) {
            let (listener, count) = (port.listener, count.load(Ordering::Relaxed));
            // Writing to a text does not fail.
            let _ = writeln!(
                text,
                "blaze_config_connections_total{{listener=\"{listener}\",result=\"{result}\"}} {count}"
            );
        }
    }
    text.push_str(
        "# HELP blaze_config_connections Connections that are open.\n# TYPE blaze_config_connections gauge\n",
    );
    for port in ports {
        let _ = writeln!(
            text,
            "blaze_config_connections{{listener=\"{}\"}} {}",
            port.listener,
            port.open()
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_text_has_every_port_and_outcome() {
        let ports = [
            Arc::new(ListenCounters::new("rest")),
            Arc::new(ListenCounters::new("grpc")),
        ];
        for (index, (outcome, _)) in OUTCOMES.iter().enumerate() {
            assert_eq!(*outcome as usize, index, "{outcome:?} is counted under its own name");
        }
        ports[1].count(Outcome::Stalled);
        let open = ports[0].opened();
        let text = metrics_text(&ports);
        assert!(text.contains("blaze_config_connections_total{listener=\"grpc\",result=\"stalled\"} 1\n"));
        assert!(text.contains("blaze_config_connections{listener=\"rest\"} 1\n"));
        assert_eq!(text.matches("# TYPE").count(), 2);
        drop(open);
        assert_eq!(ports[0].open(), 0);
    }
}
