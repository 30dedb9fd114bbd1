//! Supervised tasks and threads, and an orderly end of the process.
//!
//! ```text
//! spawn ──▶ task ends ──┬─ as its policy allows ──▶ forgotten
//!                       └─ otherwise ──▶ fail(reason) ─┐
//! SIGTERM, SIGINT ─────────────────────────────────────┴─▶ shutdown: steps by phase ▶ token ▶ wait ▶ abort at deadline
//! ```
//!
//! Nothing else in the workspace spawns: an unobserved end of a task is an unnoticed failure.

mod process;
mod shutdown;
mod task;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::future::Future;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use std::time::Instant;

use parking_lot::Mutex;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

pub use process::{Signals, block_on, exit_code, failed, say};
pub use shutdown::{ShutdownPhase, ShutdownReport, ShutdownSteps};
pub use task::{StopOnDrop, TaskEnd, TaskHandle, TaskInfo, TaskPolicy};

/// Owner of tasks and threads. Clones share them.
#[derive(Clone)]
pub struct Supervisor {
    shared: Arc<Shared>,
}

struct Shared {
    name: String,
    runtime: tokio::runtime::Handle,
    /// Cancelled when the shutdown begins: from then on a task may end.
    stopping: CancellationToken,
    /// Cancelled when the tasks shall end.
    shutdown: CancellationToken,
    failure: watch::Sender<Option<String>>,
    tasks: Mutex<BTreeMap<u64, task::Entry>>,
    /// How many tasks and threads run here, without those of children.
    running: watch::Sender<usize>,
    next_id: AtomicU64,
    parent: Option<Supervisor>,
    children: Mutex<Vec<Weak<Shared>>>,
}

impl Supervisor {
    /// A supervisor on the runtime that this is called in.
    ///
    /// # Panics
    /// Outside a Tokio runtime; there use [`Supervisor::on`].
    #[must_use]
    pub fn new(name: impl Into<String>) -> Self {
        Self::on(tokio::runtime::Handle::current(), name)
    }

    /// A supervisor on a runtime.
    #[must_use]
    pub fn on(runtime: tokio::runtime::Handle, name: impl Into<String>) -> Self {
        Self::build(runtime, name.into(), None)
    }

    fn build(runtime: tokio::runtime::Handle, name: String, parent: Option<Self>) -> Self {
        let token = |parent: Option<&CancellationToken>| {
            parent.map_or_else(CancellationToken::new, CancellationToken::child_token)
        };
        let above = parent.as_ref().map(|parent| &parent.shared);
        Self {
            shared: Arc::new(Shared {
                name,
                runtime,
                stopping: token(above.map(|shared| &shared.stopping)),
                shutdown: token(above.map(|shared| &shared.shutdown)),
                failure: watch::Sender::new(None),
                tasks: Mutex::new(BTreeMap::new()),
                running: watch::Sender::new(0),
                next_id: AtomicU64::new(0),
                parent,
                children: Mutex::new(Vec::new()),
            }),
        }
    }

    /// A part of this one that can be shut down alone. Its failure is a failure of the whole; the
    /// whole's shutdown is also its own. For a part that may fail alone make an independent
    /// supervisor.
    #[must_use]
    pub fn child(&self, name: impl Into<String>) -> Self {
        let child = Self::build(self.shared.runtime.clone(), name.into(), Some(self.clone()));
        let mut children = self.shared.children.lock();
        children.retain(|child| child.strong_count() > 0);
        children.push(Arc::downgrade(&child.shared));
        child
    }

    /// The name, for logs.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.shared.name
    }

    /// Runs a future as a task of this supervisor.
    #[allow(
        clippy::disallowed_methods,
        reason = "the one place that spawns: the wrapper observes every end"
    )]
    pub fn spawn<F>(&self, name: impl Into<String>, policy: TaskPolicy, future: F) -> TaskHandle
    where
        F: Future + Send + 'static,
        F::Output: TaskEnd,
    {
        let (observer, finished) = self.register(name.into(), policy, false);
        let id = observer.id;
        // The entry is made first: the task may end before `spawn` returns.
        let join = self.shared.runtime.spawn(task::observe(observer, future));
        let abort = join.abort_handle();
        if let Some(entry) = self.shared.tasks.lock().get_mut(&id) {
            entry.abort = Some(abort.clone());
        }
        TaskHandle::new(self, id, Some(abort), finished)
    }

    /// Runs a function on a thread of its own. It cannot be aborted, so it must look at
    /// [`Supervisor::shutdown_token`] or end by itself.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn spawn_thread<F, O>(
        &self,
        name: impl Into<String>,
        policy: TaskPolicy,
        run: F,
    ) -> std::io::Result<TaskHandle>
    where
        F: FnOnce() -> O + Send + 'static,
        O: TaskEnd,
    {
        let name = name.into();
        let (observer, finished) = self.register(name.clone(), policy, true);
        let id = observer.id;
        // A thread that could not start drops the observer, which strikes the entry off.
        std::thread::Builder::new()
            .name(name)
            .spawn(move || task::observe_thread(observer, run))?;
        Ok(TaskHandle::new(self, id, None, finished))
    }

    fn register(
        &self,
        name: String,
        policy: TaskPolicy,
        thread: bool,
    ) -> (task::Observer, CancellationToken) {
        let shared = &self.shared;
        let id = shared.next_id.fetch_add(1, Ordering::Relaxed);
        let finished = CancellationToken::new();
        let entry = task::Entry {
            name: Arc::from(name),
            policy,
            thread,
            since: Instant::now(),
            stopped: false,
            abort: None,
        };
        let name = Arc::clone(&entry.name);
        shared.tasks.lock().insert(id, entry);
        shared.running.send_modify(|running| *running += 1);
        let observer =
            task::Observer { supervisor: self.clone(), id, name, finished: finished.clone() };
        (observer, finished)
    }

    /// Cancelled when all tasks shall end by themselves: after the steps of the shutdown, before
    /// the deadline.
    #[must_use]
    pub fn shutdown_token(&self) -> CancellationToken {
        self.shared.shutdown.clone()
    }

    /// Cancelled when the shutdown begins, before its first step.
    #[must_use]
    pub fn stopping_token(&self) -> CancellationToken {
        self.shared.stopping.clone()
    }

    /// Ends the process (or the embedder's part) for a reason. The first reason stays.
    pub fn fail(&self, reason: impl Into<String>) {
        let reason = reason.into();
        let first = self.shared.failure.send_if_modified(|failure| {
            let first = failure.is_none();
            if first {
                *failure = Some(reason.clone());
            }
            first
        });
        if first && let Some(parent) = &self.shared.parent {
            parent.fail(format!("{}: {reason}", self.shared.name));
        }
    }

    /// The reason of the failure, if there was one.
    #[must_use]
    pub fn failure(&self) -> Option<String> {
        self.shared.failure.borrow().clone()
    }

    /// Waits for a failure and gives its reason.
    pub async fn failed(&self) -> String {
        let mut failure = self.shared.failure.subscribe();
        // The sender lives in `self`, so the wait cannot end without a value.
        let reason = failure.wait_for(Option::is_some).await.map(|reason| reason.clone());
        match reason {
            Ok(reason) => reason.unwrap_or_default(),
            Err(_) => std::future::pending().await,
        }
    }

    /// What runs now, with that of children, oldest first.
    #[must_use]
    pub fn running(&self) -> Vec<TaskInfo> {
        let mut out: Vec<TaskInfo> =
            self.shared.tasks.lock().values().map(task::Entry::info).collect();
        for child in self.children() {
            let name = child.name().to_owned();
            out.extend(child.running().into_iter().map(|mut info| {
                info.name = format!("{name}/{}", info.name);
                info
            }));
        }
        out
    }

    fn children(&self) -> Vec<Self> {
        let alive = |child: &Weak<Shared>| child.upgrade().map(|shared| Self { shared });
        self.shared.children.lock().iter().filter_map(alive).collect()
    }
}

impl std::fmt::Debug for Supervisor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let running: Vec<String> = self.running().into_iter().map(|task| task.name).collect();
        f.debug_struct("Supervisor")
            .field("name", &self.shared.name)
            .field("running", &running)
            .finish()
    }
}
