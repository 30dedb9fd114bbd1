//! Types whose definitions are with their talker alone: JSON in the cloud without any setting.

use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_tests::flow::FlowProcess;
use blaze_tests::plain::{RedisReader, tell_redis};
use blaze_tests::ros2::{Quality, Release};
use blaze_tests::servers::RedisServer;
use serde_json::{Value, json};

use super::support::{ARRIVE, DOMAIN, NODE, Pair, redis};

const PAUSE: Duration = Duration::from_millis(200);

/// A `test_msgs/msg/BasicTypes`, and the same in a `Nested`: it has no other field.
fn basic_types() -> (Vec<u8>, Value) {
    let mut cdr = vec![0, 1, 0, 0];
    cdr.extend([1, 2, 3, 0]);
    cdr.extend(0.5_f32.to_le_bytes());
    cdr.extend(0.1_f64.to_le_bytes());
    cdr.extend([0xff, 9]);
    cdr.extend((-300_i16).to_le_bytes());
    cdr.extend(60_000_u16.to_le_bytes());
    cdr.extend([0, 0]);
    cdr.extend((-70_000_i32).to_le_bytes());
    cdr.extend(4_000_000_000_u32.to_le_bytes());
    cdr.extend(i64::MIN.to_le_bytes());
    cdr.extend(u64::MAX.to_le_bytes());
    let json = json!({
        "bool_value": true, "byte_value": 2, "char_value": 3, "float32_value": 0.5,
        "float64_value": 0.1, "int8_value": -1, "uint8_value": 9, "int16_value": -300,
        "uint16_value": 60_000, "int32_value": -70_000, "uint32_value": 4_000_000_000_u32,
        "int64_value": i64::MIN, "uint64_value": u64::MAX,
    });
    (cdr, json)
}

/// A Redis client of the cloud asks for a topic as JSON.
fn read_json(pair: &Pair<RedisServer>, topic: &str) -> anyhow::Result<RedisReader> {
    let request = json!({
        "op": "request", "topic": topic, "service": "web", "ttl_s": 0, "json": true,
        "reliability": "reliable",
    });
    let url = pair.brokers.url();
    pair.inside("cloud", || {
        let reader = RedisReader::new(&url, &format!("blaze/json/{topic}"))?;
        tell_redis(&url, "", &request)?;
        Ok(reader)
    })
}

/// The source of a definition, as a flow says.
fn source(flow: &FlowProcess, kind: &str) -> anyhow::Result<Value> {
    Ok(flow.admin().json(&format!("/v1/ros2/types?type={kind}"))?["source"].clone())
}

#[test]
fn what_only_the_talker_knows_is_json_in_the_cloud() -> anyhow::Result<()> {
    // A robot with ROS 2, and a cloud with Redis alone.
    let pair = Pair::on(
        |_, cloud| redis(cloud),
        |redis, edge, cloud| [edge.on_ros2(DOMAIN), cloud.on_redis(&redis.url(), "")],
    )?;
    let (cdr, json) = basic_types();
    for (release, topic, kind, expected) in [
        (
            Release::Jazzy,
            "jazzy",
            "test_msgs/msg/Nested",
            json!({ "basic_types_value": json.clone() }),
        ),
        (Release::Kilted, "kilted", "test_msgs/msg/BasicTypes", json),
    ] {
        let talker = pair.on_robot(release)?;
        let publisher = talker.publisher(NODE, topic, kind, Quality::default())?;
        let mut copies = read_json(&pair, topic)?;
        let began = Instant::now();
        let copy = loop {
            publisher.send(&cdr)?;
            if let Some(copy) = copies.next(PAUSE)? {
                break copy;
            }
            anyhow::ensure!(began.elapsed() < ARRIVE, "{topic}: {}", pair.state(topic));
        };
        println!("{release:?}: the first {kind} after {:?}", began.elapsed());
        assert_eq!(serde_json::from_slice::<Value>(&copy)?, expected, "{topic}");
        assert_eq!(source(&pair.edge, kind)?, "node");
        assert_eq!(source(&pair.cloud, kind)?, "flow");
        let network = pair.edge.admin().json("/v1/ros2")?;
        let types = network["types"].as_array().context("no types")?;
        let row = types.iter().find(|row| row["type"] == kind);
        assert_eq!(row.context("not among the types")?["source"], "node");
        talker.finish()?;
    }
    Ok(())
}
