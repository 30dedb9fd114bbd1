//! The server dies, freezes, and comes back.

use std::time::{Duration, Instant};

use blaze_brokers::{Broker as _, Health, Role};
use blaze_tests::within;

use super::{Flow, frame, health, open, publish, publisher, reader, start_server};

/// In which the loss of the server must show.
const SHOWS: Duration = Duration::from_secs(5);

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_reliable_is_lost_or_repeated_by_a_killed_server() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    let service = open(&server, &Role::Service);
    health(&service, Health::Up).await;
    let channel = flow.channel("killed", 0).await;
    let mut reader = reader(&service, &channel).await;
    let publisher = publisher(&flow.broker, &channel, 0);
    let mut sequence = 0;
    let mut publish_some = |count: u64| {
        for _ in 0..count {
            sequence += 1;
            publish(publisher.as_ref(), &frame(&channel, 1, sequence));
        }
    };
    let mut last = 0;
    for _ in 0..2 {
        publish_some(500);
        server.kill().unwrap();
        publish_some(500);
        let down = tokio::join!(health(&flow.broker, Health::Down), health(&service, Health::Down));
        assert!(down.0.max(down.1) < within(SHOWS), "{down:?}");
        publish_some(500);
        server.restart().unwrap();
        let start = Instant::now();
        tokio::join!(health(&flow.broker, Health::Up), health(&service, Health::Up));
        println!("up {:?} after the server was", start.elapsed());
        publish_some(500);
        for expected in last + 1..=last + 2000 {
            assert_eq!(reader.next_frame().await.sequence(), expected);
        }
        last += 2000;
    }
    assert!(reader.is_silent().await);
    assert_eq!(publisher.later().dropped(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_frozen_server_shows_and_nothing_reliable_is_lost() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    let channel = flow.channel("frozen", 0).await;
    let mut reader = reader(&flow.broker, &channel).await;
    let publisher = publisher(&flow.broker, &channel, 0);
    publish(publisher.as_ref(), &frame(&channel, 1, 1));
    assert_eq!(reader.next_frame().await.sequence(), 1);
    for round in 0..2 {
        let first = 2 + round * 100;
        server.freeze().unwrap();
        let start = Instant::now();
        for sequence in first..first + 50 {
            publish(publisher.as_ref(), &frame(&channel, 1, sequence));
        }
        health(&flow.broker, Health::Down).await;
        assert!(start.elapsed() < within(SHOWS), "{:?}", start.elapsed());
        println!("down {:?} after the server froze", start.elapsed());
        for sequence in first + 50..first + 100 {
            publish(publisher.as_ref(), &frame(&channel, 1, sequence));
        }
        server.thaw().unwrap();
        health(&flow.broker, Health::Up).await;
        for sequence in first..first + 100 {
            assert_eq!(reader.next_frame().await.sequence(), sequence);
        }
    }
    assert!(reader.is_silent().await);
    assert_eq!(publisher.later().dropped(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_over_its_time_while_the_server_is_away_is_dropped() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    let channel = flow.channel("lifespan", 0).await;
    let mut reader = reader(&flow.broker, &channel).await;
    let publisher = publisher(&flow.broker, &channel, 0);
    server.kill().unwrap();
    health(&flow.broker, Health::Down).await;
    let soon = Instant::now() + Duration::from_millis(300);
    publisher.publish(&frame(&channel, 1, 1), Some(soon));
    publish(publisher.as_ref(), &frame(&channel, 1, 2));
    super::eventually("the first is dropped", async || publisher.later().lifespan == 1).await;
    server.restart().unwrap();
    let received = reader.next_frame().await;
    assert_eq!(received.sequence(), 2);
    // What it waited here is part of its age.
    assert!(received.age_us() > 300_000, "{}", received.age_us());
    assert!(reader.is_silent().await);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_may_come_before_its_server_and_its_topic() {
    let server = start_server();
    server.kill().unwrap();
    let service = open(&server, &Role::Service);
    let channel = blaze_tests::servers::unique_name("early").parse().unwrap();
    let publisher = publisher(&service, &channel, 0);
    publish(publisher.as_ref(), &frame(&channel, 1, 1));
    assert!(
        service
            .subscribe(&channel, blaze_brokers::SubscribeOptions::default())
            .await
            .is_err()
    );
    server.restart().unwrap();
    health(&service, Health::Up).await;
    assert_eq!(publisher.later().queued, 1, "there is no such topic yet");
    let flow = Flow::open(&server).await;
    flow.side.prepare(&channel, 0).unwrap();
    super::eventually("it is written", async || publisher.later().queued == 0).await;
    assert_eq!(publisher.later().dropped(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn closing_does_not_wait_for_a_frozen_server() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    let channel = flow.channel("closing", 0).await;
    let mut reader = reader(&flow.broker, &channel).await;
    let publisher = publisher(&flow.broker, &channel, 0);
    server.freeze().unwrap();
    publish(publisher.as_ref(), &frame(&channel, 1, 1));
    let start = Instant::now();
    flow.broker.close().await;
    assert!(start.elapsed() < Duration::from_secs(8), "{:?}", start.elapsed());
    assert_eq!(flow.broker.status().borrow().health, Health::Closed);
    assert!(reader.is_silent().await);
    let later = publisher.later();
    assert_eq!((later.queued, later.broker_error), (0, 1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn closing_waits_for_a_server_that_pauses() {
    // Longer than a second, and far from what a closed client waits: the machine may be busy.
    const PAUSE: Duration = Duration::from_millis(1_300);
    let server = start_server();
    let flow = Flow::open(&server).await;
    let service = open(&server, &Role::Service);
    health(&service, Health::Up).await;
    let channel = flow.channel("closing", 0).await;
    let mut reader = reader(&flow.broker, &channel).await;
    let publisher = publisher(&service, &channel, 0);
    publish(publisher.as_ref(), &frame(&channel, 1, 1));
    assert_eq!(reader.next_frame().await.sequence(), 1);
    server.freeze().unwrap();
    for sequence in 2..=100 {
        publish(publisher.as_ref(), &frame(&channel, 1, sequence));
    }
    let pause = async {
        tokio::time::sleep(PAUSE).await;
        server.thaw().unwrap();
    };
    tokio::join!(pause, service.close());
    for expected in 2..=100 {
        assert_eq!(reader.next_frame().await.sequence(), expected);
    }
    assert_eq!(publisher.later().dropped(), 0);
}
