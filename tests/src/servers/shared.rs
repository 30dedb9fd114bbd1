//! The servers that all tests of a run share.
//!
//! Where they are, in this order: the environment variable, the line of the same name in
//! `.services/env`, a server that this process starts for itself. An address that is named but does
//! not answer is an error, never passed over.

use std::sync::OnceLock;
use std::time::Duration;

use super::endpoint::Endpoint;
use super::{
    KafkaOptions, KafkaServer, MongoOptions, MongoServer, RedisKind, RedisOptions, RedisServer,
    installed, kafka, mongo, mongo_wire, redis,
};

/// How long a server may take to answer on a busy machine.
const BUSY: Duration = Duration::from_secs(10);

type Once<T> = OnceLock<Result<T, String>>;

/// `redis://…` of the Redis that all tests share. Use names from [`super::unique_name`]; never
/// `FLUSHALL`.
///
/// # Errors
/// When the named server does not answer, or none can be started.
pub fn shared_redis() -> anyhow::Result<String> {
    static OWN: Once<RedisServer> = OnceLock::new();
    redis_at("BLAZE_TEST_REDIS_URL", RedisKind::Redis, &OWN)
}

/// `redis://…` of the Valkey that all tests share, as [`shared_redis`].
///
/// # Errors
/// As [`shared_redis`].
pub fn shared_valkey() -> anyhow::Result<String> {
    static OWN: Once<RedisServer> = OnceLock::new();
    redis_at("BLAZE_TEST_VALKEY_URL", RedisKind::Valkey, &OWN)
}

/// `HOST:PORT` of the fog layer's Kafka that all tests share. Topics are not made by themselves.
/// Use names from [`super::unique_name`].
///
/// # Errors
/// As [`shared_redis`].
pub fn shared_kafka() -> anyhow::Result<String> {
    static OWN: Once<KafkaServer> = OnceLock::new();
    kafka_at("BLAZE_TEST_KAFKA_FOG", &OWN)
}

/// As [`shared_kafka`], for the cloud layer: another cluster.
///
/// # Errors
/// As [`shared_redis`].
pub fn shared_kafka_cloud() -> anyhow::Result<String> {
    static OWN: Once<KafkaServer> = OnceLock::new();
    kafka_at("BLAZE_TEST_KAFKA_CLOUD", &OWN)
}

/// `mongodb://…` of the MongoDB replica set that all tests share. Use databases of names from
/// [`super::unique_name`].
///
/// # Errors
/// As [`shared_redis`].
pub fn shared_mongo() -> anyhow::Result<String> {
    static OWN: Once<MongoServer> = OnceLock::new();
    let name = "BLAZE_TEST_MONGODB_URI";
    let Some(uri) = address(name) else {
        return Ok(started(&OWN, || MongoServer::start(MongoOptions::default()))?.uri());
    };
    // An address of one's own may hold a password, TLS or several hosts: then the test itself finds
    // out.
    let answers = mongo::loopback_port(&uri)
        .is_none_or(|port| mongo_wire::is_writable(&Endpoint::loopback(port)));
    anyhow::ensure!(answers, "{}", silent(name, &uri));
    Ok(uri)
}

fn redis_at(
    name: &str,
    kind: RedisKind,
    own: &'static Once<RedisServer>,
) -> anyhow::Result<String> {
    let Some(url) = address(name) else {
        return Ok(started(own, || RedisServer::start(kind, RedisOptions::default()))?.url());
    };
    // An address of one's own may hold a password, TLS or another host: then the test itself finds
    // out.
    let port = url
        .strip_prefix("redis://127.0.0.1:")
        .and_then(|port| port.trim_end_matches('/').parse().ok());
    let answers = port.is_none_or(|port| {
        redis::ping(&Endpoint::loopback(port)).is_some_and(|answer| redis::is_ready(&answer))
    });
    anyhow::ensure!(answers, "{}", silent(name, &url));
    Ok(url)
}

fn kafka_at(name: &str, own: &'static Once<KafkaServer>) -> anyhow::Result<String> {
    let Some(address) = address(name) else {
        return Ok(started(own, || KafkaServer::start(KafkaOptions::default()))?.bootstrap());
    };
    let port = address.strip_prefix("127.0.0.1:").and_then(|port| port.parse().ok());
    let answers = port.is_none_or(|port| kafka::leaders(&Endpoint::loopback(port), BUSY).is_ok());
    anyhow::ensure!(answers, "{}", silent(name, &address));
    Ok(address)
}

/// The address that a variable (`BLAZE_TEST_REDIS_URL`, …) or else `.services/env` names; nothing
/// is asked or started.
#[must_use]
pub fn address(name: &str) -> Option<String> {
    std::env::var_os(name)
        .map(|value| value.to_string_lossy().into_owned())
        .filter(|value| !value.is_empty())
        .or_else(|| installed::environment(name))
}

fn silent(name: &str, address: &str) -> String {
    format!(
        "{name}={address} does not answer: run `scripts/services start`, or `scripts/services \
         stop` to let each test \
         process start its own"
    )
}

fn started<T>(
    own: &'static Once<T>,
    start: impl FnOnce() -> anyhow::Result<T>,
) -> anyhow::Result<&'static T> {
    own.get_or_init(|| start().map_err(|error| format!("{error:#}")))
        .as_ref()
        .map_err(|error| anyhow::anyhow!("{error}"))
}
