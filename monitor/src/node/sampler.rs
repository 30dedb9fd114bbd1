//! The threads of the collectors, and the sampler that takes their newest values.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::{Condvar, Mutex};

use super::limits;
use super::sample::{Batch, Reading, Sample, Slot, State};
use super::{cgroup, clock, disk, gpu, hwmon, nvml, power, procfs, sensors};

/// Where the kernel's file systems are mounted. Tests have trees of their own.
#[derive(Clone, Debug)]
pub struct Roots {
    /// `/proc`; its list of mounts names the file systems.
    pub proc: PathBuf,
    /// `/sys`.
    pub sys: PathBuf,
}

impl Default for Roots {
    fn default() -> Self {
        Self { proc: "/proc".into(), sys: "/sys".into() }
    }
}

/// One source of values. It may block; then its own values are left out and nothing else.
pub(super) trait Collector: Send {
    /// Value of the label `collector`.
    fn name(&self) -> &'static str;
    /// Looks for the sources: at the start and every [`limits::DISCOVERY`].
    fn discover(&mut self) {}
    /// Reads the values.
    fn collect(&mut self, batch: &mut Batch);
}

/// All collectors of this machine.
pub(super) fn collectors(
    roots: &Roots,
    space: disk::SpaceOf,
    clock: clock::Probe,
) -> Vec<Box<dyn Collector>> {
    let mut all = procfs::collectors(roots);
    all.push(Box::new(cgroup::Cgroup::new(roots)));
    all.push(Box::new(disk::Space::new(roots, space)));
    all.push(Box::new(sensors::Sensors::new("thermal", roots, sensors::thermal_zones)));
    all.push(Box::new(sensors::Sensors::new("hwmon", roots, hwmon::chips)));
    all.push(Box::new(sensors::Sensors::new("battery", roots, power::batteries)));
    all.push(Box::new(power::Powercap::new(roots)));
    all.push(Box::new(gpu::Gpus::new(roots)));
    all.push(Box::new(clock::Clock(clock)));
    all
}

/// What the threads share with the sampler.
struct Signal {
    state: Mutex<Wanted>,
    wake: Condvar,
}

struct Wanted {
    /// Counts the samples; a change wakes the collectors.
    samples: u64,
    period: Duration,
    stopped: bool,
}

impl Signal {
    /// Waits until the values are wanted again; `false` at the end. A collector follows the
    /// samples, so each has new values and their differences make rates; without samples, its own
    /// clock. The time counts from the end of the last run: a slow driver has a pause.
    fn wait(&self, ended: Instant, seen: &mut u64) -> bool {
        let mut state = self.state.lock();
        loop {
            let elapsed = ended.elapsed();
            let asked = state.samples != *seen && elapsed >= state.period / 4;
            let due = state.period + state.period / 2;
            if state.stopped || asked || elapsed >= due {
                *seen = state.samples;
                return !state.stopped;
            }
            self.wake.wait_for(&mut state, due - elapsed);
        }
    }
}

/// The thread of one collector.
struct Worker {
    collector: &'static str,
    started: Instant,
    /// Why there is no thread.
    refused: Option<String>,
    latest: Arc<Mutex<Option<Arc<Reading>>>>,
}

impl Worker {
    fn spawn(collector: Box<dyn Collector>, signal: Arc<Signal>) -> Self {
        let name = collector.name();
        let latest = Arc::new(Mutex::new(None));
        let slot = Arc::clone(&latest);
        let thread = std::thread::Builder::new()
            .name(format!("node-{name}"))
            .stack_size(limits::STACK_BYTES)
            .spawn(move || run(collector, &signal, &slot));
        let refused = thread.err().map(|error| format!("its thread cannot be started: {error}"));
        Self { collector: name, started: Instant::now(), refused, latest }
    }

    fn slot(&self, now: Instant, period: Duration) -> Slot {
        let stale = (period * limits::STALE_PERIODS).max(limits::STALE_AT_LEAST);
        let reading = self.latest.lock().clone();
        let at = reading.as_ref().map_or(self.started, |reading| reading.at);
        let age = now.saturating_duration_since(at);
        let (state, reading) = match (&self.refused, reading) {
            (Some(reason), _) => (State::Down(reason.clone()), None),
            (None, _) if age > stale => (State::Down(silent(age)), None),
            (None, None) => (State::Absent, None),
            (None, Some(reading)) => (reading.state.clone(), Some(reading)),
        };
        Slot::new(self.collector, state, reading)
    }
}

fn silent(age: Duration) -> String {
    let seconds = age.as_secs();
    format!(
        "no values for {seconds} s: a file or a driver of this source blocks. Look at dmesg; \
         the values return when it answers"
    )
}

/// Body of a collector's thread. It ends with the sampler; one that blocks ends with the process.
fn run(mut collector: Box<dyn Collector>, signal: &Signal, latest: &Mutex<Option<Arc<Reading>>>) {
    let mut seen = 0;
    let mut discovered: Option<Instant> = None;
    loop {
        let began = Instant::now();
        if discovered.is_none_or(|at| began.duration_since(at) >= limits::DISCOVERY) {
            collector.discover();
            discovered = Some(began);
        }
        let mut batch = Batch::default();
        collector.collect(&mut batch);
        let ended = Instant::now();
        *latest.lock() = Some(Arc::new(Reading::new(batch, ended)));
        if !signal.wait(ended, &mut seen) {
            return;
        }
    }
}

/// Takes the values of the node. Each collector has a thread of its own.
pub struct Sampler {
    signal: Arc<Signal>,
    workers: Vec<Worker>,
}

impl std::fmt::Debug for Sampler {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Sampler").field("collectors", &self.workers.len()).finish_non_exhaustive()
    }
}

impl Sampler {
    /// Starts the collectors; `period` is the time between two samples.
    #[must_use]
    pub fn new(roots: &Roots, period: Duration) -> Self {
        let mut all = collectors(roots, disk::space_of(), clock::probe());
        all.push(Box::new(nvml::Nvidia::default()));
        Self::with(all, period)
    }

    pub(super) fn with(collectors: Vec<Box<dyn Collector>>, period: Duration) -> Self {
        let wanted = Wanted { samples: 0, period, stopped: false };
        let signal = Arc::new(Signal { state: Mutex::new(wanted), wake: Condvar::new() });
        let spawn = |collector| Worker::spawn(collector, Arc::clone(&signal));
        let workers = collectors.into_iter().map(spawn).collect();
        Self { signal, workers }
    }

    /// The newest values of all collectors, at most three periods old. Never blocks. It also asks
    /// the collectors for the values of the next sample, so the first samples may be incomplete.
    #[must_use]
    pub fn sample(&self, now: Instant) -> Sample {
        let period = self.signal.state.lock().period;
        let slots = self.workers.iter().map(|worker| worker.slot(now, period)).collect();
        self.signal.state.lock().samples += 1;
        self.signal.wake.notify_all();
        Sample { slots }
    }

    /// Changes the time between two samples.
    pub fn set_period(&self, period: Duration) {
        self.signal.state.lock().period = period;
        self.signal.wake.notify_all();
    }
}

impl Drop for Sampler {
    fn drop(&mut self) {
        self.signal.state.lock().stopped = true;
        self.signal.wake.notify_all();
    }
}
