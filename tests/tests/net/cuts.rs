//! A link that is cut for longer than the time after which a flow counts as down: one way, the
//! other way, and both.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_tests::flow::FlowProcess;
use blaze_tests::long;
use blaze_tests::network::udp::{Reading, busiest};
use blaze_tests::scenario::parts::{IMU, one_link, stream};
use blaze_tests::scenario::{BrokerKind, Running, Stream};
use blaze_tests::wan::{Shape, Ways};
use blaze_tests::{wait, within};
use serde_json::Value;

const EVENTS: &str = "robot/events";
const SCANS: &str = "robot/scans";
const LIMIT_MBPS: f64 = 20.0;
/// As `limit_mbps` is meant: 1024² bit.
const LIMIT_BYTES_PER_S: f64 = LIMIT_MBPS * 1_048_576.0 / 8.0;
/// Longer than the time after which a flow counts as down.
pub(super) const DOWN: Duration = Duration::from_secs(4);
/// Longer than the lease of a DDS participant, after which RustDDS has forgotten the other one.
const FORGOTTEN: Duration = Duration::from_secs(60);
/// By then what was on the way has arrived, and nobody counts as down yet.
const SETTLED: Duration = Duration::from_millis(1_500);
/// From the first Hello that gets through.
pub(super) const FLOWING: Duration = Duration::from_secs(1);
/// How long the link is watched after it is healed, at least.
fn watched() -> Duration {
    Duration::from_secs(if long() { 4 } else { 3 })
}
const IMU_LIFESPAN: Duration = Duration::from_secs(2);
const SCAN_LIFESPAN: Duration = Duration::from_millis(500);
/// From the link to the consumer's callback, on a busy machine; lifespans are the flows' business,
/// not the consumer's.
pub(super) const DELIVERY: Duration = Duration::from_millis(300);

/// Reliable ones with and without a lifespan, and more bulk than the limit allows.
fn streams() -> Vec<Stream> {
    vec![
        Stream { lifespan: IMU_LIFESPAN, ..stream(IMU, 50.0, 320) },
        stream(EVENTS, 5.0, 200),
        Stream { reliable: false, lifespan: SCAN_LIFESPAN, ..stream(SCANS, 50.0, 100_000) },
    ]
}

/// When one flow last heard of another.
fn heard(running: &Running, of: &str, other: &str) -> Option<Instant> {
    let now = Instant::now();
    let peers = running.flow(of).ok()?.admin().json("/v1/peers").ok()?;
    let peer = peers["peers"]
        .as_array()?
        .iter()
        .find(|peer| peer["flow"].as_str().is_some_and(|flow| flow.ends_with(other)))?;
    now.checked_sub(Duration::from_secs_f64(peer["last_heard_ms"].as_f64()? / 1e3))
}

/// Messages of each topic that the cloud has written to its Kafka.
pub(super) type Delivered = BTreeMap<String, u64>;

fn delivered(running: &Running) -> Delivered {
    let mut delivered = Delivered::new();
    for bridge in running.flow("cloud-1").map(FlowProcess::bridges).unwrap_or_default() {
        if let (Some(topic), Some(out)) =
            (bridge["topic"].as_str(), bridge["out"]["messages"].as_u64())
        {
            *delivered.entry(topic.to_owned()).or_default() += out;
        }
    }
    delivered
}

/// What the robot dropped of a topic, by reason.
pub(super) fn dropped(running: &Running, topic: &str) -> anyhow::Result<Value> {
    let bridges = running.flow("robot-1")?.bridges();
    let bridge = bridges.iter().find(|bridge| bridge["topic"] == topic);
    Ok(bridge.map(|bridge| bridge["dropped"].clone()).unwrap_or_default())
}

fn total(dropped: &Value) -> u64 {
    let reasons = dropped.as_object();
    reasons.map_or(0, |reasons| reasons.values().filter_map(Value::as_u64).sum())
}

/// Cuts the link for so long. Returns what had arrived by then.
pub(super) fn hold_cut(running: &Running, ways: Ways, time: Duration) -> anyhow::Result<Delivered> {
    let began = Instant::now();
    running.link("robot-1", "cloud-1")?.cut(ways)?;
    // Bridges that end are not listed, and come back with their counters.
    std::thread::sleep(SETTLED);
    let arrived = delivered(running);
    // The length of the cut is what is tested.
    std::thread::sleep(time.saturating_sub(began.elapsed()));
    println!("cut {ways:?} for {:.1?}", began.elapsed());
    Ok(arrived)
}

/// What is seen of the link and the flows after it is healed.
pub(super) struct Healed {
    /// When the first Hello came.
    pub(super) hello: Duration,
    /// When the first message of each topic did.
    pub(super) flowing: BTreeMap<&'static str, Duration>,
    /// Wire bytes per second of the busiest second.
    pub(super) busiest: f64,
}

/// Heals a link, and watches it until these topics flow again, and a while longer. `before`: what
/// arrived before it was cut.
pub(super) fn watch(
    running: &Running,
    ways: Ways,
    topics: &[&'static str],
    before: &Delivered,
) -> anyhow::Result<Healed> {
    let link = running.link("robot-1", "cloud-1")?;
    let healed = Instant::now();
    link.heal(ways)?;
    let (mut hello, mut flowing, mut readings) = (None, BTreeMap::new(), Vec::new());
    // Whoever heard nothing while the link was cut.
    let deaf: &[(&str, &str)] = match ways {
        Ways::Forward => &[("cloud-1", "robot-1")],
        Ways::Back => &[("robot-1", "cloud-1")],
        Ways::Both => &[("cloud-1", "robot-1"), ("robot-1", "cloud-1")],
    };
    wait::until(
        "the link was watched long enough",
        watched() * 3,
        || {
            readings.extend(Reading::of(&link));
            if hello.is_none() {
                let heard = deaf.iter().filter_map(|(of, other)| heard(running, of, other));
                hello = heard.filter(|at| *at > healed).min();
            }
            if flowing.len() < topics.len() {
                let (now, at) = (delivered(running), healed.elapsed());
                let come = topics.iter().filter(|topic| now.get(**topic) > before.get(**topic));
                for topic in come {
                    flowing.entry(*topic).or_insert(at);
                }
            }
            healed.elapsed() > watched() && hello.is_some() && flowing.len() == topics.len()
        },
        || {
            let silent: Vec<_> =
                topics.iter().map(|topic| (topic, dropped(running, topic))).collect();
            format!("{}\n{silent:?}", running.tails())
        },
    )?;
    Ok(Healed {
        hello: hello.map_or(Duration::MAX, |at| at.saturating_duration_since(healed)),
        flowing,
        busiest: busiest(&readings),
    })
}

fn cut(running: &Running, ways: Ways, time: Duration) -> anyhow::Result<()> {
    running.wait_flowing()?;
    let since = running.now();
    let before: Vec<u64> = [IMU, EVENTS, SCANS]
        .iter()
        .map(|topic| Ok(total(&dropped(running, topic)?)))
        .collect::<anyhow::Result<_>>()?;
    let arrived = hold_cut(running, ways, time)?;
    let healed = watch(running, ways, &[IMU], &arrived)?;
    let busiest = healed.busiest / LIMIT_BYTES_PER_S;
    println!(
        "  first Hello {:.0?} after it was healed, flowing {:.0?} after; busiest second {:.1} % of \
         the limit",
        healed.hello,
        healed.flowing[IMU],
        busiest * 100.0
    );
    anyhow::ensure!(healed.flowing[IMU] <= healed.hello + within(FLOWING), "{ways:?}: too late");
    anyhow::ensure!(busiest <= 1.0, "{ways:?}: more than the limit");
    for ((stream, before), lifespan) in
        streams().iter().zip(before).zip([Some(IMU_LIFESPAN), None, Some(SCAN_LIFESPAN)])
    {
        let topic = stream.topic;
        let (route, dropped) =
            (running.route("recorder", topic, &since)?, dropped(running, topic)?);
        println!("  {route}\n    dropped since the start {dropped}");
        anyhow::ensure!(
            route.duplicated == 0 && route.reordered == 0,
            "{ways:?}: twice or out of order: {route}"
        );
        // What is lost by the cut is counted where it was lost, with its reason.
        anyhow::ensure!(
            lifespan.is_none() || total(&dropped) > before,
            "{ways:?}: nothing of {topic} was dropped: {dropped}"
        );
        if let Some(lifespan) = lifespan {
            let oldest = route.latency_ms(1.0).unwrap_or_default();
            anyhow::ensure!(
                oldest <= (lifespan + within(DELIVERY)).as_secs_f64() * 1e3,
                "{ways:?}: {topic} of {oldest} ms arrived"
            );
        }
    }
    Ok(())
}

#[test]
fn a_link_that_is_cut_and_healed() -> anyhow::Result<()> {
    let scenario = one_link(Shape::to_cloud(), BrokerKind::Kafka, LIMIT_MBPS, streams());
    let running = Running::start(&scenario)?;
    cut(&running, Ways::Forward, DOWN)?;
    cut(&running, Ways::Both, DOWN)?;
    if long() {
        cut(&running, Ways::Back, DOWN)?;
        cut(&running, Ways::Forward, FORGOTTEN)?;
        cut(&running, Ways::Both, FORGOTTEN)?;
    }
    Ok(())
}
