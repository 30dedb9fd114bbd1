//! Times and limits of the monitor's program, each with its reason. Those of the parts without
//! input and output are in `node`, `ping`, `health` and `latency`.

use std::time::Duration;

use blaze_runtime::http::GetLimits;

/// Between two looks at the flows and the worker: a change is seen, judged and reported within the
/// 10 s in which somebody who injects a fault expects it.
pub const LOOK: Duration = Duration::from_secs(1);
/// Between two questions for what costs a flow more than its summary: peers, bridges, requesters. A
/// problem is named 5 s after it was seen, so that a fault has a name within 10 s.
pub const LOOK_CLOSER: Duration = Duration::from_secs(3);
/// A flow or worker on this machine answers within this time, or counts as away.
pub const ANSWER: GetLimits = GetLimits {
    connect: Duration::from_millis(500),
    answer: Duration::from_secs(2),
    bytes: 16 * 1024 * 1024,
};
/// Flows that are asked, at most: `monitor.flows` may be a name with many addresses.
pub const MAX_FLOWS: usize = 64;
/// For the name of a flow to be resolved.
pub const RESOLVE: Duration = Duration::from_millis(500);
/// Longest pause between two closer looks at a flow that needs long for them.
pub const LOOK_CLOSER_AT_LEAST: Duration = Duration::from_secs(15);
/// Blocked topics that a flow is asked about, at most, each look: one question each.
pub const MAX_BLOCKED: usize = 20;

/// Between two values of the history.
pub const HISTORY_STEP: Duration = Duration::from_secs(10);
/// Values of one series: an hour.
pub const HISTORY_VALUES: usize = 360;
/// Series of the history, at most: with 360 values of 4 bytes they stay below 2 MiB.
pub const HISTORY_SERIES: usize = 1_000;

/// Pings and answers that wait for the engine, at most; the rest is dropped and counted.
pub const PING_QUEUE: usize = 1_024;
/// Topics that are subscribed for their latency, at most.
pub const MAX_LATENCY_TOPICS: usize = 256;
/// Messages that wait to be measured, at most.
pub const LATENCY_QUEUE: usize = 4_096;

/// Between two summaries while nobody looks.
pub const REPORT: Duration = Duration::from_secs(15);
/// A summary of a change comes this long after it at most; changes meanwhile go with it.
pub const REPORT_CHANGE: Duration = Duration::from_millis(500);
/// An interest lapses after this time.
pub const INTEREST: Duration = Duration::from_secs(30);
/// Shortest and longest period that an interest may ask for, in ms.
pub const INTEREST_MS: (u32, u32) = (500, 10_000);
/// Questions of the main service that are answered at a time.
pub const QUERIES: usize = 8;
/// For one of these.
pub const QUERY: Duration = Duration::from_secs(5);
/// Largest answer and summary, in bytes.
pub const MAX_ANSWER_BYTES: usize = 1024 * 1024;
/// Problems of a summary, the worst ones, so that it stays below its largest size.
pub const MAX_PROBLEMS: usize = 200;
/// Largest summary, in bytes.
pub const MAX_SUMMARY_BYTES: usize = 256 * 1024;

/// Page of one other program in `/metrics?all=1`, in bytes.
pub const MAX_PAGE_BYTES: usize = 8 * 1024 * 1024;
/// All of them, in bytes.
pub const MAX_ALL_PAGES_BYTES: usize = 32 * 1024 * 1024;
/// For all of them: less than the 10 s after which Prometheus gives up.
pub const ALL_PAGES: Duration = Duration::from_secs(8);
/// Services whose pages go into `/metrics?all=1`, at most.
pub const MAX_PAGES: usize = 256;
