//! What every process of BlazeAIoT needs and no domain logic: configuration, supervised tasks, an
//! orderly shutdown, logs, the admin port, small state on disk.
//!
//! ```text
//! main: config ▶ logs ▶ Supervisor ▶ AdminServer ▶ (the program's parts) ▶ ready_line ▶ Supervisor::run ▶ exit code
//! ```

pub mod admin;
pub mod config;
mod core_dumps;
pub mod environment;
#[cfg(feature = "http")]
pub mod http;
pub mod logs;
#[cfg(feature = "main-service")]
pub mod main_service;
mod password;
mod ready;
pub mod state;
pub mod supervisor;
mod ticks;

pub use admin::{AdminServer, CheckStatus, Gate, Readiness};
pub use core_dumps::forbid_core_dumps;
pub use password::read_password;
pub use ready::ready_line;
pub use supervisor::{
    ShutdownPhase, ShutdownReport, ShutdownSteps, Signals, StopOnDrop, Supervisor, TaskEnd,
    TaskHandle, TaskInfo, TaskPolicy, block_on, exit_code, say,
};
pub use ticks::{BEAT, on_beat, pause, ticks};
