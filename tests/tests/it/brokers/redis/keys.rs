//! Keys: all or nothing, records that vanish, leases, a server that was away.

use std::collections::BTreeMap;
use std::time::Duration;

use blaze_brokers::Health;
use blaze_brokers::redis::{KeyChange, KeyError, RedisBroker, RedisKeys, RedisLock};
use blaze_brokers::{Broker as _, Role};
use blaze_tests::servers::RedisKind;
use bytes::Bytes;
use serde_json::json;

use super::support::{Server, channel, section_of, subscribe, wait_for};

const SHORT: Duration = Duration::from_secs(2);
const LONG: Duration = Duration::from_secs(60);

fn keys_of(server: &Server) -> RedisKeys {
    RedisKeys::open(&section_of(&json!({ "url": server.server.url(), "prefix": "site:" }))).unwrap()
}

fn put(key: &str, value: &'static str) -> KeyChange {
    KeyChange::Put { key: key.to_owned(), value: Bytes::from(value) }
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
    until(async || keys.record("blaze:watchdog:slam:robot-1:1").await.unwrap(), Option::is_none)
        .await;
    assert_eq!(keys.records("blaze:watchdog:", 100).await.unwrap().len(), 1);
    assert_eq!(keys.records("blaze:", 1).await.unwrap().len(), 1, "no more than asked for");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_value_for_a_while_vanishes_and_a_new_one_takes_its_place_and_time() {
    let server = Server::start(RedisKind::Redis);
    let keys = keys_of(&server);
    keys.put_for("cache:a", &Bytes::from("1"), LONG).await.unwrap();
    keys.put_for("cache:b", &Bytes::from_static(b"\x00\xff"), LONG).await.unwrap();
    keys.put_for("cache:a", &Bytes::from("2"), SHORT).await.unwrap();
    // Less than the server can count is as short as it can be, and no error.
    keys.put_for("cache:c", &Bytes::from("3"), Duration::ZERO).await.unwrap();
    for gone in ["cache:a", "cache:c"] {
        until(async || keys.get(gone).await.unwrap(), Option::is_none).await;
    }
    assert_eq!(
        keys.get("cache:b").await.unwrap(),
        Some(Bytes::from_static(b"\x00\xff")),
        "it has its own time"
    );
}

fn lock(owner: &str) -> RedisLock {
    RedisLock { key: "blaze:lease:worker:fog".to_owned(), owner: owner.to_owned() }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_counts_only_while_a_lock_is_held_is_done_wholly_or_not_at_all() {
    let server = Server::start(RedisKind::Redis);
    let (keys, one, other) = (keys_of(&server), lock("one"), lock("other"));
    let section = section_of(&json!({ "url": server.server.url(), "prefix": "site:" }));
    let broker = RedisBroker::open(&section, &Role::Service).unwrap();
    wait_for(&broker, Health::Up).await;
    let mut reader = subscribe(&broker, "blaze/config/changed/slam").await;
    let gone = KeyChange::Delete { key: "c".to_owned() };
    let changes = [put("a", "1"), record("b", "ready", LONG), gone];
    let notice = [(channel("blaze/config/changed/slam"), Bytes::from("hear"))];
    keys.apply(&[put("c", "0")], &notice).await.unwrap();
    let mut batch = Vec::new();
    reader.receive(&mut batch, 10).await;
    assert_eq!(batch.len(), 1, "it comes with the change");
    assert!(!keys.apply_if_held(&one, &changes, &notice).await.unwrap(), "nobody has it");
    keys.hold(&other, LONG, None).await.unwrap();
    assert!(!keys.apply_if_held(&one, &changes, &notice).await.unwrap(), "another one has it");
    assert_eq!(keys.get("a").await.unwrap(), None);
    assert_eq!(keys.get("c").await.unwrap(), Some(Bytes::from("0")));
    assert!(keys.apply_if_held(&other, &changes, &notice).await.unwrap());
    assert_eq!(keys.get("a").await.unwrap(), Some(Bytes::from("1")));
    assert_eq!(keys.record("b").await.unwrap().unwrap()["state"], "ready");
    assert_eq!(keys.get("c").await.unwrap(), None);
    reader.receive(&mut batch, 10).await;
    assert_eq!(batch.len(), 2, "it was published once more");
    // As much as a worker tells at once.
    let large = |number: usize| KeyChange::Put {
        key: format!("many:{number}"),
        value: Bytes::from("x".repeat(4096)),
    };
    let many: Vec<KeyChange> = (0..256).map(large).collect();
    assert!(keys.apply_if_held(&other, &many, &[]).await.unwrap());
    assert_eq!(keys.values("many:", 1000).await.unwrap().len(), 256);
    broker.close().await;
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
    tokio::time::timeout(Duration::from_secs(20), keys.restarted()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_server_cannot_do_just_now_is_no_refusal() {
    let server = Server::start(RedisKind::Redis);
    let keys = keys_of(&server);
    let change = [put("a", "1")];
    keys.apply(&change, &[]).await.unwrap();
    let lock = RedisLock { key: "lease".to_owned(), owner: "w-1".to_owned() };
    assert!(keys.hold(&lock, LONG, None).await.unwrap().is_held);
    server.cli(&["CONFIG", "SET", "maxmemory", "1"]);
    for told in [
        keys.apply(&change, &[]).await,
        keys.put_for("b", &Bytes::from("1"), LONG).await,
        keys.apply_if_held(&lock, &change, &[]).await.map(|_| ()),
    ] {
        assert!(
            matches!(&told, Err(KeyError::Away { reason, .. }) if reason.contains("OOM")),
            "{told:?}"
        );
    }
    server.cli(&["CONFIG", "SET", "maxmemory", "0"]);
    keys.apply(&change, &[]).await.unwrap();
    server.cli(&["REPLICAOF", "127.0.0.1", "1"]);
    let told = keys.apply(&change, &[]).await;
    assert!(
        matches!(&told, Err(KeyError::Away { reason, .. }) if reason.contains("read only")),
        "{told:?}"
    );
    server.cli(&["REPLICAOF", "NO", "ONE"]);
    keys.apply(&change, &[]).await.unwrap();
    // Something that is no text has the name: that stays so.
    keys.apply(&[record("r", "ready", LONG)], &[]).await.unwrap();
    let told = keys.get("r").await;
    assert!(matches!(told, Err(KeyError::Refused { .. })), "{told:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_record_is_deleted_by_whom_it_is_of() {
    let server = Server::start(RedisKind::Redis);
    let keys = keys_of(&server);
    keys.apply(&[record("r", "ready", LONG)], &[]).await.unwrap();
    keys.delete_record("r", "state", "starting").await.unwrap();
    assert!(keys.record("r").await.unwrap().is_some());
    keys.delete_record("r", "state", "ready").await.unwrap();
    keys.delete_record("r", "state", "ready").await.unwrap();
    assert_eq!(keys.record("r").await.unwrap(), None);
}
