//! Threads that compress and decompress.
//!
//! ```text
//! offer ─► turns: [ quick ] ─┬─► threads (as many as processors) ─► the pool's owner finds out what is to be done
//!                 [ long  ] ─┘
//! ```
//!
//! A turn is the leave to do one thing of its urgency. What that is shows when the turn begins, not
//! when it is offered: the owner keeps the payloads, within bounds of his own, and may think better
//! of it as long as they wait. So nothing here holds a payload, and a turn for which nothing is
//! left costs nothing. Quick turns go first, but now and then one is the others'. Where there are
//! several threads one is kept for quick turns: what came over the link does not wait until a large
//! payload is compressed. No lock is held during a turn.

use std::io;
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use parking_lot::{Condvar, Mutex};

#[cfg(test)]
mod tests;

/// Most threads of a pool, whatever the node file says.
pub const MAX_THREADS: usize = 64;
/// After so many quick turns in a row, one of the others begins.
const TURN_AFTER: u32 = 8;
/// Kinds of turns.
pub(super) const URGENCIES: usize = Urgency::ALL.len();

/// Threads for `flow.pool_threads`: that number, or for 0 as many as there are processors for this
/// process, which counts the quota of its control group and its affinity mask. At least 1 and at
/// most [`MAX_THREADS`].
#[must_use]
pub fn threads(configured: u16) -> usize {
    let count = match configured {
        0 => std::thread::available_parallelism().map_or(1, NonZeroUsize::get),
        count => count.into(),
    };
    count.clamp(1, MAX_THREADS)
}

/// How many of so many threads may be in long turns at a time.
#[must_use]
pub fn threads_for_long(threads: usize) -> usize {
    threads.saturating_sub(1).max(1)
}

/// Which turns go first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Urgency {
    /// What is done in a moment: to decompress, and to compress what is small.
    Quick,
    /// To compress what is large.
    Long,
}

impl Urgency {
    /// Both, the first first.
    pub const ALL: [Self; 2] = [Self::Quick, Self::Long];
}

/// What starts threads: it runs the function on a new thread of that name.
pub type Spawner = Box<dyn FnMut(String, Box<dyn FnOnce() + Send>) -> io::Result<()> + Send>;

/// What a pool has done, and has to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PoolCounters {
    /// Turns that have ended.
    pub done: u64,
    /// Time that all threads together have spent in them. What it grows by in a second, by
    /// `threads`, is the utilisation.
    pub busy: Duration,
    /// Threads there are; more than wanted until those too many have ended their turns.
    pub threads: usize,
    /// Threads that are in a turn.
    pub working: usize,
    /// Turns that wait for a thread.
    pub waiting: usize,
}

/// The threads; dropping it stops them.
pub struct CodecPool {
    shared: Arc<Shared>,
    spawner: Mutex<Spawner>,
}

struct Shared {
    /// What a turn is.
    run: Box<dyn Fn(Urgency) + Send + Sync>,
    state: Mutex<State>,
    /// There is something to do, or the number of threads has changed.
    work: Condvar,
    done: AtomicU64,
    busy_ns: AtomicU64,
}

#[derive(Default)]
struct State {
    /// Turns that wait, by urgency.
    turns: [usize; URGENCIES],
    /// Quick ones in a row while a long one could have begun.
    in_a_row: u32,
    /// Threads that are in a turn, by urgency.
    working: [usize; URGENCIES],
    threads: usize,
    wanted: usize,
    /// Threads that were ever started.
    started: usize,
    stopped: bool,
}

impl State {
    fn may_begin(&self, urgency: Urgency) -> bool {
        let may = match urgency {
            Urgency::Quick => true,
            Urgency::Long => self.working[urgency as usize] < threads_for_long(self.wanted),
        };
        may && self.turns[urgency as usize] > 0
    }

    fn begin(&mut self) -> Option<Urgency> {
        let [quick, long] = Urgency::ALL.map(|urgency| self.may_begin(urgency));
        let urgency = match (quick, long) {
            (false, false) => return None,
            (false, true) => Urgency::Long,
            (true, true) if self.in_a_row >= TURN_AFTER => Urgency::Long,
            (true, _) => Urgency::Quick,
        };
        self.in_a_row =
            if quick && long && urgency == Urgency::Quick { self.in_a_row + 1 } else { 0 };
        self.turns[urgency as usize] -= 1;
        self.working[urgency as usize] += 1;
        Some(urgency)
    }

    fn end(&mut self, urgency: Option<Urgency>) {
        if let Some(urgency) = urgency {
            self.working[urgency as usize] -= 1;
        }
    }
}

impl CodecPool {
    /// Starts threads. `run` is what they do in each turn. A panic there ends the thread, for
    /// whoever started it to notice.
    ///
    /// # Errors
    /// That of the spawner; threads that were started end.
    pub fn start(
        threads: usize,
        spawner: Spawner,
        run: impl Fn(Urgency) + Send + Sync + 'static,
    ) -> io::Result<Self> {
        let pool = Self {
            shared: Arc::new(Shared {
                run: Box::new(run),
                state: Mutex::default(),
                work: Condvar::new(),
                done: AtomicU64::new(0),
                busy_ns: AtomicU64::new(0),
            }),
            spawner: Mutex::new(spawner),
        };
        pool.resize(threads)?;
        Ok(pool)
    }

    /// Changes the number of threads, at least 1 and at most [`MAX_THREADS`]. Those too many end
    /// after the turn that they are in. Does nothing after [`CodecPool::stop`].
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
            let worker = Worker { shared: Arc::clone(&self.shared), enrolled: true, turn: None };
            spawner(format!("blaze-codec-{number}"), Box::new(move || worker.work()))?;
        }
        Ok(())
    }

    /// So many more turns. After [`CodecPool::stop`] they are forgotten.
    pub fn offer(&self, quick: usize, long: usize) {
        if quick == 0 && long == 0 {
            return;
        }
        {
            let mut state = self.shared.state.lock();
            if state.stopped {
                return;
            }
            state.turns[Urgency::Quick as usize] += quick;
            state.turns[Urgency::Long as usize] += long;
        }
        // Who takes one wakes the next if there are more.
        self.shared.work.notify_one();
    }

    /// What it has done so far.
    #[must_use]
    pub fn counters(&self) -> PoolCounters {
        let shared = &self.shared;
        let state = shared.state.lock();
        PoolCounters {
            done: shared.done.load(Ordering::Relaxed),
            busy: Duration::from_nanos(shared.busy_ns.load(Ordering::Relaxed)),
            threads: state.threads,
            working: state.working.iter().sum(),
            waiting: state.turns.iter().sum(),
        }
    }

    /// Forgets the turns that wait, and tells the threads to end after the one that they are in.
    /// Does not wait for them.
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
        {
            let mut state = self.state.lock();
            state.stopped = true;
            state.turns = [0; URGENCIES];
        }
        self.work.notify_all();
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
    /// The turn that it is in.
    turn: Option<Urgency>,
}

impl Worker {
    fn work(mut self) {
        while let Some(urgency) = self.next() {
            let began = Instant::now();
            (self.shared.run)(urgency);
            let busy = u64::try_from(began.elapsed().as_nanos()).unwrap_or(u64::MAX);
            self.shared.busy_ns.fetch_add(busy, Ordering::Relaxed);
            self.shared.done.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Ends a turn and begins the next; `None` when the thread is to end.
    fn next(&mut self) -> Option<Urgency> {
        let mut state = self.shared.state.lock();
        state.end(self.turn.take());
        loop {
            if state.stopped || state.threads > state.wanted {
                state.threads -= 1;
                self.enrolled = false;
                drop(state);
                // The call that woke it may have been for a turn.
                self.shared.work.notify_one();
                return None;
            }
            if let Some(urgency) = state.begin() {
                self.turn = Some(urgency);
                let more = Urgency::ALL.iter().any(|urgency| state.may_begin(*urgency));
                drop(state);
                if more {
                    self.shared.work.notify_one();
                }
                return Some(urgency);
            }
            self.shared.work.wait(&mut state);
        }
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        if self.enrolled {
            let mut state = self.shared.state.lock();
            state.end(self.turn.take());
            state.threads -= 1;
        }
    }
}
