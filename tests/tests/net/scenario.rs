//! Scenarios: real flows, real brokers, a link like that to a cloud.

use std::time::Duration;

use blaze_tests::long;
use blaze_tests::network::Plan;
use blaze_tests::scenario::parts::{IMU, broker, flow, service, stream};
use blaze_tests::scenario::{BrokerKind, Expect, Fault, Scenario, run};
use blaze_tests::wan::{Change, Shape, Ways};

use super::layers::COMMANDS;

/// A robot with Redis behind the router of its edge, a cloud with Kafka, and the link of the
/// paper's testbed between them. It is cut for less than the time after which a flow counts as
/// down, gets slow and loses much for a while, and is good again.
fn robot_and_cloud() -> Scenario {
    let at = Duration::from_millis;
    let (router, cloud) = ("router", "cloud-1");
    let bad = vec![Change::Delay(at(80)), Change::Loss(0.02), Change::Rate(Some(5_000_000))];
    let good = Shape::to_cloud().changes();
    Scenario {
        name: "25 ± 5 ms, 0.01 % loss, 160 Mbit/s; cut for 1.2 s one way and both, slow and lossy \
            for 2 s",
        network: Plan::new()
            .with_hosts(&["robot-1", router, cloud])
            .with_lan(&["robot-1", router])
            .with_link(router, cloud, Shape::to_cloud()),
        brokers: vec![
            broker("redis", "robot-1", BrokerKind::Redis),
            broker("kafka", cloud, BrokerKind::Kafka),
        ],
        flows: vec![
            flow("edge", "robot-1", "redis", None, &["cloud-1"]),
            flow("cloud", cloud, "kafka", None, &[]),
        ],
        publishers: vec![
            service("imu-driver", "robot-1", "redis", vec![stream(IMU, 50.0, 320)]),
            service("planner", cloud, "kafka", vec![stream(COMMANDS, 10.0, 100)]),
        ],
        consumers: vec![
            service("recorder", cloud, "kafka", vec![stream(IMU, 50.0, 320)]),
            service("driver", "robot-1", "redis", vec![stream(COMMANDS, 10.0, 100)]),
        ],
        faults: vec![
            (at(1_000), Fault::Cut(router, cloud, Ways::Forward)),
            (at(2_200), Fault::Heal(router, cloud, Ways::Forward)),
            (at(4_000), Fault::Cut(router, cloud, Ways::Both)),
            (at(5_200), Fault::Heal(router, cloud, Ways::Both)),
            (at(7_000), Fault::Set(router, cloud, Ways::Both, bad)),
            (at(9_000), Fault::Set(router, cloud, Ways::Both, good)),
        ],
        duration: Duration::from_secs(if long() { 60 } else { 11 }),
        settle: Duration::from_secs(10),
        expect: vec![Expect::Whole("recorder", IMU), Expect::Whole("driver", COMMANDS)],
    }
}

#[test]
fn reliable_streams_arrive_whole_over_a_link_that_is_bad_for_a_while() -> anyhow::Result<()> {
    let scenario = robot_and_cloud();
    let report = run(&scenario)?;
    println!("{report}");
    report.check(&scenario.expect)?;
    // Everything went over the link.
    let link = &scenario.network.links[0];
    let least = (link.forward.delay - link.forward.jitter).as_secs_f64() * 1e3;
    for route in &report.routes {
        let fastest = route.latency_ms(0.0).unwrap_or_default();
        anyhow::ensure!(fastest >= least, "{fastest} ms is less than the link takes:\n{report}");
    }
    Ok(())
}
