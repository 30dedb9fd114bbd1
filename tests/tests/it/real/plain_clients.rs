//! A service with nothing but a Redis or Kafka client is part of the system.

use anyhow::Context as _;
use std::time::{Duration, Instant};

use blaze_tests::flow::{FlowProcess, FlowSpec};
use blaze_tests::plain::{KafkaReader, KafkaWriter, Record};
use blaze_tests::servers::{shared_kafka, shared_redis, unique_name};
use blaze_tests::{wait, within};
use serde_json::{Value, json};

use crate::real::support::{RedisReader, RobotAndCloud, SOON, connect};

const TOPIC: &str = "imu/data";
const MESSAGES: u64 = 200;

fn code(why: &Value) -> (String, String) {
    let text = |key: &str| why[key].as_str().unwrap_or_default().to_owned();
    (text("verdict"), text("code"))
}

fn numbered(record: &Record) -> Option<u64> {
    let value: Value = serde_json::from_slice(&record.payload).ok()?;
    value["n"].as_u64().filter(|number| *number > 0)
}

/// Publishes `{"n":0}` until one arrives, then waits until no more of them come.
fn until_the_first_arrives(system: &RobotAndCloud, reader: &KafkaReader) -> anyhow::Result<Record> {
    let until = Instant::now() + SOON;
    while Instant::now() < until {
        system.publish(TOPIC, b"{\"n\":0}")?;
        if let Some(mut last) = reader.next(Duration::from_millis(50)) {
            while let Some(next) = reader.next(Duration::from_millis(300)) {
                last = next;
            }
            return Ok(last);
        }
    }
    anyhow::bail!("nothing arrives: {}\n{}", system.robot.tail(), system.cloud.tail())
}

fn check_headers(record: &Record) {
    assert_eq!(record.header("blaze-version"), "1");
    assert_eq!(record.header("blaze-origin"), "edge/robot-1/imu-driver/0");
    assert_eq!(record.header("blaze-encoding"), "application/json");
    assert_eq!(record.header("blaze-hops"), "2", "one on the link, one on Kafka");
    assert_eq!(record.header("blaze-reliable"), "true");
    let writer = record.header("blaze-writer");
    assert!(writer.len() == 32 && writer.bytes().all(|b| b.is_ascii_hexdigit()), "{writer}");
    assert_eq!(String::from_utf8_lossy(&record.key), writer);
    assert!(
        record.header("blaze-time").parse::<u64>().is_ok_and(|ns| ns > 1_700_000_000_000_000_000)
    );
    assert!(record.header("blaze-age-us").parse::<u64>().is_ok_and(|us| us < 10_000_000));
    assert!(!record.header("blaze-epoch").is_empty());
}

/// Who may publish a command is a matter of the node file: refused ones are told, shown, and carry
/// nothing.
#[test]
fn commands_come_only_from_whom_the_rules_allow() -> anyhow::Result<()> {
    const TOPIC: &str = "cmd_vel";
    let redis = shared_redis()?;
    let prefix = format!("{}:", unique_name("access"));
    let mut spec = FlowSpec::new("edge", "robot-1").on_redis(&redis, &prefix);
    spec.flow =
        "access: [ { match: cmd_vel, advertise: { allow: [ \"edge/*/joystick\" ] } } ]".to_owned();
    let mut flow = FlowProcess::launch(spec)?;
    flow.wait_ready()?;
    let mut connection = connect(&redis)?;
    let mut tell = |channel: &str, payload: &str| -> anyhow::Result<i64> {
        Ok(redis::cmd("PUBLISH")
            .arg(format!("{prefix}{channel}"))
            .arg(payload)
            .query(&mut connection)?)
    };
    let mut answers = RedisReader::new(&redis, &format!("{prefix}blaze/reply/test"))?;
    let mut bare = RedisReader::new(&redis, &format!("{prefix}blaze/bare/{TOPIC}"))?;
    let op = |op: &str, service: &str| {
        json!({"op": op, "topic": TOPIC, "service": service, "ttl_s": 0, "bare": op == "request",
               "id": service, "reply_to": "blaze/reply/test"})
        .to_string()
    };
    assert_eq!(tell("blaze/flow/control", &op("request", "motor"))?, 1, "the flow alone hears it");
    let answer = answers.next_json(SOON).with_context(|| flow.tail())?;
    assert_eq!(answer["ok"], true, "{answer}");
    tell("blaze/flow/control", &op("advertise", "planner"))?;
    let refused = answers.next_json(SOON)?;
    assert_eq!(refused["error"]["code"], "access_denied", "{refused}");
    assert_eq!(refused["error"]["pointer"], "/service");
    let why = flow.why(TOPIC, None)?;
    assert_eq!(
        (&why["code"], &why["verdict"]),
        (&json!("access_denied"), &json!("not_flowing")),
        "{why}"
    );
    tell("blaze/flow/control", &op("advertise", "joystick"))?;
    assert_eq!(answers.next_json(SOON)?["ok"], true);
    flow.wait_bridge(TOPIC, SOON)?;
    wait::until(
        "the joystick's command arrives",
        SOON,
        || {
            let _ = tell(TOPIC, "stop");
            matches!(bare.poll(), Ok(Some(payload)) if payload == b"stop")
        },
        || flow.tail(),
    )?;
    Ok(())
}

mod quick {
    use super::*;

    /// `redis-cli publish` → plain Kafka consumer.
    #[test]
    fn redis_publish_reaches_a_kafka_consumer() -> anyhow::Result<()> {
        let system = RobotAndCloud::start(&shared_redis()?, &shared_kafka()?)?;
        let before = system.robot.why(TOPIC, None)?;
        assert_eq!(
            code(&before),
            ("not_flowing".to_owned(), "no_advertise".to_owned()),
            "{before}"
        );

        system.tell_robot(
            &json!({"op":"advertise","topic":TOPIC,"service":"imu-driver","rate_hz":50,"max_bytes":400,
            "encoding":"application/json","reliability":"reliable","ttl_s":0}),
        )?;
        wait::until(
            "the advertise is known and the request is missing",
            SOON,
            || system.robot.why(TOPIC, None).is_ok_and(|why| code(&why).1 == "no_request"),
            || format!("{:?}", system.robot.why(TOPIC, None)),
        )?;
        system
            .tell_cloud(&json!({"op":"request","topic":TOPIC,"service":"logger","reliability":"reliable","ttl_s":0}))?;
        let reader = KafkaReader::from_end(&system.kafka, &system.topic(TOPIC))?;
        system.robot.wait_bridge(TOPIC, SOON)?;
        system.cloud.wait_bridge(TOPIC, SOON)?;
        // The pair stands on both sides; the first message may still meet a bridge that has just
        // been made.
        let first = until_the_first_arrives(&system, &reader)?;
        let mut connection = connect(&system.redis)?;
        for number in 1..=MESSAGES {
            let payload = format!("{{\"n\":{number}}}");
            redis::cmd("PUBLISH").arg(system.channel(TOPIC)).arg(payload).exec(&mut connection)?;
        }
        let mut last_sequence = first.header("blaze-sequence").parse::<u64>()?;
        let mut number = 0;
        while number < MESSAGES {
            let record = reader.next(SOON).ok_or_else(|| {
                anyhow::anyhow!("{number} of {MESSAGES} arrived: {}", system.cloud.tail())
            })?;
            let Some(found) = numbered(&record) else { continue };
            number += 1;
            assert_eq!(found, number, "in order and once");
            let sequence = record.header("blaze-sequence").parse::<u64>()?;
            assert!(sequence > last_sequence, "{sequence} after {last_sequence}");
            last_sequence = sequence;
            check_headers(&record);
        }
        for flow in [&system.robot, &system.cloud] {
            let during = flow.why(TOPIC, Some("cloud"))?;
            assert_eq!(code(&during).0, "flowing", "{during}");
        }

        let withdrawn = Instant::now();
        system.tell_cloud(&json!({"op":"withdraw","topic":TOPIC,"service":"logger"}))?;
        wait::until(
            "the bridges end within a second of the withdraw",
            within(Duration::from_secs(1)),
            || system.robot.bridges_up().is_empty(),
            || format!("{:?}", system.robot.bridges()),
        )?;
        redis::cmd("PUBLISH").arg(system.channel(TOPIC)).arg("{\"n\":0}").exec(&mut connection)?;
        assert_eq!(
            reader.next(Duration::from_millis(700)),
            None,
            "{:?} after the withdraw",
            withdrawn.elapsed()
        );
        let after = system.robot.why(TOPIC, None)?;
        assert_eq!(code(&after), ("not_flowing".to_owned(), "no_request".to_owned()), "{after}");
        Ok(())
    }

    /// Plain Kafka producer → bare Redis subscriber.
    #[test]
    fn a_kafka_producer_reaches_a_bare_redis_subscriber() -> anyhow::Result<()> {
        const COMMANDS: &str = "fleet/commands";
        let system = RobotAndCloud::start(&shared_redis()?, &shared_kafka()?)?;
        system.tell_cloud(&json!({
            "op":"advertise",
            "topic":COMMANDS,
            "service":"planner",
            "reliability":"reliable",
            "ttl_s":0,
        }))?;
        system.tell_robot(&json!({
            "op":"request",
            "topic":COMMANDS,
            "service":"driver",
            "bare":true,
            "reliability":"reliable",
            "ttl_s":0,
        }))?;
        let mut reader =
            RedisReader::new(&system.redis, &system.channel("blaze/bare/fleet/commands"))?;
        let mut framed = RedisReader::new(&system.redis, &system.channel(COMMANDS))?;
        system.cloud.wait_bridge(COMMANDS, SOON)?;
        system.robot.wait_bridge(COMMANDS, SOON)?;
        let writer = KafkaWriter::new(&system.kafka)?;
        let topic = system.topic(COMMANDS);
        let mut first = None;
        let until = Instant::now() + SOON;
        while first.is_none() && Instant::now() < until {
            writer.produce(&topic, b"0")?;
            first = reader.next(Duration::from_millis(50))?;
        }
        assert!(
            first.is_some(),
            "nothing arrives: {}\n{}",
            system.robot.tail(),
            system.cloud.tail()
        );
        for number in 1..=MESSAGES {
            writer.produce_later(&topic, number.to_string().as_bytes())?;
        }
        let mut number = 0;
        while number < MESSAGES {
            let payload = reader
                .next(SOON)?
                .ok_or_else(|| anyhow::anyhow!("{number} of {MESSAGES} arrived"))?;
            if payload == b"0" {
                continue;
            }
            number += 1;
            assert_eq!(
                String::from_utf8_lossy(&payload),
                number.to_string(),
                "bare, in order and once"
            );
        }
        assert_eq!(framed.next(Duration::from_millis(200))?, None, "nobody asked for frames");
        Ok(())
    }
}
