//! BlazeConfig's worker: keeps a copy of what its layer sees, and gives every service its
//! configuration over the local broker, also while the main service, the broker or a database is
//! away.
//!
//! ```text
//! main service ──Sync──▶ core::LayerView ──▶ core::Served ──▶ answers and notices on the local broker
//!                            │   ▲
//!                            ▼   │ at the start: last-known-good file or MongoDB, else mounted file
//!                          copy::Copies
//! ```

pub mod admin;
pub mod copy;
pub mod core;
pub mod engine;
mod hearing;
mod kept;
pub mod lease;
pub mod own;
pub mod running;
pub mod serve;
pub mod settings;
pub mod sync;
