//! From the gates of the lanes to their queues.

use super::*;

const TENTH: Duration = Duration::from_millis(100);

/// A message is compressed once for all lanes: what the one could do without the other needs.
#[test]
fn a_reliable_lane_keeps_all_beside_a_best_effort_one() {
    let best_effort = || lane("fog/f", false);
    let mut hands = Hands::new(vec![lane("cloud/c", true), best_effort()]);
    hands.publish_all(1, 1..=3, LARGE);
    // Even while it empties its queue.
    hands.plan(vec![best_effort()]);
    hands.publish_all(1, 4..=5, LARGE);
    hands.run();
    let sent = hands.sent();
    let of = |lane: u32| -> Vec<u64> {
        let of_lane = sent.iter().filter(|(at, ..)| *at == lane);
        of_lane.map(|(.., sequence)| *sequence).collect()
    };
    assert_eq!((of(0), of(1)), (vec![1, 2, 3], vec![1, 2, 3, 4, 5]));
    assert_eq!((hands.dropped(0), hands.dropped(1)), (vec![], vec![]));
    hands.check();
}

#[test]
fn of_large_best_effort_messages_the_newest_wait_and_what_is_begun_stays() {
    let mut hands = Hands::new(vec![lane("cloud/c", false)]);
    hands.publish_all(1, 1..=5, LARGE);
    assert_eq!((hands.quick, hands.long), (0, 1), "who replaces another has its request");
    assert_eq!(hands.dropped(0), [(DropReason::QueueFull, 4)], "at once");
    hands.begin(Urgency::Long);
    hands.publish_all(1, 6..=8, LARGE);
    hands.run();
    assert_eq!(hands.sent(), [(0, 1, 5), (0, 1, 8)]);
    let mut deep = lane("cloud/c", false);
    deep.lane.depth = 3;
    hands.plan(vec![deep]);
    hands.publish_all(1, 9..=14, LARGE);
    hands.run();
    assert_eq!(hands.sent(), [(0, 1, 12), (0, 1, 13), (0, 1, 14)]);
    hands.check();
}

#[test]
fn small_messages_never_give_way_and_need_not_wait_for_large_ones() {
    let mut hands = Hands::new(vec![lane("cloud/c", false)]);
    let other = hands.bench.add("odom", vec![lane("cloud/c", false)]);
    hands.publish_on(other, LARGE);
    hands.publish_all(1, 1..=5, SMALL);
    assert_eq!((hands.quick, hands.long), (5, 1));
    hands.run();
    assert_eq!(hands.dropped(0), []);
    // Large by its bytes alone: it takes its time, and is none that newer ones make worthless.
    hands.bench.core.set_large_bytes(1 << 20);
    hands.publish_all(1, 6..=8, 200_000);
    assert_eq!((hands.quick, hands.long), (0, 3));
    hands.run();
    assert_eq!(hands.dropped(0), []);
    hands.check();
}

/// Who publishes often would else never be begun with.
#[test]
fn a_frame_that_replaces_a_waiting_one_has_its_turn() {
    let mut hands = Hands::new(vec![lane("cloud/c", false)]);
    hands.publish(1, 1, LARGE);
    hands.publish(2, 1, LARGE);
    hands.publish_all(1, 2..=9, LARGE);
    assert_eq!(hands.long, 2);
    hands.begin(Urgency::Long);
    hands.end(0);
    assert_eq!(hands.sent(), [(0, 1, 9)]);
    hands.run();
    assert_eq!(hands.sent(), [(0, 2, 1)]);
}

impl Hands {
    fn publish_on(&mut self, topic: TopicId, bytes: usize) {
        let content = Content::Bare { payload: Bytes::from(vec![0; bytes]), identity: None };
        self.bench.take_on(topic, Scope::Node, vec![content]);
        self.look();
    }

    /// Whether what the link got since the last call is compressed.
    fn sent_compressed(&mut self) -> Vec<bool> {
        let sent = std::mem::take(&mut self.bench.link.submitted);
        sent.iter().map(|(.., frame)| frame.is_compressed()).collect()
    }
}

#[test]
fn one_topic_neither_fills_the_stage_nor_keeps_the_others_waiting() {
    const MIB: usize = 1 << 20;
    let mut hands = Hands::new(vec![lane("cloud/c", true)]);
    let other = hands.bench.add("odom", vec![lane("cloud/c", true)]);
    hands.publish_all(1, 1..=20, MIB);
    assert_eq!(hands.dropped(0), [(DropReason::QueueFull, 12)], "8 MiB wait");
    hands.publish_on(other, LARGE);
    hands.publish_on(other, LARGE);
    assert_eq!(hands.long, 10);
    for _ in 0..4 {
        hands.begin(Urgency::Long);
    }
    let begun: Vec<usize> = hands.jobs.iter().map(|job| job.payload.len()).collect();
    assert_eq!(begun, [MIB, LARGE, MIB, LARGE]);
    let counters = hands.bench.core.compress_counters();
    assert_eq!((counters.waiting, counters.waiting_bytes, counters.refused), (6, 6 * MIB, 12));
    hands.run();
    assert_eq!(hands.bench.core.compress_counters().waiting, 0);
    hands.check();
}

#[test]
fn what_has_become_too_old_is_not_compressed() {
    let mut short = lane("cloud/c", true);
    short.lane.lifespan_ms = 100;
    let mut hands = Hands::new(vec![short, lane("fog/f", true)]);
    hands.publish(1, 1, LARGE);
    hands.pass(TENTH);
    assert!(hands.begin(Urgency::Long), "the other lane has no such bound");
    assert_eq!(hands.dropped(0), [(DropReason::Lifespan, 1)]);
    hands.run();
    assert_eq!(hands.sent(), [(1, 1, 1)]);
    let mut short = lane("cloud/c", true);
    short.lane.lifespan_ms = 100;
    hands.plan(vec![short]);
    hands.publish(1, 2, LARGE);
    hands.publish(1, 3, 100);
    hands.pass(TENTH / 2);
    hands.publish(1, 4, LARGE);
    hands.pass(TENTH / 2);
    assert!(hands.begin(Urgency::Long));
    assert_eq!(hands.sent(), [(0, 1, 3)], "what waited behind it goes on");
    assert!(!hands.begin(Urgency::Long), "there is no more");
    hands.run();
    assert_eq!(hands.sent(), [(0, 1, 4)]);
    assert_eq!(hands.dropped(0), [(DropReason::Lifespan, 2)]);
    hands.check();
}

#[test]
fn a_receiver_that_does_not_decompress_gets_what_was_published() {
    let mut hands = Hands::new(vec![lane("cloud/c", true), lane("fog/f", true)]);
    let old = |name: &str| -> FlowId { name.parse().unwrap() };
    hands.bench.link.old = vec![old("fog/f")];
    hands.publish(1, 1, LARGE);
    hands.run();
    assert_eq!(hands.bench.link.submitted[1].2.payload().len(), LARGE);
    assert_eq!(hands.sent_compressed(), [true, false]);
    assert_eq!(hands.path().sent_size.largest(), LARGE as u64, "the largest that is sent");
    // Where nobody does nothing is compressed.
    hands.bench.link.old = vec![old("fog/f"), old("cloud/c")];
    hands.publish(1, 2, LARGE);
    assert_eq!((hands.quick, hands.long), (0, 0));
    assert_eq!(hands.sent(), [(0, 1, 2), (1, 1, 2)]);
    // It may have been replaced by an older version while its message was with the codec.
    hands.bench.link.old.clear();
    hands.publish(1, 3, LARGE);
    hands.begin(Urgency::Long);
    hands.bench.link.old = vec![old("cloud/c")];
    hands.end(0);
    assert_eq!(hands.sent_compressed(), [false, true]);
}

#[test]
fn a_topic_whose_messages_are_with_the_codec_is_not_forgotten() {
    let mut hands = Hands::new(vec![lane("cloud/c", true)]);
    hands.publish(1, 1, LARGE);
    hands.begin(Urgency::Long);
    hands.plan(Vec::new());
    hands.pass(DRAIN);
    assert_eq!(hands.path().bridges[0].phase, Phase::Ended);
    hands.bench.core.forget_unused(hands.bench.now);
    hands.pass(FORGET);
    assert_eq!(hands.bench.core.forget_unused(hands.bench.now), 0);
    hands.end(0);
    assert_eq!(hands.dropped(0), [(DropReason::NoDestination, 1)]);
    hands.bench.core.forget_unused(hands.bench.now);
    hands.pass(FORGET);
    assert_eq!(hands.bench.core.forget_unused(hands.bench.now), 1);
}
