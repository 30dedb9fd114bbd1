//! Pings that wait for answers.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use blaze_domain::FlowId;

use super::ignored::Ignored;
use super::limits::{LOST_AFTER, OPEN_PINGS};
use super::order::OrderId;

/// What a ping was sent for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Purpose {
    /// Its layer was due.
    Round,
    /// A request for pings waits for a first answer.
    WarmUp(OrderId),
    /// The sample of a request with this index.
    Order(OrderId, usize),
}

impl Purpose {
    /// Whether the ping counts as sent and lost: not while the way of the answers is set up.
    pub(super) fn counts(self) -> bool {
        !matches!(self, Self::WarmUp(_))
    }
}

/// One ping.
#[derive(Debug)]
pub(super) struct OpenPing {
    /// By the monotonic clock.
    pub(super) sent: Duration,
    /// Nodes without an answer yet.
    pub(super) waiting: BTreeSet<FlowId>,
    pub(super) purpose: Purpose,
}

/// All of them by their numbers, which grow with time.
#[derive(Debug)]
pub(super) struct OpenPings {
    pings: BTreeMap<u64, OpenPing>,
    next: u64,
}

impl OpenPings {
    /// Numbers begin anywhere, so that an answer to an earlier life is not taken for one to this.
    pub(super) fn new(first: u32) -> Self {
        Self { pings: BTreeMap::new(), next: u64::from(first) }
    }

    /// Adds a ping and returns its number.
    pub(super) fn add(&mut self, ping: OpenPing) -> u64 {
        let id = self.next;
        self.next += 1;
        self.pings.insert(id, ping);
        id
    }

    /// Takes a node's answer: when the ping was sent, and what for.
    pub(super) fn answered(
        &mut self,
        now: Duration,
        id: u64,
        node: &FlowId,
    ) -> Result<(Duration, Purpose), Ignored> {
        let ping = self.pings.get_mut(&id).ok_or(Ignored::NotAwaited)?;
        if ping.is_late(now) || !ping.waiting.remove(node) {
            return Err(Ignored::NotAwaited);
        }
        let answered = (ping.sent, ping.purpose);
        if ping.waiting.is_empty() {
            self.pings.remove(&id);
        }
        Ok(answered)
    }

    /// Takes the oldest ping that is lost: without all answers in 5 s, or one too many.
    pub(super) fn take_lost(&mut self, now: Duration) -> Option<OpenPing> {
        let oldest = self.pings.first_entry()?;
        (oldest.get().is_late(now) || self.pings.len() > OPEN_PINGS)
            .then(|| self.pings.pop_first())
            .flatten()
            .map(|(_, ping)| ping)
    }

    pub(super) fn deadline(&self) -> Option<Duration> {
        self.pings.first_key_value().map(|(_, ping)| ping.sent.saturating_add(LOST_AFTER))
    }
}

impl OpenPing {
    fn is_late(&self, now: Duration) -> bool {
        now >= self.sent.saturating_add(LOST_AFTER)
    }
}
