//! Garbage where messages are expected: on the channel of a topic that is carried.

use blaze_brokers::PublishOutcome;
use blaze_domain::WriterId;
use bytes::{BufMut, Bytes, BytesMut};

use super::inside::{DEADLINE, Inside, LIVE_TOPIC, Traffic, frame_bytes, header};
use super::random::Random;
use blaze_tests::wait;

/// A frame of these header bytes.
fn raw(header: &[u8]) -> Bytes {
    let mut bytes = BytesMut::from(&b"BLZ1"[..]);
    bytes.put_u32_le(u32::try_from(header.len()).unwrap());
    bytes.put_slice(header);
    bytes.put_slice(b"payload");
    bytes.freeze()
}

/// A field of type bytes or text.
fn field(tag: u8, value: &[u8]) -> Vec<u8> {
    let mut bytes = vec![tag << 3 | 2, u8::try_from(value.len()).unwrap()];
    bytes.extend_from_slice(value);
    bytes
}

/// What begins like a frame and is none.
fn no_frames() -> Vec<Bytes> {
    let mut random = Random::new(7);
    let good = frame_bytes(&header(LIVE_TOPIC, 9, 1), b"");
    let mut all: Vec<Bytes> = (4..good.len()).map(|end| good.slice(..end)).collect();
    // Whatever follows `BLZ1`, with a length of the header that is allowed and with one that is not.
    for _ in 0..300 {
        let count = random.below(200);
        let mut bytes = BytesMut::from(&b"BLZ1"[..]);
        bytes.put_slice(&random.bytes(count));
        all.push(bytes.freeze());
        let count = 1 + random.below(120);
        all.push(raw(&random.bytes(count)));
    }
    let topic = field(1, LIVE_TOPIC.as_bytes());
    let writer = field(3, &[5; 16]);
    let sequence = vec![4 << 3, 1];
    let origin = |layer: &[u8]| field(2, &[field(1, layer), field(2, b"robot-1")].concat());
    let edge = origin(b"edge");
    let parts: [&[&[u8]]; 10] = [
        // Text that is not UTF-8: topic, encoding, origin.
        &[&field(1, b"imu/\xff\xfe"), &edge, &writer, &sequence],
        &[&topic, &edge, &writer, &sequence, &field(6, b"\xc3\x28")],
        &[&topic, &origin(b"ed\xffge"), &writer, &sequence],
        // A writer that is too short, or too long; none; a sequence of 0; none; no topic.
        &[&topic, &edge, &field(3, &[5; 15]), &sequence],
        &[&topic, &edge, &field(3, &[5; 17]), &sequence],
        &[&topic, &edge, &sequence],
        &[&topic, &edge, &writer, &[4 << 3, 0]],
        &[&topic, &edge, &writer],
        &[&edge, &writer, &sequence],
        // A field of another wire type than its own: topic as a number.
        &[&[1 << 3, 7], &edge, &writer, &sequence],
    ];
    all.extend(parts.iter().map(|parts| raw(&parts.concat())));
    // The longest header that the prefix may promise, and one more; the highest.
    for length in [4096_u32, 4097, u32::MAX] {
        let mut bytes = BytesMut::from(&b"BLZ1"[..]);
        bytes.put_u32_le(length);
        bytes.put_slice(&[0; 32]);
        all.push(bytes.freeze());
    }
    all
}

#[tokio::test(flavor = "multi_thread", worker_threads = 3)]
async fn garbage_on_a_topic_is_counted_and_the_topic_goes_on() {
    let inside = Inside::start().await;
    let traffic = Traffic::start(&inside).await;

    let garbage = no_frames();
    for bytes in &garbage {
        assert_eq!(inside.publish(LIVE_TOPIC, bytes.clone()), PublishOutcome::Taken);
    }
    // In order by itself, and of another topic: a decode error like the rest.
    let elsewhere = frame_bytes(&header("imu/other", 9, 1), b"x");
    inside.publish(LIVE_TOPIC, elsewhere);
    let expected = garbage.len() as u64 + 1;
    wait::until(
        "all garbage counted",
        DEADLINE,
        || inside.dropped(LIVE_TOPIC, "decode_error") == expected,
        || {
            format!(
                "{expected} sent, {} counted",
                inside.dropped(LIVE_TOPIC, "decode_error")
            )
        },
    )
    .unwrap();
    assert_eq!(traffic.strangers(), 0, "nothing of it arrived");
    traffic.end().await;
    inside.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 3)]
async fn payloads_above_16_mib_are_counted_and_the_topic_goes_on() {
    let inside = Inside::start().await;
    let traffic = Traffic::start(&inside).await;
    let too_long = Bytes::from(vec![b'x'; 16 * 1024 * 1024 + 1]);

    // A memory broker refuses it at the publisher ...
    assert_eq!(inside.publish(LIVE_TOPIC, too_long.clone()), PublishOutcome::TooLarge);
    // ... a server in another process may hold it: without a header, and with one.
    assert_eq!(
        inside.node_broker.inject(LIVE_TOPIC, &too_long),
        1,
        "the flow reads the topic"
    );
    let mut framed = BytesMut::from(&frame_bytes(&header(LIVE_TOPIC, 9, 1), b"")[..]);
    framed.put_slice(&too_long);
    inside.node_broker.inject(LIVE_TOPIC, &framed.freeze());
    let counted = || inside.dropped(LIVE_TOPIC, "too_large") + inside.dropped(LIVE_TOPIC, "decode_error");
    wait::until(
        "both counted",
        DEADLINE,
        || counted() == 2,
        || format!("{} counted", counted()),
    )
    .unwrap();
    assert!(
        inside.dropped(LIVE_TOPIC, "too_large") >= 1,
        "the bare one is too_large"
    );

    // Exactly 16 MiB is a message like any other.
    inside.node_broker.inject(LIVE_TOPIC, &too_long.slice(1..));
    wait::until(
        "16 MiB arrive",
        DEADLINE,
        || traffic.strangers() == 1,
        || "they did not".into(),
    )
    .unwrap();
    traffic.end().await;
    inside.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 3)]
async fn headers_with_extreme_values_are_messages_or_counted() {
    let inside = Inside::start().await;
    let traffic = Traffic::start(&inside).await;

    // Another node, another layer: not born here.
    for (layer, node) in [("edge", "robot-2"), ("fog", "robot-1"), ("", "")] {
        let mut foreign = header(LIVE_TOPIC, 1, 1);
        foreign.writer = WriterId([layer.len() as u8 + node.len() as u8; 16]);
        foreign.origin.layer = layer.into();
        foreign.origin.node = node.into();
        inside.publish(LIVE_TOPIC, frame_bytes(&foreign, b"foreign"));
    }
    wait::until(
        "foreign messages counted",
        DEADLINE,
        || inside.dropped(LIVE_TOPIC, "foreign_origin") == 3,
        || format!("{} counted", inside.dropped(LIVE_TOPIC, "foreign_origin")),
    )
    .unwrap();

    // The highest of every number; clocks that are wrong in both directions.
    let mut random = Random::new(3);
    let mut sent = 0;
    for age_us in [0, u64::MAX / 2, u64::MAX - 1, u64::MAX] {
        for publish_time_ns in [0, 1, u64::MAX] {
            let mut extreme = header(LIVE_TOPIC, 0, u64::MAX);
            extreme.writer = WriterId(random.bytes(16).try_into().unwrap());
            extreme.age_us = age_us;
            extreme.publish_time_ns = publish_time_ns;
            extreme.depth = u32::MAX;
            extreme.origin.epoch = u64::MAX;
            inside.publish(LIVE_TOPIC, frame_bytes(&extreme, b"extreme"));
            sent += 1;
        }
    }
    wait::until(
        "messages with extreme values arrive",
        DEADLINE,
        || traffic.strangers() == sent,
        || format!("{sent} sent, {} arrived", traffic.strangers()),
    )
    .unwrap();
    // The same again is a repeat; with hops it is an echo.
    let mut repeat = header(LIVE_TOPIC, 77, 5);
    for _ in 0..3 {
        inside.publish(LIVE_TOPIC, frame_bytes(&repeat, b"repeat"));
    }
    repeat.hops = 2;
    inside.publish(LIVE_TOPIC, frame_bytes(&repeat, b"repeat"));
    wait::until(
        "repeats counted",
        DEADLINE,
        || inside.dropped(LIVE_TOPIC, "duplicate") == 2 && inside.dropped(LIVE_TOPIC, "echo") == 1,
        || format!("{:?}", inside.admin.get("/metrics")),
    )
    .unwrap();
    traffic.end().await;
    inside.end().await;
}

/// Only the flow writes messages with hops on the node scope; whoever else does must find them counted.
#[tokio::test(flavor = "multi_thread", worker_threads = 3)]
async fn messages_of_strangers_with_hops_are_counted() {
    let inside = Inside::start().await;
    let traffic = Traffic::start(&inside).await;
    for (writer, hops) in [(1, 1), (2, 7), (3, u32::MAX)] {
        let mut far = header(LIVE_TOPIC, writer, 1);
        far.hops = hops;
        inside.publish(LIVE_TOPIC, frame_bytes(&far, b"far"));
    }
    wait::until(
        "all counted",
        DEADLINE,
        || inside.dropped(LIVE_TOPIC, "echo") + inside.dropped(LIVE_TOPIC, "foreign_origin") == 3,
        || format!("{} of 3 counted", inside.dropped(LIVE_TOPIC, "echo")),
    )
    .unwrap();
    traffic.end().await;
    inside.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 3)]
async fn a_foreign_message_cannot_silence_the_writer_whose_name_it_bears() {
    let inside = Inside::start().await;
    let traffic = Traffic::start(&inside).await;
    // A node with a copied configuration, say: it uses the writer of a service of this node, far ahead of it.
    let mut foreign = header(LIVE_TOPIC, 42, 1_000_000);
    foreign.origin.node = "robot-2".into();
    inside.publish(LIVE_TOPIC, frame_bytes(&foreign, b"foreign"));
    let own = header(LIVE_TOPIC, 42, 1);
    inside.publish(LIVE_TOPIC, frame_bytes(&own, b"own"));
    wait::until(
        "the writer's own message arrives",
        DEADLINE,
        || traffic.strangers() == 1,
        || format!("{} dropped as duplicate", inside.dropped(LIVE_TOPIC, "duplicate")),
    )
    .unwrap();
    traffic.end().await;
    inside.end().await;
}
