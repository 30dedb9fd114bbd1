//! The budget of a link under two saturating cameras: small topics keep their rate, images get what
//! the allocation gives them, and no second carries more than the limit. Each row combines a link,
//! a limit, sharing and compression. How close to the allocation images come and what they add to
//! the latency of small messages depends on the machine: `blaze-bench link` measures it.

use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_flow::limit::pacer::allocated;
use blaze_tests::scenario::Running;
use blaze_tests::scenario::budget::{
    FRONT, FULL, IMAGE, IMAGE_RATE, NARROW, REAR, ROWS, Row, SETTLE, Seen, allocation, consumer,
    look, look_at_settled, of_topic, p99_of_small, reckoned, scenario, shape, small, streams,
};
use blaze_tests::wan::{Change, Shape, Ways};
use blaze_tests::{long, wait};
use serde_json::Value;

use crate::cuts::{DELIVERY, DOWN, FLOWING, dropped, hold_cut, watch};

/// Rows that every run plays.
const OF_EVERY_RUN: usize = 2;
/// Of the budget, and of the rates that the allocation gives images, so much is used at least.
/// Where others have a part of the two cores, publishers, brokers, flows, the link and consumers
/// get less done; a flow that stands still or sends less than half shows all the same.
const USED: f64 = 0.5;
/// Of small topics so many arrive.
const SMALL: f64 = 0.999;

/// How long a row is measured.
fn measured() -> Duration {
    Duration::from_secs(if long() { 30 } else { 8 })
}

fn play(row: &Row) -> anyhow::Result<()> {
    let running = Running::start(&scenario(row, shape(row))?)?;
    running.wait_flowing()?;
    // How long rates take to settle is no part of what is measured.
    std::thread::sleep(SETTLE);
    let (seen, allocation) = look_at_settled(row, &running, measured())?;
    let budget = row.budget();
    println!(
        "{}: limit {:.1} Mbit/s; busiest second {:.2} %, mean {:.2} %; ω {:.4} on the wire, {} as \
         the flow says; {} packets lost on the \
         way; processor {:.2}, {:.1} ms for each image",
        row.name,
        budget * 8.0 / 1e6,
        100.0 * seen.busiest / budget,
        100.0 * seen.mean / budget,
        seen.wire_factor,
        allocation["wire_factor"],
        seen.lost_on_the_way,
        seen.processor,
        seen.processor_per_image().as_secs_f64() * 1e3,
    );
    let faults = judge(row, &running, &seen, &allocation)?;
    anyhow::ensure!(faults.is_empty(), "{}: {}\n{}", row.name, faults.join("; "), running.tails());
    Ok(())
}

/// What must not be.
fn judge(
    row: &Row,
    running: &Running,
    seen: &Seen,
    allocation: &Value,
) -> anyhow::Result<Vec<String>> {
    let budget = row.budget();
    let mut faults = Vec::new();
    let mut expect = |holds: bool, what: String| {
        if !holds {
            faults.push(what);
        }
    };
    expect(seen.busiest <= budget, format!("{:.0} of {budget:.0} bytes in a second", seen.busiest));
    expect(
        seen.mean >= budget * USED,
        format!("only {:.0} of {budget:.0} bytes a second", seen.mean),
    );
    let wire_factor = allocation["wire_factor"].as_f64().context("it has measured")?;
    let of_flow = wire_factor * allocated(budget) / budget;
    expect(
        (of_flow / seen.wire_factor - 1.0).abs() <= IMAGE_RATE,
        format!("the flow takes {of_flow:.4} for what the wire says is {:.4}", seen.wire_factor),
    );
    // What the reserve leaves is what is given out.
    let expected = reckoned(row, allocated(budget), seen.wire_factor, allocation)?;
    // The same with the ω that the flow has measured.
    let given = reckoned(row, budget, wire_factor, allocation)?;
    let lines = streams()?.into_iter().zip(expected.into_iter().zip(given)).zip(&seen.routes);
    for ((stream, (hz, given)), route) in lines {
        let topic = stream.topic;
        let got = route.rate_hz();
        let row = of_topic(allocation, topic);
        println!(
            "  {topic:<34} reckoned {hz:>6.2} Hz (by the flow's ω {given:>6.2}), got \
             {got:>6.2} Hz; lost {:>3}, p50 {:>6.1} ms, p99 \
             {:>6.1} ms, dropped {} {}",
            route.gaps(),
            route.latency_ms(0.5).unwrap_or_default(),
            route.latency_ms(0.99).unwrap_or_default(),
            dropped(running, topic)?,
            if row["compression"].is_null() {
                String::new()
            } else {
                row["compression"].to_string()
            },
        );
        // A message more or less may fall into the time that is looked at.
        let edge = 1.0 / route.seconds.max(1) as f64;
        if stream.bytes == IMAGE {
            expect(
                got >= USED * hz - edge && got <= (1.0 + IMAGE_RATE) * hz + edge,
                format!("{topic}: {got:.2} Hz instead of {hz:.2}"),
            );
            let allocated = &row["lanes"][0]["allocated_hz"];
            let allocated = allocated.as_f64().with_context(|| format!("{topic}: {allocated}"))?;
            // A flow that is kept from the processor takes its link for a slower one.
            expect(
                allocated >= USED * given && allocated <= (1.0 + IMAGE_RATE) * given,
                format!("{topic}: {allocated:.2} Hz are given out instead of {given:.2}"),
            );
        } else {
            let all = (route.received + route.gaps()) as f64;
            expect(
                route.received as f64 >= SMALL * all
                    && got >= SMALL * stream.hz - edge
                    && route.duplicated == 0
                    && route.reordered == 0,
                format!("{topic} at {got:.2} Hz: {route}"),
            );
        }
    }
    Ok(faults)
}

#[test]
fn small_topics_keep_their_rate_and_images_get_what_is_left() -> anyhow::Result<()> {
    let rows = if long() { ROWS.len() } else { OF_EVERY_RUN };
    // Each row says what it has seen, also after one that failed.
    let failed: Vec<String> = ROWS[..rows]
        .iter()
        .filter_map(|row| play(row).err().map(|error| format!("{error:#}")))
        .collect();
    anyhow::ensure!(failed.is_empty(), "{}", failed.join("\n"));
    Ok(())
}

/// The true rate falls to a quarter of the limit, and comes back.
#[test]
fn the_rate_follows_what_the_link_carries() -> anyhow::Result<()> {
    const NARROWED: u64 = 10_000_000;
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
        "10 instead of 40 Mbit/s: measured {}, longest queue {longest:.0} ms from the fifth second \
         on; back at 90 % after {back:?}",
        narrow["links"]
    );
    anyhow::ensure!(longest <= 100.0, "the queue holds {longest:.0} ms\n{}", running.tails());
    anyhow::ensure!(back.is_some(), "not back after 30 s: {}", allocation(&running)?);
    Ok(())
}

/// How fast a change of the node file is in effect.
const IN_EFFECT: Duration = Duration::from_secs(1);

/// Another limit in the node file of a running flow: the rates follow, and no small message is
/// lost.
#[test]
fn the_limit_changes_while_the_flow_runs() -> anyhow::Result<()> {
    let limits = if long() { [160.0, 40.0, 160.0] } else { [80.0, 40.0, 80.0] };
    let of = |limit_mbps| Row { limit_mbps, ..FULL };
    let wide = Shape { rate: None, ..Shape::to_cloud() };
    let mut running = Running::start(&scenario(&of(limits[0]), wide)?)?;
    running.wait_flowing()?;
    std::thread::sleep(SETTLE);
    let process = running.flow("robot-1")?.id();
    let since = running.now();
    for limit in &limits[1..] {
        let row = of(*limit);
        // The same traffic costs the same before and after; that this is what the wire says, the
        // rows show.
        let before = allocation(&running)?;
        let wire_factor = before["wire_factor"].as_f64().context("it has measured")?;
        let expected = reckoned(&row, row.budget(), wire_factor, &before)?;
        let begun = Instant::now();
        running.edit("robot-1", |spec| spec.limit_mbps = *limit)?;
        let mut seen = Value::Null;
        let rate = |seen: &Value, topic| {
            of_topic(seen, topic)["lanes"][0]["allocated_hz"].as_f64().unwrap_or_default()
        };
        wait::until(
            &format!("limit_mbps {limit} is in effect, which gives {expected:.2?} Hz"),
            IN_EFFECT,
            || {
                seen = allocation(&running).unwrap_or_default();
                let mut as_expected = streams().unwrap_or_default().into_iter().zip(&expected);
                seen["limit_mbps"] == *limit
                    && as_expected.all(|(stream, hz)| {
                        (rate(&seen, stream.topic) - hz).abs() <= IMAGE_RATE * hz
                    })
            },
            || format!("{}\n{}", allocation(&running).unwrap_or_default(), running.tails()),
        )?;
        println!(
            "limit_mbps {limit}: in effect after {:.0?}, {FRONT} from {:.3} to {:.3} Hz, {REAR} \
             from {:.3} to {:.3} Hz",
            begun.elapsed(),
            rate(&before, FRONT),
            rate(&seen, FRONT),
            rate(&before, REAR),
            rate(&seen, REAR),
        );
        // Then the traffic keeps to it.
        std::thread::sleep(IN_EFFECT);
        let seen = look(&row, &running, measured() / 4)?;
        let (used, most) = (seen.mean / row.budget(), seen.busiest / row.budget());
        println!(
            "  {:.2} % of it on the wire, {:.2} % in the busiest second",
            100.0 * used,
            100.0 * most
        );
        anyhow::ensure!(most <= 1.0, "{most:.4} of the limit in a second\n{}", running.tails());
    }
    anyhow::ensure!(running.flow("robot-1")?.id() == process, "it was started again");
    for stream in small() {
        let route = running.route("recorder", stream.topic, &since)?;
        anyhow::ensure!(
            route.gaps() == 0 && route.duplicated == 0 && route.reordered == 0,
            "{route}\n{}",
            running.tails()
        );
    }
    Ok(())
}

/// How long small messages are worth anything.
const SMALL_LIFESPAN: Duration = Duration::from_secs(2);

/// The link is cut for longer than the time after which a flow counts as down, while cameras would
/// fill it.
#[test]
fn small_topics_are_back_a_second_after_a_cut() -> anyhow::Result<()> {
    let mut scenario = scenario(&NARROW, shape(&NARROW))?;
    for service in scenario.publishers.iter_mut().chain(&mut scenario.consumers) {
        for stream in service.streams.iter_mut().filter(|stream| stream.lifespan.is_zero()) {
            stream.lifespan = SMALL_LIFESPAN;
        }
    }
    let running = Running::start(&scenario)?;
    running.wait_flowing()?;
    std::thread::sleep(SETTLE);
    let since = running.now();
    let arrived = hold_cut(&running, Ways::Both, DOWN)?;
    let topics: Vec<&'static str> = small().iter().map(|stream| stream.topic).collect();
    let healed = watch(&running, Ways::Both, &topics, &arrived)?;
    println!(
        "  first Hello {:.0?} after it was healed, flowing after {:.0?}; busiest second {:.1} % of \
         the limit",
        healed.hello,
        healed.flowing,
        100.0 * healed.busiest / NARROW.budget()
    );
    anyhow::ensure!(
        healed.busiest <= NARROW.budget(),
        "the catch-up takes {:.0} bytes a second",
        healed.busiest
    );
    // From now on all of them have their rate, though the link has just begun to show what it
    // carries.
    let back = running.now();
    std::thread::sleep(measured() / 2);
    for stream in streams()? {
        let topic = stream.topic;
        let (route, lately) = (
            running.route(consumer(&stream), topic, &since)?,
            running.route(consumer(&stream), topic, &back)?,
        );
        let oldest = Duration::from_secs_f64(route.latency_ms(1.0).unwrap_or_default() / 1e3);
        println!("  {route}; now {:.2} Hz, oldest {oldest:.1?}", lately.rate_hz());
        anyhow::ensure!(
            route.duplicated == 0 && route.reordered == 0,
            "twice or out of order: {route}"
        );
        if stream.bytes == IMAGE {
            anyhow::ensure!(oldest <= stream.lifespan + DELIVERY, "{topic} of {oldest:?} arrived");
            continue;
        }
        anyhow::ensure!(oldest <= SMALL_LIFESPAN + DELIVERY, "{topic} of {oldest:?} arrived");
        // A slow one shows that it is back when it is published next.
        let period = Duration::from_secs_f64(1.0 / stream.hz);
        let allowed = FLOWING.max(period + DELIVERY);
        anyhow::ensure!(
            healed.flowing[topic] <= healed.hello + allowed,
            "{topic} is back after {:?}\n{}",
            healed.flowing[topic],
            running.tails()
        );
        let edge = 1.0 / lately.seconds.max(1) as f64;
        anyhow::ensure!(
            lately.rate_hz() >= 0.98 * stream.hz - edge,
            "{topic} at {:.2} Hz\n{}",
            lately.rate_hz(),
            running.tails()
        );
        let skipped = dropped(&running, topic)?["rate_limit"].as_u64().unwrap_or(0);
        anyhow::ensure!(
            skipped == 0,
            "{topic}: {skipped} messages were skipped for want of budget"
        );
    }
    Ok(())
}

/// A small message waits for a part of an image on the wire, never for the image.
#[test]
fn small_messages_do_not_wait_behind_images() -> anyhow::Result<()> {
    let image_ms = IMAGE as f64 * 8.0 / (NARROW.link_mbit as f64 * 1e6) * 1e3;
    let allowed = image_ms / 4.0;
    let without = p99_of_small(&NARROW, false, measured())?;
    let with = p99_of_small(&NARROW, true, measured())?;
    println!(
        "p99 of small messages: {without:.2} ms without cameras, {with:.2} ms beside them; an \
         image takes the link {image_ms:.0} ms, {allowed:.1} ms more are allowed"
    );
    anyhow::ensure!(
        with - without <= allowed,
        "{:.2} ms more, {allowed:.2} are allowed",
        with - without
    );
    Ok(())
}
