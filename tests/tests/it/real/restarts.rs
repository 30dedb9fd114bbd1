//! Flows and servers are killed with -9 and come back, under a stream of 50 Hz.

use std::time::{Duration, Instant};

use blaze_tests::flow::FlowProcess;
use blaze_tests::plain::KafkaWriter;
use blaze_tests::servers::{KafkaOptions, KafkaServer, RedisKind, RedisOptions, RedisServer};
use blaze_tests::{wait, within};
use serde_json::{Value, json};

use crate::real::support::{RobotAndCloud, SOON};
use blaze_tests::stream::Stream;

const TOPIC: &str = "imu/data";
/// After whatever was killed answers again, messages must flow within this time.
const FLOWING: Duration = Duration::from_secs(2);
/// The survivors may grow by this much from the first to the last restart.
const MAX_GROWTH_KIB: u64 = 10 * 1024;

/// Holders of leases: kind, topic, service.
fn leases(flow: &FlowProcess) -> Vec<String> {
    let answer = flow.admin().json("/v1/topics").unwrap_or_default();
    let mut found = Vec::new();
    for row in answer["topics"].as_array().into_iter().flatten() {
        for kind in ["advertised", "requested"] {
            for lease in row[kind]
                .as_array()
                .into_iter()
                .flatten()
                .filter(|lease| lease["local"] == true)
            {
                found.push(format!(
                    "{kind} {} {} {}",
                    row["topic"], lease["service"], lease["expires_in_s"]
                ));
            }
        }
    }
    found.sort();
    found
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Victim {
    RobotFlow,
    CloudFlow,
    Redis,
    Kafka,
}

#[test]
fn whatever_is_killed_comes_back() -> anyhow::Result<()> {
    let redis = RedisServer::start(RedisKind::Redis, RedisOptions::default())?;
    let kafka = KafkaServer::start(KafkaOptions::default())?;
    kafka.wait_ready()?;
    let mut system = RobotAndCloud::start(&redis.url(), &kafka.bootstrap())?;
    system.tell_robot(
        &json!({"op":"advertise","topic":TOPIC,"service":"imu-driver","rate_hz":50,"max_bytes":400,
        "reliability":"reliable","lifespan_ms":2000,"ttl_s":0}),
    )?;
    system.tell_cloud(&json!({"op":"request","topic":TOPIC,"service":"logger","reliability":"reliable","ttl_s":0}))?;
    system.robot.wait_bridge(TOPIC, SOON)?;
    system.cloud.wait_bridge(TOPIC, SOON)?;
    let stream = Stream::start(
        &system.redis,
        &system.channel(TOPIC),
        &system.kafka,
        &system.topic(TOPIC),
        300,
    )?;
    stream.wait_fresh(SOON)?;
    let bridges = [system.robot.bridges_up(), system.cloud.bridges_up()];
    let held = [leases(&system.robot), leases(&system.cloud)];
    assert_eq!(held.iter().map(Vec::len).sum::<usize>(), 2, "{held:?}");

    let rounds = if blaze_tests::long() { 10 } else { 2 };
    let mut first_memory = None;
    for round in 1..=rounds {
        for victim in [Victim::RobotFlow, Victim::CloudFlow, Victim::Redis, Victim::Kafka] {
            let took = kill_and_restart(victim, &mut system, &redis, &kafka, &stream)?;
            println!("round {round}: {victim:?} killed, flowing {took:?} after it answers");
            wait::until(
                "bridges are as before",
                SOON,
                || [system.robot.bridges_up(), system.cloud.bridges_up()] == bridges,
                || format!("{:?} {:?}", system.robot.bridges(), system.cloud.bridges()),
            )?;
            wait::until(
                "leases are as before",
                SOON,
                || [leases(&system.robot), leases(&system.cloud)] == held,
                || {
                    format!(
                        "{:?} {:?}, before {held:?}",
                        leases(&system.robot),
                        leases(&system.cloud)
                    )
                },
            )?;
        }
        if round == 1 {
            first_memory = Some(settled_memory(&system)?);
        }
    }
    let last = settled_memory(&system)?;
    let first = first_memory.unwrap_or(last);
    println!("resident KiB of robot and cloud flow: {first:?} after the first round, {last:?} after the last");
    let (twice, reordered) = stream.faults();
    let arrivals = stream.arrivals().len() as u64;
    println!(
        "published {}, arrived {arrivals}, twice {}, reordered {reordered}",
        stream.published(),
        twice.len()
    );
    assert_eq!(twice, Vec::<u64>::new(), "nothing twice");
    assert_eq!(reordered, 0, "in order");
    for (first, last) in first.into_iter().zip(last) {
        assert!(last <= first + MAX_GROWTH_KIB, "{last} KiB after {first} KiB");
    }
    Ok(())
}

/// Resident memory of both flows; in the long run after a minute of quiet.
fn settled_memory(system: &RobotAndCloud) -> anyhow::Result<[u64; 2]> {
    if blaze_tests::long() {
        // The figure is asked a minute after the restart: this is the measurement itself, not a wait for something.
        std::thread::sleep(Duration::from_secs(60));
    }
    Ok([system.robot.rss_kib()?, system.cloud.rss_kib()?])
}

fn kill_and_restart(
    victim: Victim,
    system: &mut RobotAndCloud,
    redis: &RedisServer,
    kafka: &KafkaServer,
    stream: &Stream,
) -> anyhow::Result<Duration> {
    match victim {
        Victim::RobotFlow => restart_flow(&mut system.robot)?,
        Victim::CloudFlow => restart_flow(&mut system.cloud)?,
        Victim::Redis => {
            redis.kill()?;
            redis.restart()?;
            wait::until("Redis answers PING", SOON, || redis.ping(), String::new)?;
        }
        Victim::Kafka => {
            kafka.kill()?;
            kafka.restart()?;
            // "Answers" is a produce that is acknowledged.
            let begin = Instant::now();
            let writer = KafkaWriter::new(&system.kafka)?;
            while writer.produce(&system.topic("blaze/flow/events"), b"{}").is_err() {
                anyhow::ensure!(begin.elapsed() < SOON * 2, "no produce is acknowledged");
            }
        }
    }
    stream
        .wait_fresh(within(FLOWING))
        .map_err(|error| anyhow::anyhow!("{victim:?}: {error}\n{}\n{}", system.robot.tail(), system.cloud.tail()))
}

fn restart_flow(flow: &mut FlowProcess) -> anyhow::Result<()> {
    flow.kill()?;
    flow.relaunch()?;
    flow.wait_ready()
}

/// A restarted Redis has nothing; the flow writes its leases again, and they outlive the next restart of the flow.
#[test]
fn leases_outlive_redis_and_then_the_flow() -> anyhow::Result<()> {
    let redis = RedisServer::start(RedisKind::Redis, RedisOptions::default())?;
    let kafka = blaze_tests::servers::shared_kafka()?;
    let mut system = RobotAndCloud::start(&redis.url(), &kafka)?;
    system.tell_robot(&json!({"op":"advertise","topic":TOPIC,"service":"imu-driver","ttl_s":0}))?;
    wait::until(
        "the lease is held",
        SOON,
        || leases(&system.robot).len() == 1,
        || system.robot.tail(),
    )?;
    let hash = system.channel("blaze:flow:leases");
    redis.kill()?;
    redis.restart()?;
    wait::until(
        "the hash is written again",
        SOON,
        || redis.cli(&["HLEN", &hash]).is_ok_and(|count| count.trim() == "1"),
        || system.robot.tail(),
    )?;
    restart_flow(&mut system.robot)?;
    let found: Vec<String> = leases(&system.robot);
    assert_eq!(
        found,
        vec![format!(
            "advertised {} {} {}",
            json!(TOPIC),
            json!("imu-driver"),
            Value::Null
        )]
    );
    Ok(())
}
