//! Properties of the link over a simulated network. `SEEDS` of them run by default; set `BLAZE_LINK_SEEDS` at build time
//! for more.

mod bounds;
mod delivery;
mod lives;
mod order;

use std::time::Duration;

use super::sim::{Random, Weather};

/// Seeds that each property runs with.
fn seeds() -> std::ops::Range<u64> {
    let count = option_env!("BLAZE_LINK_SEEDS").and_then(|count| count.parse().ok());
    0..count.unwrap_or(200)
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
