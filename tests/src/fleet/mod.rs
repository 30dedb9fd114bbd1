//! Many workers of BlazeConfig beside one real main service: in this process, each with a broker,
//! copies and, if wanted, a service of its own, or as processes.
//!
//! ```text
//! Api ──REST──▶ MainService (process) ──gRPC──▶ Worker, Worker, … (this process) ──broker──▶ Listener (SDK)
//!                                          └──▶ WorkerProcess, …
//! ```

mod api;
mod listener;
mod main_service;
mod process;
mod restart;
mod worker;

pub use api::{Api, Told, Written};
pub use listener::{Heard, Listener};
pub use main_service::{MainService, MainStore};
pub use process::WorkerProcess;
pub use restart::{Restarted, restart, wait_equal};
pub use worker::{Standing, Worker, WorkerSpec};
