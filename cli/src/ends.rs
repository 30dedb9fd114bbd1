//! What ends a command that runs on: a signal, or a part of it that failed.

use blaze_runtime::Supervisor;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::Mutex;

use crate::exit::CliError;

/// Listens to signals from its making on, so that an end while parts start is orderly, too.
pub(crate) struct Ends {
    signals: Mutex<[tokio::signal::unix::Signal; 2]>,
    supervisor: Supervisor,
}

impl Ends {
    /// # Errors
    /// [`CliError::Failed`] when the system gives no signal handlers.
    pub(crate) fn new(supervisor: Supervisor) -> Result<Self, CliError> {
        let listen = |kind| signal(kind).map_err(|error| CliError::Failed(format!("no signal handlers: {error}")));
        Ok(Self {
            signals: Mutex::new([listen(SignalKind::interrupt())?, listen(SignalKind::terminate())?]),
            supervisor,
        })
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
        let mut signals = self.signals.lock().await;
        let [interrupt, terminate] = &mut *signals;
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
    }
}
