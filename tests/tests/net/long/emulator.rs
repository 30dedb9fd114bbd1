//! `blaze-wan` measured from outside, between two namespaces.

use std::time::{Duration, Instant};

use blaze_tests::network::udp::{Sink, ping, socket};
use blaze_tests::network::{Plan, Topology};
use blaze_tests::wan::{Change, Shape, Ways};
use blaze_tests::{long, wait};

use crate::support::{reaches, received_bytes};

const MS: Duration = Duration::from_millis(1);
/// Where packets must arrive that are on the way.
const SOON: Duration = Duration::from_secs(5);
/// IPv4 and UDP headers.
const HEADERS: u64 = 28;

fn two(forward: Shape, back: Shape) -> anyhow::Result<Topology> {
    let plan = Plan::new().with_hosts(&["a", "b"]).with_asymmetric_link("a", "b", forward, back);
    Topology::build(&plan)
}

#[test]
fn a_round_trip_takes_both_delays() -> anyhow::Result<()> {
    let shape = Shape::default().with(Change::Delay(25 * MS));
    let network = two(shape, shape)?;
    let (from, echo) = (socket(network.host("a")?)?, Sink::start(network.host("b")?, true)?);
    let trips = ping(&from, &echo, if long() { 400 } else { 60 })?;
    let p50 = trips[trips.len() / 2];
    assert!((50 * MS..=52 * MS).contains(&p50), "{p50:?}");
    assert!(trips[0] >= 50 * MS, "none is faster than the delays");
    Ok(())
}

/// Sends twice the rate for some seconds and compares what comes out, by both counters, with the
/// rate. Gives the two shares of the rate.
fn blast(rate: u64) -> anyhow::Result<[f64; 2]> {
    const PAYLOAD: usize = 1_372;
    let shape = Shape {
        rate: Some(rate),
        // 0.3 s: longer than the sender waits for the processor on a busy machine, so that the link
        // is never idle.
        queue: rate * 3 / 80,
        delay: 25 * MS,
        ..Shape::default()
    };
    let network = two(shape, Shape::default())?;
    let (from, sink) = (socket(network.host("a")?)?, Sink::start(network.host("b")?, false)?);
    let link = network.link("a", "b")?;
    let seconds = if long() { 20 } else { 4 };
    let packets_per_s = 2 * rate / 8 / (PAYLOAD as u64 + HEADERS);
    let gap = Duration::from_secs_f64(1.0 / packets_per_s as f64);
    let measured = std::thread::scope(|scope| -> anyhow::Result<_> {
        let sender = scope.spawn(|| sink.send(&from, (seconds + 1) * packets_per_s, PAYLOAD, gap));
        // From when the queue is full on.
        let full = || link.stats().is_ok_and(|stats| stats.forward.dropped.queue.packets > 100);
        wait::until("a full queue", SOON, full, || format!("{:?}", link.stats()))?;
        let look = || {
            anyhow::Ok((
                Instant::now(),
                link.stats()?.forward.out.bytes,
                received_bytes(network.host("b")?, "w0")?,
            ))
        };
        let before = look()?;
        std::thread::sleep(Duration::from_secs(seconds - 1));
        let after = look()?;
        sender.join().map_err(|_| anyhow::anyhow!("the sender panicked"))??;
        let span = (after.0 - before.0).as_secs_f64();
        Ok([after.1 - before.1, after.2 - before.2].map(|bytes| bytes as f64 * 8.0 / span))
    })?;
    let stats = link.stats()?.forward;
    let shares = measured.map(|bits| bits / rate as f64);
    println!(
        "twice {rate} bit/s: {shares:?} of it leaves the emulator and enters the host; {stats:?}"
    );
    assert_eq!(stats.taken, stats.out + stats.dropped.total() + stats.queue + stats.flying);
    Ok(shares)
}

/// Two attempts may fail: a machine that keeps the sender or the emulator from the processor for
/// longer than the queue lasts leaves the link idle, and one that does so between clock and counter
/// measures something else. That the rate is never exceeded is shown without a machine in the tests
/// of the direction.
#[test]
fn the_rate_cuts_a_blast_to_size() -> anyhow::Result<()> {
    for rate in [10_000_000, 160_000_000] {
        let mut attempts = Vec::new();
        let exact = |shares: &[f64; 2]| shares.iter().all(|share| (0.97..=1.03).contains(share));
        while attempts.len() < 3 && !attempts.last().is_some_and(exact) {
            attempts.push(blast(rate)?);
        }
        assert!(attempts.last().is_some_and(exact), "{attempts:?} of {rate} bit/s");
    }
    Ok(())
}

#[test]
fn a_cut_is_one_way_or_both_and_heals() -> anyhow::Result<()> {
    let network = two(Shape::default(), Shape::default())?;
    let (a, b) = (network.host("a")?, network.host("b")?);
    let link = network.link("a", "b")?;
    let reach = || -> anyhow::Result<(bool, bool)> {
        Ok((reaches(a, b)?.is_some(), reaches(b, a)?.is_some()))
    };
    assert_eq!(reach()?, (true, true));
    link.cut(Ways::Forward)?;
    assert_eq!(reach()?, (false, true));
    link.heal(Ways::Forward)?;
    // Seen from the other end, forward is the other way.
    let other = network.link("b", "a")?;
    other.cut(Ways::Forward)?;
    assert_eq!(reach()?, (true, false));
    link.cut(Ways::Both)?;
    assert_eq!(reach()?, (false, false));
    link.heal(Ways::Both)?;
    assert_eq!(reach()?, (true, true));
    let stats = link.stats()?;
    let cut = (stats.forward.dropped.cut.packets, stats.back.dropped.cut.packets);
    assert_eq!(cut, (2, 2), "{stats:?}");
    Ok(())
}
