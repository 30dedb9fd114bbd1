//! Property: the true offset lies within the stated error, whatever the network and the clocks do.

use proptest::collection::vec;
use proptest::prelude::*;
use rand::RngExt;

use super::testing::{MS, Net, S, TestClock, node};

/// What happens in one run of three minutes.
#[derive(Debug, Clone)]
struct Case {
    seed: u64,
    synchronized: bool,
    /// Their clock minus ours at the start, in nanoseconds.
    offset: i64,
    /// Per way: shortest delay and random part, in microseconds.
    ways: [(i64, i64); 2],
    loss: f64,
    /// Drift of their clock from a second on, as share of the stated one.
    drifts: Vec<(i64, f64)>,
    /// Steps: second, whether ours, size in microseconds.
    steps: Vec<(i64, bool, i64)>,
}

fn way() -> impl Strategy<Value = (i64, i64)> {
    (prop_oneof![0..2_000_i64, 0..900_000_i64], prop_oneof![Just(0), 0..5_000_i64, 0..900_000_i64])
}

fn step() -> impl Strategy<Value = (i64, bool, i64)> {
    let size = prop_oneof![10_000..50_000_i64, 10_000..5_000_000_i64];
    let any = prop_oneof![1..5_000_i64, size.clone()];
    let sign = prop_oneof![Just(1), Just(-1)];
    // Of their clock only what counts as a step: smaller ones nobody can announce.
    prop_oneof![(Just(true), any), (Just(false), size)].prop_flat_map(move |(own, size)| {
        (1..170_i64, Just(own), sign.clone().prop_map(move |s| s * size))
    })
}

fn case() -> impl Strategy<Value = Case> {
    let share = prop_oneof![Just(-1.0), Just(1.0), -1.0..1.0_f64];
    let offset = prop_oneof![-3 * S..3 * S, -86_400 * S..86_400 * S];
    let loss = prop_oneof![Just(0.0), 0.0..0.5];
    (
        any::<u64>(),
        any::<bool>(),
        offset,
        [way(), way()],
        loss,
        vec((0..170_i64, share), 1..4),
        vec(step(), 0..4),
    )
        .prop_map(|(seed, synchronized, offset, ways, loss, drifts, steps)| Case {
            seed,
            synchronized,
            offset,
            ways,
            loss,
            drifts,
            steps,
        })
}

/// Runs a case; returns how often an offset was compared with the truth, or the first that was not
/// within its error.
fn run(case: &Case) -> Result<u32, String> {
    let ids = vec![node("edge/robot-1"), node("fog/fog-1")];
    let mut clocks = vec![TestClock::default(); 2];
    clocks[1].course += case.offset;
    clocks.iter_mut().for_each(|clock| clock.synchronized = case.synchronized);
    let (ways, loss) = (case.ways, case.loss);
    let delay = move |from: usize, rng: &mut rand::rngs::StdRng| {
        let (base, random) = ways[from];
        let lost = rng.random_bool(loss);
        (!lost).then(|| (base + rng.random_range(0..=random)) * MS / 1_000)
    };
    let mut net = Net::new(ids, clocks, case.seed, Box::new(delay));
    let ppm = if case.synchronized { 15.0 } else { 100.0 };
    let mut compared = 0;
    for tick in 0..180 * 5 {
        net.run_until(tick * S / 5 + 7);
        if tick % 5 == 0 {
            for (_, share) in case.drifts.iter().filter(|(second, _)| *second == tick / 5) {
                let at = net.at;
                net.clocks[1].drift(at, share * ppm);
            }
            for (_, own, size) in case.steps.iter().filter(|(second, ..)| *second == tick / 5) {
                net.clocks[usize::from(!own)].course += size * MS / 1_000;
                if !own {
                    announce(&mut net);
                }
            }
        }
        let Some(offset) = net.engines[0].offset(&net.ids[1], net.now(0)) else { continue };
        let truth = net.clocks[0].true_offset_s(&net.clocks[1], net.at);
        compared += 1;
        if (offset.offset_s - truth).abs() > offset.error_s + 4e-9 {
            return Err(format!("second {}: {offset:?}, true offset {truth}", tick / 5));
        }
    }
    Ok(compared)
}

/// Their step is known here with their next message: one that arrives at once.
fn announce(net: &mut Net) {
    let (theirs, ours) = (net.now(1), net.now(0));
    net.engines[1].set_measured(theirs, []);
    let number = net.engines[1].clock_number();
    let message = format!(r#"{{"id":0,"from":"fog/fog-1","to":[],"t1":0,"clock":{number}}}"#);
    net.engines[0].ping_received(ours, &node("fog/fog-1"), message.as_bytes());
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, ..ProptestConfig::default() })]

    #[test]
    fn the_true_offset_lies_within_the_error(case in case()) {
        run(&case).map_err(TestCaseError::fail)?;
    }
}

#[test]
fn asymmetry_stays_within_the_bound() {
    // 20 ms one way and 5 ms back, and clocks that are apart by 5 s and drift by 50 ppm.
    let case = Case {
        seed: 30,
        synchronized: false,
        offset: -5 * S,
        ways: [(20_000, 100), (5_000, 100)],
        loss: 0.0,
        drifts: vec![(0, 0.5)],
        steps: vec![(90, true, 1_000_000)],
    };
    let compared = run(&case).unwrap();
    assert!(compared > 850, "{compared} of 900 ticks had an offset");
}
