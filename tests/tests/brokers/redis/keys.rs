//! Keys: all or nothing, records that vanish, leases, a server that was away.

use std::collections::BTreeMap;
use std::time::Duration;

use blaze_brokers::Health;
use blaze_brokers::redis::{KeyChange, KeyError, RedisBroker, RedisKeys};
use blaze_brokers::{Broker as _, Role};
use blaze_tests::servers::RedisKind;
use bytes::Bytes;
use serde_json::json;

use super::support::{Server, channel, section_of, subscribe, wait_for};

const SHORT: Duration = Duration::from_millis(300);
const LONG: Duration = Duration::from_secs(60);

fn keys_of(server: &Server) -> RedisKeys {
    RedisKeys::open(&section_of(&json!({ "url": server.server.url(), "prefix": "site:" }))).unwrap()
}

fn put(key: &str, value: &'static str) -> KeyChange {
    KeyChange::Put {
        key: key.to_owned(),
        value: Bytes::from(value),
    }
}

fn record(key: &str, state: &str, expires: Duration) -> KeyChange {
    KeyChange::PutRecord {
        key: key.to_owned(),
        members: BTreeMap::from([("state".to_owned(), state.to_owned())]),
        expires,
    }
}

/// Asks until an answer satisfies, for at most 20 s.
async fn until<T>(mut ask: impl AsyncFnMut() -> T, is_good: impl Fn(&T) -> bool) -> T {
    let wait = async {
        loop {
            let answer = ask().await;
            if is_good(&answer) {
                return answer;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(20), wait).await.unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn values_and_the_messages_about_them_come_together() {
    let server = Server::start(RedisKind::Redis);
    let keys = keys_of(&server);
    let section = section_of(&json!({ "url": server.server.url(), "prefix": "site:" }));
    let broker = RedisBroker::open(&section, &Role::Service).unwrap();
    wait_for(&broker, Health::Up).await;
    let mut reader = subscribe(&broker, "blaze/config/changed/slam").await;
    let notice = (channel("blaze/config/changed/slam"), Bytes::from("changed"));
    keys.apply(
        &[put("blaze:config:slam", "new"), put("blaze:config:nav", "n")],
        &[notice],
    )
    .await
    .unwrap();
    let mut batch = Vec::new();
    reader.receive(&mut batch, 1).await;
    assert_eq!(batch.len(), 1);
    assert_eq!(keys.get("blaze:config:slam").await.unwrap(), Some(Bytes::from("new")));
    let gone = KeyChange::Delete {
        key: "blaze:config:slam".to_owned(),
    };
    keys.apply(&[gone], &[]).await.unwrap();
    assert_eq!(keys.get("blaze:config:slam").await.unwrap(), None);
    assert_eq!(keys.get("blaze:config:nav").await.unwrap(), Some(Bytes::from("n")));
    broker.close().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_record_vanishes_unless_it_is_renewed_and_only_those_asked_for_are_found() {
    let server = Server::start(RedisKind::Redis);
    let keys = keys_of(&server);
    let changes = [
        record("blaze:watchdog:slam:robot-1:0", "ready", LONG),
        record("blaze:watchdog:slam:robot-1:1", "ready", SHORT),
        record("blaze:watchdogs", "other", LONG),
    ];
    keys.apply(&changes, &[]).await.unwrap();
    let found = keys.records("blaze:watchdog:", 100).await.unwrap();
    assert_eq!(found.len(), 2, "{found:?}");
    assert_eq!(found[0].0, "blaze:watchdog:slam:robot-1:0");
    assert_eq!(found[0].1["state"], "ready");
    until(
        async || keys.record("blaze:watchdog:slam:robot-1:1").await.unwrap(),
        Option::is_none,
    )
    .await;
    assert_eq!(keys.records("blaze:watchdog:", 100).await.unwrap().len(), 1);
    assert_eq!(
        keys.records("blaze:", 1).await.unwrap().len(),
        1,
        "no more than asked for"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lease_has_one_owner_until_it_runs_out_or_is_given_up() {
    let server = Server::start(RedisKind::Valkey);
    let (one, other) = (keys_of(&server), keys_of(&server));
    let lease = "blaze:lease:worker:fog";
    assert!(one.hold(lease, "one", LONG).await.unwrap());
    assert!(one.hold(lease, "one", LONG).await.unwrap(), "it goes on having it");
    assert!(!other.hold(lease, "other", LONG).await.unwrap());
    other.release(lease, "other").await.unwrap();
    assert!(
        !other.hold(lease, "other", LONG).await.unwrap(),
        "nobody gives up what another has"
    );
    one.release(lease, "one").await.unwrap();
    assert!(other.hold(lease, "other", SHORT).await.unwrap());
    until(async || one.hold(lease, "one", LONG).await.unwrap(), |has| *has).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_was_away_is_used_again_and_known_to_be_another() {
    let server = Server::start(RedisKind::Redis);
    let keys = keys_of(&server);
    keys.apply(&[put("a", "1")], &[]).await.unwrap();
    // The first look only learns which start it is.
    let early = tokio::time::timeout(Duration::from_secs(1), keys.restarted()).await;
    assert!(early.is_err(), "nobody has started it anew");
    server.server.kill().unwrap();
    let error = keys.apply(&[put("a", "2")], &[]).await.unwrap_err();
    assert!(matches!(error, KeyError::Away { .. }), "{error}");
    server.server.restart().unwrap();
    let done = until(async || keys.apply(&[put("a", "3")], &[]).await, Result::is_ok).await;
    assert_eq!(done, Ok(()));
    assert_eq!(keys.get("a").await.unwrap(), Some(Bytes::from("3")));
    tokio::time::timeout(Duration::from_secs(20), keys.restarted())
        .await
        .unwrap();
}
