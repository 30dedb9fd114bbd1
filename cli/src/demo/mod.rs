//! `blaze demo`: robot, fog and cloud in one process, with recorded data.
//!
//! ```text
//! recording ─► player ─► publishers on robot-1 ─► flows ─► consumers ─► board ─► report, verdict
//!                                                   └─► admin ports ─► routes and drops ─► board
//! ```

pub mod board;
mod brokers;
pub mod camera;
pub mod compose;
pub mod domain_id;
pub mod flows;
pub mod options;
pub mod player;
pub mod recording;
pub mod report;
pub mod roles;
pub mod schedule;
pub mod session;
pub mod stats;
pub mod verdict;

pub use compose::run;
