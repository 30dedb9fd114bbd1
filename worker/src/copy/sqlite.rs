//! The copy in a SQLite file.
//!
//! ```text
//! replace, advance ─[one job at a time]─▶ thread (connection) ─▶ BEGIN IMMEDIATE; documents; head; COMMIT
//! ```
//!
//! One transaction writes the documents of the new revision, moves the one head record to it and removes the old ones: at
//! `COMMIT`, with `synchronous=FULL`, all of it is on the disk or nothing is. A crash before leaves the old revision, a
//! crash after leaves the new one; the write-ahead log is read again at the next start.

use std::path::PathBuf;
use std::sync::Arc;

use async_trait::async_trait;
use blaze_domain::LayerName;
use blaze_domain::config::{Document, Key};
use blaze_runtime::supervisor::{StopOnDrop, Supervisor, TaskPolicy};
use tokio::sync::{mpsc, oneshot};

use super::sqlite_database::{Database, Facts};
use super::{CopyError, Loaded, LocalCopy, Notes, Position, Vault, json};

/// Its name, in the worker's folder for state.
pub const DATABASE_NAME: &str = "copy.db";
/// Jobs that wait. The one who writes and the one who reads wait for their answers, so there are few.
const QUEUE: usize = 4;

type Job = Box<dyn FnOnce(&mut Database) + Send>;

/// The copy in a SQLite file, on a thread of its own. Two processes must not have the same file.
pub struct SqliteCopy {
    jobs: mpsc::Sender<Option<Job>>,
    place: String,
    /// Tells the thread of the shutdown.
    _watcher: StopOnDrop,
}

impl SqliteCopy {
    /// In this file, whose folder must exist. It is opened, and made if it is not there, at the first use.
    ///
    /// # Errors
    /// [`CopyError::Away`] if the system gives no thread.
    pub fn new(path: PathBuf, layer: LayerName, vault: Vault, supervisor: &Supervisor) -> Result<Self, CopyError> {
        let place = format!("SQLite {}", path.display());
        let mut database = Database::new(Facts {
            path,
            place: place.clone(),
            layer,
            vault,
        });
        let (jobs, mut queue) = mpsc::channel::<Option<Job>>(QUEUE);
        let work = move || {
            while let Some(Some(job)) = queue.blocking_recv() {
                job(&mut database);
            }
        };
        supervisor
            .spawn_thread("copy-sqlite", TaskPolicy::MayEnd, work)
            .map_err(|error| away(&place, &error))?;
        let (over, weak) = (supervisor.shutdown_token(), jobs.downgrade());
        let watcher = supervisor.spawn("copy-sqlite-end", TaskPolicy::MayEnd, async move {
            over.cancelled().await;
            if let Some(jobs) = weak.upgrade() {
                // It has ended already if nobody takes the message.
                let _ = jobs.send(None).await;
            }
        });
        Ok(Self {
            jobs,
            place,
            _watcher: watcher.stop_on_drop(),
        })
    }

    async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Database) -> Result<T, CopyError> + Send + 'static,
    ) -> Result<T, CopyError> {
        let (answer, answered) = oneshot::channel();
        let job: Job = Box::new(move |database| {
            // The caller may have gone; the job counts all the same.
            let _ = answer.send(work(database));
        });
        let closed = || away(&self.place, &"it is closed");
        self.jobs.send(Some(job)).await.map_err(|_| closed())?;
        answered.await.map_err(|_| closed())?
    }
}

#[async_trait]
impl LocalCopy for SqliteCopy {
    async fn load(&self) -> Result<Option<Loaded>, CopyError> {
        self.run(Database::load).await
    }

    async fn replace(&self, whole: &Loaded) -> Result<(), CopyError> {
        let whole = whole.clone();
        self.run(move |database| database.replace(&whole)).await
    }

    async fn advance(
        &self,
        position: &Position,
        puts: &[Arc<Document>],
        removes: &[Key],
        notes: Option<&Notes>,
    ) -> Result<(), CopyError> {
        let (position, puts, removes) = (position.clone(), puts.to_vec(), removes.to_vec());
        let notes = notes.map(|notes| json::notes_to_json(notes).to_string());
        self.run(move |database| database.advance(&position, &puts, &removes, notes.as_deref()))
            .await
    }

    fn describe(&self) -> String {
        self.place.clone()
    }
}

pub(super) fn away(place: &str, detail: &dyn std::fmt::Display) -> CopyError {
    CopyError::Away {
        place: place.to_owned(),
        detail: detail.to_string(),
    }
}

#[cfg(test)]
#[path = "sqlite_tests.rs"]
mod tests;
