//! A topic goes from one receiver to another while messages are with the codec.

use blaze_proto::link::link_control::WrittenRequest;

use super::*;

fn to(flow: &str) -> Vec<Bridge> {
    vec![lane(&format!("cloud/{flow}"), true)]
}

impl Hands {
    /// The link has nothing more of what was given to it.
    fn link_is_empty(&mut self) {
        self.bench.link.waiting.clear();
        self.bench.drain();
    }

    /// A flow is asked once whether it has written all, and says yes.
    fn answer(&mut self, flow: &str) {
        let told = std::mem::take(&mut self.bench.link.told);
        let [(asked, Body::WrittenRequest(WrittenRequest { token, .. }))] = &told[..] else {
            panic!("{told:?}");
        };
        assert_eq!(asked.to_string(), format!("cloud/{flow}"));
        self.bench.core.written(asked, *token);
        self.bench.drain();
    }

    fn taken(&mut self) -> Vec<u64> {
        let bridges = &self.path().bridges;
        bridges.iter().map(|bridge| bridge.stats.taken.messages).collect()
    }
}

/// The receiver before has got nothing of it, so it goes on with the topic.
#[test]
fn what_is_with_the_codec_goes_to_the_next_receiver() {
    let mut hands = Hands::new(to("a"));
    hands.publish(1, 1, LARGE);
    hands.plan(to("b"));
    hands.publish(1, 2, 100);
    hands.publish(2, 1, 100);
    assert_eq!(hands.sent(), [(1, 2, 1)], "nothing was sent before it");
    hands.run();
    assert_eq!(hands.sent(), [(1, 1, 1), (1, 1, 2)]);
    assert!(hands.bench.link.told.is_empty(), "`a` has nothing to write");
    assert_eq!(hands.taken(), [0, 3]);
}

#[test]
fn it_waits_there_for_what_was_sent_before() {
    let mut hands = Hands::new(to("a"));
    hands.publish(1, 1, 100);
    hands.publish(1, 2, LARGE);
    hands.plan(to("b"));
    hands.publish(1, 3, 100);
    hands.run();
    assert_eq!(hands.sent(), [(0, 1, 1)]);
    hands.link_is_empty();
    hands.answer("a");
    assert_eq!(hands.sent(), [(1, 1, 2), (1, 1, 3)]);
}

/// Messages of one writer were with the codec for both receivers.
#[test]
fn a_topic_that_comes_and_goes_stays_in_order() {
    let mut hands = Hands::new(to("a"));
    hands.publish(1, 1, 100);
    hands.publish(1, 2, LARGE);
    hands.plan(to("b"));
    hands.publish(1, 3, 100);
    // Nobody goes on until `b` has ended.
    hands.plan(Vec::new());
    hands.pass(DRAIN);
    hands.plan(to("a"));
    hands.publish(1, 4, 100);
    hands.run();
    hands.link_is_empty();
    assert_eq!(hands.sent(), [(0, 1, 1), (0, 1, 2), (0, 1, 3), (0, 1, 4)]);
    assert_eq!(hands.taken(), [4, 0]);
}

/// Message 1 went to `a`, which has not said that it has written it; 2 is held for `b`, and 3 is
/// with the codec.
fn of_b() -> Hands {
    let mut hands = Hands::new(to("a"));
    hands.publish(9, 1, 100);
    assert_eq!(hands.sent(), [(0, 9, 1)]);
    hands.link_is_empty();
    hands.plan(to("b"));
    hands.publish(1, 2, 100);
    hands.publish(1, 3, LARGE);
    assert_eq!((hands.sent(), hands.taken()), (vec![], vec![1, 0]));
    hands
}

#[test]
fn what_comes_from_the_codec_goes_where_that_before_it_went() {
    let mut hands = of_b();
    hands.plan(to("c"));
    hands.publish(1, 4, 100);
    hands.run();
    assert_eq!((hands.sent(), hands.taken()), (vec![], vec![1, 0, 0]));
    hands.answer("a");
    assert_eq!(hands.sent(), [(2, 1, 2), (2, 1, 3), (2, 1, 4)]);
    assert_eq!(hands.taken(), [1, 0, 3], "counted where they went, and nowhere else");
    hands.link_is_empty();
    assert!(!hands.bench.core.is_draining() && hands.bench.link.told.is_empty(), "nobody asks `b`");
}

#[test]
fn it_goes_there_too_where_that_is_only_found_out_later() {
    let mut hands = of_b();
    hands.begin(Urgency::Long);
    // Nobody goes on at first.
    hands.plan(Vec::new());
    hands.plan(to("c"));
    hands.answer("a");
    assert_eq!(hands.sent(), [(2, 1, 2)]);
    hands.publish(1, 4, 100);
    hands.end(0);
    assert_eq!(hands.sent(), [(2, 1, 3), (2, 1, 4)]);
    assert_eq!(hands.taken(), [1, 0, 3]);
}

#[test]
fn what_is_with_the_codec_comes_back_with_the_topic() {
    let mut hands = of_b();
    hands.plan(to("a"));
    hands.publish(1, 4, 100);
    assert_eq!(hands.sent(), [(0, 1, 2)]);
    hands.run();
    assert_eq!(hands.sent(), [(0, 1, 3), (0, 1, 4)]);
    assert_eq!(hands.taken(), [4, 0]);
    // Renewed with messages at the codec it goes on.
    hands.publish(1, 5, LARGE);
    hands.plan(Vec::new());
    hands.plan(to("a"));
    hands.publish(1, 6, 100);
    hands.run();
    assert_eq!(hands.sent(), [(0, 1, 5), (0, 1, 6)]);
}

#[test]
fn what_comes_back_when_its_bridge_has_ended_goes_nowhere() {
    let mut hands = Hands::new(to("a"));
    hands.publish(1, 1, LARGE);
    hands.plan(Vec::new());
    assert!(hands.bench.core.is_draining());
    hands.pass(DRAIN);
    assert!(!hands.bench.core.is_draining());
    hands.run();
    assert_eq!(hands.dropped(0), [(DropReason::NoDestination, 1)]);
    hands.check();
    // One that comes in time is the last.
    let mut hands = Hands::new(to("a"));
    hands.publish(1, 1, LARGE);
    hands.plan(Vec::new());
    hands.run();
    assert_eq!(hands.sent(), [(0, 1, 1)]);
    hands.link_is_empty();
    assert!(!hands.bench.core.is_draining());
}

#[test]
fn what_was_compressed_for_one_receiver_goes_to_an_older_one_as_it_was() {
    let mut hands = of_b();
    hands.run();
    hands.plan(to("c"));
    hands.bench.link.old = vec!["cloud/c".parse().unwrap()];
    hands.answer("a");
    let sent = std::mem::take(&mut hands.bench.link.submitted);
    assert_eq!(sent.len(), 2);
    let (_, _, frame) = &sent[1];
    assert!(!frame.is_compressed() && *frame.payload() == vec![0; LARGE]);
}

fn durable(flow: &str) -> Vec<Bridge> {
    let mut bridges = to(flow);
    bridges[0].lane.durable = true;
    bridges
}

/// A message that is kept with others before it.
fn kept(sequence: u64, bytes: usize, depth: u32) -> Content {
    Content::Frame(message(["edge", "robot-1", "imu"], 1, sequence, depth, bytes))
}

/// More at once than may wait for the codec: nobody publishes it again, so the rest goes as it is.
#[test]
fn of_what_is_kept_nothing_is_refused() {
    const IMAGE: usize = 1 << 20;
    let mut hands = Hands::new(durable("a"));
    for sequence in 1..=12 {
        hands.bench.take(Scope::Node, vec![kept(sequence, IMAGE, 12)]);
        hands.look();
        hands.run();
    }
    hands.link_is_empty();
    assert_eq!(hands.sent().len(), 12);
    hands.plan([durable("a"), durable("b")].concat());
    let Bench { core, link, now, topic, .. } = &mut hands.bench;
    core.deliver_waiting(*now, *topic, link);
    hands.look();
    hands.run();
    let sent = hands.sent();
    let newest = sent.iter().map(|(lane, ..)| *lane).max();
    let to_newest = sent.iter().filter(|(lane, ..)| Some(*lane) == newest);
    let sequences: Vec<u64> = to_newest.map(|(.., sequence)| *sequence).collect();
    assert_eq!(sequences, (1..=12).collect::<Vec<u64>>());
    assert_eq!(hands.dropped(0), []);
}

impl Hands {
    /// Bridges that have begun get what is kept.
    fn deliver_waiting(&mut self) {
        let Bench { core, link, now, topic, .. } = &mut self.bench;
        core.deliver_waiting(*now, *topic, link);
        self.look();
    }
}

/// What is kept for late joiners goes before what is held for them, and what is among that once.
#[test]
fn what_is_kept_goes_before_what_is_held() {
    let mut hands = Hands::new(durable("a"));
    hands.bench.take(Scope::Node, vec![kept(1, LARGE, 2)]);
    hands.look();
    hands.run();
    assert_eq!(hands.sent(), [(0, 1, 1)]);
    hands.link_is_empty();
    hands.plan(durable("b"));
    hands.bench.take(Scope::Node, vec![kept(2, 100, 2)]);
    hands.deliver_waiting();
    assert_eq!((hands.quick, hands.long), (0, 0), "it would come back behind what is held");
    hands.answer("a");
    let sequences: Vec<u64> = hands.sent().iter().map(|(.., sequence)| *sequence).collect();
    assert_eq!(sequences, [1, 2]);
}

/// Of what is with the codec nothing is sent before or again, whatever of it is kept.
#[test]
fn what_is_kept_goes_before_what_is_with_the_codec() {
    for depth in [1, 2, 3] {
        let mut hands = Hands::new(durable("a"));
        for sequence in 1..=3 {
            hands.bench.take(Scope::Node, vec![kept(sequence, LARGE, depth)]);
            hands.look();
            if sequence == 1 {
                hands.run();
            }
        }
        assert_eq!(hands.sent(), [(0, 1, 1)]);
        hands.plan(durable("b"));
        hands.deliver_waiting();
        hands.run();
        hands.link_is_empty();
        hands.answer("a");
        let expected = [(1, 1, 1), (1, 1, 2), (1, 1, 3)];
        assert_eq!(hands.sent(), expected[usize::from(depth < 3)..], "depth {depth}");
    }
}
