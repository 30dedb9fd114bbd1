//! The rules for all leases, on real servers.

use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::redis::RedisKeys;
use blaze_domain::node_file::{LayerBroker, NodeBroker, NodeFile};
use blaze_tests::servers::{
    KafkaOptions, KafkaServer, MongoOptions, MongoServer, RedisKind, RedisOptions, RedisServer, drop_mongo_database,
    shared_mongo, unique_name,
};
use blaze_worker::lease::conformance::{Fixture, run_all};
use blaze_worker::lease::{KafkaLease, Lease, MongoLease, RedisLease};
use rdkafka::ClientConfig;
use rdkafka::admin::{AdminClient, AdminOptions};
use serde_json::json;

/// What an answer may take on a machine that does much else.
const BUSY: Duration = Duration::from_secs(2);
/// Who has it must ask again within this: longer than an answer may take.
const TIME: Duration = Duration::from_secs(3);

struct OnRedis(RedisServer);

impl Fixture for OnRedis {
    fn lease(&self, layer: &str, owner: &str) -> Arc<dyn Lease> {
        let file = json!({ "brokers": { "node": { "redis": { "url": self.0.url(), "prefix": "x:" } } } });
        let Some(NodeBroker::Redis(section)) = NodeFile::read(&file).unwrap().0.brokers.node else {
            panic!("no Redis in {file}");
        };
        let keys = Arc::new(RedisKeys::open(&section).unwrap());
        Arc::new(RedisLease::new(keys, &layer.parse().unwrap(), owner.to_owned()))
    }

    fn time(&self) -> Duration {
        TIME
    }

    fn runs_out_within(&self) -> Duration {
        TIME + BUSY
    }

    fn given_within(&self) -> Duration {
        BUSY
    }

    fn first_within(&self) -> Duration {
        BUSY
    }
}

struct OnMongo {
    uri: String,
    database: String,
}

impl Fixture for OnMongo {
    fn lease(&self, layer: &str, owner: &str) -> Arc<dyn Lease> {
        let (layer, uri) = (layer.parse().unwrap(), self.uri.clone().into());
        Arc::new(MongoLease::new(uri, &self.database, layer, owner.to_owned()).unwrap())
    }

    fn time(&self) -> Duration {
        TIME
    }

    fn runs_out_within(&self) -> Duration {
        TIME + BUSY
    }

    fn given_within(&self) -> Duration {
        BUSY
    }

    fn first_within(&self) -> Duration {
        BUSY
    }
}

struct OnKafka(KafkaServer);

impl Fixture for OnKafka {
    fn lease(&self, layer: &str, _owner: &str) -> Arc<dyn Lease> {
        let file = json!({
            "layer": { "name": layer, "kind": "fog" },
            "node": { "name": "server-1" },
            "brokers": { "layer": { "kafka": { "bootstrap": [self.0.bootstrap()], "prefix": "x." } } },
        });
        let Some(LayerBroker::Kafka(section)) = NodeFile::read(&file).unwrap().0.brokers.layer else {
            panic!("no Kafka in {file}");
        };
        Arc::new(KafkaLease::open(&section, &layer.parse().unwrap(), TIME).unwrap())
    }

    fn time(&self) -> Duration {
        TIME
    }

    fn runs_out_within(&self) -> Duration {
        TIME + BUSY
    }

    fn given_within(&self) -> Duration {
        BUSY
    }

    fn first_within(&self) -> Duration {
        // The first one makes the topic of all.
        Duration::from_secs(10)
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_on_redis_passes_the_suite() {
    for kind in [RedisKind::Redis, RedisKind::Valkey] {
        let server = RedisServer::start(kind, RedisOptions::default()).unwrap();
        run_all(&OnRedis(server)).await.unwrap();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_on_a_replica_set_of_mongodb_passes_the_suite() {
    let fixture = OnMongo {
        uri: shared_mongo().unwrap(),
        database: unique_name("lease"),
    };
    let passed = run_all(&fixture).await;
    // What stays goes with the server.
    let _ = drop_mongo_database(&fixture.uri, &fixture.database);
    passed.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_on_a_mongodb_that_is_alone_passes_the_suite() {
    let options = MongoOptions {
        alone: true,
        ..MongoOptions::default()
    };
    let server = MongoServer::start(options).unwrap();
    let fixture = OnMongo {
        uri: server.uri(),
        database: "blaze".to_owned(),
    };
    run_all(&fixture).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_in_a_group_of_kafka_passes_the_suite() {
    let server = KafkaServer::start(KafkaOptions::default()).unwrap();
    run_all(&OnKafka(server)).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_in_a_group_of_kafka_outlives_the_broker_and_the_topic() {
    let fixture = OnKafka(KafkaServer::start(KafkaOptions::default()).unwrap());
    let (one, other) = (fixture.lease("a", "one"), fixture.lease("a", "other"));
    let until = async |lease: &Arc<dyn Lease>, what: &str| {
        let start = Instant::now();
        while !lease.hold(TIME, None).await.is_ok_and(|held| held.is_held) {
            assert!(start.elapsed() < Duration::from_secs(30), "{what}");
            tokio::time::sleep(TIME / 20).await;
        }
    };
    until(&one, "nobody has it").await;
    fixture.0.kill().unwrap();
    assert!(one.hold(TIME, None).await.is_err(), "nobody can know who has it");
    fixture.0.restart().unwrap();
    until(&other, "nobody has it after the broker came back").await;
    assert!(!one.hold(TIME, None).await.unwrap_or_default().is_held, "two have it");
    // Nobody asks for it any more.
    tokio::time::sleep(TIME).await;
    let late = fixture.lease("a", "late");
    let start = Instant::now();
    until(&late, "who begins does not get what is over").await;
    println!("who begins has it after {:?}", start.elapsed());
    let mut config = ClientConfig::new();
    let admin: AdminClient<_> = config.set("bootstrap.servers", fixture.0.bootstrap()).create().unwrap();
    let deleted = admin
        .delete_topics(&["x.blaze.worker.lease"], &AdminOptions::new())
        .await;
    assert!(deleted.unwrap().iter().all(Result::is_ok), "the topic is not deleted");
    until(&one, "nobody has it after the topic was deleted").await;
    assert!(!late.hold(TIME, None).await.unwrap_or_default().is_held, "two have it");
}
