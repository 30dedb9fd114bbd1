//! Latencies in Prometheus' words.

use crate::lane::measure::LatencyHistogram;

/// Upper bounds of the latency buckets in seconds.
const BUCKETS: [f64; 14] =
    [0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0];

/// A latency histogram as Prometheus counts: cumulative, in seconds.
#[derive(Default)]
pub(super) struct Histogram {
    below: [u64; BUCKETS.len()],
    count: u64,
    sum_s: f64,
}

impl Histogram {
    pub(super) fn add(&mut self, latency: &LatencyHistogram) {
        for (below, bound) in self.below.iter_mut().zip(BUCKETS) {
            *below += latency.count_up_to_us((bound * 1e6) as u64);
        }
        self.count += latency.count();
        self.sum_s += latency.sum_us() as f64 / 1e6;
    }

    /// `labels`: as they stand between the braces.
    pub(super) fn write(&self, name: &str, labels: &str, text: &mut String) {
        use std::fmt::Write as _;
        for (below, bound) in self.below.iter().zip(BUCKETS) {
            let _ = writeln!(text, "{name}_bucket{{{labels},le=\"{bound}\"}} {below}");
        }
        let _ = writeln!(text, "{name}_bucket{{{labels},le=\"+Inf\"}} {}", self.count);
        let _ = writeln!(text, "{name}_sum{{{labels}}} {}", self.sum_s);
        let _ = writeln!(text, "{name}_count{{{labels}}} {}", self.count);
    }
}
