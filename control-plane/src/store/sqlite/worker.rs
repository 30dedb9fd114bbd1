//! A thread that owns a connection and does one job after another.
//!
//! ```text
//! async callers ──[64 jobs]──▶ thread (connection) ──▶ answer of each job
//! ```
//!
//! SQLite blocks, so it never runs on a thread of the asynchronous runtime. The thread ends, and
//! closes the file, when the worker is closed or dropped, or when the supervisor ends its tasks.

use blaze_runtime::supervisor::{StopOnDrop, Supervisor, TaskHandle, TaskPolicy};
use rusqlite::Connection;
use tokio::sync::{mpsc, oneshot};

use super::lock::FileLock;
use crate::store::StoreError;

/// Jobs that wait; who comes later waits for a place.
const QUEUE: usize = 64;

type Job = Box<dyn FnOnce(&mut Connection) + Send>;

enum Message {
    Run(Job),
    Stop,
}

/// The caller's end of the thread.
pub(super) struct Worker {
    jobs: mpsc::Sender<Message>,
    thread: TaskHandle,
    /// Tells the thread of the shutdown.
    _watcher: StopOnDrop,
}

impl Worker {
    /// Starts the thread. It keeps the lock until the file is closed.
    ///
    /// # Errors
    /// [`StoreError::Unavailable`] if the system gives no thread.
    pub(super) fn start(
        name: &str,
        connection: Connection,
        lock: Option<FileLock>,
        supervisor: &Supervisor,
    ) -> Result<Self, StoreError> {
        let (jobs, queue) = mpsc::channel(QUEUE);
        let thread = supervisor
            .spawn_thread(name, TaskPolicy::MayEnd, move || work(connection, queue, lock))
            .map_err(|error| StoreError::Unavailable(format!("no thread for {name}: {error}")))?;
        let (over, weak) = (supervisor.shutdown_token(), jobs.downgrade());
        let watcher = supervisor.spawn(format!("{name}-end"), TaskPolicy::MayEnd, async move {
            over.cancelled().await;
            if let Some(jobs) = weak.upgrade() {
                // Nobody listens any more: then it has ended already.
                let _ = jobs.send(Message::Stop).await;
            }
        });
        Ok(Self { jobs, thread, _watcher: watcher.stop_on_drop() })
    }

    /// Does a job on the thread. Once it has been taken it is done, whether its answer is waited
    /// for or not.
    ///
    /// # Errors
    /// [`StoreError::Unavailable`] after the end of the thread.
    pub(super) async fn run<T, F>(&self, job: F) -> Result<T, StoreError>
    where
        T: Send + 'static,
        F: FnOnce(&mut Connection) -> T + Send + 'static,
    {
        let (answer, answered) = oneshot::channel();
        let job: Job = Box::new(move |connection| {
            // The caller may have gone; the job counts all the same.
            let _ = answer.send(job(connection));
        });
        let closed = || StoreError::Unavailable("the store is closed".to_owned());
        self.jobs.send(Message::Run(job)).await.map_err(|_| closed())?;
        answered.await.map_err(|_| closed())
    }

    /// Ends the thread after the jobs that it has, and waits until the file is closed.
    pub(super) async fn close(&self) {
        // It has ended already if nobody takes the message.
        let _ = self.jobs.send(Message::Stop).await;
        self.thread.finished().await;
    }
}

fn work(mut connection: Connection, mut queue: mpsc::Receiver<Message>, lock: Option<FileLock>) {
    while let Some(Message::Run(job)) = queue.blocking_recv() {
        job(&mut connection);
    }
    if let Err((_, error)) = connection.close() {
        tracing::warn!(
            %error,
            "the database file was not closed in order; it recovers at the next start",
        );
    }
    drop(lock);
}
