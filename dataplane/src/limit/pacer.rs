//! When the next datagram may leave, in wire bytes.
//!
//! The pacer spends a budget that refills with time. After a pause in which nothing was to be sent
//! at most two datagrams are saved, so that no burst fills a queue behind it. While something
//! waits, what a late wake-up of the sending thread has let go by is made good, up to [`LATE`]: on
//! a busy machine a link would otherwise carry less than its limit, however much waits for it.
//! LinkControl is never held back: it may put the pacer into debt, which user data then waits off.
//!
//! The limit holds for the wire, and the pacer stands before it. [`RESERVE`] of the limit is kept
//! for what happens between them, and of what the pacer lets out the allocation gives out all but
//! [`HEADROOM`]: 98.6 % of the limit.

use std::time::{Duration, Instant};

/// A burst is at most this many datagrams.
pub const BURST_DATAGRAMS: usize = 2;

/// Of what the sending thread has missed while something waited so much is made good: as late as a
/// scheduler with few cores often wakes it. More would use up a little more of the limit on a busy
/// machine, and be felt: what is made good at once stands before a narrow place until the
/// difference between its rate and the limit has worked it off. Two cameras over 40 Mbit/s on two
/// cores: with 0, 1.5 and 4 ms 97.6–98.5 %, 98.3–98.9 % and 98.7–98.8 % of the limit were used, and
/// the 99th percentile of the latency of small messages was 28.5–30.1, 29.1–30.7 and 31.6–33.6 ms.
pub const LATE: Duration = Duration::from_micros(1_500);

/// Share of the limit that is not spent, for what the pacer does not see: RustDDS' own discovery,
/// and that RustDDS sends from a thread of its own. What that thread holds back while it waits for
/// the processor leaves within the next second, on top of that second's own: where the pacer lets
/// out `1 − RESERVE` of the limit, and what [`LATE`] makes good, a second stays within the limit
/// after a pause of up to 8 ms.
pub const RESERVE: f64 = 0.01;

/// Share of what the pacer lets out that is not allocated. A queue that is filled as fast as it is
/// emptied never becomes shorter again, whatever made it long: a repair, a snapshot, images of two
/// cameras at the same moment. With this its use is 0.996, and a surplus image at 5 MB/s is worked
/// off in 50 s. More would cost images: all that is left out here is left out of the large topic
/// that gets the rest, whose rate then lies further below what the whole limit would give it.
pub const HEADROOM: f64 = 0.004;

/// What of a limit in bytes per second is given out to topics and control messages.
#[must_use]
pub fn allocated(limit_bytes_per_s: f64) -> f64 {
    limit_bytes_per_s.max(0.0) * (1.0 - RESERVE) * (1.0 - HEADROOM)
}

/// A budget of wire bytes per second. It is exact over any second: what was spent is never
/// forgotten.
#[derive(Debug, Clone)]
pub struct Pacer {
    limit_bytes_per_s: f64,
    /// Without the reserve.
    bytes_per_s: f64,
    /// Bytes that may leave now; negative = debt.
    credit: f64,
    burst_bytes: f64,
    /// Nothing is to be sent.
    rests: bool,
    filled: Instant,
}

impl Pacer {
    /// A pacer for a limit; `burst_bytes` is the most that leaves at once after a pause.
    #[must_use]
    pub fn new(limit_bytes_per_s: f64, burst_bytes: usize, now: Instant) -> Self {
        Self {
            limit_bytes_per_s,
            bytes_per_s: paced(limit_bytes_per_s),
            credit: 0.0,
            burst_bytes: burst_bytes as f64,
            rests: true,
            filled: now,
        }
    }

    /// Changes the limit from now on.
    pub fn set_limit(&mut self, limit_bytes_per_s: f64, now: Instant) {
        self.fill(now);
        self.limit_bytes_per_s = limit_bytes_per_s;
        self.bytes_per_s = paced(limit_bytes_per_s);
    }

    /// Changes the most that leaves at once after a pause.
    pub fn set_burst(&mut self, burst_bytes: usize) {
        self.burst_bytes = burst_bytes as f64;
    }

    /// The limit in bytes per second, the reserve included.
    #[must_use]
    pub fn limit(&self) -> f64 {
        self.limit_bytes_per_s
    }

    /// Takes what has left.
    pub fn spend(&mut self, wire_bytes: usize, now: Instant) {
        self.fill(now);
        self.rests = false;
        self.credit -= wire_bytes as f64;
    }

    /// Nothing is to be sent until [`Pacer::spend`] is called next: no more than a burst is saved.
    pub fn rest(&mut self, now: Instant) {
        self.rests = true;
        self.fill(now);
    }

    /// How long user data has to wait; zero = it may leave.
    pub fn wait(&mut self, now: Instant) -> Duration {
        self.fill(now);
        if self.credit >= 0.0 {
            return Duration::ZERO;
        }
        Duration::from_secs_f64((-self.credit / self.bytes_per_s).min(60.0))
    }

    fn fill(&mut self, now: Instant) {
        let elapsed = now.saturating_duration_since(self.filled).as_secs_f64();
        let late = if self.rests { 0.0 } else { LATE.as_secs_f64() };
        let most = self.burst_bytes + late * self.bytes_per_s;
        self.credit = (self.credit + elapsed * self.bytes_per_s).min(most);
        self.filled = self.filled.max(now);
    }
}

fn paced(limit_bytes_per_s: f64) -> f64 {
    (limit_bytes_per_s * (1.0 - RESERVE)).max(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMIT: f64 = 1_000_000.0;

    /// When datagrams of 1400 bytes leave the pacer during five seconds without a pause.
    fn departures(start: Instant) -> Vec<Instant> {
        let mut now = start;
        let mut pacer = Pacer::new(LIMIT, 2800, start);
        let mut sent = Vec::new();
        while now < start + Duration::from_secs(5) {
            let wait = pacer.wait(now);
            if wait.is_zero() {
                pacer.spend(1400, now);
                sent.push(now);
            }
            now += wait.max(Duration::from_micros(50));
        }
        sent
    }

    /// Bytes that leave in ten seconds through a thread that wakes up so late each time.
    fn sent_by_a_thread_that_wakes_late(late: Duration) -> (usize, usize) {
        let start = Instant::now();
        let (mut now, mut pacer, mut sent) = (start, Pacer::new(LIMIT, 2800, start), Vec::new());
        while now < start + Duration::from_secs(10) {
            let wait = pacer.wait(now);
            if wait.is_zero() {
                pacer.spend(1400, now);
                sent.push(now);
            } else {
                now += wait + late;
            }
        }
        (1400 * sent.len(), most_bytes_in_a_second(&sent))
    }

    #[test]
    fn what_a_late_thread_has_missed_is_made_good() {
        let (total, most) = sent_by_a_thread_that_wakes_late(LATE);
        assert!(total as f64 > 0.999 * 10.0 * paced(LIMIT), "{total} bytes in 10 s");
        assert!(most <= 1_000_000, "{most} bytes in a second");
        // Not what was missed for longer.
        let (total, _) = sent_by_a_thread_that_wakes_late(LATE * 10);
        assert!((total as f64) < 0.4 * 10.0 * LIMIT, "{total} bytes in 10 s");
    }

    #[test]
    fn nothing_is_made_good_after_a_rest() {
        let start = Instant::now();
        let mut pacer = Pacer::new(LIMIT, 2800, start);
        pacer.spend(1400, start);
        let later = start + Duration::from_millis(1);
        pacer.rest(later);
        assert_eq!(leaves_at_once(&mut pacer, later + Duration::from_secs(1)), 3);
        let more = leaves_at_once(&mut pacer, later + Duration::from_secs(2));
        assert_eq!(more, 4, "it did not rest");
    }

    /// Datagrams that leave at one moment.
    fn leaves_at_once(pacer: &mut Pacer, now: Instant) -> usize {
        let mut datagrams = 0;
        while pacer.wait(now).is_zero() {
            pacer.spend(1400, now);
            datagrams += 1;
        }
        datagrams
    }

    fn most_bytes_in_a_second(sent: &[Instant]) -> usize {
        let within = |first: Instant| {
            sent.iter().filter(move |at| **at >= first && **at < first + Duration::from_secs(1))
        };
        sent.iter().map(|first| 1400 * within(*first).count()).max().unwrap()
    }

    #[test]
    fn no_second_exceeds_the_limit_and_it_is_nearly_used_up() {
        let start = Instant::now();
        let sent = departures(start);
        let total = 1400 * sent.len();
        assert!(total > 4_800_000, "{total} bytes in 5 s");
        // Nor where the transport stands still for 8 ms.
        let (from, until) = (start + Duration::from_secs(2), start + Duration::from_millis(2008));
        let held_back = sent.iter().map(|at| if (from..until).contains(at) { until } else { *at });
        for sent in [&sent, &held_back.collect()] {
            let most = most_bytes_in_a_second(sent);
            assert!(most <= 1_000_000, "{most} bytes in a second");
        }
    }

    #[test]
    fn a_larger_burst_holds_from_the_next_pause_on() {
        let start = Instant::now();
        let mut pacer = Pacer::new(LIMIT, 1_400, start);
        let second = Duration::from_secs(1);
        // What is saved, and one that begins with nothing left.
        assert_eq!(leaves_at_once(&mut pacer, start + second), 2);
        pacer.rest(start + second);
        pacer.set_burst(2_800);
        assert_eq!(leaves_at_once(&mut pacer, start + second * 2), 3);
    }

    #[test]
    fn what_is_allocated_is_less_than_what_leaves_and_more_than_is_asked_for() {
        let given = allocated(LIMIT);
        assert!(given < paced(LIMIT) && given > 0.985 * LIMIT, "{given}");
        assert!(allocated(-1.0).abs() < f64::EPSILON);
    }

    #[test]
    fn control_goes_into_debt_that_data_waits_off() {
        let start = Instant::now();
        let mut pacer = Pacer::new(1000.0, 100, start);
        pacer.spend(588, start);
        assert_eq!(pacer.wait(start).as_millis(), 593);
        assert!(pacer.wait(start + Duration::from_millis(601)).is_zero());
    }
}
