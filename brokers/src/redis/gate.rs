//! Between the publishers of a connection and the task that writes it.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use blaze_domain::DropReason;
use tokio::sync::Notify;

use super::publisher::Target;
use crate::outbox::{Admission, Outbox, OutboxLimits};

/// Queues of small topics: 16 MiB per publisher hold 10 s of a 1-kB topic at 1.6 kHz.
const SMALL: OutboxLimits = OutboxLimits {
    lane_messages: 16_384,
    lane_bytes: 16 * 1024 * 1024,
    total_bytes: 32 * 1024 * 1024,
};
/// Queues of large topics: one of the largest messages fits beside others.
const LARGE: OutboxLimits = OutboxLimits {
    lane_messages: 256,
    lane_bytes: 32 * 1024 * 1024,
    total_bytes: 64 * 1024 * 1024,
};

/// Bytes of messages that one publisher's queue holds at most while the server takes nothing.
pub const MAX_QUEUE_BYTES: usize = LARGE.lane_bytes;

/// The queues of one connection, and whether anything is taken for them.
pub(super) struct Gate {
    open: AtomicBool,
    pub(super) outbox: Arc<Outbox<Target>>,
    /// Batches that are being made, or that the server has not answered.
    busy: AtomicUsize,
    settled: Notify,
}

/// One of the batches that count as busy.
pub(super) struct Busy(Arc<Gate>);

impl Gate {
    pub(super) fn new(large: bool) -> Arc<Self> {
        Arc::new(Self {
            open: AtomicBool::new(false),
            outbox: Outbox::new(if large { LARGE } else { SMALL }),
            busy: AtomicUsize::new(0),
            settled: Notify::new(),
        })
    }

    pub(super) fn is_open(&self) -> bool {
        self.open.load(Ordering::Acquire)
    }

    /// Closing drops what waits; so does opening what slipped in meanwhile, as it is old.
    pub(super) fn set_open(&self, open: bool) {
        if open == self.is_open() {
            return;
        }
        if open {
            self.outbox.clear(DropReason::BrokerError);
            self.open.store(true, Ordering::Release);
        } else {
            self.open.store(false, Ordering::Release);
            self.outbox.clear(DropReason::BrokerError);
        }
    }

    /// Announces a batch before its messages leave the queue, so that [`Gate::drained`] never
    /// overlooks them.
    pub(super) fn busy(self: &Arc<Self>) -> Busy {
        self.busy.fetch_add(1, Ordering::SeqCst);
        Busy(Arc::clone(self))
    }

    /// Takes nothing more, and waits until the server has answered all that was taken.
    pub(super) async fn drained(&self, most: Duration) {
        self.outbox.close();
        let empty = async {
            while self.is_open()
                && !(self.outbox.is_empty() && self.busy.load(Ordering::SeqCst) == 0)
            {
                self.settled.notified().await;
            }
        };
        // What is left then is counted as dropped.
        let _ = tokio::time::timeout(most, empty).await;
    }
}

impl Admission for Arc<Gate> {
    fn is_shut(&self) -> bool {
        !self.is_open()
    }

    fn queued(&self) {
        if !self.is_open() {
            // It closed between the two: what slipped in after it was emptied is dropped here.
            self.outbox.clear(DropReason::BrokerError);
        }
    }
}

impl Drop for Busy {
    fn drop(&mut self) {
        if self.0.busy.fetch_sub(1, Ordering::SeqCst) == 1 {
            self.0.settled.notify_one();
        }
    }
}
