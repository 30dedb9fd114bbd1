//! The budget of a link under two saturating cameras: small topics keep their rate, images get what F9 gives them, and no second carries
//! more than the limit. Each row is one combination of link, limit and sharing.

use std::time::{Duration, Instant};

use blaze_domain::LayerName;
use blaze_flow::limit::allocate::{Sharing, Terms};
use blaze_flow::limit::rates::{Budgets, Demand, LaneDemand, rates};
use blaze_tests::long;
use blaze_tests::network::Plan;
use blaze_tests::scenario::{BrokerKind, Flow, Running, Scenario, Stream};
use blaze_tests::wan::{Change, Shape, Ways};
use serde_json::Value;

use super::layers::{IMU, ODOMETRY, broker, flow, service, stream};
use super::support::turn;

const FRONT: &str = "camera/front";
const REAR: &str = "camera/rear";
/// 640 × 480 RGB, as it comes from the driver.
const IMAGE: usize = 921_600;
const IMAGE_HZ: f64 = 30.0;

/// The small topics of the paper with their rates (R2), as a Jackal publishes them.
fn small() -> Vec<Stream> {
    vec![
        stream("encoder_odom", 49.71, 700),
        stream(ODOMETRY, 19.09, 700),
        stream("pose", 1.09, 350),
        stream("scan", 4.56, 6_000),
        stream(IMU, 49.17, 320),
        stream("tf", 24.65, 500),
    ]
}

fn cameras() -> Vec<Stream> {
    let camera = |topic| Stream {
        reliable: false,
        lifespan: Duration::from_secs(1),
        ..stream(topic, IMAGE_HZ, IMAGE)
    };
    vec![camera(FRONT), camera(REAR)]
}

/// One combination.
struct Row {
    name: &'static str,
    /// The link's rate in Mbit/s of 1000² bit.
    link_mbit: u64,
    /// `limit_mbps`, in units of 1024² bit/s.
    limit_mbps: f64,
    sharing: Sharing,
}

const ROWS: [Row; 3] = [
    Row {
        name: "40 Mbit/s",
        link_mbit: 40,
        limit_mbps: 37.0,
        sharing: Sharing::Paper,
    },
    Row {
        name: "40 Mbit/s, fair",
        link_mbit: 40,
        limit_mbps: 37.0,
        sharing: Sharing::Fair,
    },
    Row {
        name: "160 Mbit/s",
        link_mbit: 160,
        limit_mbps: 150.0,
        sharing: Sharing::Paper,
    },
];

/// How long a row is measured.
fn measured() -> Duration {
    Duration::from_secs(if long() { 30 } else { 8 })
}
/// Until rates, sizes and the wire factor have settled.
const SETTLE: Duration = Duration::from_secs(8);
/// Rates of images may differ from what was reckoned by this share.
const IMAGE_RATE: f64 = 0.03;
/// Of the budget so much is used at least.
const USED: f64 = 0.95;
/// What a meter that asks now and then adds to a second.
const METER_SLACK: f64 = 1.005;
/// Of small topics so many arrive.
const SMALL: f64 = 0.999;

fn scenario(row: &Row) -> Scenario {
    let edge = Flow {
        limit_mbps: row.limit_mbps,
        bandwidth: match row.sharing {
            Sharing::Paper => "share: paper",
            Sharing::Fair => "share: fair",
        },
        keys: "compression: { codec: none }",
        ..flow("edge", "robot-1", "redis", None, &["cloud-1"])
    };
    let shape = Shape {
        rate: Some(row.link_mbit * 1_000_000),
        ..Shape::to_cloud()
    };
    Scenario {
        name: row.name,
        network: Plan::new()
            .with_hosts(&["robot-1", "cloud-1"])
            .with_link("robot-1", "cloud-1", shape),
        brokers: vec![
            broker("redis", "robot-1", BrokerKind::Redis),
            broker("kafka", "cloud-1", BrokerKind::Kafka),
        ],
        flows: vec![edge, flow("cloud", "cloud-1", "kafka", None, &[])],
        publishers: vec![
            service("driver", "robot-1", "redis", small()),
            service("front", "robot-1", "redis", vec![cameras().remove(0)]),
            service("rear", "robot-1", "redis", vec![cameras().remove(1)]),
        ],
        consumers: vec![
            service("recorder", "cloud-1", "kafka", small()),
            service("viewer", "cloud-1", "kafka", cameras()),
        ],
        faults: vec![],
        duration: Duration::ZERO,
        settle: Duration::ZERO,
        expect: vec![],
    }
}

/// The rates of F9 on what the wire factor leaves of the limit.
fn reckoned(row: &Row, wire_factor: f64) -> Vec<(&'static str, f64)> {
    let cloud: LayerName = "cloud".parse().unwrap();
    let streams: Vec<Stream> = small().into_iter().chain(cameras()).collect();
    let demand = |stream: &Stream| Demand {
        topic: stream.topic,
        size_bytes: stream.bytes as u64,
        advertised_hz: stream.hz,
        class: None,
        lanes: vec![LaneDemand {
            layer: &cloud,
            max_rate_hz: None,
        }],
    };
    let demands: Vec<Demand<'_>> = streams.iter().map(demand).collect();
    let budgets = Budgets {
        process: row.limit_mbps * 1_048_576.0 / 8.0 / wire_factor,
        links: std::collections::BTreeMap::new(),
    };
    let terms = Terms {
        sharing: row.sharing,
        ..Terms::default()
    };
    let topics = rates(&budgets, &terms, &demands).topics;
    streams.iter().zip(topics).map(|(stream, rates)| (stream.topic, rates.lanes_hz[0])).collect()
}

fn allocation(running: &Running) -> anyhow::Result<Value> {
    running.flow("robot-1")?.admin().json("/v1/allocation")
}

/// Bytes in the busiest second and the mean of all, of samples of a byte counter.
fn per_second(samples: &[(Instant, u64)]) -> (f64, f64) {
    let mut busiest: f64 = 0.0;
    for (index, (from, before)) in samples.iter().enumerate() {
        let later = samples[index..].iter().find(|(to, _)| *to >= *from + Duration::from_secs(1));
        if let Some((to, after)) = later {
            busiest = busiest.max((after - before) as f64 / (*to - *from).as_secs_f64());
        }
    }
    let mean = match (samples.first(), samples.last()) {
        (Some(first), Some(last)) if last.0 > first.0 => {
            (last.1 - first.1) as f64 / (last.0 - first.0).as_secs_f64()
        }
        _ => 0.0,
    };
    (busiest, mean)
}

fn play(row: &Row) -> anyhow::Result<()> {
    let running = Running::start(&scenario(row))?;
    running.wait_flowing()?;
    // How long rates take to settle is no part of what is measured.
    std::thread::sleep(SETTLE);
    let link = running.link("robot-1", "cloud-1")?;
    let (since, begin, before) = (running.now(), Instant::now(), link.stats()?);
    let mut samples = Vec::new();
    let mut factors = Vec::new();
    while begin.elapsed() < measured() {
        let stats = link.stats()?;
        samples.push((Instant::now(), stats.forward.taken.bytes));
        factors.extend(allocation(&running)?["wire_factor"].as_f64());
        std::thread::sleep(Duration::from_millis(50));
    }
    let (elapsed, after) = (begin.elapsed().as_secs_f64(), link.stats()?);
    let budget = row.limit_mbps * 1_048_576.0 / 8.0;
    let (busiest, mean) = per_second(&samples);
    let factor = factors.iter().sum::<f64>() / factors.len().max(1) as f64;
    println!(
        "{}: limit {:.1} Mbit/s; busiest second {:.1} %, mean {:.1} %, wire factor {factor:.4}; lost on the way {}",
        row.name,
        budget * 8.0 / 1e6,
        100.0 * busiest / budget,
        100.0 * mean / budget,
        after.forward.dropped.total().packets - before.forward.dropped.total().packets,
    );
    let mut faults = Vec::new();
    let mut expect = |holds: bool, what: String| {
        if !holds {
            faults.push(what);
        }
    };
    expect(busiest <= budget * METER_SLACK, format!("{busiest:.0} of {budget:.0} bytes in a second"));
    expect(mean >= budget * USED, format!("only {mean:.0} of {budget:.0} bytes a second"));
    for (topic, hz) in reckoned(row, factor) {
        let is_camera = [FRONT, REAR].contains(&topic);
        let route = running.route(if is_camera { "viewer" } else { "recorder" }, topic, &since)?;
        let got = route.received as f64 / elapsed;
        println!(
            "  {topic:<34} reckoned {hz:>6.2} Hz, got {got:>6.2} Hz; lost {:>3}, p50 {:>6.1} ms, p99 {:>6.1} ms",
            route.lost,
            route.latency_ms(0.5).unwrap_or_default(),
            route.latency_ms(0.99).unwrap_or_default(),
        );
        if is_camera {
            expect(
                (got - hz).abs() <= IMAGE_RATE * hz + 1.0 / elapsed,
                format!("{topic}: {got:.2} Hz instead of {hz:.2}"),
            );
        } else {
            let all = (route.received + route.lost) as f64;
            expect(
                route.received as f64 >= SMALL * all && route.duplicated == 0 && route.reordered == 0,
                format!("{topic}: {route}"),
            );
        }
    }
    anyhow::ensure!(faults.is_empty(), "{}: {}\n{}", row.name, faults.join("; "), running.tails());
    Ok(())
}

#[test]
fn small_topics_keep_their_rate_and_images_get_what_is_left() -> anyhow::Result<()> {
    let _turn = turn();
    let rows = ROWS.iter().filter(|row| long() || row.link_mbit < 100);
    for row in rows {
        play(row)?;
    }
    Ok(())
}

/// The true rate falls to a quarter of the limit, and comes back.
#[test]
fn the_rate_follows_what_the_link_carries() -> anyhow::Result<()> {
    let _turn = turn();
    let row = Row {
        name: "40 Mbit/s that become 10",
        link_mbit: 40,
        limit_mbps: 37.0,
        sharing: Sharing::Paper,
    };
    let running = Running::start(&scenario(&row))?;
    running.wait_flowing()?;
    std::thread::sleep(SETTLE);
    let link = running.link("robot-1", "cloud-1")?;
    link.set(Ways::Both, &[Change::Rate(Some(10_000_000))])?;
    // From five seconds on the queue before the narrow place holds at most a tenth of a second.
    std::thread::sleep(Duration::from_secs(5));
    let (begin, mut longest) = (Instant::now(), 0.0f64);
    while begin.elapsed() < measured() {
        let waiting = link.stats()?.forward.queue.bytes as f64;
        longest = longest.max(waiting * 8.0 / 10e6 * 1e3);
        std::thread::sleep(Duration::from_millis(20));
    }
    let narrow = allocation(&running)?;
    link.set(Ways::Both, &[Change::Rate(Some(40_000_000))])?;
    let (begin, mut back) = (Instant::now(), None);
    let mut last = (Instant::now(), link.stats()?.forward.taken.bytes);
    while begin.elapsed() < Duration::from_secs(30) && back.is_none() {
        std::thread::sleep(Duration::from_secs(1));
        let now = (Instant::now(), link.stats()?.forward.taken.bytes);
        let rate = (now.1 - last.1) as f64 / (now.0 - last.0).as_secs_f64();
        if rate >= 0.9 * row.limit_mbps * 1_048_576.0 / 8.0 {
            back = Some(begin.elapsed());
        }
        last = now;
    }
    println!(
        "10 instead of 40 Mbit/s: measured {}, longest queue {longest:.0} ms from the fifth second on; back at 90 % after {back:?}",
        narrow["links"]
    );
    anyhow::ensure!(longest <= 100.0, "the queue holds {longest:.0} ms\n{}", running.tails());
    anyhow::ensure!(back.is_some(), "not back after 30 s: {}", allocation(&running)?);
    Ok(())
}
