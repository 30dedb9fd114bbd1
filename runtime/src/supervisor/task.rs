//! One supervised task: its policy, its handle, and what happens when it ends.

use std::any::Any;
use std::fmt::Display;
use std::future::Future;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::task::Poll;
use std::time::{Duration, Instant};

use tokio::task::AbortHandle;
use tokio_util::sync::CancellationToken;

use super::Supervisor;

/// What the end of a task means before the shutdown. A panic is a failure whatever the policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TaskPolicy {
    /// The process needs it: its end is a failure.
    Essential,
    /// It ends when its work is done; an error is logged.
    MayEnd,
}

/// What a task ends with.
pub trait TaskEnd {
    /// Why it failed, if it did.
    fn failure(self) -> Option<String>;
}

impl TaskEnd for () {
    fn failure(self) -> Option<String> {
        None
    }
}

impl<E: Display> TaskEnd for Result<(), E> {
    fn failure(self) -> Option<String> {
        self.err().map(|error| error.to_string())
    }
}

/// A task or thread that runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TaskInfo {
    /// Its name, with those of child supervisors before it.
    pub name: String,
    /// Its policy.
    pub policy: TaskPolicy,
    /// Whether it is a thread.
    pub thread: bool,
    /// How long it has run.
    pub age: Duration,
}

pub(super) struct Entry {
    pub(super) name: Arc<str>,
    pub(super) policy: TaskPolicy,
    pub(super) thread: bool,
    pub(super) since: Instant,
    /// Its owner has stopped it: its end is no failure.
    pub(super) stopped: bool,
    pub(super) abort: Option<AbortHandle>,
}

impl Entry {
    pub(super) fn info(&self) -> TaskInfo {
        TaskInfo {
            name: self.name.to_string(),
            policy: self.policy,
            thread: self.thread,
            age: self.since.elapsed(),
        }
    }
}

/// Handle of a task. Dropping it leaves the task running under its supervisor.
#[derive(Clone)]
pub struct TaskHandle {
    supervisor: Supervisor,
    id: u64,
    abort: Option<AbortHandle>,
    finished: CancellationToken,
}

impl TaskHandle {
    pub(super) fn new(
        supervisor: &Supervisor,
        id: u64,
        abort: Option<AbortHandle>,
        finished: CancellationToken,
    ) -> Self {
        Self { supervisor: supervisor.clone(), id, abort, finished }
    }

    /// Ends the task at its next await, without that being a failure. A thread is only allowed to
    /// end.
    pub fn stop(&self) {
        if let Some(entry) = self.supervisor.shared.tasks.lock().get_mut(&self.id) {
            entry.stopped = true;
        }
        if let Some(abort) = &self.abort {
            abort.abort();
        }
    }

    /// Waits until the task has ended and everything that it held is dropped.
    pub async fn finished(&self) {
        self.finished.cancelled().await;
    }

    /// Whether the task has ended.
    #[must_use]
    pub fn is_finished(&self) -> bool {
        self.finished.is_cancelled()
    }

    /// Ties the task to a value: dropped, it [stops](Self::stop) the task.
    #[must_use]
    pub fn stop_on_drop(self) -> StopOnDrop {
        StopOnDrop(self)
    }
}

impl std::fmt::Debug for TaskHandle {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TaskHandle")
            .field("id", &self.id)
            .field("finished", &self.is_finished())
            .finish()
    }
}

/// Stops its task when it is dropped.
#[derive(Debug)]
pub struct StopOnDrop(TaskHandle);

impl std::ops::Deref for StopOnDrop {
    type Target = TaskHandle;
    fn deref(&self) -> &TaskHandle {
        &self.0
    }
}

impl Drop for StopOnDrop {
    fn drop(&mut self) {
        self.0.stop();
    }
}

/// How a task ended.
enum End {
    /// It was aborted, or the runtime went away.
    Dropped,
    Returned(Option<String>),
    Panicked(String),
}

/// Strikes the task off when it ends, however it ends.
pub(super) struct Observer {
    pub(super) supervisor: Supervisor,
    pub(super) id: u64,
    pub(super) name: Arc<str>,
    pub(super) finished: CancellationToken,
}

impl Observer {
    fn ended(&self, end: End) {
        let shared = &self.supervisor.shared;
        let entry = shared.tasks.lock().remove(&self.id);
        let Some(entry) = entry else { return };
        let expected = entry.stopped || shared.stopping.is_cancelled();
        let name = &self.name;
        match end {
            End::Panicked(message) => self.supervisor.fail(format!("{name} panicked: {message}")),
            End::Returned(Some(reason)) if entry.policy == TaskPolicy::Essential && !expected => {
                self.supervisor.fail(format!("{name} failed: {reason}"));
            }
            End::Returned(None) if entry.policy == TaskPolicy::Essential && !expected => {
                self.supervisor.fail(format!("{name} ended unexpectedly"));
            }
            End::Returned(Some(reason)) => tracing::warn!(task = %name, reason, "task failed"),
            End::Returned(None) | End::Dropped => {}
        }
        shared.running.send_modify(|running| *running -= 1);
        self.finished.cancel();
    }
}

impl Drop for Observer {
    fn drop(&mut self) {
        // Without effect if the end was told before.
        self.ended(End::Dropped);
    }
}

/// Runs a future and tells its supervisor how it ended.
pub(super) async fn observe<F>(observer: Observer, future: F)
where
    F: Future,
    F::Output: TaskEnd,
{
    // Declared after the observer, so dropped before it: `finished` means that nothing of the task
    // is left.
    let mut future = Some(Box::pin(future));
    let end = std::future::poll_fn(|context| {
        let Some(running) = future.as_mut() else {
            return Poll::Pending;
        };
        match catch_unwind(AssertUnwindSafe(|| running.as_mut().poll(context))) {
            Ok(Poll::Pending) => Poll::Pending,
            Ok(Poll::Ready(output)) => Poll::Ready(End::Returned(output.failure())),
            Err(panic) => Poll::Ready(End::Panicked(message_of(&*panic))),
        }
    })
    .await;
    drop(future.take());
    observer.ended(end);
}

/// Runs a function and tells its supervisor how it ended.
pub(super) fn observe_thread<O: TaskEnd>(observer: Observer, run: impl FnOnce() -> O) {
    // The observer moves in here, so that it outlives what the function held.
    let observer = observer;
    let end = match catch_unwind(AssertUnwindSafe(run)) {
        Ok(output) => End::Returned(output.failure()),
        Err(panic) => End::Panicked(message_of(&*panic)),
    };
    observer.ended(end);
}

fn message_of(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
    text.unwrap_or_else(|| "without a message".to_owned())
}
