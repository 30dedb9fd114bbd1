//! The harness of real servers: what it starts answers, what it kills has gone, what it freezes stands still.
//!
//! Needs `scripts/services install`.

mod etcd;
mod kafka;
mod mongo;
mod redis;
mod shared;
