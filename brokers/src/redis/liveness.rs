//! Whether the server gives signs of life on one connection. Nothing here reads a clock.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use blaze_runtime::BEAT;
use tokio_util::sync::CancellationToken;

/// Time between two looks.
pub(super) const LOOK: Duration = BEAT.saturating_mul(3);
/// Looks without a sign of life after which the server is pinged.
const PING_AFTER: usize = 4;
/// Looks without a sign of life after which the server is silent: a freeze shows within 2 s.
const SILENT_AFTER: usize = 9;
/// The same for connections of large messages: one message of 16 MiB takes 1.3 s at 100 Mbit/s.
const SILENT_AFTER_LARGE: usize = 20;
/// Bytes that a server takes per look at least (10 MB/s): what was sent may take its time.
const BYTES_PER_LOOK: usize = 1_920_000;

/// What is known of a connection. Several tasks write it.
#[derive(Debug, Default)]
pub(super) struct Liveness {
    /// Cancelled when the connection is gone.
    pub(super) lost: CancellationToken,
    received: AtomicBool,
    unanswered: AtomicUsize,
}

impl Liveness {
    /// Something was received.
    pub(super) fn received(&self) {
        self.received.store(true, Ordering::Relaxed);
    }

    /// Bytes were sent that will be answered.
    pub(super) fn sent(&self, bytes: usize) {
        self.unanswered.fetch_add(bytes, Ordering::Relaxed);
    }

    /// As many bytes as were sent have been answered.
    pub(super) fn answered(&self, bytes: usize) {
        self.unanswered.fetch_sub(bytes, Ordering::Relaxed);
        self.received();
    }

    /// Bytes that were sent and not answered yet.
    pub(super) fn unanswered(&self) -> usize {
        self.unanswered.load(Ordering::Relaxed)
    }
}

/// What a look at a connection gives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Look {
    Alive,
    /// Not silent for long enough to tell.
    Unknown,
    /// Send a ping, if none is under way.
    Ping,
    Silent,
}

/// Counts looks without a sign of life. Time would not do: where this process stood still, answers
/// may lie unread.
#[derive(Debug)]
pub(super) struct Watch {
    quiet: usize,
    silent_after: usize,
}

impl Watch {
    pub(super) fn new(large: bool) -> Self {
        Self { quiet: 0, silent_after: if large { SILENT_AFTER_LARGE } else { SILENT_AFTER } }
    }

    /// Looks, once per [`LOOK`].
    pub(super) fn look(&mut self, liveness: &Liveness) -> Look {
        if liveness.received.swap(false, Ordering::Relaxed) {
            self.quiet = 0;
            return Look::Alive;
        }
        self.quiet += 1;
        if self.quiet >= self.silent_after + liveness.unanswered() / BYTES_PER_LOOK {
            Look::Silent
        } else if self.quiet == PING_AFTER {
            Look::Ping
        } else {
            Look::Unknown
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn looks(watch: &mut Watch, liveness: &Liveness, count: usize) -> Vec<Look> {
        (0..count).map(|_| watch.look(liveness)).collect()
    }

    #[test]
    fn a_quiet_server_is_pinged_and_silence_is_noticed_within_two_seconds() {
        let (mut watch, liveness) = (Watch::new(false), Liveness::default());
        for _ in 0..2 {
            liveness.received();
            let found = looks(&mut watch, &liveness, 11);
            assert_eq!((found[0], found[4]), (Look::Alive, Look::Ping));
            assert_eq!(found.iter().position(|look| *look == Look::Silent), Some(9));
            assert_eq!(found[10], Look::Silent);
        }
        assert!(LOOK * 10 <= Duration::from_secs(2));
    }

    #[test]
    fn what_was_sent_may_take_its_time() {
        let (mut watch, liveness) = (Watch::new(false), Liveness::default());
        liveness.sent(10_000_000);
        assert!(!looks(&mut watch, &liveness, 13).contains(&Look::Silent));
        assert_eq!(watch.look(&liveness), Look::Silent);
        liveness.answered(10_000_000);
        assert_eq!((watch.look(&liveness), liveness.unanswered()), (Look::Alive, 0));
    }
}
