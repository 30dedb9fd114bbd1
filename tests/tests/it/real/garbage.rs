//! Garbage on every door of a real broker: counted, nothing crashes, memory is bounded.

use std::time::Duration;

use blaze_domain::WriterId;
use blaze_proto::Frame;
use blaze_tests::flow::FlowProcess;
use blaze_tests::plain::{KafkaReader, KafkaWriter};
use blaze_tests::servers::{shared_kafka, shared_redis};
use blaze_tests::wait;
use rand::rngs::StdRng;
use rand::{Rng as _, RngExt as _, SeedableRng as _};
use serde_json::{Value, json};

use crate::real::support::{RedisReader, RobotAndCloud, SOON};

const TOPIC: &str = "imu/data";
/// What a flow may hold beside what it had before.
const MAX_GROWTH_KIB: u64 = 160 * 1024;

fn metric_sum(flow: &FlowProcess, name: &str, label: &str) -> f64 {
    let Ok((_, text)) = flow.admin().get("/metrics") else {
        return 0.0;
    };
    text.lines()
        .filter(|line| line.starts_with(name) && line.contains(label))
        .filter_map(|line| line.rsplit(' ').next()?.parse::<f64>().ok())
        .sum()
}

/// Payloads that claim to be frames and are none.
fn broken_frames() -> Vec<Vec<u8>> {
    let mut all = vec![
        b"BLZ1".to_vec(),
        b"BLZ1\x00".to_vec(),
        b"BLZ1\xff\xff\xff\xff".to_vec(),
        b"BLZ1\x10\x00\x00\x00short".to_vec(),
        b"BLZ1\x00\x00\x00\x00no header at all".to_vec(),
        [b"BLZ1\x08\x00\x00\x00".as_slice(), &[0xff; 8], b"payload"].concat(),
        [b"BLZ1\x00\x10\x00\x00".as_slice(), &[0x0a; 4096], b"payload"].concat(),
    ];
    let mut random = StdRng::seed_from_u64(7);
    for _ in 0..200 {
        let length = random.random_range(4..600);
        let mut bytes = vec![0; length];
        random.fill_bytes(&mut bytes);
        bytes[..4].copy_from_slice(b"BLZ1");
        all.push(bytes);
    }
    all
}

/// Control payloads that nobody should send.
fn hostile_control() -> Vec<Vec<u8>> {
    let deep = "[".repeat(30_000);
    let mut all: Vec<Vec<u8>> = vec![
        b"".to_vec(),
        b"null".to_vec(),
        b"[]".to_vec(),
        b"{".to_vec(),
        b"\xff\xfe\x00".to_vec(),
        deep.into_bytes(),
        b"{\"op\":\"advertise\"}".to_vec(),
        b"{\"op\":\"advertise\",\"topic\":1,\"service\":{}}".to_vec(),
        b"{\"op\":\"request\",\"topic\":\"a\",\"service\":\"s\",\"max_rate_hz\":1e999}".to_vec(),
        json!({"op":"advertise","topic":"x".repeat(60_000),"service":"s"}).to_string().into_bytes(),
        vec![b'a'; 70_000],
        json!(vec![json!({"op":"fly"}); 201]).to_string().into_bytes(),
    ];
    let mut random = StdRng::seed_from_u64(11);
    for _ in 0..200 {
        let mut bytes = vec![0; random.random_range(1..300)];
        random.fill_bytes(&mut bytes);
        all.push(bytes);
    }
    all
}

fn flowing(system: &RobotAndCloud, reader: &KafkaReader) -> anyhow::Result<()> {
    let mark = format!("mark-{}", rand::random::<u64>());
    wait::until(
        "a good message still passes",
        SOON,
        || {
            let _ = system.publish(TOPIC, mark.as_bytes());
            while let Some(record) = reader.next(Duration::from_millis(100)) {
                if record.payload == mark.as_bytes() {
                    return true;
                }
            }
            false
        },
        || format!("{}\n{}", system.robot.tail(), system.cloud.tail()),
    )?;
    Ok(())
}

/// Messages that a flow dropped for a reason.
fn dropped(flow: &FlowProcess, reason: &str) -> f64 {
    metric_sum(flow, "blaze_flow_dropped_total", &format!("reason=\"{reason}\""))
}

/// Control messages that a flow refused.
fn refused(flow: &FlowProcess) -> f64 {
    metric_sum(flow, "blaze_flow_link_events_total", "event=\"control_message_refused\"")
}

fn wait_count(
    what: &str,
    flow: &FlowProcess,
    count: impl Fn() -> f64,
    expected: f64,
) -> anyhow::Result<()> {
    let state = || format!("{} of {expected}\n{}", count(), flow.tail());
    wait::until(what, SOON, || count() >= expected, state)?;
    Ok(())
}

/// Frames on a Redis channel.
fn frames(robot: &FlowProcess, system: &RobotAndCloud) -> anyhow::Result<()> {
    let (before, frames) = (dropped(robot, "decode_error"), broken_frames());
    for frame in &frames {
        system.publish(TOPIC, frame)?;
    }
    let count = || dropped(robot, "decode_error");
    wait_count("every broken frame is counted", robot, count, before + frames.len() as f64)
}

/// One byte too many.
fn large_payloads(robot: &FlowProcess, system: &RobotAndCloud) -> anyhow::Result<()> {
    let (before, large) = (dropped(robot, "too_large"), vec![b'x'; 16 * 1024 * 1024 + 1]);
    system.publish(TOPIC, &large)?;
    let count = || dropped(robot, "too_large");
    wait_count("a payload of 16 MiB + 1 is counted", robot, count, before + 1.0)?;
    let why = || robot.why(TOPIC, None).unwrap_or_default();
    wait::until(
        "why names what is too large for any bridge",
        SOON,
        || {
            let _ = system.publish(TOPIC, &large);
            why()["code"] == "too_large" && why()["verdict"] == "not_flowing"
        },
        || why().to_string(),
    )?;
    Ok(())
}

/// Control messages on both brokers.
fn control_messages(
    robot: &FlowProcess,
    system: &RobotAndCloud,
    writer: &KafkaWriter,
) -> anyhow::Result<()> {
    const CONTROL: &str = "blaze/flow/control";
    let mut events = RedisReader::new(&system.redis, &system.channel("blaze/flow/events"))?;
    let (before, hostile) = (refused(robot), hostile_control());
    for payload in &hostile {
        system.publish(CONTROL, payload)?;
        writer.produce_later(&system.topic(CONTROL), payload)?;
    }
    writer.produce(&system.topic(CONTROL), b"{}")?;
    // An empty array alone has no fault.
    let expected = before + (hostile.len() - 1) as f64;
    wait_count("every refusal is counted", robot, || refused(robot), expected)?;
    let is_told =
        |event: Value| event["event"] == "lease_refused" && event["code"] == "invalid_json";
    let told = || events.next_json(SOON).is_ok_and(is_told);
    wait::until("an event says so", SOON, told, || robot.tail())?;
    Ok(())
}

/// Kafka records with headers that lie, and what follows on their topic.
fn headers(system: &RobotAndCloud, channel: &str, writer: &KafkaWriter) -> anyhow::Result<()> {
    let (cloud, topic) = (&system.cloud, &system.topic(channel));
    let mut robot = RedisReader::new(&system.redis, &system.channel(channel))?;
    let before = dropped(cloud, "decode_error");
    let id = [b'a'; 32];
    let hostile: [&[(&str, &[u8])]; 6] = [
        &[("blaze-writer", b"no hex")],
        &[("blaze-writer", &[0xff; 40]), ("blaze-sequence", b"1")],
        &[("blaze-writer", &id), ("blaze-sequence", b"0")],
        &[("blaze-writer", &id), ("blaze-sequence", b"-1")],
        &[("blaze-writer", &id)],
        &[("blaze-writer", &id), ("blaze-sequence", b"1"), ("blaze-origin", &[b'/'; 9_000])],
    ];
    for headers in hostile {
        writer.produce_with(topic, b"payload", headers)?;
    }
    let count = || dropped(cloud, "decode_error");
    wait_count("every hostile record is counted", cloud, count, before + hostile.len() as f64)?;
    // The writer of the hostile records is heard, and a record that names no writer is bare,
    // whatever else it says.
    let origin = b"cloud/cloud-1/planner/";
    let good: &[(&str, &[u8])] =
        &[("blaze-writer", &id), ("blaze-sequence", b"1"), ("blaze-origin", origin)];
    writer.produce_with(topic, b"good", good)?;
    writer.produce_with(topic, b"bare", &[("blaze-sequence", b"-1"), ("blaze-origin", b"\xff")])?;
    let mut found = Vec::new();
    for _ in 0..2 {
        let next = robot.next(SOON)?;
        let next = next.ok_or_else(|| anyhow::anyhow!("only {found:?} came\n{}", cloud.tail()))?;
        let frame = Frame::parse(next.into())?;
        let is_named = frame.writer() == WriterId([0xaa; 16]);
        found.push((String::from_utf8_lossy(frame.payload()).into_owned(), is_named));
    }
    // Writers do not wait for each other.
    found.sort();
    assert_eq!(found, [("bare".to_owned(), false), ("good".to_owned(), true)]);
    Ok(())
}

#[test]
fn garbage_is_counted_and_does_no_harm() -> anyhow::Result<()> {
    const BACK: &str = "fleet/commands";
    let system = RobotAndCloud::start(&shared_redis()?, &shared_kafka()?)?;
    system.route(TOPIC, &json!({}))?;
    system.tell_robot(&json!({"op":"request","topic":BACK,"service":"driver","ttl_s":0}))?;
    system.tell_cloud(&json!({"op":"advertise","topic":BACK,"service":"planner","ttl_s":0}))?;
    let (robot, cloud) = (&system.robot, &system.cloud);
    for flow in [robot, cloud] {
        flow.wait_bridge(BACK, SOON)?;
    }
    let reader = KafkaReader::from_end(&system.kafka, &system.topic(TOPIC))?;
    let writer = KafkaWriter::new(&system.kafka)?;
    flowing(&system, &reader)?;
    let memory = [robot.rss_kib()?, cloud.rss_kib()?];
    frames(robot, &system)?;
    flowing(&system, &reader)?;
    large_payloads(robot, &system)?;
    flowing(&system, &reader)?;
    control_messages(robot, &system, &writer)?;
    flowing(&system, &reader)?;
    headers(&system, BACK, &writer)?;
    flowing(&system, &reader)?;
    for (flow, memory) in [robot, cloud].into_iter().zip(memory) {
        let now = flow.rss_kib()?;
        let node = &flow.spec.node;
        assert!(now <= memory + MAX_GROWTH_KIB, "{node}: {memory} → {now} KiB");
    }
    Ok(())
}
