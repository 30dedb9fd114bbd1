//! Whole flows over a simulated network: delay, loss, reordering, duplication, partitions,
//! restarts.
//!
//! Every flow is the code that production runs (control core, registry, planner, message path, link
//! engine); only the brokers, the wire and the clock are simulated. For each seed: chaos for some
//! seconds, then 5 s of quiet, then every requester must get each message of every matching
//! publisher exactly once; and at no time may a (writer, sequence) be written twice into one scope.

mod world;

use world::{Chaos, Simulation};

fn run_seeds(name: &str, chaos: &Chaos) {
    let seeds = super::seeds(40, 1_000);
    let mut failures = Vec::new();
    let mut deliveries = 0;
    for seed in seeds.iter().copied() {
        match Simulation::new(seed, chaos).run() {
            Ok(seen) => deliveries += seen,
            Err(fault) => failures.push(format!("seed {seed}: {fault}")),
        }
        if failures.len() >= 5 {
            break;
        }
    }
    assert!(failures.is_empty(), "{name} (BLAZE_SEED=n repeats one):\n{}", failures.join("\n"));
    println!("{name}: {} seeds, {deliveries} deliveries in the last rounds", seeds.len());
    assert!(
        seeds.len() == 1 || deliveries > 200,
        "{name}: only {deliveries} deliveries were asked for"
    );
}

#[test]
fn after_quiet_everybody_gets_everything_once() {
    run_seeds("everything", &Chaos { loss: 0.05, partitions: true, restarts: true, churn: true });
}

#[test]
fn a_calm_network_loses_nothing_reliable() {
    run_seeds("calm", &Chaos { loss: 0.0, partitions: false, restarts: false, churn: false });
}
