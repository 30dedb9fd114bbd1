//! What waits for one copy: at most one write, with everything that came since the last one.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use blaze_domain::config::Key;
use blaze_domain::config::state::State;
use parking_lot::Mutex;
use tokio::sync::{Notify, watch};
use tokio::time::Instant;

use super::copies::{Changed, Counts, Update};
use super::{Notes, Position};

/// Keys that a slot remembers as changed; beyond that everything is written.
pub(super) const MAX_KEYS: usize = 10_000;

/// What waits for one copy.
pub(super) struct Slot {
    pub(super) place: String,
    pub(super) waiting: Mutex<Waiting>,
    pub(super) wake: Notify,
    /// Somebody waits for it: no rest now.
    pub(super) hurry: Notify,
    /// Updates that were stored.
    pub(super) stored: AtomicU64,
    /// Of these, how many the copy holds.
    pub(super) done: watch::Sender<u64>,
    pub(super) written: AtomicU64,
    pub(super) failed: AtomicU64,
    pub(super) coalesced: AtomicU64,
    pub(super) error: Mutex<Option<String>>,
}

pub(super) struct Waiting {
    pub(super) next: Option<Next>,
    /// Since when what is being written just now has waited.
    pub(super) in_hand: Option<Instant>,
    /// The newest, for a write of everything.
    pub(super) notes: Arc<Notes>,
}

/// One write that is to be done.
pub(super) struct Next {
    /// How many updates are in it, with all before.
    pub(super) number: u64,
    /// When the first of them was stored.
    pub(super) since: Instant,
    pub(super) position: Position,
    pub(super) state: State,
    pub(super) notes: Arc<Notes>,
    pub(super) have_notes_changed: bool,
    /// None: everything.
    pub(super) keys: Option<BTreeSet<Key>>,
}

impl Next {
    pub(super) fn merge_keys(&mut self, changed: &Changed) {
        match (changed, &mut self.keys) {
            (Changed::Keys(new), Some(keys)) => keys.extend(new.iter().cloned()),
            (Changed::All, keys) => *keys = None,
            (Changed::Keys(_), None) => {}
        }
        if self.keys.as_ref().is_some_and(|keys| keys.len() > MAX_KEYS) {
            self.keys = None;
        }
    }
}

impl Slot {
    pub(super) fn new(place: String, notes: &Arc<Notes>) -> Self {
        Self {
            place,
            waiting: Mutex::new(Waiting {
                next: None,
                in_hand: None,
                notes: Arc::clone(notes),
            }),
            wake: Notify::new(),
            hurry: Notify::new(),
            stored: AtomicU64::new(0),
            done: watch::Sender::new(0),
            written: AtomicU64::new(0),
            failed: AtomicU64::new(0),
            coalesced: AtomicU64::new(0),
            error: Mutex::new(None),
        }
    }

    pub(super) fn put(&self, update: &Update) {
        let mut waiting = self.waiting.lock();
        if let Some(notes) = &update.notes {
            waiting.notes = Arc::clone(notes);
        }
        let before = waiting.next.take();
        if before.is_some() {
            self.coalesced.fetch_add(1, Ordering::Relaxed);
        }
        let (keys, had_notes, since) = before.map_or((Some(BTreeSet::new()), false, Instant::now()), |next| {
            (next.keys, next.have_notes_changed, next.since)
        });
        let mut next = Next {
            number: self.stored.fetch_add(1, Ordering::AcqRel) + 1,
            since,
            position: update.position.clone(),
            state: update.state.clone(),
            notes: Arc::clone(&waiting.notes),
            have_notes_changed: had_notes || update.notes.is_some(),
            keys,
        };
        next.merge_keys(&update.changed);
        waiting.next = Some(next);
        drop(waiting);
        self.wake.notify_one();
    }

    /// What is to be written now.
    pub(super) fn take(&self) -> Option<Next> {
        let mut waiting = self.waiting.lock();
        let next = waiting.next.take();
        waiting.in_hand = next.as_ref().map(|next| next.since);
        next
    }

    /// The copy holds so many updates, or something newer.
    pub(super) fn finish(&self, number: u64) {
        self.waiting.lock().in_hand = None;
        self.done.send_replace(number);
    }

    /// A write that failed waits again, unless a newer one does: that one is then to write everything anyway.
    pub(super) fn put_back(&self, next: Next) {
        let mut waiting = self.waiting.lock();
        waiting.in_hand = None;
        if let Some(newer) = &mut waiting.next {
            newer.since = next.since;
            self.coalesced.fetch_add(1, Ordering::Relaxed);
        } else {
            waiting.next = Some(next);
        }
    }

    /// How long something has been waiting to be in the copy.
    pub(super) fn lag(&self) -> Duration {
        let waiting = self.waiting.lock();
        let since = waiting.in_hand.or(waiting.next.as_ref().map(|next| next.since));
        since.map_or(Duration::ZERO, |since| since.elapsed())
    }

    /// Whether the copy holds all that was stored.
    pub(super) fn is_current(&self) -> bool {
        *self.done.borrow() >= self.stored.load(Ordering::Acquire)
    }

    pub(super) fn counts(&self) -> Counts {
        let number = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        Counts {
            place: self.place.clone(),
            written: number(&self.written),
            failed: number(&self.failed),
            coalesced: number(&self.coalesced),
            is_current: self.is_current(),
            error: self.error.lock().clone(),
        }
    }
}
