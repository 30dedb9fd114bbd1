//! The whole system under a mixed load, with faults drawn from a seed, for as long as is wanted.
//! `scripts/soak` runs it alone.

use std::time::Duration;

use anyhow::Context as _;
use blaze_tests::long;
use blaze_tests::process::Usage;
use blaze_tests::scenario::{Expect, Fault, Scenario, run};
use blaze_tests::wan::{Change, Shape, Ways};
use rand::rngs::StdRng;
use rand::seq::IndexedRandom as _;
use rand::{RngExt as _, SeedableRng as _};

use crate::layers::{RELIABLE, three_layers};

const LINKS: [(&str, &str); 3] = [("edge", "fog"), ("edge", "cloud-1"), ("fog", "cloud-1")];
const FLOWS: [&str; 5] = ["robot-1", "robot-2", "fog-1", "fog-2", "cloud-1"];
const BROKERS: [&str; 4] = ["redis-1", "redis-2", "kafka-fog", "kafka-cloud"];
/// Before the first fault.
const CALM: Duration = Duration::from_secs(5);
/// After the last one: everything is back by then, and flows.
const QUIET: Duration = Duration::from_secs(20);
/// A flow or server may hold so much more in the end than once it was warm.
const GROWTH: Usage = Usage { resident_kib: 64 * 1024, threads: 6, descriptors: 24 };

/// From the environment, or what the gate runs.
#[allow(
    clippy::disallowed_methods,
    reason = "how long and with which faults a test runs is no configuration"
)]
fn setting(name: &str, otherwise: u64) -> anyhow::Result<u64> {
    match std::env::var(name) {
        Ok(text) => text.parse().with_context(|| format!("{name}={text} is no number")),
        Err(_) => Ok(otherwise),
    }
}

/// What breaks, and how it is mended after a while.
fn draw(random: &mut StdRng) -> anyhow::Result<(Fault, Duration, Option<Fault>)> {
    let ways = *[Ways::Forward, Ways::Back, Ways::Both].choose(random).context("ways")?;
    let (a, b) = *LINKS.choose(random).context("links")?;
    let flow = FLOWS.choose(random).context("flows")?;
    let broker = BROKERS.choose(random).context("brokers")?;
    let mut time = |from: u64, to: u64| Duration::from_millis(random.random_range(from..to));
    Ok(match time(0, 5).as_millis() {
        0 => (Fault::Cut(a, b, ways), time(200, 8_000), Some(Fault::Heal(a, b, ways))),
        1 => {
            let bad = vec![
                Change::Delay(Duration::from_millis(120)),
                Change::Loss(0.03),
                Change::Rate(Some(8_000_000)),
            ];
            let good = Shape::to_cloud().changes();
            (Fault::Set(a, b, ways, bad), time(1_000, 6_000), Some(Fault::Set(a, b, ways, good)))
        }
        2 => (Fault::KillFlow(flow), time(100, 4_000), Some(Fault::StartFlow(flow))),
        3 => (Fault::FreezeBroker(broker), time(200, 4_000), Some(Fault::ThawBroker(broker))),
        _ => (Fault::RestartBroker(broker), time(200, 1_000), None),
    })
}

/// Faults one after another, with pauses of a few seconds.
fn faults(seed: u64, duration: Duration) -> anyhow::Result<Vec<(Duration, Fault)>> {
    let mut random = StdRng::seed_from_u64(seed);
    let (mut at, mut faults) = (CALM, Vec::new());
    loop {
        let (fault, lasts, mended) = draw(&mut random)?;
        if at + lasts + QUIET > duration {
            return Ok(faults);
        }
        faults.push((at, fault));
        at += lasts;
        faults.extend(mended.map(|mended| (at, mended)));
        at += Duration::from_millis(random.random_range(2_000..8_000));
    }
}

#[test]
fn a_mixed_load_with_random_faults() -> anyhow::Result<()> {
    let seconds = setting("BLAZE_SOAK_SECONDS", if long() { 300 } else { 45 })?;
    let seed = setting("BLAZE_SOAK_SEED", 1)?;
    let duration = Duration::from_secs(seconds);
    let mut expect = vec![Expect::Balanced, Expect::Growth(GROWTH)];
    for (consumer, topic) in RELIABLE {
        expect.push(Expect::Alive(consumer, topic));
        expect.push(Expect::LostAtMost(consumer, topic, 1.0));
    }
    let scenario = Scenario {
        name: "a mixed load with faults",
        faults: faults(seed, duration)?,
        duration,
        expect,
        // The processor of a small machine is the limit, not the link.
        ..three_layers(5.0)
    };
    println!("seed {seed}, {seconds} s, {} faults:", scenario.faults.len());
    for (at, fault) in &scenario.faults {
        println!("  {:>7.1} s {fault:?}", at.as_secs_f64());
    }
    let begun = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH)?;
    println!("begun at {} s since 1970", begun.as_secs());
    let report = run(&scenario).with_context(|| format!("seed {seed}, {seconds} s"))?;
    println!("{report}");
    let checked = report.check(&scenario.expect);
    if checked.is_err() {
        println!("{}", report.tails);
    }
    checked.with_context(|| format!("seed {seed}, {seconds} s"))
}
