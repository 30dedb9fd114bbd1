//! The allocator's word at the lanes: who is thinned, to what, and who is not.

use blaze_domain::node_file::{BandwidthSection, WireOverhead};

use super::*;
use crate::limit::limiter::Limiter;

const MILLISECOND: Duration = Duration::from_millis(1);

/// A flow that publishes one topic to the cloud, and its limiter.
struct Limited {
    bench: Bench,
    limiter: Limiter,
    sequence: u64,
}

impl Limited {
    fn new(limit_bytes_per_s: f64, lane: crate::plan::LaneSpec, rate_hz: Option<f64>) -> Self {
        let mut bench = Bench::new(Vec::new());
        let bridge = Bridge {
            lane,
            ..bridge(Scope::Node, to_cloud())
        };
        let info = TopicInfo {
            rate_hz,
            ..TopicInfo::default()
        };
        bench.apply(vec![bridge], info);
        let limiter = Limiter::new(BandwidthSection {
            limit_mbps: limit_bytes_per_s * 8.0 / (1024.0 * 1024.0),
            overhead: 1.0,
            per_message_share: 1.0,
            min_rate_hz: 0.0,
            wire_overhead: WireOverhead::Off,
            ..BandwidthSection::default()
        });
        let mut limited = Self {
            bench,
            limiter,
            sequence: 0,
        };
        limited.allocate();
        limited
    }

    fn allocate(&mut self) {
        let now = self.bench.now;
        self.bench.core.look_at_rates(now, None);
        let wanted = self.bench.core.wanted(now);
        let rates = self.limiter.run(now, &wanted.demands()).clone();
        self.bench.core.set_rates(now, &wanted, &rates);
    }

    /// Publishes at a rate for so many seconds, and works the rates out every half of one. How many passed.
    fn publish(&mut self, hz: u32, bytes: usize, seconds: u32) -> usize {
        let before = self.bench.link.submitted.len();
        let every = Duration::from_secs(1) / hz;
        for message in 1..=hz * seconds {
            self.sequence += 1;
            let frame = frame(1, self.sequence, "robot-1", 0, bytes);
            self.bench.take(Scope::Node, vec![Content::Frame(frame)]);
            self.bench.now += every;
            if message % (hz / 2).max(1) == 0 || self.bench.core.take_allocation_due() {
                self.allocate();
            }
        }
        self.bench.link.submitted.len() - before
    }

    fn dropped(&self) -> Vec<(DropReason, u64)> {
        self.bench.core.path(self.bench.topic).bridges[0].stats.dropped.iter().collect()
    }
}

#[test]
fn a_large_topic_is_thinned_to_what_the_budget_holds() {
    let mut limited = Limited::new(1_000_000.0, lane_spec(), Some(30.0));
    limited.publish(30, 100_000, 1);
    let passed = limited.publish(30, 100_000, 10);
    assert!((99..=101).contains(&passed), "{passed} images of 100 kB in 10 s at 1 MB/s");
    let path = limited.bench.core.path(limited.bench.topic);
    assert_eq!(path.granted.map(|granted| granted.size_bytes), Some(100_000));
    assert_eq!(path.bridges[0].allocated_hz, Some(10.0));
    let dropped = limited.dropped();
    assert!(dropped.len() == 1 && dropped[0].0 == DropReason::RateLimit, "{dropped:?}");
}

#[test]
fn whoever_gets_all_is_not_thinned_by_its_own_irregularity() {
    let mut limited = Limited::new(1_000_000.0, lane_spec(), Some(50.0));
    limited.publish(50, 100, 1);
    // Six messages at once after a pause: a bucket of two would let two pass.
    limited.bench.now += MILLISECOND * 120;
    for _ in 0..6 {
        limited.sequence += 1;
        let frame = frame(1, limited.sequence, "robot-1", 0, 100);
        limited.bench.take(Scope::Node, vec![Content::Frame(frame)]);
    }
    limited.publish(51, 100, 10);
    assert_eq!(limited.dropped(), []);
}

#[test]
fn whoever_publishes_far_more_than_it_says_is_held_to_its_word() {
    let mut limited = Limited::new(1_000_000.0, lane_spec(), Some(10.0));
    limited.publish(100, 100, 8);
    let passed = limited.publish(100, 100, 10);
    assert!((99..=102).contains(&passed), "{passed}");
}

#[test]
fn but_a_reliable_lane_is_not() {
    let lane = crate::plan::LaneSpec {
        reliable: true,
        ..lane_spec()
    };
    let mut limited = Limited::new(1_000_000.0, lane, Some(10.0));
    limited.publish(100, 100, 20);
    assert_eq!(limited.dropped(), []);
    let granted = limited.bench.core.path(limited.bench.topic).granted.unwrap();
    assert!((granted.advertised_hz - 100.0).abs() < 11.0, "{granted:?}");
}

#[test]
fn a_rate_that_nobody_gave_is_measured() {
    let mut limited = Limited::new(1_000_000.0, lane_spec(), None);
    limited.publish(30, 100_000, 8);
    let passed = limited.publish(30, 100_000, 10);
    assert!((99..=101).contains(&passed), "{passed}");
    let granted = limited.bench.core.path(limited.bench.topic).granted.unwrap();
    assert!((granted.advertised_hz - 30.0).abs() <= 3.0, "{granted:?}");
}

#[test]
fn a_larger_message_lowers_the_rate_at_once() {
    let mut limited = Limited::new(1_000_000.0, lane_spec(), Some(30.0));
    limited.publish(30, 100_000, 2);
    limited.publish(30, 200_000, 1);
    let allocated = limited.bench.core.path(limited.bench.topic).bridges[0].allocated_hz;
    assert_eq!(allocated, Some(5.0));
}

#[test]
fn a_new_limit_holds_from_the_next_run_on() {
    let mut limited = Limited::new(1_000_000.0, lane_spec(), Some(30.0));
    limited.publish(30, 100_000, 2);
    limited.limiter.set_bandwidth(BandwidthSection {
        limit_mbps: 4_000_000.0 * 8.0 / (1024.0 * 1024.0),
        ..limited.limiter.bandwidth().clone()
    });
    assert!(limited.limiter.is_due(limited.bench.now + MILLISECOND * 20));
    limited.allocate();
    limited.publish(30, 100_000, 1);
    assert_eq!(limited.publish(30, 100_000, 10), 300);
}

/// What a requester asks for is the smaller, and gives the reason.
#[test]
fn a_lane_runs_at_the_smaller_of_asked_and_allocated() {
    let lane = crate::plan::LaneSpec {
        max_rate_hz: Some(5.0),
        ..lane_spec()
    };
    let mut limited = Limited::new(1_000_000.0, lane, Some(30.0));
    let passed = limited.publish(30, 100_000, 10);
    assert!((49..=53).contains(&passed), "{passed}");
    let dropped = limited.dropped();
    assert!(dropped.iter().all(|(reason, _)| *reason == DropReason::MaxRate), "{dropped:?}");
}
