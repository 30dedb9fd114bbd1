//! `blaze-wan` measured from outside, between two namespaces.

use std::time::{Duration, Instant};

use blaze_tests::network::{Plan, Topology};
use blaze_tests::wan::{Change, Shape, Ways};
use blaze_tests::{long, wait};

use crate::support::{Sink, flights, percentile_ms, ping, received_bytes, socket};

const MS: Duration = Duration::from_millis(1);
/// Where packets must arrive that are on the way.
const SOON: Duration = Duration::from_secs(5);
/// IPv4 and UDP headers.
const HEADERS: u64 = 28;

fn two(forward: Shape, back: Shape) -> anyhow::Result<Topology> {
    let plan = Plan::new()
        .with_hosts(&["a", "b"])
        .with_asymmetric_link("a", "b", forward, back);
    Topology::build(&plan)
}

#[test]
fn a_round_trip_takes_both_delays() -> anyhow::Result<()> {
    let shape = Shape::default().with(Change::Delay(25 * MS));
    let network = two(shape, shape)?;
    let (from, echo) = (socket(network.host("a")?)?, Sink::echo(network.host("b")?)?);
    let trips = ping(&from, &echo, if long() { 400 } else { 60 })?;
    let [p50, p99] = [0.5, 0.99].map(|share| percentile_ms(&trips, share));
    println!(
        "round trip at 25 ms each way: {} of them, p50 {p50:.2} ms, p99 {p99:.2} ms",
        trips.len()
    );
    assert!((50.0..=52.0).contains(&p50), "{p50} ms");
    assert!(percentile_ms(&trips, 0.0) >= 50.0, "none is faster than the delays");
    Ok(())
}

#[test]
fn each_way_has_a_quality_of_its_own() -> anyhow::Result<()> {
    let shape = |delay: u32| Shape::default().with(Change::Delay(delay * MS));
    let network = two(shape(40), shape(5))?;
    for (from, to, delay) in [("a", "b", 40.0), ("b", "a", 5.0)] {
        let sink = Sink::start(network.host(to)?)?;
        sink.send(&socket(network.host(from)?)?, 200, 100, 5 * MS)?;
        wait::until("all arrive", SOON, || sink.count() == 200, || sink.count().to_string())?;
        let flights = flights(&sink);
        let [p50, p99] = [0.5, 0.99].map(|share| percentile_ms(&flights, share));
        println!("{from} to {to} at {delay} ms: p50 {p50:.2} ms, p99 {p99:.2} ms");
        assert!((delay..=delay + 1.0).contains(&p50), "{p50} ms");
        assert!(flights[0].as_secs_f64() * 1e3 >= delay, "{:?}", flights[0]);
    }
    Ok(())
}

#[test]
fn jitter_keeps_the_order_and_the_mean() -> anyhow::Result<()> {
    let shape = Shape::default()
        .with(Change::Delay(25 * MS))
        .with(Change::Jitter(5 * MS));
    let network = two(shape, shape)?;
    let sink = Sink::start(network.host("b")?)?;
    sink.send(&socket(network.host("a")?)?, 4_000, 100, MS)?;
    wait::until(
        "all arrive",
        SOON,
        || sink.count() == 4_000,
        || sink.count().to_string(),
    )?;
    let arrivals = sink.arrivals();
    assert!(
        arrivals.windows(2).all(|pair| pair[0].number < pair[1].number),
        "in order"
    );
    let flights = flights(&sink);
    let [p1, p50, p99] = [0.01, 0.5, 0.99].map(|share| percentile_ms(&flights, share));
    println!("25 ± 5 ms: p1 {p1:.2} ms, p50 {p50:.2} ms, p99 {p99:.2} ms");
    assert!((20.0..23.0).contains(&p1), "{p1} ms");
    assert!((23.5..27.0).contains(&p50), "{p50} ms");
    assert!((27.0..32.0).contains(&p99), "{p99} ms");
    Ok(())
}

#[test]
fn packets_are_lost_as_often_as_told() -> anyhow::Result<()> {
    const SENT: u64 = 2_000;
    let network = two(Shape::default().with(Change::Loss(0.01)), Shape::default())?;
    let sink = Sink::start(network.host("b")?)?;
    sink.send(&socket(network.host("a")?)?, SENT, 200, MS / 2)?;
    let link = network.link("a", "b")?;
    let arrived = || {
        link.stats()
            .is_ok_and(|stats| stats.forward.out.packets as usize == sink.count())
    };
    wait::until("what left arrives", SOON, arrived, || sink.count().to_string())?;
    let stats = link.stats()?.forward;
    println!("1 % of {SENT}: {} lost; {stats:?}", stats.dropped.loss.packets);
    assert_eq!(stats.taken.packets, SENT);
    assert_eq!(stats.taken.bytes, SENT * (200 + HEADERS));
    assert_eq!(stats.taken, stats.out + stats.dropped.total());
    assert_eq!(stats.dropped.loss, stats.dropped.total());
    assert_eq!((stats.missed, stats.refused), (0, 0));
    // 20 ± 4.45; four of those.
    assert!(
        (3..=37).contains(&stats.dropped.loss.packets),
        "{}",
        stats.dropped.loss.packets
    );
    Ok(())
}

/// Sends twice the rate for some seconds and compares what comes out, by both counters, with the rate.
/// Gives the two shares of the rate.
fn blast(rate: u64) -> anyhow::Result<[f64; 2]> {
    const PAYLOAD: usize = 1_372;
    let shape = Shape {
        rate: Some(rate),
        // 0.3 s: longer than the sender waits for the processor on a busy machine, so that the link is never idle.
        queue: rate * 3 / 80,
        delay: 25 * MS,
        ..Shape::default()
    };
    let network = two(shape, Shape::default())?;
    let (from, sink) = (socket(network.host("a")?)?, Sink::start(network.host("b")?)?);
    let link = network.link("a", "b")?;
    let seconds = if long() { 20 } else { 4 };
    let packets_per_s = 2 * rate / 8 / (PAYLOAD as u64 + HEADERS);
    let gap = Duration::from_secs_f64(1.0 / packets_per_s as f64);
    let measured = std::thread::scope(|scope| -> anyhow::Result<_> {
        let sender = scope.spawn(|| sink.send(&from, (seconds + 1) * packets_per_s, PAYLOAD, gap));
        // From when the queue is full on.
        let full = || {
            link.stats()
                .is_ok_and(|stats| stats.forward.dropped.queue.packets > 100)
        };
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
        "twice {rate} bit/s: {:.4} of it leaves the emulator, {:.4} enters the host; dropped {:?}, missed {}",
        shares[0], shares[1], stats.dropped.queue, stats.missed
    );
    assert_eq!(
        stats.taken,
        stats.out + stats.dropped.total() + stats.queue + stats.flying
    );
    Ok(shares)
}

/// Two attempts may fail: a machine that keeps the sender or the emulator from the processor for longer than the queue lasts
/// leaves the link idle, and one that does so between clock and counter measures something else. That the rate is never
/// exceeded is shown without a machine in the tests of the direction.
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

/// How exact the delay is while much else is on the link.
#[test]
fn the_delay_holds_under_load() -> anyhow::Result<()> {
    let shape = Shape {
        rate: Some(160_000_000),
        queue: 250_000,
        delay: 25 * MS,
        ..Shape::default()
    };
    let network = two(shape, shape)?;
    let (load, from) = (socket(network.host("a")?)?, socket(network.host("a")?)?);
    let (loaded, sink) = (Sink::start(network.host("b")?)?, Sink::start(network.host("b")?)?);
    let seconds = if long() { 20 } else { 4 };
    // 100 Mbit/s.
    let packets_per_s = 8_929;
    let gap = Duration::from_secs_f64(1.0 / packets_per_s as f64);
    std::thread::scope(|scope| {
        let sender = scope.spawn(|| loaded.send(&load, seconds * packets_per_s, 1_372, gap));
        sink.send(&from, seconds * 200, 100, 5 * MS)?;
        sender.join().map_err(|_| anyhow::anyhow!("the sender panicked"))?
    })?;
    let all = (seconds * 200) as usize;
    wait::until("all arrive", SOON, || sink.count() == all, || sink.count().to_string())?;
    let flights = flights(&sink);
    let [p50, p99, most] = [0.5, 0.99, 1.0].map(|share| percentile_ms(&flights, share));
    println!("25 ms beside 100 of 160 Mbit/s: p50 {p50:.2} ms, p99 {p99:.2} ms, max {most:.2} ms");
    // The time behind a packet of the load is part of it.
    assert!((25.0..26.5).contains(&p50), "{p50} ms");
    Ok(())
}

#[test]
fn a_cut_is_one_way_or_both_and_heals() -> anyhow::Result<()> {
    let shape = Shape::default().with(Change::Delay(5 * MS));
    let network = two(shape, shape)?;
    let (a, b) = (network.host("a")?, network.host("b")?);
    let (from_a, from_b) = (socket(a)?, socket(b)?);
    let (at_a, at_b) = (Sink::start(a)?, Sink::start(b)?);
    let link = network.link("a", "b")?;
    // Ten packets each way; gives how many came, once the link holds none any more.
    let exchange = || -> anyhow::Result<(usize, usize)> {
        at_a.clear();
        at_b.clear();
        let before = link.stats()?;
        at_b.send(&from_a, 10, 100, MS)?;
        at_a.send(&from_b, 10, 100, MS)?;
        let done = || {
            link.stats().is_ok_and(|now| {
                let passed = |now: &blaze_tests::wan::DirectionStats, then: &blaze_tests::wan::DirectionStats| {
                    now.taken.packets == then.taken.packets + 10 && now.flying.packets == 0
                };
                let arrived = now.forward.out.packets - before.forward.out.packets == at_b.count() as u64
                    && now.back.out.packets - before.back.out.packets == at_a.count() as u64;
                passed(&now.forward, &before.forward) && passed(&now.back, &before.back) && arrived
            })
        };
        wait::until("nothing is on the way", SOON, done, || format!("{:?}", link.stats()))?;
        Ok((at_b.count(), at_a.count()))
    };
    assert_eq!(exchange()?, (10, 10));
    link.cut(Ways::Forward)?;
    assert_eq!(exchange()?, (0, 10));
    link.heal(Ways::Forward)?;
    link.cut(Ways::Back)?;
    assert_eq!(exchange()?, (10, 0));
    link.cut(Ways::Both)?;
    assert_eq!(exchange()?, (0, 0));
    link.heal(Ways::Both)?;
    assert_eq!(exchange()?, (10, 10));
    let stats = link.stats()?;
    assert_eq!(
        (stats.forward.dropped.cut.packets, stats.back.dropped.cut.packets),
        (20, 20)
    );

    // Seen from the other end, forward is the other way.
    let other = network.link("b", "a")?;
    other.cut(Ways::Forward)?;
    assert_eq!(exchange()?, (10, 0));
    assert_eq!(other.stats()?.forward.dropped.cut.packets, 30);
    Ok(())
}

#[test]
fn what_is_too_large_is_counted_and_changes_take_effect_at_once() -> anyhow::Result<()> {
    let network = two(Shape::default(), Shape::default())?;
    let (from, sink) = (socket(network.host("a")?)?, Sink::start(network.host("b")?)?);
    let link = network.link("a", "b")?;
    link.set(Ways::Forward, &[Change::Mtu(1_000), Change::Delay(30 * MS)])?;
    sink.send(&from, 1, 972, MS)?;
    sink.send(&from, 1, 973, MS)?;
    wait::until(
        "the smaller one",
        SOON,
        || sink.count() == 1,
        || format!("{:?}", link.stats()),
    )?;
    assert!(sink.arrivals()[0].took >= 30 * MS);
    let stats = link.stats()?.forward;
    assert_eq!((stats.out.packets, stats.dropped.too_large.bytes), (1, 1_001));
    Ok(())
}

/// It says what is wrong with a command and goes on; it ends with its input.
#[test]
fn commands_are_lines_with_an_answer_each() -> anyhow::Result<()> {
    use std::io::{BufRead as _, BufReader, Write as _};
    use std::process::{Command, Stdio};

    let network = Topology::build(&Plan::new().with_hosts(&["a", "b"]).with_lan(&["a", "b"]))?;
    let mut child = Command::new(blaze_tests::process::binary("blaze-testbed")?)
        .arg("wan")
        .args([
            "--a",
            &network.host("a")?.namespace,
            "--b",
            &network.host("b")?.namespace,
        ])
        .args(["--run", "set both delay 10", "--a-device", "wan0"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()?;
    let mut input = child.stdin.take().ok_or_else(|| anyhow::anyhow!("no pipe"))?;
    let output = child.stdout.take().ok_or_else(|| anyhow::anyhow!("no pipe"))?;
    let mut lines = BufReader::new(output).lines();
    let mut next = || -> anyhow::Result<serde_json::Value> {
        let line = lines.next().ok_or_else(|| anyhow::anyhow!("it has ended"))??;
        Ok(serde_json::from_str(&line)?)
    };
    assert_eq!(next()?["ready"], true);
    for (line, ok) in [
        ("cut a>b", true),
        ("cut a>c", false),
        ("set both loss 2", false),
        ("stats", true),
    ] {
        writeln!(input, "{line}")?;
        let answer = next()?;
        assert_eq!(answer["ok"], ok, "{line}: {answer}");
        assert_eq!(answer["error"].is_string(), !ok, "{answer}");
        if line == "stats" {
            for way in ["a>b", "b>a"] {
                assert!(answer[way]["dropped"]["queue"]["bytes"].is_u64(), "{answer}");
            }
        }
    }
    drop(input);
    let ended = wait::until_some("its end", SOON, || child.try_wait().ok().flatten(), String::new)?;
    assert!(ended.success(), "{ended}");
    Ok(())
}
