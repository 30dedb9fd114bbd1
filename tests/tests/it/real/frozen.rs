//! A server stops answering: nobody else notices, nothing piles up, nothing stale arrives afterwards.

use std::io::Write as _;
use std::net::TcpStream;
use std::time::{Duration, Instant};

use blaze_tests::flow::{FlowProcess, FlowSpec, free_domain};
use blaze_tests::plain::{self, KafkaWriter};
use blaze_tests::process::Signal;
use blaze_tests::servers::{
    KafkaOptions, KafkaServer, RedisKind, RedisOptions, RedisServer, shared_kafka, shared_redis, unique_name,
};
use blaze_tests::{wait, within};
use serde_json::{Value, json};

use crate::real::support::SOON;
use blaze_tests::stream::{Arrival, Stream};

const TOPIC: &str = "imu/data";
const SIBLING: &str = "second/data";
/// Payload: large enough that what piles up would be seen.
const BYTES: usize = 20_000;
const LIFESPAN: Duration = Duration::from_millis(500);
/// What the contract lets arrive late, because it was handed to the socket before.
const IN_THE_SOCKET: usize = 1024 * 1024;
/// A flow may grow by this much while a server is frozen.
const MAX_GROWTH_KIB: u64 = 96 * 1024;

/// Robots, a fog and a cloud with streams between them: one over what freezes, the others beside it.
struct Rig {
    redis: RedisServer,
    kafka: KafkaServer,
    flows: [FlowProcess; 4],
    frozen: Stream,
    /// Nothing in common with the frozen one but the machine.
    other: Stream,
    /// From the same publisher's Redis and through the same flow as the frozen one, to another destination.
    sibling: Stream,
}

impl Rig {
    /// `robot-1` and `cloud-1` on servers of their own, `robot-2` and `fog-1` on the shared ones; everybody joined.
    fn start() -> anyhow::Result<Self> {
        let redis = RedisServer::start(RedisKind::Redis, RedisOptions::default())?;
        let kafka = KafkaServer::start(KafkaOptions::default())?;
        kafka.wait_ready()?;
        let (other_redis, other_kafka) = (shared_redis()?, shared_kafka()?);
        let run = unique_name("frozen");
        let domain = free_domain()?;
        let (redis_prefix, kafka_prefix) = (format!("{run}:"), format!("{run}."));
        let specs = [
            FlowSpec::new("edge", "robot-1")
                .on_redis(&redis.url(), "")
                .joined(domain),
            FlowSpec::new("cloud", "cloud-1")
                .on_kafka(&kafka.bootstrap(), "")
                .joined(domain),
            FlowSpec::new("edge", "robot-2")
                .on_redis(&other_redis, &redis_prefix)
                .joined(domain),
            FlowSpec::new("fog", "fog-1")
                .on_kafka(&other_kafka, &kafka_prefix)
                .joined(domain),
        ];
        let mut flows = Vec::new();
        for spec in specs {
            flows.push(FlowProcess::launch(spec)?);
        }
        for flow in &mut flows {
            flow.wait_ready()?;
        }
        let flows: [FlowProcess; 4] = flows.try_into().map_err(|_| anyhow::anyhow!("four flows"))?;
        // Two topics, so that each stream has one destination.
        connect_stream(&redis.url(), "", "first/data", &kafka.bootstrap(), "")?;
        connect_stream(&redis.url(), "", SIBLING, &other_kafka, &kafka_prefix)?;
        connect_stream(&other_redis, &redis_prefix, TOPIC, &other_kafka, &kafka_prefix)?;
        flows[0].wait_bridge("first/data", SOON)?;
        flows[1].wait_bridge("first/data", SOON)?;
        flows[0].wait_bridge(SIBLING, SOON)?;
        for topic in [TOPIC, SIBLING] {
            flows[3].wait_bridge(topic, SOON)?;
        }
        flows[2].wait_bridge(TOPIC, SOON)?;
        let frozen = Stream::start(&redis.url(), "first/data", &kafka.bootstrap(), "first.data", BYTES)?;
        let other = Stream::start(
            &other_redis,
            &format!("{redis_prefix}{TOPIC}"),
            &other_kafka,
            &format!("{kafka_prefix}imu.data"),
            300,
        )?;
        let topic = format!("{kafka_prefix}{}", SIBLING.replace('/', "."));
        let sibling = Stream::start(&redis.url(), SIBLING, &other_kafka, &topic, 300)?;
        for stream in [&frozen, &other, &sibling] {
            stream.wait_fresh(SOON)?;
        }
        Ok(Self {
            redis,
            kafka,
            flows,
            frozen,
            other,
            sibling,
        })
    }

    fn memory(&self) -> anyhow::Result<Vec<u64>> {
        self.flows.iter().map(FlowProcess::rss_kib).collect()
    }
}

fn connect_stream(redis: &str, redis_prefix: &str, topic: &str, kafka: &str, kafka_prefix: &str) -> anyhow::Result<()> {
    let advertise = json!({"op":"advertise","topic":topic,"service":"source","rate_hz":50,"lifespan_ms":LIFESPAN.as_millis() as u64,
        "reliability":"reliable","ttl_s":0});
    plain::tell_redis(redis, redis_prefix, &advertise)?;
    let request = json!({"op":"request","topic":topic,"service":"sink","reliability":"reliable","ttl_s":0});
    plain::tell_kafka(&KafkaWriter::new(kafka)?, kafka_prefix, &request)
}

fn period() -> Duration {
    Duration::from_secs(if blaze_tests::long() { 20 } else { 5 })
}

/// How often the comparison of latencies is made: a machine that is busy with something else for one of the two windows says
/// nothing of the flow, which would hold up the other route each time.
const ATTEMPTS: usize = 3;

/// Freezes a server for a while and checks what must hold.
fn freeze(
    rig: &Rig,
    what: &str,
    others: &[&Stream],
    freeze: impl Fn() -> anyhow::Result<()>,
    thaw: impl Fn() -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let mut seen = Vec::new();
    while seen.len() < ATTEMPTS {
        let times = freeze_once(rig, what, others, &freeze, &thaw)?;
        // The margin beside the factor is what the clock of two busy cores resolves.
        let margin = within(Duration::from_millis(5));
        let as_fast = |(calm, frozen): &(Duration, Duration)| *frozen <= calm.mul_f64(1.2) + margin;
        if times.iter().all(as_fast) {
            return Ok(());
        }
        seen.push(times);
    }
    anyhow::bail!("{what}: each time another route was slower while it was frozen: {seen:?}")
}

/// Gives the other routes' p99 before and while the server was frozen.
fn freeze_once(
    rig: &Rig,
    what: &str,
    others: &[&Stream],
    freeze: impl Fn() -> anyhow::Result<()>,
    thaw: impl Fn() -> anyhow::Result<()>,
) -> anyhow::Result<Vec<(Duration, Duration)>> {
    let calm_from = Instant::now();
    std::thread::sleep(period());
    let calm_to = Instant::now();
    let before = rig.memory()?;
    freeze()?;
    let frozen_from = Instant::now();
    std::thread::sleep(period());
    let frozen_to = Instant::now();
    let during = rig.memory()?;
    thaw()?;
    let thawed = Instant::now();
    rig.frozen.wait_fresh(SOON)?;
    println!("{what}: flowing again {:?} after it answers", thawed.elapsed());
    let mut times = Vec::new();
    for other in others {
        let calm = other.p99(calm_from, calm_to).unwrap_or_default();
        let frozen = other.p99(frozen_from, frozen_to).unwrap_or_default();
        println!("{what}: another route's p99 {calm:?} before, {frozen:?} while it was frozen");
        let (twice, reordered) = other.faults();
        assert_eq!((twice.len(), reordered), (0, 0), "another route");
        assert!(!frozen.is_zero(), "another route went on");
        times.push((calm, frozen));
    }
    for (flow, (before, during)) in rig.flows.iter().zip(before.iter().zip(&during)) {
        println!(
            "{what}: {} {before} KiB before, {during} KiB while it was frozen",
            flow.spec.node
        );
        assert!(
            *during <= before + MAX_GROWTH_KIB,
            "{}: {before} → {during} KiB",
            flow.spec.node
        );
    }
    Ok(times)
}

/// What arrived after the thaw although it was older than its lifespan.
fn stale(stream: &Stream, since: Instant) -> Vec<Arrival> {
    let late = LIFESPAN + Duration::from_millis(500);
    stream
        .arrivals()
        .into_iter()
        .filter(|arrival| arrival.at > since && arrival.took > late)
        .collect()
}

fn dropped(flow: &FlowProcess) -> Value {
    let bridges = flow.bridges();
    bridges.iter().map(|bridge| bridge["dropped"].clone()).collect()
}

#[test]
fn a_frozen_kafka_holds_up_nobody_else() -> anyhow::Result<()> {
    let rig = Rig::start()?;
    let thawed = std::cell::Cell::new(Instant::now());
    freeze(
        &rig,
        "Kafka",
        &[&rig.other, &rig.sibling],
        || rig.kafka.freeze(),
        || {
            thawed.set(Instant::now());
            rig.kafka.thaw()
        },
    )?;
    let (twice, reordered) = rig.frozen.faults();
    assert_eq!((twice, reordered), (vec![], 0));
    let stale = stale(&rig.frozen, thawed.get());
    let bytes: usize = stale.iter().map(|arrival| arrival.bytes).sum();
    println!(
        "Kafka: {} messages ({bytes} bytes) arrived although older than their lifespan",
        stale.len()
    );
    assert!(bytes <= IN_THE_SOCKET, "{bytes} bytes were stale");
    let counted = dropped(&rig.flows[1]);
    println!("Kafka: cloud-1 counts {counted}");
    let text = counted.to_string();
    assert!(
        ["lifespan", "queue_full", "broker_error"]
            .iter()
            .any(|reason| text.contains(reason)),
        "what was dropped has a reason: {counted}"
    );
    Ok(())
}

#[test]
fn a_frozen_redis_holds_up_nobody_else() -> anyhow::Result<()> {
    let rig = Rig::start()?;
    freeze(&rig, "Redis", &[&rig.other], || rig.redis.freeze(), || rig.redis.thaw())?;
    let (twice, reordered) = rig.frozen.faults();
    assert_eq!((twice, reordered), (vec![], 0));
    wait::until(
        "robot-1 is ready again",
        SOON,
        || rig.flows[0].admin().ready(),
        || rig.flows[0].tail(),
    )?;
    Ok(())
}

/// The flow at the other end of the link stands still, until it counts as down and beyond.
#[test]
fn a_stalled_destination_holds_up_nobody_else() -> anyhow::Result<()> {
    let rig = Rig::start()?;
    let cloud = &rig.flows[1];
    freeze(
        &rig,
        "the cloud's flow",
        &[&rig.other, &rig.sibling],
        || cloud.signal(Signal::STOP),
        || cloud.signal(Signal::CONT),
    )?;
    let (twice, reordered) = rig.frozen.faults();
    assert_eq!((twice, reordered), (vec![], 0));
    let counted = dropped(&rig.flows[0]);
    println!("robot-1 counts {counted}");
    let text = counted.to_string();
    assert!(
        ["link_down", "lifespan"].iter().any(|reason| text.contains(reason)),
        "what was dropped has a reason: {counted}"
    );
    Ok(())
}

/// A subscriber on the publisher's Redis that never reads.
#[test]
fn a_slow_redis_subscriber_holds_up_nobody_else() -> anyhow::Result<()> {
    let rig = Rig::start()?;
    let slow = std::cell::RefCell::new(None);
    freeze(
        &rig,
        "a slow subscriber",
        &[&rig.frozen, &rig.other, &rig.sibling],
        || {
            let mut stream = TcpStream::connect(("127.0.0.1", rig.redis.port()))?;
            stream.write_all(b"SUBSCRIBE first/data\r\n")?;
            slow.replace(Some(stream));
            Ok(())
        },
        || {
            slow.replace(None);
            Ok(())
        },
    )
}
