//! The engine between a main service, a broker and a lease that the test plays.

#[path = "ends_tests.rs"]
mod ends;
#[path = "follow_tests.rs"]
mod follow;
#[path = "found_tests.rs"]
mod found;
#[path = "hear_tests.rs"]
mod hear;
#[path = "lead_tests.rs"]
mod lead;

use async_trait::async_trait;
use blaze_brokers::KeyedMessage;
use blaze_brokers::redis::KeyChange;
use blaze_domain::config::Document;
use blaze_domain::names::ChannelName;
use bytes::Bytes;
use serde_json::{Value, json};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinSet;

use super::*;
use crate::copy::{Copies, Found};
use crate::core::Site;
use crate::core::messages::Delivery;
use crate::core::testing::{document, place};
use crate::core::{Edit, Incoming};
use crate::lease::Term;
use crate::serve::{Channels, Outlet, OutletError, Speaker};
use crate::sync::SyncEvent;

/// What services see.
#[derive(Debug, Clone, PartialEq)]
enum Seen {
    Key(String, Option<Value>),
    Notice(String, Value),
    TakenAway(String, String),
}

struct Board {
    seen: mpsc::Sender<Seen>,
    is_up: watch::Receiver<bool>,
}

#[async_trait]
impl Outlet for Board {
    async fn deliver(
        &self,
        changes: &[KeyChange],
        messages: &[KeyedMessage],
    ) -> Result<(), OutletError> {
        if !*self.is_up.borrow() {
            return Err(OutletError::Away("switched off".to_owned()));
        }
        for change in changes {
            let seen = match change {
                KeyChange::Put { key, value } => Seen::Key(key.clone(), Some(parse(value))),
                KeyChange::Delete { key } => Seen::Key(key.clone(), None),
                KeyChange::PutRecord { .. } => panic!("the worker writes no records"),
            };
            self.seen.send(seen).await.unwrap();
        }
        for message in messages {
            let seen = match &message.value {
                Some(text) => Seen::Notice(message.channel.to_string(), parse(text)),
                None => Seen::TakenAway(message.channel.to_string(), message.key.clone()),
            };
            self.seen.send(seen).await.unwrap();
        }
        Ok(())
    }

    fn has_keys(&self) -> bool {
        true
    }

    async fn keys_lost(&self) {
        std::future::pending::<()>().await;
    }

    async fn missing_keys(&self, _: &[String]) -> Result<Vec<String>, OutletError> {
        Ok(Vec::new())
    }

    async fn own_keys(&self) -> Result<Vec<String>, OutletError> {
        Ok(Vec::new())
    }
}

struct Answers(mpsc::Sender<(String, Value)>);

impl Replies for Answers {
    fn reply(&self, to: &ChannelName, payload: Bytes) -> Result<(), String> {
        self.0.try_send((to.to_string(), parse(&payload))).map_err(|error| error.to_string())
    }

    fn shared(&self) -> Option<ChannelName> {
        None
    }
}

fn parse(bytes: &[u8]) -> Value {
    serde_json::from_slice(bytes).unwrap()
}

struct World {
    sync: mpsc::Sender<SyncEvent>,
    gets: mpsc::Sender<Bytes>,
    signs: mpsc::Sender<Sign>,
    leader: watch::Sender<Option<u64>>,
    noted: watch::Sender<Option<Mark>>,
    told: watch::Receiver<Option<Mark>>,
    /// Whether the broker takes anything.
    up: watch::Sender<bool>,
    defaults: watch::Sender<defaults::Status>,
    queries: mpsc::Sender<oneshot::Sender<Status>>,
    found: mpsc::Sender<Found>,
    answers: mpsc::Receiver<(String, Value)>,
    seen: mpsc::Receiver<Seen>,
    acks: watch::Receiver<Option<v1::Ack>>,
    _tasks: JoinSet<()>,
}

fn world_from(start: Option<Loaded>, is_leader: bool) -> World {
    world_with(start, is_leader, None)
}

fn world_with(start: Option<Loaded>, is_leader: bool, copies: Option<Copies>) -> World {
    world_as(start, is_leader, copies, Delivery::Text)
}

fn world_as(
    start: Option<Loaded>,
    is_leader: bool,
    copies: Option<Copies>,
    delivery: Delivery,
) -> World {
    world_on(start, is_leader, copies, delivery, None)
}

/// The same on a broker where channels are to be made.
fn world_on(
    start: Option<Loaded>,
    is_leader: bool,
    copies: Option<Copies>,
    delivery: Delivery,
    channels: Option<Arc<dyn Channels>>,
) -> World {
    let (sync, sync_in) = mpsc::channel(QUEUE);
    let (gets, gets_in) = mpsc::channel(64);
    let (signs, signs_in) = mpsc::channel(64);
    let (queries, queries_in) = mpsc::channel(64);
    let (found, found_in) = mpsc::channel(2);
    let (leader, leader_in) = watch::channel(is_leader.then_some(1));
    let (noted, noted_in) = watch::channel(None);
    let (told_out, told) = watch::channel(None);
    let (up, is_up) = watch::channel(true);
    let (defaults, defaults_in) = watch::channel(defaults::Status::default());
    let (answer, answers) = mpsc::channel(64);
    let (see, seen) = mpsc::channel(64);
    let (acks_out, acks) = watch::channel(None);
    let identity = Identity {
        site: Site { layer: "edge".parse().unwrap(), node: Some("robot-1".parse().unwrap()) },
        node: "robot-1".parse().unwrap(),
        worker_id: "w-1".to_owned(),
        delivery,
    };
    let speaker = Speaker::new(Term::always());
    let outputs = Outputs {
        replies: Arc::new(Answers(answer)),
        speaker: speaker.clone(),
        channels,
        copies,
        acks: acks_out,
        own: None,
        term: Term::always(),
        told: told_out,
    };
    let inputs = Inputs {
        sync: sync_in,
        gets: gets_in,
        signs: signs_in,
        defaults: defaults_in,
        leader: leader_in,
        noted: noted_in,
        queries: queries_in,
        found: found_in,
    };
    let mut tasks = JoinSet::new();
    tasks.spawn(speaker.run(Arc::new(Board { seen: see, is_up })));
    tasks.spawn(Engine::new(identity, outputs, start).run(inputs, CancellationToken::new()));
    World {
        sync,
        gets,
        signs,
        leader,
        noted,
        told,
        up,
        defaults,
        queries,
        found,
        answers,
        seen,
        acks,
        _tasks: tasks,
    }
}

fn world() -> World {
    world_from(None, true)
}

fn documents(rate: u64) -> Vec<Document> {
    vec![
        document("Layer/edge", 1, json!({ "kind": "edge", "config": { "log": "info" } })),
        document("Node/robot-1", 1, json!({ "layer": "edge" })),
        document("Service/nav", 1, json!({ "config": { "speed": 1 } })),
        document("Service/slam", 2, json!({ "config": { "rate_hz": rate } })),
    ]
}

/// A commit right after the one before.
fn commit(revision: u64, edit: Edit) -> Incoming {
    Incoming::Commit { revision, previous: revision - 1, edits: vec![edit] }
}

fn put(revision: u64, document: Document) -> Incoming {
    commit(revision, Edit::Put(document))
}

fn remove(revision: u64, document: Document) -> Incoming {
    commit(revision, Edit::Remove(document.key))
}

/// Another rate of `slam`.
fn slam(revision: u64, rate: u64) -> Incoming {
    put(revision, document("Service/slam", revision, json!({ "config": { "rate_hz": rate } })))
}

/// Channels and notices among what was seen.
fn noticed(seen: &[Seen]) -> impl Iterator<Item = (&str, &Value)> {
    seen.iter().filter_map(|seen| match seen {
        Seen::Notice(channel, notice) => Some((channel.as_str(), notice)),
        Seen::Key(..) | Seen::TakenAway(..) => None,
    })
}

/// Rates in notices.
fn rates(seen: &[Seen]) -> Vec<u64> {
    noticed(seen).filter_map(|(_, notice)| notice["config"]["rate_hz"].as_u64()).collect()
}

/// What a copy of a store holds.
fn copy_of(store_id: &str, revision: u64, documents: Vec<Document>) -> Loaded {
    Loaded {
        position: Position {
            store_id: store_id.to_owned(),
            layer: "edge".parse().unwrap(),
            revision,
            as_of: Timestamp::from_millis(1_000),
        },
        documents: documents.into_iter().map(Arc::new).collect(),
        notes: Arc::default(),
    }
}

/// The same with a place that was notified: an instance of `slam`.
fn with_place(instance: &str, loaded: Loaded) -> Loaded {
    let notes = Arc::new(Notes {
        places: vec![place(&format!("slam/{instance}@robot-1"))],
        ..Notes::default()
    });
    Loaded { notes, ..loaded }
}

/// What a mounted file says.
fn file(rate: u64) -> defaults::Status {
    let documents =
        documents(rate).into_iter().map(|document| Arc::new(Document { revision: 0, ..document }));
    defaults::Status {
        current: Some(Arc::new(defaults::Defaults { documents: documents.collect(), left_out: 0 })),
        problem: None,
    }
}

impl World {
    async fn says(&self, incoming: Incoming) {
        self.sync.send(SyncEvent::Said(incoming)).await.unwrap();
    }

    /// The main service accepts the worker and tells all it has.
    async fn opens(&self, documents: Vec<Document>, revision: u64) -> CancellationToken {
        let stream = CancellationToken::new();
        self.sync.send(SyncEvent::Opened(stream.clone())).await.unwrap();
        self.says(Incoming::Welcome {
            protocol: 1,
            store_id: "s".to_owned(),
            revision,
            resumed: false,
        })
        .await;
        self.says(Incoming::Snapshot { revision, documents, last: true }).await;
        stream
    }

    async fn closes(&self) {
        let closed = SyncEvent::Closed { reason: "cut".to_owned(), is_unreadable: false };
        self.sync.send(closed).await.unwrap();
    }

    async fn status(&self) -> Status {
        let (send, status) = oneshot::channel();
        self.queries.send(send).await.unwrap();
        status.await.unwrap()
    }

    async fn hello(&self) -> v1::Hello {
        let (send, hello) = oneshot::channel();
        let greeting = SyncEvent::Greeting { is_safe: true, answer: send };
        self.sync.send(greeting).await.unwrap();
        hello.await.unwrap()
    }

    async fn asks(&mut self, request: Value) -> Value {
        self.gets.send(Bytes::from(request.to_string())).await.unwrap();
        let answer = tokio::time::timeout(Duration::from_secs(10), self.answers.recv()).await;
        let (to, answer) = answer.expect("an answer within 10 s").unwrap();
        assert_eq!(to, "blaze/reply/t");
        answer
    }

    async fn slam(&mut self) -> Value {
        self.asks(
            json!({ "id": "1", "service": "slam", "instance": "0", "reply_to": "blaze/reply/t" }),
        )
        .await
    }

    async fn notice(&mut self) -> (String, Value) {
        let wait = async {
            loop {
                if let Some(Seen::Notice(channel, text)) = self.seen.recv().await {
                    return (channel, text);
                }
            }
        };
        tokio::time::timeout(Duration::from_secs(10), wait).await.expect("a notice within 10 s")
    }

    /// Everything that has been told by now, and by then.
    async fn rest(&mut self) -> Vec<Seen> {
        tokio::time::sleep(Duration::from_secs(5)).await;
        let mut out = Vec::new();
        while let Ok(seen) = self.seen.try_recv() {
            out.push(seen);
        }
        out
    }
}

#[tokio::test(start_paused = true)]
async fn a_service_gets_its_configuration_and_hears_of_its_own_changes_alone() {
    let mut w = world();
    assert_eq!(w.slam().await["error"]["code"], "not_ready");
    w.opens(documents(30), 2).await;
    w.rest().await;
    let answer = w.slam().await;
    assert_eq!((&answer["config"]["rate_hz"], &answer["source"]), (&json!(30), &json!("main")));
    assert_eq!((&answer["node"], &answer["revision"]), (&json!("robot-1"), &json!(2)));
    w.rest().await;

    w.says(slam(3, 10)).await;
    let told = w.rest().await;
    let notices: Vec<_> = noticed(&told).collect();
    assert_eq!(notices.len(), 2, "the instance that asked, and the one without: {told:?}");
    for (channel, notice) in notices {
        assert_eq!(channel, "blaze/config/changed/slam");
        assert_eq!(
            (&notice["paths"], &notice["scopes"], &notice["revision"]),
            (&json!(["/rate_hz"]), &json!(["service"]), &json!(3))
        );
        assert_eq!(notice["config"], json!({ "rate_hz": 10, "log": "info" }));
    }
    let keys = told.iter().filter_map(|seen| match seen {
        Seen::Key(key, Some(value)) if value["config"]["rate_hz"] == 10 => Some(key.as_str()),
        _ => None,
    });
    assert_eq!(keys.collect::<Vec<_>>(), ["blaze:config:slam", "blaze:config:slam:0"]);

    // A new revision that says the same is told to nobody.
    let same =
        document("Service/slam", 4, json!({ "config": { "rate_hz": 10 }, "description": "new" }));
    w.says(put(4, same)).await;
    assert_eq!(w.rest().await, []);
    assert_eq!(w.slam().await["revision"], 3);
}

#[tokio::test(start_paused = true)]
async fn what_comes_together_is_told_once_and_the_last_state_always() {
    let mut w = world();
    w.opens(documents(30), 2).await;
    w.rest().await;
    for revision in 3..53 {
        w.says(slam(revision, revision)).await;
    }
    let told = w.rest().await;
    let rates = rates(&told);
    assert_eq!(rates.last(), Some(&52));
    assert!(rates.len() < 50 && rates.is_sorted(), "{rates:?}");
}

#[tokio::test(start_paused = true)]
async fn what_is_missing_is_asked_for_anew_and_services_keep_what_they_have() {
    let mut w = world();
    let stream = w.opens(documents(30), 2).await;
    w.rest().await;
    // The one before is missing.
    w.says(slam(9, 1)).await;
    tokio::time::timeout(Duration::from_secs(10), stream.cancelled()).await.unwrap();
    assert_eq!(w.slam().await["config"]["rate_hz"], 30);
    w.closes().await;
    let hello = w.hello().await;
    assert_eq!((hello.revision, hello.store_id.as_str()), (0, ""));
    assert_eq!((hello.layer.as_str(), hello.node.as_str()), ("edge", "robot-1"));
    assert_eq!(w.slam().await["source"], "copy");
    // What nothing is missing of is gone on from.
    w.opens(documents(5), 9).await;
    w.rest().await;
    assert_eq!(w.slam().await["config"]["rate_hz"], 5);
    let hello = w.hello().await;
    assert_eq!((hello.revision, hello.store_id.as_str()), (9, "s"));
    assert!(hello.digest.starts_with("sha256:"));
}

#[tokio::test(start_paused = true)]
async fn the_mounted_file_serves_until_there_is_better_and_never_after() {
    let mut w = world();
    w.defaults.send_replace(file(1));
    w.rest().await;
    let answer = w.slam().await;
    assert_eq!((&answer["config"]["rate_hz"], &answer["source"]), (&json!(1), &json!("file")));
    w.defaults.send_replace(file(2));
    w.rest().await;
    assert_eq!(w.slam().await["config"]["rate_hz"], 2);
    w.opens(documents(30), 2).await;
    w.rest().await;
    w.defaults.send_replace(file(3));
    w.rest().await;
    w.closes().await;
    let answer = w.slam().await;
    assert_eq!((&answer["config"]["rate_hz"], &answer["source"]), (&json!(30), &json!("copy")));
}

#[tokio::test(start_paused = true)]
async fn a_new_life_serves_what_the_last_one_had_and_tells_only_what_differs() {
    let loaded = with_place("0", copy_of("s", 2, documents(30)));
    let mut w = world_from(Some(loaded), true);
    let answer = w.slam().await;
    assert_eq!((&answer["config"]["rate_hz"], &answer["source"]), (&json!(30), &json!("copy")));
    assert_eq!(answer["as_of"], "1970-01-01T00:00:01.000Z");
    let hello = w.hello().await;
    assert_eq!((hello.revision, hello.store_id.as_str()), (2, "s"));
    let of_slam_0 =
        |seen: &Seen| matches!(seen, Seen::Notice(_, notice) if notice["instance"] == "0");
    assert!(!w.rest().await.iter().any(of_slam_0), "it was told already");
    w.opens(documents(10), 5).await;
    let told = w.rest().await;
    assert_eq!(told.iter().filter(|seen| of_slam_0(seen)).count(), 1, "{told:?}");
}
