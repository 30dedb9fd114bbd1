//! What arrives: complete, in order, once, and repaired.

use std::time::Duration;

use blaze_domain::{DropReason, Priority};

use super::super::event::{LaneId, LinkEvent};
use super::super::sim::{Post, Sim, Weather};
use super::{bad_weather, seeds};
use crate::testing::Random;

#[test]
fn reliable_messages_arrive_all_in_order_and_once() {
    for seed in seeds() {
        let mut random = Random(seed);
        let weather = bad_weather(&mut random, 0.05);
        let mut sim = Sim::new(seed, weather, &["edge/a", "fog/b"]);
        sim.run_to(Duration::from_secs(2), "up", |sim| {
            sim.nodes[0].engine.peers()[0].rtt.is_some()
        });
        let mut counts = [0u64; 4];
        for _ in 0..150 {
            let stream = u32::try_from(random.below(4)).unwrap();
            let class = Priority::ALL[stream as usize % 3];
            let bytes = if random.chance(0.05) { 5_000 } else { 200 };
            let post = Post::reliable(stream).class(class).bytes(bytes);
            sim.publish(0, 1, post).unwrap();
            counts[stream as usize] += 1;
            sim.run(random.duration(Duration::from_millis(10)));
        }
        sim.run_ms(6_000);
        for (stream, count) in (0..).zip(counts) {
            let expected: Vec<u64> = (1..=count).collect();
            assert_eq!(sim.sequences(1, stream), expected, "seed {seed}, {weather:?}");
        }
        sim.check_deliveries();
        sim.check_accounts();
        assert!(sim.nodes[0].lanes.values().all(|lane| lane.out == lane.submitted), "seed {seed}");
        assert!(sim.nodes[0].lanes.values().all(|lane| lane.sent == lane.submitted), "seed {seed}");
        assert_eq!(sim.nodes[1].engine.reassembly_bytes(), 0);
    }
}

#[test]
fn best_effort_messages_arrive_in_order_and_once() {
    for seed in seeds() {
        let mut random = Random(seed);
        let weather =
            Weather { jitter: Duration::from_millis(3), ..bad_weather(&mut random, 0.05) };
        let mut sim = Sim::new(seed, weather, &["edge/a", "fog/b"]);
        sim.run_ms(1_000);
        for _ in 0..200 {
            let stream = u32::try_from(random.below(3)).unwrap();
            sim.publish(0, 1, Post::small(stream)).unwrap();
            sim.run(random.duration(Duration::from_millis(10)));
        }
        sim.run_ms(1_000);
        sim.check_deliveries();
        sim.check_accounts();
        let delivered = sim.nodes[1].delivered.len();
        assert!(delivered > 150, "seed {seed}: {delivered} of 200, {weather:?}");
        let lanes = sim.nodes[0].lanes.values();
        assert_eq!(lanes.map(|lane| lane.out).sum::<u64>(), 200);
        assert_eq!(sim.nodes[0].engine.counters().repairs, 0);
    }
}

#[test]
fn large_frames_are_repaired() {
    for seed in seeds().step_by(10) {
        let mut random = Random(seed);
        let loss = 0.01 + 0.04 * random.share();
        let weather = Weather {
            delay: Duration::from_millis(25),
            jitter: Duration::from_micros(300),
            loss,
            duplicated: 0.001,
        };
        let mut sim = Sim::new(seed, weather, &["edge/a", "fog/b"]);
        sim.nodes[0].rate = Some(12_500_000.0);
        sim.run_ms(1_000);
        for _ in 0..5 {
            let post = Post::large(1, 1_000_000).lifespan(Some(Duration::from_secs(2)));
            sim.publish(0, 1, post).unwrap();
            sim.publish(0, 1, Post::small(2)).unwrap();
            sim.run_ms(200);
        }
        sim.run_ms(2_000);
        assert_eq!(sim.sequences(1, 1), [1, 2, 3, 4, 5], "seed {seed}, loss {loss}");
        sim.check_deliveries();
        sim.check_accounts();
        let repairs = sim.nodes[0].engine.counters().repairs;
        #[allow(clippy::cast_precision_loss, reason = "a few thousand")]
        let share = repairs as f64 / (5.0 * 809.0);
        assert!(share < loss * 2.0 + 0.01, "seed {seed}: {share} repaired at {loss} loss");
        let info = &sim.nodes[0].engine.peers()[0];
        assert!(
            (info.loss - loss).abs() < 0.02,
            "seed {seed}: {} measured, {loss} true",
            info.loss
        );
    }
}

#[test]
fn many_losses_in_one_round_trip_are_repaired_in_the_next() {
    let mut sim = Sim::new(1, Weather::delay(150), &["edge/a", "fog/b"]);
    sim.run_ms(2_000);
    let (a, b) = (sim.id(0), sim.id(1));
    let weather = Weather { loss: 0.2, ..Weather::delay(150) };
    sim.network.set_path(&a, &b, weather);
    // Each in a sample of its own: about 70 gaps in the time from a loss to its repair.
    for _ in 0..6_000 {
        sim.publish(0, 1, Post::reliable(1)).unwrap();
        sim.run_ms(1);
    }
    sim.run_ms(10_000);
    sim.check_deliveries();
    sim.check_accounts();
    let delivered = sim.sequences(1, 1).len();
    // One that is lost six times running is given up, and so rare is that.
    assert!(delivered > 5_990, "{delivered} of 6000");
}

#[test]
fn the_last_message_is_repaired_by_a_probe() {
    let mut sim = Sim::new(1, Weather::delay(20), &["edge/a", "fog/b"]);
    sim.run_ms(1_000);
    sim.publish(0, 1, Post::reliable(1)).unwrap();
    sim.run_ms(1_000);
    let mut lost = false;
    sim.network.censor = Some(Box::new(move |from, _, class, _| {
        let lose = !lost && class == Priority::State && from.flow.layer.as_str() == "edge";
        lost |= lose;
        lose
    }));
    let sent_at = sim.now;
    sim.publish(0, 1, Post::reliable(1)).unwrap();
    sim.run_ms(1_000);
    assert_eq!(sim.sequences(1, 1), [1, 2]);
    let took = sim.nodes[1].delivered[1].at - sent_at;
    // Probe after 100 ms, half a round trip there and back, repair: half a round trip.
    assert!(took < Duration::from_millis(175), "{took:?}");
    assert!(sim.nodes[0].engine.counters().probes >= 1);
    assert_eq!(sim.nodes[0].engine.counters().repairs, 1);
}

#[test]
fn an_outage_shorter_than_down_loses_nothing_reliable() {
    for seed in seeds().step_by(4) {
        let mut random = Random(seed);
        // Without loss of Hello beside the outage, the peers are never down.
        let weather = bad_weather(&mut random, 0.0);
        let mut sim = Sim::new(seed, weather, &["edge/a", "fog/b"]);
        sim.run_ms(1_500);
        let (a, b) = (sim.id(0), sim.id(1));
        for step in 0..100u64 {
            if step == 20 {
                sim.network.set_partition(&a, &b, true);
            }
            let bytes = if step % 7 == 0 { 6_000 } else { 100 };
            sim.publish(0, 1, Post::reliable(1).bytes(bytes)).unwrap();
            sim.run_ms(18);
            if step == 99 {
                sim.network.set_partition(&a, &b, false);
            }
        }
        sim.run_ms(5_000);
        let downs = sim.nodes.iter().flat_map(|node| &node.events);
        let downs = downs.filter(|event| matches!(event.1, LinkEvent::PeerDown { .. })).count();
        assert_eq!(downs, 0, "seed {seed}");
        let mut events = sim.nodes[0].events.iter();
        let recovered = events.any(|(_, event)| matches!(event, LinkEvent::PeerRecovered { .. }));
        assert!(recovered, "seed {seed}: it was suspect meanwhile");
        assert_eq!(sim.sequences(1, 1), (1..=100).collect::<Vec<_>>(), "seed {seed}, {weather:?}");
        sim.check_deliveries();
        sim.check_accounts();
    }
}

#[test]
fn lifespan_ends_at_both_ends() {
    let mut sim = Sim::new(1, Weather::delay(40), &["edge/a", "fog/b"]);
    sim.run_ms(1_000);
    let span = |milliseconds| Post::reliable(1).lifespan(Some(Duration::from_millis(milliseconds)));
    // Too old on arrival.
    sim.publish(0, 1, span(30)).unwrap();
    sim.run_ms(300);
    let lane = LaneId(1);
    assert_eq!(
        sim.nodes[0].lanes[&lane].out, 1,
        "it arrived; that it was too late is counted there"
    );
    assert_eq!(sim.nodes[1].receiver_dropped.get(&DropReason::Lifespan), Some(&1));
    // Too old while it waits: the first is on the way when the path is cut, the second waits for it
    // to heal.
    let (a, b) = (sim.id(0), sim.id(1));
    sim.network.set_partition(&a, &b, true);
    sim.publish(0, 1, span(200)).unwrap();
    sim.run_ms(400);
    sim.publish(0, 1, span(200)).unwrap();
    sim.run_ms(300);
    assert_eq!(sim.nodes[0].lanes[&lane].dropped[&DropReason::Lifespan], 1);
    sim.network.set_partition(&a, &b, false);
    sim.run_ms(1_000);
    assert_eq!(sim.nodes[0].lanes[&lane].dropped[&DropReason::Lifespan], 2);
    sim.publish(0, 1, span(200)).unwrap();
    sim.run_ms(45);
    assert_eq!(sim.sequences(1, 1), [4], "those that were given up hold nobody back");
    sim.check_accounts();
}

#[test]
fn a_large_message_that_grows_old_is_counted_once() {
    for seed in seeds() {
        let mut random = Random(seed);
        let mut sim = Sim::new(seed, Weather::delay(20), &["edge/a", "fog/b"]);
        sim.run_ms(1_500);
        let loss = 0.1 + 0.3 * random.share();
        let mut dice = Random(seed + 1);
        // What is lost is messages alone: a peer that is down counts what it had of them. And
        // nothing overtakes: a part that was given up would come after all.
        sim.network.weather.delay = Duration::from_millis(1 + random.below(79));
        sim.network.censor =
            Some(Box::new(move |_, _, class, _| class == Priority::Bulk && dice.chance(loss)));
        for _ in 0..60 {
            let post = Post::large(1, 4_000).lifespan(Some(Duration::from_millis(90)));
            sim.publish(0, 1, post).unwrap();
            sim.run(random.duration(Duration::from_millis(100)));
        }
        sim.run_ms(3_000);
        sim.check_accounts();
        sim.check_deliveries();
        let lane = &sim.nodes[0].lanes[&LaneId(1)];
        let late: u64 = sim.nodes[1].receiver_dropped.values().sum();
        let delivered = sim.sequences(1, 1).len() as u64;
        assert_eq!(lane.out, delivered + late, "seed {seed}, loss {loss}: {lane:?}");
    }
}

/// Loses all user datagrams of the first flow that hold a message of 700 bytes or more.
fn lose_large_ones(sim: &mut Sim) {
    sim.network.censor = Some(Box::new(|from, _, class, datagram| {
        class == Priority::State && from.flow.layer.as_str() == "edge" && datagram.len() >= 700
    }));
}

#[test]
fn a_reliable_message_of_which_nothing_came_is_counted_once() {
    for lifespan in [None, Some(Duration::from_millis(300))] {
        let mut sim = Sim::new(1, Weather::delay(20), &["edge/a", "fog/b"]);
        sim.run_ms(1_500);
        let post = Post::reliable(1).lifespan(lifespan);
        sim.publish(0, 1, post).unwrap();
        sim.run_ms(200);
        lose_large_ones(&mut sim);
        sim.publish(0, 1, post.bytes(700)).unwrap();
        sim.run_ms(1);
        sim.publish(0, 1, post).unwrap();
        // Others go on, so that the class is active.
        for _ in 0..60 {
            sim.publish(0, 1, Post::small(2)).unwrap();
            sim.run_ms(50);
        }
        assert_eq!(sim.sequences(1, 1), [1, 3], "{lifespan:?}");
        let lane = &sim.nodes[0].lanes[&LaneId(1)];
        let reason =
            if lifespan.is_some() { DropReason::Lifespan } else { DropReason::ReassemblyTimeout };
        assert_eq!(lane.out, 2, "{lifespan:?}: what did not arrive is not out");
        assert_eq!(
            lane.dropped.iter().collect::<Vec<_>>(),
            [(&reason, &1)],
            "{lifespan:?}: counted by its sender"
        );
        assert!(sim.nodes[1].receiver_dropped.is_empty(), "{lifespan:?}: and by nobody else");
        sim.check_accounts();
    }
}

#[test]
fn a_repair_that_comes_after_all_does_not_make_a_message_out_that_was_given_up() {
    let mut sim = Sim::new(1, Weather::delay(20), &["edge/a", "fog/b"]);
    sim.run_ms(1_500);
    lose_large_ones(&mut sim);
    let start = sim.now;
    sim.publish(0, 1, Post::reliable(1).bytes(700)).unwrap();
    sim.run_ms(1);
    sim.publish(0, 1, Post::reliable(1)).unwrap();
    while sim.sequences(1, 1).is_empty() {
        assert!(sim.now - start < Duration::from_secs(5), "it is given up");
        let _ = sim.publish(0, 1, Post::small(2));
        sim.run_ms(1);
    }
    // From now on nothing is lost, and the sender does not know yet.
    sim.network.censor = None;
    sim.run_ms(1_000);
    assert_eq!(sim.sequences(1, 1), [2]);
    let lane = &sim.nodes[0].lanes[&LaneId(1)];
    assert_eq!((lane.out, lane.dropped[&DropReason::ReassemblyTimeout]), (1, 1));
    sim.check_accounts();
}

#[test]
fn age_counts_residence_half_the_round_trip_and_repair() {
    let mut sim = Sim::new(1, Weather::delay(30), &["edge/a", "fog/b"]);
    sim.run_ms(2_000);
    sim.nodes[0].rate = Some(1_000_000.0);
    sim.publish(0, 1, Post::large(1, 100_000)).unwrap();
    sim.run_ms(1_000);
    let delivered = &sim.nodes[1].delivered[0];
    let true_age = delivered.at - sim.start - Duration::from_millis(2_000);
    let told = Duration::from_micros(delivered.frame.age_us());
    assert!(true_age > Duration::from_millis(130), "{true_age:?}");
    assert!(told.abs_diff(true_age) < Duration::from_millis(3), "{told:?} told, {true_age:?} true");
}

#[test]
fn small_messages_share_a_datagram_and_none_waits() {
    let mut sim = Sim::new(1, Weather::delay(5), &["edge/a", "fog/b"]);
    sim.run_ms(1_600);
    let before = sim.nodes[0].sent_datagrams;
    for _ in 0..6 {
        sim.publish(0, 1, Post::small(1)).unwrap();
    }
    sim.run_ms(6);
    assert_eq!(sim.sequences(1, 1).len(), 6);
    assert_eq!(sim.nodes[0].sent_datagrams - before, 1);
}

#[test]
fn used_up_message_numbers_begin_a_new_link_epoch() {
    let mut sim = Sim::new(1, Weather { loss: 0.05, ..Weather::delay(10) }, &["edge/a", "fog/b"]);
    sim.run_ms(1_200);
    sim.publish(0, 1, Post::reliable(1)).unwrap();
    sim.run_ms(500);
    sim.nodes[0].engine.peers[0].as_mut().unwrap().send[1].skip_to_last_numbers(20);
    for _ in 0..60 {
        sim.publish(0, 1, Post::reliable(1)).unwrap();
        sim.publish(0, 1, Post::small(2)).unwrap();
        sim.run_ms(5);
    }
    sim.run_ms(2_000);
    assert_eq!(sim.sequences(1, 1), (1..=61).collect::<Vec<_>>());
    sim.check_deliveries();
    sim.check_accounts();
    assert_eq!(sim.nodes[0].engine.peers()[0].queue_bytes, [0; 3]);
}

#[test]
fn feedback_comes_as_often_as_agreed() {
    let count = std::rc::Rc::new(std::cell::Cell::new(0));
    let seen = std::rc::Rc::clone(&count);
    let mut sim = Sim::new(1, Weather::delay(10), &["edge/a", "fog/b"]);
    sim.run_ms(1_200);
    sim.network.censor = Some(Box::new(move |from, _, _, datagram| {
        // A Hello tells the layer's name, a Feedback no name at all.
        let hello = datagram.windows(3).any(|bytes| bytes == b"fog");
        if from.flow.layer.as_str() == "fog" && !hello {
            seen.set(seen.get() + 1);
        }
        false
    }));
    let per_second = |sim: &mut Sim, posts: u64, every: u64| {
        count.set(0);
        for _ in 0..1_000 / every {
            for _ in 0..posts {
                sim.publish(0, 1, Post::small(1).bytes(1_000)).unwrap();
            }
            sim.run_ms(every);
        }
        count.get()
    };
    assert_eq!(per_second(&mut sim, 0, 1_000), 0, "nothing was ever sent");
    let busy = per_second(&mut sim, 1, 10);
    assert!((18..=21).contains(&busy), "every 50 ms: {busy}");
    let flood = per_second(&mut sim, 5, 1);
    assert!((74..=82).contains(&flood), "every 64 samples: {flood}");
    sim.run_ms(100);
    let idle = per_second(&mut sim, 0, 1_000);
    assert!((0..=2).contains(&idle), "every 500 ms, some with a Hello: {idle}");
}
