//! The worker as services and operators have it: real `blaze-config`, `blaze-worker` and Redis, killed and started again.
//!
//! Needs `cargo build --workspace` and `scripts/services install`.
//!
//! ```text
//! stage      a main service, a Redis and workers of one layer
//! kit        robots that each have a Redis of their own, and service processes
//! serving    what services are told, and whether only those it concerns
//! outages    the main service, the broker and the worker away, in turns and together
//! killed     worker, broker and database killed behind a cut link
//! rollouts   roll-outs that services judge
//! secrets    what services are not told is nowhere
//! wire       both ends of `Sync` across versions
//! raw        `Sync` as bytes
//! recorded   recordings of it
//! partition  the link to the main service loses everything while very much is changed (needs root: a network namespace)
//! ```

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "the helpers of a test fail like the test"
)]

mod killed;
mod kit;
mod outages;
mod partition;
mod raw;
mod recorded;
mod rollouts;
mod secrets;
mod serving;
mod stage;
mod wire;
