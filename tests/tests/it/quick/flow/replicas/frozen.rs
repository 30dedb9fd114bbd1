//! Kafka, or the client that reads it, stands still while topics move from one replica to another.

use std::time::Duration;

use rand::RngExt;

use super::parts::End;
use super::seeds;
use super::world::World;

const SECOND: Duration = Duration::from_secs(1);

/// A replica that comes back gets its topics again after a few seconds. What the other one had for
/// Kafka by then is written before anything that comes after it, however long that takes.
#[test]
fn what_waits_for_kafka_is_not_overtaken_by_what_goes_to_another_replica() {
    let mut moved = 0;
    for seed in seeds() {
        let mut world = World::new(seed);
        world.run_for(3 * SECOND);
        for _ in 0..3 {
            let victim = world.random_cloud();
            world.end(victim, End::Stopped);
            world.run_for(2 * SECOND);
            world.restart(victim);
            let pause = Duration::from_millis(world.random.random_range(3_000..8_000));
            let frozen = Duration::from_millis(world.random.random_range(100..3_500));
            world.run_for(pause);
            let before = world.receiver_up();
            world.freeze_kafka(frozen);
            moved += usize::from(world.receiver_up() != before);
            world.run_for(4 * SECOND);
        }
        world.stop_publishing();
        world.run_for(4 * SECOND);
        let found = world.judge();
        assert_eq!(
            (found.lost_up, found.twice_up, found.late_up),
            (0, 0, 0),
            "seed {seed}: {found:?}"
        );
        assert_eq!((found.lost_down, found.twice_down), (0, 0), "seed {seed}: {found:?}");
    }
    println!("{moved} times the receiver became another one while Kafka stood still");
    assert!(moved > 0, "no topic ever moved in such a pause");
}

/// A carrier's reader stands still although what the flow says gets through, and then the flow
/// falls silent, too. Who takes over begins where that one had stopped reading, not where it was
/// last heard.
#[test]
fn what_a_carrier_had_not_read_before_it_fell_silent_is_taken_over() {
    for seed in seeds() {
        let mut world = World::new(seed);
        world.run_for(3 * SECOND);
        let carrier = world.carrier_down().unwrap();
        world.flows[carrier].deaf = true;
        let alone = Duration::from_millis(world.random.random_range(500..6_000));
        world.run_for(alone);
        world.flows[carrier].mute = true;
        world.run_for(4 * SECOND);
        assert_ne!(world.carrier_down(), None, "seed {seed}");
        (world.flows[carrier].deaf, world.flows[carrier].mute) = (false, false);
        world.run_for(4 * SECOND);
        world.stop_publishing();
        world.run_for(4 * SECOND);
        let found = world.judge();
        assert_eq!(
            (found.lost_down, found.twice_down, found.carriers),
            (0, 0, 1),
            "seed {seed}, {alone:?}: {found:?}"
        );
    }
}

/// Who hears nothing, not even itself, does not take the others for dead.
#[test]
fn a_replica_that_hears_nothing_takes_nothing_over() {
    for seed in seeds() {
        let mut world = World::new(seed);
        world.run_for(8 * SECOND);
        let carrier = world.carrier_down().unwrap();
        let other = (1..=2).find(|index| *index != carrier).unwrap();
        world.flows[other].deaf = true;
        world.run_for(8 * SECOND);
        assert_eq!(world.judge().carriers, 1, "seed {seed}");
        world.flows[other].deaf = false;
        world.run_for(4 * SECOND);
        world.stop_publishing();
        world.run_for(4 * SECOND);
        let found = world.judge();
        assert_eq!((found.lost_down, found.twice_down), (0, 0), "seed {seed}: {found:?}");
    }
}
