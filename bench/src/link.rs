//! What a limited link carries and how late small messages are, with two cameras that ask for more
//! than it takes: a robot on Redis, a cloud on Kafka (for latencies: Redis), the emulated link
//! between them. Beside it in the same run plain UDP over the same link: packets of the same rate,
//! and echoes of small ones without and beside them.
//!
//! ```text
//! probe ─► Redis ─► blaze-flow ─► emulated link ─► blaze-flow ─► Kafka ─► probe
//! socket ──────────────────────► emulated link ──────────────────────────► socket
//! ```
//!
//! Needs root, and is meant for release builds:
//! `cargo build --release --workspace && target/release/blaze-bench link`.

use std::time::Duration;

use anyhow::Context as _;
use blaze_flow::limit::pacer::allocated;
use blaze_tests::network::udp::{Reading, Sink, ping, socket};
use blaze_tests::network::{Plan, Topology};
use blaze_tests::scenario::budget::{
    COMPUTED, FRONT, FULL, NARROW, REAR, ROWS, Row, SETTLE, Seen, look_at_settled, p99_of_small,
    reckoned, scenario, shape, steady,
};
use blaze_tests::scenario::{Route, Running};
use clap::Parser;

/// Measures what a limited link carries, and what cameras add to the latency of small messages.
#[derive(Parser)]
pub(crate) struct Arguments {
    /// Seconds per measurement
    #[arg(long, default_value_t = 30)]
    seconds: u64,
    /// Only rows whose name contains this
    #[arg(long, default_value = "")]
    only: String,
    /// How often latencies are measured; each try is printed
    #[arg(long, default_value_t = 3)]
    tries: usize,
}

/// Payload of a packet of plain UDP, and the headers of IPv4 and UDP.
const PAYLOAD: usize = 1_272;
const HEADERS: usize = 28;
/// Until packets have crossed the link both ways and its queue is as it stays.
const UNDER_WAY: Duration = Duration::from_secs(1);
/// Time from one echo to the next on a link without a queue: its delay both ways. Where echoes take
/// longer, the last of them come when the other packets have ended: plain UDP looks better then.
const ECHO: Duration = Duration::from_millis(52);

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let time = Duration::from_secs(arguments.seconds);
    println!(
        "{:<26} {:>7} {:>8} {:>9} {:>8} {:>8} {:>8} {:>9} {:>9} {:>8}",
        "ROW",
        "FLOW/%",
        "BUSIEST",
        "UDP/%",
        "FRONT/Hz",
        "of",
        "REAR/Hz",
        "of",
        "CPU/core",
        "ms/IMAGE"
    );
    for row in ROWS.iter().chain(&COMPUTED).filter(|row| row.name.contains(&arguments.only)) {
        rates(row, time)?;
    }
    println!("\n{:<26} {:>12} {:>9} {:>9}", "p99/ms OF SMALL MESSAGES", "ALONE", "BESIDE", "ADDED");
    for row in [&NARROW, &FULL].into_iter().filter(|row| row.name.contains(&arguments.only)) {
        for _ in 0..arguments.tries {
            latencies(row, time)?;
        }
    }
    Ok(())
}

/// One row: shares of the limit, and the rates of images beside those of the allocation.
fn rates(row: &Row, time: Duration) -> anyhow::Result<()> {
    let (seen, expected) = flow_rates(row, time)?;
    let plain = plain_share(row, time)?;
    let budget = row.budget();
    print!(
        "{:<26} {:>7.1} {:>8.1} {plain:>9.1}",
        row.name,
        100.0 * seen.mean / budget,
        100.0 * seen.busiest / budget,
    );
    for (topic, width) in [(FRONT, 8), (REAR, 9)] {
        let index = seen.routes.iter().position(|route| route.topic == topic);
        let index = index.with_context(|| format!("{topic} is missing"))?;
        let (got, of) = (seen.routes[index].rate_hz(), expected[index]);
        print!(" {got:>8.2} {of:>width$.2}");
    }
    println!(" {:>9.2} {:>8.1}", seen.processor, seen.processor_per_image().as_secs_f64() * 1e3);
    Ok(())
}

fn flow_rates(row: &Row, time: Duration) -> anyhow::Result<(Seen, Vec<f64>)> {
    let running = Running::start(&scenario(row, shape(row))?)?;
    running.wait_flowing()?;
    std::thread::sleep(SETTLE);
    let (seen, allocation) = look_at_settled(row, &running, time)?;
    let expected = reckoned(row, allocated(row.budget()), seen.wire_factor, &allocation)?;
    Ok((seen, expected))
}

/// Percent of a row's limit that packets of plain UDP at exactly that rate bring over its link.
fn plain_share(row: &Row, time: Duration) -> anyhow::Result<f64> {
    let network = Topology::build(&Plan::two_hosts("robot-1", "cloud-1", shape(row)))?;
    let (robot, cloud) = (network.host("robot-1")?, network.host("cloud-1")?);
    let (from, sink) = (socket(robot)?, Sink::start(cloud, false)?);
    let link = network.link("robot-1", "cloud-1")?;
    std::thread::scope(|scope| {
        let sender = scope.spawn(|| at_limit(row, &from, &sink, time + 2 * UNDER_WAY));
        std::thread::sleep(UNDER_WAY);
        let begin = Reading::of(&link)?;
        std::thread::sleep(time);
        let rate = begin.rate_to(&Reading::of(&link)?);
        sender.join().map_err(|_| anyhow::anyhow!("the sender panicked"))??;
        Ok(100.0 * rate / row.budget())
    })
}

/// Sends at a row's limit for so long.
fn at_limit(
    row: &Row,
    from: &std::net::UdpSocket,
    sink: &Sink,
    time: Duration,
) -> anyhow::Result<()> {
    let packets_per_s = row.budget() / (PAYLOAD + HEADERS) as f64;
    let count = (packets_per_s * time.as_secs_f64()) as u64;
    sink.send(from, count, PAYLOAD, Duration::from_secs_f64(1.0 / packets_per_s))
}

/// What saturating cameras add to the latency of small messages, and what packets at the limit add
/// to the round trip of small packets of plain UDP.
fn latencies(row: &Row, time: Duration) -> anyhow::Result<()> {
    let print = |name: String, alone: f64, beside: f64| {
        println!("{name:<26} {alone:>12.2} {beside:>9.2} {:>9.2}", beside - alone);
    };
    let (alone, beside) = (p99_of_small(row, false, time)?, p99_of_small(row, true, time)?);
    print(format!("{}, flow", row.name), alone, beside);
    let (alone, beside) = (echoes(row, false, time)?, echoes(row, true, time)?);
    print(format!("{}, plain UDP", row.name), alone, beside);
    Ok(())
}

/// The 99th percentile of the round trip of small packets in milliseconds.
fn echoes(row: &Row, beside: bool, time: Duration) -> anyhow::Result<f64> {
    let network = Topology::build(&Plan::two_hosts("robot-1", "cloud-1", steady(row)))?;
    let (robot, cloud) = (network.host("robot-1")?, network.host("cloud-1")?);
    let (from, echo) = (socket(robot)?, Sink::start(cloud, true)?);
    let (bulk, sink) = (socket(robot)?, Sink::start(cloud, false)?);
    let count = time.div_duration_f64(ECHO) as usize;
    let trips = std::thread::scope(|scope| {
        let sender = scope.spawn(|| {
            if beside { at_limit(row, &bulk, &sink, time + 2 * UNDER_WAY) } else { Ok(()) }
        });
        std::thread::sleep(UNDER_WAY);
        let trips = ping(&from, &echo, count)?;
        sender.join().map_err(|_| anyhow::anyhow!("the sender panicked"))??;
        anyhow::Ok(trips)
    })?;
    let latencies_ms = trips.iter().map(|trip| trip.as_secs_f64() * 1e3).collect();
    let route = Route { latencies_ms, ..Route::default() };
    route.latency_ms(0.99).context("no echo came back")
}
