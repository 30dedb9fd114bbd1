//! A server, a flow or a reader stands still: nobody else notices, nothing piles up, nothing stale
//! arrives afterwards.

use std::cell::RefCell;
use std::io::Write as _;
use std::net::TcpStream;
use std::time::{Duration, Instant};

use blaze_tests::flow::{FlowProcess, FlowSpec, free_domain};
use blaze_tests::plain::{self, KafkaWriter};
use blaze_tests::process::Signal;
use blaze_tests::servers::{
    KafkaOptions, KafkaServer, RedisKind, RedisOptions, RedisServer, shared_kafka, shared_redis,
    unique_name,
};
use blaze_tests::wait;
use serde_json::json;

use crate::real::support::SOON;
use blaze_tests::stream::Stream;

const TOPIC: &str = "imu/data";
/// The stream over what freezes.
const FROZEN: &str = "first/data";
const SIBLING: &str = "second/data";
/// Payload: large enough that what piles up would be seen.
const BYTES: usize = 20_000;
const LIFESPAN: Duration = Duration::from_millis(500);
/// What the contract lets arrive late, because it was handed to the socket before.
const IN_THE_SOCKET: usize = 1024 * 1024;
/// A flow may grow by this much while a server is frozen.
const MAX_GROWTH_KIB: u64 = 96 * 1024;

/// Robots, a fog and a cloud with streams between them: one over what freezes, the others beside
/// it.
struct Rig {
    redis: RedisServer,
    kafka: KafkaServer,
    flows: [FlowProcess; 4],
    frozen: Stream,
    /// Nothing in common with the frozen one but the machine.
    other: Stream,
    /// From the same publisher's Redis and through the same flow as the frozen one, to another
    /// destination.
    sibling: Stream,
}

impl Rig {
    /// `robot-1` and `cloud-1` on servers of their own, `robot-2` and `fog-1` on the shared ones;
    /// everybody joined.
    fn start() -> anyhow::Result<Self> {
        let redis = RedisServer::start(RedisKind::Redis, RedisOptions::default())?;
        let kafka = KafkaServer::start(KafkaOptions::default())?;
        let (other_redis, other_kafka) = (shared_redis()?, shared_kafka()?);
        let run = unique_name("frozen");
        let domain = free_domain()?;
        let (redis_prefix, kafka_prefix) = (format!("{run}:"), format!("{run}."));
        let specs = [
            FlowSpec::new("edge", "robot-1").on_redis(&redis.url(), "").joined(domain),
            FlowSpec::new("cloud", "cloud-1").on_kafka(&kafka.bootstrap(), "").joined(domain),
            FlowSpec::new("edge", "robot-2").on_redis(&other_redis, &redis_prefix).joined(domain),
            FlowSpec::new("fog", "fog-1").on_kafka(&other_kafka, &kafka_prefix).joined(domain),
        ];
        let mut flows = Vec::new();
        for spec in specs {
            flows.push(FlowProcess::launch(spec)?);
        }
        for flow in &mut flows {
            flow.wait_ready()?;
        }
        let flows: [FlowProcess; 4] =
            flows.try_into().map_err(|_| anyhow::anyhow!("four flows"))?;
        // Two topics, so that each stream has one destination.
        connect_stream(&redis.url(), "", FROZEN, &kafka.bootstrap(), "")?;
        connect_stream(&redis.url(), "", SIBLING, &other_kafka, &kafka_prefix)?;
        connect_stream(&other_redis, &redis_prefix, TOPIC, &other_kafka, &kafka_prefix)?;
        flows[0].wait_bridge(FROZEN, SOON)?;
        flows[1].wait_bridge(FROZEN, SOON)?;
        flows[0].wait_bridge(SIBLING, SOON)?;
        for topic in [TOPIC, SIBLING] {
            flows[3].wait_bridge(topic, SOON)?;
        }
        flows[2].wait_bridge(TOPIC, SOON)?;
        let frozen = Stream::start(&redis.url(), FROZEN, &kafka.bootstrap(), "first.data", BYTES)?;
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
        Ok(Self { redis, kafka, flows, frozen, other, sibling })
    }

    fn memory(&self) -> anyhow::Result<Vec<u64>> {
        self.flows.iter().map(FlowProcess::rss_kib).collect()
    }
}

fn connect_stream(
    redis: &str,
    redis_prefix: &str,
    topic: &str,
    kafka: &str,
    kafka_prefix: &str,
) -> anyhow::Result<()> {
    let advertise = json!({"op":"advertise","topic":topic,"service":"source","rate_hz":50,"lifespan_ms":LIFESPAN
        .as_millis() as u64,
        "reliability":"reliable","ttl_s":0});
    plain::tell_redis(redis, redis_prefix, &advertise)?;
    let request =
        json!({"op":"request","topic":topic,"service":"sink","reliability":"reliable","ttl_s":0});
    plain::tell_kafka(&KafkaWriter::new(kafka)?, kafka_prefix, &request)
}

/// Longer than the time after which a flow counts as down.
fn period() -> Duration {
    Duration::from_secs(if blaze_tests::long() { 20 } else { 4 })
}

/// How often the comparison of latencies is made: a machine that is busy with something else for
/// one of the two windows says nothing of the flow, which would hold up the other route each time.
const ATTEMPTS: usize = 3;

impl Rig {
    /// Freezes something for a while and checks what must hold. Gives the moment when it went on.
    fn freeze(
        &self,
        what: &str,
        others: &[&Stream],
        freeze: impl Fn() -> anyhow::Result<()>,
        thaw: impl Fn() -> anyhow::Result<()>,
    ) -> anyhow::Result<Instant> {
        let mut seen = Vec::new();
        while seen.len() < ATTEMPTS {
            let (thawed, times) = self.freeze_once(what, others, &freeze, &thaw)?;
            // The margin beside the factor is what the clock of two busy cores resolves; beside
            // other tests what these take, but less than what makes a message expire.
            let margin = match blaze_tests::long() {
                true => Duration::from_millis(5),
                false => LIFESPAN.mul_f64(0.6),
            };
            let as_fast =
                |(calm, frozen): &(Duration, Duration)| *frozen <= calm.mul_f64(1.2) + margin;
            if times.iter().all(as_fast) {
                return Ok(thawed);
            }
            seen.push(times);
        }
        anyhow::bail!("{what}: each time another route was slower while it was frozen: {seen:?}")
    }

    /// Gives when it went on, and the other routes' p99 before and while it was frozen.
    fn freeze_once(
        &self,
        what: &str,
        others: &[&Stream],
        freeze: impl Fn() -> anyhow::Result<()>,
        thaw: impl Fn() -> anyhow::Result<()>,
    ) -> anyhow::Result<(Instant, Vec<(Duration, Duration)>)> {
        let calm_from = Instant::now();
        std::thread::sleep(period());
        let calm_to = Instant::now();
        let before = self.memory()?;
        freeze()?;
        let frozen_from = Instant::now();
        std::thread::sleep(period());
        let frozen_to = Instant::now();
        let during = self.memory()?;
        let thawed = Instant::now();
        thaw()?;
        self.frozen.wait_fresh(SOON)?;
        println!("{what}: flowing again {:?} after it answers", thawed.elapsed());
        for stream in others.iter().copied().chain([&self.frozen]) {
            let (twice, reordered) = stream.faults();
            assert_eq!((twice, reordered), (vec![], 0), "{what}");
        }
        let times = others.iter().map(|other| {
            let calm = other.p99(calm_from, calm_to).unwrap_or_default();
            // A route that did not go on at all is slower than any.
            let frozen = other.p99(frozen_from, frozen_to).unwrap_or(Duration::MAX);
            println!("{what}: another route's p99 {calm:?} before, {frozen:?} while it was frozen");
            (calm, frozen)
        });
        let times = times.collect();
        for (flow, (before, during)) in self.flows.iter().zip(before.iter().zip(&during)) {
            let node = &flow.spec.node;
            assert!(*during <= before + MAX_GROWTH_KIB, "{what}, {node}: {before} → {during} KiB");
        }
        Ok((thawed, times))
    }
}

/// Bytes that arrived after the thaw although they were older than their lifespan.
fn stale(stream: &Stream, since: Instant) -> usize {
    let late = LIFESPAN + Duration::from_millis(500);
    let arrivals = stream.arrivals().into_iter();
    let stale = arrivals.filter(|arrival| arrival.at > since && arrival.took > late);
    stale.map(|arrival| arrival.bytes).sum()
}

/// What a flow dropped of the stream that froze, of these reasons.
fn dropped(flow: &FlowProcess, reasons: &[&str]) -> u64 {
    let bridges = flow.bridges();
    let of_frozen = bridges.iter().filter(|bridge| bridge["topic"] == FROZEN);
    let counts = of_frozen
        .flat_map(|bridge| reasons.iter().map(|reason| bridge["dropped"][reason].as_u64()));
    counts.flatten().sum()
}

#[test]
fn what_stands_still_holds_up_nobody_else() -> anyhow::Result<()> {
    let rig = Rig::start()?;
    let (robot, cloud) = (&rig.flows[0], &rig.flows[1]);
    let others = [&rig.other, &rig.sibling];
    let thawed = rig.freeze("Kafka", &others, || rig.kafka.freeze(), || rig.kafka.thaw())?;
    let bytes = stale(&rig.frozen, thawed);
    assert!(bytes <= IN_THE_SOCKET, "{bytes} bytes were stale");
    let counted = dropped(cloud, &["lifespan", "queue_full", "broker_error"]);
    assert!(counted > 0, "what was dropped has a reason: {:?}", cloud.bridges());
    // A subscriber on the publisher's Redis that never reads.
    let slow = RefCell::new(None);
    let subscribe = || -> anyhow::Result<()> {
        let mut stream = TcpStream::connect(("127.0.0.1", rig.redis.port()))?;
        writeln!(stream, "SUBSCRIBE {FROZEN}\r")?;
        slow.replace(Some(stream));
        Ok(())
    };
    let leave = || -> anyhow::Result<()> {
        slow.replace(None);
        Ok(())
    };
    let all = [&rig.frozen, &rig.other, &rig.sibling];
    rig.freeze("a slow subscriber", &all, subscribe, leave)?;
    // The flow at the other end of the link, until it counts as down and beyond.
    let reasons = ["link_down", "lifespan"];
    let before = dropped(robot, &reasons);
    rig.freeze(
        "the cloud's flow",
        &others,
        || cloud.signal(Signal::STOP),
        || cloud.signal(Signal::CONT),
    )?;
    assert!(
        dropped(robot, &reasons) > before,
        "what was dropped has a reason: {:?}",
        robot.bridges()
    );
    rig.freeze("Redis", &others[..1], || rig.redis.freeze(), || rig.redis.thaw())?;
    wait::until("robot-1 is ready again", SOON, || robot.admin().ready(), || robot.tail())?;
    Ok(())
}
