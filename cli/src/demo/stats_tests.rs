use std::collections::BTreeSet;

use proptest::prelude::*;

use super::*;

/// Lost, duplicated, reordered.
fn tracked(sequences: &[u64]) -> (u64, u64, u64) {
    let mut tracker = SequenceTracker::default();
    sequences.iter().for_each(|sequence| tracker.add(*sequence));
    (tracker.lost(), tracker.duplicated(), tracker.reordered())
}

/// The definitions, word by word.
fn oracle(sequences: &[u64]) -> (u64, u64, u64) {
    let mut seen = BTreeSet::new();
    let (mut duplicated, mut reordered) = (0, 0);
    for sequence in sequences {
        if seen.contains(sequence) {
            duplicated += 1;
        } else {
            reordered += u64::from(seen.last().is_some_and(|largest| largest > sequence));
            seen.insert(*sequence);
        }
    }
    let lost = match (seen.first(), seen.last()) {
        (Some(first), Some(last)) => last - first + 1 - seen.len() as u64,
        _ => 0,
    };
    (lost, duplicated, reordered)
}

proptest! {
    #[test]
    fn counts_are_exact(sequences in prop::collection::vec(1u64..200, 0..300)) {
        prop_assert_eq!(tracked(&sequences), oracle(&sequences));
    }
}

#[test]
fn extreme_numbers_are_no_trouble() {
    assert_eq!(tracked(&[u64::MAX, 1, u64::MAX - 1, 0]).0, u64::MAX - 3);
}

#[test]
fn old_gaps_are_settled_as_lost() {
    let mut tracker = SequenceTracker::default();
    let count = MAX_GAPS as u64 * 3;
    for index in 0..count {
        tracker.add(index * 2);
    }
    assert_eq!(tracker.lost(), count - 1);
    assert!(tracker.ranges.len() <= MAX_GAPS + 1);
    // It was missing long ago and is settled: late, but still lost.
    tracker.add(1);
    assert_eq!((tracker.lost(), tracker.reordered()), (count - 1, 1));
    // A gap that is remembered is filled.
    tracker.add((count - 2) * 2 + 1);
    assert_eq!((tracker.lost(), tracker.reordered()), (count - 2, 2));
}

fn arrival(writer: u8, sequence: u64, millis: u64) -> Arrival {
    Arrival {
        writer: WriterId([writer; 16]),
        sequence,
        publish_time_ns: sequence * 1_000_000,
        latency: Duration::from_millis(millis),
        bytes: 100,
    }
}

#[test]
fn periods_count_what_came_in_them() {
    let start = Instant::now();
    let second = |count| start + Duration::from_secs(count);
    let mut stats = SubscriptionStats::new(start);
    for sequence in [1, 2, 4] {
        stats.add(&arrival(1, sequence, 1), second(1));
    }
    let first = stats.take_recent(second(1));
    assert_eq!(first.counters.received, 3);
    assert_eq!(first.counters.lost, 1);
    assert_eq!(first.seconds, 1.0);
    // 3 fills the gap, 4 is a repeat, and another writer counts for itself.
    stats.add(&arrival(1, 3, 100), second(2));
    stats.add(&arrival(1, 4, 100), second(2));
    stats.add(&arrival(2, 50, 100), second(2));
    let recent = stats.take_recent(second(3));
    assert_eq!(
        recent.counters,
        Counters {
            received: 3,
            bytes: 300,
            lost: 0,
            duplicated: 1,
            reordered: 1
        }
    );
    assert!((recent.p50_ms.unwrap() - 100.0).abs() < 12.5);
    let total = stats.total(second(5));
    assert_eq!(total.seconds, 4.0);
    assert_eq!(
        total.counters,
        Counters {
            received: 6,
            bytes: 600,
            lost: 0,
            duplicated: 1,
            reordered: 1
        }
    );
    assert_eq!(stats.first.unwrap().1, 1_000_000);
    assert_eq!(stats.last, Some((second(2), 50_000_000)));
}

#[test]
fn writers_are_bounded() {
    let start = Instant::now();
    let mut stats = SubscriptionStats::new(start);
    for index in 0..3_000u64 {
        let mut writer = [0; 16];
        writer[..8].copy_from_slice(&index.to_le_bytes());
        let message = Arrival {
            writer: WriterId(writer),
            ..arrival(0, 1, 1)
        };
        stats.add(&message, start);
    }
    assert_eq!(stats.counters().received, 3_000);
    assert_eq!(stats.writers.len(), MAX_WRITERS);
}
