//! What the worker knows and what follows from it. No I/O and no clock: everything comes in as an
//! argument.
//!
//! ```text
//! Incoming ──▶ LayerView ──Change──▶ Served ──Flushed──▶ notices, keys of Redis          [messages] writes them
//!              (the documents)         │ ▲
//!                                      ▼ └── GetRequest                                  [messages] reads it
//!                                    Reply
//! acks, watchdogs ──▶ Signs ──Complaint──▶ Gate ──Failure──▶ Served undoes the roll-out
//! ```
//!
//! [`LayerView`] checks what the main service tells and has the documents; [`Served`] knows who is
//! served with what, and works out from a change who must be told. [`Signs`] knows how the services
//! are, and [`Gate`] judges roll-outs by it.

mod answer;
mod asked;
mod change;
mod gate;
mod health;
mod incoming;
mod layer_view;
pub mod messages;
mod notice;
mod reach;
mod served;
mod served_target;
#[cfg(test)]
pub(crate) mod testing;
mod told;
mod world;

pub use answer::{Freshness, Reply, answer};
pub use asked::{ASKED_FOR, MAX_ASKED};
pub use change::Change;
pub use gate::{Failure, Gate, MAX_WINDOWS, RolloutPhase, RolloutState};
pub use health::{Complaint, MAX_SIGNS, Row, Signs, Trouble};
pub use incoming::{Edit, Incoming, MAX_SNAPSHOT_BYTES, OLDEST_PROTOCOL, PROTOCOL, SyncFault};
pub use layer_view::{Applied, LayerView, ResumePoint};
pub use notice::{Config, Notice, Scope, Standing};
pub use served::{MAX_FAILED, Served, Trial};
pub use served_target::{ServedTarget, Site, Source};
pub use told::{Flushed, Told};
