//! How much more the wire carries than `s · α`: the wire factor ω of F9, measured.
//!
//! What leaves is user messages with their headers, chunks and repairs, and the link's own control messages. The first grows with what is
//! sent, the second does not. So both are measured apart:
//!
//! ```text
//! allocation runs on  (B · (1 − reserve) − control) / ω_user  =  B / ω,    ω_user = wire bytes of user messages / Σ s·α
//! ```
//!
//! With a single quotient of all bytes a flow that has sent next to nothing would take Hellos for the cost of messages, and give a camera
//! that begins a tenth of the link.

use std::time::{Duration, Instant};

use super::pacer::RESERVE;

/// Time constant of the means.
const TAU: Duration = Duration::from_secs(5);
/// Fewer bytes of payload than this, over the time constant, tell nothing of what messages cost.
const ENOUGH_BYTES: f64 = 16_384.0;
/// The factor before anything was measured: a little more than what images cost.
const FIRST: f64 = 1.06;
/// Bounds of what is believed of the cost of messages. Messages of a few bytes cost more than ten times their size.
const BELIEVED: (f64, f64) = (0.9, 50.0);
/// Of the limit so much is left for messages at least, however much the link says itself.
const LEAST_SHARE: f64 = 0.1;

/// Totals since the start, in bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Totals {
    /// Wire bytes of datagrams that carried messages.
    pub user_wire: u64,
    /// Wire bytes of all others.
    pub control_wire: u64,
    /// Payload of messages that were sent, each counted once.
    pub payload: u64,
}

/// The wire factor of all links, or of one.
#[derive(Debug, Clone)]
pub struct WireFactor {
    last: Option<(Instant, Totals)>,
    /// Decaying sums over [`TAU`], in bytes.
    user_wire: f64,
    payload: f64,
    /// Bytes per second.
    control: f64,
}

impl Default for WireFactor {
    fn default() -> Self {
        Self {
            last: None,
            user_wire: 0.0,
            payload: 0.0,
            control: 0.0,
        }
    }
}

impl WireFactor {
    /// Takes the totals at a moment; to be called about once a second.
    pub fn sample(&mut self, now: Instant, totals: Totals) {
        let Some((at, before)) = self.last.replace((now, totals)) else {
            return;
        };
        let elapsed = now.saturating_duration_since(at).as_secs_f64();
        let went_back = totals.payload < before.payload || totals.user_wire < before.user_wire;
        if elapsed <= 0.0 || went_back || totals.control_wire < before.control_wire {
            // A topic was forgotten with its counters.
            return;
        }
        let keeps = (-elapsed / TAU.as_secs_f64()).exp();
        self.user_wire = self.user_wire * keeps + (totals.user_wire - before.user_wire) as f64;
        self.payload = self.payload * keeps + (totals.payload - before.payload) as f64;
        let control = (totals.control_wire - before.control_wire) as f64 / elapsed;
        self.control = self.control * keeps + control * (1.0 - keeps);
    }

    /// `ω_user`: wire bytes of messages per byte of `s · α`.
    #[must_use]
    pub fn of_messages(&self, overhead: f64) -> f64 {
        if self.payload < ENOUGH_BYTES {
            return FIRST;
        }
        (self.user_wire / (self.payload * overhead.max(1.0))).clamp(BELIEVED.0, BELIEVED.1)
    }

    /// What a limit in wire bytes per second leaves for `s · α`, in bytes per second. Divided into the limit it gives ω.
    #[must_use]
    pub fn budget(&self, limit_bytes_per_s: f64, overhead: f64) -> f64 {
        let limit = limit_bytes_per_s.max(0.0);
        let for_messages = (limit * (1.0 - RESERVE) - self.control).max(limit * LEAST_SHARE);
        for_messages / self.of_messages(overhead)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    /// After a minute with so many bytes in each second.
    fn after_a_minute(user_wire: u64, control_wire: u64, payload: u64) -> WireFactor {
        let start = Instant::now();
        let mut factor = WireFactor::default();
        for second in 0..60u32 {
            let times = u64::from(second);
            let totals = Totals {
                user_wire: user_wire * times,
                control_wire: control_wire * times,
                payload: payload * times,
            };
            factor.sample(start + SECOND * second, totals);
        }
        factor
    }

    #[test]
    fn what_the_wire_adds_is_divided_out() {
        let factor = after_a_minute(1_122_000, 10_000, 1_000_000);
        assert!((factor.of_messages(1.02) - 1.1).abs() < 1e-9);
        let budget = factor.budget(2_000_000.0, 1.02);
        let expected = (2_000_000.0 * (1.0 - RESERVE) - 10_000.0) / 1.1;
        assert!((budget - expected).abs() < 20.0, "{budget}, not {expected}");
    }

    #[test]
    fn a_flow_that_hardly_sends_does_not_take_hellos_for_messages() {
        let factor = after_a_minute(400, 900, 100);
        assert!((factor.of_messages(1.02) - FIRST).abs() < 1e-12);
        assert!(factor.budget(20e6, 1.02) > 18e6);
    }

    #[test]
    fn counters_that_go_back_and_clocks_that_stand_change_nothing() {
        let start = Instant::now();
        let mut factor = after_a_minute(1_122_000, 0, 1_000_000);
        let before = factor.of_messages(1.02);
        factor.sample(start + SECOND * 100, Totals::default());
        factor.sample(start + SECOND * 100, Totals { payload: 9, ..Totals::default() });
        assert!((factor.of_messages(1.02) - before).abs() < 1e-9);
        assert!(WireFactor::default().budget(f64::MIN, 1.0).abs() < 1e-9);
    }

    #[test]
    fn control_messages_never_take_all() {
        let factor = after_a_minute(0, 1_000_000, 0);
        assert!((factor.budget(1_000.0, 1.0) - 100.0 / FIRST).abs() < 1e-9);
    }
}
