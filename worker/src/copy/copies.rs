//! Writes the newest state to every copy, each at its own pace.
//!
//! ```text
//! store(update) ──▶ slot of the file     ──▶ task ──▶ replace, at most a fifth of the time unless it is urgent
//!               └─▶ slot of the database ──▶ task ──▶ replace, likewise
//! could not be read at the start ─▶ task: load until it can be ──▶ Found ──▶ engine
//! ```
//!
//! A slot holds one update; a newer update replaces it. So a caller never waits, a copy that is
//! slow or away costs one state, and the newest state is written.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use blaze_domain::config::state::State;
use blaze_runtime::{Supervisor, TaskPolicy};
use parking_lot::Mutex;
use tokio::sync::{Notify, mpsc, oneshot, watch};
use tokio::time::Instant;

use super::{CopyError, Loaded, LocalCopy, Notes, Position};

/// Bounds of the pause after a failure; the pause is drawn from zero to the bound, which doubles.
const PAUSE: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(30));
/// A copy rests this many times as long as the write took, between these bounds: each write is of
/// all documents, which costs processor time and wears out flash memory.
const REST: u32 = 4;
const REST_BOUNDS: (Duration, Duration) = (Duration::from_millis(200), Duration::from_secs(10));
/// A copy with at most so many documents rests no longer than this: a state within the rest is lost
/// with the power.
const SMALL: (usize, Duration) = (1_000, Duration::from_secs(1));
/// Where only the time of the position moves on, a copy is written again when it is this old.
const MAX_AGE: Duration = Duration::from_secs(300);

/// A state that is to be kept.
#[derive(Debug, Clone)]
pub struct Update {
    /// How far it is.
    pub position: Position,
    /// The documents of the layer's view.
    pub state: State,
    /// The notes.
    pub notes: Arc<Notes>,
    /// Documents or notes differ from the last update; else only the time has moved on.
    pub has_changed: bool,
}

/// A copy, and what is known of it at the start.
#[derive(Clone)]
pub struct Target {
    /// The copy.
    pub copy: Arc<dyn LocalCopy>,
    /// What it holds is known, or that nobody here can read it; else it is read before anything is
    /// written.
    pub is_read: bool,
    /// Position of its content, if all copies hold the same notes.
    pub written: Option<Position>,
}

/// What a copy holds that was not known at the start.
#[derive(Debug)]
pub struct Found {
    /// Which copy.
    pub place: String,
    /// What it holds; perhaps something newer than what is served.
    pub loaded: Loaded,
    /// Another worker of the layer has written it meanwhile; else nobody knew what it holds.
    pub is_of_another: bool,
    /// To be told once that is taken into account: only then the copy is written.
    pub taken: oneshot::Sender<()>,
}

/// What became of the updates, since the start.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Counts {
    /// Which copy.
    pub place: String,
    /// Writes that were done.
    pub written: u64,
    /// Writes that failed; each is tried again, then with the newest state.
    pub failed: u64,
    /// Whether the copy holds all that it should: what was stored, and nothing is owed.
    pub is_current: bool,
}

/// Keeps the copies up to date. Clones share them.
#[derive(Clone)]
pub struct Copies {
    slots: Arc<[Arc<Slot>]>,
    /// Something is known already that is to be stored later.
    owed: Arc<AtomicBool>,
    /// Whether the main service answers.
    answers: watch::Sender<bool>,
}

/// What waits for one copy, and what became of it.
#[derive(Default)]
struct Slot {
    place: String,
    next: Mutex<Option<Update>>,
    wake: Notify,
    /// Somebody waits for it: no rest now.
    hurry: Notify,
    /// Updates that were stored.
    stored: AtomicU64,
    /// Of these, how many the copy holds.
    done: watch::Sender<u64>,
    written: AtomicU64,
    failed: AtomicU64,
}

impl Slot {
    fn put(&self, update: &Update) {
        let mut update = update.clone();
        let mut next = self.next.lock();
        update.has_changed |= next.take().is_some_and(|before| before.has_changed);
        *next = Some(update);
        self.stored.fetch_add(1, Ordering::AcqRel);
        drop(next);
        self.wake.notify_one();
    }

    /// What is to be written now, and how many updates are in it.
    fn take(&self) -> Option<(Update, u64)> {
        let mut next = self.next.lock();
        Some((next.take()?, self.stored.load(Ordering::Acquire)))
    }

    /// A write that failed waits again, unless a newer one does.
    fn put_back(&self, update: Update) {
        let mut next = self.next.lock();
        match &mut *next {
            Some(newer) => newer.has_changed = true,
            None => *next = Some(update),
        }
    }

    /// Whether the copy holds all that was stored.
    fn is_current(&self) -> bool {
        *self.done.borrow() >= self.stored.load(Ordering::Acquire)
    }

    fn counts(&self) -> Counts {
        let number = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        Counts {
            place: self.place.clone(),
            written: number(&self.written),
            failed: number(&self.failed),
            is_current: self.is_current(),
        }
    }
}

impl Copies {
    /// Starts one task per copy. `found` takes what is read later.
    #[must_use]
    pub fn start(
        supervisor: &Supervisor,
        targets: Vec<Target>,
        found: &mpsc::Sender<Found>,
    ) -> Self {
        let answers = watch::Sender::new(false);
        let start = |target: Target| {
            let place = target.copy.describe();
            let slot = Arc::new(Slot { place, ..Slot::default() });
            let writer = Writer {
                copy: target.copy,
                slot: Arc::clone(&slot),
                found: found.clone(),
                is_read: target.is_read,
                is_overtaken: false,
                main_answers: answers.subscribe(),
                failures: 0,
                written: target.written,
            };
            let stop = supervisor.shutdown_token();
            supervisor.spawn(
                format!("copy to {}", slot.place),
                TaskPolicy::Essential,
                async move {
                    tokio::select! {
                        () = writer.run() => {}
                        () = stop.cancelled() => {}
                    }
                },
            );
            slot
        };
        Self { slots: targets.into_iter().map(start).collect(), owed: Arc::default(), answers }
    }

    /// Says whether the main service answers: what a copy holds that is newer than what is served
    /// is read only while it does not.
    pub fn set_main_answers(&self, answers: bool) {
        self.answers.send_if_modified(|before| std::mem::replace(before, answers) != answers);
    }

    /// Says whether something is known that is to be stored later: until then no copy counts as
    /// current.
    pub fn owe(&self, is_owed: bool) {
        self.owed.store(is_owed, Ordering::Release);
    }

    /// Has a state written to every copy, when it can be. Never waits.
    pub fn store(&self, update: &Update) {
        for slot in &*self.slots {
            slot.put(update);
        }
    }

    /// Ends the rest of every copy that is behind.
    pub fn hurry(&self) {
        for slot in self.slots.iter().filter(|slot| !slot.is_current()) {
            slot.hurry.notify_one();
        }
    }

    /// Waits until every copy holds what was stored before, at most so long. Gives whether they do.
    /// Those that rest are woken.
    pub async fn flush(&self, limit: Duration) -> bool {
        let all = async {
            self.hurry();
            for slot in &*self.slots {
                let stored = slot.stored.load(Ordering::Acquire);
                // The sender lives as long as the slot.
                let _ = slot.done.subscribe().wait_for(|done| *done >= stored).await;
            }
        };
        tokio::time::timeout(limit, all).await.is_ok()
    }

    /// What became of the updates, by copy.
    #[must_use]
    pub fn counts(&self) -> Vec<Counts> {
        // Before the slots: whoever stores does so first, and then owes nothing more.
        let is_owed = self.owed.load(Ordering::Acquire);
        let counts = self.slots.iter().map(|slot| slot.counts());
        counts
            .map(|counts| Counts { is_current: counts.is_current && !is_owed, ..counts })
            .collect()
    }
}

/// The task of one copy.
struct Writer {
    copy: Arc<dyn LocalCopy>,
    slot: Arc<Slot>,
    found: mpsc::Sender<Found>,
    /// What the copy holds is known, or newer than nothing that is served.
    is_read: bool,
    /// Another worker of the layer has written something newer, which is not read yet.
    is_overtaken: bool,
    main_answers: watch::Receiver<bool>,
    failures: u32,
    /// What it was last written with; none after a failure.
    written: Option<Position>,
}

impl Writer {
    async fn run(mut self) {
        loop {
            if !self.is_read {
                self.read(false).await;
            }
            // While the main service answers it tells the same, and a worker that is always second
            // would read all for each change.
            if self.is_overtaken && !*self.main_answers.borrow_and_update() {
                self.read(true).await;
            }
            match self.slot.take() {
                None => tokio::select! {
                    () = self.slot.wake.notified() => {}
                    Ok(()) = self.main_answers.changed(), if self.is_overtaken => {}
                },
                Some((next, number)) => self.write(next, number).await,
            }
        }
    }

    /// Reads what is there, as soon as that can be done, and has it taken into account: it may be
    /// newer than what is served, and then is not to be written over.
    async fn read(&mut self, is_of_another: bool) {
        loop {
            match self.copy.load().await {
                Ok(None) => break,
                Ok(Some(loaded)) => {
                    self.recovered();
                    let (taken, is_taken) = oneshot::channel();
                    let place = self.slot.place.clone();
                    let found = Found { place, loaded, is_of_another, taken };
                    // Nobody is there only at the end.
                    let _ = self.found.send(found).await;
                    let _ = is_taken.await;
                    break;
                }
                // What becomes of it is for the first write to decide.
                Err(error) if error.is_unreadable() => break,
                Err(error) => {
                    let pause = self.failed(&error);
                    self.pause(pause).await;
                }
            }
        }
        self.is_read = true;
        self.is_overtaken = false;
        self.recovered();
    }

    /// Writes, and rests.
    async fn write(&mut self, next: Update, number: u64) {
        if self.is_spared(&next) {
            self.slot.done.send_replace(number);
            return;
        }
        let began = Instant::now();
        let whole = Loaded {
            position: next.position.clone(),
            documents: next.state.all().map(|(_, held)| Arc::clone(&held.document)).collect(),
            notes: Arc::clone(&next.notes),
        };
        let written = self.copy.replace(&whole).await;
        self.is_overtaken = matches!(written, Err(CopyError::Newer { .. }));
        self.written = written.is_ok().then_some(whole.position);
        match written {
            Ok(()) => {
                self.slot.written.fetch_add(1, Ordering::Relaxed);
                self.recovered();
                self.slot.done.send_replace(number);
                let is_small = whole.documents.len() <= SMALL.0;
                let most = if is_small { SMALL.1 } else { REST_BOUNDS.1 };
                self.pause((began.elapsed() * REST).clamp(REST_BOUNDS.0, most)).await;
            }
            // Another process of this layer writes it and has newer documents; notes of this one
            // come with its next write.
            Err(CopyError::Newer { .. }) => {
                self.slot.done.send_replace(number);
            }
            Err(error) => {
                self.slot.put_back(next);
                let pause = self.failed(&error);
                self.pause(pause).await;
            }
        }
    }

    /// Waits, unless somebody waits for this copy.
    async fn pause(&self, pause: Duration) {
        tokio::select! {
            () = tokio::time::sleep(pause) => {}
            () = self.slot.hurry.notified() => {}
        }
    }

    /// Whether a write is spared that is for the time alone, which moves on every few seconds.
    fn is_spared(&self, next: &Update) -> bool {
        let Some(written) = self.written.as_ref().filter(|_| !next.has_changed) else {
            return false;
        };
        let age_ms = next.position.as_of.as_millis().saturating_sub(written.as_of.as_millis());
        let is_same = (&written.store_id, written.revision)
            == (&next.position.store_id, next.position.revision);
        is_same && u128::from(age_ms.unsigned_abs()) < MAX_AGE.as_millis()
    }

    /// It can be used, whatever was the matter before.
    fn recovered(&mut self) {
        if std::mem::take(&mut self.failures) > 0 {
            tracing::info!(copy = self.slot.place, "the copy is there again");
        }
    }

    fn failed(&mut self, error: &CopyError) -> Duration {
        if let CopyError::Raced { .. } = error {
            tracing::debug!(%error, "the copy is written again");
            return rand::random_range(Duration::ZERO..=PAUSE.0);
        }
        self.slot.failed.fetch_add(1, Ordering::Relaxed);
        if self.failures == 0 {
            tracing::warn!(%error, "a copy of the configuration is not written; it is tried again");
        }
        let bound = PAUSE.0.saturating_mul(1 << self.failures.min(16)).min(PAUSE.1);
        self.failures = self.failures.saturating_add(1);
        rand::random_range(Duration::ZERO..=bound)
    }
}

#[cfg(test)]
#[path = "copies_tests.rs"]
mod tests;
