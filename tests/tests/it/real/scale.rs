//! Thousands of topics on one flow: what they cost in memory, traffic and time, all of them bridged
//! to another flow.

use std::time::{Duration, Instant};

use blaze_tests::flow::{FlowProcess, FlowSpec, free_domain};
use blaze_tests::long;
use blaze_tests::plain::{self, RedisReader};
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer, shared_valkey, unique_name};
use blaze_tests::wait;
use serde_json::{Value, json};

use crate::real::support::SOON;

/// As many as one control message may hold.
const BATCH: usize = 200;
/// How long the traffic of flows that have nothing to say is measured.
fn idle() -> Duration {
    Duration::from_secs(if long() { 5 } else { 2 })
}
/// Where all topics must be bridged.
const BRIDGED: Duration = Duration::from_secs(60);
/// What Hellos and Feedbacks of one flow to one other may take, however many topics there are.
const IDLE_BYTES_PER_S: f64 = 4_000.0;

fn tell(url: &str, prefix: &str, op: &str, topics: std::ops::Range<usize>) -> anyhow::Result<()> {
    for first in topics.clone().step_by(BATCH) {
        let messages: Vec<Value> = (first..topics.end.min(first + BATCH))
            .map(|number| json!({"op":op,"topic":format!("scale/t{number}"),"service":"s","rate_hz":1,"max_bytes":100,"ttl_s":0}))
            .collect();
        plain::tell_redis(url, prefix, &Value::from(messages))?;
    }
    Ok(())
}

fn up(flow: &FlowProcess) -> usize {
    flow.bridges_up().len()
}

/// Wire bytes of control messages since the start.
fn control_bytes(flow: &FlowProcess) -> anyhow::Result<f64> {
    let allocation = flow.admin().json("/v1/allocation")?;
    Ok(allocation["control_wire_bytes"].as_f64().unwrap_or_default())
}

/// Waits until neither has anything to tell, and gives what they have told.
fn quiet(robot: &FlowProcess, fog: &FlowProcess) -> anyhow::Result<[f64; 2]> {
    const LOOK: Duration = Duration::from_secs(1);
    let told = || -> anyhow::Result<[f64; 2]> { Ok([control_bytes(robot)?, control_bytes(fog)?]) };
    let (mut since, mut before) = (Instant::now(), told()?);
    let mut is_quiet = || {
        let seconds = since.elapsed().as_secs_f64();
        if seconds < LOOK.as_secs_f64() {
            return false;
        }
        let Ok(now) = told() else { return false };
        let quiet = now
            .iter()
            .zip(&before)
            .all(|(now, before)| (now - before) / seconds <= IDLE_BYTES_PER_S);
        (since, before) = (Instant::now(), now);
        quiet
    };
    wait::until("all has been told", SOON, &mut is_quiet, || format!("{:?}", told()))?;
    told()
}

#[test]
fn thousands_of_topics_on_one_flow() -> anyhow::Result<()> {
    let topics = if long() { 5_000 } else { 1_000 };
    let redis = RedisServer::start(RedisKind::Redis, RedisOptions::default())?;
    let (url, fog_url) = (redis.url(), shared_valkey()?);
    let (domain, fog_prefix) = (free_domain()?, format!("{}:", unique_name("scale")));
    let mut robot =
        FlowProcess::launch(FlowSpec::new("edge", "robot-1").on_redis(&url, "").joined(domain))?;
    let mut fog = FlowProcess::launch(
        FlowSpec::new("fog", "fog-1").on_redis(&fog_url, &fog_prefix).joined(domain),
    )?;
    robot.wait_ready()?;
    fog.wait_ready()?;
    let before = [robot.usage()?, fog.usage()?];
    tell(&url, "", "advertise", 0..topics)?;
    let begin = Instant::now();
    tell(&fog_url, &fog_prefix, "request", 0..topics)?;
    let all = |flow: &FlowProcess| up(flow) == topics;
    wait::until(
        "all topics are bridged",
        BRIDGED,
        || all(&robot) && all(&fog),
        || format!("{} and {} of {topics}\n{}\n{}", up(&robot), up(&fog), robot.tail(), fog.tail()),
    )?;
    let took = begin.elapsed();
    let after = [robot.usage()?, fog.usage()?];
    // How each bridge does is told, too.
    let told = quiet(&robot, &fog)?;
    println!("told to each other by then: {:.0} and {:.0} bytes", told[0], told[1]);
    let counted = told;
    let cpu = [robot.cpu()?, fog.cpu()?];
    // Nothing to wait for: the traffic and work of this time are measured.
    let since = Instant::now();
    std::thread::sleep(idle());
    let seconds = since.elapsed().as_secs_f64();
    for (index, flow) in [&robot, &fog].into_iter().enumerate() {
        let rate = (control_bytes(flow)? - counted[index]) / seconds;
        let busy = (flow.cpu()? - cpu[index]).as_secs_f64() / seconds;
        println!(
            "{topics} topics, bridged after {took:.1?}: {} holds {}, before {}; idle: {rate:.0} \
             control bytes/s, {:.1} % of a core",
            flow.spec.node,
            after[index],
            before[index],
            busy * 100.0
        );
        anyhow::ensure!(rate <= IDLE_BYTES_PER_S, "{} sends {rate} bytes/s", flow.spec.node);
    }
    // Any of them carries.
    let last = format!("scale/t{}", topics - 1);
    let mut reader = RedisReader::new(&fog_url, &format!("{fog_prefix}{last}"))?;
    wait::until(
        "a message of the last topic arrives",
        SOON,
        || plain::publish(&url, &last, b"here").is_ok() && matches!(reader.poll(), Ok(Some(_))),
        || fog.tail(),
    )?;
    // One change among thousands does not wait for the others.
    let begin = Instant::now();
    tell(&fog_url, &fog_prefix, "withdraw", 0..1)?;
    wait::until(
        "one bridge has gone",
        SOON,
        || up(&robot) == topics - 1 && up(&fog) == topics - 1,
        || format!("{} and {}", up(&robot), up(&fog)),
    )?;
    println!("one withdrawn: in effect at both ends after {:.0?}", begin.elapsed());
    Ok(())
}
