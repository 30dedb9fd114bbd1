//! Peers come, fall silent, return, leave, and begin new lives.

use std::time::Duration;

use blaze_domain::DropReason;
use blaze_proto::link::link_control::{Body, SnapshotRequest, State};

use super::super::event::{LinkEvent, PeerState};
use super::super::sim::{Post, Sim, Weather};
use super::super::transport::Endpoint;
use super::{bad_weather, seeds};
use crate::testing::Random;

fn names(sim: &Sim, at: usize) -> Vec<String> {
    let events = sim.nodes[at].events.iter().filter_map(|(_, event)| match event {
        LinkEvent::PeerUp(Endpoint { flow, epoch }) => Some(format!("up {flow} {epoch}")),
        LinkEvent::PeerSuspect { flow } => Some(format!("suspect {flow}")),
        LinkEvent::PeerRecovered { flow } => Some(format!("recovered {flow}")),
        LinkEvent::PeerDown { endpoint, reason } => {
            Some(format!("down {} {reason:?}", endpoint.flow))
        }
        LinkEvent::PeerForgotten(peer) => Some(format!("forgotten {}", peer.flow)),
        _ => None,
    });
    events.collect()
}

#[test]
fn peers_are_up_after_a_round_trip_and_know_their_clocks() {
    let mut sim = Sim::new(1, Weather::delay(40), &["edge/a", "fog/b"]);
    let ahead = 1_700_000_000_000_000_000 + 5_000_000_000;
    sim.nodes[1].engine.set_wall_clock(sim.now, ahead);
    sim.nodes[1].engine.set_addresses(vec!["10.0.0.2".to_owned()]);
    sim.nodes[1].engine.set_registry(9, 77);
    let b = sim.id(1);
    assert!(!sim.nodes[0].engine.takes_lz4(&b), "it may be of an older version");
    sim.run_ms(81);
    assert_eq!(names(&sim, 0), ["up fog/b 1"]);
    assert!(sim.nodes[0].engine.takes_lz4(&b));
    sim.nodes[1].engine.set_state(sim.now, State::Ready);
    sim.run_ms(1_500);
    let info = sim.nodes[0].engine.peers().remove(0);
    assert_eq!(info.state, PeerState::Up);
    assert_eq!((info.version, info.digest), (9, 77));
    let told = |event: &LinkEvent| {
        matches!(
            event,
            LinkEvent::Hello { hello, .. } if hello.state() == State::Ready,
        )
    };
    assert!(sim.nodes[0].events.iter().any(|(_, event)| told(event)));
    assert_eq!(info.rtt, Some(Duration::from_millis(80)));
    assert!((info.clock_offset_ns.unwrap() - 5_000_000_000).abs() < 1_000_000, "{info:?}");
    assert_eq!(info.clock_error, Some(Duration::from_millis(40)));
    let told = sim.nodes[0].events.iter().any(
        |(_, event)| matches!(event, LinkEvent::Addresses(addresses) if addresses == &["10.0.0.2"]),
    );
    assert!(told);
}

#[test]
fn one_side_is_enough_for_discovery() {
    let mut sim = Sim::new(1, Weather::delay(10), &["edge/a", "fog/b", "cloud/c"]);
    sim.nodes[2].alive = false;
    sim.run_ms(100);
    // A Hello alone makes its sender known, also to one that was told nothing by its transport.
    sim.rebuild(0);
    sim.run_ms(1_000);
    assert_eq!(names(&sim, 1), ["up edge/a 1", "down edge/a NewEpoch", "up edge/a 2"]);
    assert_eq!(names(&sim, 0), ["up fog/b 1", "down fog/b Restarted", "up fog/b 1"]);
}

#[test]
fn silence_is_suspect_then_down_then_forgotten() {
    let mut sim = Sim::new(1, Weather::delay(10), &["edge/a", "fog/b"]);
    sim.run_ms(1_510);
    let (a, b) = (sim.id(0), sim.id(1));
    sim.network.set_partition(&a, &b, true);
    let cut_at = sim.now;
    sim.publish(0, 1, Post::reliable(1)).unwrap();
    sim.run_ms(295);
    assert_eq!(sim.nodes[0].engine.peers()[0].state, PeerState::Up);
    sim.run_ms(10);
    assert_eq!(sim.nodes[0].engine.peers()[0].state, PeerState::Suspect);
    sim.publish(0, 1, Post::small(2)).unwrap();
    sim.run_ms(1_500);
    assert_eq!(
        sim.nodes[0].engine.lane_queued(super::super::LaneId(2)).messages,
        1,
        "suspect: it waits"
    );
    sim.run_to(Duration::from_secs(1), "down", |sim| {
        sim.nodes[0].engine.peers()[0].state == PeerState::Down
    });
    assert!(
        sim.now - cut_at >= Duration::from_millis(2_000)
            && sim.now - cut_at <= Duration::from_millis(2_600)
    );
    assert_eq!(
        sim.nodes[0].lanes.values().map(|lane| lane.dropped[&DropReason::LinkDown]).sum::<u64>(),
        2
    );
    assert_eq!(sim.publish(0, 1, Post::small(2)), Err(DropReason::LinkDown));
    assert_eq!(sim.nodes[0].engine.send_control(&b, request()), Err(DropReason::LinkDown));
    sim.run_ms(57_000);
    assert_eq!(sim.nodes[0].engine.peers().len(), 1);
    sim.run_ms(3_000);
    assert!(sim.nodes[0].engine.peers().is_empty());
    let expected = ["up fog/b 1", "suspect fog/b", "down fog/b Silent", "forgotten fog/b"];
    assert_eq!(names(&sim, 0), expected);
    assert_eq!(sim.publish(0, 1, Post::small(2)), Err(DropReason::NoDestination));
    assert_eq!(sim.nodes[0].engine.next_timeout(), None, "nothing is left to do");
}

fn request() -> Body {
    Body::SnapshotRequest(SnapshotRequest { version: 3, parts: vec![1] })
}

#[test]
fn a_peer_that_returns_starts_anew_and_gets_nothing_old() {
    for seed in seeds().step_by(4) {
        let mut random = Random(seed);
        let weather = bad_weather(&mut random, 0.02);
        let mut sim = Sim::new(seed, weather, &["edge/a", "fog/b"]);
        sim.run_ms(1_500);
        let (a, b) = (sim.id(0), sim.id(1));
        sim.publish(0, 1, Post::reliable(1)).unwrap();
        sim.run_ms(1_000);
        sim.network.set_partition(&a, &b, true);
        for _ in 0..5 {
            sim.publish(0, 1, Post::reliable(1)).unwrap();
        }
        sim.run_ms(5_000);
        sim.network.set_partition(&a, &b, false);
        sim.run_ms(1_500);
        for _ in 0..5 {
            sim.publish(0, 1, Post::reliable(1)).unwrap();
            sim.run_ms(20);
        }
        sim.run_ms(3_000);
        assert_eq!(sim.sequences(1, 1), [1, 7, 8, 9, 10, 11], "seed {seed}, {weather:?}");
        sim.check_accounts();
        assert_eq!(sim.nodes[0].lanes[&super::super::LaneId(1)].dropped[&DropReason::LinkDown], 5);
    }
}

#[test]
fn goodbye_is_down_at_once_and_final() {
    let mut sim = Sim::new(1, Weather::delay(10), &["edge/a", "fog/b"]);
    sim.network.weather.jitter = Duration::from_millis(5);
    sim.run_ms(1_200);
    sim.publish(0, 1, Post::reliable(1)).unwrap();
    sim.run_ms(100);
    sim.nodes[1].engine.goodbye();
    sim.run_ms(20);
    sim.nodes[1].alive = false;
    assert_eq!(names(&sim, 0), ["up fog/b 1", "down fog/b Goodbye", "forgotten fog/b"]);
    assert_eq!(sim.publish(0, 1, Post::reliable(1)), Err(DropReason::LinkDown));
    sim.run_ms(200);
    // A late Hello of that life changes nothing; a new life does.
    let endpoint = sim.endpoint(1);
    sim.nodes[0].engine.peer_discovered(sim.now, endpoint);
    sim.run_ms(600);
    assert_eq!(names(&sim, 0).len(), 3);
    assert!(sim.nodes[0].engine.peers().is_empty());
    sim.nodes[1].alive = true;
    sim.crash(1);
    sim.run_ms(600);
    assert_eq!(names(&sim, 0)[3..], ["up fog/b 2"]);
}

#[test]
fn a_new_life_replaces_the_old_one_and_an_older_one_is_ignored() {
    let mut sim = Sim::new(1, Weather::delay(10), &["edge/a", "fog/b"]);
    sim.run_ms(1_000);
    let old = sim.endpoint(1);
    sim.nodes[1].alive = false;
    for _ in 0..3 {
        sim.publish(0, 1, Post::reliable(1)).unwrap();
    }
    sim.run_ms(50);
    sim.nodes[1].alive = true;
    sim.crash(1);
    sim.run_ms(500);
    let lane = &sim.nodes[0].lanes[&super::super::LaneId(1)];
    assert_eq!(lane.dropped[&DropReason::LinkDown], 3);
    sim.nodes[0].engine.peer_discovered(sim.now, old.clone());
    sim.nodes[0].engine.peer_lost(sim.now, &old);
    sim.publish(0, 1, Post::reliable(1)).unwrap();
    sim.run_ms(500);
    assert_eq!(sim.sequences(1, 1), [4]);
    assert_eq!(names(&sim, 0), ["up fog/b 1", "down fog/b NewEpoch", "up fog/b 2"]);
    assert!(sim.nodes[0].engine.counters().stale >= 1);
    sim.check_accounts();
}

#[test]
fn a_flow_is_a_peer_again_when_another_of_its_name_has_ended() {
    // Before and after the first one has forgotten those who do not speak with it any more; with a
    // Goodbye, and without.
    for (both_ms, says_goodbye) in [(6_000, true), (120_000, true), (6_000, false)] {
        let mut sim = Sim::new(1, Weather::delay(10), &["edge/a", "fog/b"]);
        sim.run_ms(1_000);
        let double = sim.double(0);
        sim.run_ms(both_ms);
        let up = |sim: &Sim| {
            let peers = sim.nodes[1].engine.peers().into_iter();
            let up = peers.filter(|peer| peer.state == PeerState::Up).map(|peer| peer.epoch);
            up.collect::<Vec<_>>()
        };
        assert_eq!(up(&sim), [2], "the newer one");
        assert_eq!(sim.nodes[1].engine.waiting_peers(), 0, "that is no lack of places");
        if says_goodbye {
            sim.nodes[double].engine.goodbye();
            sim.run_ms(20);
        }
        sim.nodes[double].alive = false;
        sim.run_ms(if says_goodbye { 1_000 } else { 4_000 });
        assert_eq!(up(&sim), [1], "{both_ms}, {says_goodbye}");
        sim.publish(1, 0, Post::reliable(1)).unwrap();
        sim.run_ms(100);
        assert_eq!(sim.sequences(0, 1), [1], "{both_ms}, {says_goodbye}");
        // It came after all: a late Hello of the life that has ended.
        let late = sim.endpoint(double);
        if says_goodbye {
            assert!(!sim.nodes[1].engine.peer_discovered(sim.now, late));
            sim.run_ms(1_000);
            assert_eq!(up(&sim), [1]);
        }
    }
}

#[test]
fn a_flow_that_is_silent_for_a_while_keeps_its_place_from_its_life_before() {
    let mut sim = Sim::new(1, Weather::delay(10), &["edge/a", "fog/b"]);
    sim.run_ms(1_000);
    sim.crash(1);
    sim.run_ms(1_000);
    let (edge, fog) = (sim.id(0), sim.id(1));
    sim.network.set_partition(&edge, &fog, true);
    sim.run_ms(4_000);
    sim.network.set_partition(&edge, &fog, false);
    sim.run_ms(1_000);
    let expected =
        ["up fog/b 1", "down fog/b NewEpoch", "up fog/b 2", "down fog/b Silent", "up fog/b 2"];
    assert_eq!(names(&sim, 0), expected);
}

#[test]
fn one_that_never_answers_is_forgotten() {
    let mut sim = Sim::new(1, Weather::delay(10), &["edge/a"]);
    let ghost = |name: &str| Endpoint { flow: name.parse().unwrap(), epoch: 4 };
    sim.nodes[0].engine.peer_discovered(sim.now, ghost("fog/b"));
    sim.nodes[0].engine.peer_discovered(sim.now, ghost("fog/c"));
    sim.nodes[0].engine.peer_discovered(sim.now, ghost("edge/a"));
    sim.nodes[0].engine.peer_lost(sim.now, &ghost("fog/c"));
    assert_eq!(sim.nodes[0].engine.peers().len(), 1, "neither itself nor one that went");
    sim.run_ms(59_000);
    assert_eq!(sim.nodes[0].engine.peers().len(), 1);
    assert!(sim.nodes[0].sent_datagrams > 100, "it goes on saying Hello");
    sim.run_ms(1_500);
    assert!(sim.nodes[0].engine.peers().is_empty());
    assert!(names(&sim, 0).is_empty());
}

#[test]
fn a_new_life_forgets_those_who_are_not_heard_again() {
    // Down before, and up before; and one that the transport finds again although it says nothing.
    for (silent_ms, found) in [(3_000, false), (100, false), (100, true)] {
        let mut sim = Sim::new(1, Weather::delay(10), &["edge/a", "fog/b", "cloud/c"]);
        sim.run_ms(1_500);
        sim.nodes[1].alive = false;
        sim.run_ms(silent_ms);
        sim.rebuild(0);
        if found {
            let endpoint = sim.endpoint(1);
            sim.nodes[0].engine.peer_discovered(sim.now, endpoint);
        }
        let forgotten = |sim: &Sim| {
            let names = names(sim, 0).into_iter();
            names.filter(|name| name.starts_with("forgotten")).collect::<Vec<_>>()
        };
        sim.run_ms(50_000);
        assert!(forgotten(&sim).is_empty(), "{silent_ms}, {found}: it may come back");
        sim.run_ms(12_000);
        assert_eq!(forgotten(&sim), ["forgotten fog/b"], "{silent_ms}, {found}");
        assert_eq!(sim.nodes[0].engine.peers().len(), 1);
    }
}

#[test]
fn whoever_leaves_the_inter_scope_waits_for_nobody() {
    let mut sim = Sim::new(1, Weather::delay(10), &["edge/a", "fog/b"]);
    sim.run_ms(1_000);
    sim.nodes[1].alive = false;
    sim.nodes[0].engine.leave(sim.now);
    assert_eq!(sim.nodes[0].engine.next_timeout(), None);
    assert!(sim.nodes[0].engine.peers().is_empty());
}

#[test]
fn registry_messages_pass_and_are_bounded() {
    let mut sim = Sim::new(1, Weather::delay(10), &["edge/a", "fog/b"]);
    sim.run_ms(1_000);
    let to = sim.id(1);
    sim.nodes[0].engine.send_control(&to, request()).unwrap();
    sim.run_ms(50);
    let got =
        sim.nodes[1].events.iter().filter(|(_, event)| matches!(event, LinkEvent::Control { .. }));
    assert_eq!(got.count(), 1);
    let mut refused = None;
    for _ in 0..1_000 {
        refused = sim.nodes[0].engine.send_control(&to, request()).err().or(refused);
    }
    assert_eq!(refused, Some(DropReason::QueueFull));
    let huge = Body::SnapshotRequest(SnapshotRequest { version: 1, parts: vec![u32::MAX; 300] });
    assert_eq!(sim.nodes[0].engine.send_control(&to, huge), Err(DropReason::TooLarge));
}

/// Everything at once: loss, cuts of one or both directions, crashes, rebuilt participants, all
/// kinds of messages.
#[test]
fn whatever_happens_accounts_balance_and_nothing_comes_twice() {
    for seed in seeds() {
        let mut random = Random(seed);
        let weather = bad_weather(&mut random, 0.1);
        let mut sim = Sim::new(seed, weather, &["edge/a", "fog/b", "cloud/c", "edge/d"]);
        sim.run_ms(1_000);
        for node in &mut sim.nodes {
            node.rate = Some(2_000_000.0);
        }
        for _ in 0..250 {
            let (from, to) = (random.below(4), random.below(4));
            let (from, to) = (usize::try_from(from).unwrap(), usize::try_from(to).unwrap());
            if from == to {
                continue;
            }
            let (x, y) = (sim.id(from), sim.id(to));
            match random.below(100) {
                0..3 => sim.network.set_partition(&x, &y, true),
                3 => sim.network.set_cut(&x, &y, true),
                4..12 => sim.network.set_partition(&x, &y, false),
                12 => sim.crash(from),
                13 => sim.rebuild(from),
                14 => {
                    sim.nodes[from].engine.goodbye();
                    sim.run_ms(50);
                    sim.crash(from);
                }
                15..18 => sim.run(random.duration(Duration::from_secs(4))),
                _ => {
                    // One stream per pair, so that one flow's writer is never heard through two.
                    let stream = u32::try_from(from * 1000 + to * 100).unwrap()
                        + u32::try_from(random.below(3)).unwrap();
                    let post = Post {
                        class: blaze_domain::Priority::ALL[stream as usize % 3],
                        stream,
                        bytes: [50, 900, 3_000, 40_000][stream as usize % 4],
                        reliable: stream.is_multiple_of(2),
                        lifespan: random.chance(0.3).then(|| Duration::from_millis(500)),
                        keep_newest: 0,
                    };
                    for _ in 0..=random.below(6) {
                        let _ = sim.publish(from, to, post);
                    }
                    sim.run(random.duration(Duration::from_millis(40)));
                }
            }
            sim.check_accounts();
        }
        for from in 0..4 {
            for to in 0..4 {
                let (x, y) = (sim.id(from), sim.id(to));
                sim.network.set_partition(&x, &y, false);
            }
        }
        sim.network.weather.loss = 0.0;
        for at in 0..4 {
            sim.announce(at);
        }
        sim.run_ms(8_000);
        sim.check_accounts();
        sim.check_deliveries();
        for node in &sim.nodes {
            let up = node.engine.peers().iter().filter(|peer| peer.state == PeerState::Up).count();
            assert_eq!(up, 3, "seed {seed}: all are up again");
            let queued: usize = node.engine.peers().iter().flat_map(|peer| peer.queue_bytes).sum();
            assert_eq!(queued, 0, "seed {seed}: everything is out or dropped");
            assert_eq!(node.engine.reassembly_bytes(), 0, "seed {seed}");
        }
    }
}

#[test]
fn an_uneven_path_keeps_the_clock_within_its_error() {
    let mut sim = Sim::new(1, Weather::delay(10), &["edge/a", "fog/b"]);
    let (a, b) = (sim.id(0), sim.id(1));
    sim.network.set_path(&a, &b, Weather::delay(70));
    sim.network.set_path(
        &b,
        &a,
        Weather { jitter: Duration::from_millis(30), ..Weather::delay(5) },
    );
    sim.run_ms(6_000);
    let info = sim.nodes[0].engine.peer(&b).unwrap();
    let (offset, error) = (info.clock_offset_ns.unwrap(), info.clock_error.unwrap());
    assert!(error < Duration::from_millis(45), "the best of eight exchanges: {error:?}");
    assert!(u128::from(offset.unsigned_abs()) <= error.as_nanos(), "{offset} ns, {error:?}");
    assert!(info.rtt.unwrap() > Duration::from_millis(75));
}
