//! The rules for all leases, on real servers.

use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::redis::RedisKeys;
use blaze_domain::node_file::{LayerBroker, MongoSection, NodeBroker, NodeFile};
use blaze_tests::servers::{
    KafkaOptions, KafkaServer, MongoOptions, MongoServer, RedisKind, RedisOptions, RedisServer,
    drop_mongo_database, shared_mongo, unique_name,
};
use blaze_worker::lease::conformance::{BUSY, TIME, run_all};
use blaze_worker::lease::{KafkaLease, Lease, MongoLease, RedisLease};
use rdkafka::ClientConfig;
use rdkafka::admin::{AdminClient, AdminOptions, NewTopic, TopicReplication};
use serde_json::json;

/// Leases on Kafka begin with the topic of all, which the first one makes.
const FIRST_ON_KAFKA: Duration = Duration::from_secs(10);

async fn run_on_redis(kind: RedisKind) {
    let server = RedisServer::start(kind, RedisOptions::default()).unwrap();
    let lease = |layer: &str, owner: &str| -> Arc<dyn Lease> {
        Arc::new(RedisLease::new(keys_on(&server), &layer.parse().unwrap(), owner.to_owned()))
    };
    run_all(&lease, BUSY).await.unwrap();
}

fn keys_on(server: &RedisServer) -> Arc<RedisKeys> {
    let file =
        json!({ "brokers": { "node": { "redis": { "url": server.url(), "prefix": "x:" } } } });
    let Some(NodeBroker::Redis(section)) = NodeFile::read(&file).unwrap().0.brokers.node else {
        panic!("no Redis in {file}");
    };
    Arc::new(RedisKeys::open(&section).unwrap())
}

async fn run_on_mongo(uri: &str, database: &str) -> Result<(), String> {
    let lease = |layer: &str, owner: &str| -> Arc<dyn Lease> {
        let section = MongoSection::of(uri, database);
        Arc::new(MongoLease::new(section, layer.parse().unwrap(), owner.to_owned()))
    };
    run_all(&lease, BUSY).await
}

fn on_kafka(server: &KafkaServer, layer: &str) -> Arc<dyn Lease> {
    let file = json!({ "brokers": { "layer": { "kafka": { "bootstrap": [server.bootstrap()],
        "prefix": "x." } } } });
    let Some(LayerBroker::Kafka(section)) = NodeFile::read(&file).unwrap().0.brokers.layer else {
        panic!("no Kafka in {file}");
    };
    Arc::new(KafkaLease::open(&section, &layer.parse().unwrap(), TIME).unwrap())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_on_redis_passes_the_suite() {
    for kind in [RedisKind::Redis, RedisKind::Valkey] {
        run_on_redis(kind).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_two_workers_of_a_node_the_one_that_was_started_last_serves() {
    let server = RedisServer::start(RedisKind::Redis, RedisOptions::default()).unwrap();
    let (layer, node) = ("edge".parse().unwrap(), "robot-1".parse().unwrap());
    let lease = |started_ms: u64, worker: &str| {
        RedisLease::of_node(keys_on(&server), (&layer, &node), started_ms, worker)
    };
    let (older, newer) = (lease(9, "w1 on a"), lease(10, "w2 on b"));
    let hold = async |lease: &RedisLease| {
        let held = lease.hold(TIME, None).await.unwrap();
        (held.is_held, held.by)
    };
    assert_eq!(hold(&older).await, (true, None));
    assert_eq!(hold(&newer).await, (true, None), "at once");
    assert_eq!(hold(&older).await, (false, Some("w2 on b".to_owned())));
    assert_eq!(hold(&newer).await, (true, None));
    newer.release().await;
    assert_eq!(hold(&older).await, (true, None));
    // One that was killed.
    let killed = Instant::now();
    assert_eq!(hold(&newer).await, (true, None));
    while !hold(&older).await.0 {
        assert!(killed.elapsed() < TIME + BUSY);
        tokio::time::sleep(TIME / 50).await;
    }
    assert!(killed.elapsed() >= TIME);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_on_a_replica_set_of_mongodb_passes_the_suite() {
    let (uri, database) = (shared_mongo().unwrap(), unique_name("lease"));
    let passed = run_on_mongo(&uri, &database).await;
    // What stays goes with the server.
    let _ = drop_mongo_database(&uri, &database);
    passed.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_on_a_mongodb_that_is_alone_passes_the_suite() {
    let options = MongoOptions { alone: true, ..MongoOptions::default() };
    let server = MongoServer::start(options).unwrap();
    run_on_mongo(&server.uri(), "blaze").await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_in_a_group_of_kafka_passes_the_suite() {
    let server = KafkaServer::start(KafkaOptions::default()).unwrap();
    let lease = |layer: &str, _: &str| on_kafka(&server, layer);
    run_all(&lease, FIRST_ON_KAFKA).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_in_a_group_of_kafka_has_one_owner_though_the_topic_has_two_partitions() {
    let server = KafkaServer::start(KafkaOptions::default()).unwrap();
    let mut config = ClientConfig::new();
    let admin: AdminClient<_> =
        config.set("bootstrap.servers", server.bootstrap()).create().unwrap();
    let topic = NewTopic::new("x.blaze.worker.lease", 2, TopicReplication::Fixed(1));
    let made = admin.create_topics([&topic], &AdminOptions::new()).await;
    assert!(made.unwrap().iter().all(Result::is_ok), "the topic is not made");
    // Each of the two gets a partition.
    let (one, other) = (on_kafka(&server, "a"), on_kafka(&server, "a"));
    let (start, mut is_had) = (Instant::now(), false);
    while start.elapsed() < FIRST_ON_KAFKA {
        let (one, other) = tokio::join!(one.hold(TIME, None), other.hold(TIME, None));
        let (one, other) = (one.unwrap_or_default().is_held, other.unwrap_or_default().is_held);
        assert!(!(one && other), "two have it");
        is_had |= one || other;
        tokio::time::sleep(TIME / 20).await;
    }
    assert!(is_had, "nobody has it");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_in_a_group_of_kafka_outlives_the_broker_and_the_topic() {
    let server = KafkaServer::start(KafkaOptions::default()).unwrap();
    let (one, other) = (on_kafka(&server, "a"), on_kafka(&server, "a"));
    let until = async |lease: &Arc<dyn Lease>, what: &str| {
        let start = Instant::now();
        while !lease.hold(TIME, None).await.is_ok_and(|held| held.is_held) {
            assert!(start.elapsed() < Duration::from_secs(30), "{what}");
            tokio::time::sleep(TIME / 20).await;
        }
    };
    until(&one, "nobody has it").await;
    server.kill().unwrap();
    assert!(one.hold(TIME, None).await.is_err(), "nobody can know who has it");
    server.restart().unwrap();
    until(&other, "nobody has it after the broker came back").await;
    assert!(!one.hold(TIME, None).await.unwrap_or_default().is_held, "two have it");
    // Nobody asks for it any more.
    tokio::time::sleep(TIME).await;
    let late = on_kafka(&server, "a");
    let start = Instant::now();
    until(&late, "who begins does not get what is over").await;
    println!("who begins has it after {:?}", start.elapsed());
    let mut config = ClientConfig::new();
    let admin: AdminClient<_> =
        config.set("bootstrap.servers", server.bootstrap()).create().unwrap();
    let deleted = admin.delete_topics(&["x.blaze.worker.lease"], &AdminOptions::new()).await;
    assert!(deleted.unwrap().iter().all(Result::is_ok), "the topic is not deleted");
    until(&one, "nobody has it after the topic was deleted").await;
    assert!(!late.hold(TIME, None).await.unwrap_or_default().is_held, "two have it");
}
