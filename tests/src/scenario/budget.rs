//! A robot with six small topics and two cameras that ask for more than its link may carry: what is
//! played, what the allocator gives each topic of it, and what is seen of the link.

use std::io::Write as _;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_cli::demo::camera::Pictures;
use blaze_cli::demo::recording::{Body, load_built_in};
use blaze_domain::LayerName;
use blaze_flow::limit::allocate::{Sharing, Terms};
use blaze_flow::limit::rates::{Budgets, Demand, LaneDemand, rates};
use serde_json::Value;

use super::parts::{CAMERA, IMU, ODOMETRY, flow, one_link, service, stream};
use super::{BrokerKind, Flow, Route, Running, Scenario, Stream};
use crate::network::udp::{Reading, busiest};
use crate::wan::Shape;

/// One camera.
pub const FRONT: &str = "camera/front";
/// The other.
pub const REAR: &str = "camera/rear";
/// 640 × 480 RGB, as it comes from the driver.
pub const IMAGE: usize = 921_600;
const IMAGE_HZ: f64 = 30.0;
/// Pictures of the recording that are published in turn.
const PICTURES: usize = 60;

/// The small topics of a Jackal with the rates at which it publishes them.
#[must_use]
pub fn small() -> Vec<Stream> {
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

/// All of them, small ones first.
///
/// # Errors
/// When the pictures cannot be written to a file.
pub fn streams() -> anyhow::Result<Vec<Stream>> {
    Ok(small().into_iter().chain(cameras()?).collect())
}

/// The service that requests a topic.
#[must_use]
pub fn consumer(stream: &Stream) -> &'static str {
    if stream.bytes == IMAGE { "viewer" } else { "recorder" }
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
    for recording in load_built_in(Pictures::Rgb)? {
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

/// A link, a limit, sharing and compression.
#[derive(Debug, Clone, Copy)]
pub struct Row {
    /// For the report.
    pub name: &'static str,
    /// The link's rate in Mbit/s of 1000² bit.
    pub link_mbit: u64,
    /// `limit_mbps`, in units of 1024² bit/s.
    pub limit_mbps: f64,
    /// How images share what small topics leave.
    pub sharing: Sharing,
    /// What stands in `flow.compression`.
    pub compression: &'static str,
}

impl Row {
    const fn new(name: &'static str, link_mbit: u64, limit_mbps: f64) -> Self {
        Self { name, link_mbit, limit_mbps, sharing: Sharing::Paper, compression: "codec: none" }
    }

    const fn fair(self) -> Self {
        Self { sharing: Sharing::Fair, ..self }
    }

    const fn compressed(self, compression: &'static str) -> Self {
        Self { compression, ..self }
    }

    fn is_compressed(&self) -> bool {
        self.compression != "codec: none"
    }

    /// Wire bytes per second.
    #[must_use]
    pub fn budget(&self) -> f64 {
        self.limit_mbps * 1_048_576.0 / 8.0
    }
}

/// Most of the link of the paper.
pub const FULL: Row = Row::new("160 Mbit/s", 160, 150.0);
/// A narrow one.
pub const NARROW: Row = Row::new("40 Mbit/s", 40, 37.0);

/// Rows limited by the link.
pub const ROWS: [Row; 8] = [
    NARROW,
    Row::new("40 Mbit/s, LZ4 adaptive", 40, 37.0).compressed("level: 10"),
    Row::new("40 Mbit/s, fair", 40, 37.0).fair(),
    Row::new("40 Mbit/s, LZ4 level 1", 40, 37.0).compressed("level: 1, adaptive: false"),
    Row::new("40 Mbit/s, LZ4 level 9", 40, 37.0).compressed("level: 9, adaptive: false"),
    Row::new("40 Mbit/s, LZ4 level 10", 40, 37.0).compressed("level: 10, adaptive: false"),
    FULL,
    Row::new("160 Mbit/s, fair", 160, 150.0).fair(),
];
/// Rows limited by how fast two cores compress, not by the link.
pub const COMPUTED: [Row; 2] = [
    Row::new("160 Mbit/s, LZ4 level 9", 160, 150.0).compressed("level: 9, adaptive: false"),
    Row::new("160 Mbit/s, LZ4 level 10", 160, 150.0).compressed("level: 10, adaptive: false"),
];

/// Until rates, sizes and the wire factor have settled.
pub const SETTLE: Duration = Duration::from_secs(8);
/// Rates of images may differ from what was reckoned by this share.
pub const IMAGE_RATE: f64 = 0.03;
/// Between two looks at the link.
const LOOK: Duration = Duration::from_millis(50);

/// The robot of a row, and a cloud on Kafka.
///
/// # Errors
/// As [`streams`].
pub fn scenario(row: &Row, shape: Shape) -> anyhow::Result<Scenario> {
    scenario_on(row, shape, BrokerKind::Kafka)
}

/// With this broker in the cloud.
///
/// # Errors
/// As [`streams`].
pub fn scenario_on(row: &Row, shape: Shape, cloud: BrokerKind) -> anyhow::Result<Scenario> {
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
        flows: vec![edge, flow("cloud", "cloud-1", "cloud-broker", None, &[])],
        publishers: vec![
            publishes("driver", small()),
            publishes("front", vec![cameras[0].clone()]),
            publishes("rear", vec![cameras[1].clone()]),
        ],
        consumers: vec![
            service("recorder", "cloud-1", "cloud-broker", small()),
            service("viewer", "cloud-1", "cloud-broker", cameras),
        ],
        ..one_link(shape, cloud, row.limit_mbps, Vec::new())
    })
}

/// The link of a row.
#[must_use]
pub fn shape(row: &Row) -> Shape {
    let rate = row.link_mbit * 1_000_000;
    // The emulator shares the processors with what it measures: where it comes late, all that has
    // waited for it comes at once. 50 ms hold it; a narrower place would make a loss of it, and the
    // flow would rightly slow down.
    Shape { rate: Some(rate), queue: rate / 8 / 20, ..Shape::to_cloud() }
}

/// The same without jitter and loss.
#[must_use]
pub fn steady(row: &Row) -> Shape {
    Shape { jitter: Duration::ZERO, loss: 0.0, ..shape(row) }
}

/// What the robot's flow says of its budget.
///
/// # Errors
/// When it does not answer.
pub fn allocation(running: &Running) -> anyhow::Result<Value> {
    running.flow("robot-1")?.admin().json("/v1/allocation")
}

/// The part of it for one topic.
#[must_use]
pub fn of_topic<'a>(allocation: &'a Value, topic: &str) -> &'a Value {
    let topics = allocation["topics"].as_array().map(Vec::as_slice).unwrap_or_default();
    topics.iter().find(|row| row["topic"] == topic).unwrap_or(&Value::Null)
}

/// `s` of a topic: as it is published, or as large as the flow says that it sends it.
fn size(row: &Row, allocation: &Value, stream: &Stream) -> u64 {
    if row.is_compressed() {
        of_topic(allocation, stream.topic)["size_bytes"].as_u64().unwrap_or(0)
    } else {
        stream.bytes as u64
    }
}

/// The rates of the allocation on what ω leaves of so many wire bytes per second.
///
/// # Errors
/// As [`streams`].
pub fn reckoned(
    row: &Row,
    wire_bytes_per_s: f64,
    wire_factor: f64,
    allocation: &Value,
) -> anyhow::Result<Vec<f64>> {
    let cloud: LayerName = "cloud".parse()?;
    let streams = streams()?;
    let demand = |stream: &Stream| Demand {
        topic: stream.topic,
        size_bytes: size(row, allocation, stream),
        advertised_hz: stream.hz,
        class: None,
        lanes: vec![LaneDemand { layer: &cloud, receiver: None, max_rate_hz: None }],
    };
    let demands: Vec<Demand<'_>> = streams.iter().map(demand).collect();
    let budgets = Budgets { process: wire_bytes_per_s / wire_factor, ..Budgets::default() };
    let terms = Terms { sharing: row.sharing, ..Terms::default() };
    let topics = rates(&budgets, &terms, &demands).topics;
    Ok(topics.into_iter().map(|rates| rates.lanes_hz[0]).collect())
}

/// What was seen of the link while a row was played.
pub struct Seen {
    /// Wire bytes per second of the busiest second.
    pub busiest: f64,
    /// Wire bytes per second.
    pub mean: f64,
    /// ω: wire bytes as the emulator counts them for each byte of `s · α` of the messages that
    /// came, whatever the flow says.
    pub wire_factor: f64,
    /// Packets that the link dropped.
    pub lost_on_the_way: u64,
    /// Processor time of the robot's flow, per second.
    pub processor: f64,
    /// Of all streams.
    pub routes: Vec<Route>,
}

impl Seen {
    /// Processor time of the robot's flow for each image that came, with all that it does besides.
    #[must_use]
    pub fn processor_per_image(&self) -> Duration {
        let images =
            self.routes.iter().filter(|route| [FRONT, REAR].contains(&route.topic.as_str()));
        let hz: f64 = images.map(Route::rate_hz).sum();
        Duration::from_secs_f64(self.processor / hz.max(1e-3))
    }
}

/// Looks at the link for a while.
///
/// # Errors
/// When a process has ended.
pub fn look(row: &Row, running: &Running, time: Duration) -> anyhow::Result<Seen> {
    let link = running.link("robot-1", "cloud-1")?;
    let (since, begin, before) = (running.now(), Instant::now(), link.stats()?);
    let cpu = running.flow("robot-1")?.cpu()?;
    let mut readings = vec![Reading::of(&link)?];
    while begin.elapsed() < time {
        std::thread::sleep(LOOK);
        readings.push(Reading::of(&link)?);
    }
    let processor =
        (running.flow("robot-1")?.cpu()? - cpu).as_secs_f64() / begin.elapsed().as_secs_f64();
    let after = link.stats()?;
    let (streams, allocation) = (streams()?, allocation(running)?);
    let routes = streams.iter().map(|stream| running.route(consumer(stream), stream.topic, &since));
    let routes: Vec<Route> = routes.collect::<anyhow::Result<_>>()?;
    let mean = readings[0].rate_to(&readings[readings.len() - 1]);
    let reckoned = streams.iter().zip(&routes);
    let reckoned: f64 = reckoned
        .map(|(stream, route)| {
            route.rate_hz() * size(row, &allocation, stream) as f64 * Terms::default().overhead
        })
        .sum();
    Ok(Seen {
        busiest: busiest(&readings),
        mean,
        wire_factor: mean / reckoned.max(1.0),
        lost_on_the_way: after.forward.dropped.total().packets
            - before.forward.dropped.total().packets,
        processor,
        routes,
    })
}

/// Looks until no topic has grown meanwhile by what would show in the rates. Which picture is the
/// largest of a topic shows late where few of them pass and LZ4 makes each another size, and how
/// hard it tries depends on what the processor has to spare; who of two cameras is the larger one
/// decides who gets the rest.
///
/// # Errors
/// As [`look`], and when they still grow.
pub fn look_at_settled(
    row: &Row,
    running: &Running,
    time: Duration,
) -> anyhow::Result<(Seen, Value)> {
    const LOOKS: usize = 15;
    const GROWN: f64 = IMAGE_RATE / 6.0;
    let sizes = |allocation: &Value| -> anyhow::Result<[f64; 2]> {
        let of = |topic| {
            let size = &of_topic(allocation, topic)["size_bytes"];
            size.as_f64().with_context(|| format!("{topic}: no size, {size}"))
        };
        Ok([of(FRONT)?, of(REAR)?])
    };
    let is_settled = |before: [f64; 2], after: [f64; 2]| {
        let grown = before.iter().zip(after).map(|(before, after)| (after / before - 1.0).abs());
        grown.fold(0.0, f64::max) <= GROWN
            && before[0].total_cmp(&before[1]) == after[0].total_cmp(&after[1])
    };
    let mut before = sizes(&allocation(running)?)?;
    for _ in 0..LOOKS {
        let seen = look(row, running, time)?;
        let allocation = allocation(running)?;
        let after = sizes(&allocation)?;
        if is_settled(before, after) {
            return Ok((seen, allocation));
        }
        before = after;
    }
    anyhow::bail!("{}: sizes still grow: {before:?}", row.name)
}

/// The 99th percentile of the latency of all small messages in milliseconds, over a link of 25 ms
/// without jitter, alone or beside the cameras.
///
/// # Errors
/// As [`look`].
pub fn p99_of_small(row: &Row, beside_cameras: bool, time: Duration) -> anyhow::Result<f64> {
    // What Kafka does to small messages while it takes images, and on the cores that it shares
    // with the flows, is not the link's.
    let mut scenario = scenario_on(row, steady(row), BrokerKind::Redis)?;
    if !beside_cameras {
        scenario.publishers.truncate(1);
        scenario.consumers.truncate(1);
    }
    let running = Running::start(&scenario)?;
    running.wait_flowing()?;
    std::thread::sleep(SETTLE);
    let since = running.now();
    std::thread::sleep(time);
    let mut latencies = Vec::new();
    for stream in small() {
        latencies.extend(running.route("recorder", stream.topic, &since)?.latencies_ms);
    }
    latencies.sort_by(f64::total_cmp);
    let route = Route { latencies_ms: latencies, ..Route::default() };
    route.latency_ms(0.99).context("nothing arrived")
}
