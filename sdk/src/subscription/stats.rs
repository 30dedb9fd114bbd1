//! What a subscription counted.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};

use blaze_domain::DropReason;

use crate::monitor::Counts;

/// What a subscription counted since it was made, in messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct SubscriptionStats {
    /// Arrived from the broker, of any kind.
    pub received: u64,
    /// Handed to the callback.
    pub delivered: u64,
    /// Missing between the first and the last sequence received of a writer. What a flow left out
    /// on the way, because of the rate asked for or the budget, is missing as well.
    pub lost: u64,
    /// Repeats, by writer and sequence; left out.
    pub duplicated: u64,
    /// Came after a later one of the same writer; delivered all the same.
    pub reordered: u64,
    /// Left out, because they came faster than `max_rate_hz`.
    pub skipped: u64,
    /// Left out, because they were older than their lifespan or that of the subscription.
    pub expired: u64,
    /// Gave way in a full queue, because the callback was slower than they came.
    pub queue_dropped: u64,
    /// Left out, because they claimed to be frames and were none.
    pub malformed: u64,
    /// Calls of the callback that panicked.
    pub panicked: u64,
}

impl SubscriptionStats {
    /// As metrics have it, without callbacks.
    pub(super) fn counts(&self) -> Counts {
        Counts {
            messages: BTreeMap::from([("receive", self.received)]),
            dropped: BTreeMap::from([
                (DropReason::Duplicate, self.duplicated),
                (DropReason::MaxRate, self.skipped),
                (DropReason::Lifespan, self.expired),
                (DropReason::QueueFull, self.queue_dropped),
                (DropReason::DecodeError, self.malformed),
            ]),
            callbacks: None,
        }
    }
}

macro_rules! counters {
    ($($name:ident),+) => {
        #[derive(Default)]
        pub(crate) struct Counters { $(pub(super) $name: Counter),+ }

        impl Counters {
            pub(super) fn read(&self) -> SubscriptionStats {
                SubscriptionStats { $($name: self.$name.0.load(Ordering::Relaxed)),+ }
            }
        }
    };
}

counters!(
    received,
    delivered,
    lost,
    duplicated,
    reordered,
    skipped,
    expired,
    queue_dropped,
    malformed,
    panicked
);

#[derive(Default)]
pub(crate) struct Counter(AtomicU64);

impl Counter {
    pub(super) fn add(&self, count: u64) {
        self.0.fetch_add(count, Ordering::Relaxed);
    }

    /// Takes back what was counted before.
    pub(super) fn take_back(&self, count: u64) {
        self.0.fetch_sub(count, Ordering::Relaxed);
    }
}
