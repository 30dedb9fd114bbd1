//! `blaze demo`: robot, fog and cloud in one process, with recorded data.
//!
//! ```text
//! recording ─► player ─► publishers on robot-1 ─► flows ─► consumers ─► board ─► report, verdict
//!                                                   ├─► admin ports ─► routes and drops ─► board
//! changes ─► REST ─► main service ─► workers ─► brokers ─┴─► analytics, flow of robot-1
//! ```

pub mod analytics;
pub mod board;
mod brokers;
pub mod camera;
pub mod changes;
pub mod compose;
mod configuration;
pub mod domain_id;
pub mod flows;
mod nodes;
pub mod options;
pub mod player;
pub mod recording;
pub mod report;
pub mod roles;
pub mod schedule;
pub mod session;
pub mod stage;
pub mod stats;
mod system;
pub mod verdict;

pub use compose::run;
