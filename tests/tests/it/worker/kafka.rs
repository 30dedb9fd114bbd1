//! What is special to Kafka: keys, plain clients, a broker that dies.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use blaze_tests::plain::{KafkaReader, KafkaWriter, Record};
use blaze_tests::servers::{KafkaOptions, KafkaServer};
use serde_json::{Value, json};

use super::layer::{on_shared_kafka, rate};
use super::stage::{PATIENCE, Stage, next, rest};

fn value(record: &Record) -> Value {
    serde_json::from_slice(&record.payload).unwrap()
}

fn key(record: &Record) -> String {
    String::from_utf8(record.key.clone()).unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_plain_client_asks_and_reads_json_with_keys() {
    let (section, bootstrap, prefix) = on_shared_kafka();
    let stage = Stage::of_layer(&section);
    let _main = stage.main();
    stage.robot().await;
    let worker = stage.worker("server-1");
    stage.equal(&worker, PATIENCE).await;
    // Who asks once asks a worker that has the lease.
    worker.until("it leads", |status| status["leader"] == true).await;
    let topic = |name: &str| format!("{prefix}{name}");
    let replies = KafkaReader::from_end(&bootstrap, &topic("blaze.reply")).unwrap();
    let changed =
        KafkaReader::from_beginning(&bootstrap, &topic("blaze.config.changed.slam")).unwrap();
    let writer = KafkaWriter::new(&bootstrap).unwrap();
    let ask = |request: &Value| {
        let text = request.to_string();
        writer.produce(&topic("blaze.config.get"), text.as_bytes()).unwrap();
    };
    // Without an id nobody could tell whose answer it is.
    ask(&json!({ "service": "slam", "instance": "0", "node": "robot-1" }));
    ask(&json!({
        "id": "7f1c",
        "service": "slam",
        "instance": "0",
        "node": "robot-1",
        "reply_to": "blaze/reply/me",
    }));
    let answer = replies.next(PATIENCE).expect("an answer");
    assert_eq!((key(&answer).as_str(), answer.headers.len()), ("7f1c", 0));
    assert_eq!(
        (&value(&answer)["id"], &value(&answer)["config"]["camera"]["rate_hz"]),
        (&json!("7f1c"), &json!(30))
    );
    let refused = "blaze_worker_requests_total{result=\"refused\"} 1";
    let start = tokio::time::Instant::now();
    while !worker.text("/metrics").await.contains(refused) {
        assert!(start.elapsed() < PATIENCE, "{}", worker.text("/metrics").await);
        tokio::time::sleep(Duration::from_millis(20)).await;
    }

    let revision = stage.put("/services/slam/instances/0", rate(10)).await;
    let mut notice = changed.next(PATIENCE).expect("a notice");
    while value(&notice)["revision"] != revision {
        notice = changed.next(PATIENCE).expect("a notice");
    }
    assert_eq!((key(&notice).as_str(), notice.headers.len()), ("0", 0));
    assert_eq!(value(&notice)["config"]["camera"]["rate_hz"], 10);
    let revision = stage.put("/services/slam", json!({ "config": { "x": 1 } })).await;
    let mut keys = BTreeMap::new();
    while keys.len() < 2 {
        let notice = changed.next(PATIENCE).expect("a notice");
        assert_eq!(value(&notice)["revision"], revision);
        keys.insert(key(&notice), value(&notice)["instance"].clone());
    }
    let expected = BTreeMap::from([(String::new(), json!(null)), ("0".to_owned(), json!("0"))]);
    assert_eq!(keys, expected);

    // The topic of a service that comes later is there before anything is said of it.
    stage.apply(&[("Service", "late", json!({}))]).await;
    let late = KafkaReader::from_end(&bootstrap, &topic("blaze.config.changed.late")).unwrap();
    stage.put("/services/late", json!({ "config": { "x": 1 } })).await;
    let mut notice = late.next(PATIENCE).expect("a notice");
    while value(&notice)["config"]["x"] != 1 {
        notice = late.next(PATIENCE).expect("a notice");
    }
    worker.stop();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_the_broker_was_killed_the_last_state_comes_and_nothing_older_after_it() {
    let server = KafkaServer::start(KafkaOptions::default()).unwrap();
    let bootstrap = server.bootstrap();
    let stage = Stage::of_layer(&json!({ "kafka": { "bootstrap": [bootstrap] } }));
    let _main = stage.main();
    stage.robot().await;
    let worker = stage.worker("server-1");
    stage.equal(&worker, PATIENCE).await;
    let mut service = stage.service().await;
    let (mut slam, mut nav) = (service.listen("slam").await, service.listen("nav").await);
    stage.put("/services/slam/instances/0", rate(1)).await;
    // What was said at the start may come only now.
    while next(&mut slam).await["config"]["camera"]["rate_hz"] != 1 {}
    rest(&mut nav).await;
    // Changes before, while and after it is away.
    stage.put("/services/slam/instances/0", rate(2)).await;
    server.kill().unwrap();
    for rate_hz in 3..8 {
        stage.put("/services/slam/instances/0", rate(rate_hz)).await;
    }
    stage.send(reqwest::Method::DELETE, "/services/nav", None).await;
    server.restart().unwrap();
    let last = stage.put("/services/slam/instances/0", rate(9)).await;
    let mut seen = vec![next(&mut slam).await["revision"].as_u64().unwrap()];
    while seen.last() != Some(&last) {
        seen.push(next(&mut slam).await["revision"].as_u64().unwrap());
    }
    assert!(seen.is_sorted(), "{seen:?}");
    assert!(seen.len() <= 4, "no replay of what nobody needs any more: {seen:?}");
    while next(&mut nav).await["deleted"] != true {}
    let asks = json!({ "service": "slam", "instance": "0", "node": "robot-1" });
    assert_eq!(service.ask(asks, PATIENCE).await["config"]["camera"]["rate_hz"], 9);
    // A worker that lost its lease with the broker takes over from itself, and says once more what
    // holds, for the service and for each instance.
    let again = rest(&mut slam).await;
    let mut told = BTreeSet::new();
    let mut is_first = |notice: &Value| told.insert(notice["instance"].to_string());
    assert!(again.iter().all(|it| it["revision"] == last && is_first(it)), "{again:?}");

    // The topic itself says the same to whoever reads it from its beginning.
    let plain = KafkaReader::from_beginning(&bootstrap, "blaze.config.changed.slam").unwrap();
    let mut revisions = Vec::new();
    while revisions.last() != Some(&last) {
        let record = plain.next(PATIENCE).expect("the last notice");
        if key(&record) == "0" {
            revisions.push(value(&record)["revision"].as_u64().unwrap());
        }
    }
    assert!(revisions.is_sorted(), "{revisions:?}");
    worker.stop();
}
