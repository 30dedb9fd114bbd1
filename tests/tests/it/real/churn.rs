//! Requests come and go, again and again, at the other end of a link: bridges come and go with
//! them, and nothing grows.

use std::time::Duration;

use blaze_tests::flow::FlowProcess;
use blaze_tests::long;
use blaze_tests::plain::{self, KafkaWriter};
use blaze_tests::process::Usage;
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer, shared_kafka};
use blaze_tests::wait;
use serde_json::json;

use crate::real::support::{RobotAndCloud, SOON};

/// They take turns, so that some are in use while others come and go.
const TOPICS: usize = 5;
/// The share of the cycles after which everything that is made once has been made.
const WARM: usize = 5;
/// What the allocator of the system may hold on to.
const MOST: Usage = Usage { resident_kib: 6 * 1024, threads: 1, descriptors: 3 };

fn topic(cycle: usize) -> String {
    format!("churn/t{}", cycle % TOPICS)
}

fn bridged(flow: &FlowProcess, topic: &str) -> bool {
    let start = format!("{topic}|");
    flow.bridges_up().iter().any(|id| id.starts_with(&start))
}

fn usage(system: &RobotAndCloud) -> anyhow::Result<[Usage; 2]> {
    Ok([system.robot.usage()?, system.cloud.usage()?])
}

#[test]
fn requests_that_come_and_go_leave_nothing_behind() -> anyhow::Result<()> {
    let redis = RedisServer::start(RedisKind::Redis, RedisOptions::default())?;
    let system = RobotAndCloud::start(&redis.url(), &shared_kafka()?)?;
    for number in 0..TOPICS {
        system.tell_robot(
            &json!({"op":"advertise","topic":topic(number),"service":"source","rate_hz":10,"max_bytes":100,
            "reliability":"reliable","ttl_s":0}),
        )?;
    }
    let kafka = KafkaWriter::new(&system.kafka)?;
    let tell = |op: &str, cycle: usize| {
        let message = json!({
            "op":op,
            "topic":topic(cycle),
            "service":"sink",
            "reliability":"reliable",
            "ttl_s":0,
        });
        plain::tell_kafka(&kafka, &system.kafka_prefix, &message)
    };
    let on_both = |what: &str, expected: bool, cycle: usize| {
        let (name, flows) = (topic(cycle), [&system.robot, &system.cloud]);
        wait::until(
            what,
            SOON,
            || flows.iter().all(|flow| bridged(flow, &name) == expected),
            || format!("cycle {cycle}: {:?}", flows.map(FlowProcess::bridges_up)),
        )
    };
    let cycles = if long() { 2_000 } else { 30 };
    let channels = || redis.cli(&["PUBSUB", "CHANNELS"]).map(|list| list.lines().count());
    let idle = channels()?;
    let (mut warm, mut came) = (usage(&system)?, 0);
    for cycle in 0..cycles {
        if cycle == cycles / WARM {
            warm = usage(&system)?;
        }
        let name = topic(cycle);
        tell("request", cycle)?;
        on_both("the request is served", true, cycle)?;
        if cycle % 10 == 0 {
            // What is bridged carries.
            let sent = format!("{cycle}");
            system.publish(&name, sent.as_bytes())?;
            wait::until(
                "a message arrives",
                SOON,
                || system.cloud.delivered() > came,
                || system.cloud.tail(),
            )?;
            came = system.cloud.delivered();
        }
        tell("withdraw", cycle)?;
        on_both("the bridge has gone", false, cycle)?;
    }
    wait::until(
        "the robot's subscriptions have gone",
        SOON,
        || channels().is_ok_and(|now| now == idle),
        || format!("{idle} before, {:?}", channels()),
    )?;
    // Nothing to wait for: memory is given back in its own time.
    std::thread::sleep(Duration::from_secs(1));
    let last = usage(&system)?;
    for (flow, (warm, last)) in [&system.robot, &system.cloud].iter().zip(warm.iter().zip(&last)) {
        println!("{cycles} cycles: {} holds {last}; after a fifth of them {warm}", flow.spec.node);
        anyhow::ensure!(
            last.exceeds_by_at_most(warm, &MOST),
            "{} grew from {warm} to {last}",
            flow.spec.node
        );
    }
    Ok(())
}
