//! What the flow does on its server beside messages.

use std::collections::BTreeMap;

use blaze_brokers::{Broker as _, BrokerError, FlowSide, Health, PublishOutcome, SubscribeOptions};
use blaze_domain::WriterId;
use blaze_domain::names::ChannelName;
use blaze_tests::servers::unique_name;
use bytes::Bytes;

use super::plain::{delete_topic, make_topic, topic_uuid};
use super::{
    Flow, WITH_KEPT, eventually, frame, health, publish, publisher, reader, start_server, subscribe,
};

async fn leases(side: &dyn FlowSide) -> BTreeMap<String, String> {
    let loaded = side.load_leases().await.unwrap();
    let text = |(key, value): (String, Bytes)| (key, String::from_utf8(value.to_vec()).unwrap());
    loaded.into_iter().map(text).collect()
}

fn map(pairs: &[(&str, &str)]) -> BTreeMap<String, String> {
    pairs.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn leases_survive_the_flow_the_server_and_their_topic() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    assert_eq!(leases(flow.side.as_ref()).await, map(&[]));
    for (key, value) in [("a", "1"), ("b", "2"), ("a", "3"), ("c", "4")] {
        flow.side.put_lease(key, Bytes::from(value));
    }
    flow.side.remove_lease("c");
    let expected = map(&[("a", "3"), ("b", "2")]);
    eventually("the leases are there", async || leases(flow.side.as_ref()).await == expected).await;
    server.kill().unwrap();
    health(&flow.broker, Health::Down).await;
    assert!(matches!(flow.side.load_leases().await, Err(BrokerError::Away(_))));
    flow.side.put_lease("d", Bytes::from("5"));
    flow.side.remove_lease("b");
    server.restart().unwrap();
    let expected = map(&[("a", "3"), ("d", "5")]);
    eventually("what changed meanwhile is there", async || {
        leases(flow.side.as_ref()).await == expected
    })
    .await;
    flow.broker.close().await;
    let flow = Flow::open(&server).await;
    assert_eq!(leases(flow.side.as_ref()).await, expected);
    delete_topic(&server, "blaze.flow.leases").await;
    eventually("the leases are written again", async || {
        flow.side.load_leases().await.is_ok_and(|leases| leases.len() == 2)
    })
    .await;
    assert_eq!(leases(flow.side.as_ref()).await, expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn prepared_topics_are_made_again_until_they_are_released() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    let channel = flow.channel("again", 0).await;
    let mut reader = reader(&flow.broker, &channel).await;
    let publisher = publisher(&flow.broker, &channel, 0);
    let mut uuid = topic_uuid(&server, channel.as_str());
    for sequence in 1..=2 {
        delete_topic(&server, channel.as_str()).await;
        eventually("the topic is made again", async || {
            let found = topic_uuid(&server, channel.as_str());
            let zero = found.chars().all(|c| c == 'A');
            !zero && found != uuid
        })
        .await;
        uuid = topic_uuid(&server, channel.as_str());
        publish(publisher.as_ref(), &frame(&channel, 1, sequence));
        assert_eq!(reader.next_frame().await.sequence(), sequence);
    }
    flow.side.release(&channel);
    delete_topic(&server, channel.as_str()).await;
    let other = flow.channel("other", 0).await;
    assert!(
        topic_uuid(&server, channel.as_str()).chars().all(|c| c == 'A'),
        "made again though released, and {other} was made"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_forgotten_writer_leaves_nothing_for_late_joiners() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    // It was made for something else before.
    let name = unique_name("kept");
    make_topic(&server, &name, 1, &[("retention.ms", "600000")]).await;
    let channel: ChannelName = name.parse().unwrap();
    flow.side.prepare(&channel, 2).unwrap();
    let publisher = publisher(&flow.broker, &channel, 2);
    for sequence in 1..=3 {
        for writer in 1..=2 {
            publish(publisher.as_ref(), &frame(&channel, writer, sequence));
        }
    }
    eventually("all is written", async || publisher.later().queued == 0).await;
    let mut late = subscribe(&flow.broker, &channel, WITH_KEPT).await;
    let mut found = Vec::new();
    for _ in 0..4 {
        let frame = late.next_frame().await;
        found.push((frame.writer().0[0], frame.sequence()));
    }
    assert_eq!(found, [(1, 2), (2, 2), (1, 3), (2, 3)]);
    assert!(late.is_silent().await);
    flow.side.forget_writer(&channel, WriterId([1; 16]));
    eventually("the writer is forgotten", async || {
        let mut late = subscribe(&flow.broker, &channel, WITH_KEPT).await;
        let first = late.next_frame().await;
        first.writer() == WriterId([2; 16])
    })
    .await;
    let mut later = subscribe(&flow.broker, &channel, WITH_KEPT).await;
    for sequence in [2, 3] {
        let frame = later.next_frame().await;
        assert_eq!((frame.writer(), frame.sequence()), (WriterId([2; 16]), sequence));
    }
    assert!(later.is_silent().await);
    assert!(late.is_silent().await, "taking away is no message");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_flow_that_stands_back_reads_and_writes_nothing_but_where_flows_meet() {
    let server = start_server();
    let (flow, other) = (Flow::open(&server).await, Flow::open(&server).await);
    let channel = flow.channel("mine", 0).await;
    let peers: ChannelName = "blaze/flow/peers".parse().unwrap();
    let mut reader_of_user = reader(&flow.broker, &channel).await;
    let mut reader_of_peers = reader(&flow.broker, &peers).await;
    let (user, meeting) =
        (publisher(&flow.broker, &channel, 0), publisher(&flow.broker, &peers, 0));
    let others = publisher(&other.broker, &channel, 0);
    flow.side.stand_back(Some("cloud/server-9".to_owned()));
    health(&flow.broker, Health::InUse).await;
    assert_eq!(flow.broker.status().borrow().detail, "scope_in_use: cloud/server-9");
    assert_eq!(user.publish(&frame(&channel, 1, 1), None), PublishOutcome::Dropped);
    assert!(flow.broker.subscribe(&channel, SubscribeOptions::default()).await.is_err());
    publish(others.as_ref(), &frame(&channel, 2, 1));
    let hello = Bytes::from_static(b"hello");
    assert_eq!(meeting.publish_bare(&hello, None), PublishOutcome::Taken);
    assert_eq!(reader_of_peers.next_bare().await.0, hello);
    assert!(reader_of_user.is_silent().await);
    flow.side.stand_back(None);
    health(&flow.broker, Health::Up).await;
    let mut sequence = 1;
    eventually("it is read again", async || {
        sequence += 1;
        publish(others.as_ref(), &frame(&channel, 2, sequence));
        match reader_of_user.next_within(super::SILENCE).await {
            Some(received) => match received.content {
                blaze_brokers::Content::Frame(frame) => {
                    assert!(frame.sequence() > 1, "what was written meanwhile is another's");
                    true
                }
                other => panic!("{other:?}"),
            },
            None => false,
        }
    })
    .await;
    publish(user.as_ref(), &frame(&channel, 1, 2));
    eventually("it is written again", async || user.later().queued == 0).await;
    assert_eq!(user.later().dropped(), 0);
}
