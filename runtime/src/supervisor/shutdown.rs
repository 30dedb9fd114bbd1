//! The orderly end: not ready → stop accepting → end streams → drain → abort at the deadline.

use std::future::Future;
use std::pin::Pin;
use std::time::Duration;

use tokio::time::Instant;

use super::Supervisor;

/// After the abort, tasks get this long to drop what they hold.
const AFTER_ABORT: Duration = Duration::from_millis(500);

/// The order of the steps of a shutdown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ShutdownPhase {
    /// Tell the world: readiness.
    NotReady,
    /// Take in nothing new.
    StopAccepting,
    /// End what would go on for ever.
    EndStreams,
    /// Empty the queues.
    Drain,
}

type Step = Pin<Box<dyn Future<Output = ()> + Send>>;

/// What is to be done at the shutdown, and until when.
pub struct ShutdownSteps {
    deadline: Duration,
    steps: Vec<(ShutdownPhase, String, Step)>,
}

impl ShutdownSteps {
    /// No steps; everything is over after `deadline`.
    #[must_use]
    pub fn new(deadline: Duration) -> Self {
        Self { deadline, steps: Vec::new() }
    }

    /// One more step. Steps of one phase run in the order in which they were added.
    #[must_use]
    pub fn on(
        mut self,
        phase: ShutdownPhase,
        name: impl Into<String>,
        step: impl Future<Output = ()> + Send + 'static,
    ) -> Self {
        self.steps.push((phase, name.into(), Box::pin(step)));
        self
    }
}

/// What a shutdown left behind.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ShutdownReport {
    /// Steps that the deadline cut off.
    pub unfinished_steps: Vec<String>,
    /// Tasks that were aborted at the deadline.
    pub aborted: Vec<String>,
    /// Threads, and tasks that block a thread, that still run.
    pub left: Vec<String>,
}

impl ShutdownReport {
    /// Whether everything ended by itself.
    #[must_use]
    pub fn is_clean(&self) -> bool {
        *self == Self::default()
    }
}

impl Supervisor {
    /// Ends all tasks of this supervisor and its children; at the deadline those that are left are
    /// aborted.
    pub async fn shutdown(&self, deadline: Duration) -> ShutdownReport {
        self.shutdown_with(ShutdownSteps::new(deadline)).await
    }

    /// The same with steps before: the tasks run on while they are taken.
    pub async fn shutdown_with(&self, steps: ShutdownSteps) -> ShutdownReport {
        let deadline = Instant::now() + steps.deadline;
        let mut report = ShutdownReport::default();
        self.shared.stopping.cancel();
        let mut steps = steps.steps;
        steps.sort_by_key(|(phase, ..)| *phase);
        for (_, name, step) in steps {
            if tokio::time::timeout_at(deadline, step).await.is_err() {
                report.unfinished_steps.push(name);
            }
        }
        self.shared.shutdown.cancel();
        if tokio::time::timeout_at(deadline, self.all_ended()).await.is_err() {
            report.aborted = self.abort_all();
            if tokio::time::timeout(AFTER_ABORT, self.all_ended()).await.is_err() {
                report.left = self.running().into_iter().map(|task| task.name).collect();
                report.aborted.retain(|name| !report.left.contains(name));
            }
        }
        report
    }

    /// Waits until no task and no thread runs, here and in children.
    async fn all_ended(&self) {
        // Children that are made while this waits belong to tasks that are waited for.
        loop {
            for child in self.children() {
                Box::pin(child.all_ended()).await;
            }
            let mut running = self.shared.running.subscribe();
            if running.wait_for(|running| *running == 0).await.is_err() {
                return;
            }
            if self.running().is_empty() {
                return;
            }
        }
    }

    fn abort_all(&self) -> Vec<String> {
        let mut names = Vec::new();
        for entry in self.shared.tasks.lock().values() {
            if let Some(abort) = &entry.abort {
                abort.abort();
                names.push(entry.name.to_string());
            }
        }
        for child in self.children() {
            names.extend(
                child.abort_all().into_iter().map(|name| format!("{}/{name}", child.name())),
            );
        }
        names
    }
}
