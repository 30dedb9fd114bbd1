//! Servers that die, freeze, forget or cut off a reader.

use std::time::{Duration, Instant};

use blaze_brokers::{
    Broker, BrokerError, Health, PublishOutcome, PublisherOptions, SubscribeOptions,
};
use blaze_tests::servers::{RedisKind, RedisOptions};

use super::support::{
    DEADLINE, Server, channel, eventually, frame, next_number, numbers_until_silence, publish,
    publisher, subscribe, wait_for,
};

/// A frozen server: within some 2 s the client is down and takes nothing; thawed, it is up, and
/// nothing comes twice.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_frozen_server_is_noticed_and_nothing_comes_twice() {
    for kind in [RedisKind::Redis, RedisKind::Valkey] {
        let server = Server::start(kind);
        let (source, sink) = (server.service().await, server.service().await);
        let mut reader = subscribe(&sink, "imu").await;
        let publisher = publisher(&source, "imu", 0);
        publish(publisher.as_ref(), 1, 1);
        assert_eq!(next_number(&mut reader).await, (1, 1));
        server.server.freeze().unwrap();
        let frozen = Instant::now();
        let mut taken = vec![];
        let mut sequence = 1;
        while frozen.elapsed() < Duration::from_secs(5) {
            sequence += 1;
            if publisher.publish(&frame(1, sequence, 100), None) == PublishOutcome::Taken {
                taken.push(sequence);
            } else if source.status().borrow().health == Health::Down {
                assert!(
                    frozen.elapsed() < Duration::from_secs(if blaze_tests::long() { 3 } else { 4 }),
                    "down after {:?}",
                    frozen.elapsed()
                );
                break;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        assert_eq!(
            wait_for(&sink, Health::Down).await,
            format!("127.0.0.1:{} does not answer", server.server.port())
        );
        assert!(matches!(
            sink.subscribe(&channel("other"), SubscribeOptions::default()).await,
            Err(BrokerError::Away(_))
        ));
        // Up to the end of the freeze nothing is taken.
        while frozen.elapsed() < Duration::from_secs(5) {
            sequence += 1;
            assert_eq!(publisher.publish(&frame(1, sequence, 100), None), PublishOutcome::Dropped);
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        server.server.thaw().unwrap();
        wait_for(&source, Health::Up).await;
        wait_for(&sink, Health::Up).await;
        let after = sequence + 1;
        publish(publisher.as_ref(), 1, after);
        let mut found = Vec::new();
        while found.last() != Some(&after) {
            found.push(next_number(&mut reader).await.1);
        }
        found.extend(numbers_until_silence(&mut reader).await);
        assert_eq!(found.last(), Some(&after));
        assert!(found.is_sorted_by(|a, b| a < b), "{found:?}");
        let late: Vec<_> =
            found.iter().filter(|&&number| number != after && !taken.contains(&number)).collect();
        assert!(late.is_empty(), "dropped and delivered: {late:?}");
        let later = publisher.later();
        let delivered = found.len() as u64 - 1;
        assert_eq!(later.queued, 0);
        assert_eq!(
            delivered + later.dropped(),
            taken.len() as u64,
            "each is delivered or counted: {later:?}"
        );
    }
}

/// A server that is killed while much is under way: what is not delivered is counted, nothing comes
/// twice.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_server_loses_nothing_uncounted() {
    let server = Server::start(RedisKind::Redis);
    let source = server.service().await;
    let publisher = publisher(&source, "imu", 0);
    for round in 0..3u64 {
        let before = publisher.later();
        let mut taken = 0;
        for sequence in 1..=20_000 {
            if publisher.publish(&frame(1, round * 100_000 + sequence, 1_000), None)
                == PublishOutcome::Taken
            {
                taken += 1;
            }
            if sequence == 10_000 {
                server.server.kill().unwrap();
            }
        }
        wait_for(&source, Health::Down).await;
        let later = eventually("all is settled", || {
            let later = publisher.later();
            (later.queued == 0).then_some(later)
        })
        .await;
        assert!(later.dropped() - before.dropped() <= taken);
        assert!(
            later.broker_error > before.broker_error,
            "what was under way is counted: {later:?}"
        );
        server.server.restart().unwrap();
        wait_for(&source, Health::Up).await;
    }
}

/// A reader that the server cuts off for being slow comes back by itself; what is missing is
/// missing, nothing is repeated, and the status tells.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_reader_that_is_cut_off_comes_back() {
    let server = Server::with(
        RedisKind::Redis,
        RedisOptions {
            extra: vec!["client-output-buffer-limit pubsub 1mb 0 0".to_owned()],
            ..RedisOptions::default()
        },
    );
    let (source, sink) = (server.service().await, server.service().await);
    let options = SubscribeOptions { large: true, ..SubscribeOptions::default() };
    let mut reader = sink.subscribe(&channel("camera"), options).await.unwrap();
    let large = PublisherOptions { large: true, ..PublisherOptions::default() };
    let publisher = source.publisher(&channel("camera"), large).unwrap();
    // One message above the limit and above what the sockets hold: the server closes the reader.
    eventually("the large connection takes messages", || {
        (publisher.publish(&frame(1, 1, 16 * 1024 * 1024), None) == PublishOutcome::Taken)
            .then_some(())
    })
    .await;
    let detail = eventually("the status tells", || {
        let status = sink.status().borrow().clone();
        (status.health == Health::Up && status.detail.contains("interrupted"))
            .then_some(status.detail)
    })
    .await;
    assert!(detail.starts_with("redis 7.0.15; reading was interrupted"), "{detail}");
    let mut small = subscribe(&sink, "imu").await;
    publish(self::publisher(&source, "imu", 0).as_ref(), 1, 1);
    assert_eq!(
        next_number(&mut small).await,
        (1, 1),
        "small topics have a connection of their own"
    );
    let mut sequence = 100;
    let until = Instant::now() + DEADLINE;
    loop {
        sequence += 1;
        publisher.publish(&frame(1, sequence, 1_000), None);
        let found = numbers_until_silence(&mut reader).await;
        if let Some(first) = found.first() {
            assert!(*first > 100, "{found:?}");
            break;
        }
        assert!(Instant::now() < until, "nothing comes any more");
    }
}
