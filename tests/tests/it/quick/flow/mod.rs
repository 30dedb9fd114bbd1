//! Whole flows over simulated brokers, networks and clocks.

mod allocation;
mod brokers;
#[path = "../../../../../dataplane/src/link/flights.rs"]
mod flights;
mod protocol;
mod replicas;

/// Seeds with which a simulation once found a fault. Every tier runs them besides the first ones:
/// whoever mends such a fault adds its seed.
const FAILED: &[u64] = &[];

/// Seeds of a simulation: those that once failed and the first `few`, or the first `many` with the
/// full counts. `BLAZE_SEED` names a single one.
fn seeds(few: u64, many: u64) -> Vec<u64> {
    let only = std::env::var_os("BLAZE_SEED").and_then(|text| text.to_str()?.parse().ok());
    let first = 0..if blaze_tests::long() { many } else { few };
    only.map_or_else(|| FAILED.iter().copied().chain(first).collect(), |seed| vec![seed])
}
