//! Real servers for tests: Redis, Valkey, Kafka, MongoDB and etcd from the files that
//! `scripts/services install` unpacked.
//!
//! Most tests share the servers that `scripts/services start` runs ([`shared_redis`],
//! [`shared_kafka`], [`shared_mongo`]) and keep apart by [`unique_name`]. A test that kills,
//! freezes or configures a server starts one of its own: [`RedisServer`], [`KafkaServer`],
//! [`MongoServer`], [`EtcdServer`]. Those listen on a free port of loopback, or of a host of a
//! [network](crate::network) alone, and end with the value, or with the test's process.
//!
//! All calls block the thread. In an asynchronous test they need a runtime with several threads.

mod certificates;
mod endpoint;
mod etcd;
pub(crate) mod installed;
mod kafka;
mod mongo;
mod mongo_wire;
mod ports;
mod process;
mod redis;
mod shared;

pub use certificates::Certificates;
pub use etcd::{EtcdOptions, EtcdServer};
pub use kafka::{KafkaOptions, KafkaServer};
pub use mongo::{
    MongoOptions, MongoServer, abandon_mongo_transaction, drop_mongo_database, mongo_command,
    mongo_insert,
};
pub use ports::free as free_port;
pub use redis::{RedisKind, RedisOptions, RedisServer};
pub use shared::{
    address, shared_kafka, shared_kafka_cloud, shared_mongo, shared_redis, shared_valkey,
};

/// A name that no other test and no earlier run on the same server has: `stem-…`, of lower-case
/// letters, digits and `-`.
#[must_use]
pub fn unique_name(stem: &str) -> String {
    use std::sync::atomic::{AtomicU32, Ordering};
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    let micros = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .map_or(0, |since| since.as_micros());
    format!("{stem}-{:x}-{micros:x}-{number:x}", std::process::id())
}
