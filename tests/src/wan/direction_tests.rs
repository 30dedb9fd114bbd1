//! Tests of one direction of a link, on a clock of their own.

use std::time::{Duration, Instant};

use proptest::prelude::*;

use super::super::{Change, Shape};
use super::{Direction, MAX_HELD_BYTES};

const MS: Duration = Duration::from_millis(1);

/// Lets everything arrive; gives each packet and when it came.
fn drain(direction: &mut Direction<u64>) -> Vec<(u64, Instant)> {
    let mut arrived = Vec::new();
    while let Some(due) = direction.next_due() {
        while let Some(packet) = direction.pop(due) {
            arrived.push((packet, due));
        }
    }
    arrived
}

#[test]
fn the_rate_spaces_packets_and_the_queue_drops_what_it_cannot_hold() {
    let start = Instant::now();
    // 1000 bytes take 8 ms.
    let shape = Shape { rate: Some(1_000_000), queue: 2_000, delay: 10 * MS, ..Shape::default() };
    let mut direction = Direction::new(shape, 1);
    for packet in 0..5 {
        direction.offer(start, 1_000, packet);
    }
    let stats = direction.stats();
    assert_eq!((stats.queue.packets, stats.flying.packets), (2, 1));
    assert_eq!(stats.dropped.queue.packets, 2);
    let arrived = drain(&mut direction);
    let expected = [(0, 18), (1, 26), (2, 34)].map(|(packet, at)| (packet, start + at * MS));
    assert_eq!(arrived, expected);
}

#[test]
fn a_rate_that_rises_lets_the_queue_go_faster() {
    let start = Instant::now();
    let mut direction = Direction::new(Shape::default().with(Change::Rate(Some(8_000))), 1);
    // A second each.
    for packet in 0..3 {
        direction.offer(start, 1_000, packet);
    }
    direction.change(start + 500 * MS, &[Change::Rate(Some(8_000_000))]);
    let arrived = drain(&mut direction);
    let expected = [1_000, 1_001, 1_002].map(|at| start + at * MS);
    assert_eq!(arrived.iter().map(|(_, at)| *at).collect::<Vec<_>>(), expected);
}

#[test]
fn a_cut_loses_what_is_on_the_way_and_healed_it_begins_anew() {
    let start = Instant::now();
    let shape = Shape { rate: Some(1_000_000), delay: 50 * MS, ..Shape::default() };
    let mut direction = Direction::new(shape, 1);
    direction.offer(start, 1_000, 1);
    direction.offer(start, 1_000, 2);
    direction.cut();
    assert_eq!(direction.next_due(), None);
    direction.offer(start + 10 * MS, 1_000, 3);
    assert_eq!(direction.stats().dropped.cut.packets, 3);
    direction.heal();
    direction.offer(start + 20 * MS, 1_000, 4);
    assert_eq!(drain(&mut direction), [(4, start + 78 * MS)]);
}

#[test]
fn larger_than_the_mtu_is_dropped() {
    let start = Instant::now();
    let mut direction = Direction::new(Shape::default(), 1);
    direction.offer(start, 1_500, 1);
    direction.offer(start, 1_501, 2);
    let stats = direction.stats();
    assert_eq!(stats.dropped.too_large.bytes, 1_501);
    assert_eq!(drain(&mut direction).len(), 1);
}

#[test]
fn memory_is_bounded() {
    let start = Instant::now();
    let shape = Shape::default().with(Change::Delay(60_000 * MS)).with(Change::Mtu(65_535));
    let mut direction = Direction::new(shape, 1);
    for packet in 0..3_000 {
        direction.offer(start, 65_000, packet);
    }
    let stats = direction.stats();
    assert!(stats.flying.bytes <= MAX_HELD_BYTES, "{stats:?}");
    assert!(stats.dropped.memory.packets > 0, "{stats:?}");
}

#[test]
fn losses_are_as_likely_as_told_and_the_same_for_a_seed() {
    let start = Instant::now();
    let fate = |seed| {
        let mut direction = Direction::new(Shape::default().with(Change::Loss(0.01)), seed);
        for packet in 0..100_000 {
            direction.offer(start, 100, packet);
        }
        drain(&mut direction).into_iter().map(|(packet, _)| packet).collect::<Vec<_>>()
    };
    let (one, again, other) = (fate(1), fate(1), fate(2));
    assert_eq!(one, again);
    assert_ne!(one, other);
    // 1000 ± 31.5; five of those.
    for lost in [100_000 - one.len(), 100_000 - other.len()] {
        assert!((843..=1157).contains(&lost), "{lost} of 100000");
    }
}

#[test]
fn jitter_wanders_over_its_whole_range_also_at_a_high_rate() {
    let start = Instant::now();
    let shape = Shape::default().with(Change::Delay(25 * MS)).with(Change::Jitter(5 * MS));
    let mut direction = Direction::new(shape, 1);
    let mut sent = Vec::new();
    // 10,000 a second for a minute.
    for packet in 0..600_000_u32 {
        let at = start + packet * Duration::from_micros(100);
        direction.offer(at, 100, u64::from(packet));
        sent.push(at);
    }
    let arrived = drain(&mut direction);
    let delays: Vec<f64> = arrived
        .iter()
        .map(|(packet, at)| (*at - sent[*packet as usize]).as_secs_f64() * 1e3)
        .collect();
    let mean = delays.iter().sum::<f64>() / delays.len() as f64;
    let (least, most) =
        delays.iter().fold((f64::MAX, f64::MIN), |(least, most), d| (least.min(*d), most.max(*d)));
    assert!((mean - 25.0).abs() < 0.5, "mean {mean}");
    assert!((20.0..21.0).contains(&least), "least {least}");
    assert!(most > 29.0 && most <= 30.001, "most {most}");
    assert!(arrived.windows(2).all(|pair| pair[0].0 < pair[1].0), "the order is kept");
}

/// What happens to a direction in a random run.
#[derive(Debug, Clone)]
enum Step {
    Offer { gap_us: u64, bytes: u64 },
    Pop { gap_us: u64 },
    Change(Change),
    Cut,
    Heal,
}

fn step() -> impl Strategy<Value = Step> {
    let gap = || 0_u64..3_000;
    prop_oneof![
        8 => (gap(), 40_u64..2_000).prop_map(|(gap_us, bytes)| Step::Offer { gap_us, bytes }),
        4 => gap().prop_map(|gap_us| Step::Pop { gap_us }),
        1 => change().prop_map(Step::Change),
        1 => Just(Step::Cut),
        1 => Just(Step::Heal),
    ]
}

fn change() -> impl Strategy<Value = Change> {
    prop_oneof![
        (0_u64..50_000).prop_map(|us| Change::Delay(Duration::from_micros(us))),
        (0_u64..10_000).prop_map(|us| Change::Jitter(Duration::from_micros(us))),
        (0.0..0.5).prop_map(Change::Loss),
        proptest::option::of(100_000_u64..100_000_000).prop_map(Change::Rate),
        (0_u64..20_000).prop_map(Change::Queue),
        (100_u32..1_600).prop_map(Change::Mtu),
    ]
}

proptest! {
    /// Whatever happens: in = out + dropped + queued, and the order is kept.
    #[test]
    fn nothing_is_made_or_forgotten(steps in proptest::collection::vec(step(), 1..300), seed: u64) {
        let mut now = Instant::now();
        let mut direction = Direction::new(Shape::default(), seed);
        let (mut next, mut arrived) = (0, Vec::new());
        for step in steps {
            match step {
                Step::Offer { gap_us, bytes } => {
                    now += Duration::from_micros(gap_us);
                    direction.offer(now, bytes, next);
                    next += 1;
                }
                Step::Pop { gap_us } => {
                    now += Duration::from_micros(gap_us);
                    while let Some(packet) = direction.pop(now) {
                        arrived.push(packet);
                    }
                    prop_assert!(direction.next_due().is_none_or(|due| due > now));
                }
                Step::Change(change) => direction.change(now, &[change]),
                Step::Cut => direction.cut(),
                Step::Heal => direction.heal(),
            }
            let stats = direction.stats();
            prop_assert_eq!(
                stats.taken,
                stats.out + stats.dropped.total() + stats.queue + stats.flying,
            );
        }
        arrived.extend(drain(&mut direction).into_iter().map(|(packet, _)| packet));
        let stats = direction.stats();
        prop_assert_eq!(stats.taken, stats.out + stats.dropped.total());
        prop_assert_eq!(stats.out.packets as usize, arrived.len());
        prop_assert!(arrived.windows(2).all(|pair| pair[0] < pair[1]), "{:?}", arrived);
    }

    /// In no window leaves more than the rate lets through, but for the packet that leaves as it
    /// begins. Jitter moves the ends of a window.
    #[test]
    fn the_rate_holds_in_every_window(
        packets in proptest::collection::vec((0_u64..2_000, 40_u64..1_500), 2..200),
        rate in 1_000_000_u64..50_000_000,
        jitter_us in prop_oneof![Just(0_u64), 0_u64..5_000],
    ) {
        let jitter = Duration::from_micros(jitter_us);
        let shape =
            Shape { rate: Some(rate), delay: 10 * MS, jitter, queue: 20_000, ..Shape::default() };
        let mut direction = Direction::new(shape, 3);
        let mut now = Instant::now();
        let sizes: Vec<u64> = packets.iter().map(|(_, bytes)| *bytes).collect();
        for (number, (gap_us, bytes)) in packets.iter().enumerate() {
            now += Duration::from_micros(*gap_us);
            direction.offer(now, *bytes, number as u64);
        }
        let arrived = drain(&mut direction);
        for first in 0..arrived.len() {
            let mut bits = 0;
            for (packet, at) in &arrived[first + 1..] {
                bits += sizes[*packet as usize] * 8;
                let window = (*at - arrived[first].1 + 2 * jitter).as_secs_f64();
                // A nanosecond of rounding for each packet.
                prop_assert!(
                    bits as f64 <= rate as f64 * (window + 1e-6),
                    "{bits} bits in {window} s at {rate}",
                );
            }
        }
    }

    /// Without jitter each packet takes the delay, the time at the rate, and the wait for those
    /// before it.
    #[test]
    fn the_delay_is_exact(gaps in proptest::collection::vec(0_u64..2_000, 1..100),
        delay_us in 0_u64..100_000) {
        let delay = Duration::from_micros(delay_us);
        // 1000 bytes a millisecond.
        let shape = Shape { rate: Some(8_000_000), delay, queue: u64::MAX, ..Shape::default() };
        let mut direction = Direction::new(shape, 5);
        let mut now = Instant::now();
        let mut left = now;
        let mut expected = Vec::new();
        for (number, gap_us) in gaps.iter().enumerate() {
            now += Duration::from_micros(*gap_us);
            direction.offer(now, 1_000, number as u64);
            left = left.max(now) + MS;
            expected.push((number as u64, left + delay));
        }
        prop_assert_eq!(drain(&mut direction), expected);
    }
}
