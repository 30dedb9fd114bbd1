//! Scenarios: real flows, real brokers, a link like that to a cloud.

use std::time::Duration;

use blaze_tests::long;
use blaze_tests::network::Plan;
use blaze_tests::scenario::{BrokerKind, Expect, Fault, Scenario, run};
use blaze_tests::wan::{Change, Shape, Ways};

use super::layers::{COMMANDS, IMU, broker, flow, service, stream};

/// A robot with Redis behind the router of its edge, a cloud with Kafka, and the link of the paper's testbed between them.
fn robot_and_cloud() -> Scenario {
    Scenario {
        name: "robot to cloud over 25 ± 5 ms, 0.01 % loss, 160 Mbit/s",
        network: Plan::new()
            .with_hosts(&["robot-1", "router", "cloud-1"])
            .with_lan(&["robot-1", "router"])
            .with_link("router", "cloud-1", Shape::to_cloud()),
        brokers: vec![
            broker("redis", "robot-1", BrokerKind::Redis),
            broker("kafka", "cloud-1", BrokerKind::Kafka),
        ],
        flows: vec![
            flow("edge", "robot-1", "redis", None, &["cloud-1"]),
            flow("cloud", "cloud-1", "kafka", None, &[]),
        ],
        publishers: vec![
            service("imu-driver", "robot-1", "redis", vec![stream(IMU, 50.0, 320)]),
            service("planner", "cloud-1", "kafka", vec![stream(COMMANDS, 10.0, 100)]),
        ],
        consumers: vec![
            service("recorder", "cloud-1", "kafka", vec![stream(IMU, 50.0, 320)]),
            service("driver", "robot-1", "redis", vec![stream(COMMANDS, 10.0, 100)]),
        ],
        faults: vec![],
        duration: Duration::from_secs(if long() { 60 } else { 8 }),
        settle: Duration::from_secs(10),
        expect: vec![
            Expect::Whole("recorder", IMU),
            Expect::Received("recorder", IMU, if long() { 2_900 } else { 380 }),
            Expect::Whole("driver", COMMANDS),
        ],
    }
}

/// Plays it, prints the table, and checks what is expected of it and that everything went over the link.
fn play(scenario: &Scenario) -> anyhow::Result<()> {
    let report = run(scenario)?;
    println!("{report}");
    report.check(&scenario.expect)?;
    let link = &scenario.network.links[0];
    let least = (link.forward.delay - link.forward.jitter).as_secs_f64() * 1e3;
    for route in &report.routes {
        let fastest = route.latency_ms(0.0).unwrap_or_default();
        anyhow::ensure!(fastest >= least, "{fastest} ms is less than the link takes:\n{report}");
    }
    Ok(())
}

#[test]
fn a_reliable_stream_arrives_whole_over_a_link_to_a_cloud() -> anyhow::Result<()> {
    play(&robot_and_cloud())
}

/// A link that is cut for less than the time after which a flow counts as down holds messages up and loses none, and neither
/// does one that gets slow and loses much for a while.
#[test]
fn a_reliable_stream_arrives_whole_over_a_link_that_is_bad_for_a_while() -> anyhow::Result<()> {
    let at = Duration::from_millis;
    let (robot, cloud) = ("router", "cloud-1");
    let bad = vec![Change::Delay(at(80)), Change::Loss(0.02), Change::Rate(Some(5_000_000))];
    play(&Scenario {
        name: "the same link, cut for 1.2 s one way and both, slow and lossy for 3 s",
        faults: vec![
            (at(2_000), Fault::Cut(robot, cloud, Ways::Forward)),
            (at(3_200), Fault::Heal(robot, cloud, Ways::Forward)),
            (at(6_000), Fault::Cut(robot, cloud, Ways::Both)),
            (at(7_200), Fault::Heal(robot, cloud, Ways::Both)),
            (at(10_000), Fault::Set(robot, cloud, Ways::Both, bad)),
            (
                at(13_000),
                Fault::Set(robot, cloud, Ways::Both, Shape::to_cloud().changes()),
            ),
        ],
        duration: Duration::from_secs(16),
        expect: vec![Expect::Whole("recorder", IMU), Expect::Whole("driver", COMMANDS)],
        ..robot_and_cloud()
    })
}

/// A flow that is killed and comes back, and brokers that stop or start anew, cost messages, but none comes twice or late.
#[test]
fn a_flow_and_its_brokers_come_back() -> anyhow::Result<()> {
    let at = Duration::from_secs;
    play(&Scenario {
        name: "the same link; the cloud's flow is killed, Redis starts anew, Kafka stands still",
        faults: vec![
            (at(2), Fault::KillFlow("cloud-1")),
            (at(3), Fault::StartFlow("cloud-1")),
            (at(14), Fault::RestartBroker("redis")),
            (at(20), Fault::FreezeBroker("kafka")),
            (at(21), Fault::ThawBroker("kafka")),
        ],
        duration: Duration::from_secs(30),
        expect: vec![
            Expect::LostAtMost("recorder", IMU, 0.6),
            Expect::LostAtMost("driver", COMMANDS, 0.6),
        ],
        ..robot_and_cloud()
    })
}
