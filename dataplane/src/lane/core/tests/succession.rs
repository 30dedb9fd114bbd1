//! A topic goes from one receiver to another.

use blaze_proto::link::link_control::{Written, WrittenRequest};

use super::*;
use crate::lane::succession::LONGEST_WAIT;

const LATER: Duration = Duration::from_millis(100);

fn to(flow: &str) -> Target {
    let receiver: FlowId = format!("cloud/{flow}").parse().unwrap();
    Target::Inter {
        layer: receiver.layer.clone(),
        receiver,
    }
}

fn reliable(flow: &str) -> Vec<Bridge> {
    let mut bridge = bridge(Scope::Node, to(flow));
    bridge.lane.reliable = true;
    vec![bridge]
}

fn of_cloud(sequence: u64) -> Frame {
    let origin = Origin {
        layer: "cloud".into(),
        node: "cloud-9".into(),
        ..Origin::default()
    };
    let header = Header::new("imu/data", origin, WriterId([7; 16]), sequence, WALL);
    Frame::new(&header, Bytes::new()).unwrap().with_hops_and_age(1, 0)
}

impl Bench {
    /// One message of writer 1 from the own node.
    fn send(&mut self, sequences: std::ops::RangeInclusive<u64>, bytes: usize) {
        let contents = sequences.map(|sequence| Content::Frame(frame(1, sequence, "robot-1", 0, bytes)));
        self.take(Scope::Node, contents.collect());
    }

    fn plan(&mut self, flow: &str) {
        self.apply(reliable(flow), TopicInfo::default());
        self.core.drain(self.now, &mut self.link);
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

    fn pass(&mut self, time: Duration) {
        self.now += time;
        self.core.drain(self.now, &mut self.link);
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
    assert!(bench.asked("a").is_empty(), "not more often than every 100 ms");
    bench.pass(LATER / 2);
    assert_eq!(bench.asked("a"), tokens, "asked again");
    bench.core.written(&"cloud/b".parse().unwrap(), tokens[0]);
    bench.core.written(&"cloud/a".parse().unwrap(), tokens[0] + 1);
    bench.pass(Duration::ZERO);
    assert!(
        bench.sent().is_empty(),
        "neither another flow's answer nor one to another question"
    );
    bench.core.written(&"cloud/a".parse().unwrap(), tokens[0]);
    bench.pass(Duration::ZERO);
    bench.send(6..=6, 10);
    assert_eq!(bench.sent(), [(1, 3), (1, 4), (1, 5), (1, 6)]);
    assert!(bench.asked("a").is_empty() && !bench.core.is_draining());
}

#[test]
fn one_that_is_gone_or_never_answers_is_not_waited_for() {
    for gone in [true, false] {
        let mut bench = Bench::new(reliable("a"));
        bench.plan("b");
        bench.send(1..=1, 10);
        if gone {
            bench.link.gone = Some("cloud/a".parse().unwrap());
            bench.pass(Duration::ZERO);
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
    let mut bench = Bench::new(reliable("a"));
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
    bench.pass(Duration::ZERO);
    assert_eq!(bench.sent(), [(2, 4), (2, 5)]);
}

#[test]
fn nothing_is_asked_where_nobody_goes_on() {
    let mut bench = Bench::new(reliable("a"));
    bench.send(1..=1, 10);
    bench.link.waiting.clear();
    bench.apply(vec![], TopicInfo::default());
    bench.pass(Duration::ZERO);
    assert!(bench.asked("a").is_empty() && !bench.core.is_draining());
}

#[test]
fn what_is_held_is_bounded() {
    let mut bench = Bench::new(reliable("a"));
    bench.plan("b");
    for sequence in 1..=40 {
        bench.send(sequence..=sequence, 1_000_000);
    }
    bench.link.gone = Some("cloud/a".parse().unwrap());
    bench.pass(Duration::ZERO);
    let sent = bench.sent();
    assert_eq!(sent, (1..=33).map(|sequence| (1, sequence)).collect::<Vec<_>>());
    let path = bench.core.path(bench.topic);
    assert_eq!(path.bridges[1].stats.dropped.get(DropReason::QueueFull), 7);
    // The room is free again.
    bench.link.waiting.clear();
    bench.plan("a");
    bench.link.gone = None;
    bench.send(41..=41, 1_000_000);
    bench.link.gone = Some("cloud/b".parse().unwrap());
    bench.pass(Duration::ZERO);
    assert_eq!(bench.sent(), [(0, 41)]);
}

#[test]
fn of_large_best_effort_messages_the_newest_is_held() {
    let best_effort = |flow: &str| vec![bridge(Scope::Node, to(flow))];
    let mut bench = Bench::new(best_effort("a"));
    bench.send(1..=1, 100_000);
    bench.link.waiting.clear();
    bench.apply(best_effort("b"), TopicInfo::default());
    bench.send(2..=5, 100_000);
    bench.link.gone = Some("cloud/a".parse().unwrap());
    bench.pass(Duration::ZERO);
    assert_eq!(bench.sent(), [(0, 1), (1, 5)]);
    let path = bench.core.path(bench.topic);
    assert_eq!(path.bridges[1].stats.dropped.get(DropReason::QueueFull), 3);
}

#[test]
fn a_question_is_answered_when_the_broker_has_what_had_come_by_then() {
    let mut bench = Bench::new(vec![bridge(Scope::Inter, Target::Layer)]);
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
        bench.core.deliver(bench.now, of_cloud(sequence), &mut bench.link);
    }
    bench.out.queued.store(3, Ordering::SeqCst);
    ask(&mut bench, "imu/data", 3);
    ask(&mut bench, "imu/data", 3);
    assert!(answers(&mut bench).is_empty());
    bench.core.deliver(bench.now, of_cloud(4), &mut bench.link);
    bench.out.queued.store(2, Ordering::SeqCst);
    bench.pass(LATER);
    assert!(
        answers(&mut bench).is_empty(),
        "two of four wait, one of them had come by then"
    );
    bench.out.queued.store(1, Ordering::SeqCst);
    bench.pass(LATER);
    assert_eq!(answers(&mut bench), [yes(3)], "the one that waits came later");
    bench.out.queued.store(9, Ordering::SeqCst);
    for token in 0..5_000 {
        let asker = format!("cloud/n{token}").parse().unwrap();
        let Bench { core, link, now, .. } = &mut bench;
        core.written_asked(*now, asker, "imu/data".to_owned(), token, link);
    }
    bench.out.queued.store(0, Ordering::SeqCst);
    bench.pass(LATER);
    assert_eq!(answers(&mut bench).len(), 1_024, "those beyond ask again");
}

#[test]
fn what_waits_for_its_bridge_is_not_written() {
    let mut bench = Bench::new(vec![]);
    bench.core.deliver(bench.now, of_cloud(1), &mut bench.link);
    let asker: FlowId = "cloud/a".parse().unwrap();
    let Bench { core, link, now, .. } = &mut bench;
    core.written_asked(*now, asker, "imu/data".to_owned(), 1, link);
    assert!(bench.link.told.is_empty());
    bench.pass(crate::lane::early::WAIT);
    assert_eq!(bench.link.told.len(), 1, "it was dropped");
}
