//! Memory stays bounded, whatever a peer does.

use std::time::Duration;

use blaze_domain::{DropReason, Priority};
use blaze_proto::Frame;
use bytes::{BufMut, Bytes, BytesMut};

use super::super::event::{LaneId, LinkEvent, PeerState};
use super::super::sim::{Post, Sim, Weather};
use super::super::wire::{DatagramBuilder, LinkHeader, Record, SenderId};
use super::super::{Limits, sim};
use super::seeds;
use crate::testing::Random;

#[test]
fn the_oldest_that_waits_gives_way() {
    let limits = Limits { queue_bytes: [10_000; 3], ..Limits::default() };
    let mut sim = Sim::with_limits(1, Weather::delay(10), &["edge/a", "fog/b"], limits);
    sim.run_ms(1_000);
    sim.nodes[0].rate = Some(1_000.0);
    sim.publish(0, 1, Post::reliable(9)).unwrap();
    sim.run_ms(1);
    for _ in 0..100 {
        sim.publish(0, 1, Post::reliable(1).bytes(1_000)).unwrap();
        assert!(sim.nodes[0].engine.peers()[0].queue_bytes[1] <= 10_000);
    }
    sim.check_accounts();
    let queued = sim.nodes[0].engine.lane_queued(LaneId(1)).messages;
    let dropped = sim.nodes[0].lanes[&LaneId(1)].dropped[&DropReason::QueueFull];
    assert_eq!((queued, dropped), (8, 92));
    // One message always fits, alone.
    sim.publish(0, 1, Post::reliable(1).bytes(50_000)).unwrap();
    assert_eq!(sim.nodes[0].engine.lane_queued(LaneId(1)).messages, 1);
    sim.nodes[0].rate = None;
    sim.run_ms(1_500);
    assert_eq!(sim.sequences(1, 1), [101]);
    assert_eq!(sim.sequences(1, 9), [1], "what was started is not dropped");
    sim.check_accounts();
}

#[test]
fn a_link_that_is_too_slow_carries_the_newest_pictures() {
    let mut sim = Sim::new(3, Weather::delay(10), &["edge/a", "fog/b"]);
    sim.run_ms(1_000);
    // A picture of 100 kB each 33 ms is 3 MB/s; the link takes a third of that.
    sim.nodes[0].rate = Some(1_000_000.0);
    for _ in 0..90 {
        sim.publish(
            0,
            1,
            Post::large(1, 100_000).lifespan(Some(Duration::from_millis(500))).newest(),
        )
        .unwrap();
        assert!(
            sim.nodes[0].engine.lane_queued(LaneId(1)).messages <= 4,
            "one waits, the others are on the way"
        );
        sim.run_ms(33);
    }
    sim.run_ms(1_000);
    let arrived = sim.sequences(1, 1);
    assert!((25..=33).contains(&arrived.len()), "{arrived:?}");
    assert!(
        arrived.windows(2).all(|pair| pair[1] - pair[0] <= 5),
        "a picture comes at any time: {arrived:?}"
    );
    let lane = &sim.nodes[0].lanes[&LaneId(1)];
    assert_eq!(lane.dropped.get(&DropReason::Lifespan), None, "none grows old in the queue");
    assert_eq!(lane.dropped[&DropReason::QueueFull], 90 - arrived.len() as u64);
    sim.check_accounts();
}

#[test]
fn a_started_message_is_finished_when_the_queue_overflows() {
    let limits = Limits { queue_bytes: [30_000; 3], ..Limits::default() };
    let mut sim = Sim::with_limits(1, Weather::delay(10), &["edge/a", "fog/b"], limits);
    sim.run_ms(1_000);
    sim.nodes[0].rate = Some(100_000.0);
    for _ in 0..60 {
        sim.publish(0, 1, Post::large(1, 20_000)).unwrap();
        sim.run_ms(50);
        assert!(sim.nodes[0].engine.peers()[0].queue_bytes[2] <= 50_500);
    }
    sim.nodes[0].rate = None;
    sim.run_ms(1_000);
    sim.check_accounts();
    sim.check_deliveries();
    let delivered = sim.sequences(1, 1);
    assert!(delivered.len() >= 12, "{delivered:?}");
    assert_eq!(delivered.last(), Some(&60), "the newest survives");
    assert_eq!(sim.nodes[1].engine.counters().reassembly_timeouts, 0, "nothing was left half sent");
}

#[test]
fn a_lane_can_be_dropped() {
    let mut sim = Sim::new(1, Weather::delay(10), &["edge/a", "fog/b"]);
    sim.run_ms(1_000);
    sim.nodes[0].rate = Some(50_000.0);
    sim.publish(0, 1, Post::large(1, 20_000)).unwrap();
    sim.run_ms(20);
    for _ in 0..5 {
        sim.publish(0, 1, Post::large(1, 20_000)).unwrap();
        sim.publish(0, 1, Post::large(2, 20_000)).unwrap();
    }
    let dropped = sim.nodes[0].engine.drop_lane(LaneId(1));
    assert_eq!(dropped.messages, 5);
    assert_eq!(sim.nodes[0].engine.lane_queued(LaneId(1)).messages, 1, "the started one goes on");
    sim.nodes[0].rate = None;
    sim.run_ms(1_000);
    assert_eq!(sim.sequences(1, 1), [1]);
    assert_eq!(sim.sequences(1, 2), [1, 2, 3, 4, 5]);
    assert_eq!(sim.nodes[0].engine.lane_queued(LaneId(1)).messages, 0);
}

#[test]
fn before_the_first_feedback_64_kib_are_sent() {
    let mut sim = Sim::new(1, Weather::delay(50), &["edge/a", "fog/b"]);
    sim.run_ms(1_000);
    let before = sim.nodes[0].sent_bytes;
    sim.publish(0, 1, Post::large(1, 1_000_000)).unwrap();
    sim.run_ms(49);
    let sent = sim.nodes[0].sent_bytes - before;
    assert!((60_000..=65_536 + 1_300).contains(&sent), "{sent}");
    sim.run_ms(2_000);
    assert_eq!(sim.sequences(1, 1), [1]);
    let window = sim.nodes[0].engine.peers()[0].window_bytes[2];
    assert_eq!(window, 64 * 1024 * 1024);
}

/// A peer that has said Hello and then sends what it likes.
struct Hostile {
    sim: Sim,
    sender: SenderId,
    sequence: u64,
}

const SMALL: Limits =
    Limits { queue_bytes: [100_000; 3], reassembly_bytes: 1_000_000, peers: 8, streams: 64 };

impl Hostile {
    fn new(seed: u64) -> Self {
        let mut sim =
            Sim::with_limits(seed, Weather::delay(5), &["edge/evil", "fog/b", "cloud/c"], SMALL);
        sim.run_ms(1_200);
        let endpoint = sim.endpoint(0);
        Self { sender: SenderId::of(&endpoint.flow, endpoint.epoch), sim, sequence: 0 }
    }

    fn header(&mut self, class: Priority) -> LinkHeader {
        self.sequence += 1;
        LinkHeader {
            class,
            records: 0,
            link_epoch: 1_000,
            sender: self.sender,
            link_sequence: self.sequence,
            send_ns: 1,
            unsettled: 1,
            message_floor: 1,
        }
    }

    /// Sends a whole message in a sample of its own, after `lost` samples that never come.
    /// `settled`: of all samples before it the sender knows what became of them.
    fn post(&mut self, message: u32, behind: u16, frame: &Frame, lost: u64, settled: bool) {
        self.sequence += lost;
        let mut header = self.header(Priority::State);
        if !settled {
            header.unsettled = u32::try_from(header.link_sequence).unwrap();
        }
        let length = u32::try_from(frame.received_len()).unwrap();
        let mut out = DatagramBuilder::new(1300);
        out.put_part(&part(message, length, 0, length, behind), frame);
        self.send(out.finish(&header), Priority::State);
    }

    fn send(&mut self, datagram: Bytes, class: Priority) {
        self.sim.nodes[1].engine.receive(self.sim.now, datagram, class);
        let reserved = self.sim.nodes[1].engine.reassembly_bytes();
        assert!(reserved <= SMALL.reassembly_bytes, "{reserved}");
    }
}

fn part(message: u32, total: u32, offset: u32, length: u32, behind: u16) -> Record {
    Record { message, total, offset, length, hops: 1, flags: 0, behind, age_us: 0 }
}

#[test]
fn unfinished_messages_of_a_hostile_peer_stay_within_bounds() {
    let mut hostile = Hostile::new(1);
    let filler = sim::frame(Post::large(1, 60_000), 1);
    for message in 1..3_000u32 {
        let total = [600_000, 17_000_000, 2_000, 300][message as usize % 4];
        let mut out = DatagramBuilder::new(1300);
        out.put_part(&part(message * 3, total, 0, 280.min(total), 1), &filler);
        let header = hostile.header(Priority::Bulk);
        hostile.send(out.finish(&header), Priority::Bulk);
    }
    // The honest one still gets its messages through.
    let sim = &mut hostile.sim;
    for _ in 0..20 {
        sim.publish(2, 1, Post::large(7, 30_000)).unwrap();
        sim.run_ms(20);
    }
    sim.run_ms(500);
    assert_eq!(sim.sequences(1, 7).len(), 20);
}

#[test]
fn waiting_messages_of_a_hostile_peer_stay_within_bounds() {
    let mut hostile = Hostile::new(1);
    for message in 2..5_000u32 {
        let frame = sim::frame(Post::reliable(message), u64::from(message));
        let mut out = DatagramBuilder::new(1300);
        let length = u32::try_from(frame.received_len()).unwrap();
        // Each waits for a message that never comes.
        out.put_part(&part(message * 2, length, 0, length, 1), &frame);
        let header = hostile.header(Priority::State);
        hostile.send(out.finish(&header), Priority::State);
    }
    hostile.sim.run_ms(40_000);
    assert_eq!(hostile.sim.nodes[1].engine.reassembly_bytes(), 0, "given up in the end");
    assert_eq!(
        hostile.sim.nodes[1].delivered.len(),
        4_998,
        "complete ones are handed out all the same"
    );
}

#[test]
fn a_class_with_too_many_gaps_goes_on_once_its_sender_settles_them() {
    let mut hostile = Hostile::new(1);
    let frame = sim::frame(Post::small(1), 1);
    // Every other sample is lost, and the sender knows of none what became of it. The last one says
    // that all before are settled.
    for message in 1..=9_001 {
        hostile.post(message, 0, &frame, 1, message > 9_000);
    }
    hostile.sim.run_ms(1);
    let refused = hostile.sim.nodes[1].engine.counters().overrun;
    assert!(refused > 0, "there were too many gaps");
    let delivered = hostile.sim.nodes[1].delivered.len() as u64;
    assert_eq!(delivered + refused, 9_001);
    assert_eq!(refused, 9_000 - 8_192, "the last one is taken");
}

#[test]
fn nothing_is_given_up_while_more_is_missing_than_can_be_told() {
    let mut hostile = Hostile::new(1);
    let filler = sim::frame(Post::small(1), 1);
    // Waits for the first message, which may be in any of the samples that are missing.
    hostile.post(2, 1, &sim::frame(Post::reliable(77), 1), 1, false);
    for message in 3..2_003 {
        hostile.post(message, 0, &filler, 1, false);
        hostile.sim.run_ms(2);
    }
    assert!(hostile.sim.sequences(1, 77).is_empty(), "it waits for longer than 2 s");
    for message in 2_003..3_003 {
        hostile.post(message, 0, &filler, 0, true);
        hostile.sim.run_ms(2);
    }
    assert_eq!(
        hostile.sim.sequences(1, 77),
        [1],
        "all that is missing is told: it waits no longer"
    );
}

#[test]
fn jumping_sequences_and_floors_do_no_harm() {
    let mut hostile = Hostile::new(1);
    let mut random = Random(5);
    let frame = sim::frame(Post::small(1), 1);
    let length = u32::try_from(frame.received_len()).unwrap();
    for _ in 0..30_000 {
        let mut out = DatagramBuilder::new(1300);
        let message = u32::try_from(random.next() >> 32).unwrap().max(2);
        out.put_part(&part(message, length, 0, length, 1), &frame);
        let mut header = hostile.header(Priority::State);
        header.link_sequence = random.next() >> random.below(60);
        header.link_sequence = header.link_sequence.max(1);
        header.message_floor = u32::try_from(random.next() >> 32).unwrap() >> random.below(32);
        header.unsettled = u32::try_from(header.link_sequence.min(u64::from(u32::MAX))).unwrap();
        hostile.send(out.finish(&header), Priority::State);
    }
    hostile.sim.run_ms(100);
}

#[test]
fn random_and_mutated_datagrams_never_panic() {
    // Datagrams as they are sent in an ordinary exchange.
    let mut captured: Vec<(Priority, Bytes)> = Vec::new();
    let store = std::rc::Rc::new(std::cell::RefCell::new(Vec::new()));
    let mut sim = Sim::new(3, Weather { loss: 0.1, ..Weather::delay(5) }, &["edge/a", "fog/b"]);
    let into = std::rc::Rc::clone(&store);
    sim.network.censor = Some(Box::new(move |_, _, class, datagram| {
        into.borrow_mut().push((class, datagram.clone()));
        false
    }));
    sim.run_ms(600);
    for _ in 0..20 {
        sim.publish(0, 1, Post::reliable(1)).unwrap();
        sim.publish(0, 1, Post::large(2, 5_000)).unwrap();
        sim.run_ms(30);
    }
    captured.append(&mut store.borrow_mut());
    assert!(captured.len() > 100);
    for seed in seeds() {
        let mut random = Random(seed);
        let mut sim = Sim::with_limits(seed, Weather::delay(5), &["edge/a", "fog/b"], SMALL);
        sim.run_ms(600);
        for _ in 0..300 {
            let at = usize::try_from(random.below(2)).unwrap();
            let (class, datagram) =
                &captured[usize::try_from(random.below(captured.len() as u64)).unwrap()];
            let mut bytes = BytesMut::from(&datagram[..]);
            for _ in 0..random.below(4) {
                let place = usize::try_from(random.below(bytes.len() as u64)).unwrap();
                bytes[place] = u8::try_from(random.next() % 256).unwrap();
            }
            if random.chance(0.1) {
                bytes.truncate(usize::try_from(random.below(bytes.len() as u64 + 1)).unwrap());
            }
            if random.chance(0.05) {
                bytes.clear();
                for _ in 0..random.below(200) {
                    bytes.put_u64(random.next());
                }
            }
            sim.nodes[at].engine.receive(sim.now, bytes.freeze(), *class);
            assert!(sim.nodes[at].engine.reassembly_bytes() <= SMALL.reassembly_bytes);
            assert!(sim.nodes[at].engine.peers().len() <= SMALL.peers);
            if random.chance(0.2) {
                let _ = sim.publish(0, 1, Post::reliable(1));
                sim.run(random.duration(Duration::from_millis(20)));
            }
        }
        sim.run_ms(3_000);
        sim.check_accounts();
    }
}

#[test]
fn who_finds_no_place_is_told_of_and_gets_one_when_it_is_free() {
    let limits = Limits { peers: 2, ..Limits::default() };
    let mut sim = Sim::with_limits(1, Weather::delay(5), &["edge/a", "fog/b", "cloud/c"], limits);
    sim.run_ms(1_000);
    let late = sim.join("edge/d");
    // It says Hello for a minute and gives up.
    sim.run_ms(65_000);
    let of = |sim: &Sim, wanted: fn(&LinkEvent) -> bool| {
        let events = sim.nodes[0].events.iter();
        events.filter(|(_, event)| wanted(event)).count()
    };
    assert_eq!(sim.nodes[0].engine.peers().len(), 2);
    assert_eq!(sim.nodes[0].engine.waiting_peers(), 1);
    assert!(sim.nodes[0].engine.counters().peers_refused > 100);
    let told = of(&sim, |event| matches!(event, LinkEvent::PeerRefused { peers: 2, .. }));
    assert!((1..=2).contains(&told), "once a minute: {told}");
    sim.nodes[2].alive = false;
    sim.run_ms(65_000);
    assert_eq!(sim.nodes[0].engine.waiting_peers(), 0);
    let admitted = of(&sim, |event| matches!(event, LinkEvent::PeerAdmitted(_)));
    assert_eq!(admitted, 1);
    let peer = sim.nodes[0].engine.peer(&sim.id(late)).unwrap();
    assert_eq!(peer.state, PeerState::Up);
    sim.publish(0, late, Post::reliable(1)).unwrap();
    sim.run_ms(100);
    assert_eq!(sim.sequences(late, 1), [1]);
}

#[test]
fn one_that_waits_for_a_place_and_goes_gets_none() {
    let limits = Limits { peers: 1, ..Limits::default() };
    let mut sim = Sim::with_limits(1, Weather::delay(5), &["edge/a", "fog/b"], limits);
    sim.run_ms(1_000);
    let late = sim.join("edge/d");
    sim.run_ms(100);
    assert_eq!(sim.nodes[0].engine.waiting_peers(), 1);
    sim.nodes[late].alive = false;
    let endpoint = sim.endpoint(late);
    sim.nodes[0].engine.peer_lost(sim.now, &endpoint);
    assert_eq!(sim.nodes[0].engine.waiting_peers(), 0);
}
