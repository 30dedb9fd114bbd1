//! What is kept for late joiners.

use std::time::{Duration, Instant};

use blaze_brokers::{Broker, Content, Health};
use blaze_tests::servers::RedisKind;

use super::support::{
    Server, channel, eventually, frame, next, next_number, publish, publisher, settled,
    subscribe_with_kept, wait_for, writer,
};

/// Late joiners come while a writer publishes as fast as it can: each gets an unbroken row, nothing
/// twice.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn late_joiners_get_an_unbroken_row() {
    let server = Server::start(RedisKind::Redis);
    let (source, sink) = (server.service().await, server.service().await);
    let publisher = publisher(&source, "map", 5);
    let (stop, stopped) = std::sync::mpsc::sync_channel::<()>(0);
    let thread = std::thread::spawn(move || {
        let mut sequence = 0;
        while stopped.try_recv() == Err(std::sync::mpsc::TryRecvError::Empty) {
            sequence += 1;
            publish(publisher.as_ref(), 1, sequence);
            // About 2,000 a second: the queue stays short, so that nothing is dropped on purpose.
            std::thread::sleep(std::time::Duration::from_micros(500));
        }
        publisher.later().dropped()
    });
    for round in 0..20 {
        let mut late = subscribe_with_kept(&sink, "map").await;
        let (_, first) = next_number(&mut late).await;
        for expected in first + 1..first + 100 {
            assert_eq!(next_number(&mut late).await, (1, expected), "round {round}, from {first}");
        }
    }
    drop(stop);
    assert_eq!(thread.join().unwrap(), 0);
}

/// When a writer's lease has lapsed, its field goes; so it does not come back when the server loses
/// everything.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_forgotten_writer_stays_forgotten() {
    let server = Server::start(RedisKind::Redis);
    let flow = server.flow("edge/robot-1", 1);
    wait_for(&flow, Health::Up).await;
    let (kept, gone) = (publisher(&flow, "map", 1), publisher(&flow, "map", 1));
    publish(kept.as_ref(), 1, 1);
    publish(gone.as_ref(), 2, 1);
    settled(kept.as_ref()).await;
    settled(gone.as_ref()).await;
    let fields = || {
        server
            .cli(&["HKEYS", "blaze:last:map"])
            .split_whitespace()
            .map(str::to_owned)
            .collect::<Vec<_>>()
    };
    assert_eq!(fields().len(), 2);
    flow.flow_side().unwrap().forget_writer(&channel("map"), writer(2));
    let only_the_first = || (fields() == [writer(1).to_string()]).then_some(());
    eventually("the field is gone", only_the_first).await;
    server.cli(&["FLUSHALL"]);
    eventually("what lives is written again", only_the_first).await;
    let sink = server.service().await;
    let mut late = subscribe_with_kept(&sink, "map").await;
    match next(&mut late).await.content {
        Content::Frame(found) => assert_eq!(
            (found.sequence(), found.payload()),
            (1, frame(1, 1, 100).payload()),
            "with its content"
        ),
        other => panic!("{other:?}"),
    }
}

/// Under a memory policy whole keys vanish, and somebody may delete one.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn keys_that_vanish_are_written_again() {
    let server = Server::start(RedisKind::Redis);
    let flow = server.flow("edge/robot-1", 1);
    wait_for(&flow, Health::Up).await;
    let publisher = publisher(&flow, "map", 1);
    publish(publisher.as_ref(), 1, 1);
    settled(publisher.as_ref()).await;
    flow.flow_side().unwrap().put_lease("a", "1".into());
    let keys = ["blaze:flow:leases", "blaze:last:map"];
    let count = |key: &str| server.cli(&["HLEN", key]).trim().to_owned();
    let are_there = || (count(keys[0]), count(keys[1])) == ("2".to_owned(), "1".to_owned());
    flow.flow_side().unwrap().put_lease("b", "1".into());
    eventually("all is written", || are_there().then_some(())).await;
    server.cli(&["DEL", keys[0], keys[1]]);
    // What is written right after makes a key anew, without what else was in it.
    flow.flow_side().unwrap().put_lease("a", "2".into());
    eventually("one of two", || (count(keys[0]) == "1").then_some(())).await;
    // It is looked for each ten seconds, and has to be missing twice.
    let until = Instant::now() + Duration::from_secs(30);
    while !are_there() {
        assert!(Instant::now() < until, "all is written again");
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
}

/// A service whose server was restarted writes again what it kept; what its gone publishers kept is
/// forgotten.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_restarted_server_gets_back_what_a_service_keeps() {
    let server = Server::start(RedisKind::Redis);
    let (source, sink) = (server.service().await, server.service().await);
    let publisher = publisher(&source, "map", 2);
    for sequence in 1..=3 {
        publish(publisher.as_ref(), 1, sequence);
    }
    settled(publisher.as_ref()).await;
    server.server.restart().unwrap();
    eventually("the field is back", || {
        (server.cli(&["HLEN", "blaze:last:map"]).trim() == "1").then_some(())
    })
    .await;
    wait_for(&sink, Health::Up).await;
    let mut late = subscribe_with_kept(&sink, "map").await;
    assert_eq!(next_number(&mut late).await, (1, 2));
    assert_eq!(next_number(&mut late).await, (1, 3));
}
