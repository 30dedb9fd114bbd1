//! Two workers of one layer: one serves, and when it is killed, stopped or ended the other one
//! does.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_tests::plain::{KafkaReader, KafkaWriter};
use blaze_tests::process::Signal;
use blaze_tests::servers::{KafkaOptions, KafkaServer, MongoOptions, MongoServer};
use blaze_tests::within;
use serde_json::{Value, json};

use super::stage::{PATIENCE, Stage, Worker};

/// `worker.lease_ms`, unless set.
const LEASE: Duration = Duration::from_secs(5);
/// The same where Kafka decides: its session timeout, and time for the others to hear of it.
const LEASE_ON_KAFKA: Duration = Duration::from_secs(12);
/// What a look at the status may take.
const LOOK: Duration = Duration::from_millis(250);
/// How long after the signal whoever ends has given it up and the other one has looked.
const GIVEN: Duration = Duration::from_secs(1);

/// Two workers of a layer whose further sections these are, one of which leads: that one first.
async fn two(stage: &Stage, sections: &Value) -> (Worker, Worker) {
    let (one, other) =
        (stage.layer_worker("fog-1", sections), stage.layer_worker("fog-2", sections));
    stage.equal(&one, PATIENCE).await;
    stage.equal(&other, PATIENCE).await;
    let start = Instant::now();
    loop {
        match (one.leads().await, other.leads().await) {
            (Some(true), Some(false)) => return (one, other),
            (Some(false), Some(true)) => return (other, one),
            (Some(true), Some(true)) => panic!("two lead"),
            _ => assert!(start.elapsed() < PATIENCE, "none leads: {} {}", one.tail(), other.tail()),
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

/// How long until it leads, from an instant on.
async fn until_it_leads(worker: &Worker, since: Instant) -> Duration {
    while worker.leads().await != Some(true) {
        assert!(since.elapsed() < PATIENCE, "it does not take over: {}", worker.tail());
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    since.elapsed()
}

/// The leader is killed, stopped, goes on, and is ended; each time the other one takes over within
/// `lease` or, where it could say so, at once.
async fn takeovers(
    name: &str,
    stage: &Stage,
    both: (Worker, Worker),
    sections: &Value,
    lease: Duration,
) {
    let (leader, other) = both;
    let since = Instant::now();
    leader.kill();
    let killed = until_it_leads(&other, since).await;

    // It has been the follower's turn; the one that was killed is there again.
    let leader = other;
    let other = stage.layer_worker("fog-3", sections);
    stage.equal(&other, PATIENCE).await;
    assert!(!other.is_leader().await);
    let since = Instant::now();
    leader.signal(Signal::STOP);
    let stopped = until_it_leads(&other, since).await;
    leader.signal(Signal::CONT);
    let since = Instant::now();
    while since.elapsed() < lease {
        if let Some(leads) = leader.leads().await {
            assert!(!leads, "it was stopped and has lost the lease: {}", leader.tail());
        }
        assert_ne!(other.leads().await, Some(false), "it has the lease: {}", other.tail());
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert_eq!((leader.is_leader().await, other.is_leader().await), (false, true));

    let since = Instant::now();
    other.stop();
    let ended = until_it_leads(&leader, since).await;
    println!(
        "{name}: taken over {killed:?} after a kill, {stopped:?} after a stop, {ended:?} after an \
         end"
    );
    let (lost, given) = (lease + within(LOOK), within(GIVEN));
    assert!(killed <= lost, "after a kill {killed:?}, not {lost:?}");
    assert!(stopped <= lost, "after a stop {stopped:?}, not {lost:?}");
    assert!(ended <= given, "after an end {ended:?}, not {given:?}");
    leader.stop();
}

async fn stage() -> (Stage, blaze_tests::process::Process) {
    let stage = Stage::new();
    let main = stage.main();
    stage.robot().await;
    (stage, main)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn with_redis_another_worker_takes_over_within_a_lease() {
    let (stage, _main) = stage().await;
    let sections = json!({ "cache": { "redis": { "url": stage.redis.url() } } });
    let both = two(&stage, &sections).await;
    takeovers("Redis", &stage, both, &sections, LEASE).await;
    // People look there for who leads.
    let worker = stage.layer_worker("fog-4", &sections);
    until_it_leads(&worker, Instant::now()).await;
    let owner = async || stage.keys().get("blaze:lease:worker:edge").await.unwrap();
    let status = worker.status().await;
    assert_eq!(owner().await.as_deref(), Some(status["worker_id"].as_str().unwrap().as_bytes()));
    worker.stop();
    assert_eq!(owner().await, None, "who ends gives it up");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn with_mongodb_another_worker_takes_over_within_a_lease() {
    let (stage, _main) = stage().await;
    let server = MongoServer::start(MongoOptions::default()).unwrap();
    let sections =
        json!({ "database": { "mongodb": { "uri": server.uri(), "database": "blaze" } } });
    let both = two(&stage, &sections).await;
    takeovers("MongoDB", &stage, both, &sections, LEASE).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn with_kafka_another_worker_takes_over_within_its_session_timeout() {
    let (stage, _main) = stage().await;
    let server = KafkaServer::start(KafkaOptions::default()).unwrap();
    let sections =
        json!({ "brokers": { "layer": { "kafka": { "bootstrap": [server.bootstrap()] } } } });
    let both = two(&stage, &sections).await;
    one_answers(&server.bootstrap(), &both).await;
    takeovers("Kafka", &stage, both, &sections, LEASE_ON_KAFKA).await;
}

/// Both hear what services ask on Kafka, and the one that leads answers, once.
async fn one_answers(bootstrap: &str, (leader, other): &(Worker, Worker)) {
    let replies = KafkaReader::from_end(bootstrap, "blaze.reply").unwrap();
    let writer = KafkaWriter::new(bootstrap).unwrap();
    let ask = |id: &str| {
        let request = json!({
            "id": id,
            "service": "slam",
            "instance": "0",
            "node": "robot-1",
            "reply_to": "blaze/reply/me",
        });
        writer.produce("blaze.config.get", request.to_string().as_bytes()).unwrap();
    };
    let left = async |worker: &Worker| {
        let metrics = worker.text("/metrics").await;
        let line = metrics.lines().find(|line| line.contains("result=\"left_to_others\""));
        line.and_then(|line| line.rsplit(' ').next()?.parse::<f64>().ok())
    };
    let (start, mut asked) = (Instant::now(), 0);
    while left(other).await.is_none_or(|heard| heard < 5.0) {
        assert!(start.elapsed() < PATIENCE, "both hear all: {:?}", left(other).await);
        ask(&asked.to_string());
        asked += 1;
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert_eq!(left(leader).await, Some(0.0));
    // Whatever else was answered is there before the answer to one more.
    ask("last");
    let mut answers: BTreeMap<String, usize> = BTreeMap::new();
    while !answers.contains_key("last") {
        let answer = replies.next(PATIENCE).expect("an answer");
        *answers.entry(String::from_utf8(answer.key).unwrap()).or_default() += 1;
    }
    assert!(
        answers.len() > 5 && answers.values().all(|count| *count == 1),
        "{asked} were asked: {answers:?}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whoever_was_stopped_writes_nothing_older_over_what_the_next_one_wrote() {
    let (stage, _main) = stage().await;
    let sections = json!({
        "cache": { "redis": { "url": stage.redis.url() } },
        "worker": { "lease_ms": 1000 },
    });
    let (leader, other) = two(&stage, &sections).await;
    for round in 1..=3_u64 {
        // It is stopped with a change on its way.
        stage.put("/services/slam", json!({ "config": { "camera": { "rate_hz": round } } })).await;
        leader.signal(Signal::STOP);
        until_it_leads(&other, Instant::now()).await;
        let revision = stage
            .put("/services/slam", json!({ "config": { "camera": { "rate_hz": round + 100 } } }))
            .await;
        let key = async || {
            let key = stage.keys().get("blaze:config:slam:0").await.unwrap();
            key.map(|key| serde_json::from_slice::<Value>(&key).unwrap())
        };
        let start = Instant::now();
        while key().await.is_none_or(|key| key["revision"] != revision) {
            assert!(start.elapsed() < PATIENCE, "{:?}; {}", key().await, other.tail());
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        leader.signal(Signal::CONT);
        let start = Instant::now();
        let mut answers = 0;
        while start.elapsed() < Duration::from_secs(2) {
            answers += u32::from(leader.leads().await == Some(false));
            let key = key().await.expect("the key is there");
            assert_eq!(key["revision"], revision, "an older one was written: {}", leader.tail());
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        assert!(answers > 0, "it goes on");
        // The other one leads the next round, too, so it makes way.
        other.signal(Signal::STOP);
        until_it_leads(&leader, Instant::now()).await;
        other.signal(Signal::CONT);
        stage.equal(&other, PATIENCE).await;
        assert!(!other.is_leader().await);
    }
}
