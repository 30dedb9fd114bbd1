//! The whole system: two robots, a fog with two flows over one Kafka, a cloud with another, and
//! links between the layers like those of a robot laboratory.

use std::time::Duration;

use blaze_tests::long;
use blaze_tests::network::Plan;
use blaze_tests::scenario::parts::{CAMERA, IMU, ODOMETRY, broker, flow, service, stream};
use blaze_tests::scenario::{BrokerKind, Expect, Scenario, Stream, run};
use blaze_tests::wan::Shape;

pub(super) const COMMANDS: &str = "fleet/commands";
pub(super) const MAP: &str = "fleet/map";
/// 640 × 480 RGB.
const IMAGE: usize = 921_600;
/// DDS domain of the robots' layer.
const EDGE_DOMAIN: u16 = 30;

/// The camera as it comes from the driver: best effort, and old pictures are worth nothing.
pub(super) fn camera(hz: f64) -> Stream {
    Stream { reliable: false, lifespan: Duration::from_secs(1), ..stream(CAMERA, hz, IMAGE) }
}

/// Robots with a Redis each meet over DDS in the edge; fog and cloud have a Kafka each, the fog two
/// flows over it.
pub(super) fn three_layers(image_hz: f64) -> Scenario {
    let shape = Shape::to_cloud();
    let (imu, odometry) = (stream(IMU, 50.0, 320), stream(ODOMETRY, 50.0, 700));
    let (commands, map) = (stream(COMMANDS, 10.0, 100), stream(MAP, 5.0, 4_000));
    Scenario {
        name: "two robots, two flows in the fog, one in the cloud; 25 ± 5 ms, 0.01 % loss, 160 \
            Mbit/s between layers",
        network: Plan::new()
            .with_hosts(&["robot-1", "robot-2", "edge", "fog-1", "fog-2", "fog", "cloud-1"])
            .with_lan(&["robot-1", "robot-2", "edge"])
            .with_unicast_lan(&["fog-1", "fog-2", "fog"])
            .with_link("edge", "fog", shape)
            .with_link("edge", "cloud-1", shape)
            .with_link("fog", "cloud-1", shape),
        brokers: vec![
            broker("redis-1", "robot-1", BrokerKind::Redis),
            broker("redis-2", "robot-2", BrokerKind::Redis),
            broker("kafka-fog", "fog", BrokerKind::Kafka),
            broker("kafka-cloud", "cloud-1", BrokerKind::Kafka),
        ],
        flows: vec![
            flow("edge", "robot-1", "redis-1", Some(EDGE_DOMAIN), &["cloud-1"]),
            flow("edge", "robot-2", "redis-2", Some(EDGE_DOMAIN), &["cloud-1"]),
            flow("fog", "fog-1", "kafka-fog", None, &["cloud-1"]),
            flow("fog", "fog-2", "kafka-fog", None, &["cloud-1"]),
            flow("cloud", "cloud-1", "kafka-cloud", None, &[]),
        ],
        publishers: vec![
            service("driver", "robot-1", "redis-1", vec![imu.clone(), odometry.clone()]),
            service("camera", "robot-1", "redis-1", vec![camera(image_hz)]),
            service("planner", "cloud-1", "kafka-cloud", vec![commands.clone()]),
            service("mapper", "fog-1", "kafka-fog", vec![map.clone()]),
        ],
        consumers: vec![
            service(
                "dashboard",
                "fog-1",
                "kafka-fog",
                vec![imu.clone(), odometry.clone(), commands.clone()],
            ),
            service("viewer", "fog-2", "kafka-fog", vec![camera(image_hz)]),
            service("recorder", "cloud-1", "kafka-cloud", vec![imu.clone(), odometry, map.clone()]),
            service("archive", "cloud-1", "kafka-cloud", vec![camera(image_hz)]),
            service("neighbour", "robot-2", "redis-2", vec![imu, commands.clone()]),
            service("pilot", "robot-1", "redis-1", vec![commands, map]),
        ],
        faults: vec![],
        duration: Duration::from_secs(if long() { 120 } else { 6 }),
        settle: Duration::from_secs(10),
        expect: whole(),
    }
}

/// Every reliable topic arrives at every consumer, each message once and in order.
fn whole() -> Vec<Expect> {
    RELIABLE.map(|(consumer, topic)| Expect::Whole(consumer, topic)).to_vec()
}

/// Who gets which reliable topic.
pub(super) const RELIABLE: [(&str, &str); 10] = [
    ("dashboard", IMU),
    ("dashboard", ODOMETRY),
    ("dashboard", COMMANDS),
    ("recorder", IMU),
    ("recorder", ODOMETRY),
    ("recorder", MAP),
    ("neighbour", IMU),
    ("neighbour", COMMANDS),
    ("pilot", COMMANDS),
    ("pilot", MAP),
];

/// With the camera raw, which is more than twice what the link may carry.
#[test]
fn three_layers_beside_a_raw_camera() -> anyhow::Result<()> {
    let mut scenario = three_layers(30.0);
    scenario.expect.extend([
        Expect::Balanced,
        // What the limit leaves for it, shared by two destinations.
        Expect::Received("viewer", CAMERA, 1),
        Expect::Received("archive", CAMERA, 1),
    ]);
    let report = run(&scenario)?;
    println!("{report}");
    report.check(&scenario.expect)
}
