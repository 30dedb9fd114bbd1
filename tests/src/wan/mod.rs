//! What `blaze-wan` does to packets, and the words with which it is told.
//!
//! ```text
//! TUN in A ─► cut? too large? ─► queue (bytes, tail drop) ─► rate ─► loss ─► delay ± jitter ─► TUN in B
//!             └────────────────────────── direction.rs, once for each way ──────────────────┘
//! ```
//!
//! Nothing here does I/O or looks at a clock; the binary does.

mod command;
mod direction;
mod shape;
mod stats;
mod wander;

pub use command::{Command, Ways};
pub use direction::{Direction, MAX_HELD_BYTES};
pub use shape::{Change, Shape};
pub use stats::{DirectionStats, Dropped, LinkStats, Tally};
