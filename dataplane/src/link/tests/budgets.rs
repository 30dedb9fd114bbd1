//! What may go to each peer: limits of layers, the capacity that is measured, and what happens
//! after an outage.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_domain::Priority;
use blaze_proto::link::link_control::{Body, SnapshotRequest};

use super::super::event::PeerState;
use super::super::sim::{Post, Sim, Weather};
use super::super::{LinkBudgets, LinkCapacity, PacketSize};
use crate::limit::capacity::State;

/// Wire bytes per second.
const LIMIT: f64 = 1e6;
const HEADERS: usize = 80;
/// Each datagram is one packet.
const PACKETS: PacketSize = PacketSize {
    prefix: 0,
    align: 1,
    whole: 1_300,
    whole_header: HEADERS,
    last_part: 1_300,
    part: 1_300,
    part_header: HEADERS,
};

/// Limits what the first flow sends.
fn limit(sim: &mut Sim, layers: &[(&str, f64)], adaptive: bool) {
    let layers = layers.iter().map(|(layer, limit)| (layer.parse().unwrap(), *limit));
    let budgets = LinkBudgets {
        limit_bytes_per_s: LIMIT,
        layers: layers.collect(),
        adaptive,
        packets: PACKETS,
    };
    sim.nodes[0].engine.set_budgets(sim.now, budgets);
}

/// Wire bytes that the first flow has sent to another one.
fn sent_to(sim: &Sim, to: usize) -> f64 {
    let (datagrams, bytes) = sim.nodes[0].sent_to.get(&sim.id(to)).copied().unwrap_or_default();
    (bytes + datagrams * HEADERS as u64) as f64
}

fn capacity(sim: &Sim) -> LinkCapacity {
    let peer = sim.nodes[0].engine.peer(&sim.id(1)).unwrap();
    peer.capacity.unwrap()
}

/// Twenty images of so many bytes a second, and a hundred small messages.
fn publish(sim: &mut Sim, to: &[usize], image: usize, milliseconds: u64) {
    for step in 0..milliseconds / 10 {
        for to in to {
            let stream = u32::try_from(10 * to).unwrap();
            // Nobody takes them while the peer is down.
            if step % 5 == 0 {
                let post = Post::large(stream, image).newest();
                let _ = sim.publish(0, *to, post);
            }
            let _ = sim.publish(0, *to, Post::small(stream + 1));
        }
        sim.run_ms(10);
    }
}

#[test]
fn a_link_is_filled_up_to_its_limit_and_not_beyond() {
    let mut sim = Sim::new(1, Weather::delay(25), &["edge/a", "fog/b"]);
    limit(&mut sim, &[], true);
    sim.run_ms(1_500);
    publish(&mut sim, &[1], 100_000, 2_000);
    for _ in 0..5 {
        let before = sent_to(&sim, 1);
        publish(&mut sim, &[1], 100_000, 1_000);
        let sent = sent_to(&sim, 1) - before;
        assert!((0.95 * LIMIT..=LIMIT).contains(&sent), "{sent} bytes in a second");
    }
    assert_eq!(capacity(&sim).state, State::Unknown);
    sim.check_deliveries();
    sim.check_accounts();
}

/// Silent for longer than a moment, and not for so long that it counts as down.
fn cut(sim: &mut Sim) {
    let (a, b) = (sim.id(0), sim.id(1));
    sim.network.set_partition(&a, &b, true);
    publish(sim, &[1], 100_000, 1_300);
    assert_eq!(sim.nodes[0].engine.peer(&b).unwrap().state, PeerState::Suspect);
    sim.network.set_partition(&a, &b, false);
    sim.run_to(Duration::from_secs(2), "it acknowledges again", |sim| {
        sim.nodes[0].engine.peer(&b).is_some_and(|peer| peer.state == PeerState::Up)
    });
}

#[test]
fn after_an_outage_a_link_begins_low_and_with_what_is_small() {
    for needed in [0.0, 100_000.0] {
        let mut sim = Sim::new(1, Weather::delay(25), &["edge/a", "fog/b"]);
        // Told before there is anything to follow.
        let told = BTreeMap::from([(sim.id(1), needed)]);
        sim.nodes[0].engine.set_needed(sim.now, &told);
        limit(&mut sim, &[], true);
        sim.run_ms(1_500);
        publish(&mut sim, &[1], 100_000, 3_000);
        assert_eq!(capacity(&sim).state, State::Unknown);
        cut(&mut sim);
        let begins = capacity(&sim);
        let expected = if needed > 0.0 { 1.25 * needed } else { LIMIT / 32.0 };
        assert_eq!(begins.state, State::SlowStart, "{needed}");
        assert!((begins.bytes_per_s - expected).abs() < 1.0, "{begins:?} with {needed}");
        // The catch-up stays below what the link may carry, and well below at first.
        let (before, small) = (sent_to(&sim, 1), sim.sequences(1, 11).len());
        publish(&mut sim, &[1], 100_000, 250);
        let sent = sent_to(&sim, 1) - before;
        assert!(sent < 0.25 * 1.5 * expected + 10_000.0, "{sent} bytes in a quarter of a second");
        for _ in 0..10 {
            let before = sent_to(&sim, 1);
            publish(&mut sim, &[1], 100_000, 1_000);
            let sent = sent_to(&sim, 1) - before;
            assert!(sent <= LIMIT, "{sent} bytes in a second");
        }
        assert_eq!(capacity(&sim).state, State::Unknown, "{needed}");
        let came = sim.sequences(1, 11).len() - small;
        assert!(came > 1_000, "{came} small messages in ten seconds");
        sim.check_deliveries();
        sim.check_accounts();
    }
}

/// Cut for so long that the flow is forgotten: the estimate is gone, and the way may be another
/// one.
#[test]
fn whoever_comes_back_after_it_was_forgotten_begins_low_as_well() {
    let mut sim = Sim::new(1, Weather::delay(25), &["edge/a", "fog/b"]);
    limit(&mut sim, &[], true);
    sim.run_ms(1_500);
    let (a, b) = (sim.id(0), sim.id(1));
    assert_eq!(capacity(&sim).state, State::Unknown, "at first nothing is known against it");
    sim.network.set_partition(&a, &b, true);
    sim.run_ms(70_000);
    assert!(sim.nodes[0].engine.peer(&b).is_none_or(|peer| peer.state == PeerState::Down));
    sim.network.set_partition(&a, &b, false);
    for node in [0, 1] {
        sim.announce(node);
    }
    let is_up = |sim: &Sim| {
        let peer = sim.nodes[0].engine.peer(&sim.id(1));
        peer.is_some_and(|peer| peer.state == PeerState::Up)
    };
    sim.run_to(Duration::from_secs(10), "it is back", is_up);
    assert_eq!(capacity(&sim).state, State::SlowStart);
    // The same with a new life of it.
    publish(&mut sim, &[1], 100_000, 10_000);
    assert_eq!(capacity(&sim).state, State::Unknown);
    sim.crash(1);
    sim.run_to(Duration::from_secs(10), "it is back", is_up);
    assert_eq!(capacity(&sim).state, State::SlowStart);
}

#[test]
fn two_peers_of_one_layer_share_its_limit_and_hold_up_nobody_else() {
    const OF_FOG: f64 = 100_000.0;
    let mut sim = Sim::new(1, Weather::delay(10), &["edge/a", "fog/b", "fog/c", "cloud/d"]);
    limit(&mut sim, &[("fog", OF_FOG)], false);
    sim.run_ms(1_500);
    publish(&mut sim, &[1, 2, 3], 20_000, 1_000);
    let before = [1, 2, 3].map(|to| sent_to(&sim, to));
    let published = sim.sequences(3, 30).len();
    publish(&mut sim, &[1, 2, 3], 20_000, 10_000);
    let sent = [1, 2, 3].map(|to| sent_to(&sim, to) - before[to - 1]);
    let of_fog = sent[0] + sent[1];
    assert!((0.95 * 10.0 * OF_FOG..=10.0 * OF_FOG).contains(&of_fog), "{sent:?}");
    assert!((sent[0] / of_fog - 0.5).abs() < 0.1, "they take turns: {sent:?}");
    let to_cloud = sim.sequences(3, 30).len() - published;
    assert!((198..=202).contains(&to_cloud), "{to_cloud} of 200 images in another layer");
    sim.check_deliveries();
    sim.check_accounts();
}

#[test]
fn whoever_waits_for_its_link_says_until_when() {
    let mut sim = Sim::new(1, Weather::delay(10), &["edge/a", "fog/b"]);
    limit(&mut sim, &[("fog", 100_000.0)], false);
    sim.run_ms(1_200);
    assert_eq!(sim.nodes[0].engine.paced_until(), None, "nothing waits");
    sim.publish(0, 1, Post::large(1, 50_000)).unwrap();
    let (now, b) = (sim.now, sim.id(1));
    let engine = &mut sim.nodes[0].engine;
    let messages = |engine: &mut super::super::Engine, at: Instant| {
        let all = std::iter::from_fn(|| engine.poll_transmit(at));
        all.filter(|transmit| !transmit.control).count()
    };
    assert_eq!(messages(engine, now), 3, "two were saved, and one more");
    let until = engine.paced_until().unwrap();
    // A datagram takes 14 ms.
    assert!(until > now && until < now + Duration::from_millis(20), "{:?}", until - now);
    let before = until - Duration::from_millis(1);
    assert!(engine.poll_transmit(before).is_none());
    // LinkControl never waits, and is waited off.
    let body = Body::SnapshotRequest(SnapshotRequest { version: 3, parts: vec![1] });
    engine.send_control(&b, body).unwrap();
    let control = engine.poll_transmit(before).unwrap();
    assert!(control.control && control.class == Priority::Control);
    assert!(engine.poll_transmit(before).is_none());
    let later = engine.paced_until().unwrap();
    assert!(later > until);
    assert_eq!(messages(engine, later), 1);
}
