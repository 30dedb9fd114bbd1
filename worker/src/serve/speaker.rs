//! Tells services what has changed, one after the other, and never twice what is old already: of
//! what waits, only the newest of each place counts. A broker that is away holds up nobody; what
//! waits then is bounded by the places that there are.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::KeyedMessage;
use blaze_brokers::redis::KeyError;
use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::Notify;
use tokio::time::{Instant, sleep_until};

use super::outlet::{Outlet, OutletError};
use super::waiting::State;
use crate::lease::{Mark, Term};

/// Places that are told of in one transaction.
const BATCH: usize = 256;
/// Upper bounds of the pause after a failure, which doubles; full jitter.
const PAUSE: (Duration, Duration) = (Duration::from_millis(20), Duration::from_millis(500));
/// What is for a channel that is not there yet is set aside for so long, so that it does not hold
/// up the rest.
const ASIDE: Duration = Duration::from_millis(200);

/// A server of the keys that is not the broker's and does not answer is left alone for so long,
/// which doubles: notices go on meanwhile.
const KEYS_AGAIN: (Duration, Duration) = (Duration::from_millis(500), Duration::from_secs(10));
/// Between two looks whether the server has the keys.
const LOOK_FOR_KEYS: Duration = Duration::from_secs(10);
/// Between two tries to look for keys of before.
const SWEEP_AGAIN: Duration = Duration::from_secs(5);

/// What is told of one place.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Told {
    /// Which place: a name that no other has.
    pub place: String,
    /// Its key and what it has from now on, `None`: there is none; absent where the place has no
    /// key.
    pub key: Option<(String, Option<Bytes>)>,
    /// The notice, if there is one.
    pub notice: Option<KeyedMessage>,
}

/// What happened to notices and keys.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SpeakerCounts {
    /// Notices that the broker took.
    pub notices: u64,
    /// Notices that were replaced by newer ones before the broker took them.
    pub replaced: u64,
    /// Transactions that failed and were tried again.
    pub failures: u64,
    /// Places that were not told, because the broker refuses them.
    pub dropped: u64,
    /// Places that wait.
    pub waiting: u64,
}

struct Shared {
    state: Mutex<State>,
    more: Notify,
}

/// Clones share it. [`Speaker::run`] must run once.
#[derive(Clone)]
pub struct Speaker {
    shared: Arc<Shared>,
    term: Term,
}

impl Speaker {
    /// One that tells nothing outside of a term.
    #[must_use]
    pub fn new(term: Term) -> Self {
        Self { term, shared: Arc::new(Shared { state: Mutex::default(), more: Notify::new() }) }
    }

    /// Tells it as soon as the broker takes it. Never waits.
    pub fn tell(&self, told: impl IntoIterator<Item = Told>) {
        let mut state = self.shared.state.lock();
        told.into_iter().for_each(|one| state.put(one));
        drop(state);
        self.shared.more.notify_one();
    }

    /// Notices are from this state from now on; `None`: the broker may lack anything before them.
    pub fn set_state(&self, state: Option<Mark>) {
        self.shared.state.lock().from = state;
    }

    /// Whether the broker has not taken the last notice of a place.
    #[must_use]
    pub fn is_waiting(&self, place: &str) -> bool {
        self.shared.state.lock().is_waiting(place)
    }

    /// Lowest revision of this store among the notices that the broker has not taken; 0 if one is
    /// of another store. `aside`: with those whose channel cannot be made yet.
    #[must_use]
    pub fn waits_since(&self, store_id: &str, aside: bool) -> Option<u64> {
        self.shared.state.lock().waits_since(store_id, aside)
    }

    /// Has keys of before, which nobody wants any more, looked for and deleted. All that are wanted
    /// must have been told.
    pub fn sweep_keys(&self) {
        self.shared.state.lock().sweep = true;
        self.shared.more.notify_one();
    }

    /// Forgets everything: somebody else tells it from now on.
    pub fn clear(&self) {
        self.shared.state.lock().clear();
    }

    /// What has happened so far.
    #[must_use]
    pub fn counts(&self) -> SpeakerCounts {
        let state = self.shared.state.lock();
        SpeakerCounts { waiting: state.waiting.len() as u64, ..state.counts }
    }

    /// Tells what waits, for ever.
    pub async fn run(self, outlet: Arc<dyn Outlet>) {
        let lost = async {
            loop {
                outlet.keys_lost().await;
                {
                    let mut state = self.shared.state.lock();
                    state.write_all();
                    state.keys_wait = false;
                }
                self.shared.more.notify_one();
            }
        };
        tokio::select! {
            () = self.speak(&*outlet) => {}
            () = lost => {}
            () = self.look_for_keys(&*outlet) => {}
        }
    }

    /// Writes keys again that the server has lost while it ran, for ever.
    async fn look_for_keys(&self, outlet: &dyn Outlet) {
        let mut before = BTreeSet::new();
        loop {
            tokio::time::sleep(LOOK_FOR_KEYS).await;
            let wanted = self.shared.state.lock().settled_keys();
            if wanted.is_empty() || !self.term.is_on() {
                continue;
            }
            let missing = match outlet.missing_keys(&wanted).await {
                Ok(missing) => missing.into_iter().collect(),
                Err(error) => {
                    tracing::debug!(%error, "it is not known which keys are there");
                    BTreeSet::new()
                }
            };
            // Twice running, as what is on its way is not there yet.
            let lost: BTreeSet<String> = before.intersection(&missing).cloned().collect();
            before = missing;
            if !lost.is_empty() {
                tracing::warn!(
                    keys = ?lost.iter().take(4).collect::<Vec<_>>(),
                    count = lost.len(),
                    "the server has lost keys: they are written again",
                );
                self.shared.state.lock().write_again(&lost);
                self.shared.more.notify_one();
            }
        }
    }

    async fn speak(&self, outlet: &dyn Outlet) {
        let (mut pause, mut most) = (PAUSE.0, BATCH);
        let mut aside: Option<Instant> = None;
        let mut keys_again: Option<Instant> = None;
        let mut keys_pause = KEYS_AGAIN.0;
        let mut sweep_at = Instant::now();
        // Why it failed last, told once.
        let mut trouble: Option<String> = None;
        loop {
            if keys_again.is_some_and(|until| until <= Instant::now()) {
                keys_again = None;
                self.shared.state.lock().keys_wait = false;
            }
            if aside.is_some_and(|until| until <= Instant::now()) {
                aside = None;
                self.shared.state.lock().bring_back();
            }
            let (batch, changes) = {
                let mut state = self.shared.state.lock();
                let batch = state.take(most);
                let changes = match outlet.has_keys() {
                    true => state.changes(&batch.keys),
                    false => Vec::new(),
                };
                (batch, changes)
            };
            if batch.is_empty() {
                // Last: to look through all keys of a server may take long.
                if keys_again.is_none() && sweep_at <= Instant::now() && self.term.is_on() {
                    if self.sweep(outlet).await {
                        continue;
                    }
                    sweep_at = Instant::now() + SWEEP_AGAIN;
                }
                let is_due = self.term.is_on() && self.shared.state.lock().sweep;
                let again = [aside, keys_again, is_due.then_some(sweep_at)];
                let again = again.into_iter().flatten().min();
                tokio::select! {
                    () = self.shared.more.notified() => {}
                    () = sleep_until(again.unwrap_or_else(Instant::now)), if again.is_some() => {}
                }
                continue;
            }
            let messages: Vec<_> =
                batch.waiting.iter().map(|(_, waiting)| waiting.notice.clone()).collect();
            // At the last instant: what was taken may be old if the process was stopped since.
            let delivered = match self.term.is_on() {
                true => outlet.deliver(&changes, &messages).await,
                false => Err(OutletError::Led),
            };
            match delivered {
                Ok(()) => {
                    let mut state = self.shared.state.lock();
                    state.busy.clear();
                    state.counts.notices += messages.len() as u64;
                    (pause, most, trouble) = (PAUSE.0, BATCH, None);
                    if !changes.is_empty() {
                        keys_pause = KEYS_AGAIN.0;
                    }
                }
                Err(OutletError::KeysAlone(error @ KeyError::Away { .. })) => {
                    if keys_pause == KEYS_AGAIN.0 {
                        tracing::warn!(
                            %error,
                            "keys are not written, notices go on; it is tried again",
                        );
                    }
                    keys_again = Some(Instant::now() + keys_pause);
                    keys_pause = (keys_pause * 2).min(KEYS_AGAIN.1);
                    let mut state = self.shared.state.lock();
                    state.counts.failures += 1;
                    state.put_back(batch);
                    state.keys_wait = true;
                }
                Err(OutletError::KeysAlone(error @ KeyError::Refused { .. })) => {
                    let mut state = self.shared.state.lock();
                    if batch.keys.len() > 1 {
                        most = 1;
                        state.put_back(batch);
                    } else {
                        tracing::error!(
                            %error,
                            keys = ?batch.keys,
                            "a key is not written; its service is told by a notice alone",
                        );
                        state.counts.dropped += 1;
                        state.put_back(batch.without_keys());
                    }
                }
                // Whoever is refused alone would be refused again, and must not hold up the others.
                Err(error)
                    if error.is_refusal() && batch.len() <= 2 && batch.waiting.len() <= 1 =>
                {
                    let place = batch.waiting.first().map(|(place, _)| place.as_str());
                    tracing::error!(
                        %error,
                        place,
                        keys = ?batch.keys,
                        "a service is not told of its configuration",
                    );
                    let mut state = self.shared.state.lock();
                    state.busy.clear();
                    state.counts.dropped += 1;
                }
                Err(OutletError::NotYet { channels, reason }) => {
                    tracing::debug!(
                        channels = channels.len(),
                        reason,
                        "services could not be told yet"
                    );
                    aside.get_or_insert(Instant::now() + ASIDE);
                    let mut state = self.shared.state.lock();
                    state.counts.failures += 1;
                    state.put_back(batch.without_keys());
                    state.set_aside(&channels);
                }
                Err(error) => {
                    let words = error.to_string();
                    if trouble.as_ref() != Some(&words) && !error.is_refusal() {
                        tracing::warn!(
                            error = words,
                            "services cannot be told now; it is tried again"
                        );
                    }
                    trouble = Some(words);
                    {
                        let mut state = self.shared.state.lock();
                        state.counts.failures += 1;
                        state.put_back(batch);
                    }
                    if error.is_refusal() {
                        most = 1;
                        continue;
                    }
                    tokio::time::sleep(pause.mul_f64(rand::random())).await;
                    pause = (pause * 2).min(PAUSE.1);
                }
            }
        }
    }

    /// Looks for keys of before, if that is due; those that cannot be looked for now are looked for
    /// later. Returns whether it did.
    async fn sweep(&self, outlet: &dyn Outlet) -> bool {
        let cleared = {
            let mut state = self.shared.state.lock();
            if !std::mem::take(&mut state.sweep) {
                return false;
            }
            state.cleared
        };
        let found = outlet.own_keys().await;
        let mut state = self.shared.state.lock();
        // What is wanted has been forgotten meanwhile, so nobody knows what is not.
        if state.cleared != cleared {
            return true;
        }
        match found {
            Ok(found) => {
                state.drop_unwanted(found);
                true
            }
            Err(error) if error.is_refusal() => {
                tracing::warn!(
                    %error,
                    "keys of before were not looked for: those that nobody wants any more stay",
                );
                true
            }
            Err(error) => {
                tracing::debug!(%error, "keys of before were not looked for yet");
                state.sweep = true;
                false
            }
        }
    }
}

#[cfg(test)]
#[path = "speaker_tests.rs"]
mod tests;
