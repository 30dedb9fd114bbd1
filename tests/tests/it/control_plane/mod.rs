//! The configuration service as its users have it: real `blaze-config` processes, reached over REST
//! and gRPC.
//!
//! Needs `cargo build --workspace` and `scripts/services install` (MongoDB). `BLAZE_LONG` selects
//! the full counts; what takes time is asserted only there. Measured tests are best run one after
//! another (`--test-threads=1`).
//!
//! ```text
//! stage    a store and the processes on it: start, kill -9, start again, backup, restore
//! client   one user of one process, over REST or gRPC: put, apply, get, delete, list; yes, no or unknown
//! watcher  a watch with cuts, that checks what it is told;  stream, sse: events from bytes and messages
//! writer   changes services of its own
//! register, checker   the history of a register, and whether it can be explained
//! ```

mod backup;
mod canary;
mod checker;
mod client;
mod crashes;
mod linearizable;
mod other_layer;
mod register;
mod sse;
mod stage;
mod stream;
mod token;
mod watch;
mod watcher;
mod writer;

/// The full count, or a smaller one that fits into every run.
pub(crate) fn count(full: usize, short: usize) -> usize {
    if blaze_tests::long() { full } else { short }
}
