//! Writes the newest state to every copy, each at its own pace.
//!
//! ```text
//! store(update) ──▶ slot of the database ──▶ task ──▶ advance, or replace after a failure
//!               └─▶ slot of the file     ──▶ task ──▶ replace, at most a fifth of the time, and once a second
//!                                                      at most while the database keeps up
//! could not be read at the start ─▶ task: load until it can be ──▶ Found ──▶ engine
//! ```
//!
//! A slot holds one update: a newer one is merged into it and counted. So whoever stores never waits, a copy that is slow or
//! away costs one state and the keys that changed since, and what is written is always the newest.

use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use blaze_domain::config::Key;
use blaze_domain::config::state::State;
use blaze_runtime::{Supervisor, TaskPolicy};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::Instant;

use super::slot::{Next, Slot};
use super::{CopyError, Loaded, LocalCopy, Notes, Position};

/// Bounds of the pause after a failure; the pause is drawn from zero to the bound, which doubles.
const PAUSE: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(30));
/// A copy that always writes everything rests this many times as long as the write took, between these bounds.
const REST: u32 = 4;
const REST_BOUNDS: (Duration, Duration) = (Duration::from_millis(50), Duration::from_secs(10));

/// It rests at least so long while another copy keeps up, and so may be this old when that one is lost: to write all documents for each change of one wears out
/// flash memory, and is most of what a change costs a worker that it does not concern.
const REST_BESIDE: Duration = Duration::from_secs(1);
/// A copy keeps up that holds what was stored so long ago: what comes later is on its way there.
const KEEPS_UP: Duration = Duration::from_millis(100);

/// Where only the time of the position moves on, such a copy is written again when it is this old.
const MAX_AGE: Duration = Duration::from_secs(300);

/// What changed since the last update.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Changed {
    /// Perhaps everything: a snapshot, another store.
    All,
    /// These documents: they are new, other ones, or gone.
    Keys(Vec<Key>),
}

/// A state that is to be kept.
#[derive(Debug, Clone)]
pub struct Update {
    /// How far it is.
    pub position: Position,
    /// The documents of the layer's view.
    pub state: State,
    /// What is new in it.
    pub changed: Changed,
    /// The notes, if they changed.
    pub notes: Option<Arc<Notes>>,
}

/// A copy, and what is known of it at the start.
#[derive(Clone)]
pub struct Target {
    /// The copy.
    pub copy: Arc<dyn LocalCopy>,
    /// It holds what the first update is counted from; else the first write is everything.
    pub is_current: bool,
    /// What it holds is known, or that nobody here can read it; else it is read before anything is written.
    pub is_read: bool,
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
    /// Updates that were merged into one that waited.
    pub coalesced: u64,
    /// Whether the copy holds all that it should: what was stored, and nothing is owed.
    pub is_current: bool,
    /// Why the last write failed; none once one was done again.
    pub error: Option<String>,
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

impl Copies {
    /// Starts one task per copy. `notes` are those that the copies were started from; `found` takes what is read later.
    #[must_use]
    pub fn start(
        supervisor: &Supervisor,
        targets: Vec<Target>,
        notes: &Arc<Notes>,
        found: &mpsc::Sender<Found>,
    ) -> Self {
        let slot = |target: &Target| Arc::new(Slot::new(target.copy.describe(), notes));
        let slots: Arc<[Arc<Slot>]> = targets.iter().map(slot).collect();
        let answers = watch::Sender::new(false);
        for (target, slot) in targets.into_iter().zip(&*slots) {
            let name = format!("copy to {}", slot.place);
            let (stop, writer) = (
                supervisor.shutdown_token(),
                Writer::new(
                    target,
                    Arc::clone(slot),
                    Arc::clone(&slots),
                    found.clone(),
                    answers.subscribe(),
                ),
            );
            supervisor.spawn(name, TaskPolicy::Essential, async move {
                tokio::select! {
                    () = writer.run() => {}
                    () = stop.cancelled() => {}
                }
            });
        }
        Self {
            slots,
            owed: Arc::default(),
            answers,
        }
    }

    /// Says whether the main service answers: what a copy holds that is newer than what is served is read only while it does not.
    pub fn set_main_answers(&self, answers: bool) {
        self.answers
            .send_if_modified(|before| std::mem::replace(before, answers) != answers);
    }

    /// Says whether something is known that is to be stored later: until then no copy counts as current.
    pub fn owe(&self, is_owed: bool) {
        self.owed.store(is_owed, Ordering::Release);
    }

    /// Has a state written to every copy, when it can be. Never waits.
    pub fn store(&self, update: &Update) {
        for slot in &*self.slots {
            slot.put(update);
        }
    }

    /// Waits until every copy holds what was stored before, at most so long. Gives whether they do. Those that rest are woken.
    pub async fn flush(&self, limit: Duration) -> bool {
        let all = async {
            for slot in &*self.slots {
                if !slot.is_current() {
                    slot.hurry.notify_one();
                }
            }
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
            .map(|counts| Counts {
                is_current: counts.is_current && !is_owed,
                ..counts
            })
            .collect()
    }
}

impl fmt::Debug for Copies {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.counts()).finish()
    }
}

/// The task of one copy.
struct Writer {
    copy: Arc<dyn LocalCopy>,
    slot: Arc<Slot>,
    /// Of all copies, this one too.
    all: Arc<[Arc<Slot>]>,
    found: mpsc::Sender<Found>,
    /// What the copy holds is known, or newer than nothing that is served.
    is_read: bool,
    /// The copy holds what the next update is counted from.
    is_current: bool,
    /// Another worker of the layer has written something newer, which is not read yet.
    is_overtaken: bool,
    main_answers: watch::Receiver<bool>,
    failures: u32,
    /// What it was last written with.
    written: Option<Position>,
}

impl Writer {
    fn new(
        target: Target,
        slot: Arc<Slot>,
        all: Arc<[Arc<Slot>]>,
        found: mpsc::Sender<Found>,
        main_answers: watch::Receiver<bool>,
    ) -> Self {
        Self {
            copy: target.copy,
            slot,
            all,
            found,
            is_read: target.is_read,
            is_current: target.is_current,
            is_overtaken: false,
            main_answers,
            failures: 0,
            written: None,
        }
    }

    async fn run(mut self) {
        loop {
            if !self.is_read {
                self.read(false).await;
            }
            // While the main service answers it tells the same, and a worker that is always second would read all for each change.
            if self.is_overtaken && !*self.main_answers.borrow_and_update() {
                self.read(true).await;
            }
            match self.slot.take() {
                None => tokio::select! {
                    () = self.slot.wake.notified() => {}
                    Ok(()) = self.main_answers.changed(), if self.is_overtaken => {}
                },
                Some(next) => self.write_one(next).await,
            }
        }
    }

    /// Reads what is there, as soon as that can be done, and has it taken into account: it may be newer than what is served,
    /// and then is not to be written over.
    async fn read(&mut self, is_of_another: bool) {
        loop {
            match self.copy.load().await {
                Ok(None) => break,
                Ok(Some(loaded)) => {
                    self.recovered();
                    let (taken, is_taken) = oneshot::channel();
                    let place = self.slot.place.clone();
                    let found = Found {
                        place,
                        loaded,
                        is_of_another,
                        taken,
                    };
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

    /// Writes, and rests for as long as that one is to.
    async fn write_one(&mut self, next: Next) {
        if self.is_spared(&next) {
            self.slot.finish(next.number);
            return;
        }
        let began = Instant::now();
        let written = self.write(&next).await;
        self.is_current = written.is_ok();
        self.is_overtaken = matches!(written, Err(CopyError::Newer { .. }));
        match written {
            Ok(()) => {
                self.slot.written.fetch_add(1, Ordering::Relaxed);
                self.recovered();
                self.slot.finish(next.number);
                self.written = Some(next.position);
                if self.copy.writes_whole() {
                    self.rest(began).await;
                }
            }
            // Another process of this layer writes it and has newer documents; notes of this one come with its next write.
            Err(CopyError::Newer { .. }) => {
                self.slot.finish(next.number);
            }
            Err(error) => {
                self.slot.put_back(next);
                let pause = self.failed(&error);
                self.pause(pause).await;
            }
        }
    }

    /// How long a copy rests that always writes everything. By time alone: whether another one holds the newest at this very
    /// instant is chance.
    async fn rest(&self, began: Instant) {
        let wrote = Instant::now();
        let rest = ((wrote - began) * REST).clamp(REST_BOUNDS.0, REST_BOUNDS.1);
        let mut is_over = self.pause(rest).await;
        while !is_over && wrote.elapsed() < REST_BESIDE && self.another_keeps_up() {
            is_over = self.pause(REST_BOUNDS.0).await;
        }
    }

    fn another_keeps_up(&self) -> bool {
        let mut others = self.all.iter().filter(|slot| !Arc::ptr_eq(slot, &self.slot));
        others.any(|slot| slot.error.lock().is_none() && slot.lag() < KEEPS_UP)
    }

    /// Waits, unless somebody waits for this copy; returns whether somebody does.
    async fn pause(&self, pause: Duration) -> bool {
        tokio::select! {
            () = tokio::time::sleep(pause) => false,
            () = self.slot.hurry.notified() => true,
        }
    }

    /// Whether a copy that always writes everything is spared a write for the time alone, which moves on every few seconds.
    fn is_spared(&self, next: &Next) -> bool {
        let has_same = !next.have_notes_changed && next.keys.as_ref().is_some_and(BTreeSet::is_empty);
        let is_young = |written: &Position| {
            let age_ms = next
                .position
                .as_of
                .as_millis()
                .saturating_sub(written.as_of.as_millis());
            let is_same = (&written.store_id, written.revision) == (&next.position.store_id, next.position.revision);
            is_same && u128::from(age_ms.unsigned_abs()) < MAX_AGE.as_millis()
        };
        self.copy.writes_whole() && self.is_current && has_same && self.written.as_ref().is_some_and(is_young)
    }

    async fn write(&self, next: &Next) -> Result<(), CopyError> {
        if let Some(keys) = next
            .keys
            .as_ref()
            .filter(|_| self.is_current && !self.copy.writes_whole())
        {
            let document = |key: &Key| next.state.get(key).map(|held| Arc::clone(&held.document));
            let puts: Vec<_> = keys.iter().filter_map(document).collect();
            let is_gone = |key: &&Key| next.state.get(key).is_none();
            let removes: Vec<Key> = keys.iter().filter(is_gone).cloned().collect();
            let notes = next.have_notes_changed.then_some(&*next.notes);
            match self.copy.advance(&next.position, &puts, &removes, notes).await {
                // It has lost what it had, or never had it: no failure yet.
                Err(CopyError::Behind { .. }) => {}
                advanced => return advanced,
            }
        }
        let whole = Loaded {
            position: next.position.clone(),
            documents: next.state.all().map(|(_, held)| Arc::clone(&held.document)).collect(),
            notes: Arc::clone(&next.notes),
        };
        self.copy.replace(&whole).await
    }

    /// It can be used, whatever was the matter before.
    fn recovered(&mut self) {
        let slot = &self.slot;
        if slot.error.lock().take().is_some() {
            tracing::info!(copy = slot.place, failures = self.failures, "the copy is there again");
        }
        self.failures = 0;
    }

    fn failed(&mut self, error: &CopyError) -> Duration {
        let slot = &self.slot;
        slot.failed.fetch_add(1, Ordering::Relaxed);
        let text = error.to_string();
        let told = slot.error.lock().replace(text.clone());
        if told.is_none() {
            tracing::warn!(
                error = text,
                "a copy of the configuration is not written; it is tried again"
            );
        }
        let bound = PAUSE.0.saturating_mul(1 << self.failures.min(16)).min(PAUSE.1);
        self.failures = self.failures.saturating_add(1);
        rand::random_range(Duration::ZERO..=bound)
    }
}

#[cfg(test)]
#[path = "copies_tests.rs"]
mod tests;
