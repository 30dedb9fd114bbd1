//! A topic goes from one receiver to another.

use blaze_proto::link::link_control::{Written, WrittenRequest};

use super::*;
use crate::lane::succession::{LONGEST_PATIENCE, LONGEST_WAIT, MAX_ASKS};
use crate::world::LayerScopeId;

const LATER: Duration = Duration::from_millis(100);

fn to(flow: &str) -> Target {
    let receiver: FlowId = format!("cloud/{flow}").parse().unwrap();
    Target::Inter { layer: receiver.layer.clone(), receiver }
}

fn reliable(flow: &str) -> Vec<Bridge> {
    let mut bridge = bridge(Scope::Node, to(flow));
    bridge.lane.reliable = true;
    vec![bridge]
}

fn of_cloud(sequence: u64) -> Frame {
    message(["cloud", "cloud-9", ""], 7, sequence, 0, 0).with_hops_and_age(1, 0)
}

impl Bench {
    /// A message of writer 9 has gone to replica `a`, which has acknowledged it.
    fn of_a() -> Self {
        let mut bench = Self::new(reliable("a"));
        bench.take(Scope::Node, vec![Content::Frame(frame(9, 1, "robot-1", 0, 10))]);
        assert_eq!(bench.sent(), [(0, 1)]);
        bench.link.waiting.clear();
        bench
    }

    /// Messages of writer 1 from the own node.
    fn send(&mut self, sequences: std::ops::RangeInclusive<u64>, bytes: usize) {
        let contents =
            sequences.map(|sequence| Content::Frame(frame(1, sequence, "robot-1", 0, bytes)));
        self.take(Scope::Node, contents.collect());
    }

    fn plan(&mut self, flow: &str) {
        self.apply(reliable(flow), TopicInfo::default());
        self.drain();
    }

    /// Sequences that the link got, and to which place of the topic's bridges.
    fn sent(&mut self) -> Vec<(u32, u64)> {
        let sent = std::mem::take(&mut self.link.submitted);
        sent.iter().map(|(lane, _, frame)| (lane.0, frame.sequence())).collect()
    }

    /// Tokens of the questions that a flow was asked since the last call.
    fn asked(&mut self, flow: &str) -> Vec<u64> {
        let told = std::mem::take(&mut self.link.told);
        let of = |(to, body): &(FlowId, Body)| match body {
            Body::WrittenRequest(WrittenRequest { topic, token }) => {
                assert_eq!((to.to_string(), topic.as_str()), (format!("cloud/{flow}"), "imu/data"));
                *token
            }
            other => panic!("{other:?}"),
        };
        told.iter().map(of).collect()
    }

    /// A flow says that it has written what it was asked for last.
    fn answer(&mut self, flow: &str) {
        let tokens = self.asked(flow);
        self.core.written(&format!("cloud/{flow}").parse().unwrap(), tokens[tokens.len() - 1]);
        self.drain();
    }

    fn is_gone(&mut self, flow: &str) {
        self.link.gone = Some(format!("cloud/{flow}").parse().unwrap());
        self.link.waiting.clear();
        self.drain();
    }

    fn pass(&mut self, time: Duration) {
        self.now += time;
        self.drain();
    }
}

#[test]
fn the_next_receiver_gets_nothing_before_the_one_before_has_written_all() {
    let mut bench = Bench::new(reliable("a"));
    bench.send(1..=2, 10);
    assert_eq!(bench.sent(), [(0, 1), (0, 2)]);
    bench.plan("b");
    bench.send(3..=4, 10);
    assert!(bench.asked("a").is_empty(), "two are not acknowledged yet");
    bench.link.waiting.clear();
    bench.pass(LATER);
    let tokens = bench.asked("a");
    assert_eq!(tokens.len(), 1);
    bench.send(5..=5, 10);
    bench.pass(LATER / 2);
    assert!(bench.asked("a").is_empty(), "not again for 100 ms");
    bench.pass(LATER / 2);
    assert_eq!(bench.asked("a"), tokens, "asked again");
    bench.pass(LATER);
    assert!(bench.asked("a").is_empty(), "not again for 200 ms");
    bench.core.written(&"cloud/b".parse().unwrap(), tokens[0]);
    bench.core.written(&"cloud/a".parse().unwrap(), tokens[0] + 1);
    bench.drain();
    assert!(bench.sent().is_empty(), "neither another flow's answer nor one to another question");
    bench.core.written(&"cloud/a".parse().unwrap(), tokens[0]);
    bench.drain();
    bench.send(6..=6, 10);
    assert_eq!(bench.sent(), [(1, 3), (1, 4), (1, 5), (1, 6)]);
    assert!(bench.asked("a").is_empty() && !bench.core.is_draining());
}

#[test]
fn one_that_is_gone_or_never_answers_is_not_waited_for() {
    for gone in [true, false] {
        let mut bench = Bench::of_a();
        bench.plan("b");
        bench.send(1..=1, 10);
        assert!(bench.sent().is_empty());
        if gone {
            bench.is_gone("a");
        } else {
            bench.pass(LONGEST_WAIT - LATER);
            assert!(bench.sent().is_empty());
            bench.pass(LATER);
        }
        assert_eq!(bench.sent(), [(1, 1)], "gone: {gone}");
    }
}

#[test]
fn what_is_held_goes_back_with_the_topic_and_on_to_a_third() {
    let mut bench = Bench::of_a();
    bench.plan("b");
    bench.send(1..=2, 10);
    bench.plan("a");
    bench.send(3..=3, 10);
    assert_eq!(bench.sent(), [(0, 1), (0, 2), (0, 3)]);
    bench.link.waiting.clear();
    bench.plan("b");
    bench.send(4..=4, 10);
    let asked = bench.asked("a");
    bench.plan("c");
    bench.send(5..=5, 10);
    bench.pass(LATER / 2);
    assert!(bench.sent().is_empty(), "the first has still not written all");
    bench.core.written(&"cloud/a".parse().unwrap(), asked[asked.len() - 1]);
    bench.drain();
    assert_eq!(bench.sent(), [(2, 4), (2, 5)]);
}

#[test]
fn nothing_is_asked_where_nobody_goes_on_or_nothing_was_sent() {
    let mut bench = Bench::of_a();
    bench.apply(vec![], TopicInfo::default());
    bench.drain();
    assert!(bench.asked("a").is_empty() && !bench.core.is_draining());
    let mut bench = Bench::new(reliable("a"));
    bench.plan("b");
    bench.send(1..=1, 10);
    assert_eq!(bench.sent(), [(1, 1)]);
    assert!(bench.asked("a").is_empty() && !bench.core.is_draining());
}

/// The plan that ends a bridge may come before the one that says who goes on.
#[test]
fn one_that_still_drains_is_asked_when_another_goes_on_later() {
    let mut bench = Bench::of_a();
    bench.link.waiting.insert(LaneId(0), 1);
    bench.apply(vec![], TopicInfo::default());
    bench.drain();
    bench.plan("b");
    bench.send(1..=1, 10);
    bench.link.waiting.clear();
    bench.drain();
    assert!(bench.sent().is_empty());
    bench.answer("a");
    assert_eq!(bench.sent(), [(1, 1)]);
    // Even where it had nothing more to empty and has ended.
    let mut bench = Bench::of_a();
    bench.apply(vec![], TopicInfo::default());
    bench.drain();
    assert!(!bench.core.is_draining());
    bench.pass(DRAIN / 2);
    bench.plan("b");
    bench.send(1..=1, 10);
    assert!(bench.sent().is_empty());
    bench.answer("a");
    assert_eq!(bench.sent(), [(1, 1)]);
}

/// Each robot of a layer is alone; two that share their broker are one.
#[test]
fn only_flows_on_one_broker_follow_one_another() {
    let alone = |flow: &str| {
        let mut bridges = reliable(flow);
        bridges[0].lane.shared = None;
        bridges
    };
    let both = |one: Vec<Bridge>, other: Vec<Bridge>| -> Vec<Bridge> {
        one.into_iter().chain(other).collect()
    };
    let mut bench = Bench::new(both(alone("robot-7"), reliable("a")));
    bench.send(1..=1, 10);
    assert_eq!(bench.sent(), [(0, 1), (1, 1)]);
    bench.link.waiting.clear();
    bench.apply(both(alone("robot-7"), reliable("b")), TopicInfo::default());
    bench.send(2..=2, 10);
    // Back again: what was held is the replica's, not the robot's.
    bench.apply(both(alone("robot-7"), reliable("a")), TopicInfo::default());
    bench.drain();
    bench.send(3..=3, 10);
    assert_eq!(bench.sent(), [(0, 2), (1, 2), (0, 3), (1, 3)]);
    bench.link.waiting.clear();
    // A robot leaves and another one comes: nobody waits.
    bench.apply(both(alone("robot-8"), reliable("a")), TopicInfo::default());
    bench.drain();
    bench.send(4..=4, 10);
    assert_eq!(bench.sent(), [(1, 4), (3, 4)]);
    assert!(bench.link.told.is_empty());
    let mut other = reliable("c");
    other[0].lane.shared = Some(LayerScopeId::kafka("another"));
    bench.link.waiting.clear();
    bench.apply(other, TopicInfo::default());
    bench.drain();
    bench.send(5..=5, 10);
    assert_eq!(bench.sent(), [(4, 5)]);
}

#[test]
fn what_nobody_goes_on_with_stays_until_it_is_planned_again() {
    let mut bench = Bench::of_a();
    bench.plan("b");
    bench.send(1..=2, 10);
    bench.apply(vec![], TopicInfo::default());
    bench.pass(LATER);
    bench.plan("b");
    bench.send(3..=3, 10);
    bench.answer("a");
    assert_eq!(bench.sent(), [(1, 1), (1, 2), (1, 3)]);
    // Not for ever.
    let mut bench = Bench::of_a();
    bench.plan("b");
    bench.send(1..=2, 10);
    bench.apply(vec![], TopicInfo::default());
    bench.pass(DRAIN);
    assert_eq!(
        bench.core.path(bench.topic).bridges[1].stats.dropped.get(DropReason::NoDestination),
        2
    );
}

#[test]
fn a_flow_that_goes_away_sends_what_it_holds() {
    let mut bench = Bench::of_a();
    bench.plan("b");
    bench.send(1..=2, 10);
    bench.core.leave(bench.now);
    bench.apply(vec![], TopicInfo::default());
    bench.drain();
    assert_eq!(bench.sent(), [(1, 1), (1, 2)]);
    bench.link.waiting.clear();
    bench.drain();
    assert!(!bench.core.is_draining());
}

#[test]
fn what_was_held_does_not_push_out_what_waits() {
    let mut bench = Bench::of_a();
    bench.plan("b");
    bench.send(1..=5, 10);
    bench.link.room = 2;
    bench.answer("a");
    assert_eq!(bench.sent(), [(1, 1), (1, 2)]);
    bench.send(6..=6, 10);
    bench.link.room = 3;
    bench.drain();
    assert_eq!(bench.sent(), [(1, 3)], "two have not left yet");
    bench.link.room = 10;
    bench.drain();
    assert_eq!(bench.sent(), [(1, 4), (1, 5), (1, 6)]);
}

#[test]
fn what_was_held_goes_on_where_there_is_never_room() {
    let mut bench = Bench::of_a();
    bench.plan("b");
    bench.send(1..=2, 10);
    bench.link.room = 1;
    bench.link.waiting.insert(LaneId(7), 1);
    bench.answer("a");
    assert!(bench.sent().is_empty());
    bench.pass(LONGEST_PATIENCE);
    assert_eq!(bench.sent(), [(1, 1), (1, 2)]);
}

/// What others say of lanes and peers does not let a question be forgotten.
#[test]
fn a_question_is_answered_whatever_else_happens() {
    let mut bench = Bench::new(vec![bridge(Scope::Inter, Target::Layer { json: false })]);
    bench.deliver(of_cloud(1));
    bench.out.queued.store(1, Ordering::SeqCst);
    let Bench { core, link, now, .. } = &mut bench;
    core.written_asked(*now, "cloud/a".parse().unwrap(), "imu/data".to_owned(), 1, link);
    core.stir();
    core.lane_out(LaneId(0), 1, 1);
    let look_at = core.drain(*now, link).unwrap();
    bench.out.queued.store(0, Ordering::SeqCst);
    bench.core.drain(look_at, &mut bench.link);
    assert_eq!(bench.link.told.len(), 1);
    // Nor an early message.
    let mut bench = Bench::new(vec![]);
    bench.deliver(of_cloud(1));
    bench.core.stir();
    let look_at = bench.core.drain(bench.now, &mut bench.link).unwrap();
    bench.core.drain(look_at, &mut bench.link);
    assert_eq!(bench.core.drain(look_at, &mut bench.link), None);
    assert_eq!(bench.drops(), [(DropReason::NoDestination, 1)]);
}

/// What was held and goes to another bridge is counted there, and only there.
#[test]
fn what_was_held_is_counted_once() {
    let mut bench = Bench::of_a();
    bench.plan("b");
    bench.send(1..=2, 10);
    bench.plan("c");
    bench.send(3..=3, 10);
    bench.is_gone("a");
    assert_eq!(bench.sent(), [(2, 1), (2, 2), (2, 3)]);
    let path = bench.core.path(bench.topic);
    let taken: Vec<u64> = path.bridges.iter().map(|bridge| bridge.stats.taken.messages).collect();
    assert_eq!(taken, [1, 0, 3]);
}

#[test]
fn what_is_held_is_bounded() {
    let mut bench = Bench::of_a();
    bench.plan("b");
    for sequence in 1..=40 {
        bench.send(sequence..=sequence, 1_000_000);
    }
    bench.is_gone("a");
    let sent = bench.sent();
    assert_eq!(sent, (1..=33).map(|sequence| (1, sequence)).collect::<Vec<_>>());
    let path = bench.core.path(bench.topic);
    assert_eq!(path.bridges[1].stats.dropped.get(DropReason::QueueFull), 7);
    // The room is free again.
    bench.link.gone = None;
    bench.link.waiting.clear();
    bench.plan("a");
    for sequence in 41..=73 {
        bench.send(sequence..=sequence, 1_000_000);
    }
    bench.is_gone("b");
    assert_eq!(bench.sent().len(), 33);
}

#[test]
fn of_large_best_effort_messages_the_newest_is_held() {
    let best_effort = |flow: &str| vec![bridge(Scope::Node, to(flow))];
    let mut bench = Bench::new(best_effort("a"));
    bench.send(1..=1, 100);
    bench.link.waiting.clear();
    bench.apply(best_effort("b"), TopicInfo::default());
    bench.send(2..=4, 100);
    bench.send(5..=8, 100_000);
    bench.is_gone("a");
    assert_eq!(bench.sent(), [(0, 1), (1, 2), (1, 3), (1, 4), (1, 8)]);
    let path = bench.core.path(bench.topic);
    assert_eq!(path.bridges[1].stats.dropped.get(DropReason::QueueFull), 3);
}

#[test]
fn not_all_questions_are_asked_at_once() {
    let mut bench = Bench::of_a();
    let topics = MAX_ASKS + 5;
    for number in 0..topics {
        for flow in ["a", "b"] {
            let id = bench.add(&format!("t/{number}"), reliable(flow));
            bench.take_on(id, Scope::Node, vec![bare("a")]);
        }
    }
    bench.link.waiting.clear();
    bench.drain();
    assert_eq!(std::mem::take(&mut bench.link.told).len(), MAX_ASKS);
    bench.pass(LATER / 5);
    assert_eq!(std::mem::take(&mut bench.link.told).len(), 5);
}

#[test]
fn a_question_is_answered_when_the_broker_has_what_had_come_by_then() {
    let mut bench = Bench::new(vec![bridge(Scope::Inter, Target::Layer { json: false })]);
    let asker: FlowId = "cloud/a".parse().unwrap();
    let answers = |bench: &mut Bench| std::mem::take(&mut bench.link.told);
    let ask = |bench: &mut Bench, topic: &str, token: u64| {
        let Bench { core, link, now, .. } = bench;
        core.written_asked(*now, asker.clone(), topic.to_owned(), token, link);
    };
    let yes = |token: u64| (asker.clone(), Body::Written(Written { token }));
    ask(&mut bench, "no/such", 1);
    ask(&mut bench, "imu/data", 2);
    assert_eq!(answers(&mut bench), [yes(1), yes(2)]);
    for sequence in 1..=3 {
        bench.deliver(of_cloud(sequence));
    }
    bench.out.queued.store(3, Ordering::SeqCst);
    assert!(bench.core.has_unwritten());
    // Two lanes of one flow for one topic, each asked twice.
    for token in [3, 4, 3, 4] {
        ask(&mut bench, "imu/data", token);
    }
    assert!(answers(&mut bench).is_empty());
    bench.deliver(of_cloud(4));
    bench.out.queued.store(2, Ordering::SeqCst);
    bench.pass(LATER);
    assert!(answers(&mut bench).is_empty(), "two of four wait, one of them had come by then");
    bench.out.queued.store(1, Ordering::SeqCst);
    bench.pass(LATER);
    assert_eq!(answers(&mut bench), [yes(3), yes(4)], "the one that waits came later");
}

#[test]
fn questions_that_wait_are_bounded() {
    let mut bench = Bench::new(vec![bridge(Scope::Inter, Target::Layer { json: false })]);
    bench.deliver(of_cloud(1));
    bench.out.queued.store(1, Ordering::SeqCst);
    let ask = |bench: &mut Bench, asker: u64, topic: String, token: u64| {
        let Bench { core, link, now, .. } = bench;
        core.written_asked(*now, format!("cloud/n{asker}").parse().unwrap(), topic, token, link);
    };
    let answered = |bench: &mut Bench| {
        bench.out.queued.store(0, Ordering::SeqCst);
        bench.pass(LATER);
        bench.out.queued.store(1, Ordering::SeqCst);
        std::mem::take(&mut bench.link.told).len()
    };
    for token in 0..100 {
        ask(&mut bench, 1, "imu/data".to_owned(), token);
    }
    assert_eq!(answered(&mut bench), 4, "of one flow for one topic");
    for token in 0..5_000 {
        ask(&mut bench, token, "imu/data".to_owned(), token);
    }
    assert_eq!(answered(&mut bench), 1_024, "those beyond ask again");
    for number in 0..1_000 {
        let topic = format!("t/{number}");
        bench.add(&topic, vec![bridge(Scope::Inter, Target::Layer { json: false })]);
        let origin = Origin { layer: "cloud".into(), ..Origin::default() };
        let header = Header::new(&topic, origin, WriterId([7; 16]), 1, WALL);
        let came = Frame::new(&header, Bytes::new()).unwrap();
        bench.deliver(came.with_hops_and_age(1, 0));
        ask(&mut bench, 1, topic, number);
    }
    assert_eq!(answered(&mut bench), 256, "of one flow");
}

#[test]
fn what_waits_for_its_bridge_is_not_written() {
    let mut bench = Bench::new(vec![]);
    bench.deliver(of_cloud(1));
    let asker: FlowId = "cloud/a".parse().unwrap();
    let Bench { core, link, now, .. } = &mut bench;
    core.written_asked(*now, asker, "imu/data".to_owned(), 1, link);
    assert!(bench.link.told.is_empty());
    bench.pass(crate::lane::early::WAIT);
    assert_eq!(bench.link.told.len(), 1, "it was dropped");
}

/// A sender that has another receiver now may still have much on its way.
#[test]
fn a_bridge_from_the_link_that_drains_stays_while_messages_come() {
    let mut bench = Bench::new(vec![bridge(Scope::Inter, Target::Layer { json: false })]);
    bench.apply(vec![], TopicInfo::default());
    for sequence in 1..=100 {
        bench.pass(DRAIN / 2);
        bench.deliver(of_cloud(sequence));
    }
    let until_then = (LONGEST_WAIT.as_millis() / (DRAIN / 2).as_millis()) as usize;
    let written = bench.out.frames.lock().len();
    assert!((until_then - 1..=until_then).contains(&written), "{written}");
}
