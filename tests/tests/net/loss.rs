//! A link that loses 1 % both ways: what is reliable is whole, what is not shows its losses,
//! pictures are repaired within their lifespan, and no topic waits for another's repair.

use std::time::Duration;

use blaze_tests::long;
use blaze_tests::scenario::parts::{one_link, stream};
use blaze_tests::scenario::{BrokerKind, Route, Running, Stream};
use blaze_tests::wan::{Change, Shape, Ways};

const BEST_EFFORT: &str = "imu/best_effort";
const RELIABLE: &str = "imu/reliable";
const PICTURES: &str = "pictures";
const PICTURES_HZ: f64 = 4.0;
const LOSS: f64 = 0.01;
/// How often times are measured at most.
const LOOKS: usize = 3;
/// What a reliable message may take that has to be sent again, on a link with a round trip below 1
/// ms. Its loss is known with the next Feedback (50 ms or 64 samples), the repair may be lost
/// again.
const REPAIRED_MS: f64 = 200.0;
/// What a message may take that is never repaired itself: below the 50 ms that others' repairs
/// take, above the pauses of a busy machine.
const UNTOUCHED_MS: f64 = 30.0;

/// The picture has 154 parts: without repair one of five would be whole.
fn streams() -> Vec<Stream> {
    let best_effort = |stream| Stream { reliable: false, ..stream };
    vec![
        stream(RELIABLE, 100.0, 320),
        best_effort(stream(BEST_EFFORT, 100.0, 320)),
        Stream {
            lifespan: Duration::from_millis(500),
            ..best_effort(stream(PICTURES, PICTURES_HZ, 200_000))
        },
    ]
}

/// What came of reliable messages, of best-effort ones and of pictures within a time.
fn look(running: &Running, seconds: u64) -> anyhow::Result<[Route; 3]> {
    let since = running.now();
    // Nothing to wait for: what comes within this time is measured.
    std::thread::sleep(Duration::from_secs(seconds));
    let route = |topic| {
        let route = running.route("recorder", topic, &since)?;
        println!("{route}");
        anyhow::ensure!(route.duplicated == 0, "twice: {route}");
        Ok(route)
    };
    Ok([route(RELIABLE)?, route(BEST_EFFORT)?, route(PICTURES)?])
}

fn p99_ms(route: &Route) -> f64 {
    route.latency_ms(0.99).unwrap_or(f64::INFINITY)
}

#[test]
fn a_link_that_loses_one_percent_is_repaired() -> anyhow::Result<()> {
    let running = Running::start(&one_link(Shape::default(), BrokerKind::Redis, 100.0, streams()))?;
    running.wait_flowing()?;
    let link = running.link("robot-1", "cloud-1")?;
    let (clean_s, lossy_s) = if long() { (60, 60) } else { (4, 8) };
    // What else has the processors only ever adds to a time: one of three looks must show that
    // nobody waits. All else must hold each time.
    let mut late = Ok(());
    for _ in 0..LOOKS {
        link.set(Ways::Both, &[Change::Loss(0.0)])?;
        let [_, clean, _] = look(&running, clean_s)?;
        link.set(Ways::Both, &[Change::Loss(LOSS)])?;
        let lossy = look(&running, lossy_s)?;
        whole(&clean, &lossy).map_err(|error| error.context(running.tails()))?;
        late = in_time(&clean, &lossy);
        if late.is_ok() {
            break;
        }
        println!("{late:?}");
    }
    late.map_err(|error| error.context(running.tails()))
}

/// What is reliable arrives, pictures are repaired, the rest shows what was lost.
fn whole(clean: &Route, [reliable, best_effort, pictures]: &[Route; 3]) -> anyhow::Result<()> {
    let (lost, received) = (best_effort.gaps() - clean.gaps(), best_effort.latencies_ms.len());
    let share = lost as f64 / (lost as f64 + received as f64);
    anyhow::ensure!(lost > 0 && share < 0.05, "best effort: {lost} lost, {share:.3}");
    anyhow::ensure!(reliable.gaps() == 0 && reliable.rate_hz() >= 95.0, "reliable: {reliable}");
    anyhow::ensure!(
        pictures.rate_hz() >= 0.75 * PICTURES_HZ,
        "pictures are not repaired: {pictures}"
    );
    Ok(())
}

/// What is never repaired itself does not notice the repairs of others.
fn in_time(clean: &Route, [reliable, best_effort, _]: &[Route; 3]) -> anyhow::Result<()> {
    anyhow::ensure!(p99_ms(reliable) < REPAIRED_MS, "reliable: p99 {} ms", p99_ms(reliable));
    let untouched = UNTOUCHED_MS.max(3.0 * p99_ms(clean));
    anyhow::ensure!(p99_ms(best_effort) < untouched, "best effort: p99 {} ms", p99_ms(best_effort));
    Ok(())
}
