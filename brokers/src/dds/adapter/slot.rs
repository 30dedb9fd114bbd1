//! DDS writers of topics: made by the lifecycle thread, written by the sender, gone a while after
//! their last user.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use blaze_domain::{DropReason, WriterId};
use parking_lot::Mutex;

use super::Topic;
use crate::dds::{Profile, Writer, Written};

/// How long a new writer waits for its first reader: discovery takes that long where there is one.
const MEET: Duration = Duration::from_millis(300);
/// How long after the first reader was found samples may not reach it, since it has not found the
/// writer.
const SETTLE: Duration = Duration::from_millis(20);
/// How long a writer stands before it takes over from another: the readers have found it by then.
const STANDS: Duration = Duration::from_millis(100);
/// How long a writer stays after its last user at least, and at most while readers have not
/// acknowledged.
const LINGER: Duration = Duration::from_millis(300);
const LONGEST_LINGER: Duration = Duration::from_secs(5);

/// Samples that wait for the event loop of RustDDS: it keeps so many of best-effort writers.
const SMALL_DEPTH: u16 = 256;
/// The same where they may be large.
const LARGE_DEPTH: u16 = 16;
/// Samples of a reliable writer that some reader has not acknowledged.
const SMALL_WINDOW: u16 = 8192;
/// The same where they may be large.
const LARGE_WINDOW: u16 = 64;

/// Which writer.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct SlotKey {
    pub(super) topic: Topic,
    pub(super) reliable: bool,
    pub(super) large: bool,
    /// Samples for late joiners; 0 = volatile.
    pub(super) depth: u16,
    /// Of transient_local topics each origin has a writer of its own.
    pub(super) origin: Option<WriterId>,
}

impl SlotKey {
    /// What its writer offers.
    pub(super) fn profile(&self) -> Profile {
        let (depth, window) =
            if self.large { (LARGE_DEPTH, LARGE_WINDOW) } else { (SMALL_DEPTH, SMALL_WINDOW) };
        Profile {
            reliable: self.reliable,
            depth: if self.depth > 0 { self.depth } else { depth },
            transient_local: self.depth > 0,
            window: if self.reliable { window } else { 0 },
            timing: self.topic.timing,
        }
    }
}

/// What became of a message at its writer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Attempt {
    /// RustDDS has it, or nobody reads the topic.
    Done,
    /// Try again in a moment.
    NotNow,
    /// It is dropped.
    Dropped(DropReason),
}

#[derive(Default)]
struct State {
    writer: Option<Arc<Writer>>,
    made: Option<Instant>,
    matched: Option<Instant>,
    settled: bool,
    full_since: Option<Instant>,
}

/// One writer, or the wish for one.
pub(super) struct Slot {
    pub(super) key: SlotKey,
    state: Mutex<State>,
    retired: Arc<Retired>,
}

/// Writers without users, which go in a while.
#[derive(Default)]
struct Retired(Mutex<Vec<(Arc<Writer>, Instant)>>);

impl Drop for Slot {
    fn drop(&mut self) {
        if let Some(writer) = self.state.get_mut().writer.take() {
            self.retired.0.lock().push((writer, Instant::now()));
        }
    }
}

impl Slot {
    /// Writes a sample, if its writer is there and can take it.
    pub(super) fn write(
        &self,
        now: Instant,
        write: impl FnOnce(&Writer) -> Result<Written, DropReason>,
    ) -> Attempt {
        let mut state = self.state.lock();
        let state = &mut *state;
        let Some(writer) = &state.writer else {
            return Attempt::NotNow;
        };
        if !state.settled {
            let age = |at: Option<Instant>| {
                at.map_or(Duration::ZERO, |at| now.saturating_duration_since(at))
            };
            if state.matched.is_none() && writer.is_matched() {
                state.matched = Some(now);
            }
            if age(state.matched) < SETTLE && age(state.made) < MEET {
                return Attempt::NotNow;
            }
            state.settled = true;
        }
        match write(writer) {
            Ok(Written::Taken(_) | Written::NoReader) => {
                state.full_since = None;
                Attempt::Done
            }
            Ok(Written::Full) => {
                state.full_since.get_or_insert(now);
                Attempt::NotNow
            }
            Ok(Written::Failed) => Attempt::Dropped(DropReason::BrokerError),
            Err(reason) => Attempt::Dropped(reason),
        }
    }

    pub(super) fn needs_writer(&self) -> bool {
        self.state.lock().writer.is_none()
    }

    pub(super) fn put(&self, writer: Writer, now: Instant) {
        *self.state.lock() =
            State { writer: Some(Arc::new(writer)), made: Some(now), ..State::default() };
    }

    /// Whether its writer stands, and has met so many readers, where that takes less than `limit`.
    pub(super) fn has_met(&self, readers: usize, now: Instant, limit: Duration) -> bool {
        let state = self.state.lock();
        let (Some(writer), Some(made)) = (&state.writer, state.made) else { return false };
        let age = now.saturating_duration_since(made);
        may_take_over(age, limit, || writer.has_met(readers))
    }

    /// Since when its window has been full.
    pub(super) fn full_since(&self) -> Option<Instant> {
        self.state.lock().full_since
    }
}

/// All slots of one broker.
#[derive(Default)]
pub(super) struct Slots {
    all: Mutex<HashMap<SlotKey, Weak<Slot>>>,
    retired: Arc<Retired>,
}

impl Slots {
    /// The slot of a writer; all who want the same one share it.
    pub(super) fn get(&self, key: SlotKey) -> Arc<Slot> {
        let mut all = self.all.lock();
        if let Some(slot) = all.get(&key).and_then(Weak::upgrade) {
            return slot;
        }
        let slot = Arc::new(Slot {
            key: key.clone(),
            state: Mutex::default(),
            retired: Arc::clone(&self.retired),
        });
        all.insert(key, Arc::downgrade(&slot));
        slot
    }

    /// Those that are used.
    pub(super) fn live(&self) -> Vec<Arc<Slot>> {
        let mut all = self.all.lock();
        all.retain(|_, slot| slot.strong_count() > 0);
        let live = all.values().filter_map(Weak::upgrade).collect();
        // A slot whose last other user goes now must not end while the list is locked.
        drop(all);
        live
    }

    /// Whether readers have acknowledged all that was written.
    pub(super) fn are_acknowledged(&self) -> bool {
        let writers: Vec<Arc<Writer>> = {
            let live = self.live();
            let current = live.iter().filter_map(|slot| slot.state.lock().writer.clone());
            current
                .chain(self.retired.0.lock().iter().map(|(writer, _)| Arc::clone(writer)))
                .collect()
        };
        writers.iter().all(|writer| writer.is_acknowledged())
    }

    /// Takes out the writers whose time is over.
    pub(super) fn take_gone(&self, now: Instant) -> Vec<Arc<Writer>> {
        let mut retired = self.retired.0.lock();
        let (gone, stays): (Vec<_>, Vec<_>) =
            std::mem::take(&mut *retired).into_iter().partition(|(writer, at)| {
                may_go(now.saturating_duration_since(*at), || writer.is_acknowledged())
            });
        *retired = stays;
        gone.into_iter().map(|(writer, _)| writer).collect()
    }

    /// Takes out all writers, whose participant has died.
    pub(super) fn take_all(&self) -> Vec<Arc<Writer>> {
        let live = self.live();
        let mut writers: Vec<Arc<Writer>> =
            live.iter().filter_map(|slot| std::mem::take(&mut *slot.state.lock()).writer).collect();
        writers.extend(self.retired.0.lock().drain(..).map(|(writer, _)| writer));
        writers
    }
}

/// Whether a writer without users may go, this long after the last one.
fn may_go(passed: Duration, is_acknowledged: impl FnOnce() -> bool) -> bool {
    passed >= LONGEST_LINGER || (passed >= LINGER && is_acknowledged())
}

/// Whether a writer of this age may take over from another.
fn may_take_over(age: Duration, limit: Duration, has_met: impl FnOnce() -> bool) -> bool {
    age >= limit || (age >= STANDS && has_met())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_writer_takes_over_when_readers_have_found_it_or_after_a_while() {
        let limit = Duration::from_secs(2);
        assert!(!may_take_over(Duration::from_millis(99), limit, || true));
        assert!(may_take_over(STANDS, limit, || true));
        assert!(!may_take_over(Duration::from_millis(1_999), limit, || false));
        assert!(may_take_over(limit, limit, || false));
    }

    #[test]
    fn a_writer_waits_for_readers_but_not_for_ever() {
        let before = |limit: Duration| limit - Duration::from_millis(1);
        assert!(!may_go(before(LINGER), || true), "it may be wanted again at once");
        assert!(may_go(LINGER, || true));
        assert!(!may_go(LINGER, || false), "what a reader lacks is still repaired");
        assert!(!may_go(before(LONGEST_LINGER), || false));
        assert!(may_go(LONGEST_LINGER, || false));
    }
}
