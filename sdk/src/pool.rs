//! Pool that runs subscription callbacks.
//!
//! ```text
//! subscriptions ── tickets ──► ready queue ──► base threads
//!                                         └──► spare threads, while callbacks keep all others busy
//! ```
//!
//! Base threads: `pool_threads`; default: number of cores, at least 2.
//!
//! A ticket is "this subscription has something to run"; its job runs one callback and is put back
//! at the end of the queue if there is more, so subscriptions take turns. When nothing was taken
//! from the queue for [`STUCK_AFTER`], because every thread sits in a callback that waits for
//! something, a spare thread comes to help; it leaves when it has been idle.

use std::collections::VecDeque;
use std::io;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_runtime::{Supervisor, TaskPolicy};
use parking_lot::{Condvar, Mutex};

/// Spare threads of one pool at most.
pub(crate) const MAX_SPARE_THREADS: usize = 16;
/// How long the queue may stand still before a spare thread comes.
const STUCK_AFTER: Duration = Duration::from_millis(50);
/// How long a spare thread stays without work.
const SPARE_IDLE: Duration = Duration::from_secs(5);

/// Something that can be run piece by piece.
pub(crate) trait Job: Send + Sync {
    /// Runs one piece. Returns whether there is more. It must not panic.
    fn run_one(&self) -> bool;
}

/// The threads; dropping it stops them.
pub(crate) struct Pool {
    shared: Arc<Shared>,
}

/// A way to put jobs into the pool.
#[derive(Clone)]
pub(crate) struct PoolHandle {
    shared: Arc<Shared>,
}

struct Shared {
    state: Mutex<State>,
    /// There is something in the queue.
    work: Condvar,
    /// The same, for the thread that watches whether it stands still.
    watched: Condvar,
    /// Owner of the threads.
    supervisor: Supervisor,
}

#[derive(Default)]
struct State {
    ready: VecDeque<Arc<dyn Job>>,
    taken: u64,
    /// Threads that wait for work; each will take one job of the queue.
    idle: usize,
    /// The watch thread is in its 50 ms check and needs no wake-up.
    watching: bool,
    spare: usize,
    stopped: bool,
}

impl Pool {
    /// Starts the threads; at least two, so that one slow callback never holds up the others. They
    /// end with the supervisor, after the callback that they are in.
    pub(crate) fn start(threads: usize, supervisor: &Supervisor) -> io::Result<Self> {
        let pool = Self {
            shared: Arc::new(Shared {
                state: Mutex::default(),
                work: Condvar::new(),
                watched: Condvar::new(),
                supervisor: supervisor.clone(),
            }),
        };
        for number in 0..threads.max(2) {
            pool.shared.spawn(format!("blaze-cb-{number}"), |shared| work(shared, None))?;
        }
        pool.shared.spawn("blaze-cb-watch".to_owned(), help_when_stuck)?;
        let (shared, stop) = (Arc::clone(&pool.shared), supervisor.shutdown_token());
        supervisor.spawn("pool", TaskPolicy::MayEnd, async move {
            stop.cancelled().await;
            shared.stop();
        });
        Ok(pool)
    }

    pub(crate) fn handle(&self) -> PoolHandle {
        PoolHandle { shared: Arc::clone(&self.shared) }
    }

    /// Forgets what waits and tells the threads to end after the callback that they are in.
    pub(crate) fn stop(&self) {
        self.shared.stop();
    }
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.stop();
    }
}

impl PoolHandle {
    pub(crate) fn submit(&self, job: Arc<dyn Job>) {
        self.shared.submit(job);
    }
}

impl Shared {
    fn stop(&self) {
        let forgotten = {
            let mut state = self.state.lock();
            state.stopped = true;
            std::mem::take(&mut state.ready)
        };
        drop(forgotten);
        self.work.notify_all();
        self.watched.notify_all();
    }

    fn submit(&self, job: Arc<dyn Job>) {
        let mut state = self.state.lock();
        if state.stopped {
            return;
        }
        state.ready.push_back(job);
        let call_watch = state.lacks_threads() && !state.watching;
        drop(state);
        self.work.notify_one();
        if call_watch {
            self.watched.notify_one();
        }
    }

    fn spawn(
        self: &Arc<Self>,
        name: String,
        body: impl FnOnce(&Arc<Self>) + Send + 'static,
    ) -> io::Result<()> {
        let shared = Arc::clone(self);
        self.supervisor.spawn_thread(name, TaskPolicy::MayEnd, move || body(&shared))?;
        Ok(())
    }

    /// The next job; `None` when the pool stops or a spare thread was idle for its time.
    fn next(&self, idle: Option<Duration>) -> Option<Arc<dyn Job>> {
        let mut state = self.state.lock();
        loop {
            if state.stopped {
                return None;
            }
            if let Some(job) = state.ready.pop_front() {
                state.taken += 1;
                return Some(job);
            }
            state.idle += 1;
            let timed_out = match idle {
                None => {
                    self.work.wait(&mut state);
                    false
                }
                Some(time) => self.work.wait_for(&mut state, time).timed_out(),
            };
            state.idle -= 1;
            if timed_out && state.ready.is_empty() {
                return None;
            }
        }
    }
}

fn work(shared: &Arc<Shared>, idle: Option<Duration>) {
    while let Some(job) = shared.next(idle) {
        if job.run_one() {
            shared.submit(job);
        }
    }
}

impl State {
    /// More jobs wait than threads.
    fn lacks_threads(&self) -> bool {
        self.ready.len() > self.idle
    }
}

fn help_when_stuck(shared: &Arc<Shared>) {
    let mut state = shared.state.lock();
    while !state.stopped {
        if !state.lacks_threads() {
            shared.watched.wait(&mut state);
            continue;
        }
        let before = state.taken;
        state.watching = true;
        let look_again = Instant::now() + STUCK_AFTER;
        while !state.stopped && !shared.watched.wait_until(&mut state, look_again).timed_out() {}
        state.watching = false;
        let is_stuck = state.taken == before && state.lacks_threads();
        if state.stopped || !is_stuck || state.spare >= MAX_SPARE_THREADS {
            continue;
        }
        state.spare += 1;
        let number = state.spare;
        drop(state);
        let started = shared.spawn(format!("blaze-spare-{number}"), |shared| {
            work(shared, Some(SPARE_IDLE));
            shared.state.lock().spare -= 1;
        });
        state = shared.state.lock();
        if let Err(error) = started {
            state.spare -= 1;
            tracing::warn!(
                %error,
                "all callback threads are busy, and no spare thread could be started",
            );
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};

    const DEADLINE: Duration = Duration::from_secs(20);

    /// Runs once, and then waits until it is let go.
    #[derive(Default)]
    struct Stuck {
        running: AtomicUsize,
        may_end: Mutex<bool>,
        ends: Condvar,
    }

    impl Job for Stuck {
        fn run_one(&self) -> bool {
            self.running.fetch_add(1, Ordering::SeqCst);
            let mut may_end = self.may_end.lock();
            while !*may_end {
                self.ends.wait(&mut may_end);
            }
            false
        }
    }

    impl Stuck {
        fn let_go(&self) {
            *self.may_end.lock() = true;
            self.ends.notify_all();
        }
    }

    pub(crate) fn eventually(mut holds: impl FnMut() -> bool) {
        let until = Instant::now() + DEADLINE;
        while !holds() {
            assert!(Instant::now() < until, "not within {DEADLINE:?}");
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    #[tokio::test]
    async fn stuck_threads_get_help_up_to_a_bound_and_all_end_when_it_stops() {
        let supervisor = Supervisor::new("t");
        let pool = Pool::start(2, &supervisor).unwrap();
        let stuck = Arc::new(Stuck::default());
        let most = 2 + MAX_SPARE_THREADS;
        for _ in 0..most + 5 {
            pool.handle().submit(Arc::clone(&stuck) as Arc<dyn Job>);
        }
        eventually(|| stuck.running.load(Ordering::SeqCst) == most);
        {
            let state = pool.shared.state.lock();
            assert_eq!((state.ready.len(), state.spare), (5, MAX_SPARE_THREADS));
        }
        let threads = || supervisor.running().iter().filter(|task| task.thread).count();
        assert_eq!(threads(), most + 1, "and the one that watches");
        let report = supervisor.shutdown(Duration::from_millis(1)).await;
        assert_eq!(report.left.len(), most, "they are still in their jobs: {report:?}");
        stuck.let_go();
        assert!(supervisor.shutdown(DEADLINE).await.is_clean());
        assert_eq!(stuck.running.load(Ordering::SeqCst), most, "what waited was forgotten");
    }

    #[tokio::test]
    async fn quick_jobs_need_no_spare_threads_and_take_turns() {
        struct Counting(AtomicUsize, usize);
        impl Job for Counting {
            fn run_one(&self) -> bool {
                self.0.fetch_add(1, Ordering::SeqCst) + 1 < self.1
            }
        }
        // Where the machine lets no thread run for as long as a job that is stuck takes, there is
        // one: not each time.
        let needs_none = (0..3).any(|_| {
            let pool = Pool::start(2, &Supervisor::new("t")).unwrap();
            let jobs: Vec<_> =
                (0..4).map(|_| Arc::new(Counting(AtomicUsize::new(0), 5_000))).collect();
            for job in &jobs {
                pool.handle().submit(Arc::clone(job) as Arc<dyn Job>);
            }
            eventually(|| jobs.iter().all(|job| job.0.load(Ordering::SeqCst) == 5_000));
            pool.shared.state.lock().spare == 0
        });
        assert!(needs_none);
    }
}
