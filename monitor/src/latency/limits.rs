//! Times and limits of message latency.

use std::time::Duration;

/// Values of one label, `_other` included.
pub(super) const MAX_LABELS: usize = 256;
/// Pairs of topic and publishing node; the others are one, `_other`.
pub(super) const MAX_PAIRS: usize = 2_000;
/// Last values of a pair that quantiles are made from; 12 bytes each.
pub(super) const WINDOW: usize = 256;
/// Writers whose losses are counted; of more the one that is silent for longest is forgotten.
pub(super) const MAX_WRITERS: usize = 4_096;
/// A pair that is silent this long gives its place to a new one when there is no other.
pub(super) const IDLE: Duration = Duration::from_secs(600);
/// Idle pairs are looked for this often while there is no room: messages of `_other` may be many.
pub(super) const SWEEP_EVERY: Duration = Duration::from_secs(60);
/// Raw samples that wait to be taken; about 150 bytes each. The oldest give way.
pub(super) const MAX_SAMPLES: usize = 10_000;
/// Error in seconds below which a clock is good enough whatever the latency is.
pub(super) const GOOD_ERROR_S: f64 = 0.001;
/// Part of the latency that the error may be beyond that.
pub(super) const ERROR_PART: f64 = 0.5;
/// Longest latency in seconds: stamps that are further off are of a recording or a simulation.
pub(super) const MAX_LATENCY_S: f64 = 3_600.0;
/// Upper bounds of the buckets in seconds: from one host to a slow mobile network.
pub(super) const BUCKETS: [f64; 13] =
    [0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0];
