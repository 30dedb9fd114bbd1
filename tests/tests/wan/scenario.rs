//! Scenarios: real flows, real brokers, a link like that to a cloud.

use std::time::Duration;

use blaze_tests::long;
use blaze_tests::network::Plan;
use blaze_tests::scenario::{Broker, BrokerKind, Expect, Flow, Scenario, Service, Stream, run};
use blaze_tests::wan::Shape;

use super::support::turn;

const IMU: &str = "imu/data";
const COMMANDS: &str = "fleet/commands";

/// A robot with Redis behind the router of its edge, a cloud with Kafka, and the link of the paper's testbed between them.
fn robot_and_cloud() -> Scenario {
    let stream = |topic, hz, bytes| Stream {
        topic,
        reliable: true,
        hz,
        bytes,
        lifespan: Duration::ZERO,
    };
    let service = |name, flow, broker, stream| Service {
        name,
        flow,
        broker,
        streams: vec![stream],
    };
    Scenario {
        name: "robot to cloud over 25 ± 5 ms, 0.01 % loss, 160 Mbit/s",
        network: Plan::new()
            .with_hosts(&["robot-1", "router", "cloud-1"])
            .with_lan(&["robot-1", "router"])
            .with_link("router", "cloud-1", Shape::to_cloud()),
        brokers: vec![
            Broker {
                name: "redis",
                host: "robot-1",
                kind: BrokerKind::Redis,
            },
            Broker {
                name: "kafka",
                host: "cloud-1",
                kind: BrokerKind::Kafka,
            },
        ],
        flows: vec![
            Flow {
                layer: "edge",
                kind: "",
                node: "robot-1",
                host: "robot-1",
                brokers: vec!["redis"],
                peers: vec!["cloud-1"],
                limit_mbps: 100.0,
                extra: "",
            },
            Flow {
                layer: "cloud",
                kind: "",
                node: "cloud-1",
                host: "cloud-1",
                brokers: vec!["kafka"],
                peers: vec![],
                limit_mbps: 100.0,
                extra: "",
            },
        ],
        publishers: vec![
            service("imu-driver", "robot-1", "redis", stream(IMU, 50.0, 320)),
            service("planner", "cloud-1", "kafka", stream(COMMANDS, 10.0, 100)),
        ],
        consumers: vec![
            service("recorder", "cloud-1", "kafka", stream(IMU, 50.0, 320)),
            service("driver", "robot-1", "redis", stream(COMMANDS, 10.0, 100)),
        ],
        faults: vec![],
        duration: Duration::from_secs(if long() { 600 } else { 20 }),
        settle: Duration::from_secs(10),
        expect: vec![
            Expect::Whole("recorder", IMU),
            Expect::Received("recorder", IMU, if long() { 29_000 } else { 950 }),
            Expect::P99("recorder", IMU, Duration::from_millis(250)),
            Expect::Whole("driver", COMMANDS),
        ],
    }
}

#[test]
fn a_reliable_stream_arrives_whole_over_a_link_to_a_cloud() -> anyhow::Result<()> {
    let _turn = turn();
    let scenario = robot_and_cloud();
    let report = run(&scenario)?;
    println!("{report}");
    report.check(&scenario.expect)
}
