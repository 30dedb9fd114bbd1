//! Every job ends in one way, whatever else happens.

use super::*;
use std::sync::atomic::AtomicUsize;

const DEADLINE: Duration = Duration::from_secs(20);

fn on_threads() -> Spawner {
    Box::new(|name, run| std::thread::Builder::new().name(name).spawn(run).map(|_| ()))
}

fn eventually(mut holds: impl FnMut() -> bool) {
    let until = Instant::now() + DEADLINE;
    while !holds() {
        assert!(Instant::now() < until, "not within {DEADLINE:?}");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Jobs that do not end before they may.
#[derive(Default)]
struct Gate {
    running: AtomicUsize,
    open: Mutex<bool>,
    opens: Condvar,
}

impl Gate {
    fn job(self: &Arc<Self>, urgency: Urgency, bytes: usize) -> Job {
        let gate = Arc::clone(self);
        Job::new(urgency, bytes, move || {
            gate.running.fetch_add(1, Ordering::SeqCst);
            let mut open = gate.open.lock();
            while !*open {
                gate.opens.wait(&mut open);
            }
        })
    }

    fn open(&self) {
        *self.open.lock() = true;
        self.opens.notify_all();
    }

    /// A pool whose only thread is in a job of this.
    fn busy_pool(self: &Arc<Self>) -> CodecPool {
        let pool = CodecPool::start(1, on_threads()).unwrap();
        pool.submit(self.job(Urgency::Compress, 1)).unwrap();
        eventually(|| self.running.load(Ordering::SeqCst) == 1);
        pool
    }
}

fn counting(results: &Arc<Mutex<Vec<Option<u32>>>>, urgency: Urgency, number: u32) -> Job {
    let results = Arc::clone(results);
    let done = Completion::new(move |result| results.lock().push(result));
    Job::new(urgency, 10, move || done.give(number))
}

/// The standard library looks at the affinity mask and the quota of the control group (v1 and v2): a container with
/// half a processor gets one thread, not as many as the machine has.
#[test]
fn there_is_at_least_one_thread_and_not_more_than_the_most() {
    let own = threads(0);
    assert!((1..=MAX_THREADS).contains(&own));
    assert_eq!(
        own,
        std::thread::available_parallelism()
            .map_or(1, NonZeroUsize::get)
            .min(MAX_THREADS)
    );
    assert_eq!(
        [threads(1), threads(7), threads(64), threads(65), threads(u16::MAX)],
        [1, 7, 64, 64, 64]
    );
}

#[test]
fn all_jobs_are_done_by_all_threads() {
    let results = Arc::default();
    let pool = CodecPool::start(4, on_threads()).unwrap();
    for number in 0..2_000 {
        let urgency = if number % 3 == 0 {
            Urgency::Decompress
        } else {
            Urgency::Compress
        };
        pool.submit(counting(&results, urgency, number)).unwrap();
    }
    eventually(|| pool.counters().done == 2_000);
    let mut all: Vec<u32> = results.lock().iter().map(|result| result.unwrap()).collect();
    all.sort_unstable();
    assert_eq!(all, (0..2_000).collect::<Vec<_>>());
    let counters = pool.counters();
    assert_eq!(
        (counters.threads, counters.waiting_jobs, counters.waiting_bytes),
        (4, 0, 0)
    );
    assert_eq!((counters.refused, counters.panicked, counters.forgotten), (0, 0, 0));
}

#[test]
fn what_came_over_the_link_goes_first_but_not_always() {
    let (gate, results) = (Arc::<Gate>::default(), Arc::default());
    let pool = gate.busy_pool();
    for number in 0..20 {
        pool.submit(counting(&results, Urgency::Compress, number)).unwrap();
    }
    for number in 100..120 {
        pool.submit(counting(&results, Urgency::Decompress, number)).unwrap();
    }
    gate.open();
    eventually(|| results.lock().len() == 40);
    let order: Vec<u32> = results.lock().iter().map(|result| result.unwrap()).collect();
    let expected: Vec<u32> = (100..108)
        .chain([0])
        .chain(108..116)
        .chain([1])
        .chain(116..120)
        .chain(2..20)
        .collect();
    assert_eq!(order, expected);
}

#[test]
fn a_full_queue_says_so_and_one_job_always_fits() {
    let (gate, results) = (Arc::<Gate>::default(), Arc::<Mutex<Vec<Option<u32>>>>::default());
    let pool = gate.busy_pool();
    // Larger than all that may wait.
    pool.submit(gate.job(Urgency::Compress, 2 * MAX_WAITING_BYTES)).unwrap();
    let (refused, why) = pool.submit(counting(&results, Urgency::Compress, 1)).unwrap_err();
    assert_eq!(why, Refusal::Full);
    assert!(results.lock().is_empty(), "the caller has it");
    drop(refused);
    assert_eq!(*results.lock(), [None]);
    // The other kind has room of its own.
    pool.submit(gate.job(Urgency::Decompress, MAX_WAITING_BYTES)).unwrap();
    assert!(pool.submit(gate.job(Urgency::Decompress, 1)).is_err());
    pool.submit(gate.job(Urgency::Decompress, 0)).unwrap();
    for _ in 0..MAX_WAITING_JOBS - 2 {
        pool.submit(gate.job(Urgency::Decompress, 0)).unwrap();
    }
    assert!(pool.submit(gate.job(Urgency::Decompress, 0)).is_err(), "too many");
    let counters = pool.counters();
    assert_eq!((counters.refused, counters.waiting_jobs), (3, MAX_WAITING_JOBS + 1));
    assert_eq!(counters.waiting_bytes, 3 * MAX_WAITING_BYTES);
    gate.open();
    eventually(|| pool.counters().done == MAX_WAITING_JOBS as u64 + 2);
    assert_eq!(pool.counters().waiting_bytes, 0);
}

#[test]
fn a_panic_ends_the_job_and_not_the_thread() {
    struct Nasty;
    impl Drop for Nasty {
        fn drop(&mut self) {
            if !std::thread::panicking() {
                panic!("once more");
            }
        }
    }
    let results = Arc::new(Mutex::new(Vec::new()));
    let pool = CodecPool::start(1, on_threads()).unwrap();
    for number in 0..3u32 {
        let told = Arc::clone(&results);
        let done = Completion::<u32>::new(move |result| told.lock().push(result));
        let run = move || {
            let _held = done;
            if number == 1 {
                std::panic::panic_any(Nasty);
            }
            panic!("a job that fails, as it is meant to");
        };
        pool.submit(Job::new(Urgency::Compress, 1, run)).unwrap();
    }
    pool.submit(counting(&results, Urgency::Compress, 7)).unwrap();
    eventually(|| results.lock().len() == 4 && pool.counters().done == 1);
    assert_eq!(*results.lock(), [None, None, None, Some(7)]);
    assert_eq!((pool.counters().panicked, pool.counters().threads), (3, 1));
}

#[test]
fn stopped_under_load_it_ends_and_everybody_is_told() {
    let (gate, results) = (Arc::<Gate>::default(), Arc::<Mutex<Vec<Option<u32>>>>::default());
    let pool = gate.busy_pool();
    for number in 0..50 {
        pool.submit(counting(&results, Urgency::Compress, number)).unwrap();
    }
    pool.stop();
    assert_eq!(*results.lock(), vec![None; 50]);
    let (job, why) = pool.submit(counting(&results, Urgency::Compress, 1)).unwrap_err();
    assert_eq!(why, Refusal::Stopped);
    drop(job);
    pool.resize(8).unwrap();
    assert_eq!(
        (pool.counters().threads, pool.counters().forgotten),
        (1, 50),
        "it is still in its job"
    );
    gate.open();
    eventually(|| pool.counters().threads == 0);
    assert_eq!((pool.counters().done, results.lock().len()), (1, 51));
}

#[test]
fn dropped_it_ends_too() {
    let gate = Arc::<Gate>::default();
    let pool = gate.busy_pool();
    let shared = Arc::clone(&pool.shared);
    drop(pool);
    gate.open();
    eventually(|| shared.state.lock().threads == 0);
    eventually(|| Arc::strong_count(&shared) == 1);
}

#[test]
fn more_and_fewer_threads_while_it_runs() {
    let gate = Arc::<Gate>::default();
    let pool = gate.busy_pool();
    for _ in 0..20 {
        pool.submit(gate.job(Urgency::Compress, 1)).unwrap();
    }
    pool.resize(6).unwrap();
    eventually(|| gate.running.load(Ordering::SeqCst) == 6);
    pool.resize(2).unwrap();
    assert_eq!(pool.counters().threads, 6, "those in a job end it");
    pool.resize(3).unwrap();
    gate.open();
    eventually(|| pool.counters().done == 21 && pool.counters().threads == 3);
    // Those that wait leave as well, and a job that comes then is done.
    for round in 0..200u64 {
        pool.resize(1 + (round % 3) as usize).unwrap();
        pool.submit(gate.job(Urgency::Decompress, 1)).unwrap();
        eventually(|| pool.counters().done == 22 + round);
    }
    pool.resize(0).unwrap();
    eventually(|| pool.counters().threads == 1);
}

#[test]
fn threads_that_wait_for_work_end_as_well() {
    let pool = CodecPool::start(6, on_threads()).unwrap();
    // So that they wait; if one does not yet it is all the easier.
    let a_moment = Duration::from_millis(50);
    std::thread::sleep(a_moment);
    pool.resize(2).unwrap();
    eventually(|| pool.counters().threads == 2);
    std::thread::sleep(a_moment);
    pool.stop();
    eventually(|| pool.counters().threads == 0);
}

#[test]
fn without_threads_there_is_no_pool_and_with_fewer_it_goes_on() {
    let none: Spawner = Box::new(|_, _| Err(io::Error::other("no thread")));
    assert!(CodecPool::start(2, none).is_err());
    let mut left = 2;
    let two: Spawner = Box::new(move |name, run| {
        left -= 1;
        if left < 0 {
            return Err(io::Error::other("no thread"));
        }
        std::thread::Builder::new().name(name).spawn(run).map(|_| ())
    });
    let pool = CodecPool::start(1, two).unwrap();
    assert!(pool.resize(4).is_err());
    assert_eq!(pool.counters().threads, 2);
    let results = Arc::default();
    pool.submit(counting(&results, Urgency::Compress, 1)).unwrap();
    eventually(|| results.lock().len() == 1);
}

#[test]
fn utilisation_is_the_time_in_jobs() {
    let pool = CodecPool::start(2, on_threads()).unwrap();
    for _ in 0..4 {
        let run = || std::thread::sleep(Duration::from_millis(20));
        pool.submit(Job::new(Urgency::Compress, 1, run)).unwrap();
    }
    eventually(|| pool.counters().done == 4);
    assert!(
        pool.counters().busy >= Duration::from_millis(80),
        "{:?}",
        pool.counters()
    );
}

#[test]
fn payloads_go_there_and_back_through_the_pool() {
    let pool = CodecPool::start(2, on_threads()).unwrap();
    let payload = bytes::Bytes::from(b"0123456789abcdef".repeat(5_000));
    let (there, back) = (Arc::new(Mutex::new(None)), Arc::new(Mutex::new(None)));
    let told = Arc::clone(&there);
    let done = Completion::new(move |result| *told.lock() = result);
    pool.submit(crate::codec::compress_job(payload.clone(), 9, done))
        .unwrap();
    eventually(|| there.lock().is_some());
    let compressed = there.lock().take().unwrap();
    assert_eq!((compressed.before, compressed.level), (80_000, 9));
    assert!(compressed.after() < 1_000 && compressed.taken > Duration::ZERO && compressed.processor > Duration::ZERO);
    let told = Arc::clone(&back);
    let done = Completion::new(move |result| *told.lock() = result);
    let job = crate::codec::decompress_job(compressed.block.unwrap(), 80_000, 100_000, done);
    assert_eq!(job.bytes, 80_000);
    pool.submit(job).unwrap();
    eventually(|| back.lock().is_some());
    assert_eq!(back.lock().take(), Some(Ok(payload)));
}
