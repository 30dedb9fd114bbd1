//! Records of plain clients, and topics that users made.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_brokers::{Content, PublishOutcome, Role};
use blaze_domain::WriterId;
use blaze_domain::names::ChannelName;
use blaze_tests::servers::unique_name;
use sha2::{Digest as _, Sha256};

use super::plain::{PlainProducer, delete_topic, make_topic, topic_uuid};
use super::{
    Flow, WITH_KEPT, eventually, frame, health, open, publish, publisher, reader, start_server,
    subscribe,
};

fn bare_writer(layer: &str, uuid: &str, partition: i32) -> WriterId {
    let hash = Sha256::digest(format!("kafka|{layer}|{uuid}|{partition}"));
    WriterId(hash[..16].try_into().unwrap())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn bare_records_have_the_identity_of_their_place() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    let service = open(&server, &Role::Service);
    health(&service, blaze_brokers::Health::Up).await;
    let name = unique_name("own");
    make_topic(&server, &name, 3, &[]).await;
    let channel: ChannelName = name.parse().unwrap();
    let plain = PlainProducer::new(&server);
    plain.write(&name, 1, &["before"]);
    let mut of_flow = reader(&flow.broker, &channel).await;
    let mut of_service = reader(&service, &channel).await;
    for partition in 0..3 {
        plain.write(&name, partition, &["one", "two", ""]);
    }
    let uuid = topic_uuid(&server, &name);
    for (reader, layer) in [(&mut of_flow, "fog"), (&mut of_service, "")] {
        let mut found: BTreeMap<WriterId, Vec<(u64, String)>> = BTreeMap::new();
        for _ in 0..9 {
            let (payload, identity) = reader.next_bare().await;
            let (writer, sequence) = identity.unwrap();
            let text = String::from_utf8(payload.to_vec()).unwrap();
            found.entry(writer).or_default().push((sequence, text));
        }
        for partition in 0..3 {
            let first = if partition == 1 { 2 } else { 1 };
            let expected = [(first, "one"), (first + 1, "two"), (first + 2, "")];
            let expected = expected.map(|(sequence, text)| (sequence, text.to_owned())).to_vec();
            assert_eq!(
                found.get(&bare_writer(layer, &uuid, partition)),
                Some(&expected),
                "{partition}"
            );
        }
        assert!(reader.is_silent().await);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_topic_made_anew_is_read_from_its_beginning() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    let name = unique_name("anew");
    make_topic(&server, &name, 1, &[]).await;
    let channel: ChannelName = name.parse().unwrap();
    let plain = PlainProducer::new(&server);
    plain.write(&name, 0, &["old", "older"]);
    let mut reader = reader(&flow.broker, &channel).await;
    plain.write(&name, 0, &["live"]);
    let before = reader.next_bare().await;
    assert_eq!((&before.0[..], before.1.unwrap().1), (&b"live"[..], 3));
    let mut writers = vec![before.1.unwrap().0];
    for round in 0..2 {
        delete_topic(&server, &name).await;
        make_topic(&server, &name, 1, &[]).await;
        // More than the old topic had, so that the old position exists in the new one.
        let values: Vec<String> = (0..10).map(|number| format!("{round}/{number}")).collect();
        let values: Vec<&str> = values.iter().map(String::as_str).collect();
        PlainProducer::new(&server).write(&name, 0, &values);
        let writer = bare_writer("fog", &topic_uuid(&server, &name), 0);
        assert!(!writers.contains(&writer));
        writers.push(writer);
        for (sequence, value) in (1..).zip(&values) {
            let (payload, identity) = reader.next_bare().await;
            assert_eq!((&payload[..], identity), (value.as_bytes(), Some((writer, sequence))));
        }
    }
    assert!(reader.is_silent().await);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_writer_stays_in_order_on_several_partitions() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    let name = unique_name("spread");
    make_topic(&server, &name, 4, &[("cleanup.policy", "compact")]).await;
    let channel: ChannelName = name.parse().unwrap();
    let mut reader = reader(&flow.broker, &channel).await;
    let publisher = publisher(&flow.broker, &channel, 3);
    for sequence in 1..=200 {
        for writer in 1..=4 {
            publish(publisher.as_ref(), &frame(&channel, writer, sequence));
        }
    }
    let mut last = [0; 5];
    for _ in 0..800 {
        let frame = reader.next_frame().await;
        let last = &mut last[usize::from(frame.writer().0[0])];
        assert_eq!(frame.sequence(), *last + 1);
        *last += 1;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_larger_than_the_topic_allows_is_counted_as_that() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    let name = unique_name("narrow");
    make_topic(&server, &name, 1, &[("max.message.bytes", "2000")]).await;
    let channel: ChannelName = name.parse().unwrap();
    let mut reader = reader(&flow.broker, &channel).await;
    let publisher = publisher(&flow.broker, &channel, 0);
    let large = bytes::Bytes::from(vec![b'x'; 10_000]);
    assert_eq!(publisher.publish_bare(&large, None), PublishOutcome::Taken);
    eventually("the refusal is counted", async || publisher.later().too_large == 1).await;
    publish(publisher.as_ref(), &frame(&channel, 1, 1));
    assert_eq!(reader.next_frame().await.sequence(), 1);
    assert_eq!(publisher.later().dropped(), 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn ages_count_what_a_message_lay_on_the_server() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    let channel = flow.channel("age", 1).await;
    let publisher = publisher(&flow.broker, &channel, 1);
    let before = Instant::now();
    publish(publisher.as_ref(), &frame(&channel, 1, 1).with_hops_and_age(3, 1000));
    eventually("it is written", async || publisher.later().queued == 0).await;
    let written = Instant::now();
    while written.elapsed() < Duration::from_millis(700) {
        tokio::task::yield_now().await;
    }
    let mut late = subscribe(&flow.broker, &channel, WITH_KEPT).await;
    let received = late.next().await;
    let longest = u64::try_from(before.elapsed().as_micros()).unwrap();
    let age = received.broker_age_us;
    assert!((690_000..=longest).contains(&age), "{age} µs of {longest}");
    let Content::Frame(frame) = received.content else {
        panic!("{received:?}");
    };
    assert_eq!(frame.hops(), 3);
    assert!((1000..1_000_000).contains(&frame.age_us()), "{}", frame.age_us());
}
