//! Properties of the link over a simulated network. Each runs with 200 seeds, or with as many as
//! the environment variable `BLAZE_LINK_SEEDS` says.

mod bounds;
mod budgets;
mod delivery;
mod lives;
mod order;

use std::time::Duration;

use super::sim::Weather;
use crate::testing::Random;

/// Seeds that each property runs with.
#[allow(clippy::disallowed_methods, reason = "how long a test runs is no configuration")]
fn seeds() -> std::ops::Range<u64> {
    let count = std::env::var("BLAZE_LINK_SEEDS").ok();
    0..count.and_then(|count| count.parse().ok()).unwrap_or(200)
}

/// A path as bad as they come: up to 80 ms, 20 ms of jitter, `loss` lost, some doubled.
fn bad_weather(random: &mut Random, loss: f64) -> Weather {
    Weather {
        delay: Duration::from_millis(1) + random.duration(Duration::from_millis(79)),
        jitter: random.duration(Duration::from_millis(20)),
        loss: loss * random.share(),
        duplicated: 0.02 * random.share(),
    }
}
