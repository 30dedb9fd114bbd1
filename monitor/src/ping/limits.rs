//! Times and limits of pings, each with its unit and reason.

use std::time::Duration;

/// Bytes of a message: one UDP datagram on any path, headers included.
pub(super) const MESSAGE_BYTES: usize = 1_200;
/// Known nodes up to which each one is asked: the matrix is complete.
pub(super) const ALL_ASKED: usize = 64;
/// Nodes asked in one layer where not all are asked.
pub(super) const PER_LAYER: usize = 8;
/// Nodes asked in all layers together where not all are asked. Each asked node answers each that asks
/// on one topic, so the pongs that a node receives grow with the square of this number. Three layers
/// have all of `PER_LAYER`.
pub(super) const IN_ALL: usize = 24;
/// Nodes asked because their topics are measured: as many as `ALL_ASKED`, which bounds the series.
pub(super) const MEASURED: usize = 64;
/// Known nodes: ten times the largest system that was simulated.
pub(super) const KNOWN: usize = 10_000;
/// Period per known node: with each node asking each layer, about 10 pings a second reach a layer.
pub(super) const PERIOD_PER_NODE: Duration = Duration::from_millis(100);
/// Period by which a silent node is forgotten while pings are off: the default of `ping_period_s`.
pub(super) const PERIOD_WHEN_OFF: Duration = Duration::from_secs(60);
/// Share of the period by which each one differs, so that nodes do not fall into step.
pub(super) const JITTER: f64 = 0.1;
/// Periods after which a node that is no longer received is not known any more.
pub(super) const SILENT_PERIODS: u32 = 3;
/// Between two sweeps for silent nodes: short beside three periods, rare enough to cost nothing.
pub(super) const SWEEP: Duration = Duration::from_secs(10);
/// Pings at the start and after a step: as many as samples are kept.
pub(super) const START_PINGS: u8 = 8;
/// Between two of the pings at the start.
pub(super) const START_INTERVAL: Duration = Duration::from_secs(1);
/// A ping without an answer is lost: the lifespan of a message on these topics.
pub(super) const LOST_AFTER: Duration = Duration::from_secs(5);
/// Longest random delay of an answer, so that the nodes of a layer do not answer in one burst.
pub(super) const ANSWER_DELAY: Duration = Duration::from_millis(100);
/// Shortest time between two messages of answers; those of one second share a message.
pub(super) const ANSWER_INTERVAL: Duration = Duration::from_secs(1);
/// Answers that wait: 64 nodes that ask for each of 8 layers within a second.
pub(super) const ANSWERS_WAITING: usize = 512;
/// Answers that wait for one node: one request for pings at the shortest interval, and its rounds.
pub(super) const ANSWERS_PER_NODE: usize = 32;
/// Pings that wait for answers: 16 layers, and a request at the shortest interval, for 5 s.
pub(super) const OPEN_PINGS: usize = 512;
/// Samples of a node's clock that are kept; the one with the least error counts.
pub(super) const CLOCK_SAMPLES: usize = 8;
/// Latencies of a node that are kept for its quantiles: an hour of the default period.
pub(super) const LATENCIES: usize = 64;
/// Nanoseconds by which a wall clock must leave its course to count as a step.
pub(super) const STEP_NS: i64 = 5_000_000;
/// Steps of a clock while a message is on its way: a message with a number smaller by this or less
/// was overtaken. A restart takes a random number, so it cannot be mistaken for that.
pub(super) const STEPS_ON_THE_WAY: i64 = 16;
/// Drift between two synchronised clocks, in parts per million.
pub(super) const DRIFT_SYNCHRONIZED_PPM: f64 = 15.0;
/// Drift between two clocks of which one is not synchronised, in parts per million.
pub(super) const DRIFT_PPM: f64 = 100.0;
/// Offsets that the flow knows from its links, and those that its peers know: as many as nodes.
pub(super) const OTHER_OFFSETS: usize = KNOWN;
/// Pings of one request.
pub(super) const ORDER_COUNT: u32 = 100;
/// Shortest time between two pings of a request.
pub(super) const ORDER_INTERVAL: Duration = Duration::from_millis(50);
/// Longest time between two pings of a request, so that one ends within 100 minutes.
pub(super) const ORDER_LONGEST_INTERVAL: Duration = Duration::from_secs(60);
/// How long a request waits for a first answer of a node whose topic was not yet requested.
pub(super) const ORDER_WARM_UP: Duration = Duration::from_secs(5);
/// Between two pings of that wait.
pub(super) const ORDER_WARM_INTERVAL: Duration = Duration::from_millis(500);
/// Upper bounds of the latency histogram's buckets, in seconds: from a wire to a satellite.
pub(super) static BUCKETS: [f64; 11] =
    [0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5];
