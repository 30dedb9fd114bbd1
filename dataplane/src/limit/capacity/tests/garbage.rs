//! Whatever comes, it neither panics nor leaves its bounds.

use std::time::{Duration, Instant};

use super::super::*;
use crate::testing::Random;

const BYTES: [u64; 6] = [0, 1, 1400, 1_000_000, u64::MAX / 2, u64::MAX];
const NANOSECONDS: [u64; 7] =
    [0, 1, 1_000_000, 50_000_000, 2_000_000_000, 40_000_000_000, u64::MAX];
const LIMITS: [f64; 10] =
    [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -1.0, 0.0, 1e-300, 1.0, 1e5, 2e7, 1e300];

fn is_sound(capacity: &Capacity, limit: f64) {
    let rate = capacity.bytes_per_s();
    let least = FLOOR_BYTES_PER_S.max(limit * FLOOR_SHARE).min(limit);
    assert!((least..=limit).contains(&rate), "{rate} of {limit}");
    assert!(capacity.measured().is_none_or(|measured| measured > 0.0 && measured <= limit));
    assert!((0.0..=1.0).contains(&capacity.loss.ordinary));
}

#[test]
fn garbage_does_no_harm() {
    for seed in 0..200 {
        let mut random = Random(seed);
        let start = Instant::now() + Duration::from_secs(100);
        let mut now = start;
        let mut limit = 1e6;
        let mut capacity = Capacity::new(limit, now);
        for _ in 0..2000 {
            let mut any = |of: &[u64]| of[random.below(of.len() as u64) as usize];
            let (bytes, lost, nanoseconds) = (any(&BYTES), any(&BYTES), any(&NANOSECONDS));
            match random.below(20) {
                0 => capacity.outage(now),
                1 => {
                    let told = LIMITS[random.below(LIMITS.len() as u64) as usize];
                    capacity.set_limit(told, now);
                    limit = if told > 1.0 { told.min(1e12) } else { 1.0 };
                }
                // Time goes back, stands still, or goes on.
                2 => now = start.checked_sub(Duration::from_secs(random.below(100))).unwrap(),
                3..8 => now += Duration::from_millis(random.below(200)),
                8..11 => capacity.sent(now, usize::try_from(bytes).unwrap_or(usize::MAX)),
                11 => capacity.set_needed(LIMITS[random.below(LIMITS.len() as u64) as usize], now),
                _ => {
                    let seen = Seen {
                        delivered_bytes: bytes,
                        lost_bytes: lost,
                        round_trip: (nanoseconds > 1).then(|| Duration::from_nanos(nanoseconds)),
                    };
                    capacity.feedback(now, &seen);
                }
            }
            is_sound(&capacity, limit);
        }
    }
}

#[test]
fn it_recovers_from_garbage() {
    let mut now = Instant::now();
    let mut capacity = Capacity::new(1e6, now);
    let garbage = [
        (u64::MAX, 0, Duration::ZERO),
        (0, u64::MAX, Duration::MAX),
        (1400, 1400, Duration::from_secs(29)),
    ];
    for (delivered_bytes, lost_bytes, round_trip) in garbage {
        capacity.sent(now, usize::MAX);
        capacity.feedback(now, &Seen { delivered_bytes, lost_bytes, round_trip: Some(round_trip) });
    }
    for _ in 0..2000 {
        now += Duration::from_millis(50);
        for _ in 0..5 {
            capacity.sent(now, (capacity.bytes_per_s() / 100.0) as usize);
        }
        let seen = Seen {
            delivered_bytes: (capacity.bytes_per_s() / 20.0) as u64,
            lost_bytes: 0,
            round_trip: Some(Duration::from_millis(50)),
        };
        capacity.feedback(now, &seen);
    }
    assert!(capacity.bytes_per_s() >= 1e6);
    assert_eq!(capacity.state(), State::Unknown);
}
