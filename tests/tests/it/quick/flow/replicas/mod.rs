//! Two cloud flows on one simulated Kafka and a robot on a simulated Redis, joined by a simulated
//! network: the code of production, while replicas are stopped, killed and started again.
//!
//! Reliable topics lose nothing when a replica is stopped, and what lies on Kafka is not lost when
//! one is killed; no message reaches a consumer twice under one identity, but for a consumer on
//! Kafka that drops repeats.

mod balance;
mod frozen;
mod gateways;
mod parts;
mod tasks;
mod world;

use std::time::Duration;

use parts::End;
use world::World;

fn seeds() -> Vec<u64> {
    super::seeds(12, 400)
}

/// Both directions run while one replica after the other ends in that way and comes back.
fn run(end: End) -> (u64, u64) {
    let (mut repeats, mut handed_over) = (0, 0);
    for seed in seeds() {
        let mut world = World::new(seed);
        world.run_for(Duration::from_secs(3));
        for _ in 0..4 {
            let victim = world.random_cloud();
            world.end(victim, end);
            world.run_for(Duration::from_secs(4));
            world.restart(victim);
            world.run_for(Duration::from_secs(8));
        }
        world.stop_publishing();
        world.run_for(Duration::from_secs(4));
        let found = world.judge();
        assert!(found.sent_down > 2_000 && found.sent_up > 2_000, "seed {seed}: {found:?}");
        assert_eq!(
            found.lost_down, 0,
            "seed {seed}, {end:?}: what lies on Kafka is not lost: {found:?}"
        );
        assert_eq!(found.twice_down, 0, "seed {seed}, {end:?}: {found:?}");
        if end == End::Stopped {
            assert_eq!((found.lost_up, found.twice_up), (0, 0), "seed {seed}: {found:?}");
            // A replica that is stopped hands over exactly: nothing is even sent twice.
            assert_eq!(found.repeats_down, 0, "seed {seed}: {found:?}");
        }
        assert_eq!((found.carriers, found.holes), (1, 0), "seed {seed}, {end:?}: {found:?}");
        repeats += found.repeats_down;
        handed_over += found.handed_over;
    }
    (repeats, handed_over)
}

#[test]
fn a_replica_that_is_stopped_hands_over_without_loss_or_repeat() {
    let (repeats, handed_over) = run(End::Stopped);
    println!("{handed_over} topics handed over, {repeats} repeats");
    assert!(handed_over > 0, "nothing was ever handed over");
}

#[test]
fn a_replica_that_is_killed_is_replaced_and_what_lies_on_kafka_arrives_once() {
    let (repeats, _) = run(End::Killed);
    println!("{repeats} repeats were dropped on the way");
    assert!(repeats > 0, "no takeover ever began in the past");
}

/// While the two do not hear each other on Kafka both carry the topic; the robot gets each message
/// once all the same.
#[test]
fn replicas_that_do_not_hear_each_other_do_no_harm() {
    for seed in seeds() {
        let mut world = World::new(seed);
        world.run_for(Duration::from_secs(3));
        world.split(true);
        world.run_for(Duration::from_secs(6));
        assert_eq!(world.judge().carriers, 2, "seed {seed}: each thinks that it is alone");
        world.split(false);
        world.run_for(Duration::from_secs(6));
        world.stop_publishing();
        world.run_for(Duration::from_secs(4));
        let found = world.judge();
        assert_eq!(
            (found.lost_down, found.twice_down, found.carriers),
            (0, 0, 1),
            "seed {seed}: {found:?}"
        );
        assert_eq!((found.lost_up, found.twice_up), (0, 0), "seed {seed}: {found:?}");
        assert!(found.repeats_down > 0, "seed {seed}: {found:?}");
    }
}
