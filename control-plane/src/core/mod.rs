//! The use cases of the main service: pure rules in the middle, one committer, a log of recent
//! commits.
//!
//! ```text
//! REST, gRPC ─▶ service ─▶ queue ─▶ committer ─[evaluate: state + request → changes]─▶ Store::commit ─▶ state, log ─▶ watch
//!                  │                                                                        ▲
//!                  └── reads: state (after a barrier: what the store acknowledged is applied)  └─ follower: commits of others
//! ```

mod affected;
mod barrier;
mod check;
mod committer;
mod cost;
mod digests;
mod edited;
mod evaluate;
mod log;
mod page;
mod pattern;
mod refs;
mod report;
mod rollouts;
mod schema;
mod secrets;
pub mod service;
#[cfg(test)]
mod service_tests;
pub mod testing;
pub mod types;
mod view;
mod watch;
mod workers;

pub(crate) use committer::now;
pub use committer::{CommitReport, OnCommit};
pub use service::{
    ConfigService, CoreOptions, DiffReport, End, LiveItem, LiveQuery, LiveStream, LiveView,
    OLDEST_SYNC_PROTOCOL, ProblemsQuery, SYNC_PROTOCOL, SyncHello, SyncItem, SyncStream,
    TopicsQuery, WhyQuery, live_view,
};
pub use types::*;
pub use watch::WatchStream;
pub use workers::{Acknowledged, RolloutReport, Running, RunningState, WorkerName, WorkerSession};
