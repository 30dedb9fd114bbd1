//! Many nodes join at once, each in a namespace of its own, and ask for what is flowing: those who
//! had it go on having it.

use std::time::{Duration, Instant};

use blaze_tests::flow::{FlowProcess, FlowSpec};
use blaze_tests::machine::Idler;
use blaze_tests::network::{Host, Plan, Topology, inside};
use blaze_tests::plain::{self, KafkaWriter};
use blaze_tests::servers::{KafkaOptions, KafkaServer, RedisKind, RedisOptions, RedisServer};
use blaze_tests::stream::Stream;
use blaze_tests::wait;
use rustix::process::setpriority_process;
use serde_json::{Value, json};

const NODES: usize = 13;
const TOPIC: &str = "imu/data";
const DOMAIN: u16 = 20;
/// The longest time that the route may be silent; its messages come every 20 ms. Beyond it counts
/// what the machine had nobody do anything: all nodes start on the same processors here.
const GAP: Duration = Duration::from_millis(200);
/// Nice value of those who join: processors serve the others (0) first.
const LATER: i32 = 10;
const SOON: Duration = Duration::from_secs(30);
/// After the last one has what it asked for.
const AFTER: Duration = Duration::from_secs(3);

fn redis(host: &Host) -> anyhow::Result<RedisServer> {
    let options = RedisOptions { host: Some(host.clone()), ..RedisOptions::default() };
    RedisServer::start(RedisKind::Redis, options)
}

fn lease(op: &str) -> Value {
    json!({
        "op":op,
        "topic":TOPIC,
        "service":"test",
        "reliability":"reliable",
        "lifespan_ms":1000,
        "ttl_s":0,
    })
}

/// Messages that a node's flow has written to its Redis.
fn delivered(flow: &FlowProcess) -> u64 {
    let bridges = flow.bridges();
    let of_topic = bridges.iter().filter(|bridge| bridge["topic"] == TOPIC);
    of_topic.filter_map(|bridge| bridge["out"]["messages"].as_u64()).sum()
}

fn peers_up(flow: &FlowProcess) -> usize {
    let peers = flow.admin().json("/v1/peers").unwrap_or_default();
    let peers = peers["peers"].as_array().cloned().unwrap_or_default();
    peers.iter().filter(|peer| peer["state"] == "up").count()
}

#[test]
fn nodes_that_join_at_once_disturb_nobody() -> anyhow::Result<()> {
    let names: Vec<String> = (1..=NODES).map(|number| format!("node-{number}")).collect();
    let mut hosts = vec!["robot-1", "cloud-1"];
    hosts.extend(names.iter().map(String::as_str));
    let network = Topology::build(&Plan::new().with_hosts(&hosts).with_unicast_lan(&hosts))?;
    let (robot_host, cloud_host) = (network.host("robot-1")?, network.host("cloud-1")?);
    let robot_redis = redis(robot_host)?;
    let kafka = KafkaServer::start(KafkaOptions {
        host: Some(cloud_host.clone()),
        ..KafkaOptions::default()
    })?;
    let seed = [cloud_host.address];
    let spec = |layer: &str, host: &Host| {
        FlowSpec::new(layer, &host.name).joined(DOMAIN).inside(host, &seed)
    };
    let mut robot = FlowProcess::launch(spec("edge", robot_host).on_redis(&robot_redis.url(), ""))?;
    let mut cloud =
        FlowProcess::launch(spec("cloud", cloud_host).on_kafka(&kafka.bootstrap(), ""))?;
    robot.wait_ready()?;
    cloud.wait_ready()?;
    let tell = |host: &Host, redis: &RedisServer, message: Value| {
        inside(&host.namespace, || plain::tell_redis(&redis.url(), "", &message))
    };
    tell(robot_host, &robot_redis, lease("advertise"))?;
    inside(&cloud_host.namespace, || {
        plain::tell_kafka(&KafkaWriter::new(&kafka.bootstrap())?, "", &lease("request"))
    })?;
    cloud.wait_bridge(TOPIC, SOON)?;
    robot.wait_bridge(TOPIC, SOON)?;
    let stream = Stream::between(
        (robot_host, &robot_redis.url(), TOPIC),
        (cloud_host, &kafka.bootstrap(), "imu.data"),
        320,
    )?;
    stream.wait_fresh(SOON)?;
    let servers: Vec<RedisServer> =
        names.iter().map(|name| redis(network.host(name)?)).collect::<anyhow::Result<_>>()?;
    let calm = Instant::now();
    stream.wait_fresh(SOON)?;
    // As long as before the join, to compare with.
    std::thread::sleep(AFTER);
    let (joined, idler) = (Instant::now(), Idler::start());
    let mut flows = Vec::new();
    // Elsewhere each node has processors of its own: those of the route go first.
    setpriority_process(None, LATER)?;
    for (name, server) in names.iter().zip(&servers) {
        flows.push(FlowProcess::launch(
            spec("edge", network.host(name)?).on_redis(&server.url(), ""),
        )?);
    }
    setpriority_process(None, 0)?;
    for ((name, server), flow) in names.iter().zip(&servers).zip(&mut flows) {
        flow.wait_ready()?;
        tell(network.host(name)?, server, lease("request"))?;
    }
    wait::until(
        "every node has what it asked for",
        SOON,
        || flows.iter().all(|flow| delivered(flow) > 0),
        || {
            let without = flows.iter().filter(|flow| delivered(flow) == 0);
            let seen = |flow: &FlowProcess| {
                let read = |path| flow.admin().json(path).unwrap_or_default();
                format!("{}\n{}\n{}", read("/v1/peers"), read("/v1/topics"), flow.tail())
            };
            let served: Vec<u64> = flows.iter().map(delivered).collect();
            let without: Vec<String> = without.map(seen).collect();
            format!("{served:?}\n{}\nthe robot: {}", without.join("\n"), seen(&robot))
        },
    )?;
    let served = joined.elapsed();
    wait::until(
        "all know each other",
        SOON,
        || peers_up(&robot) == NODES + 1,
        || format!("{} of {}", peers_up(&robot), NODES + 1),
    )?;
    std::thread::sleep(AFTER);
    let (end, late) = (Instant::now(), idler.latest());
    let (before, during) = (stream.gap(calm, joined), stream.gap(joined, end));
    let (twice, reordered) = stream.faults();
    println!(
        "{NODES} nodes joined at once and had the topic after {served:.1?}: longest gap \
         {during:.0?}, before {before:.0?}, the machine was late by {late:.0?}; {} came, twice {}, \
         out of order {reordered}",
        stream.arrivals().len(),
        twice.len()
    );
    let lost = stream.published() - stream.arrivals().len() as u64;
    anyhow::ensure!(
        twice.is_empty() && reordered == 0,
        "twice {twice:?}, out of order {reordered}"
    );
    // A few are on their way.
    anyhow::ensure!(lost <= 10, "{lost} of {} lost", stream.published());
    anyhow::ensure!(
        during <= GAP + late,
        "silent for {during:?}, where the machine was late by {late:?}"
    );
    Ok(())
}
