//! One worker for a whole layer, on Kafka and on DDS: what services ask, are told and say, and what
//! who comes late finds.

use std::collections::BTreeMap;
use std::time::Duration;

use blaze_brokers::Subscription;
use blaze_domain::Scope;
use blaze_sdk::{AckStatus, ServiceManager, ServiceOptions, ServiceState};
use blaze_tests::flow::free_domain;
use blaze_tests::process::Process;
use blaze_tests::servers::{shared_kafka, unique_name};
use serde_json::{Value, json};
use tokio::sync::mpsc;

use super::stage::{PATIENCE, Stage, Worker, next, rest};

/// How long silence must last to count as silence.
const SILENCE: Duration = Duration::from_millis(300);

pub(super) fn rate(rate_hz: u64) -> Value {
    json!({ "node": "robot-1", "config": { "camera": { "rate_hz": rate_hz } } })
}

/// A section of the layer's broker on the Kafka that tests share, with names of its own.
pub(super) fn on_shared_kafka() -> (Value, String, String) {
    let (bootstrap, prefix) = (shared_kafka().unwrap(), format!("{}.", unique_name("worker")));
    let section = json!({ "kafka": { "bootstrap": [bootstrap], "prefix": prefix } });
    (section, bootstrap, prefix)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn on_kafka_a_whole_layer_is_served() {
    let (section, ..) = on_shared_kafka();
    let stage = Stage::of_layer(&section);
    let (_main, worker, last) = everything(&stage).await;
    // Of each instance there is the last notice alone.
    let service = stage.service().await;
    let mut late = service.listen_late("slam").await;
    let mut found = BTreeMap::new();
    for _ in 0..last.len() {
        let notice = next(&mut late).await;
        found.insert(notice["instance"].to_string(), notice["revision"].clone());
    }
    assert_eq!(found, last);
    let mut more = Vec::new();
    let silence = tokio::time::timeout(SILENCE, late.receive(&mut more, 1)).await;
    assert!(silence.is_err(), "{more:?}");
    worker.stop();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn on_dds_a_whole_layer_is_served() {
    let domain = free_domain().unwrap();
    let stage = Stage::of_layer(&json!({ "dds": { "domain": domain, "interface": "127.0.0.1" } }));
    let (_main, worker, last) = everything(&stage).await;
    // There are no keys: the last notices come in their order.
    let service = stage.service().await;
    let mut late = service.listen_late("slam").await;
    let mut found = BTreeMap::new();
    while found != last {
        let notice = next(&mut late).await;
        found.insert(notice["instance"].to_string(), notice["revision"].clone());
    }
    worker.stop();
}

/// Has a layer served. Gives the revision that each instance of `slam` was told last.
async fn everything(stage: &Stage) -> (Process, Worker, BTreeMap<String, Value>) {
    let main = stage.main();
    let first = stage.robot().await;
    let worker = stage.worker("server-1");
    stage.equal(&worker, PATIENCE).await;
    answers(stage).await;
    let last = notices(stage, &worker, first).await;
    by_the_sdk(stage, &worker).await;
    let service = stage.service().await;
    let mut nav = service.listen("nav").await;
    stage.send(reqwest::Method::DELETE, "/services/nav", None).await;
    // On DDS, whose clocks are compared, what was told before may come as if it were new.
    let mut notice = next(&mut nav).await;
    while notice["revision"] == first {
        notice = next(&mut nav).await;
    }
    assert_eq!(
        (&notice["deleted"], &notice["config"], &notice["hash"]),
        (&json!(true), &json!(null), &json!(null))
    );
    // Whoever comes late still hears of it.
    let mut late = service.listen_late("nav").await;
    let mut notice = next(&mut late).await;
    while notice["deleted"] != true {
        notice = next(&mut late).await;
    }
    let slam = service.listen_late("slam").await;
    let last = until_told(slam, &last, stage).await;
    (main, worker, last)
}

/// What the main service has last told of `slam`: of the instance, and of the service without.
async fn until_told(
    mut slam: Subscription,
    last: &BTreeMap<String, Value>,
    stage: &Stage,
) -> BTreeMap<String, Value> {
    let mut found: BTreeMap<String, Value> = BTreeMap::new();
    let effective = stage.get("/effective?service=slam&instance=0").await;
    loop {
        let notice = next(&mut slam).await;
        let instance = notice["instance"].to_string();
        let before = found.insert(instance.clone(), notice["revision"].clone());
        assert!(
            before.and_then(|before| before.as_u64()) <= notice["revision"].as_u64(),
            "nothing older after something newer"
        );
        let is_last = notice["instance"] != "0" || notice["hash"] == effective["hash"];
        if is_last && last.keys().all(|key| found.contains_key(key)) {
            return found;
        }
    }
}

async fn answers(stage: &Stage) {
    let mut service = stage.service().await;
    let asks = json!({ "service": "slam", "instance": "0", "node": "robot-1" });
    let answer = service.ask(asks.clone(), PATIENCE).await;
    let effective = stage.get("/effective?service=slam&instance=0").await;
    assert_eq!((&answer["config"], &answer["hash"]), (&effective["config"], &effective["hash"]));
    assert_eq!(
        (&answer["source"], &answer["layer"], &answer["node"]),
        (&json!("main"), &json!("edge"), &json!("robot-1"))
    );
    let mut again = asks;
    again["hash"] = answer["hash"].clone();
    assert_eq!(service.ask(again, PATIENCE).await["unchanged"], true);
    let misspelt = service.ask(json!({ "service": "slamm" }), PATIENCE).await;
    assert_eq!(misspelt["error"]["code"], "not_found");
}

async fn notices(stage: &Stage, worker: &Worker, first: u64) -> BTreeMap<String, Value> {
    let service = stage.service().await;
    let (mut slam, mut nav) = (service.listen("slam").await, service.listen("nav").await);
    // A subscription may reach the network only now; from the first notice on none is missing.
    let mut revision = 0;
    for rate_hz in [10, 11, 12] {
        revision = stage.put("/services/slam/instances/0", rate(rate_hz)).await;
        let mut notice = next(&mut slam).await;
        while notice["config"]["camera"]["rate_hz"] != rate_hz {
            notice = next(&mut slam).await;
        }
        assert_eq!(
            (&notice["instance"], &notice["node"], &notice["revision"]),
            (&json!("0"), &json!("robot-1"), &json!(revision))
        );
        assert_eq!(
            (&notice["paths"], &notice["scopes"]),
            (&json!(["/camera/rate_hz"]), &json!(["instance"]))
        );
    }
    let config = json!({ "config": { "camera": { "rate_hz": 30 }, "mode": "map" } });
    let of_service = stage.put("/services/slam", config).await;
    let mut last = BTreeMap::from([("\"0\"".to_owned(), json!(revision))]);
    while last.len() < 2 || last.values().any(|revision| *revision != of_service) {
        let notice = next(&mut slam).await;
        last.insert(notice["instance"].to_string(), notice["revision"].clone());
    }
    let of_nav = rest(&mut nav).await;
    assert!(
        of_nav.iter().all(|notice| notice["revision"] == first),
        "it concerns nobody else: {of_nav:?}"
    );
    // Who is there from the first moment on hears of the first change.
    stage.apply(&[("Service", "late", json!({ "config": { "x": 1 } }))]).await;
    stage.equal(worker, PATIENCE).await;
    let mut late = service.listen("late").await;
    let revision = stage.put("/services/late", json!({ "config": { "x": 2 } })).await;
    let mut notice = next(&mut late).await;
    while notice["config"]["x"] != 2 {
        notice = next(&mut late).await;
    }
    assert_eq!((&notice["instance"], &notice["revision"]), (&json!(null), &json!(revision)));
    last
}

/// A service of the SDK: its configuration, its changes, its acknowledgement and its sign of life.
async fn by_the_sdk(stage: &Stage, worker: &Worker) {
    let options = ServiceOptions::new(
        "edge".parse().unwrap(),
        "slam".parse().unwrap(),
        stage.broker().await,
        Scope::Layer,
    );
    let service = ServiceManager::start(options.on_node("robot-1".parse().unwrap())).await.unwrap();
    let (told, mut changes) = mpsc::channel(64);
    let config = service.config();
    let _listener = config.on_change(move |change| {
        told.try_send((change.revision, change.new.clone())).unwrap();
    });
    let start = tokio::time::Instant::now();
    config.ready(PATIENCE).await.unwrap();
    println!("the first configuration after {:?}", start.elapsed());
    let mut change = async |rate_hz: u64| {
        loop {
            let change = tokio::time::timeout(PATIENCE, changes.recv()).await;
            let (revision, new) = change.expect("a change in time").unwrap();
            if new.is_some_and(|new| new["camera"]["rate_hz"] == rate_hz) {
                return revision;
            }
        }
    };
    change(12).await;
    let revision = stage.put("/services/slam/instances/0", rate(20)).await;
    let start = tokio::time::Instant::now();
    assert_eq!(change(20).await, revision);
    println!("the change after {:?}", start.elapsed());
    config.ack(AckStatus::Applied, "").unwrap();
    until_known(stage, worker, |known| known["config_revision"] == revision).await;
    service.cache().set_state(ServiceState::Ready);
    until_known(stage, worker, |known| known["state"] == "ready").await;
    service.shutdown().await;
}

/// Waits until the main service knows of the instance.
async fn until_known(stage: &Stage, worker: &Worker, is_good: impl Fn(&Value) -> bool) {
    let start = tokio::time::Instant::now();
    loop {
        let topology = stage.get("/topology").await;
        let nodes = topology["layers"][0]["nodes"].as_array().unwrap();
        let robot = nodes.iter().find(|node| node["name"] == "robot-1").unwrap();
        let slam = robot["services"]
            .as_array()
            .unwrap()
            .iter()
            .find(|known| known["service"] == "slam" && known["instance"] == "0");
        if slam.is_some_and(&is_good) {
            return;
        }
        assert!(start.elapsed() < PATIENCE, "{topology}; {}", worker.tail());
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}
