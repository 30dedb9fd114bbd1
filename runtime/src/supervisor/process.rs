//! A supervisor as the whole process: signals, exit codes.

use std::future::Future;
use std::io::Write;
use std::process::ExitCode;
use std::time::Duration;

use tokio::signal::unix::{Signal, SignalKind, signal};

use super::{ShutdownSteps, Supervisor};

/// Exit codes of all servers.
pub mod exit_code {
    /// A task failed.
    pub const FAILED: u8 = 1;
    /// A wrong option.
    pub const USAGE: u8 = 2;
    /// A faulty configuration.
    pub const CONFIGURATION: u8 = 64;
}

/// Threads of the runtime that block get this long at the end of the process.
const AFTER_MAIN: Duration = Duration::from_millis(500);

/// Runs the main future of the process `name` on a runtime of its own; what then still blocks a
/// thread does not hold it up. A system that gives no threads is told on stderr.
pub fn block_on(name: &str, main: impl Future<Output = ExitCode>) -> ExitCode {
    crate::ticks::begin();
    match tokio::runtime::Builder::new_multi_thread().enable_all().build() {
        Ok(runtime) => {
            let code = runtime.block_on(main);
            runtime.shutdown_timeout(AFTER_MAIN);
            code
        }
        Err(error) => failed(name, error),
    }
}

/// Says why the process `name` ends, and with which code.
pub fn failed(name: &str, error: impl std::fmt::Display) -> ExitCode {
    say(format_args!("{name} failed: {error}"));
    ExitCode::from(exit_code::FAILED)
}

impl Supervisor {
    /// Waits for SIGTERM, SIGINT or a failure, then shuts down. A second signal exits at once.
    ///
    /// The code is 0 after a signal and 1 after a failure, which is told in one line on stderr.
    pub async fn run(self, steps: ShutdownSteps) -> ExitCode {
        let mut signals = match Signals::new() {
            Ok(signals) => signals,
            Err(error) => {
                return failed(self.name(), format_args!("no signal handlers: {error}"));
            }
        };
        let failure = tokio::select! {
            name = signals.recv() => {
                tracing::info!(signal = name.0, "shutting down");
                None
            }
            reason = self.failed() => Some(reason),
        };
        if let Some(reason) = &failure {
            failed(self.name(), reason);
        }
        let report = tokio::select! {
            report = self.shutdown_with(steps) => report,
            (name, number) = signals.recv() => {
                say(format_args!("{}: {name} during the shutdown, exiting at once", self.name()));
                std::process::exit(if failure
                    .is_some() { i32::from(exit_code::FAILED) } else { 128 + number });
            }
        };
        if !report.is_clean() {
            tracing::warn!(
                ?report.unfinished_steps,
                ?report.aborted,
                ?report.left,
                "the shutdown reached its deadline",
            );
        }
        // A panic while draining is a failure too, though nothing waited for it.
        match (failure, self.failure()) {
            (None, None) => ExitCode::SUCCESS,
            (Some(_), _) => ExitCode::from(exit_code::FAILED),
            (None, Some(reason)) => failed(self.name(), reason),
        }
    }
}

/// SIGTERM and SIGINT, from its making on.
pub struct Signals {
    terminate: Signal,
    interrupt: Signal,
}

impl Signals {
    /// Begins to listen; from then on they do not end the process by themselves.
    ///
    /// # Errors
    /// If the system gives no handlers.
    pub fn new() -> std::io::Result<Self> {
        Ok(Self {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
        })
    }

    /// Name and number of the next signal.
    pub async fn recv(&mut self) -> (&'static str, i32) {
        tokio::select! {
            Some(()) = self.terminate.recv() => ("SIGTERM", SignalKind::terminate().as_raw_value()),
            Some(()) = self.interrupt.recv() => ("SIGINT", SignalKind::interrupt().as_raw_value()),
            else => std::future::pending().await,
        }
    }
}

/// One line on stderr; a closed stderr is no reason to fail.
pub fn say(line: std::fmt::Arguments<'_>) {
    let _ = writeln!(std::io::stderr().lock(), "{line}");
}
