//! Every turn ends, whatever else happens; those that matter most go first.

use super::*;
use crate::testing::{eventually, on_threads};
use std::sync::atomic::{AtomicBool, AtomicUsize};

/// Turns that do not end before they may.
#[derive(Default)]
struct Gate {
    /// Turns that have begun, in their order.
    begun: Mutex<Vec<Urgency>>,
    open: Mutex<bool>,
    opens: Condvar,
}

impl Gate {
    fn open(&self) {
        *self.open.lock() = true;
        self.opens.notify_all();
    }

    fn turn(&self, urgency: Urgency) {
        self.begun.lock().push(urgency);
        let mut open = self.open.lock();
        while !*open {
            self.opens.wait(&mut open);
        }
    }

    fn begun(&self, urgency: Urgency) -> usize {
        self.begun.lock().iter().filter(|begun| **begun == urgency).count()
    }

    fn pool(self: &Arc<Self>, threads: usize) -> CodecPool {
        let gate = Arc::clone(self);
        CodecPool::start(threads, on_threads(), move |urgency| gate.turn(urgency)).unwrap()
    }

    /// A pool whose only thread is in a long turn.
    fn busy_pool(self: &Arc<Self>) -> CodecPool {
        let pool = self.pool(1);
        pool.offer(0, 1);
        eventually(|| self.begun(Urgency::Long) == 1);
        pool
    }
}

/// The standard library looks at the affinity mask and the quota of the control group (v1 and v2):
/// a container with half a processor gets one thread, not as many as the machine has.
#[test]
fn there_is_at_least_one_thread_and_not_more_than_the_most() {
    let own = threads(0);
    assert!((1..=MAX_THREADS).contains(&own));
    assert_eq!(
        own,
        std::thread::available_parallelism().map_or(1, NonZeroUsize::get).min(MAX_THREADS)
    );
    assert_eq!(
        [threads(1), threads(7), threads(64), threads(65), threads(u16::MAX)],
        [1, 7, 64, 64, 64]
    );
    assert_eq!([0, 1, 2, 8].map(threads_for_long), [1, 1, 1, 7]);
}

#[test]
fn all_turns_are_taken_by_all_threads() {
    let pool = {
        let gate = Arc::<Gate>::default();
        gate.open();
        gate.pool(4)
    };
    for number in 0..2_000 {
        pool.offer(usize::from(number % 3 == 0), usize::from(number % 3 != 0));
    }
    pool.offer(0, 0);
    pool.offer(300, 200);
    eventually(|| pool.counters().done == 2_500);
    eventually(|| pool.counters().working == 0);
    let counters = pool.counters();
    assert_eq!((counters.threads, counters.waiting), (4, 0));
}

#[test]
fn quick_turns_go_first_but_not_always() {
    let gate = Arc::<Gate>::default();
    let pool = gate.busy_pool();
    pool.offer(20, 20);
    assert_eq!(pool.counters().waiting, 40);
    gate.open();
    eventually(|| pool.counters().done == 41);
    let order = gate.begun.lock().clone();
    let long: Vec<usize> = (1..=40).filter(|at| order[*at] == Urgency::Long).collect();
    assert_eq!(
        long[..3],
        [9, 18, 23],
        "one after eight, and after the last quick one the rest: {order:?}"
    );
}

/// What came over the link does not wait until large payloads are compressed.
#[test]
fn one_thread_is_kept_for_quick_turns() {
    let gate = Arc::<Gate>::default();
    let pool = gate.pool(3);
    pool.offer(0, 10);
    eventually(|| gate.begun(Urgency::Long) == 2);
    pool.offer(1, 0);
    eventually(|| gate.begun(Urgency::Quick) == 1);
    assert_eq!((gate.begun(Urgency::Long), pool.counters().working), (2, 3));
    // With another thread there is one more long turn.
    pool.resize(4).unwrap();
    eventually(|| gate.begun(Urgency::Long) == 3);
    gate.open();
    eventually(|| pool.counters().done == 11);
    assert_eq!(pool.counters().waiting, 0);
}

/// Whoever started the thread is to notice: nothing is caught here.
#[test]
fn a_panic_ends_its_thread_and_the_others_go_on() {
    let turns = Arc::new(AtomicUsize::new(0));
    let (ended, fails) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicBool::new(true)));
    let noticed = Arc::clone(&ended);
    let spawner: Spawner = Box::new(move |name, run| {
        let noticed = Arc::clone(&noticed);
        let observed = move || {
            if std::panic::catch_unwind(std::panic::AssertUnwindSafe(run)).is_err() {
                noticed.fetch_add(1, Ordering::SeqCst);
            }
        };
        std::thread::Builder::new().name(name).spawn(observed).map(|_| ())
    });
    let counted = Arc::clone(&turns);
    let pool = CodecPool::start(2, spawner, move |_| {
        if fails.swap(false, Ordering::SeqCst) {
            panic!("a turn that fails, as it is meant to");
        }
        counted.fetch_add(1, Ordering::SeqCst);
    })
    .unwrap();
    pool.offer(0, 1);
    eventually(|| ended.load(Ordering::SeqCst) == 1);
    assert_eq!((pool.counters().threads, pool.counters().working), (1, 0));
    // Its place among those in long turns is free.
    pool.offer(3, 3);
    eventually(|| turns.load(Ordering::SeqCst) == 6);
    pool.resize(2).unwrap();
    assert_eq!(pool.counters().threads, 2);
}

#[test]
fn stopped_under_load_it_ends() {
    let gate = Arc::<Gate>::default();
    let pool = gate.busy_pool();
    pool.offer(25, 25);
    pool.stop();
    pool.offer(1, 1);
    pool.resize(8).unwrap();
    let counters = pool.counters();
    assert_eq!((counters.threads, counters.waiting), (1, 0), "it is still in its turn");
    gate.open();
    eventually(|| pool.counters().threads == 0);
    assert_eq!((pool.counters().done, pool.counters().working), (1, 0));
}

#[test]
fn more_and_fewer_threads_while_it_runs() {
    let gate = Arc::<Gate>::default();
    let pool = gate.busy_pool();
    pool.offer(20, 0);
    pool.resize(6).unwrap();
    eventually(|| pool.counters().working == 6);
    pool.resize(2).unwrap();
    assert_eq!(pool.counters().threads, 6, "those in a turn end it");
    pool.resize(3).unwrap();
    gate.open();
    eventually(|| pool.counters().done == 21 && pool.counters().threads == 3);
    // Those that wait leave as well, and a turn that comes then is taken.
    for round in 0..200u64 {
        pool.resize(1 + (round % 3) as usize).unwrap();
        pool.offer((round % 2) as usize, ((round + 1) % 2) as usize);
        eventually(|| pool.counters().done == 22 + round);
    }
    pool.resize(0).unwrap();
    eventually(|| pool.counters().threads == 1);
}

#[test]
fn without_threads_there_is_no_pool_and_with_fewer_it_goes_on() {
    let none: Spawner = Box::new(|_, _| Err(io::Error::other("no thread")));
    assert!(CodecPool::start(2, none, |_| ()).is_err());
    let mut left = 2;
    let two: Spawner = Box::new(move |name, run| {
        left -= 1;
        if left < 0 {
            return Err(io::Error::other("no thread"));
        }
        std::thread::Builder::new().name(name).spawn(run).map(|_| ())
    });
    let pool = CodecPool::start(1, two, |_| ()).unwrap();
    assert!(pool.resize(4).is_err());
    assert_eq!(pool.counters().threads, 2);
    pool.offer(0, 1);
    eventually(|| pool.counters().done == 1);
}

#[test]
fn utilisation_is_the_time_in_turns() {
    let nap = |_| std::thread::sleep(Duration::from_millis(20));
    let pool = CodecPool::start(2, on_threads(), nap).unwrap();
    pool.offer(2, 2);
    eventually(|| pool.counters().done == 4);
    assert!(pool.counters().busy >= Duration::from_millis(80), "{:?}", pool.counters());
}
