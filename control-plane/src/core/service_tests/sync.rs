//! What a worker is told.

use std::collections::BTreeMap;

use blaze_domain::config::{canonical, secret};
use futures::stream::BoxStream;

use super::*;
use crate::core::{
    Acknowledged, Running, RunningState, SYNC_PROTOCOL, SyncHello, SyncItem, WorkerSession,
};

/// A worker that believes all it is told.
struct Copy {
    items: BoxStream<'static, SyncItem>,
    session: Arc<WorkerSession>,
    documents: BTreeMap<Key, Arc<Document>>,
    revision: u64,
    resumed: bool,
    /// Operations of the commits, in order.
    told: Vec<(u64, &'static str, String)>,
}

fn hello(layer: &str, revision: u64, store_id: &str) -> SyncHello {
    SyncHello {
        protocol: SYNC_PROTOCOL,
        layer: layer.parse().unwrap(),
        node: Some("robot-1".parse().unwrap()),
        worker_id: "w-1".to_owned(),
        version: "0.1.0".to_owned(),
        store_id: store_id.to_owned(),
        revision,
        digest: String::new(),
        without_texts: false,
    }
}

impl World {
    async fn worker(&self, hello: SyncHello) -> Copy {
        self.worker_over(hello, true).await
    }

    async fn worker_over(&self, hello: SyncHello, is_safe: bool) -> Copy {
        let caller = caller(&["worker"], Some(hello.layer.as_str()));
        let opened = self.service.sync(&caller, hello, is_safe).await.unwrap();
        let (items, session) = opened.into_parts();
        let mut copy = Copy {
            items,
            session,
            documents: BTreeMap::new(),
            revision: 0,
            resumed: false,
            told: Vec::new(),
        };
        let Some(SyncItem::Welcome { revision, resumed, .. }) = copy.items.next().await else {
            panic!("Welcome comes first");
        };
        (copy.revision, copy.resumed) = (revision, resumed);
        copy
    }

    async fn digest(&self, layer: &str) -> Value {
        let read = ReadOptions::default();
        let answer = self.service.digest(&self.admin, &layer.parse().unwrap(), &read).await;
        answer.unwrap().value
    }
}

impl Copy {
    /// Takes in what comes until everything up to a revision is known.
    async fn until(&mut self, revision: u64) -> String {
        let wait = async {
            loop {
                match self.items.next().await {
                    Some(SyncItem::Bookmark { revision: at, digest, .. }) => {
                        self.revision = self.revision.max(at);
                        assert_eq!(digest, self.digest(), "at {at}");
                        if at >= revision {
                            return digest;
                        }
                    }
                    Some(item) => self.take(item),
                    None => panic!("the stream ended at {}", self.revision),
                }
                if self.revision >= revision && !self.told.is_empty() {
                    return self.digest();
                }
            }
        };
        tokio::time::timeout(Duration::from_secs(20), wait).await.expect("it comes within 20 s")
    }

    fn take(&mut self, item: SyncItem) {
        match item {
            SyncItem::Snapshot { documents, .. } => {
                self.documents
                    .extend(documents.into_iter().map(|document| (document.key.clone(), document)));
            }
            SyncItem::Commit(commit) => {
                assert!(commit.previous < commit.revision);
                self.revision = commit.revision;
                for (op, document) in &commit.changes {
                    self.told.push((commit.revision, op.as_str(), document.key.to_string()));
                    match op {
                        WatchOp::Create | WatchOp::Update => {
                            self.documents.insert(document.key.clone(), Arc::clone(document));
                        }
                        WatchOp::Delete | WatchOp::Leave => {
                            self.documents.remove(&document.key);
                        }
                    }
                }
            }
            other => panic!("{other:?}"),
        }
    }

    fn digest(&self) -> String {
        canonical::digest(self.documents.iter().map(|(key, document)| {
            let service = key.service_name().map(blaze_domain::ServiceName::as_str);
            (key.kind(), service, key.name().as_str(), document.revision)
        }))
    }

    fn names(&self) -> Vec<String> {
        self.documents.keys().map(ToString::to_string).collect()
    }
}

#[tokio::test]
async fn a_new_worker_gets_what_its_layer_sees_and_then_every_change_of_it() {
    let w = world().await;
    w.robot().await;
    w.put("Layer/fog", json!({ "kind": "fog" })).await;
    w.put("Service/fog-only", json!({ "layers": ["fog"] })).await;
    let mut edge = w.worker(hello("edge", 0, "")).await;
    let mut fog = w.worker(hello("fog", 0, "")).await;
    assert!(!edge.resumed);
    edge.until(3).await;
    assert_eq!(edge.names(), ["Layer/edge", "Node/robot-1", "Service/slam", "Instance/slam/0"]);
    fog.until(3).await;
    assert_eq!(fog.names(), ["Layer/fog", "Service/fog-only", "Service/slam"]);

    // What moves to another layer takes along what is placed on it.
    w.patch("Node/robot-1", json!({ "spec": { "layer": "fog" } })).await.unwrap();
    edge.until(4).await;
    fog.until(4).await;
    assert_eq!(edge.names(), ["Layer/edge", "Service/slam"]);
    let moved =
        |op| vec![(4, op, "Node/robot-1".to_owned()), (4, op, "Instance/slam/0".to_owned())];
    assert_eq!((edge.told, fog.told.clone()), (moved("leave"), moved("update")));
    assert_eq!(fog.digest(), w.digest("fog").await["digest"]);
}

#[tokio::test]
async fn a_worker_that_was_away_gets_what_it_has_missed() {
    let w = world().await;
    w.robot().await;
    let store_id = w.service.store_id().to_owned();
    w.put("Layer/fog", json!({ "kind": "fog" })).await;
    w.put("Layer/edge", json!({ "kind": "edge", "config": { "a": 2 } })).await;
    let mut back = w.worker(hello("edge", 1, &store_id)).await;
    assert!(back.resumed);
    assert_eq!(back.revision, 3, "so it knows when it has all");
    let told = loop {
        match back.items.next().await.unwrap() {
            SyncItem::Commit(commit) => break (commit.previous, commit.revision),
            // It has none of the documents here, so their digest is of no use.
            SyncItem::Bookmark { .. } => {}
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(told, (1, 3));

    for (revision, store, digest, why) in [
        (1, "another", String::new(), "its copy is of another store"),
        (9, store_id.as_str(), String::new(), "it has what does not exist"),
        (1, store_id.as_str(), "sha256:0".to_owned(), "it has something else"),
        (0, store_id.as_str(), String::new(), "it has nothing"),
    ] {
        let asks = SyncHello { digest, ..hello("edge", revision, store) };
        let mut anew = w.worker(asks).await;
        assert!(!anew.resumed, "{why}");
        anew.until(3).await;
        assert_eq!(anew.documents.len(), 4, "{why}");
    }
    let right = SyncHello {
        digest: w.digest("edge").await["digest"].as_str().unwrap().to_owned(),
        ..hello("edge", 3, &store_id)
    };
    assert!(w.worker(right).await.resumed);
    w.service.trim(&w.admin, 4, None).await.unwrap();
    assert!(!w.worker(hello("edge", 1, &store_id)).await.resumed, "its past is gone");
}

#[tokio::test]
async fn secrets_go_in_clear_over_a_safe_connection_alone() {
    let w = world().await;
    w.put("Service/slam", json!({ "config": { "password": { "$secret": "canary" } } })).await;
    for (is_safe, shown) in [
        (true, json!({ "$secret": { "text": "canary", "version": 1 } })),
        (false, json!({ "$secret": { "redacted": true, "version": 1 } })),
    ] {
        let mut worker = w.worker_over(hello("edge", 0, ""), is_safe).await;
        worker.until(1).await;
        assert_eq!(worker.documents[&key("Service/slam")].config().unwrap()["password"], shown);
    }
    let mut blind = w.worker(SyncHello { without_texts: true, ..hello("edge", 0, "") }).await;
    blind.until(1).await;
    let mut live = w.worker(hello("edge", 0, "")).await;
    live.until(1).await;
    w.put("Service/slam", json!({ "config": { "password": { "$secret": "second" } } })).await;
    live.until(2).await;
    let document = &live.documents[&key("Service/slam")];
    assert_eq!(document.config().unwrap()["password"]["$secret"]["text"], "second");
    assert!(secret::contains(&document.spec));
    // Whoever wants none gets none, neither at the beginning nor later.
    assert_eq!(
        blind.documents[&key("Service/slam")].config().unwrap()["password"],
        json!({ "$secret": { "redacted": true, "version": 1 } })
    );
    blind.until(2).await;
    assert_eq!(
        blind.documents[&key("Service/slam")].config().unwrap()["password"],
        json!({ "$secret": { "redacted": true, "version": 2 } })
    );
}

#[tokio::test]
async fn only_the_worker_of_a_layer_is_told_of_it() {
    let w = world().await;
    w.robot().await;
    for (roles, layer, wants) in [
        (&["worker"][..], "fog", hello("edge", 0, "")),
        (&["admin"], "edge", hello("edge", 0, "")),
        (&["viewer"], "edge", hello("edge", 0, "")),
    ] {
        let refused = w.service.sync(&caller(roles, Some(layer)), wants, true).await;
        let code = refused.map(drop).unwrap_err().code;
        assert_eq!(code, Code::PermissionDenied, "{roles:?} of {layer}");
    }
    let nameless = SyncHello { worker_id: String::new(), ..hello("edge", 0, "") };
    for senseless in [SyncHello { protocol: 0, ..hello("edge", 0, "") }, nameless] {
        let refused = w.service.sync(&caller(&["worker"], Some("edge")), senseless, true).await;
        assert_eq!(refused.map(drop).unwrap_err().code, Code::InvalidRequest);
    }
}

#[tokio::test]
async fn a_slow_worker_misses_nothing() {
    let w = world().await;
    w.robot().await;
    let mut worker = w.worker(hello("edge", 0, "")).await;
    worker.until(1).await;
    for number in 0..1100 {
        w.patch("Node/robot-1", json!({ "spec": { "config": { "n": number } } })).await.unwrap();
    }
    // More than a watcher may be behind.
    worker.until(1101).await;
    assert_eq!(worker.told.len(), 1100);
    assert_eq!(worker.digest(), w.digest("edge").await["digest"]);
}

#[tokio::test]
async fn workers_that_do_not_read_on_keep_nobody_from_its_snapshot() {
    const AT_ONCE: usize = 8;
    let w = world().await;
    w.robot().await;
    let mut stuck = Vec::new();
    for _ in 0..AT_ONCE {
        let mut worker = w.worker(hello("edge", 0, "")).await;
        assert!(matches!(worker.items.next().await, Some(SyncItem::Snapshot { .. })));
        stuck.push(worker);
    }
    let mut next = w.worker(hello("edge", 0, "")).await;
    next.until(1).await;
    assert_eq!(next.documents.len(), 4);
}

#[tokio::test]
async fn what_a_worker_has_is_known_while_it_is_here_and_after() {
    let w = world().await;
    w.robot().await;
    let read = ReadOptions::default();
    let mut worker = w.worker(hello("edge", 0, "")).await;
    let digest = worker.until(1).await;
    let listed = |answer: Answer<Value>| answer.value["items"][0].clone();
    let before = listed(w.service.workers(&w.admin, &read).await.unwrap());
    assert_eq!((&before["connected"], &before["in_sync"]), (&json!(true), &json!(false)));

    let running = Running {
        service: "slam".parse().unwrap(),
        instance: "0".parse().unwrap(),
        node: Some("robot-1".parse().unwrap()),
    };
    let state = RunningState {
        state: "ready".to_owned(),
        config_revision: 1,
        config_hash: "sha256:1".to_owned(),
    };
    let has = Acknowledged::new(1, digest.clone(), [(running, state)], []);
    w.service.acknowledged(&worker.session, has);
    let after = listed(w.service.workers(&w.admin, &read).await.unwrap());
    assert_eq!((&after["in_sync"], &after["digest"]), (&json!(true), &json!(digest)));
    assert_eq!(after["worker_id"], "w-1");
    let topology = w.service.topology(&w.admin, &read).await.unwrap().value;
    let node = &topology["layers"][0]["nodes"][0];
    assert_eq!(node["worker"]["in_sync"], true);
    // No monitor has reported.
    let health = json!({ "state": "unknown", "since": null, "codes": [] });
    let slam = json!({
        "service": "slam", "instance": "0", "state": "ready", "config_revision": 1,
        "health": health,
    });
    assert_eq!((&node["services"], &node["health"]), (&json!([slam]), &health));

    // What it has is old now, and nobody of another layer is told of it.
    w.put("Layer/edge", json!({ "kind": "edge" })).await;
    assert_eq!(listed(w.service.workers(&w.admin, &read).await.unwrap())["in_sync"], false);
    assert_eq!(w.service.worker_lags().into_values().collect::<Vec<_>>(), [1]);
    let other = caller(&["viewer"], Some("fog"));
    assert_eq!(w.service.workers(&other, &read).await.unwrap().value["items"], json!([]));
    drop(worker);
    let gone = listed(w.service.workers(&w.admin, &read).await.unwrap());
    assert_eq!((&gone["connected"], &gone["in_sync"]), (&json!(false), &json!(false)));
    assert_eq!(gone["revision"], 1);
}

#[tokio::test]
async fn a_worker_is_told_to_come_again_when_the_service_ends() {
    let w = world().await;
    w.robot().await;
    let mut worker = w.worker(hello("edge", 0, "")).await;
    worker.until(1).await;
    w.service.end_watches();
    let mut rest = Vec::new();
    while let Some(item) =
        tokio::time::timeout(Duration::from_secs(10), worker.items.next()).await.unwrap()
    {
        rest.push(item);
    }
    let [SyncItem::GoAway { retry_after_ms, .. }, SyncItem::End(None)] = rest.as_slice() else {
        panic!("{rest:?}");
    };
    assert!((100..2000).contains(retry_after_ms));
}
