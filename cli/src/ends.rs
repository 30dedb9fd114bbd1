//! What ends a command that runs on: a signal, or a part of it that failed.

use blaze_runtime::{Signals, Supervisor};
use tokio::sync::Mutex;

use crate::exit::CliError;

fn signals() -> Result<Signals, CliError> {
    Signals::new().map_err(|error| CliError::Failed(format!("no signal handlers: {error}")))
}

/// Waits for Ctrl-C or SIGTERM.
///
/// # Errors
/// [`CliError::Failed`] when the system gives no signal handlers.
pub(crate) async fn interrupted() -> Result<(), CliError> {
    signals()?.recv().await;
    Ok(())
}

/// Listens to signals from its making on, so that an end while parts start is orderly, too.
pub(crate) struct Ends {
    signals: Mutex<Signals>,
    supervisor: Supervisor,
}

impl Ends {
    /// # Errors
    /// [`CliError::Failed`] when the system gives no signal handlers.
    pub(crate) fn new(supervisor: Supervisor) -> Result<Self, CliError> {
        Ok(Self { signals: Mutex::new(signals()?), supervisor })
    }

    /// Waits for the end; a sentence if it was no signal.
    pub(crate) async fn wait(&self) -> Option<String> {
        tokio::select! {
            () = self.signal() => None,
            reason = self.supervisor.failed() => Some(reason),
        }
    }

    /// Waits for a signal.
    pub(crate) async fn signal(&self) {
        self.signals.lock().await.recv().await;
    }
}
