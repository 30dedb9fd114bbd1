//! How much may leave: rates per lane, and the budget of the wire. See `docs/design/bandwidth.md`.
//!
//! ```text
//! budgets, sizes, rates ─► allocate ─► rates ─► gate: whole messages, per lane ─► queues ─► pacer: wire bytes
//! ```
//!
//! The allocation decides what is worth sending, in whole messages; the pacer keeps the limit,
//! whatever was decided.

pub mod allocate;
pub mod bucket;
pub mod capacity;
pub mod gate;
pub mod limiter;
pub mod pacer;
pub mod rates;
pub mod size;
pub mod wire_factor;
