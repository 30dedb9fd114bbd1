//! Datagrams in the air of a simulated network.

use std::collections::BTreeMap;
use std::time::Instant;

/// Things that arrive at a time, and in the order of their sending where two arrive at once.
pub(crate) struct Flights<T> {
    waiting: BTreeMap<(Instant, u64), T>,
    sent: u64,
}

impl<T> Default for Flights<T> {
    fn default() -> Self {
        Self { waiting: BTreeMap::new(), sent: 0 }
    }
}

impl<T> Flights<T> {
    pub(crate) fn send(&mut self, due: Instant, load: T) {
        self.sent += 1;
        self.waiting.insert((due, self.sent), load);
    }

    /// When the next one arrives.
    pub(crate) fn next_due(&self) -> Option<Instant> {
        self.waiting.first_key_value().map(|((due, _), _)| *due)
    }

    /// The next one that has arrived by `now`.
    pub(crate) fn arrived(&mut self, now: Instant) -> Option<T> {
        self.next_due().filter(|due| *due <= now)?;
        self.waiting.pop_first().map(|(_, load)| load)
    }
}
