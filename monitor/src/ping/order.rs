//! Pings on request: `POST /v1/ping`.

use std::time::Duration;

use blaze_domain::FlowId;
use serde::Serialize;

use super::estimate::{Now, Sample};
use super::limits::{
    ORDER_COUNT, ORDER_INTERVAL, ORDER_LONGEST_INTERVAL, ORDER_WARM_INTERVAL, ORDER_WARM_UP,
};
use super::open::Purpose;

/// Number of a request for pings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OrderId(pub(super) u64);

/// A request for pings is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum OrderError {
    /// Another request is not done yet.
    #[error("another request for pings is not done yet")]
    Busy,
    /// No such node is known.
    #[error("no monitor of {0} is known here")]
    Unknown(FlowId),
    /// Count or interval is out of range.
    #[error("1 to 100 pings, 50 ms to 60 s apart")]
    Invalid,
}

/// Result of one ping of a request.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(untagged)]
pub enum PingSample {
    /// Answered.
    Answered {
        /// Time on one way, in milliseconds.
        latency_ms: f64,
        /// Their clock minus ours, in milliseconds.
        offset_ms: f64,
        /// The true offset is not farther away than this, in milliseconds.
        error_ms: f64,
    },
    /// No answer in 5 s.
    Lost {
        /// True.
        lost: bool,
    },
}

impl PingSample {
    pub(super) const LOST: Self = Self::Lost { lost: true };

    pub(super) fn answered(sample: &Sample, now: Now) -> Self {
        let offset = sample.offset(now);
        Self::Answered {
            latency_ms: sample.latency_s() * 1e3,
            offset_ms: offset.offset_s * 1e3,
            error_ms: offset.error_s * 1e3,
        }
    }
}

/// The request that is being served.
#[derive(Debug)]
pub(super) struct Order {
    pub(super) id: OrderId,
    pub(super) to: FlowId,
    interval: Duration,
    next: Duration,
    /// Until then it waits for a first answer, because the way of the answers is being set up.
    warm_up: Option<Duration>,
    sent: usize,
    samples: Vec<Option<PingSample>>,
}

impl Order {
    pub(super) fn new(
        now: Duration,
        id: OrderId,
        to: FlowId,
        count: u32,
        interval: Duration,
    ) -> Result<Self, OrderError> {
        let count_is_good = (1..=ORDER_COUNT).contains(&count);
        if !count_is_good || !(ORDER_INTERVAL..=ORDER_LONGEST_INTERVAL).contains(&interval) {
            return Err(OrderError::Invalid);
        }
        let samples = vec![None; count as usize];
        Ok(Self { id, to, interval, next: now, warm_up: None, sent: 0, samples })
    }

    /// Waits for a first answer before the first sample.
    pub(super) fn warm_up(&mut self, now: Duration) {
        self.warm_up = Some(now.saturating_add(ORDER_WARM_UP));
    }

    pub(super) fn is_done(&self) -> bool {
        self.samples.iter().all(Option::is_some)
    }

    pub(super) fn samples(self) -> Vec<PingSample> {
        self.samples.into_iter().flatten().collect()
    }

    pub(super) fn deadline(&self) -> Option<Duration> {
        (self.sent < self.samples.len()).then_some(self.next)
    }

    /// What the ping that is due now is for, and sets the time of the next.
    pub(super) fn take_due(&mut self, now: Duration) -> Option<Purpose> {
        if self.deadline().is_none_or(|due| due > now) {
            return None;
        }
        if self.warm_up.is_some_and(|until| now < until) {
            self.next = now.saturating_add(ORDER_WARM_INTERVAL);
            return Some(Purpose::WarmUp(self.id));
        }
        self.warm_up = None;
        self.next = now.saturating_add(self.interval);
        self.sent += 1;
        Some(Purpose::Order(self.id, self.sent - 1))
    }

    /// Notes the result of a ping of this request.
    pub(super) fn result(&mut self, now: Duration, purpose: Purpose, sample: PingSample) {
        match purpose {
            Purpose::WarmUp(id) if id == self.id => self.warmed_up(now, sample),
            Purpose::Order(id, index) if id == self.id => {
                if let Some(slot) = self.samples.get_mut(index) {
                    *slot = Some(sample);
                }
            }
            // Pings of the rounds, and of a request that was cancelled.
            Purpose::Round | Purpose::WarmUp(_) | Purpose::Order(..) => {}
        }
    }

    fn warmed_up(&mut self, now: Duration, sample: PingSample) {
        if sample != PingSample::LOST && self.warm_up.take().is_some() {
            self.next = now;
        }
    }
}
