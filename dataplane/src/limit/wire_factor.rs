//! How much more the wire carries than `s · α`: the measured wire factor ω.
//!
//! What leaves is user messages with their headers, chunks and repairs, and the link's own control
//! messages. The first grows with what is sent, the second does not. So both are measured apart:
//!
//! ```text
//! allocation runs on  (B · given out − control) / ω_user  =  B / ω,    ω_user = wire bytes of user messages / Σ s·α
//! ```
//!
//! `s` is the largest size of a topic, of which each message counts as much, however small it was:
//! where sizes vary ω is below 1, and the rates that come of it use up the limit.
//!
//! With a single quotient of all bytes a flow that has sent next to nothing would take Hellos for
//! the cost of messages, and give a camera that begins a tenth of the link.

use std::time::{Duration, Instant};

use super::pacer::allocated;

/// Layers that are measured one by one, at most; the others only count together with all.
pub const MAX_LAYERS: usize = 1_024;
/// Time constant of the means.
const TAU: Duration = Duration::from_secs(5);
/// Fewer bytes of `s` than this, over the time constant, tell nothing of what messages cost.
const ENOUGH_BYTES: f64 = 16_384.0;
/// The factor before anything was measured: what images cost, 1,376 bytes in each packet for 1,232
/// of them.
pub const FIRST: f64 = 1.1;
/// Bounds of what is believed of the cost of messages. Messages of a few bytes cost more than ten
/// times their size; those of a topic whose largest was an outlier cost next to nothing of it.
const BELIEVED: (f64, f64) = (0.01, 50.0);
/// Of the limit so much is left for messages at least, however much the link says itself.
const LEAST_SHARE: f64 = 0.1;

/// Totals since the start, in bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Totals {
    /// Wire bytes of datagrams that carried messages.
    pub user_wire: u64,
    /// Wire bytes of all others.
    pub control_wire: u64,
    /// `Σ s` of the messages that were sent, each copy counted once, and of those that are being
    /// sent the part that has left.
    pub reckoned: u64,
}

/// The wire factor of all links, or of those to one layer.
#[derive(Debug, Clone, Default)]
pub struct WireFactor {
    last: Option<(Instant, Totals)>,
    /// Decaying sums over [`TAU`], in bytes.
    user_wire: f64,
    reckoned: f64,
    /// Bytes per second.
    control: f64,
}

impl WireFactor {
    /// Takes the totals at a moment; to be called about once a second.
    pub fn sample(&mut self, now: Instant, totals: Totals) {
        let Some((at, before)) = self.last.replace((now, totals)) else {
            return;
        };
        let elapsed = now.saturating_duration_since(at).as_secs_f64();
        let went_back =
            totals.user_wire < before.user_wire || totals.control_wire < before.control_wire;
        if elapsed <= 0.0 || went_back {
            return;
        }
        let keeps = (-elapsed / TAU.as_secs_f64()).exp();
        self.user_wire = self.user_wire * keeps + (totals.user_wire - before.user_wire) as f64;
        // A little less than before where the size of a topic has just become smaller, of which a
        // message is being sent.
        let reckoned = totals.reckoned as f64 - before.reckoned as f64;
        self.reckoned = (self.reckoned * keeps + reckoned).max(0.0);
        let control = (totals.control_wire - before.control_wire) as f64 / elapsed;
        self.control = self.control * keeps + control * (1.0 - keeps);
    }

    /// `ω_user`: wire bytes of messages per byte of `s · α`; `None` while too little was sent to
    /// tell.
    #[must_use]
    pub fn of_messages(&self, overhead: f64) -> Option<f64> {
        let measured = self.user_wire / (self.reckoned * overhead.max(1.0));
        (self.reckoned >= ENOUGH_BYTES).then_some(measured.clamp(BELIEVED.0, BELIEVED.1))
    }

    /// What flows tell one another, in wire bytes per second.
    #[must_use]
    pub fn control_bytes_per_s(&self) -> f64 {
        self.control
    }
}

/// What a limit in wire bytes per second leaves for `s · α`, in bytes per second. Divided into the
/// limit it gives ω.
#[must_use]
pub fn budget(limit_bytes_per_s: f64, control_bytes_per_s: f64, of_messages: f64) -> f64 {
    let limit = limit_bytes_per_s.max(0.0);
    let for_messages = (allocated(limit) - control_bytes_per_s).max(limit * LEAST_SHARE);
    for_messages / of_messages
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    /// After a minute with so many bytes in each second.
    fn after_a_minute(user_wire: u64, control_wire: u64, reckoned: u64) -> WireFactor {
        let start = Instant::now();
        let mut factor = WireFactor::default();
        for second in 0..60u32 {
            let times = u64::from(second);
            let totals = Totals {
                user_wire: user_wire * times,
                control_wire: control_wire * times,
                reckoned: reckoned * times,
            };
            factor.sample(start + SECOND * second, totals);
        }
        factor
    }

    #[test]
    fn what_the_wire_adds_is_divided_out() {
        let factor = after_a_minute(1_122_000, 10_000, 1_000_000);
        let of_messages = factor.of_messages(1.02).unwrap();
        assert!((of_messages - 1.1).abs() < 1e-9);
        let budget = budget(2_000_000.0, factor.control_bytes_per_s(), of_messages);
        let expected = (allocated(2_000_000.0) - 10_000.0) / 1.1;
        assert!((budget - expected).abs() < 20.0, "{budget}, not {expected}");
    }

    #[test]
    fn a_flow_that_hardly_sends_does_not_take_hellos_for_messages() {
        let factor = after_a_minute(400, 900, 100);
        assert_eq!(factor.of_messages(1.02), None);
        assert!(budget(20e6, factor.control_bytes_per_s(), FIRST) > 17e6);
    }

    /// Images that LZ4 makes 100 and 40 kB large in turn, at the rate that the budget gives them.
    #[test]
    fn sizes_that_vary_leave_no_room_unused() {
        const LIMIT: f64 = 1e6;
        let start = Instant::now();
        let mut factor = WireFactor::default();
        let (mut user_wire, mut reckoned, mut wire_of_second) = (0.0f64, 0.0f64, 0.0f64);
        for second in 0..60u32 {
            let totals =
                Totals { user_wire: user_wire as u64, control_wire: 0, reckoned: reckoned as u64 };
            factor.sample(start + SECOND * second, totals);
            let of_messages = factor.of_messages(1.02).unwrap_or(FIRST);
            let hz = budget(LIMIT, factor.control_bytes_per_s(), of_messages) / (100_000.0 * 1.02);
            wire_of_second = hz * 70_000.0 * 1.08;
            user_wire += wire_of_second;
            reckoned += hz * 100_000.0;
        }
        let used = wire_of_second / allocated(LIMIT);
        assert!((used - 1.0).abs() < 0.001, "{used} of what is given out");
    }

    #[test]
    fn counters_that_go_back_and_clocks_that_stand_change_nothing() {
        let start = Instant::now();
        let mut factor = after_a_minute(1_122_000, 0, 1_000_000);
        let before = factor.of_messages(1.02).unwrap();
        factor.sample(start + SECOND * 100, Totals::default());
        factor.sample(start + SECOND * 100, Totals { reckoned: 9, ..Totals::default() });
        assert!((factor.of_messages(1.02).unwrap() - before).abs() < 1e-9);
        assert!(budget(f64::MIN, 0.0, FIRST).abs() < 1e-9);
    }

    #[test]
    fn control_messages_never_take_all() {
        let factor = after_a_minute(0, 1_000_000, 0);
        assert!(
            (budget(1_000.0, factor.control_bytes_per_s(), FIRST) - 100.0 / FIRST).abs() < 1e-9
        );
    }
}
