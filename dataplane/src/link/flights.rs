//! Datagrams in the air of a simulated network.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::time::Instant;

/// Things that arrive at a time, and in the order of their sending where two arrive at once.
pub(crate) struct Flights<T> {
    waiting: BinaryHeap<Reverse<Flight<T>>>,
    sent: u64,
}

struct Flight<T> {
    due: Instant,
    number: u64,
    load: T,
}

impl<T> PartialEq for Flight<T> {
    fn eq(&self, other: &Self) -> bool {
        self.number == other.number
    }
}
impl<T> Eq for Flight<T> {}
impl<T> PartialOrd for Flight<T> {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl<T> Ord for Flight<T> {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.due, self.number).cmp(&(other.due, other.number))
    }
}

impl<T> Default for Flights<T> {
    fn default() -> Self {
        Self {
            waiting: BinaryHeap::new(),
            sent: 0,
        }
    }
}

impl<T> Flights<T> {
    pub(crate) fn send(&mut self, due: Instant, load: T) {
        self.sent += 1;
        self.waiting.push(Reverse(Flight {
            due,
            number: self.sent,
            load,
        }));
    }

    /// When the next one arrives.
    pub(crate) fn next_due(&self) -> Option<Instant> {
        self.waiting.peek().map(|flight| flight.0.due)
    }

    /// The next one that has arrived by `now`.
    pub(crate) fn arrived(&mut self, now: Instant) -> Option<T> {
        if self.next_due()? > now {
            return None;
        }
        self.waiting.pop().map(|flight| flight.0.load)
    }
}
