//! Times and limits of the status stream and of what is made from it.

use std::time::Duration;

/// Nodes whose state is kept. The console's tables and the tick over them stay small.
pub const MAX_NODES: usize = 10_000;
/// One message of a monitor, in bytes, also after decompression (1 MiB): the largest answer.
pub const MAX_MESSAGE_BYTES: usize = 1024 * 1024;
/// One summary, in bytes (256 KiB): with [`MAX_NODES`] it bounds the memory.
pub const MAX_SUMMARY_BYTES: usize = 256 * 1024;
/// Version of the program and metrics address, in bytes each.
pub const MAX_WORD_BYTES: usize = 256;
/// Flows of one node that are looked at; a node has one, or a few in tests.
pub const MAX_FLOWS: usize = 8;
/// Problems of one node that are shown, the first ones; further ones are counted.
pub const MAX_PROBLEMS: usize = 200;
/// Services of one node that are shown, the first ones.
pub const MAX_SERVICES: usize = 1000;
/// Links of one node that are shown, the first ones.
pub const MAX_LINKS: usize = 1000;
/// A text of a problem, in characters: it is for people.
pub const MAX_TEXT_CHARS: usize = 500;
/// Problems in one answer; further ones are counted in `total`.
pub const MAX_LISTED: usize = 1000;

/// Without a summary for so long a node counts as silent: three of its 15 s periods. The last
/// [`WORSE`] of them are the hysteresis.
pub const SILENT: Duration = Duration::from_secs(45);
/// A state that is worse counts after this.
pub const WORSE: Duration = Duration::from_secs(5);
/// A state that is better counts after this.
pub const BETTER: Duration = Duration::from_secs(15);
/// Between two evaluations of all nodes.
pub const TICK: Duration = Duration::from_secs(1);
/// Between two summaries of a node that nobody looks at.
pub const IDLE_PERIOD: Duration = Duration::from_secs(15);

/// Shortest and longest period of summaries while somebody looks, in ms.
pub const PERIOD_MS: std::ops::RangeInclusive<u64> = 500..=10_000;
/// Period of a live view that names none, in ms.
pub const DEFAULT_PERIOD_MS: u64 = 1000;
/// An interest is sent again after this: it lapses at the monitor after 30 s.
pub const RENEW_INTEREST: Duration = Duration::from_secs(10);
/// A view that was not read for so many of its periods is not looked at any more.
pub const HELD_PERIODS: u32 = 3;
/// Pings come once a minute: their rows are asked for no more often than this.
pub const LATENCY_PERIOD: Duration = Duration::from_secs(5);

/// Queries of one node that are open at once; more wait.
pub const QUERIES: usize = 8;
/// Time for an answer, with the wait for a place.
pub const QUERY_TIME: Duration = Duration::from_secs(5);
/// An answer is shared by all who ask within this.
pub const SHARED_FOR: Duration = Duration::from_millis(500);
/// Messages that wait for one monitor: its queries, an interest, the last word.
pub const QUEUED: usize = 16;
/// Path with query of a query, in bytes.
pub const MAX_PATH_BYTES: usize = 2048;

/// Nodes that a view of one topic asks, those with drops first.
pub const TOPIC_NODES: usize = 50;
/// Nodes that the latency view asks: up to so many all nodes ping one another.
pub const LATENCY_NODES: usize = 64;
/// Places that are named for a topic, on each side.
pub const TOPIC_PLACES: usize = 20;

/// For a monitor to say which node it is of.
pub const GREETING: Duration = Duration::from_secs(10);
/// When a monitor that cannot be served is to come again.
pub const AGAIN_MS: u32 = 30_000;
