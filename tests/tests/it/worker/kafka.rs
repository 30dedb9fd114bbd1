//! What is special to Kafka: keys, plain clients, several workers, a broker that dies.

use std::collections::BTreeMap;
use std::time::Duration;

use blaze_tests::flow::{FlowProcess, FlowSpec};
use blaze_tests::plain::{KafkaReader, KafkaWriter, Record};
use blaze_tests::servers::{KafkaOptions, KafkaServer};
use serde_json::{Value, json};

use super::flow::{has_limit, is_configured, layer, limit};
use super::layer::{on_shared_kafka, rate};
use super::secrets::{self, CANARY, clean, config};
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
    let changed = KafkaReader::from_beginning(&bootstrap, &topic("blaze.config.changed.slam")).unwrap();
    let writer = KafkaWriter::new(&bootstrap).unwrap();
    let ask = |request: &Value| {
        let text = request.to_string();
        writer.produce(&topic("blaze.config.get"), text.as_bytes()).unwrap();
    };
    // Without an id nobody could tell whose answer it is.
    ask(&json!({ "service": "slam", "instance": "0", "node": "robot-1" }));
    ask(&json!({ "id": "7f1c", "service": "slam", "instance": "0", "node": "robot-1", "reply_to": "blaze/reply/me" }));
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
async fn of_two_workers_all_hear_and_one_answers() {
    let (section, bootstrap, prefix) = on_shared_kafka();
    let stage = Stage::of_layer(&section).with_cache();
    let _main = stage.main();
    stage.robot().await;
    let lease = json!({ "lease_ms": 5000 });
    let one = stage.worker_with("server-1", lease.clone());
    one.until("the first has the lease", |status| status["leader"] == true)
        .await;
    let other = stage.worker_with("server-2", lease);
    stage.equal(&one, PATIENCE).await;
    stage.equal(&other, PATIENCE).await;
    let mut service = stage.service().await;
    let replies = KafkaReader::from_end(&bootstrap, &format!("{prefix}blaze.reply")).unwrap();
    let asks = json!({ "service": "slam", "instance": "0", "node": "robot-1" });
    for _ in 0..5 {
        service.ask(asks.clone(), PATIENCE).await;
    }
    let mut answers: BTreeMap<String, usize> = BTreeMap::new();
    // All that were asked for, and then no other.
    let time = |count: usize| {
        if count < 5 {
            PATIENCE
        } else {
            Duration::from_millis(500)
        }
    };
    while let Some(answer) = replies.next(time(answers.len())) {
        *answers.entry(key(&answer)).or_default() += 1;
    }
    assert!(
        answers.len() >= 5 && answers.values().all(|count| *count == 1),
        "{answers:?}"
    );
    let left = |metrics: &str| {
        let line = metrics.lines().find(|line| line.contains("result=\"left_to_others\""));
        line.and_then(|line| line.rsplit(' ').next()?.parse::<f64>().ok())
    };
    let start = tokio::time::Instant::now();
    while left(&other.text("/metrics").await).is_none_or(|heard| heard < 5.0) {
        assert!(start.elapsed() < PATIENCE, "all hear: {}", other.text("/metrics").await);
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert_eq!(left(&one.text("/metrics").await), Some(0.0));

    let mut slam = service.listen("slam").await;
    one.kill();
    let revision = stage.put("/services/slam/instances/0", rate(10)).await;
    other
        .until("the other takes over", |status| status["leader"] == true)
        .await;
    let mut notice = next(&mut slam).await;
    while notice["revision"] != revision {
        notice = next(&mut slam).await;
    }
    assert_eq!(service.ask(asks, PATIENCE).await["config"]["camera"]["rate_hz"], 10);
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
    assert_eq!(rest(&mut slam).await, [json!(null); 0]);

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

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_services_are_not_told_is_nowhere_on_kafka() {
    let server = KafkaServer::start(KafkaOptions::default()).unwrap();
    let stage = Stage::of_layer(&json!({ "kafka": { "bootstrap": [server.bootstrap()] } }));
    let log = stage.path("main.log");
    let _main = stage.main_at("trace", Some(&log));
    secrets::documents(&stage).await;
    let worker = stage.worker_with("server-1", json!({ "deliver_secrets": false }));
    stage.equal(&worker, PATIENCE).await;
    let mut service = stage.service().await;
    let mut slam = service.listen("slam").await;
    let mut plain = service
        .ask(
            json!({ "service": "slam", "instance": "0", "node": "robot-1" }),
            PATIENCE,
        )
        .await;
    assert!(clean("the answer", &plain.to_string()), "{plain}");
    for number in [30, 40, 50] {
        let revision = stage.put("/services/slam", json!({ "config": config(number) })).await;
        plain = next(&mut slam).await;
        while plain["revision"] != revision {
            plain = next(&mut slam).await;
        }
        assert!(clean("the notice", &plain.to_string()), "{plain}");
    }
    stage.send(reqwest::Method::DELETE, "/services/nav", None).await;
    stage.equal(&worker, PATIENCE).await;
    assert_eq!(worker.process.count_in_memory(CANARY.as_bytes()).unwrap(), 0);
    clean("the log of the worker", &worker.tail());
    worker.stop();
    server.kill().unwrap();
    let stored = server.stored().unwrap();
    assert!(
        clean("Kafka", &String::from_utf8_lossy(&stored)),
        "{} bytes hold no notice",
        stored.len()
    );
    println!("Kafka holds {} bytes, none of them of a secret", stored.len());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_flow_on_kafka_takes_its_settings_from_the_worker_of_the_layer_whoever_starts_first() {
    let (section, bootstrap, prefix) = on_shared_kafka();
    let stage = Stage::of_layer(&section);
    let spec = || FlowSpec {
        limit_mbps: 30.0,
        ..FlowSpec::new("edge", "robot-1").on_kafka(&bootstrap, &prefix)
    };
    let flow = FlowProcess::start(spec()).unwrap();
    has_limit(&flow, 30.0, PATIENCE);
    let _main = stage.main();
    stage.robot().await;
    stage.put("/layers/edge", layer(&limit(12.0))).await;
    let worker = stage.worker("server-1");
    let first = has_limit(&flow, 12.0, PATIENCE);
    is_configured(&worker).await;
    let service = stage.service().await;
    let mut slam = service.listen("slam").await;
    rest(&mut slam).await;
    stage.put("/layers/edge", layer(&limit(9.5))).await;
    let took = has_limit(&flow, 9.5, PATIENCE);
    drop(flow);
    let again = FlowProcess::start(spec()).unwrap();
    let started = has_limit(&again, 9.5, PATIENCE);
    println!(
        "a limit counts {first:?} after the worker is ready, {took:?} after a change, {started:?} after the flow is ready"
    );
    let others = rest(&mut slam).await;
    assert!(others.is_empty(), "nobody else hears: {others:?}");
    worker.stop();
}
