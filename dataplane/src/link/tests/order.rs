//! Who waits for whom, and who does not.

use std::time::Duration;

use blaze_domain::Priority;

use super::super::sim::{Post, Sim, Weather};
use super::super::wire::{HEADER_BYTES, RECORD_BYTES};
use super::seeds;
use crate::testing::Random;

/// Loses the first datagram of user messages from `edge`, of that class, with at least so many
/// bytes.
fn lose_first(sim: &mut Sim, wanted: Priority, at_least: usize) {
    let mut lost = false;
    sim.network.censor = Some(Box::new(move |from, _, class, datagram| {
        let control = datagram.len() < HEADER_BYTES + RECORD_BYTES || datagram[8 + 8..24] == [0; 8];
        let edge = from.flow.layer.as_str() == "edge";
        let lose = !lost && edge && class == wanted && !control && datagram.len() >= at_least;
        lost |= lose;
        lose
    }));
}

#[test]
fn a_lost_packet_delays_only_its_own_stream() {
    for class in Priority::ALL.iter().copied() {
        let mut sim = Sim::new(1, Weather::delay(20), &["edge/a", "fog/b"]);
        sim.run_ms(1_500);
        lose_first(&mut sim, class, 0);
        let post = |stream| Post::reliable(stream).class(class);
        let start = sim.now;
        sim.publish(0, 1, post(1)).unwrap();
        sim.run_ms(1);
        for _ in 0..10 {
            sim.publish(0, 1, post(1)).unwrap();
            sim.publish(0, 1, post(2)).unwrap();
            sim.run_ms(1);
        }
        sim.run_ms(18);
        assert_eq!(sim.sequences(1, 2).len(), 9, "one way after the last but one");
        assert!(sim.sequences(1, 1).is_empty(), "they wait for the first");
        sim.run_ms(200);
        assert_eq!(sim.sequences(1, 1), (1..=11).collect::<Vec<_>>());
        let first = sim.nodes[1]
            .delivered
            .iter()
            .find(|d| d.frame.writer() == super::super::sim::writer(1));
        let took = first.unwrap().at - start;
        // It is missed at once; the report may wait 50 ms, then a round trip.
        assert!(took < Duration::from_millis(20 + 50 + 45), "{took:?}");
    }
}

#[test]
fn a_control_message_waits_for_one_datagram_at_most() {
    for seed in seeds().step_by(10) {
        let mut random = Random(seed);
        let mut sim = Sim::new(seed, Weather::delay(5), &["edge/a", "fog/b", "cloud/c"]);
        sim.run_ms(1_500);
        // A datagram takes 13 ms.
        sim.nodes[0].rate = Some(100_000.0);
        for to in [1, 2] {
            sim.publish(0, to, Post::large(1, 400_000)).unwrap();
            for _ in 0..50 {
                sim.publish(0, to, Post::small(2).bytes(1_000)).unwrap();
            }
        }
        for _ in 0..10 {
            sim.run(Duration::from_millis(50) + random.duration(Duration::from_millis(50)));
            let at = sim.now;
            let urgent = Post::reliable(3).class(Priority::Control);
            sim.publish(0, 1, urgent).unwrap();
            sim.run_ms(60);
            let delivered = sim.nodes[1].delivered.iter().rev();
            let last = delivered
                .clone()
                .find(|d| d.frame.writer() == super::super::sim::writer(3))
                .unwrap();
            let took = last.at - at;
            // The datagram before it, LinkControl that may be due, itself, and the way.
            assert!(took < Duration::from_millis(13 + 8 + 3 + 5), "seed {seed}: {took:?}");
        }
    }
}

#[test]
fn peers_of_one_class_take_turns() {
    let mut sim = Sim::new(1, Weather::delay(5), &["edge/a", "fog/b", "cloud/c"]);
    sim.run_ms(1_500);
    sim.nodes[0].rate = Some(200_000.0);
    for to in [1, 2] {
        for _ in 0..40 {
            sim.publish(0, to, Post::small(1).bytes(1_000)).unwrap();
        }
    }
    sim.run_ms(250);
    let counts = [1, 2].map(|to| sim.nodes[to].delivered.len());
    assert!(counts[0] > 10 && counts[0].abs_diff(counts[1]) <= 1, "{counts:?}");
}

#[test]
fn a_dead_peer_slows_nobody() {
    let run = |dead: bool| {
        let mut sim = Sim::new(7, Weather::delay(10), &["edge/a", "fog/b", "cloud/c"]);
        sim.run_ms(1_500);
        sim.nodes[0].rate = Some(5_000_000.0);
        sim.nodes[2].alive = !dead;
        for _ in 0..300 {
            for to in [1, 2] {
                let reliable = sim.publish(0, to, Post::reliable(1));
                let large = sim.publish(0, to, Post::large(2, 8_000));
                assert!(to == 2 || (reliable.is_ok() && large.is_ok()));
            }
            sim.run_ms(10);
        }
        sim.run_ms(500);
        sim.check_accounts();
        assert_eq!(sim.nodes[1].delivered.len(), 600);
        let ages = sim.nodes[1].delivered.iter().map(|d| d.frame.age_us());
        (ages.clone().max().unwrap(), ages.sum::<u64>() / 600)
    };
    let (both, one) = (run(false), run(true));
    // The dead one even leaves room; it must never cost any.
    assert!(one.0 <= both.0 + 1_000 && one.1 <= both.1 + 1_000, "{one:?} {both:?}");
}

#[test]
fn a_chunked_message_does_not_wait_for_lost_best_effort_ones() {
    let mut sim = Sim::new(1, Weather::delay(20), &["edge/a", "fog/b"]);
    sim.run_ms(1_500);
    lose_first(&mut sim, Priority::State, 0);
    sim.publish(0, 1, Post::small(1)).unwrap();
    sim.run_ms(1);
    sim.publish(0, 1, Post::small(1).bytes(5_000)).unwrap();
    sim.run_ms(25);
    assert_eq!(sim.sequences(1, 1), [2]);
}
