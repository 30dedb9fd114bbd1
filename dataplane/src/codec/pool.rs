//! Threads that compress and decompress.
//!
//! ```text
//! submit ─► [ decompress ] ─┐
//!           [ compress   ] ─┴─► threads (as many as processors) ─► the job itself says what came of it
//! ```
//!
//! What came from the inter scope goes first: it has crossed the link already, and is quickly done. Both kinds have
//! bounds of their own, so neither takes the other's room, and now and then a turn is the other's. No lock is held
//! while a job runs.

use std::collections::VecDeque;
use std::io;
use std::num::NonZeroUsize;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use parking_lot::{Condvar, Mutex};

#[cfg(test)]
mod tests;

/// Most threads of a pool, whatever the node file says.
pub const MAX_THREADS: usize = 64;
/// Bytes of jobs that wait at most, of each urgency (32 MiB, 64 MiB together); one job always fits. Besides these, each
/// thread has one job in hands.
pub const MAX_WAITING_BYTES: usize = 32 * 1024 * 1024;
/// Jobs that wait at most, of each urgency.
pub const MAX_WAITING_JOBS: usize = 4_096;
/// After so many jobs of the first kind in a row, one of the other has its turn.
const TURN_AFTER: u32 = 8;

/// Threads for `flow.pool_threads`: that number, or for 0 as many as there are processors for this process, which
/// counts the quota of its control group and its affinity mask. At least 1 and at most [`MAX_THREADS`].
#[must_use]
pub fn threads(configured: u16) -> usize {
    let count = match configured {
        0 => std::thread::available_parallelism().map_or(1, NonZeroUsize::get),
        count => count.into(),
    };
    count.clamp(1, MAX_THREADS)
}

/// Which jobs go first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Urgency {
    /// What came over the inter scope; before all others.
    Decompress,
    /// What is to leave over it.
    Compress,
}

/// Work for a thread of the pool.
pub struct Job {
    urgency: Urgency,
    bytes: usize,
    run: Box<dyn FnOnce() + Send>,
}

impl Job {
    /// `bytes`: what it holds, or will hold when it runs, whichever is more. A job that is never run, because the pool
    /// is full or stops, is dropped with what it has captured: a [`Completion`] then says so.
    #[must_use]
    pub fn new(urgency: Urgency, bytes: usize, run: impl FnOnce() + Send + 'static) -> Self {
        Self {
            urgency,
            bytes,
            run: Box::new(run),
        }
    }
}

impl std::fmt::Debug for Job {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Job")
            .field("urgency", &self.urgency)
            .field("bytes", &self.bytes)
            .finish_non_exhaustive()
    }
}

/// Tells somebody what became of a job: exactly once, with `None` if it was dropped before, also by a panic in the job.
///
/// It is told on the thread that runs the job or drops it, and that may be one that submits a job or stops the pool: so
/// the callback takes no lock that such a thread may hold, and does not panic.
pub struct Completion<R>(Option<Told<R>>);

type Told<R> = Box<dyn FnOnce(Option<R>) + Send>;

impl<R> Completion<R> {
    /// One that calls `told`.
    #[must_use]
    pub fn new(told: impl FnOnce(Option<R>) + Send + 'static) -> Self {
        Self(Some(Box::new(told)))
    }

    /// Tells the result.
    pub fn give(mut self, result: R) {
        if let Some(told) = self.0.take() {
            told(Some(result));
        }
    }
}

impl<R> Drop for Completion<R> {
    fn drop(&mut self) {
        if let Some(told) = self.0.take() {
            told(None);
        }
    }
}

/// Why a job was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// Too much waits; counted by the pool.
    #[error("the pool has too much to do")]
    Full,
    /// The pool stops or has stopped.
    #[error("the pool has stopped")]
    Stopped,
}

/// What starts threads: it runs the function on a new thread of that name.
pub type Spawner = Box<dyn FnMut(String, Box<dyn FnOnce() + Send>) -> io::Result<()> + Send>;

/// What a pool has done, and has to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PoolCounters {
    /// Jobs that have run to their end.
    pub done: u64,
    /// Jobs that were not taken, because too much waited.
    pub refused: u64,
    /// Jobs that panicked.
    pub panicked: u64,
    /// Jobs that waited when the pool was stopped.
    pub forgotten: u64,
    /// Time that all threads together have spent on jobs that have ended. What it grows by in a second, by `threads`,
    /// is the utilisation.
    pub busy: Duration,
    /// Threads there are; more than wanted until those too many have ended their jobs.
    pub threads: usize,
    /// Jobs that wait.
    pub waiting_jobs: usize,
    /// Their bytes.
    pub waiting_bytes: usize,
}

/// The threads; dropping it stops them.
pub struct CodecPool {
    shared: Arc<Shared>,
    spawner: Mutex<Spawner>,
}

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    /// There is something to do, or the number of threads has changed.
    work: Condvar,
    done: AtomicU64,
    panicked: AtomicU64,
    busy_ns: AtomicU64,
}

#[derive(Default)]
struct State {
    decompress: Waiting,
    compress: Waiting,
    /// Jobs of the first kind in a row while some of the other waited.
    in_a_row: u32,
    threads: usize,
    wanted: usize,
    /// Threads that were ever started.
    started: usize,
    refused: u64,
    forgotten: u64,
    stopped: bool,
}

#[derive(Default)]
struct Waiting {
    jobs: VecDeque<Job>,
    bytes: usize,
}

impl Waiting {
    fn has_room(&self, bytes: usize) -> bool {
        let fits = self.bytes.saturating_add(bytes) <= MAX_WAITING_BYTES && self.jobs.len() < MAX_WAITING_JOBS;
        fits || self.jobs.is_empty()
    }

    fn pop(&mut self) -> Option<Job> {
        let job = self.jobs.pop_front()?;
        self.bytes -= job.bytes;
        Some(job)
    }
}

impl State {
    fn waiting(&mut self, urgency: Urgency) -> &mut Waiting {
        match urgency {
            Urgency::Decompress => &mut self.decompress,
            Urgency::Compress => &mut self.compress,
        }
    }

    fn pop(&mut self) -> Option<Job> {
        let others_turn = self.in_a_row >= TURN_AFTER || self.decompress.jobs.is_empty();
        if others_turn && let Some(job) = self.compress.pop() {
            self.in_a_row = 0;
            return Some(job);
        }
        let waits = !self.compress.jobs.is_empty();
        self.in_a_row = if waits { self.in_a_row + 1 } else { 0 };
        self.decompress.pop()
    }
}

impl CodecPool {
    /// Starts threads.
    ///
    /// # Errors
    /// That of the spawner; threads that were started end.
    pub fn start(threads: usize, spawner: Spawner) -> io::Result<Self> {
        let pool = Self {
            shared: Arc::default(),
            spawner: Mutex::new(spawner),
        };
        pool.resize(threads)?;
        Ok(pool)
    }

    /// Changes the number of threads, at least 1 and at most [`MAX_THREADS`]. Those too many end after the job that
    /// they are in. Does nothing after [`CodecPool::stop`].
    ///
    /// # Errors
    /// That of the spawner; the pool goes on with the threads that it has.
    pub fn resize(&self, threads: usize) -> io::Result<()> {
        let wanted = threads.clamp(1, MAX_THREADS);
        let mut spawner = self.spawner.lock();
        self.shared.state.lock().wanted = wanted;
        // Those that wait must look whether they are too many.
        self.shared.work.notify_all();
        for _ in 0..wanted {
            let Some(number) = self.shared.enrol() else { break };
            // If it is dropped without being run, the thread is struck off.
            let worker = Worker {
                shared: Arc::clone(&self.shared),
                enrolled: true,
            };
            spawner(format!("blaze-codec-{number}"), Box::new(move || worker.work()))?;
        }
        Ok(())
    }

    /// Puts a job behind those of its urgency.
    ///
    /// # Errors
    /// The job, and why it was not taken. The caller drops it where it may, see [`Completion`].
    pub fn submit(&self, job: Job) -> Result<(), (Job, Refusal)> {
        {
            let mut state = self.shared.state.lock();
            if state.stopped {
                return Err((job, Refusal::Stopped));
            }
            if !state.waiting(job.urgency).has_room(job.bytes) {
                state.refused += 1;
                return Err((job, Refusal::Full));
            }
            let waiting = state.waiting(job.urgency);
            waiting.bytes += job.bytes;
            waiting.jobs.push_back(job);
        }
        self.shared.work.notify_one();
        Ok(())
    }

    /// What it has done so far.
    #[must_use]
    pub fn counters(&self) -> PoolCounters {
        let shared = &self.shared;
        let state = shared.state.lock();
        PoolCounters {
            done: shared.done.load(Ordering::Relaxed),
            refused: state.refused,
            panicked: shared.panicked.load(Ordering::Relaxed),
            forgotten: state.forgotten,
            busy: Duration::from_nanos(shared.busy_ns.load(Ordering::Relaxed)),
            threads: state.threads,
            waiting_jobs: state.decompress.jobs.len() + state.compress.jobs.len(),
            waiting_bytes: state.decompress.bytes + state.compress.bytes,
        }
    }

    /// Forgets what waits, and tells the threads to end after the job that they are in. Does not wait for them.
    pub fn stop(&self) {
        self.shared.stop();
    }
}

impl Drop for CodecPool {
    fn drop(&mut self) {
        self.shared.stop();
    }
}

impl Shared {
    fn stop(&self) {
        let forgotten = {
            let mut state = self.state.lock();
            state.stopped = true;
            let forgotten = (
                std::mem::take(&mut state.decompress),
                std::mem::take(&mut state.compress),
            );
            state.forgotten += (forgotten.0.jobs.len() + forgotten.1.jobs.len()) as u64;
            forgotten
        };
        self.work.notify_all();
        // Whoever is told that his job is dropped may come back to this pool.
        drop(forgotten);
    }

    /// Notes a new thread, if one more is wanted, and gives its number.
    fn enrol(&self) -> Option<usize> {
        let mut state = self.state.lock();
        if state.stopped || state.threads >= state.wanted {
            return None;
        }
        state.threads += 1;
        state.started += 1;
        Some(state.started)
    }
}

/// One thread.
struct Worker {
    shared: Arc<Shared>,
    /// It counts among the threads.
    enrolled: bool,
}

impl Worker {
    fn work(mut self) {
        while let Some(job) = self.next() {
            let began = Instant::now();
            let ended = catch_unwind(AssertUnwindSafe(job.run));
            let busy = u64::try_from(began.elapsed().as_nanos()).unwrap_or(u64::MAX);
            self.shared.busy_ns.fetch_add(busy, Ordering::Relaxed);
            if let Err(panic) = ended {
                self.shared.panicked.fetch_add(1, Ordering::Relaxed);
                tracing::error!(urgency = ?job.urgency, bytes = job.bytes, "a job of the compression pool panicked");
                // To drop what was thrown may throw again, and end this thread.
                std::mem::forget(panic);
            } else {
                self.shared.done.fetch_add(1, Ordering::Relaxed);
            }
        }
    }

    /// The next job; `None` when the thread is to end.
    fn next(&mut self) -> Option<Job> {
        let mut state = self.shared.state.lock();
        loop {
            if state.stopped || state.threads > state.wanted {
                state.threads -= 1;
                self.enrolled = false;
                drop(state);
                // The call that woke it may have been for a job.
                self.shared.work.notify_one();
                return None;
            }
            if let Some(job) = state.pop() {
                return Some(job);
            }
            self.shared.work.wait(&mut state);
        }
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        if self.enrolled {
            self.shared.state.lock().threads -= 1;
        }
    }
}
