//! What the contract says of shared, emptied and remade servers: nothing happens in silence.

use std::cell::RefCell;
use std::time::Duration;

use blaze_tests::flow::{FlowProcess, FlowSpec};
use blaze_tests::plain::{KafkaReader, KafkaWriter, delete_topic, make_topic};
use blaze_tests::servers::{
    KafkaOptions, KafkaServer, RedisKind, RedisOptions, RedisServer, shared_kafka, shared_redis, unique_name,
};
use blaze_tests::wait;
use serde_json::json;

use crate::real::support::{RedisReader, RobotAndCloud, SOON, connect};
use blaze_tests::stream::Stream;

const TOPIC: &str = "imu/data";

fn streaming(redis: &str, kafka: &str) -> anyhow::Result<(RobotAndCloud, Stream)> {
    let system = RobotAndCloud::start(redis, kafka)?;
    system.tell_robot(&json!({"op":"advertise","topic":TOPIC,"service":"imu-driver","ttl_s":0}))?;
    system.tell_cloud(&json!({"op":"request","topic":TOPIC,"service":"logger","ttl_s":0}))?;
    system.robot.wait_bridge(TOPIC, SOON)?;
    system.cloud.wait_bridge(TOPIC, SOON)?;
    let stream = Stream::start(redis, &system.channel(TOPIC), kafka, &system.topic(TOPIC), 300)?;
    stream.wait_fresh(SOON)?;
    Ok((system, stream))
}

fn readyz(flow: &FlowProcess) -> String {
    flow.admin().get("/readyz").map(|(_, body)| body).unwrap_or_default()
}

#[test]
fn a_deleted_kafka_topic_is_made_again() -> anyhow::Result<()> {
    let kafka = shared_kafka()?;
    let (system, stream) = streaming(&shared_redis()?, &kafka)?;
    drop(stream);
    delete_topic(&kafka, &system.topic(TOPIC))?;
    // The flow makes it again, and its own consumers and producers go on by themselves.
    let reader = KafkaReader::from_end(&kafka, &system.topic(TOPIC))?;
    let mut number = 0;
    wait::until(
        "messages reach the topic that was made anew",
        SOON,
        || {
            number += 1;
            let _ = system.publish(TOPIC, number.to_string().as_bytes());
            reader.next(Duration::from_millis(50)).is_some()
        },
        || system.cloud.tail(),
    )?;
    Ok(())
}

/// Records of a plain producer in a topic that was deleted and made anew begin at offset 0 again: they are new messages.
#[test]
fn bare_records_of_a_topic_made_anew_are_no_repeats() -> anyhow::Result<()> {
    const COMMANDS: &str = "fleet/commands";
    let (redis, kafka) = (shared_redis()?, shared_kafka()?);
    let system = RobotAndCloud::start(&redis, &kafka)?;
    system.tell_cloud(&json!({"op":"advertise","topic":COMMANDS,"service":"planner","ttl_s":0}))?;
    system.tell_robot(&json!({"op":"request","topic":COMMANDS,"service":"driver","bare":true,"ttl_s":0}))?;
    let mut reader = RedisReader::new(&redis, &system.channel("blaze/bare/fleet/commands"))?;
    system.cloud.wait_bridge(COMMANDS, SOON)?;
    system.robot.wait_bridge(COMMANDS, SOON)?;
    let topic = system.topic(COMMANDS);
    let writer = KafkaWriter::new(&kafka)?;
    for life in ["first", "second"] {
        if life == "second" {
            delete_topic(&kafka, &topic)?;
        }
        let (arrived, produced) = (RefCell::new(None), RefCell::new(None));
        wait::until(
            &format!("commands of the {life} topic arrive"),
            SOON,
            || {
                produced.replace(Some(writer.produce(&topic, life.as_bytes())));
                arrived.replace(Some(reader.next(Duration::from_millis(100))));
                matches!(&*arrived.borrow(), Some(Ok(Some(payload))) if payload == life.as_bytes())
            },
            || {
                format!(
                    "the last record: {:?}, read: {:?}\n{:?}\n{:?}\n{}\n{}",
                    produced.borrow(),
                    arrived.borrow(),
                    system.cloud.bridges(),
                    system.robot.bridges(),
                    system.cloud.tail(),
                    system.robot.tail()
                )
            },
        )?;
    }
    Ok(())
}

#[test]
fn a_flushed_redis_gets_its_leases_again() -> anyhow::Result<()> {
    let redis = RedisServer::start(RedisKind::Redis, RedisOptions::default())?;
    let (system, stream) = streaming(&redis.url(), &shared_kafka()?)?;
    let hash = system.channel("blaze:flow:leases");
    let owner = system.channel("blaze:flow:owner");
    assert_eq!(redis.cli(&["HLEN", &hash])?.trim(), "1");
    redis.cli(&["FLUSHALL"])?;
    wait::until(
        "owner and leases are written again",
        SOON,
        || {
            redis.cli(&["HLEN", &hash]).is_ok_and(|count| count.trim() == "1")
                && redis
                    .cli(&["GET", &owner])
                    .is_ok_and(|value| value.contains("edge/robot-1/"))
        },
        || system.robot.tail(),
    )?;
    stream.wait_fresh(SOON)?;
    let (twice, reordered) = stream.faults();
    assert_eq!((twice.len(), reordered), (0, 0));
    Ok(())
}

#[test]
fn two_nodes_on_one_redis_are_not_silent() -> anyhow::Result<()> {
    let redis = shared_redis()?;
    let prefix = format!("{}:", unique_name("shared"));
    let mut first = FlowProcess::start(FlowSpec::new("edge", "robot-1").on_redis(&redis, &prefix))?;
    let mut second = FlowProcess::launch(FlowSpec::new("edge", "robot-2").on_redis(&redis, &prefix))?;
    second.listening()?;
    wait::until(
        "the second node says whose scope it is",
        SOON,
        || readyz(&second).contains("scope_in_use") && readyz(&second).contains("edge/robot-1"),
        || readyz(&second),
    )?;
    assert!(!second.admin().ready());
    let why = second.why(TOPIC, None)?;
    assert_eq!(why["code"], "scope_in_use", "{why}");
    assert!(first.admin().ready());
    // The first one goes: the second takes over by itself.
    first.kill()?;
    second.wait_ready()?;
    Ok(())
}

#[test]
fn two_layers_on_one_kafka_are_not_silent() -> anyhow::Result<()> {
    let kafka = KafkaServer::start(KafkaOptions::default())?;
    kafka.wait_ready()?;
    let mut fog = FlowProcess::start(FlowSpec::new("fog", "fog-1").on_kafka(&kafka.bootstrap(), ""))?;
    let mut cloud = FlowProcess::launch(FlowSpec::new("cloud", "cloud-1").on_kafka(&kafka.bootstrap(), ""))?;
    cloud.listening()?;
    wait::until(
        "the second layer says whose scope it is",
        SOON,
        || readyz(&cloud).contains("scope_in_use") && readyz(&cloud).contains("fog/fog-1"),
        || readyz(&cloud),
    )?;
    let why = cloud.why(TOPIC, None)?;
    assert_eq!(why["code"], "scope_in_use", "{why}");
    assert!(fog.admin().ready(), "the first one goes on");
    fog.kill()?;
    wait::until("it takes over", SOON, || cloud.admin().ready(), || readyz(&cloud))?;
    // With a prefix of its own each layer has its scope.
    let other = FlowProcess::start(FlowSpec::new("fog", "fog-2").on_kafka(&kafka.bootstrap(), "fog."))?;
    assert!(other.admin().ready() && cloud.admin().ready());
    Ok(())
}

/// A topic that somebody else made takes small batches only: messages are refused for their own size, never for their company.
#[test]
fn a_burst_into_a_topic_with_small_batches_is_whole() -> anyhow::Result<()> {
    const SMALL: u64 = 1_000;
    let system = RobotAndCloud::start(&shared_redis()?, &shared_kafka()?)?;
    make_topic(&system.kafka, &system.topic(TOPIC), &[("max.message.bytes", "10000")])?;
    let records = KafkaReader::from_end(&system.kafka, &system.topic(TOPIC))?;
    system.tell_robot(
        &json!({"op":"advertise","topic":TOPIC,"service":"imu-driver","reliability":"reliable","ttl_s":0}),
    )?;
    system.tell_cloud(&json!({"op":"request","topic":TOPIC,"service":"logger","reliability":"reliable","ttl_s":0}))?;
    system.cloud.wait_bridge(TOPIC, SOON)?;
    system.robot.wait_bridge(TOPIC, SOON)?;
    let mut connection = connect(&system.redis)?;
    let mut burst = redis::pipe();
    for number in 0..SMALL {
        if number == SMALL / 2 {
            burst.cmd("PUBLISH").arg(system.channel(TOPIC)).arg(vec![b'x'; 20_000]);
        }
        burst
            .cmd("PUBLISH")
            .arg(system.channel(TOPIC))
            .arg(format!("{number:0100}"));
    }
    let heard: Vec<i64> = burst.query(&mut connection)?;
    assert!(heard.iter().all(|heard| *heard == 1));
    let mut arrived = Vec::new();
    while arrived.len() < SMALL as usize {
        let record = records.next(SOON);
        let record = record.ok_or_else(|| anyhow::anyhow!("{} came\n{:?}", arrived.len(), system.cloud.bridges()))?;
        arrived.push(record.text().parse::<u64>()?);
    }
    assert_eq!(arrived, (0..SMALL).collect::<Vec<_>>());
    wait::until(
        "the large one is counted",
        SOON,
        || {
            system
                .cloud
                .bridges()
                .iter()
                .any(|bridge| bridge["dropped"]["too_large"] == 1)
        },
        || format!("{:?}", system.cloud.bridges()),
    )?;
    Ok(())
}

/// What is refused before it reaches a bridge is named as well.
#[test]
fn why_names_what_is_too_large_for_any_bridge() -> anyhow::Result<()> {
    let system = RobotAndCloud::start(&shared_redis()?, &shared_kafka()?)?;
    system.tell_robot(&json!({"op":"advertise","topic":TOPIC,"service":"imu-driver","ttl_s":0}))?;
    system.tell_cloud(&json!({"op":"request","topic":TOPIC,"service":"logger","ttl_s":0}))?;
    system.robot.wait_bridge(TOPIC, SOON)?;
    let large = vec![b'x'; 16 * 1024 * 1024 + 1];
    wait::until(
        "why names it",
        SOON,
        || {
            let _ = system.publish(TOPIC, &large);
            let why = system.robot.why(TOPIC, None);
            why.is_ok_and(|why| why["code"] == "too_large" && why["verdict"] == "not_flowing")
        },
        || format!("{:?}", system.robot.why(TOPIC, None)),
    )?;
    Ok(())
}

/// Somebody else's topic has the name that this one would have.
#[test]
fn a_foreign_topic_that_collides_blocks_and_is_named() -> anyhow::Result<()> {
    let system = RobotAndCloud::start(&shared_redis()?, &shared_kafka()?)?;
    make_topic(&system.kafka, &system.topic("ext_y"), &[])?;
    let replies = KafkaReader::from_end(&system.kafka, &system.topic("blaze/reply"))?;
    system.tell_robot(&json!({"op":"advertise","topic":"ext/y","service":"a","ttl_s":0}))?;
    let request = json!({"op":"request","topic":"ext/y","service":"b","id":"1","reply_to":"blaze/reply/x","ttl_s":0});
    wait::until(
        "it is refused, and why says so",
        SOON,
        || {
            let _ = system.tell_cloud(&request);
            let answer = replies.next(SOON).map(|record| record.text()).unwrap_or_default();
            let why = system.cloud.why("ext/y", None);
            answer.contains("name_collision") && why.is_ok_and(|why| why["code"] == "name_collision")
        },
        || format!("{:?}", system.cloud.why("ext/y", None)),
    )?;
    Ok(())
}

#[test]
fn names_that_collide_on_kafka_are_refused() -> anyhow::Result<()> {
    let system = RobotAndCloud::start(&shared_redis()?, &shared_kafka()?)?;
    let replies = KafkaReader::from_end(&system.kafka, &system.topic("blaze/reply"))?;
    let ask = |topic: &str, id: &str| -> anyhow::Result<serde_json::Value> {
        system.tell_cloud(
            &json!({"op":"request","topic":topic,"service":"logger","id":id,"reply_to":"blaze/reply/x","ttl_s":0}),
        )?;
        let answer = replies.next(SOON).ok_or_else(|| anyhow::anyhow!("no answer"))?;
        Ok(serde_json::from_slice(&answer.payload)?)
    };
    assert_eq!(ask("imu/data", "1")?["ok"], true);
    let refused = ask("imu_data", "2")?;
    assert_eq!(refused["error"]["code"], "name_collision", "{refused}");
    assert_eq!(refused["error"]["pointer"], "/topic");
    Ok(())
}

#[test]
fn types_that_differ_are_told_and_agree_later() -> anyhow::Result<()> {
    const TOPIC: &str = "robot/pose";
    let system = RobotAndCloud::start(&shared_redis()?, &shared_kafka()?)?;
    let request =
        |name: &str| system.tell_cloud(&json!({"op":"request","topic":TOPIC,"service":"sink","type":name,"ttl_s":0}));
    system.tell_robot(
        &json!({"op":"advertise","topic":TOPIC,"service":"source","type":"geometry_msgs/msg/Pose","ttl_s":0}),
    )?;
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
