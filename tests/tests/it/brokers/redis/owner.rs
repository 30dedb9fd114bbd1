//! Whose scope it is, and the flow's leases.

use std::time::{Duration, Instant};

use blaze_brokers::{Broker, BrokerError, Health, PublishOutcome, SubscribeOptions};
use blaze_tests::servers::RedisKind;
use bytes::Bytes;

use super::support::{
    Server, channel, eventually, frame, next_number, numbers_until_silence, publish, publisher,
    settled, subscribe, wait_for,
};

fn owner(server: &Server) -> String {
    server.cli(&["GET", "blaze:flow:owner"]).trim().to_owned()
}

fn leases(server: &Server) -> Vec<(String, String)> {
    let text = server.cli(&["HGETALL", "blaze:flow:leases"]);
    let lines: Vec<&str> = text.lines().filter(|line| !line.is_empty()).collect();
    let mut found: Vec<_> =
        lines.chunks(2).map(|pair| (pair[0].to_owned(), pair[1].to_owned())).collect();
    found.sort();
    found
}

fn pairs(pairs: &[(&str, &str)]) -> Vec<(String, String)> {
    pairs.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect()
}

/// The first flow has the scope; another neither reads nor writes until the first has gone.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_scope_has_one_flow() {
    for kind in [RedisKind::Redis, RedisKind::Valkey] {
        let server = Server::start(kind);
        let first = server.flow("edge/robot-1", 7);
        wait_for(&first, Health::Up).await;
        assert_eq!(owner(&server), "edge/robot-1/7");
        let second = server.flow("edge/robot-2", 9);
        assert_eq!(wait_for(&second, Health::InUse).await, "scope_in_use: edge/robot-1 holds it");
        let waiting = publisher(&second, "imu", 0);
        assert_eq!(waiting.publish(&frame(2, 1, 10), None), PublishOutcome::Dropped);
        let refused = second.subscribe(&channel("imu"), SubscribeOptions::default()).await;
        assert!(matches!(refused, Err(BrokerError::Away(why)) if why.contains("edge/robot-1")));
        assert!(second.flow_side().unwrap().load_leases().await.is_err());
        first.close().await;
        let closed = Instant::now();
        wait_for(&second, Health::Up).await;
        assert!(closed.elapsed() < Duration::from_secs(3), "a closed flow leaves no key behind");
        assert_eq!(owner(&server), "edge/robot-2/9");
        let mut reader = subscribe(&second, "imu").await;
        publish(waiting.as_ref(), 2, 2);
        assert_eq!(next_number(&mut reader).await, (2, 2));
    }
}

/// A newer life of the same node takes over at once; the old one stops reading and writing.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_newer_life_takes_over() {
    let server = Server::start(RedisKind::Redis);
    // Above 2^53 a script's numbers would be equal.
    let (old_epoch, new_epoch) = (u64::MAX - 1, u64::MAX);
    let old = server.flow("edge/robot-1", old_epoch);
    wait_for(&old, Health::Up).await;
    let mut reader = subscribe(&old, "imu").await;
    let old_publisher = publisher(&old, "imu", 0);
    let new = server.flow("edge/robot-1", new_epoch);
    wait_for(&new, Health::Up).await;
    assert_eq!(owner(&server), format!("edge/robot-1/{new_epoch}"));
    let detail = wait_for(&old, Health::InUse).await;
    assert_eq!(detail, "scope_in_use: edge/robot-1 with a newer epoch holds it");
    assert_eq!(old_publisher.publish(&frame(1, 1, 10), None), PublishOutcome::Dropped);
    let new_publisher = publisher(&new, "imu", 0);
    publish(new_publisher.as_ref(), 2, 1);
    settled(new_publisher.as_ref()).await;
    assert!(numbers_until_silence(&mut reader).await.is_empty(), "the old life reads nothing");
    new.close().await;
    wait_for(&old, Health::Up).await;
    publish(old_publisher.as_ref(), 1, 2);
    assert_eq!(next_number(&mut reader).await, (1, 2));
}

/// A flow that died without a word holds the scope for 5 s.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dead_flow_is_succeeded() {
    let server = Server::start(RedisKind::Redis);
    let first = server.flow("edge/robot-1", 1);
    wait_for(&first, Health::Up).await;
    let second = server.flow("edge/robot-2", 1);
    wait_for(&second, Health::InUse).await;
    drop(first);
    let died = Instant::now();
    wait_for(&second, Health::Up).await;
    let passed = died.elapsed();
    assert!(passed > Duration::from_secs(3) && passed < Duration::from_secs(8), "{passed:?}");
}

/// A flow whose server is frozen stops before its key has run out, and is the owner again
/// afterwards.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_frozen_server_costs_the_scope_only_for_the_time() {
    let server = Server::start(RedisKind::Redis);
    let flow = server.flow("edge/robot-1", 1);
    wait_for(&flow, Health::Up).await;
    let side = flow.flow_side().unwrap();
    server.server.freeze().unwrap();
    let frozen = Instant::now();
    wait_for(&flow, Health::Down).await;
    side.put_lease("while-frozen", Bytes::from_static(b"1"));
    tokio::time::sleep_until((frozen + Duration::from_secs(6)).into()).await;
    server.server.thaw().unwrap();
    wait_for(&flow, Health::Up).await;
    assert_eq!(owner(&server), "edge/robot-1/1");
    eventually("the lease is written", || {
        (leases(&server) == pairs(&[("while-frozen", "1")])).then_some(())
    })
    .await;
}

/// Leases are written in order, survive the flow, and come back after the server has lost
/// everything.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn leases_survive_flow_and_server() {
    for kind in [RedisKind::Redis, RedisKind::Valkey] {
        let server = Server::start(kind);
        let first = server.flow("edge/robot-1", 1);
        let side = first.flow_side().unwrap();
        // Also before the server was reached.
        side.put_lease("a", Bytes::from_static(b"1"));
        side.put_lease("b", Bytes::from_static(b"1"));
        wait_for(&first, Health::Up).await;
        side.put_lease("a", Bytes::from_static(b"2"));
        side.remove_lease("b");
        side.put_lease("c", Bytes::from_static(b"1"));
        let expected = pairs(&[("a", "2"), ("c", "1")]);
        // Closing delivers what is not written yet.
        first.close().await;
        assert_eq!(leases(&server), expected);
        drop((side, first));

        let second = server.flow("edge/robot-1", 2);
        wait_for(&second, Health::Up).await;
        let side = second.flow_side().unwrap();
        let mut loaded = side.load_leases().await.unwrap();
        loaded.sort();
        assert_eq!(
            loaded,
            [
                ("a".to_owned(), Bytes::from_static(b"2")),
                ("c".to_owned(), Bytes::from_static(b"1"))
            ]
        );
        server.cli(&["FLUSHALL"]);
        eventually("after a flush", || (leases(&server) == expected).then_some(())).await;
        server.server.kill().unwrap();
        wait_for(&second, Health::Down).await;
        side.remove_lease("a");
        side.put_lease("d", Bytes::from_static(b"1"));
        server.server.restart().unwrap();
        let expected = pairs(&[("c", "1"), ("d", "1")]);
        eventually("after a restart", || (leases(&server) == expected).then_some(())).await;
        assert_eq!(owner(&server), "edge/robot-1/2");
    }
}
