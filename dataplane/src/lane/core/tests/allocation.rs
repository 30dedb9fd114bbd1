//! The allocator's word at the lanes: who is thinned, to what, and who is not.

use blaze_domain::node_file::{BandwidthSection, WireOverhead};

use super::*;
use crate::lane::allocation::LaneFacts;
use crate::limit::limiter::Limiter;
use crate::link::Begun;

const MILLISECOND: Duration = Duration::from_millis(1);

/// A flow that publishes one topic to the cloud, and its limiter.
struct Limited {
    bench: Bench,
    limiter: Limiter,
    sequence: u64,
}

impl Limited {
    fn new(limit_bytes_per_s: f64, lane: LaneSpec, rate_hz: Option<f64>) -> Self {
        let bridge = Bridge { lane, ..bridge(Scope::Node, to_cloud()) };
        Self::with(limit_bytes_per_s, vec![bridge], rate_hz)
    }

    fn with(limit_bytes_per_s: f64, bridges: Vec<Bridge>, rate_hz: Option<f64>) -> Self {
        let mut bench = Bench::new(Vec::new());
        let info = TopicInfo { rate_hz, ..TopicInfo::default() };
        bench.apply(bridges, info);
        let limiter = Limiter::new(BandwidthSection {
            limit_mbps: limit_bytes_per_s * 8.0 / (1024.0 * 1024.0),
            overhead: 1.0,
            per_message_share: 1.0,
            min_rate_hz: 0.0,
            wire_overhead: WireOverhead::Off,
            ..BandwidthSection::default()
        });
        let mut limited = Self { bench, limiter, sequence: 0 };
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

    /// Publishes one message, which the lane has sent at once if it passes.
    fn post(&mut self, from: Scope, hops: u32, bytes: usize) {
        self.sequence += 1;
        let before = self.bench.link.submitted.len();
        let frame = frame(1 + from as u8, self.sequence, "robot-1", hops, bytes);
        self.bench.take(from, vec![Content::Frame(frame)]);
        for (lane, ..) in &self.bench.link.submitted[before..] {
            let now = self.bench.now;
            self.bench.core.lane_sent(now, *lane, bytes as u64, Duration::ZERO);
        }
        let grown = self.bench.core.take_allocation_due();
        if self.bench.core.take_lanes_changed() || grown {
            self.allocate();
        }
    }

    /// Publishes at a rate for so many seconds, and works the rates out every half of one. How many
    /// passed.
    fn publish(&mut self, hz: u32, bytes: usize, seconds: u32) -> usize {
        let before = self.bench.link.submitted.len();
        let every = Duration::from_secs(1) / hz;
        for message in 1..=hz * seconds {
            self.post(Scope::Node, 0, bytes);
            self.bench.now += every;
            if message % (hz / 2).max(1) == 0 {
                self.allocate();
            }
        }
        self.bench.link.submitted.len() - before
    }

    fn rates(&self) -> Vec<Option<f64>> {
        self.path().bridges.iter().map(|bridge| bridge.allocated_hz).collect()
    }

    /// What is shown of the lanes of the topic.
    fn lanes(&mut self) -> Vec<LaneFacts> {
        let (facts, _) = self.bench.core.allocation_facts(self.bench.now, None, 10);
        facts.into_iter().flat_map(|topic| topic.lanes).collect()
    }

    fn path(&self) -> &TopicPath {
        self.bench.core.path(self.bench.topic)
    }

    fn dropped(&self) -> Vec<(DropReason, u64)> {
        let bridges = self.path().bridges.iter();
        let mut all: BTreeMap<DropReason, u64> = BTreeMap::new();
        for (reason, count) in bridges.flat_map(|bridge| bridge.stats.dropped.iter()) {
            *all.entry(reason).or_default() += count;
        }
        all.into_iter().collect()
    }
}

#[test]
fn a_large_topic_is_thinned_to_what_the_budget_holds() {
    let mut limited = Limited::new(1_000_000.0, lane_spec(), Some(30.0));
    limited.publish(30, 100_000, 1);
    let passed = limited.publish(30, 100_000, 10);
    assert!((99..=101).contains(&passed), "{passed} images of 100 kB in 10 s at 1 MB/s");
    let path = limited.path();
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
        limited.post(Scope::Node, 0, 100);
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
    let lane = lane_with(|lane| lane.reliable = true);
    let mut limited = Limited::new(1_000_000.0, lane, Some(10.0));
    limited.publish(100, 100, 20);
    assert_eq!(limited.dropped(), []);
    let granted = limited.path().granted.unwrap();
    assert!((granted.advertised_hz - 100.0).abs() < 11.0, "{granted:?}");
}

#[test]
fn a_rate_that_nobody_gave_is_measured() {
    let mut limited = Limited::new(1_000_000.0, lane_spec(), None);
    limited.publish(30, 100_000, 8);
    let passed = limited.publish(30, 100_000, 10);
    assert!((99..=101).contains(&passed), "{passed}");
    let granted = limited.path().granted.unwrap();
    assert!((granted.advertised_hz - 30.0).abs() <= 3.0, "{granted:?}");
}

#[test]
fn a_larger_message_lowers_the_rate_at_once() {
    let mut limited = Limited::new(1_000_000.0, lane_spec(), Some(30.0));
    limited.publish(30, 100_000, 2);
    limited.publish(30, 200_000, 1);
    let allocated = limited.path().bridges[0].allocated_hz;
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
    let lane = lane_with(|lane| lane.max_rate_hz = Some(5.0));
    let mut limited = Limited::new(1_000_000.0, lane, Some(30.0));
    let passed = limited.publish(30, 100_000, 10);
    assert!((49..=53).contains(&passed), "{passed}");
    let dropped = limited.dropped();
    assert!(dropped.iter().all(|(reason, _)| *reason == DropReason::MaxRate), "{dropped:?}");
}

/// As LZ4 makes images: the wire carries less than the largest of them each time, and ω has to
/// know.
#[test]
fn each_message_is_reckoned_as_the_largest() {
    let mut limited = Limited::new(1e9, lane_spec(), Some(10.0));
    for message in 0..100 {
        limited.post(Scope::Node, 0, if message % 2 == 0 { 100_000 } else { 40_000 });
        limited.bench.now += MILLISECOND * 100;
    }
    let cloud: LayerName = "cloud".parse().unwrap();
    let reckoned = limited.bench.core.reckoned(std::iter::empty());
    assert_eq!((reckoned.all, reckoned.by_layer[&cloud]), (10_000_000, 10_000_000));
    // A lane that is forgotten takes nothing of it along.
    limited.bench.apply(Vec::new(), TopicInfo::default());
    limited.bench.link.waiting.clear();
    limited.bench.drain();
    limited.bench.now += FORGET;
    limited.bench.core.forget_unused(limited.bench.now);
    limited.bench.core.forget_unused(limited.bench.now + FORGET);
    assert_eq!(limited.bench.core.reckoned(std::iter::empty()), reckoned);
}

/// An image takes seconds on a slow link: what of it has left counts, or the wire factor would jump
/// with each.
#[test]
fn a_message_that_is_being_sent_is_reckoned_by_what_has_left() {
    let mut limited = Limited::new(1e9, lane_spec(), Some(10.0));
    limited.post(Scope::Node, 0, 100_000);
    let (lane, ..) = limited.bench.link.submitted[0];
    let of = |parts_sent| {
        let begun = Begun { payload_bytes: 40_000, parts_sent, parts: 50 };
        limited.bench.core.reckoned(std::iter::once((lane, begun))).all
    };
    assert_eq!((of(0), of(10), of(50)), (100_000, 120_000, 200_000));
    // And if the rest of it is dropped that does not come back.
    let begun = Begun { payload_bytes: 40_000, parts_sent: 10, parts: 50 };
    limited.bench.core.lane_cut(lane, begun);
    assert_eq!(limited.bench.core.reckoned(std::iter::empty()).all, 120_000);
}

/// Five seconds hold five messages of it or six, which is a tenth more than 1.09 Hz.
#[test]
fn a_slow_publisher_is_not_taken_for_one_that_exceeds() {
    let mut limited = Limited::new(1_000_000.0, lane_spec(), Some(1.09));
    for _ in 0..300 {
        limited.post(Scope::Node, 0, 350);
        limited.bench.now += Duration::from_secs_f64(1.0 / 1.09);
        limited.allocate();
        assert!(!limited.path().bridges[0].exceeds_advertised);
    }
    assert_eq!(limited.dropped(), []);
}

#[test]
fn whoever_exceeds_is_said_to_until_it_does_not_any_more() {
    let mut limited = Limited::new(1_000_000.0, lane_spec(), Some(10.0));
    limited.publish(100, 100, 8);
    let held = limited.lanes().remove(0);
    assert!(held.exceeds_advertised && held.limited && held.skipped > 0, "{held:?}");
    assert_eq!(held.allocated_hz, Some(10.0));
    limited.publish(10, 100, 8);
    let free = limited.lanes().remove(0);
    assert!(
        !free.exceeds_advertised && !free.limited && free.allocated_hz == Some(10.0),
        "{free:?}"
    );
}

/// What a flow wrote to the layer scope stays in the layer, however large and often that is.
#[test]
fn what_does_not_leave_says_nothing_of_the_lanes() {
    let mut limited = Limited::with(1e9, vec![bridge(Scope::Layer, to_cloud())], None);
    for _ in 0..8 {
        limited.post(Scope::Layer, 0, 1_000);
        for _ in 0..10 {
            limited.post(Scope::Layer, 1, 500_000);
            limited.bench.now += MILLISECOND * 100;
        }
        limited.allocate();
    }
    assert_eq!(limited.bench.link.submitted.len(), 8);
    let granted = limited.path().granted.unwrap();
    assert_eq!(granted.size_bytes, 1_000);
    assert!((granted.advertised_hz - 1.0).abs() < 0.11, "{granted:?}");
}

/// Services of the node and of the layer publish it, and one flow of the cloud gets both.
#[test]
fn what_goes_to_one_receiver_from_two_scopes_is_one_lane() {
    let both = |max_rate_hz| {
        let of = |from| {
            let mut bridge = bridge(from, to_cloud());
            bridge.lane.max_rate_hz = max_rate_hz;
            bridge
        };
        vec![of(Scope::Node), of(Scope::Layer)]
    };
    let publish = |limited: &mut Limited, scopes: [Scope; 2], seconds: u32| {
        let before = limited.bench.link.submitted.len();
        for message in 0..40 * seconds {
            limited.post(scopes[message as usize % 2], 0, 100_000);
            limited.bench.now += MILLISECOND * 25;
            if message % 20 == 0 {
                limited.allocate();
            }
        }
        limited.bench.link.submitted.len() - before
    };
    let mut limited = Limited::with(1_000_000.0, both(None), Some(40.0));
    publish(&mut limited, [Scope::Node, Scope::Layer], 2);
    let wanted = limited.bench.core.wanted(limited.bench.now);
    assert_eq!(wanted.demands()[0].lanes.len(), 1, "one copy");
    for scopes in
        [[Scope::Node, Scope::Layer], [Scope::Layer, Scope::Layer], [Scope::Node, Scope::Node]]
    {
        let passed = publish(&mut limited, scopes, 10);
        assert!((99..=101).contains(&passed), "{passed} in 10 s from {scopes:?}");
    }
    assert_eq!(limited.rates(), [Some(10.0); 2]);
    assert_eq!(limited.lanes().len(), 1);
    // What is asked for at most is asked for together, too.
    let mut limited = Limited::with(1_000_000.0, both(Some(5.0)), Some(40.0));
    publish(&mut limited, [Scope::Node, Scope::Layer], 2);
    let passed = publish(&mut limited, [Scope::Node, Scope::Layer], 10);
    assert!((49..=51).contains(&passed), "{passed} in 10 s");
    let dropped = limited.dropped();
    assert!(dropped.iter().all(|(reason, _)| *reason == DropReason::MaxRate), "{dropped:?}");
}

/// Else a flow that has to skip half would seem to carry no more than it can.
#[test]
fn what_the_budget_skips_is_load_and_what_nobody_asks_for_is_not() {
    let lane = lane_with(|lane| lane.max_rate_hz = Some(20.0));
    let mut limited = Limited::new(1_000_000.0, lane, Some(40.0));
    let mut load = 0;
    for _ in 0..20 {
        limited.publish(40, 100_000, 1);
        load = limited.bench.core.measure(limited.bench.now, &limited.bench.link).out_bytes_per_s;
    }
    assert!((1_900_000..2_200_000).contains(&load), "{load}: 20 of 40 messages, of which 10 fit");
    let dropped: BTreeMap<_, _> = limited.dropped().into_iter().collect();
    assert!(
        dropped[&DropReason::RateLimit] > 150 && dropped[&DropReason::MaxRate] > 350,
        "{dropped:?}"
    );
}

#[test]
fn what_is_kept_for_late_joiners_passes_whatever_the_rate() {
    let lane = lane_with(|lane| (lane.max_rate_hz, lane.durable) = (Some(1.0), true));
    let mut limited = Limited::new(1_000.0, lane, None);
    let now = limited.bench.now;
    let mut batch: Vec<Received> = (1..=20u8)
        .map(|writer| Received {
            kept: true,
            ..received(Content::Frame(frame(writer, 1, "robot-1", 0, 1_000)), now)
        })
        .collect();
    let (core, link) = (&mut limited.bench.core, &mut limited.bench.link);
    core.ingest(now, WALL, limited.bench.topic, Scope::Node, &mut batch, link);
    assert_eq!(limited.bench.link.submitted.len(), 20);
    assert_eq!(limited.dropped(), []);
    limited.bench.now += Duration::from_secs(1);
    limited.allocate();
    let granted = limited.path().granted.unwrap();
    assert_eq!((granted.size_bytes, granted.advertised_hz), (1_000, 0.0), "it is no rate");
}

#[test]
fn a_lane_that_drains_has_no_rate_any_more() {
    let to_fog =
        Target::Inter { layer: "fog".parse().unwrap(), receiver: "fog/fog-1".parse().unwrap() };
    let (cloud, fog) = (bridge(Scope::Node, to_cloud()), bridge(Scope::Node, to_fog));
    let mut limited = Limited::with(1_000_000.0, vec![cloud, fog.clone()], Some(30.0));
    limited.publish(30, 100_000, 2);
    assert_eq!(limited.rates(), [Some(5.0); 2]);
    let info = TopicInfo { rate_hz: Some(30.0), ..TopicInfo::default() };
    limited.bench.apply(vec![fog], info);
    assert!(limited.bench.core.take_lanes_changed());
    limited.allocate();
    assert_eq!(limited.rates(), [None, Some(10.0)]);
    let lanes: Vec<_> = limited
        .lanes()
        .into_iter()
        .map(|lane| (lane.receiver.to_string(), lane.allocated_hz))
        .collect();
    assert_eq!(lanes, [("cloud/cloud-1".to_owned(), None), ("fog/fog-1".to_owned(), Some(10.0))]);
    limited.bench.apply(Vec::new(), TopicInfo::default());
    limited.allocate();
    assert_eq!(limited.rates(), [None, None]);
    assert!(
        limited.path().granted.is_none() && limited.bench.core.wanted(limited.bench.now).is_empty()
    );
    assert!(limited.lanes().is_empty());
}

#[test]
fn facts_are_taken_a_few_topics_at_a_time() {
    let mut limited = Limited::new(1_000_000.0, lane_spec(), Some(1.0));
    let now = limited.bench.now;
    for name in ["a", "b", "c", "d"] {
        limited.bench.add(name, vec![bridge(Scope::Node, to_cloud())]);
    }
    limited.allocate();
    let (mut names, mut after) = (Vec::new(), None);
    loop {
        let (facts, last) = limited.bench.core.allocation_facts(now, after, 2);
        assert!(facts.len() <= 2);
        names.extend(facts.iter().map(|facts| facts.name.to_string()));
        after = last;
        if last.is_none() {
            break;
        }
    }
    assert_eq!(names, ["imu/data", "a", "b", "c", "d"]);
}

/// Images are admitted as unevenly as they come. Of a fast topic one more may wait for that; of a
/// slow one an older image is of no use.
#[test]
fn of_a_fast_topic_more_than_one_image_may_wait() {
    for (bytes_per_s, waiting) in [(1_000_000.0, 1), (2_500_000.0, 3)] {
        let mut limited = Limited::new(bytes_per_s, lane_spec(), Some(30.0));
        limited.publish(30, 100_000, 2);
        let bridge = &limited.path().bridges[0];
        assert_eq!(bridge.keep_newest(), waiting, "{:?}", bridge.allocated_hz);
    }
}
