//! Both ends of `Sync` across versions: what was recorded with the version before is understood by
//! the main service and the worker of today, with more in it than they know, and versions that are
//! too far apart are told so.
//!
//! The recordings are in `tests/fixtures/sync`. A new version of the protocol brings one of its
//! own: `BLAZE_RECORD_SYNC=FILE` lets the first test write it.

use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use blaze_proto::v1;
use blaze_proto::v1::sync_request::Msg as Said;
use blaze_proto::v1::sync_response::Msg as Told;
use bytes::Bytes;
use futures::StreamExt as _;
use prost::Message as _;
use reqwest::Method;
use serde_json::{Value, json};

use super::kit::Robot;
use super::raw::{RawMain, RawStream, Session};
use super::recorded::{
    Recorded, count, fixture, last_digest, read, said, told, with_unknown, write,
};
use super::stage::{PATIENCE, Stage, Worker};

/// The version that main service and worker of today speak.
const PROTOCOL: u32 = 2;
/// What stands in the recordings as a secret.
const CANARY: &str = "canary-of-the-wire";

/// Passes one stream on, both ways, and notes what passes, until either end ends it or `is_over`
/// says so.
async fn pass(
    number: usize,
    session: Session,
    main: SocketAddr,
    is_over: impl Fn(&[Recorded]) -> bool,
) -> Vec<Recorded> {
    let Session { mut said, tell } = session;
    let mut recorded = Vec::new();
    let note = |by_worker: bool, bytes: &Bytes| Recorded {
        stream: number,
        by_worker,
        bytes: bytes.clone(),
    };
    let hello = said.next().await.unwrap().unwrap();
    recorded.push(note(true, &hello));
    let mut stream = RawStream::open(main, hello).await.unwrap();
    while !is_over(&recorded) {
        tokio::select! {
            Some(Ok(bytes)) = said.next() => {
                recorded.push(note(true, &bytes));
                stream.say.send(bytes).await.unwrap();
            }
            Some(Ok(bytes)) = stream.told.next() => {
                recorded.push(note(false, &bytes));
                tell.send(Ok(bytes)).await.unwrap();
            }
            else => break,
        }
    }
    recorded
}

async fn documents(stage: &Stage) {
    let documents = json!([
        { "kind": "Layer", "name": "edge", "spec": { "kind": "edge" } },
        { "kind": "Layer", "name": "fog", "spec": { "kind": "fog" } },
        {
            "kind": "Node",
            "name": "robot-1",
            "labels": { "canary": "true" },
            "spec": { "layer": "edge" },
        },
        {
            "kind": "Service",
            "name": "slam",
            "spec": { "config": { "n": 1, "password": { "$secret": CANARY } } },
        },
        { "kind": "Service", "name": "nav", "spec": { "config": { "n": 1 } } },
        { "kind": "Service", "name": "map", "spec": { "config": { "n": 1 } } },
        { "kind": "Instance", "service": "slam", "name": "0", "spec": { "node": "robot-1" } },
    ]);
    stage.send(Method::POST, "/apply", Some(&documents)).await;
}

/// What happens while the first stream is open: every kind of change, a roll-out, and a service
/// that says how it is.
async fn changes(stage: &Stage, robot: &Robot, worker: &Worker) -> u64 {
    stage.put("/services/slam", json!({ "config": { "n": 2 } })).await;
    stage.send(Method::DELETE, "/services/nav", None).await;
    stage.put("/services/map", json!({ "config": { "n": 1 }, "layers": ["fog"] })).await;
    let rollout = json!({ "name": "faster", "spec": {
        "target": { "kind": "Service", "name": "slam" }, "patch": { "config": { "n": 3 } },
        "canary": { "node_selector": "canary=true" }, "gate": {
            "window_s": 600,
            "max_unhealthy": 0,
        },
    } });
    stage.send(Method::POST, "/rollouts", Some(&rollout)).await;
    let ack = json!({ "service": "slam", "instance": "0", "node": "robot-1", "status": "applied" });
    let service = robot.service().await;
    service.publish("blaze/config/ack", &ack);
    let is_known = |status: &Value| {
        status["services"].as_array().unwrap().iter().any(|one| one["state"] == "ready")
    };
    worker.until("the service is known", is_known).await;
    stage.get("/digest?layer=edge").await["revision"].as_u64().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_said_today_is_recorded() {
    let stage = Stage::new();
    let mut main = stage.main();
    documents(&stage).await;
    let mut between = RawMain::start().await;
    let robot = Robot::new(&stage, "robot-1").with(&json!({
        "config": { "server": format!("http://{}", between.address) },
        "worker": { "deliver_secrets": true },
    }));
    let worker = robot.worker_unready(&stage);
    let session = between.session().await;
    let told_all = |recorded: &[Recorded]| {
        // A whole picture: all changes, and an Ack in which the service and the roll-out are.
        let is_whole = |one: &Recorded| {
            let Said::Ack(ack) = said(&one.bytes) else { return false };
            !ack.services.is_empty() && !ack.rollouts.is_empty()
        };
        let acks = recorded.iter().filter(|one| one.by_worker);
        count(recorded, "Commit") >= 4 && acks.filter(|one| is_whole(one)).count() > 0
    };
    let passing = pass(0, session, stage.grpc, told_all);
    let changing = async {
        // It is ready when it has been told something, which the other future passes on.
        let worker = tokio::task::spawn_blocking(|| worker.ready()).await.unwrap();
        worker.until("the worker is in sync", |status| status["source"] == "main").await;
        let revision = changes(&stage, &robot, &worker).await;
        (worker, revision)
    };
    let (mut recorded, (worker, revision)) = tokio::join!(passing, changing);
    // The second stream goes on from there, and ends when the main service does.
    let session = between.session().await;
    let passing = pass(1, session, stage.grpc, |recorded| count(recorded, "GoAway") > 0);
    let ending = async {
        let is_there = |status: &Value| {
            status["revision"].as_u64() >= Some(revision) && status["source"] == "main"
        };
        worker.until("the worker is in sync again", is_there).await;
        main.ask_to_end().unwrap();
    };
    let (second, ()) = tokio::join!(passing, ending);
    recorded.extend(second);
    for kind in ["Hello", "Ack", "Welcome", "Snapshot", "Commit", "Bookmark", "GoAway"] {
        assert!(count(&recorded, kind) > 0, "no {kind}");
    }
    let resumed =
        recorded.iter().filter(|one| one.stream == 1 && !one.by_worker).find_map(|one| match told(
            &one.bytes,
        ) {
            Told::Welcome(welcome) => Some(welcome.resumed),
            _ => None,
        });
    assert_eq!(resumed, Some(true));
    if let Some(path) = blaze_runtime::environment::variable("BLAZE_RECORD_SYNC") {
        write(Path::new(&path), &recorded);
    }
    main.exit(PATIENCE).unwrap();
}

/// A worker that was recorded, with members that today's main service does not know.
async fn is_served(stage: &Stage, recorded: &[Recorded], protocol: u32) {
    let mut of_first = recorded.iter().filter(|one| one.by_worker && one.stream == 0).cloned();
    let hello = of_first.next().unwrap();
    let Said::Hello(greeting) = said(&hello.bytes) else { panic!("Hello comes first") };
    assert_eq!(greeting.protocol, protocol);
    let mut stream = RawStream::open(stage.grpc, with_unknown(&hello.bytes)).await.unwrap();
    let mut documents = 0;
    loop {
        let next = tokio::time::timeout(PATIENCE, stream.told.next()).await.unwrap();
        match told(&next.unwrap().unwrap()) {
            Told::Welcome(welcome) => {
                assert_eq!((welcome.protocol, welcome.resumed), (protocol, false));
            }
            Told::Snapshot(part) => documents += part.documents.len(),
            Told::Bookmark(bookmark) => {
                assert!(bookmark.digest.starts_with("sha256:"));
                break;
            }
            other => panic!("{other:?}"),
        }
    }
    // Without layer `fog`, and the service that `edge` does not see.
    assert_eq!(documents, 6);
    let mut last = None;
    for ack in of_first {
        let Said::Ack(has) = said(&ack.bytes) else { continue };
        stream.say.send(with_unknown(&ack.bytes)).await.unwrap();
        last = Some(has);
    }
    let last = last.unwrap();
    let start = tokio::time::Instant::now();
    loop {
        let workers = stage.get("/workers").await;
        let items = workers["items"].as_array().unwrap();
        let known =
            items.iter().find(|one| one["worker_id"] == greeting.worker_id.as_str()).unwrap();
        if known["revision"] == last.revision && known["digest"] == last.digest.as_str() {
            assert_eq!(
                (&known["version"], &known["connected"]),
                (&json!(greeting.version), &json!(true))
            );
            break;
        }
        assert!(start.elapsed() < PATIENCE, "{workers}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    // And it goes on being told.
    let revision = stage.put("/services/slam", json!({ "config": { "n": 9 + protocol } })).await;
    loop {
        let next = tokio::time::timeout(PATIENCE, stream.told.next()).await.unwrap();
        match told(&next.unwrap().unwrap()) {
            Told::Commit(commit) => {
                assert_eq!(commit.revision, revision);
                break;
            }
            Told::Bookmark(_) => {}
            other => panic!("{other:?}"),
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_main_service_serves_workers_that_were_recorded() {
    let stage = Stage::new();
    let _main = stage.main();
    documents(&stage).await;
    for protocol in [PROTOCOL - 1, PROTOCOL] {
        is_served(&stage, &read(&fixture(protocol)), protocol).await;
    }
}

/// Says what a main service was recorded to say in one stream.
async fn replay(session: &Session, recorded: &[Recorded], stream: usize) {
    for one in recorded.iter().filter(|one| !one.by_worker && one.stream == stream) {
        session.tell.send(Ok(with_unknown(&one.bytes))).await.unwrap();
        // A message of a kind that nobody knows.
        session.tell.send(Ok(Bytes::from_static(&[0xfa, 0x01, 0x00]))).await.unwrap();
    }
}

async fn hello(session: &mut Session) -> v1::Hello {
    match said(&session.said.next().await.unwrap().unwrap()) {
        Said::Hello(hello) => hello,
        Said::Ack(ack) => panic!("Hello comes first: {ack:?}"),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_worker_understands_main_services_that_were_recorded() {
    for protocol in [PROTOCOL - 1, PROTOCOL] {
        let recorded = read(&fixture(protocol));
        let stage = Stage::new();
        let mut main = RawMain::start().await;
        // Secrets are redacted here; a main service of version 1 sends them all the same.
        let robot = Robot::new(&stage, "robot-1").with(&json!({
            "config": { "server": format!("http://{}", main.address) },
            "worker": { "deliver_secrets": false },
        }));
        let worker = robot.worker_unready(&stage);
        let mut first = main.session().await;
        let greeting = hello(&mut first).await;
        assert_eq!((greeting.protocol, greeting.without_texts), (PROTOCOL, true));
        replay(&first, &recorded, 0).await;
        let worker = tokio::task::spawn_blocking(|| worker.ready()).await.unwrap();
        let (revision, digest) = last_digest(&recorded);
        let is_tried = |status: &Value| status["rollouts"][0]["phase"] == "applied";
        worker.until("it has what was recorded", is_tried).await;
        drop(first);
        // What comes now goes on from there.
        let mut second = main.session().await;
        let greeting = hello(&mut second).await;
        assert!(greeting.revision > 0 && !greeting.store_id.is_empty(), "{greeting:?}");
        replay(&second, &recorded, 1).await;
        let has_all =
            |status: &Value| status["digest"] == digest.as_str() && status["revision"] == revision;
        worker.until("it has all that was recorded", has_all).await;
        let mut service = robot.service().await;
        let answer = service.ask(json!({ "service": "slam", "instance": "0" }), PATIENCE).await;
        assert_eq!(answer["config"]["n"], 3, "the roll-out counts: {answer}");
        for name in ["nav", "map"] {
            let answer = service.ask(json!({ "service": name }), PATIENCE).await;
            assert_eq!(answer["error"]["code"], "not_found", "{name}: {answer}");
        }
        drop(second);
        let is_told = |status: &Value| {
            status["reason"].as_str().is_some_and(|reason| reason.contains("ending"))
        };
        worker.until("why the stream ended", is_told).await;
        assert!(!worker.status().await.to_string().contains(CANARY));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_main_service_tells_workers_that_are_too_far_apart() {
    let stage = Stage::new();
    let _main = stage.main();
    documents(&stage).await;
    let greeting = |protocol| v1::SyncRequest {
        msg: Some(Said::Hello(v1::Hello {
            protocol,
            layer: "edge".to_owned(),
            worker_id: "w".to_owned(),
            ..v1::Hello::default()
        })),
    };
    for protocol in [PROTOCOL - 1, PROTOCOL, PROTOCOL + 1] {
        let hello = Bytes::from(greeting(protocol).encode_to_vec());
        let mut stream = RawStream::open(stage.grpc, hello).await.unwrap();
        let Told::Welcome(welcome) = told(&stream.told.next().await.unwrap().unwrap()) else {
            panic!("Welcome comes first")
        };
        assert_eq!(welcome.protocol, protocol.min(PROTOCOL));
    }
    let too_new = Bytes::from(greeting(PROTOCOL + 2).encode_to_vec());
    let mut stream = RawStream::open(stage.grpc, too_new).await.unwrap();
    let Told::GoAway(away) = told(&stream.told.next().await.unwrap().unwrap()) else {
        panic!("it is sent away")
    };
    assert!(away.reason.contains("update the older of the two"), "{away:?}");
    assert!(stream.told.next().await.is_none(), "nothing else is said");
    let none = Bytes::from(greeting(PROTOCOL - 2).encode_to_vec());
    let refused = RawStream::open(stage.grpc, none).await.err().unwrap();
    assert_eq!(refused.code(), tonic::Code::InvalidArgument, "{refused}");
}
