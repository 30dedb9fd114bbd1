//! A reader and the thread that empties it.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use bytes::Bytes;
use rustdds::dds::ReadResult;

use super::participant::{RawReader, prefix_of};
use super::sample::Cdr;
use super::{DdsError, GuidPrefix, create_error};
use crate::wake::unpark_waker;

/// A sample, and what its writer says of it.
pub type Sample = rustdds::no_key::DeserializedCacheChange<Cdr>;

/// Takes each sample and returns whether it is well-formed. It runs in the reader's thread: while
/// it works, at most `depth` samples wait, then the oldest are lost.
pub type SampleSink = Box<dyn Fn(Sample) -> bool + Send>;

/// As [`SampleSink`], of the octets of a sample and the participant that wrote it.
pub type OctetsSink = Box<dyn Fn(GuidPrefix, Bytes) + Send>;

/// Hands the octets of samples to `sink`. A sample that is no sequence of octets is malformed.
pub(super) fn of_octets(sink: OctetsSink) -> SampleSink {
    Box::new(move |sample| {
        let octets = sample.sample.octets();
        let is_well_formed = octets.is_some();
        if let Some(octets) = octets {
            sink(prefix_of(sample.writer_guid), octets);
        }
        is_well_formed
    })
}

/// A safety net only: RustDDS wakes the thread.
const LONGEST_SLEEP: Duration = Duration::from_millis(250);

/// Reads one topic until it is dropped.
pub struct Reader {
    thread: StoppableThread,
    malformed: Arc<AtomicU64>,
}

impl Reader {
    pub(super) fn start(
        reader: RawReader,
        sink: SampleSink,
        failed: Arc<AtomicBool>,
    ) -> Result<Self, DdsError> {
        let malformed = Arc::<AtomicU64>::default();
        let counter = Arc::clone(&malformed);
        let thread = StoppableThread::start("dds-reader", failed, move |stop| {
            let waker = unpark_waker();
            while !stop.load(Ordering::Relaxed) {
                // Before it is emptied: what comes before a waker is set wakes nobody.
                reader.set_waker(Some(waker.clone()));
                drain(&reader, &sink, &counter);
                thread::park_timeout(LONGEST_SLEEP);
            }
        })?;
        Ok(Self { thread, malformed })
    }

    /// Samples that were malformed, and were dropped.
    #[must_use]
    pub fn malformed(&self) -> u64 {
        self.malformed.load(Ordering::Relaxed)
    }

    /// Whether its thread still runs.
    #[must_use]
    pub fn is_running(&self) -> bool {
        self.thread.is_running()
    }
}

/// Takes what is there.
fn drain(reader: &RawReader, sink: &SampleSink, malformed: &AtomicU64) {
    take_up_to(reader, usize::MAX, |taken| {
        // The encoding of an error is none of CDR.
        if !taken.is_ok_and(sink) {
            malformed.fetch_add(1, Ordering::Relaxed);
        }
    });
}

/// Takes samples as long as there are any, at most `limit`. Returns whether there may be more.
pub(crate) fn take_up_to(
    reader: &RawReader,
    limit: usize,
    mut sink: impl FnMut(ReadResult<Sample>),
) -> bool {
    reader.drain_read_notifications();
    for _ in 0..limit {
        match reader.try_take_one().transpose() {
            Some(taken) => sink(taken),
            None => return false,
        }
    }
    true
}

/// A named thread that is asked to stop and waited for on drop. A panic in it sets `failed`.
pub(super) struct StoppableThread {
    stop: Arc<AtomicBool>,
    handle: Option<JoinHandle<()>>,
    waited: bool,
}

impl StoppableThread {
    pub(super) fn start(
        name: &'static str,
        failed: Arc<AtomicBool>,
        body: impl FnOnce(&AtomicBool) + Send + 'static,
    ) -> Result<Self, DdsError> {
        let stop = Arc::<AtomicBool>::default();
        let flag = Arc::clone(&stop);
        let handle = thread::Builder::new()
            .name(name.to_owned())
            .spawn(move || {
                if catch_unwind(AssertUnwindSafe(|| body(&flag))).is_err() {
                    failed.store(true, Ordering::Relaxed);
                }
            })
            .map_err(create_error("thread"))?;
        Ok(Self { stop, handle: Some(handle), waited: true })
    }

    /// Is not waited for on drop: it may be in a long call of the system.
    pub(super) fn unwaited(mut self) -> Self {
        self.waited = false;
        self
    }

    pub(super) fn is_running(&self) -> bool {
        self.handle.as_ref().is_some_and(|handle| !handle.is_finished())
    }
}

impl Drop for StoppableThread {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(handle) = self.handle.take() {
            handle.thread().unpark();
            // A sink may own the reader that calls it.
            if self.waited && handle.thread().id() != thread::current().id() {
                // The body caught its own panic.
                let _ = handle.join();
            }
        }
    }
}
