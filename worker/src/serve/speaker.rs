//! Tells services what has changed, one after the other, and never twice what is old already: of what waits, only the newest
//! of each place counts. A broker that is away holds up nobody; what waits then is bounded by the places that there are.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use blaze_brokers::redis::KeyChange;
use blaze_domain::names::ChannelName;
use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::Notify;

use super::outlet::Outlet;

/// Places that are told of in one transaction.
const BATCH: usize = 256;
/// Bytes of one transaction, unless one place alone has more (1 MiB): a large one over a slow connection would not be done in
/// the time that a call may take, and be tried again for ever.
const BATCH_BYTES: usize = 1024 * 1024;
/// Upper bounds of the pause after a failure, which doubles; full jitter.
const PAUSE: (Duration, Duration) = (Duration::from_millis(20), Duration::from_millis(500));

/// What is told of one place.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Told {
    /// Which place: a name that no other has.
    pub place: String,
    /// Its key and what it has from now on, `None`: there is none; absent where the place has no key.
    pub key: Option<(String, Option<Bytes>)>,
    /// Channel and text of the notice, if there is one.
    pub notice: Option<(ChannelName, Bytes)>,
}

/// What happened to notices and keys.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SpeakerCounts {
    /// Notices that the broker took.
    pub notices: u64,
    /// Notices that were replaced by newer ones before the broker took them.
    pub replaced: u64,
    /// Keys that were written or deleted.
    pub keys: u64,
    /// Transactions that failed and were tried again.
    pub failures: u64,
    /// Places that were not told, because the broker refuses them.
    pub dropped: u64,
    /// Places that wait.
    pub waiting: u64,
}

/// A notice that waits.
struct Waiting {
    /// The key that must be written no later.
    key: Option<String>,
    notice: (ChannelName, Bytes),
}

#[derive(Default)]
struct State {
    /// All keys as they should be, to be written again when the server has lost them.
    wanted: BTreeMap<String, Bytes>,
    /// Keys that are not as they should be; those that are not wanted are to go.
    dirty: BTreeSet<String>,
    /// Places in the order in which they are told of; each stands here once.
    order: BTreeMap<i64, String>,
    waiting: BTreeMap<String, (i64, Waiting)>,
    /// Of the last that was put at the end, and of the first.
    ends: (i64, i64),
    /// Keys of before are to be looked for: those of this worker that are not wanted are to go.
    sweep: bool,
}

/// What is told at once.
struct Batch {
    keys: BTreeSet<String>,
    waiting: Vec<(String, Waiting)>,
}

impl Batch {
    fn is_empty(&self) -> bool {
        self.keys.is_empty() && self.waiting.is_empty()
    }

    fn len(&self) -> usize {
        self.keys.len() + self.waiting.len()
    }
}

impl State {
    /// Takes in what is newer than what waits of the same place; it is told at the end, so that the notices of a service come
    /// in the order of their revisions. Returns whether a notice gave way.
    fn put(&mut self, told: Told) -> bool {
        let Told { place, key, notice } = told;
        let name = key.map(|(name, value)| {
            match value {
                Some(value) => self.wanted.insert(name.clone(), value),
                None => self.wanted.remove(&name),
            };
            self.dirty.insert(name.clone());
            name
        });
        let Some(notice) = notice else { return false };
        let old = self.waiting.remove(&place);
        if let Some((at, _)) = &old {
            self.order.remove(at);
        }
        self.ends.1 += 1;
        self.order.insert(self.ends.1, place.clone());
        self.waiting.insert(place, (self.ends.1, Waiting { key: name, notice }));
        old.is_some()
    }

    /// The first that wait, at most so many and, but for the first, so many bytes.
    fn take(&mut self, most: usize) -> Batch {
        let mut batch = Batch {
            keys: BTreeSet::new(),
            waiting: Vec::new(),
        };
        let mut bytes = 0;
        while batch.waiting.len() < most
            && (bytes < BATCH_BYTES || batch.is_empty())
            && let Some((_, place)) = self.order.pop_first()
        {
            let Some((_, waiting)) = self.waiting.remove(&place) else {
                continue;
            };
            bytes += waiting.notice.1.len();
            if let Some(key) = waiting.key.as_ref().and_then(|key| self.dirty.take(key)) {
                bytes += self.wanted.get(&key).map_or(0, Bytes::len);
                batch.keys.insert(key);
            }
            batch.waiting.push((place, waiting));
        }
        while batch.len() < most
            && (bytes < BATCH_BYTES || batch.is_empty())
            && let Some(key) = self.dirty.pop_first()
        {
            bytes += self.wanted.get(&key).map_or(0, Bytes::len);
            batch.keys.insert(key);
        }
        batch
    }

    /// Keys as they should be now.
    fn changes(&self, keys: &BTreeSet<String>) -> Vec<KeyChange> {
        let change = |key: &String| match self.wanted.get(key) {
            Some(value) => KeyChange::Put {
                key: key.clone(),
                value: value.clone(),
            },
            None => KeyChange::Delete { key: key.clone() },
        };
        keys.iter().map(change).collect()
    }

    /// What could not be told goes back to the front; what has come meanwhile is newer.
    fn put_back(&mut self, batch: Batch) {
        self.dirty.extend(batch.keys);
        for (place, waiting) in batch.waiting.into_iter().rev() {
            if !self.waiting.contains_key(&place) {
                self.ends.0 -= 1;
                self.order.insert(self.ends.0, place.clone());
                self.waiting.insert(place, (self.ends.0, waiting));
            }
        }
    }

    /// All keys are to be written again, and those that came back are to go.
    fn write_all(&mut self) {
        self.dirty.extend(self.wanted.keys().cloned());
        self.sweep = true;
    }

    /// Of the keys that are there, those that should not be.
    fn drop_unwanted(&mut self, found: Vec<String>) {
        let unwanted = found.into_iter().filter(|key| !self.wanted.contains_key(key));
        self.dirty.extend(unwanted);
    }
}

struct Shared {
    state: Mutex<State>,
    more: Notify,
    notices: AtomicU64,
    replaced: AtomicU64,
    keys: AtomicU64,
    failures: AtomicU64,
    dropped: AtomicU64,
}

/// Clones share it. [`Speaker::run`] must run once.
#[derive(Clone)]
pub struct Speaker {
    shared: Arc<Shared>,
}

impl Default for Speaker {
    fn default() -> Self {
        Self {
            shared: Arc::new(Shared {
                state: Mutex::default(),
                more: Notify::new(),
                notices: AtomicU64::new(0),
                replaced: AtomicU64::new(0),
                keys: AtomicU64::new(0),
                failures: AtomicU64::new(0),
                dropped: AtomicU64::new(0),
            }),
        }
    }
}

impl Speaker {
    /// Tells it as soon as the broker takes it. Never waits.
    pub fn tell(&self, told: impl IntoIterator<Item = Told>) {
        let mut replaced = 0;
        {
            let mut state = self.shared.state.lock();
            for one in told {
                replaced += u64::from(state.put(one));
            }
        }
        self.shared.replaced.fetch_add(replaced, Ordering::Relaxed);
        self.shared.more.notify_one();
    }

    /// Whether the newest notice of a place still waits.
    #[must_use]
    pub fn is_waiting(&self, place: &str) -> bool {
        self.shared.state.lock().waiting.contains_key(place)
    }

    /// Has keys of before, which nobody wants any more, looked for and deleted. All that are wanted must have been told.
    pub fn sweep_keys(&self) {
        self.shared.state.lock().sweep = true;
        self.shared.more.notify_one();
    }

    /// Forgets everything: somebody else tells it from now on.
    pub fn clear(&self) {
        *self.shared.state.lock() = State::default();
    }

    /// What has happened so far.
    #[must_use]
    pub fn counts(&self) -> SpeakerCounts {
        let count = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        SpeakerCounts {
            notices: count(&self.shared.notices),
            replaced: count(&self.shared.replaced),
            keys: count(&self.shared.keys),
            failures: count(&self.shared.failures),
            dropped: count(&self.shared.dropped),
            waiting: self.shared.state.lock().order.len() as u64,
        }
    }

    /// Tells what waits, for ever.
    pub async fn run(self, outlet: Arc<dyn Outlet>) {
        let lost = async {
            loop {
                outlet.keys_lost().await;
                self.shared.state.lock().write_all();
                self.shared.more.notify_one();
            }
        };
        tokio::select! {
            () = self.speak(&*outlet) => {}
            () = lost => {}
        }
    }

    async fn speak(&self, outlet: &dyn Outlet) {
        let (mut pause, mut most) = (PAUSE.0, BATCH);
        loop {
            self.sweep(outlet).await;
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
                self.shared.more.notified().await;
                continue;
            }
            let messages: Vec<_> = batch
                .waiting
                .iter()
                .map(|(_, waiting)| waiting.notice.clone())
                .collect();
            match outlet.deliver(&changes, &messages).await {
                Ok(()) => {
                    (pause, most) = (PAUSE.0, BATCH);
                    self.shared.keys.fetch_add(changes.len() as u64, Ordering::Relaxed);
                    self.shared.notices.fetch_add(messages.len() as u64, Ordering::Relaxed);
                }
                // Whoever is refused alone would be refused again, and must not hold up the others.
                Err(error) if error.is_refusal() && batch.len() <= 2 && batch.waiting.len() <= 1 => {
                    let place = batch.waiting.first().map(|(place, _)| place.as_str());
                    tracing::error!(%error, place, keys = ?batch.keys, "a service is not told of its configuration");
                    self.shared.dropped.fetch_add(1, Ordering::Relaxed);
                }
                Err(error) => {
                    tracing::debug!(%error, "services could not be told");
                    self.shared.failures.fetch_add(1, Ordering::Relaxed);
                    self.shared.state.lock().put_back(batch);
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

    /// Looks for keys of before, if that is due; one that cannot be looked for now is looked for later.
    async fn sweep(&self, outlet: &dyn Outlet) {
        if !std::mem::take(&mut self.shared.state.lock().sweep) {
            return;
        }
        let found = outlet.own_keys().await;
        let mut state = self.shared.state.lock();
        match found {
            Ok(found) => state.drop_unwanted(found),
            Err(error) => {
                tracing::debug!(%error, "keys of before were not looked for");
                state.sweep = true;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use async_trait::async_trait;
    use tokio::sync::{mpsc, watch};

    use super::super::outlet::OutletError;
    use super::*;

    type Delivered = (Vec<KeyChange>, Vec<(ChannelName, Bytes)>);

    /// A broker that can be away and can lose its keys.
    struct Fake {
        is_up: watch::Receiver<bool>,
        lost: Arc<Notify>,
        delivered: mpsc::Sender<Delivered>,
        own: Vec<String>,
        /// A channel that it refuses.
        refused: Option<&'static str>,
    }

    #[async_trait]
    impl Outlet for Fake {
        async fn deliver(&self, changes: &[KeyChange], messages: &[(ChannelName, Bytes)]) -> Result<(), OutletError> {
            if !*self.is_up.borrow() {
                return Err(OutletError::Away("switched off".to_owned()));
            }
            if messages
                .iter()
                .any(|(channel, _)| Some(channel.as_str()) == self.refused)
            {
                return Err(OutletError::TooLarge { bytes: 1 });
            }
            self.delivered
                .send((changes.to_vec(), messages.to_vec()))
                .await
                .unwrap();
            Ok(())
        }

        fn has_keys(&self) -> bool {
            true
        }

        async fn keys_lost(&self) {
            self.lost.notified().await;
        }

        async fn own_keys(&self) -> Result<Vec<String>, OutletError> {
            Ok(self.own.clone())
        }
    }

    struct World {
        speaker: Speaker,
        up: watch::Sender<bool>,
        lost: Arc<Notify>,
        delivered: mpsc::Receiver<Delivered>,
        _run: tokio::task::JoinSet<()>,
    }

    fn world(is_up: bool) -> World {
        let (up, seen) = watch::channel(is_up);
        let (send, delivered) = mpsc::channel(64);
        let (speaker, lost) = (Speaker::default(), Arc::new(Notify::new()));
        let outlet = Arc::new(Fake {
            is_up: seen,
            lost: Arc::clone(&lost),
            delivered: send,
            own: vec!["blaze:config:old".to_owned(), "blaze:config:slam".to_owned()],
            refused: Some("blaze/config/changed/refused"),
        });
        let mut run = tokio::task::JoinSet::new();
        run.spawn(speaker.clone().run(outlet));
        World {
            speaker,
            up,
            lost,
            delivered,
            _run: run,
        }
    }

    fn told(place: &str, text: &'static str) -> Told {
        Told {
            place: place.to_owned(),
            key: Some((format!("blaze:config:{place}"), Some(Bytes::from(text)))),
            notice: Some((
                format!("blaze/config/changed/{place}").parse().unwrap(),
                Bytes::from(text),
            )),
        }
    }

    fn texts(delivered: &Delivered) -> Vec<Bytes> {
        delivered.1.iter().map(|(_, text)| text.clone()).collect()
    }

    #[tokio::test(start_paused = true)]
    async fn of_what_waits_the_newest_of_each_place_is_told_once() {
        let mut w = world(false);
        w.speaker.tell([told("slam", "1"), told("nav", "1")]);
        w.speaker.tell([told("slam", "2")]);
        while w.speaker.counts().failures < 3 {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        w.speaker.tell([told("slam", "3")]);
        w.up.send_replace(true);
        let first = w.delivered.recv().await.unwrap();
        assert_eq!(
            texts(&first),
            ["1", "3"],
            "a newer one comes after what was told meanwhile"
        );
        assert_eq!(first.0.len(), 2);
        tokio::time::sleep(Duration::from_secs(5)).await;
        assert!(w.delivered.is_empty());
        let counts = w.speaker.counts();
        assert_eq!((counts.notices, counts.replaced, counts.waiting), (2, 2, 0));
    }

    #[tokio::test(start_paused = true)]
    async fn keys_that_the_server_has_lost_are_written_again_without_a_notice() {
        let mut w = world(true);
        w.speaker.tell([told("slam", "1"), told("nav", "1")]);
        w.delivered.recv().await.unwrap();
        w.speaker.tell([Told {
            key: Some(("blaze:config:nav".to_owned(), None)),
            ..told("nav", "gone")
        }]);
        let gone = w.delivered.recv().await.unwrap();
        assert_eq!(
            gone.0,
            [KeyChange::Delete {
                key: "blaze:config:nav".to_owned()
            }]
        );
        w.lost.notify_one();
        let again = w.delivered.recv().await.unwrap();
        let old = KeyChange::Delete {
            key: "blaze:config:old".to_owned(),
        };
        let slam = KeyChange::Put {
            key: "blaze:config:slam".to_owned(),
            value: Bytes::from("1"),
        };
        assert_eq!(again, (vec![old, slam], Vec::new()), "and one that nobody wants goes");
    }

    #[test]
    fn what_came_meanwhile_is_newer_than_what_goes_back() {
        let mut state = State::default();
        state.put(told("slam", "1"));
        let batch = state.take(BATCH);
        state.put(told("slam", "2"));
        state.put_back(batch);
        let left = state.take(BATCH);
        let texts: Vec<_> = left
            .waiting
            .iter()
            .map(|(_, waiting)| waiting.notice.1.clone())
            .collect();
        assert_eq!(texts, ["2"]);
        assert_eq!(state.changes(&left.keys).len(), 1);
        assert!(state.take(BATCH).is_empty());
    }

    #[test]
    fn of_two_places_with_one_key_the_last_word_counts() {
        let mut state = State::default();
        let moved = |place: &str, value: Option<&'static str>| Told {
            key: Some(("blaze:config:slam:0".to_owned(), value.map(Bytes::from))),
            ..told(place, "moved")
        };
        // The new place waits already when the old one goes and the new one changes again.
        state.put(moved("slam-at-b", Some("1")));
        state.put(moved("slam-at-a", None));
        state.put(moved("slam-at-b", Some("2")));
        let batch = state.take(BATCH);
        let put = KeyChange::Put {
            key: "blaze:config:slam:0".to_owned(),
            value: Bytes::from("2"),
        };
        assert_eq!(state.changes(&batch.keys), [put]);
    }

    #[tokio::test(start_paused = true)]
    async fn whom_the_broker_refuses_holds_up_nobody_else() {
        let mut w = world(true);
        w.speaker
            .tell([told("nav", "1"), told("refused", "1"), told("slam", "1")]);
        let mut heard = Vec::new();
        while heard.len() < 2 {
            heard.extend(texts(&w.delivered.recv().await.unwrap()));
        }
        while w.speaker.counts().waiting > 0 {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        let counts = w.speaker.counts();
        assert_eq!((counts.notices, counts.dropped), (2, 1));
    }

    #[test]
    fn a_batch_is_bounded_in_bytes_but_never_empty() {
        let mut state = State::default();
        let large: &'static str = Box::leak("x".repeat(BATCH_BYTES).into_boxed_str());
        state.put(told("a", large));
        state.put(told("b", large));
        state.put(told("c", "small"));
        let counts: Vec<usize> = (0..3).map(|_| state.take(BATCH).waiting.len()).collect();
        assert_eq!(counts, [1, 1, 1]);
        assert!(state.take(BATCH).is_empty());
    }
}
