//! Parts that many scenarios are made of.

use std::time::Duration;

use super::{Broker, BrokerKind, Flow, Scenario, Service, Stream};
use crate::network::Plan;
use crate::wan::Shape;

/// What an inertial measurement unit publishes.
pub const IMU: &str = "imu/data";
/// Odometry of a Jackal.
pub const ODOMETRY: &str = "jackal_velocity_controller/odom";
/// Its camera.
pub const CAMERA: &str = "camera/image_raw";

/// A reliable topic without a lifespan; its payloads are noise.
#[must_use]
pub fn stream(topic: &'static str, hz: f64, bytes: usize) -> Stream {
    Stream { topic, reliable: true, hz, bytes, lifespan: Duration::ZERO, payloads: None }
}

/// A flow on the host of its own name, with a limit of 100 Mbit/s.
#[must_use]
pub fn flow(
    layer: &'static str,
    node: &'static str,
    broker: &'static str,
    layer_domain: Option<u16>,
    peers: &[&'static str],
) -> Flow {
    Flow {
        layer,
        node,
        host: node,
        brokers: vec![broker],
        layer_domain,
        peers: peers.to_vec(),
        limit_mbps: 100.0,
        bandwidth: "",
        keys: "",
    }
}

/// A service at a flow's node.
#[must_use]
pub fn service(
    name: &'static str,
    flow: &'static str,
    broker: &'static str,
    streams: Vec<Stream>,
) -> Service {
    Service { name, flow, broker, streams }
}

/// A server.
#[must_use]
pub fn broker(name: &'static str, host: &'static str, kind: BrokerKind) -> Broker {
    Broker { name, host, kind }
}

/// A robot with a Redis, a cloud with some broker, one link between them, and streams from the one
/// to the other; without faults or an end.
#[must_use]
pub fn one_link(
    shape: Shape,
    cloud: BrokerKind,
    limit_mbps: f64,
    streams: Vec<Stream>,
) -> Scenario {
    let flow = |layer, node, broker, peers: &[&'static str]| Flow {
        limit_mbps,
        ..flow(layer, node, broker, None, peers)
    };
    Scenario {
        name: "a robot and a cloud",
        network: Plan::two_hosts("robot-1", "cloud-1", shape),
        brokers: vec![
            broker("redis", "robot-1", BrokerKind::Redis),
            broker("cloud-broker", "cloud-1", cloud),
        ],
        flows: vec![
            flow("edge", "robot-1", "redis", &["cloud-1"]),
            flow("cloud", "cloud-1", "cloud-broker", &[]),
        ],
        publishers: vec![service("driver", "robot-1", "redis", streams.clone())],
        consumers: vec![service("recorder", "cloud-1", "cloud-broker", streams)],
        faults: vec![],
        duration: Duration::ZERO,
        settle: Duration::ZERO,
        expect: vec![],
    }
}
