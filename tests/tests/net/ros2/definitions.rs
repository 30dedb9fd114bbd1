//! Types whose definitions are with their talker alone: JSON in the cloud without any setting.

use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_tests::flow::{FlowProcess, FlowSpec};
use blaze_tests::network::{Host, Plan, Topology, inside};
use blaze_tests::plain::{self, RedisReader};
use blaze_tests::ros2::{Peer, Quality, Release, open_loopback};
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer};
use blaze_tests::wan::Shape;
use serde_json::{Value, json};

use super::support::{ARRIVE, DOMAIN, NODE};

const LINK_DOMAIN: u16 = 50;
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

/// A robot with ROS 2, and a cloud with Redis alone.
struct Stage {
    robot: FlowProcess,
    cloud: FlowProcess,
    redis: RedisServer,
    network: Topology,
}

impl Stage {
    fn start() -> anyhow::Result<Self> {
        let network = Topology::build(&Plan::two_hosts("robot", "cloud", Shape::to_cloud()))?;
        let (robot, cloud) = (network.host("robot")?, network.host("cloud")?);
        open_loopback(robot)?;
        let host = Some(cloud.clone());
        let redis =
            RedisServer::start(RedisKind::Redis, RedisOptions { host, ..RedisOptions::default() })?;
        let on_robot = FlowSpec::new("edge", "robot-1").on_ros2(DOMAIN).joined(LINK_DOMAIN);
        let in_cloud = FlowSpec::new("cloud", "cloud-1").on_redis(&redis.url(), "");
        let mut robot = FlowProcess::launch(on_robot.inside(robot, &[cloud.address]))?;
        let mut cloud = FlowProcess::launch(in_cloud.joined(LINK_DOMAIN).inside(cloud, &[]))?;
        robot.wait_ready()?;
        cloud.wait_ready()?;
        Ok(Self { robot, cloud, redis, network })
    }

    fn peer(&self, release: Release) -> anyhow::Result<Peer> {
        let peer = Peer::start(release, self.network.host("robot")?, DOMAIN)?;
        peer.node(NODE)?;
        Ok(peer)
    }

    fn in_cloud<T: Send>(
        &self,
        act: impl FnOnce(&str) -> anyhow::Result<T> + Send,
    ) -> anyhow::Result<T> {
        let host: &Host = self.network.host("cloud")?;
        inside(&host.namespace, || act(&self.redis.url()))
    }

    /// A Redis client of the cloud asks for a topic as JSON.
    fn read_json(&self, topic: &str) -> anyhow::Result<RedisReader> {
        let request = json!({
            "op": "request", "topic": topic, "service": "web", "ttl_s": 0, "json": true,
            "reliability": "reliable",
        });
        self.in_cloud(|url| {
            let reader = RedisReader::new(url, &format!("blaze/json/{topic}"))?;
            plain::tell_redis(url, "", &request)?;
            Ok(reader)
        })
    }

    fn state(&self, topic: &str) -> String {
        let of = |flow: &FlowProcess| format!("{:?}\n{}", flow.why(topic, None), flow.tail());
        format!("{}\n{}", of(&self.robot), of(&self.cloud))
    }
}

/// The source of a definition, as a flow says.
fn source(flow: &FlowProcess, kind: &str) -> anyhow::Result<Value> {
    Ok(flow.admin().json(&format!("/v1/ros2/types?type={kind}"))?["source"].clone())
}

#[test]
fn what_only_the_talker_knows_is_json_in_the_cloud() -> anyhow::Result<()> {
    let stage = Stage::start()?;
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
        let talker = stage.peer(release)?;
        let publisher = talker.publisher(NODE, topic, kind, Quality::default())?;
        let mut copies = stage.read_json(topic)?;
        let began = Instant::now();
        let copy = loop {
            publisher.send(&cdr)?;
            if let Some(copy) = copies.next(PAUSE)? {
                break copy;
            }
            anyhow::ensure!(began.elapsed() < ARRIVE, "{topic}: {}", stage.state(topic));
        };
        println!("{release:?}: the first {kind} after {:?}", began.elapsed());
        assert_eq!(serde_json::from_slice::<Value>(&copy)?, expected, "{topic}");
        assert_eq!(source(&stage.robot, kind)?, "node");
        assert_eq!(source(&stage.cloud, kind)?, "flow");
        let network = stage.robot.admin().json("/v1/ros2")?;
        let types = network["types"].as_array().context("no types")?;
        let row = types.iter().find(|row| row["type"] == kind);
        assert_eq!(row.context("not among the types")?["source"], "node");
        talker.finish()?;
    }
    Ok(())
}
