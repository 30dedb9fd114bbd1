//! The server dies, freezes, and comes back.

use std::time::{Duration, Instant};

use blaze_brokers::{Broker as _, Health, Role};
use blaze_tests::within;

use super::{Flow, frame, health, open, publish, publisher, reader, start_server};

/// In which the loss of the server must show.
const SHOWS: Duration = Duration::from_secs(5);

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_reliable_is_lost_or_repeated_by_a_server_that_is_killed_or_frozen() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    let service = open(&server, &Role::Service);
    health(&service, Health::Up).await;
    let channel = flow.channel("killed", 0).await;
    let mut reader = reader(&service, &channel).await;
    let publisher = publisher(&flow.broker, &channel, 0);
    let mut sequence = 0;
    let mut publish_some = || {
        for _ in 0..500 {
            sequence += 1;
            publish(publisher.as_ref(), &frame(&channel, 1, sequence));
        }
    };
    let mut last = 0;
    for is_killed in [true, false, true, false] {
        publish_some();
        if is_killed {
            server.kill().unwrap();
        } else {
            server.freeze().unwrap();
        }
        publish_some();
        let down = tokio::join!(health(&flow.broker, Health::Down), health(&service, Health::Down));
        assert!(down.0.max(down.1) < within(SHOWS), "{down:?}");
        publish_some();
        if is_killed {
            server.restart().unwrap();
        } else {
            server.thaw().unwrap();
        }
        tokio::join!(health(&flow.broker, Health::Up), health(&service, Health::Up));
        publish_some();
        for expected in last + 1..=last + 2000 {
            assert_eq!(reader.next_frame().await.sequence(), expected);
        }
        last += 2000;
    }
    assert!(reader.is_silent().await);
    assert_eq!(publisher.later().dropped(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_may_come_before_its_server_and_its_topic() {
    let server = start_server();
    server.kill().unwrap();
    let service = open(&server, &Role::Service);
    let channel = blaze_tests::servers::unique_name("early").parse().unwrap();
    let publisher = publisher(&service, &channel, 0);
    publish(publisher.as_ref(), &frame(&channel, 1, 1));
    assert!(service.subscribe(&channel, blaze_brokers::SubscribeOptions::default()).await.is_err());
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
