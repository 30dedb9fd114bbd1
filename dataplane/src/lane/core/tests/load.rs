//! What bridges carry, and which topics another flow could go on with.

use blaze_brokers::{Begin, ConsumerOffset};

use super::*;
use crate::lane::load::{Loads, TopicLoad};

const SECOND: Duration = Duration::from_secs(1);

fn to_node() -> Target {
    Target::Node(Form::Framed)
}

impl Bench {
    /// A bridge out of the layer, and one into it.
    fn of_layer() -> Self {
        let mut bench = Self::new(vec![
            bridge(Scope::Layer, to_cloud()),
            bridge(Scope::Inter, Target::Layer { json: false }),
        ]);
        bench.core.reads_from(bench.topic, &[0]);
        bench
    }

    /// Messages of 1000 bytes of a service of the layer, from an offset on; the lane has sent them.
    fn publish_on_layer(&mut self, offsets: std::ops::Range<i64>) {
        let received = |offset: i64| Received {
            content: Content::Frame(frame(1, offset as u64 + 1, "", 0, 1000)),
            at: self.now,
            broker_age_us: 0,
            kept: false,
            place: Some(ConsumerOffset { partition: 0, offset, appended_ms: None }),
        };
        let mut batch: Vec<Received> = offsets.clone().map(received).collect();
        self.core.ingest(self.now, WALL, self.topic, Scope::Layer, &mut batch, &mut self.link);
        for _ in offsets {
            self.core.lane_sent(self.now, LaneId(0), 1000, Duration::ZERO);
        }
    }

    /// So many seconds with ten messages each, measured each second.
    fn run(&mut self, seconds: std::ops::Range<i64>) -> Loads {
        let mut loads = Loads::default();
        for second in seconds {
            self.publish_on_layer(second * 10..second * 10 + 10);
            self.link.waiting.clear();
            self.now += SECOND;
            loads = self.core.measure(self.now, &self.link);
        }
        loads
    }

    fn may_move(&mut self) -> bool {
        self.core.measure(self.now, &self.link).carried[0].may_move
    }
}

#[test]
fn both_directions_are_measured_and_the_carried_topics_are_told() {
    let mut bench = Bench::of_layer();
    assert!(!bench.run(0..3).carried[0].may_move, "measured for too short a time");
    let loads = bench.run(3..6);
    let carried =
        TopicLoad { topic: "imu/data".parse().unwrap(), bytes_per_s: 10_000, may_move: true };
    assert_eq!((loads.out_bytes_per_s, loads.in_bytes_per_s), (10_000, 0));
    assert_eq!(loads.carried, [carried]);
    bench.deliver(message(["fog", "", ""], 9, 1, 0, 6000).with_hops_and_age(1, 0));
    let taken_in = bench.run(6..7).in_bytes_per_s;
    assert!((500..1500).contains(&taken_in), "6000 bytes in one of seven seconds: {taken_in}");
}

#[test]
fn what_is_thinned_weighs_what_is_left() {
    let mut thinned = bridge(Scope::Layer, to_cloud());
    thinned.lane.max_rate_hz = Some(2.0);
    let mut bench = Bench::new(vec![thinned]);
    let loads = bench.run(0..20);
    assert!((1_500..3_000).contains(&loads.out_bytes_per_s), "{loads:?}");
}

#[test]
fn a_topic_whose_lane_is_behind_or_whose_peer_is_silent_stays() {
    let mut bench = Bench::of_layer();
    assert!(bench.run(0..8).carried[0].may_move);
    // Ten a second: in a quarter of a second two or three leave, and one more may be on its way.
    for (queued, silent, may_move) in
        [(0, true, true), (1, true, false), (3, false, true), (4, false, false)]
    {
        bench.link.waiting.insert(LaneId(0), queued);
        bench.link.refuse = silent;
        assert_eq!(bench.may_move(), may_move, "{queued} queued, silent {silent}");
    }
}

#[test]
fn a_topic_that_cannot_be_handed_over_exactly_stays() {
    let mut bench = Bench::of_layer();
    assert!(bench.run(0..8).carried[0].may_move);
    bench.core.reads_from(bench.topic, &[7; 9]);
    assert!(!bench.may_move(), "too many partitions");
    bench.core.reads_from(bench.topic, &[]);
    assert!(!bench.may_move(), "a broker without places");
    bench.core.reads_from(bench.topic, &[7; 8]);
    assert!(bench.may_move());
    let mut durable = bridge(Scope::Layer, to_cloud());
    durable.lane.durable = true;
    bench.apply(vec![durable], TopicInfo::default());
    assert!(!bench.may_move(), "what is kept would be sent again");
    bench.apply(vec![bridge(Scope::Layer, to_cloud())], TopicInfo::default());
    assert!(!bench.may_move(), "the bridge into the layer drains");
    bench.now += DRAIN;
    bench.drain();
    assert!(bench.may_move());
}

#[test]
fn a_topic_that_is_given_up_is_emptied_when_its_last_message_has_left() {
    let mut bench = Bench::of_layer();
    bench.run(0..2);
    let name: TopicName = "imu/data".parse().unwrap();
    bench.link.waiting.insert(LaneId(0), 1);
    bench.apply(vec![], TopicInfo::default());
    assert_eq!(bench.core.stopped_at(bench.topic), [20]);
    bench.drain();
    assert!(!bench.core.has_emptied(&name));
    assert_eq!(
        bench.core.measure(bench.now, &bench.link).out_bytes_per_s,
        0,
        "it takes nothing in"
    );
    bench.link.waiting.clear();
    bench.drain();
    assert!(bench.core.has_emptied(&name));
}

/// Taken back after a moment, a topic goes on where it stopped, though its source read on a little.
#[test]
fn what_was_read_after_the_last_bridge_is_read_again() {
    let mut bench = Bench::of_layer();
    bench.publish_on_layer(0..5);
    bench.apply(vec![bridge(Scope::Inter, Target::Layer { json: false })], TopicInfo::default());
    let stopped = bench.core.stopped_at(bench.topic);
    bench.publish_on_layer(5..8);
    // The node's source ends, too: it has no places.
    bench.core.reads_no_more(bench.topic, Scope::Node);
    assert_eq!(bench.core.stopped_at(bench.topic), stopped);
    bench.core.reads_no_more(bench.topic, Scope::Layer);
    assert_eq!(bench.link.submitted.len(), 5);
    bench.apply(vec![bridge(Scope::Layer, to_cloud())], TopicInfo::default());
    let begin = Begin::At(stopped.into());
    bench.core.takes_over(bench.topic, &begin);
    assert_eq!(bench.core.begin_reading(bench.topic, false), begin);
    bench.core.reads_from(bench.topic, &[5]);
    bench.publish_on_layer(5..9);
    assert_eq!(bench.submitted(), (1..=9).collect::<Vec<u64>>());
    assert_eq!(bench.drops(), []);
}

#[test]
fn a_topic_that_is_read_on_for_its_node_is_taken_back_without_a_gap_either() {
    let both = vec![bridge(Scope::Layer, to_cloud()), bridge(Scope::Layer, to_node())];
    let mut bench = Bench::new(both.clone());
    bench.core.reads_from(bench.topic, &[0]);
    bench.publish_on_layer(0..5);
    bench.apply(vec![bridge(Scope::Layer, to_node())], TopicInfo::default());
    let stopped = bench.core.stopped_at(bench.topic);
    bench.publish_on_layer(5..8);
    bench.apply(both, TopicInfo::default());
    let begin = Begin::At(stopped.into());
    bench.core.takes_over(bench.topic, &begin);
    assert_eq!(bench.core.begin_reading(bench.topic, true), begin);
    bench.core.reads_from(bench.topic, &[5]);
    bench.publish_on_layer(5..9);
    let all: Vec<u64> = (1..=9).collect();
    assert_eq!(bench.submitted(), all);
    assert_eq!(bench.written(), all, "each once");
}
