//! Answers that wait to be sent: each for a short random time, and those of one second together.

use std::time::Duration;

use blaze_domain::FlowId;
use rand::rngs::StdRng;

use super::ignored::Ignored;
use super::limits::{ANSWER_DELAY, ANSWER_INTERVAL, ANSWERS_PER_NODE, ANSWERS_WAITING};
use super::rounds::up_to;

/// A received ping.
#[derive(Debug)]
pub(super) struct Waiting {
    pub(super) to: FlowId,
    pub(super) id: u64,
    /// When it was received, by the monotonic clock.
    pub(super) received: Duration,
}

/// Received pings that are not answered yet.
#[derive(Debug, Default)]
pub(super) struct Answers {
    waiting: Vec<Waiting>,
    due: Option<Duration>,
    sent: Option<Duration>,
}

impl Answers {
    pub(super) fn add(&mut self, ping: Waiting, rng: &mut StdRng) -> Result<(), Ignored> {
        let of_node = self.waiting.iter().filter(|other| other.to == ping.to).count();
        if self.waiting.len() >= ANSWERS_WAITING || of_node >= ANSWERS_PER_NODE {
            return Err(Ignored::TooManyPings);
        }
        if self.due.is_none() {
            let soon = ping.received.saturating_add(up_to(ANSWER_DELAY, rng));
            let next = self.sent.map_or(soon, |sent| sent.saturating_add(ANSWER_INTERVAL));
            self.due = Some(soon.max(next));
        }
        self.waiting.push(ping);
        Ok(())
    }

    pub(super) fn due(&self) -> Option<Duration> {
        self.due
    }

    /// All that wait, once they are due.
    pub(super) fn take(&mut self, now: Duration) -> Vec<Waiting> {
        if self.due.is_none_or(|due| due > now) {
            return Vec::new();
        }
        self.due = None;
        self.sent = Some(now);
        std::mem::take(&mut self.waiting)
    }
}
