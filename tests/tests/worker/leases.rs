//! The rules for all leases, on real servers.

use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::redis::RedisKeys;
use blaze_domain::node_file::{LayerBroker, NodeBroker, NodeFile};
use blaze_tests::servers::{
    KafkaOptions, KafkaServer, MongoOptions, MongoServer, RedisKind, RedisOptions, RedisServer, drop_mongo_database,
    shared_mongo, unique_name,
};
use blaze_worker::lease::conformance::{Fixture, run_all, run_out};
use blaze_worker::lease::{KafkaLease, Lease, MongoLease, RedisLease};
use serde_json::json;

/// What an answer may take on a machine that does much else.
const BUSY: Duration = Duration::from_secs(2);
const TIME: Duration = Duration::from_secs(1);

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

struct OnKafka {
    server: KafkaServer,
    /// The least that the broker lets members ask for.
    session: Duration,
}

impl Fixture for OnKafka {
    fn lease(&self, layer: &str, _owner: &str) -> Arc<dyn Lease> {
        let file = json!({
            "layer": { "name": layer, "kind": "fog" },
            "node": { "name": "server-1" },
            "brokers": { "layer": { "kafka": { "bootstrap": [self.server.bootstrap()], "prefix": "x." } } },
        });
        let Some(LayerBroker::Kafka(section)) = NodeFile::read(&file).unwrap().0.brokers.layer else {
            panic!("no Kafka in {file}");
        };
        Arc::new(KafkaLease::open(&section, &layer.parse().unwrap(), self.time()).unwrap())
    }

    fn time(&self) -> Duration {
        TIME
    }

    fn runs_out_within(&self) -> Duration {
        // The member itself leaves when it is not asked for a session.
        self.session.max(TIME) + BUSY
    }

    fn given_within(&self) -> Duration {
        BUSY
    }

    fn first_within(&self) -> Duration {
        // The first group makes the topic of all groups, and several sessions may be refused.
        Duration::from_secs(30)
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
    let options = KafkaOptions {
        extra: vec!["group.min.session.timeout.ms=500".to_owned()],
        ..KafkaOptions::default()
    };
    let fixture = OnKafka {
        server: KafkaServer::start(options).unwrap(),
        session: Duration::from_millis(500),
    };
    run_all(&fixture).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_in_a_group_of_a_kafka_with_its_defaults_passes_the_suite() {
    let fixture = OnKafka {
        server: KafkaServer::start(KafkaOptions::default()).unwrap(),
        session: Duration::from_secs(6),
    };
    // Each rule takes some sessions of six seconds.
    let passed = if blaze_tests::long() {
        run_all(&fixture).await
    } else {
        run_out(&fixture).await
    };
    passed.unwrap();
}
