//! What waits to be told: of each place the newest, and of each key how it should be.

use std::collections::{BTreeMap, BTreeSet};

use blaze_brokers::KeyedMessage;
use blaze_brokers::redis::KeyChange;
use blaze_domain::names::ChannelName;
use bytes::Bytes;

use super::{SpeakerCounts, Told};
use crate::lease::Mark;

/// Bytes of one transaction, unless one place alone has more (1 MiB): a large one over a slow
/// connection would not be done in the time that a call may take, and be tried again for ever.
pub(super) const BATCH_BYTES: usize = 1024 * 1024;

/// A notice that waits.
pub(super) struct Waiting {
    /// The key that must be written no later.
    key: Option<String>,
    pub(super) notice: KeyedMessage,
    /// State of the first notice of the place that the broker has not taken.
    since: Option<Mark>,
}

#[derive(Default)]
pub(super) struct State {
    /// All keys as they should be, to be written again when the server has lost them.
    wanted: BTreeMap<String, Bytes>,
    /// Keys that are not as they should be; those that are not wanted are to go.
    dirty: BTreeSet<String>,
    /// Places in the order in which they are told of; each stands here once, but for those that
    /// were set aside.
    pub(super) order: BTreeMap<i64, String>,
    pub(super) waiting: BTreeMap<String, (i64, Waiting)>,
    /// Of the last that was put at the end, and of the first.
    ends: (i64, i64),
    /// Keys are not told just now: their server does not answer.
    pub(super) keys_wait: bool,
    /// Keys of before are to be looked for: those of this worker that are not wanted are to go.
    pub(super) sweep: bool,
    /// Places with a notice on its way, and since which state they wait.
    pub(super) busy: BTreeMap<String, Option<Mark>>,
    /// State that notices are from; `None`: the broker may lack anything before them.
    pub(super) from: Option<Mark>,
    /// How often everything was forgotten.
    pub(super) cleared: u64,
    pub(super) counts: SpeakerCounts,
}

/// What is told at once.
pub(super) struct Batch {
    pub(super) keys: BTreeSet<String>,
    pub(super) waiting: Vec<(String, Waiting)>,
    /// How often everything had been forgotten when it was taken.
    cleared: u64,
}

impl Batch {
    pub(super) fn is_empty(&self) -> bool {
        self.keys.is_empty() && self.waiting.is_empty()
    }

    pub(super) fn len(&self) -> usize {
        self.keys.len() + self.waiting.len()
    }

    /// The same once its keys are as they should be, or never will be.
    pub(super) fn without_keys(mut self) -> Self {
        self.keys.clear();
        self
    }
}

impl State {
    /// Takes in what is newer than what waits of the same place; it is told at the end, so that the
    /// notices of a service come in the order of their revisions.
    pub(super) fn put(&mut self, told: Told) {
        let Told { place, key, notice } = told;
        let name = key.map(|(name, value)| {
            match value {
                Some(value) => self.wanted.insert(name.clone(), value),
                None => self.wanted.remove(&name),
            };
            self.dirty.insert(name.clone());
            name
        });
        let Some(notice) = notice else { return };
        let mut since = self.from.clone();
        if let Some((at, before)) = self.waiting.remove(&place) {
            self.order.remove(&at);
            self.counts.replaced += 1;
            since = before.since;
        }
        self.ends.1 += 1;
        self.order.insert(self.ends.1, place.clone());
        let key = name;
        self.waiting.insert(place, (self.ends.1, Waiting { key, notice, since }));
    }

    /// The first that wait, at most so many and, but for the first, so many bytes.
    pub(super) fn take(&mut self, most: usize) -> Batch {
        let mut batch = Batch { keys: BTreeSet::new(), waiting: Vec::new(), cleared: self.cleared };
        let mut bytes = 0;
        while batch.waiting.len() < most
            && (bytes < BATCH_BYTES || batch.is_empty())
            && let Some((_, place)) = self.order.pop_first()
        {
            let Some((_, waiting)) = self.waiting.remove(&place) else {
                continue;
            };
            bytes += waiting.notice.value.as_ref().map_or(0, Bytes::len);
            let key = waiting.key.as_ref().filter(|_| !self.keys_wait);
            if let Some(key) = key.and_then(|key| self.dirty.take(key)) {
                bytes += self.wanted.get(&key).map_or(0, Bytes::len);
                batch.keys.insert(key);
            }
            batch.waiting.push((place, waiting));
        }
        while !self.keys_wait
            && batch.len() < most
            && (bytes < BATCH_BYTES || batch.is_empty())
            && let Some(key) = self.dirty.pop_first()
        {
            bytes += self.wanted.get(&key).map_or(0, Bytes::len);
            batch.keys.insert(key);
        }
        let places = batch.waiting.iter();
        self.busy = places.map(|(place, waiting)| (place.clone(), waiting.since.clone())).collect();
        batch
    }

    /// Whether the broker has not taken the last notice of a place.
    pub(super) fn is_waiting(&self, place: &str) -> bool {
        self.waiting.contains_key(place) || self.busy.contains_key(place)
    }

    /// Lowest revision of this store among the notices that the broker has not taken; 0 if one is
    /// of another store. `aside`: with those that are set aside.
    pub(super) fn waits_since(&self, store_id: &str, aside: bool) -> Option<u64> {
        let waiting = self.waiting.values();
        let waiting = waiting.filter(|(at, _)| aside || self.order.contains_key(at));
        let all = waiting.map(|(_, waiting)| &waiting.since).chain(self.busy.values());
        let revision = |mark: &Mark| if mark.store_id == store_id { mark.revision } else { 0 };
        all.map(|since| since.as_ref().map_or(0, revision)).min()
    }

    /// Everything is forgotten, also what is on its way and comes back.
    pub(super) fn clear(&mut self) {
        *self = Self { cleared: self.cleared + 1, counts: self.counts, ..Self::default() };
    }

    /// Keys as they should be now.
    pub(super) fn changes(&self, keys: &BTreeSet<String>) -> Vec<KeyChange> {
        let change = |key: &String| match self.wanted.get(key) {
            Some(value) => KeyChange::Put { key: key.clone(), value: value.clone() },
            None => KeyChange::Delete { key: key.clone() },
        };
        keys.iter().map(change).collect()
    }

    /// What could not be told goes back to the front; what has come meanwhile is newer.
    pub(super) fn put_back(&mut self, batch: Batch) {
        self.busy.clear();
        if batch.cleared != self.cleared {
            return;
        }
        self.dirty.extend(batch.keys);
        for (place, waiting) in batch.waiting.into_iter().rev() {
            if let Some((_, newer)) = self.waiting.get_mut(&place) {
                newer.since = waiting.since;
                continue;
            }
            self.ends.0 -= 1;
            self.order.insert(self.ends.0, place.clone());
            self.waiting.insert(place, (self.ends.0, waiting));
        }
    }

    /// What waits for these channels is not told until [`Self::bring_back`]; it waits on.
    pub(super) fn set_aside(&mut self, channels: &BTreeSet<ChannelName>) {
        let waiting = &self.waiting;
        let is_of_these = |place: &String| {
            let found = waiting.get(place);
            found.is_some_and(|(_, waiting)| channels.contains(&waiting.notice.channel))
        };
        self.order.retain(|_, place| !is_of_these(place));
    }

    /// What was set aside is told again, where it stood.
    pub(super) fn bring_back(&mut self) {
        let places = self.waiting.iter().map(|(place, (at, _))| (*at, place.clone()));
        self.order.extend(places);
    }

    /// All keys are to be written again, and those that came back are to go.
    pub(super) fn write_all(&mut self) {
        self.dirty.extend(self.wanted.keys().cloned());
        self.sweep = true;
    }

    /// Keys that the server should have, if nothing is on its way to it.
    pub(super) fn settled_keys(&self) -> Vec<String> {
        self.wanted.keys().filter(|key| !self.dirty.contains(*key)).cloned().collect()
    }

    /// These keys are to be written again, if they are still wanted.
    pub(super) fn write_again(&mut self, keys: &BTreeSet<String>) {
        self.dirty.extend(keys.iter().filter(|key| self.wanted.contains_key(*key)).cloned());
    }

    /// Of the keys that are there, those that should not be.
    pub(super) fn drop_unwanted(&mut self, found: Vec<String>) {
        let unwanted = found.into_iter().filter(|key| !self.wanted.contains_key(key));
        self.dirty.extend(unwanted);
    }
}
