//! The speaker in front of a broker that is away, refuses, or has forgotten.

use async_trait::async_trait;
use blaze_brokers::redis::KeyChange;
use tokio::sync::{mpsc, watch};

use super::super::waiting::BATCH_BYTES;
use super::*;

type Delivered = (Vec<KeyChange>, Vec<KeyedMessage>);

/// A broker that can be away and can lose its keys.
struct Fake {
    is_up: watch::Receiver<bool>,
    lost: Arc<Notify>,
    delivered: mpsc::Sender<Delivered>,
    own: Vec<String>,
    /// A channel that it refuses.
    refused: Option<&'static str>,
    /// A channel that it has not yet.
    missing: Option<&'static str>,
    /// Whether the server of the keys, another one, answers.
    has_keys: watch::Receiver<bool>,
    /// Keys that it has lost, as long as nobody writes them.
    evicted: Arc<Mutex<BTreeSet<String>>>,
}

#[async_trait]
impl Outlet for Fake {
    async fn deliver(
        &self,
        changes: &[KeyChange],
        messages: &[KeyedMessage],
    ) -> Result<(), OutletError> {
        if !*self.is_up.borrow() {
            return Err(OutletError::Away("switched off".to_owned()));
        }
        if messages.iter().any(|message| Some(message.channel.as_str()) == self.refused) {
            return Err(OutletError::TooLarge { bytes: 1 });
        }
        let missing =
            messages.iter().find(|message| Some(message.channel.as_str()) == self.missing);
        if let Some(message) = missing {
            return Err(OutletError::NotYet {
                channels: [message.channel.clone()].into(),
                reason: "told so".to_owned(),
            });
        }
        let (place, reason) = ("cache".to_owned(), "told so".to_owned());
        if !changes.is_empty() && !*self.has_keys.borrow() {
            return Err(OutletError::KeysAlone(KeyError::Away { place, reason }));
        }
        if changes.iter().any(|change| change.key() == "blaze:config:forbidden") {
            return Err(OutletError::KeysAlone(KeyError::Refused { place, reason }));
        }
        self.evicted.lock().retain(|key| changes.iter().all(|change| change.key() != key.as_str()));
        self.delivered.send((changes.to_vec(), messages.to_vec())).await.unwrap();
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

    async fn missing_keys(&self, keys: &[String]) -> Result<Vec<String>, OutletError> {
        let evicted = self.evicted.lock();
        Ok(keys.iter().filter(|key| evicted.contains(*key)).cloned().collect())
    }
}

struct World {
    speaker: Speaker,
    up: watch::Sender<bool>,
    keys: watch::Sender<bool>,
    lost: Arc<Notify>,
    evicted: Arc<Mutex<BTreeSet<String>>>,
    delivered: mpsc::Receiver<Delivered>,
    _run: tokio::task::JoinSet<()>,
}

fn world(is_up: bool) -> World {
    let (up, seen) = watch::channel(is_up);
    let (keys, has_keys) = watch::channel(true);
    let (send, delivered) = mpsc::channel(64);
    let evicted = Arc::default();
    let (speaker, lost) = (Speaker::new(Term::always()), Arc::new(Notify::new()));
    let outlet = Arc::new(Fake {
        is_up: seen,
        lost: Arc::clone(&lost),
        delivered: send,
        own: vec!["blaze:config:old".to_owned(), "blaze:config:slam".to_owned()],
        refused: Some("blaze/config/changed/refused"),
        missing: Some("blaze/config/changed/missing"),
        has_keys,
        evicted: Arc::clone(&evicted),
    });
    let mut run = tokio::task::JoinSet::new();
    run.spawn(speaker.clone().run(outlet));
    World { speaker, up, keys, lost, evicted, delivered, _run: run }
}

fn told(place: &str, text: &'static str) -> Told {
    Told {
        place: place.to_owned(),
        key: Some((format!("blaze:config:{place}"), Some(Bytes::from(text)))),
        notice: Some(KeyedMessage {
            channel: format!("blaze/config/changed/{place}").parse().unwrap(),
            key: String::new(),
            value: Some(Bytes::from(text)),
        }),
    }
}

fn texts(delivered: &Delivered) -> Vec<Bytes> {
    let said = delivered.1.iter().filter_map(|message| message.value.clone());
    said.collect()
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
    assert_eq!(texts(&first), ["1", "3"], "a newer one comes after what was told meanwhile");
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
    w.speaker
        .tell([Told { key: Some(("blaze:config:nav".to_owned(), None)), ..told("nav", "gone") }]);
    let gone = w.delivered.recv().await.unwrap();
    assert_eq!(gone.0, [KeyChange::Delete { key: "blaze:config:nav".to_owned() }]);
    w.lost.notify_one();
    let again = w.delivered.recv().await.unwrap();
    let old = KeyChange::Delete { key: "blaze:config:old".to_owned() };
    let slam = KeyChange::Put { key: "blaze:config:slam".to_owned(), value: Bytes::from("1") };
    assert_eq!(again, (vec![slam], Vec::new()));
    let swept = w.delivered.recv().await.unwrap();
    assert_eq!(swept, (vec![old], Vec::new()), "and one that nobody wants goes");
}

#[tokio::test(start_paused = true)]
async fn keys_that_vanish_while_the_server_runs_are_written_again() {
    let mut w = world(true);
    w.speaker.tell([told("slam", "1"), told("nav", "1")]);
    w.delivered.recv().await.unwrap();
    let evicted = Instant::now();
    w.evicted.lock().insert("blaze:config:slam".to_owned());
    let again = w.delivered.recv().await.unwrap();
    let slam = KeyChange::Put { key: "blaze:config:slam".to_owned(), value: Bytes::from("1") };
    assert_eq!(again, (vec![slam], Vec::new()));
    assert!(evicted.elapsed() <= LOOK_FOR_KEYS * 3);
    tokio::time::sleep(LOOK_FOR_KEYS * 3).await;
    assert!(w.delivered.try_recv().is_err(), "it is there again");
}

#[test]
fn what_came_meanwhile_is_newer_than_what_goes_back() {
    let mut state = State::default();
    state.put(told("slam", "1"));
    let batch = state.take(BATCH);
    state.put(told("slam", "2"));
    state.put_back(batch);
    let left = state.take(BATCH);
    let texts: Vec<_> =
        left.waiting.iter().filter_map(|(_, waiting)| waiting.notice.value.clone()).collect();
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
    let put = KeyChange::Put { key: "blaze:config:slam:0".to_owned(), value: Bytes::from("2") };
    assert_eq!(state.changes(&batch.keys), [put]);
}

#[tokio::test(start_paused = true)]
async fn whom_the_broker_refuses_holds_up_nobody_else() {
    let mut w = world(true);
    w.speaker.tell([told("nav", "1"), told("refused", "1"), told("slam", "1")]);
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

#[test]
fn what_was_forgotten_does_not_come_back_and_is_not_missed() {
    let mut state = State::default();
    state.put(told("slam", "7"));
    assert!(state.waits_since("", false).is_some());
    let batch = state.take(BATCH);
    assert!(state.waits_since("", false).is_some(), "also while it is on its way");
    state.put(told("nav", "8"));
    state.clear();
    state.put_back(batch);
    assert!(state.waits_since("", false).is_none());
    assert!(state.take(BATCH).is_empty());
}

#[test]
fn a_place_waits_since_its_first_notice_that_was_not_taken() {
    let at = |revision| {
        let store_id = "a".to_owned();
        Some(Mark { store_id, revision })
    };
    let mut state = State::default();
    state.from = at(5);
    state.put(told("slam", "1"));
    state.from = at(6);
    state.put(told("nav", "1"));
    state.put(told("slam", "2"));
    assert_eq!(state.waits_since("a", true), Some(5), "also after it was replaced");
    let batch = state.take(BATCH);
    assert!(state.is_waiting("nav"), "also while it is on its way");
    state.from = at(7);
    state.put(told("nav", "2"));
    assert_eq!(state.waits_since("a", true), Some(5));
    state.put_back(batch);
    state.set_aside(&["blaze/config/changed/slam".parse().unwrap()].into());
    assert_eq!((state.waits_since("a", false), state.waits_since("a", true)), (Some(6), Some(5)));
    assert_eq!(state.waits_since("b", true), Some(0), "of another store");
    assert!(state.is_waiting("slam") && !state.is_waiting("log"));
}

#[tokio::test(start_paused = true)]
async fn a_channel_that_is_not_there_yet_holds_up_no_other_one_and_waits_on() {
    let mut w = world(true);
    w.speaker.tell([told("missing", "1"), told("slam", "1")]);
    let mut notices = Vec::new();
    while notices.is_empty() {
        let (_, messages) = w.delivered.recv().await.unwrap();
        notices.extend(messages.iter().map(|message| message.channel.to_string()));
    }
    assert_eq!(notices, ["blaze/config/changed/slam"]);
    // It is tried again and again, and what comes meanwhile is told.
    tokio::time::sleep(Duration::from_secs(10)).await;
    w.speaker.tell([told("nav", "2")]);
    let (_, messages) = w.delivered.recv().await.unwrap();
    assert_eq!(messages[0].channel.as_str(), "blaze/config/changed/nav");
    let counts = w.speaker.counts();
    assert!((20..200).contains(&counts.failures), "{counts:?}");
    assert_eq!((counts.waiting, counts.dropped), (1, 0));
    // Of all who can be told nobody waits.
    let is_all = async {
        while w.speaker.waits_since("", false).is_some() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(10), is_all).await.unwrap();
    assert_eq!(w.speaker.counts().waiting, 1);
}

#[tokio::test(start_paused = true)]
async fn notices_go_on_while_the_keys_wait_for_their_server() {
    let mut w = world(true);
    w.keys.send_replace(false);
    for text in ["1", "2", "3"] {
        w.speaker.tell([told("slam", text), told("nav", text)]);
        let delivered = w.delivered.recv().await.unwrap();
        assert_eq!((texts(&delivered).len(), delivered.0.len()), (2, 0));
    }
    tokio::time::sleep(Duration::from_secs(5)).await;
    assert!(w.delivered.is_empty(), "each notice was told once, and no key was written");
    assert!(w.speaker.counts().notices == 6 && w.speaker.waits_since("", false).is_none());
    w.keys.send_replace(true);
    let written = w.delivered.recv().await.unwrap();
    let put = |place: &str| KeyChange::Put {
        key: format!("blaze:config:{place}"),
        value: Bytes::from("3"),
    };
    assert_eq!(written, (vec![put("nav"), put("slam")], Vec::new()));
}

#[tokio::test(start_paused = true)]
async fn whose_key_is_refused_is_told_without_it_and_the_others_have_theirs() {
    let mut w = world(true);
    w.speaker.tell([told("slam", "1"), told("forbidden", "1"), told("nav", "1")]);
    let (mut keys, mut places) = (Vec::new(), Vec::new());
    while places.len() < 3 || keys.len() < 2 {
        let (changes, messages) = w.delivered.recv().await.unwrap();
        keys.extend(changes.iter().map(|change| change.key().to_owned()));
        places.extend(messages.into_iter().map(|message| message.channel.to_string()));
    }
    assert_eq!(keys, ["blaze:config:slam", "blaze:config:nav"]);
    let all = ["slam", "forbidden", "nav"].map(|place| format!("blaze/config/changed/{place}"));
    assert_eq!(places, all, "in their order");
    tokio::time::sleep(Duration::from_secs(5)).await;
    assert!(w.delivered.is_empty());
}
