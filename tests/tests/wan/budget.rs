//! The budget of a link under two saturating cameras: small topics keep their rate, images get what F9 gives them, and no second carries
//! more than the limit. Each row is one combination of link, limit, sharing and compression.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze::demo::recording::{Body, load_built_in};
use blaze_domain::LayerName;
use blaze_flow::limit::allocate::{Sharing, Terms};
use blaze_flow::limit::rates::{Budgets, Demand, LaneDemand, rates};
use blaze_tests::network::Plan;
use blaze_tests::scenario::{BrokerKind, Flow, Route, Running, Scenario, Stream};
use blaze_tests::wan::{Change, Shape, Ways};
use blaze_tests::{long, wait};
use serde_json::Value;

use super::layers::{CAMERA, IMU, ODOMETRY, broker, flow, service, stream};
use super::support::turn;

const FRONT: &str = "camera/front";
const REAR: &str = "camera/rear";
/// 640 × 480 RGB, as it comes from the driver.
const IMAGE: usize = 921_600;
const IMAGE_HZ: f64 = 30.0;
/// Pictures of the recording that are published in turn.
const PICTURES: usize = 60;

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

/// Both publish the pictures of the recording.
fn cameras() -> anyhow::Result<Vec<Stream>> {
    let pictures = pictures()?;
    let camera = |topic| Stream {
        reliable: false,
        lifespan: Duration::from_secs(1),
        payloads: Some(pictures),
        ..stream(topic, IMAGE_HZ, IMAGE)
    };
    Ok(vec![camera(FRONT), camera(REAR)])
}

/// A file with pictures of the recording, as they come from a camera.
fn pictures() -> anyhow::Result<&'static str> {
    static FILE: OnceLock<Result<tempfile::NamedTempFile, String>> = OnceLock::new();
    let made = FILE.get_or_init(|| write_pictures().map_err(|error| format!("{error:#}")));
    let file = made.as_ref().map_err(|error| anyhow::anyhow!("{error}"))?;
    file.path().to_str().context("a path that is no text")
}

fn write_pictures() -> anyhow::Result<tempfile::NamedTempFile> {
    let mut file = tempfile::NamedTempFile::new()?;
    let mut written = 0;
    for recording in load_built_in()? {
        let camera = recording.topics.iter().position(|topic| topic.name.as_str() == CAMERA);
        let pictures = recording.messages.iter().filter(|message| Some(message.topic) == camera);
        for picture in pictures.take(PICTURES - written) {
            if let Body::Ready(pixels) = &picture.body {
                anyhow::ensure!(pixels.len() == IMAGE, "a picture of {} bytes", pixels.len());
                file.write_all(pixels)?;
                written += 1;
            }
        }
    }
    anyhow::ensure!(written == PICTURES, "{written} pictures");
    Ok(file)
}

/// One combination.
struct Row {
    name: &'static str,
    /// The link's rate in Mbit/s of 1000² bit.
    link_mbit: u64,
    /// `limit_mbps`, in units of 1024² bit/s.
    limit_mbps: f64,
    sharing: Sharing,
    /// What stands in `flow.compression`.
    compression: &'static str,
    /// What two cores reach is reported; the images' rates have no bar.
    reported: bool,
}

impl Row {
    const fn new(name: &'static str, link_mbit: u64, limit_mbps: f64) -> Self {
        Self {
            name,
            link_mbit,
            limit_mbps,
            sharing: Sharing::Paper,
            compression: "codec: none",
            reported: false,
        }
    }

    const fn fair(self) -> Self {
        Self {
            sharing: Sharing::Fair,
            ..self
        }
    }

    const fn compressed(self, compression: &'static str) -> Self {
        Self { compression, ..self }
    }

    const fn reported(self) -> Self {
        Self { reported: true, ..self }
    }

    fn is_compressed(&self) -> bool {
        self.compression != "codec: none"
    }

    /// Wire bytes per second.
    fn budget(&self) -> f64 {
        self.limit_mbps * 1_048_576.0 / 8.0
    }
}

const FULL: Row = Row::new("160 Mbit/s", 160, 150.0);
const NARROW: Row = Row::new("40 Mbit/s", 40, 37.0);

/// The rows that every run plays come first.
const ROWS: [Row; 9] = [
    NARROW,
    Row::new("40 Mbit/s, LZ4 adaptive", 40, 37.0).compressed("level: 10"),
    Row::new("40 Mbit/s, fair", 40, 37.0).fair(),
    Row::new("40 Mbit/s, LZ4 level 1", 40, 37.0).compressed("level: 1, adaptive: false"),
    Row::new("40 Mbit/s, LZ4 level 9", 40, 37.0).compressed("level: 9, adaptive: false"),
    Row::new("40 Mbit/s, LZ4 level 10", 40, 37.0).compressed("level: 10, adaptive: false"),
    FULL,
    Row::new("160 Mbit/s, fair", 160, 150.0).fair(),
    Row::new("160 Mbit/s, LZ4 level 9", 160, 150.0).compressed("level: 9, adaptive: false").reported(),
];
const OF_EVERY_RUN: usize = 2;

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
/// Between two looks at the link.
const LOOK: Duration = Duration::from_millis(50);

fn scenario(row: &Row, shape: Shape) -> anyhow::Result<Scenario> {
    let edge = Flow {
        limit_mbps: row.limit_mbps,
        bandwidth: match row.sharing {
            Sharing::Paper => "share: paper",
            Sharing::Fair => "share: fair",
        },
        keys: Box::leak(format!("compression: {{ {} }}", row.compression).into_boxed_str()),
        ..flow("edge", "robot-1", "redis", None, &["cloud-1"])
    };
    let cameras = cameras()?;
    let publishes = |name, streams| service(name, "robot-1", "redis", streams);
    Ok(Scenario {
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
            publishes("driver", small()),
            publishes("front", vec![cameras[0].clone()]),
            publishes("rear", vec![cameras[1].clone()]),
        ],
        consumers: vec![
            service("recorder", "cloud-1", "kafka", small()),
            service("viewer", "cloud-1", "kafka", cameras),
        ],
        faults: vec![],
        duration: Duration::ZERO,
        settle: Duration::ZERO,
        expect: vec![],
    })
}

fn shape(row: &Row) -> Shape {
    Shape {
        rate: Some(row.link_mbit * 1_000_000),
        ..Shape::to_cloud()
    }
}

fn allocation(running: &Running) -> anyhow::Result<Value> {
    running.flow("robot-1")?.admin().json("/v1/allocation")
}

fn of_topic<'a>(allocation: &'a Value, topic: &str) -> &'a Value {
    let topics = allocation["topics"].as_array().map(Vec::as_slice).unwrap_or_default();
    topics.iter().find(|row| row["topic"] == topic).unwrap_or(&Value::Null)
}

/// The rates of F9 on what the wire factor leaves of the limit, of payloads as large as the flow says that it sends them.
fn reckoned(row: &Row, wire_factor: f64, allocation: &Value) -> anyhow::Result<Vec<(Stream, f64)>> {
    let cloud: LayerName = "cloud".parse()?;
    let streams: Vec<Stream> = small().into_iter().chain(cameras()?).collect();
    let demand = |stream: &Stream| Demand {
        topic: stream.topic,
        size_bytes: if row.is_compressed() {
            of_topic(allocation, stream.topic)["size_bytes"].as_u64().unwrap_or(0)
        } else {
            stream.bytes as u64
        },
        advertised_hz: stream.hz,
        class: None,
        lanes: vec![LaneDemand {
            layer: &cloud,
            max_rate_hz: None,
        }],
    };
    let demands: Vec<Demand<'_>> = streams.iter().map(demand).collect();
    let budgets = Budgets {
        process: row.budget() / wire_factor,
        links: BTreeMap::new(),
    };
    let terms = Terms {
        sharing: row.sharing,
        ..Terms::default()
    };
    let topics = rates(&budgets, &terms, &demands).topics;
    Ok(streams.into_iter().zip(topics).map(|(stream, rates)| (stream, rates.lanes_hz[0])).collect())
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
        (Some(first), Some(last)) if last.0 > first.0 => (last.1 - first.1) as f64 / (last.0 - first.0).as_secs_f64(),
        _ => 0.0,
    };
    (busiest, mean)
}

/// What was seen of the link while a row was played.
struct Seen {
    busiest: f64,
    mean: f64,
    wire_factor: f64,
    lost_on_the_way: u64,
    /// Processor time of the robot's flow, per second.
    processor: f64,
    routes: Vec<Route>,
}

/// Looks at the link for a while.
fn look(running: &Running) -> anyhow::Result<Seen> {
    let link = running.link("robot-1", "cloud-1")?;
    let (since, begin, before) = (running.now(), Instant::now(), link.stats()?);
    let cpu = running.flow("robot-1")?.cpu()?;
    let (mut samples, mut factors) = (Vec::new(), Vec::new());
    while begin.elapsed() < measured() {
        samples.push((Instant::now(), link.stats()?.forward.taken.bytes));
        factors.extend(allocation(running)?["wire_factor"].as_f64());
        std::thread::sleep(LOOK);
    }
    let (busiest, mean) = per_second(&samples);
    let after = link.stats()?;
    let consumers = small().into_iter().map(|stream| ("recorder", stream));
    let consumers = consumers.chain(cameras()?.into_iter().map(|stream| ("viewer", stream)));
    let routes = consumers.map(|(consumer, stream)| running.route(consumer, stream.topic, &since));
    Ok(Seen {
        busiest,
        mean,
        wire_factor: factors.iter().sum::<f64>() / factors.len().max(1) as f64,
        lost_on_the_way: after.forward.dropped.total().packets - before.forward.dropped.total().packets,
        processor: (running.flow("robot-1")?.cpu()? - cpu).as_secs_f64() / begin.elapsed().as_secs_f64(),
        routes: routes.collect::<anyhow::Result<_>>()?,
    })
}

fn play(row: &Row) -> anyhow::Result<()> {
    let running = Running::start(&scenario(row, shape(row))?)?;
    running.wait_flowing()?;
    // How long rates take to settle is no part of what is measured.
    std::thread::sleep(SETTLE);
    let seen = look(&running)?;
    let allocation = allocation(&running)?;
    let budget = row.budget();
    println!(
        "{}: limit {:.1} Mbit/s; busiest second {:.1} %, mean {:.1} %, wire factor {:.4}; {} packets lost on the way; \
         processor {:.2}",
        row.name,
        budget * 8.0 / 1e6,
        100.0 * seen.busiest / budget,
        100.0 * seen.mean / budget,
        seen.wire_factor,
        seen.lost_on_the_way,
        seen.processor,
    );
    let mut faults = Vec::new();
    let mut expect = |holds: bool, what: String| {
        if !holds {
            faults.push(what);
        }
    };
    expect(
        seen.busiest <= budget * METER_SLACK,
        format!("{:.0} of {budget:.0} bytes in a second", seen.busiest),
    );
    expect(
        row.reported || seen.mean >= budget * USED,
        format!("only {:.0} of {budget:.0} bytes a second", seen.mean),
    );
    for ((stream, hz), route) in reckoned(row, seen.wire_factor, &allocation)?.iter().zip(&seen.routes) {
        let topic = stream.topic;
        let got = route.rate_hz();
        let compression = &of_topic(&allocation, topic)["compression"];
        println!(
            "  {topic:<34} reckoned {hz:>6.2} Hz, got {got:>6.2} Hz; lost {:>3}, p50 {:>6.1} ms, p99 {:>6.1} ms {}",
            route.lost,
            route.latency_ms(0.5).unwrap_or_default(),
            route.latency_ms(0.99).unwrap_or_default(),
            if compression.is_null() { String::new() } else { compression.to_string() },
        );
        // A message more or less may fall into the time that is looked at.
        let edge = 1.0 / route.seconds.max(1) as f64;
        if stream.bytes == IMAGE {
            expect(
                row.reported || (got - hz).abs() <= IMAGE_RATE * hz + edge,
                format!("{topic}: {got:.2} Hz instead of {hz:.2}"),
            );
        } else {
            let all = (route.received + route.lost) as f64;
            expect(
                route.received as f64 >= SMALL * all
                    && got >= SMALL * stream.hz - edge
                    && route.duplicated == 0
                    && route.reordered == 0,
                format!("{topic} at {got:.2} Hz: {route}"),
            );
        }
    }
    anyhow::ensure!(faults.is_empty(), "{}: {}\n{}", row.name, faults.join("; "), running.tails());
    Ok(())
}

#[test]
fn small_topics_keep_their_rate_and_images_get_what_is_left() -> anyhow::Result<()> {
    let _turn = turn();
    let rows = if long() { ROWS.len() } else { OF_EVERY_RUN };
    ROWS[..rows].iter().try_for_each(play)
}

/// The true rate falls to a quarter of the limit, and comes back.
#[test]
fn the_rate_follows_what_the_link_carries() -> anyhow::Result<()> {
    const NARROWED: u64 = 10_000_000;
    let _turn = turn();
    let running = Running::start(&scenario(&NARROW, shape(&NARROW))?)?;
    running.wait_flowing()?;
    std::thread::sleep(SETTLE);
    let link = running.link("robot-1", "cloud-1")?;
    link.set(Ways::Both, &[Change::Rate(Some(NARROWED))])?;
    // From five seconds on the queue before the narrow place holds at most a tenth of a second.
    std::thread::sleep(Duration::from_secs(5));
    let (begin, mut longest) = (Instant::now(), 0.0f64);
    while begin.elapsed() < measured() {
        let waiting = link.stats()?.forward.queue.bytes as f64;
        longest = longest.max(waiting * 8.0 / NARROWED as f64 * 1e3);
        std::thread::sleep(Duration::from_millis(20));
    }
    let narrow = allocation(&running)?;
    link.set(Ways::Both, &[Change::Rate(Some(NARROW.link_mbit * 1_000_000))])?;
    let (begin, mut back) = (Instant::now(), None);
    let mut last = (Instant::now(), link.stats()?.forward.taken.bytes);
    while begin.elapsed() < Duration::from_secs(30) && back.is_none() {
        std::thread::sleep(Duration::from_secs(1));
        let now = (Instant::now(), link.stats()?.forward.taken.bytes);
        let rate = (now.1 - last.1) as f64 / (now.0 - last.0).as_secs_f64();
        if rate >= 0.9 * NARROW.budget() {
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

/// How fast a change of the node file is in effect.
const IN_EFFECT: Duration = Duration::from_secs(1);

/// Another limit in the node file of a running flow: the rates follow, and no small message is lost.
#[test]
fn the_limit_changes_while_the_flow_runs() -> anyhow::Result<()> {
    let _turn = turn();
    let limits = if long() { [160.0, 40.0, 160.0] } else { [40.0, 10.0, 40.0] };
    let row = Row {
        limit_mbps: limits[0],
        ..FULL
    };
    let wide = Shape {
        rate: None,
        ..Shape::to_cloud()
    };
    let mut running = Running::start(&scenario(&row, wide)?)?;
    running.wait_flowing()?;
    std::thread::sleep(SETTLE);
    let process = running.flow("robot-1")?.id();
    let since = running.now();
    for limit in &limits[1..] {
        let front = of_topic(&allocation(&running)?, FRONT)["lanes"][0]["allocated_hz"].as_f64();
        let begun = Instant::now();
        running.edit("robot-1", |spec| spec.limit_mbps = *limit)?;
        let mut seen = Value::Null;
        wait::until(
            &format!("limit_mbps {limit} is in effect"),
            IN_EFFECT,
            || {
                seen = allocation(&running).unwrap_or_default();
                let rate = of_topic(&seen, FRONT)["lanes"][0]["allocated_hz"].as_f64();
                seen["limit_mbps"] == *limit && rate.is_some() && rate != front
            },
            || running.tails(),
        )?;
        let rate = of_topic(&seen, FRONT)["lanes"][0]["allocated_hz"].clone();
        println!("limit_mbps {limit}: in effect after {:.0?}, {FRONT} from {front:?} to {rate} Hz", begun.elapsed());
        // Then the traffic keeps to it.
        let link = running.link("robot-1", "cloud-1")?;
        std::thread::sleep(IN_EFFECT);
        let (begin, before) = (Instant::now(), link.stats()?.forward.taken.bytes);
        std::thread::sleep(measured() / 4);
        let rate = (link.stats()?.forward.taken.bytes - before) as f64 / begin.elapsed().as_secs_f64();
        let budget = limit * 1_048_576.0 / 8.0;
        println!("  {:.1} % of it on the wire", 100.0 * rate / budget);
        anyhow::ensure!(rate <= budget * METER_SLACK, "{rate:.0} of {budget:.0} bytes a second");
    }
    anyhow::ensure!(running.flow("robot-1")?.id() == process, "it was started again");
    for stream in small() {
        let route = running.route("recorder", stream.topic, &since)?;
        anyhow::ensure!(
            route.lost == 0 && route.duplicated == 0 && route.reordered == 0,
            "{route}\n{}",
            running.tails()
        );
    }
    Ok(())
}

/// What saturating cameras add to the latency of small messages, over a link of 25 ms without jitter. The bar is for a machine that has
/// nothing else to do.
#[test]
fn small_messages_do_not_wait_behind_images() -> anyhow::Result<()> {
    const ADDED: Duration = Duration::from_millis(2);
    let _turn = turn();
    let steady = Shape {
        jitter: Duration::ZERO,
        loss: 0.0,
        ..shape(&NARROW)
    };
    // A part of an image on the wire: what a small message may find before it.
    let chunk = Duration::from_secs_f64(f64::from(steady.mtu) * 8.0 / (NARROW.link_mbit as f64 * 1e6));
    let mut p99 = Vec::new();
    for cameras in [false, true] {
        let mut scenario = scenario(&NARROW, steady)?;
        if !cameras {
            scenario.publishers.truncate(1);
            scenario.consumers.truncate(1);
        }
        let running = Running::start(&scenario)?;
        running.wait_flowing()?;
        std::thread::sleep(SETTLE);
        let since = running.now();
        std::thread::sleep(measured());
        let mut latencies = Vec::new();
        for stream in small() {
            latencies.extend(running.route("recorder", stream.topic, &since)?.latencies_ms);
        }
        latencies.sort_by(f64::total_cmp);
        let route = Route {
            latencies_ms: latencies,
            ..Route::default()
        };
        p99.push(route.latency_ms(0.99).context("nothing arrived")?);
    }
    let (without, with) = (p99[0], p99[1]);
    println!(
        "p99 of small messages: {without:.2} ms without cameras, {with:.2} ms beside them; allowed {:.2} ms more",
        (ADDED + chunk).as_secs_f64() * 1e3
    );
    if long() {
        anyhow::ensure!(with - without <= (ADDED + chunk).as_secs_f64() * 1e3, "{:.2} ms more", with - without);
    }
    Ok(())
}
