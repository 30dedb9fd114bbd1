//! What the contract says of topics on servers that others use as well: nothing happens in silence.

use std::time::Duration;

use blaze_tests::plain::{KafkaReader, KafkaWriter, delete_topic, make_topic};
use blaze_tests::servers::{shared_kafka, shared_redis};
use blaze_tests::wait;
use serde_json::json;

use crate::real::support::{RedisReader, RobotAndCloud, SOON, connect};

const TOPIC: &str = "imu/data";

/// A topic that somebody else made takes small batches only: messages are refused for their own
/// size, never for their company.
#[test]
fn a_burst_into_a_topic_with_small_batches_is_whole() -> anyhow::Result<()> {
    const SMALL: u64 = 1_000;
    let system = RobotAndCloud::start(&shared_redis()?, &shared_kafka()?)?;
    make_topic(&system.kafka, &system.topic(TOPIC), &[("max.message.bytes", "10000")])?;
    let records = KafkaReader::from_end(&system.kafka, &system.topic(TOPIC))?;
    system.route(TOPIC, &json!({"reliability":"reliable"}))?;
    let mut connection = connect(&system.redis)?;
    let mut burst = redis::pipe();
    for number in 0..SMALL {
        if number == SMALL / 2 {
            burst.cmd("PUBLISH").arg(system.channel(TOPIC)).arg(vec![b'x'; 20_000]);
        }
        burst.cmd("PUBLISH").arg(system.channel(TOPIC)).arg(format!("{number:0100}"));
    }
    let heard: Vec<i64> = burst.query(&mut connection)?;
    assert!(heard.iter().all(|heard| *heard == 1));
    let mut arrived = Vec::new();
    while arrived.len() < SMALL as usize {
        let record = records.next(SOON);
        let record = record.ok_or_else(|| {
            let (robot, cloud) = (system.robot.bridges(), system.cloud.bridges());
            let tails = format!("{}\n{}", system.robot.tail(), system.cloud.tail());
            anyhow::anyhow!("{} came\n{robot:?}\n{cloud:?}\n{tails}", arrived.len())
        })?;
        arrived.push(record.text().parse::<u64>()?);
    }
    assert_eq!(arrived, (0..SMALL).collect::<Vec<_>>());
    wait::until(
        "the large one is counted",
        SOON,
        || system.cloud.bridges().iter().any(|bridge| bridge["dropped"]["too_large"] == 1),
        || format!("{:?}", system.cloud.bridges()),
    )?;
    Ok(())
}

/// The flow makes them again, its routes go on, and what a plain producer writes there is no
/// repeat, though its offsets begin at 0 again.
#[test]
fn deleted_kafka_topics_are_made_again_and_their_routes_go_on() -> anyhow::Result<()> {
    const COMMANDS: &str = "fleet/commands";
    const TURN: Duration = Duration::from_millis(50);
    /// More records than the second topic gets: none has an offset that the first had not.
    const BEFORE: usize = 2_000;
    let system = RobotAndCloud::start(&shared_redis()?, &shared_kafka()?)?;
    system.route(TOPIC, &json!({}))?;
    system.tell_cloud(&json!({"op":"advertise","topic":COMMANDS,"service":"planner","ttl_s":0}))?;
    system.tell_robot(
        &json!({"op":"request","topic":COMMANDS,"service":"driver","bare":true,"ttl_s":0}),
    )?;
    for flow in [&system.cloud, &system.robot] {
        flow.wait_bridge(COMMANDS, SOON)?;
    }
    let mut commands =
        RedisReader::new(&system.redis, &system.channel(&format!("blaze/bare/{COMMANDS}")))?;
    let writer = KafkaWriter::new(&system.kafka)?;
    for _ in 0..BEFORE {
        writer.produce_later(&system.topic(COMMANDS), b"before")?;
    }
    let tails = || format!("{}\n{}", system.cloud.tail(), system.robot.tail());
    for life in ["first", "second"] {
        if life == "second" {
            for topic in [TOPIC, COMMANDS] {
                delete_topic(&system.kafka, &system.topic(topic))?;
            }
        }
        let mut command = || {
            // While there is no topic, nothing is acknowledged.
            let _ = writer.produce(&system.topic(COMMANDS), life.as_bytes());
            while let Ok(Some(payload)) = commands.next(TURN) {
                if payload == life.as_bytes() {
                    return true;
                }
            }
            false
        };
        wait::until(&format!("commands of the {life} topic arrive"), SOON, &mut command, tails)?;
        let records = KafkaReader::from_end(&system.kafka, &system.topic(TOPIC))?;
        let mut message = || {
            let _ = system.publish(TOPIC, life.as_bytes());
            records.next(TURN).is_some()
        };
        wait::until(&format!("messages reach the {life} topic"), SOON, &mut message, tails)?;
    }
    Ok(())
}

/// Somebody else's topic has the name that this one would have.
#[test]
fn a_foreign_topic_that_collides_blocks_and_is_named() -> anyhow::Result<()> {
    let system = RobotAndCloud::start(&shared_redis()?, &shared_kafka()?)?;
    make_topic(&system.kafka, &system.topic("ext_y"), &[])?;
    let replies = KafkaReader::from_end(&system.kafka, &system.topic("blaze/reply"))?;
    system.tell_robot(&json!({"op":"advertise","topic":"ext/y","service":"a","ttl_s":0}))?;
    let request = json!({
        "op":"request",
        "topic":"ext/y",
        "service":"b",
        "id":"1",
        "reply_to":"blaze/reply/x",
        "ttl_s":0,
    });
    wait::until(
        "it is refused, and why says so",
        SOON,
        || {
            let _ = system.tell_cloud(&request);
            let answer = replies.next(SOON).map(|record| record.text()).unwrap_or_default();
            let why = system.cloud.why("ext/y", None);
            answer.contains("name_collision")
                && why.is_ok_and(|why| why["code"] == "name_collision")
        },
        || format!("{:?}", system.cloud.why("ext/y", None)),
    )?;
    Ok(())
}

#[test]
fn types_that_differ_are_told_and_agree_later() -> anyhow::Result<()> {
    const TOPIC: &str = "robot/pose";
    let system = RobotAndCloud::start(&shared_redis()?, &shared_kafka()?)?;
    let request = |name: &str| {
        system.tell_cloud(
            &json!({"op":"request","topic":TOPIC,"service":"sink","type":name,"ttl_s":0}),
        )
    };
    system.tell_robot(&json!({
        "op":"advertise",
        "topic":TOPIC,
        "service":"source",
        "type":"geometry_msgs/msg/Pose",
        "ttl_s":0,
    }))?;
    request("nav_msgs/msg/Odometry")?;
    for flow in [&system.robot, &system.cloud] {
        let why = || flow.why(TOPIC, Some("cloud")).unwrap_or_default();
        wait::until(
            "the mismatch is told",
            SOON,
            || why()["code"] == "type_mismatch" && why()["verdict"] == "not_flowing",
            || format!("{}: {}", flow.spec.node, why()),
        )?;
        let told = why().to_string();
        assert!(
            told.contains("geometry_msgs/msg/Pose") && told.contains("nav_msgs/msg/Odometry"),
            "{told}"
        );
    }
    request("geometry_msgs/msg/Pose")?;
    system.robot.wait_bridge(TOPIC, SOON)?;
    system.cloud.wait_bridge(TOPIC, SOON)
}
