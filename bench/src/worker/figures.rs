//! Times, and what a process used meanwhile.

use std::time::Duration;

use blaze_tests::process::cpu_time;
use serde::Serialize;

/// Of a number of times, in milliseconds.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub(crate) struct Spread {
    /// How many.
    pub(crate) count: usize,
    pub(crate) p50_ms: f64,
    pub(crate) p99_ms: f64,
    pub(crate) max_ms: f64,
}

impl Spread {
    pub(crate) fn of(mut times: Vec<Duration>) -> Self {
        times.sort_unstable();
        let at = |part: f64| {
            let index = ((times.len() as f64 * part) as usize).min(times.len().saturating_sub(1));
            times.get(index).map_or(0.0, |time| time.as_secs_f64() * 1e3)
        };
        Self { count: times.len(), p50_ms: at(0.5), p99_ms: at(0.99), max_ms: at(1.0) }
    }
}

/// CPU time of a process from now on.
pub(crate) struct Clock {
    process: u32,
    begun: Duration,
}

impl Clock {
    pub(crate) fn start(process: u32) -> anyhow::Result<Self> {
        Ok(Self { process, begun: cpu_time(process)? })
    }

    /// From the beginning of the process on.
    pub(crate) fn since_start(process: u32) -> Self {
        Self { process, begun: Duration::ZERO }
    }

    pub(crate) fn used(&self) -> anyhow::Result<Duration> {
        Ok(cpu_time(self.process)?.saturating_sub(self.begun))
    }

    /// Of one of so many operations, in milliseconds.
    pub(crate) fn used_ms(&self, operations: usize) -> anyhow::Result<f64> {
        Ok(self.used()?.as_secs_f64() * 1e3 / operations.max(1) as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_the_sorted_times() {
        let spread = Spread::of((1..=200).rev().map(Duration::from_millis).collect());
        assert_eq!(
            (spread.count, spread.p50_ms, spread.p99_ms, spread.max_ms),
            (200, 101.0, 199.0, 200.0)
        );
        assert_eq!(Spread::of(Vec::new()).p99_ms, 0.0);
    }
}
