//! When the next datagram may leave, in wire bytes.
//!
//! The pacer spends a budget that refills with time and saves at most two datagrams, so that no burst fills a queue behind
//! it. LinkControl is never held back: it may put the pacer into debt, which user data then waits off.

use std::time::{Duration, Instant};

/// A budget of wire bytes per second. It is exact over any second: what was spent is never forgotten.
#[derive(Debug, Clone)]
pub struct Pacer {
    bytes_per_s: f64,
    /// Bytes that may leave now; negative = debt.
    credit: f64,
    burst_bytes: f64,
    filled: Instant,
}

impl Pacer {
    /// A pacer for a budget; `burst_bytes` is the most that leaves at once after a pause.
    #[must_use]
    pub fn new(bytes_per_s: f64, burst_bytes: usize, now: Instant) -> Self {
        Self {
            bytes_per_s: bytes_per_s.max(1.0),
            credit: 0.0,
            burst_bytes: burst_bytes as f64,
            filled: now,
        }
    }

    /// Changes the budget from now on.
    pub fn set_rate(&mut self, bytes_per_s: f64, now: Instant) {
        self.fill(now);
        self.bytes_per_s = bytes_per_s.max(1.0);
    }

    /// Bytes per second.
    #[must_use]
    pub fn rate(&self) -> f64 {
        self.bytes_per_s
    }

    /// Takes what has left.
    pub fn spend(&mut self, wire_bytes: usize, now: Instant) {
        self.fill(now);
        self.credit -= wire_bytes as f64;
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
        self.credit = (self.credit + elapsed * self.bytes_per_s).min(self.burst_bytes);
        self.filled = self.filled.max(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_second_exceeds_the_budget_by_more_than_the_burst() {
        let start = Instant::now();
        let mut now = start;
        let mut pacer = Pacer::new(1_000_000.0, 2800, start);
        let mut sent: Vec<(Instant, usize)> = Vec::new();
        while now < start + Duration::from_secs(5) {
            let wait = pacer.wait(now);
            if wait.is_zero() {
                pacer.spend(1400, now);
                sent.push((now, 1400));
            }
            now += wait.max(Duration::from_micros(50));
        }
        for (first, _) in &sent {
            let within = |t: &Instant| *t >= *first && *t < *first + Duration::from_secs(1);
            let bytes: usize = sent.iter().filter(|(at, _)| within(at)).map(|(_, bytes)| bytes).sum();
            assert!(bytes <= 1_000_000 + 2 * 2800, "{bytes} bytes in a second");
        }
        let total: usize = sent.iter().map(|(_, bytes)| bytes).sum();
        assert!(total > 4_900_000, "{total} bytes in 5 s");
    }

    #[test]
    fn control_goes_into_debt_that_data_waits_off() {
        let start = Instant::now();
        let mut pacer = Pacer::new(1000.0, 100, start);
        pacer.spend(600, start);
        assert_eq!(pacer.wait(start), Duration::from_millis(600));
        assert!(pacer.wait(start + Duration::from_millis(601)).is_zero());
    }
}
