//! Topics of unequal weight move between replicas by measured load, and no message is lost,
//! repeated or overtaken by that.

use std::collections::BTreeMap;
use std::time::Duration;

use blaze_brokers::Content;
use blaze_domain::{Origin, Scope, TopicName, WriterId};
use blaze_flow::plan::TopicPlan;
use blaze_flow::world::{Carrying, Hold};
use blaze_proto::{Frame, Header};
use bytes::Bytes;

use super::parts::{End, Life, Record, channel};
use super::world::World;

const SECOND: Duration = Duration::from_secs(1);
/// Bytes of a message and messages per second: from 40 to 320 KiB/s, 1.15 MB/s in all.
const STREAMS: [(usize, u32); 8] = [
    (16_384, 20),
    (12_288, 20),
    (8_192, 20),
    (8_192, 20),
    (4_096, 30),
    (4_096, 20),
    (2_048, 30),
    (2_048, 20),
];

fn seeds() -> Vec<u64> {
    crate::quick::flow::seeds(2, 40)
}

/// What became of the messages of all streams.
#[derive(Debug, Default, PartialEq)]
struct Became {
    lost: u64,
    twice: usize,
    /// Came after one that was published later.
    late: usize,
    /// Repeats that the robot's flow dropped.
    repeats: u64,
}

impl World {
    /// One replica carries everything; the others have only just come. Also the repeats that came
    /// of that.
    fn skewed(seed: u64, replicas: usize) -> (Self, u64) {
        let mut world = Self::loaded(seed, replicas, &STREAMS);
        for index in 2..=replicas {
            world.end(index, End::Killed);
        }
        world.run_for(8 * SECOND);
        assert_eq!(world.carried(), [(1, STREAMS.len())].into(), "seed {seed}");
        for index in 2..=replicas {
            world.restart(index);
        }
        let repeats = world.became().repeats;
        (world, repeats)
    }

    /// What services of the cloud publish, besides.
    pub(crate) fn publish_streams(&mut self) {
        let wall = self.wall();
        for (number, stream) in self.streams.iter_mut().enumerate() {
            while stream.next <= self.now {
                stream.next += stream.period;
                stream.sent += 1;
                let origin =
                    Origin { layer: "cloud".into(), service: "s".into(), ..Origin::default() };
                let writer = WriterId([100 + number as u8; 16]);
                let header = Header {
                    reliable: true,
                    ..Header::new(stream.topic.as_str(), origin, writer, stream.sent, wall)
                };
                let payload = Bytes::from(vec![0; stream.bytes]);
                let record = Record {
                    content: Content::Frame(Frame::new(&header, payload).unwrap()),
                    at: self.now,
                    by: usize::MAX,
                };
                let mut log = self.kafka.log.lock();
                log.entry(stream.topic.to_string()).or_default().push(record);
            }
        }
    }

    /// How many streams each replica carries.
    fn carried(&self) -> BTreeMap<usize, usize> {
        let mut carried = BTreeMap::new();
        for stream in &self.streams {
            for index in self.carriers_of(&stream.topic) {
                *carried.entry(index).or_default() += 1;
            }
        }
        carried
    }

    fn carriers_of(&self, topic: &TopicName) -> Vec<usize> {
        let lives = |index: &usize| matches!(self.flows[*index].life, Life::Alive);
        let carries = |index: &usize| {
            let plan = self.flows[*index].control.plans().get(topic);
            plan.is_some_and(TopicPlan::carries_out)
        };
        (1..self.flows.len()).filter(lives).filter(carries).collect()
    }

    /// Bytes per second of the replicas, as published.
    fn loads(&self) -> Vec<u64> {
        let mut loads = vec![0; self.flows.len() - 1];
        for (stream, (bytes, hz)) in self.streams.iter().zip(STREAMS) {
            for index in self.carriers_of(&stream.topic) {
                loads[index - 1] += bytes as u64 * u64::from(hz);
            }
        }
        loads
    }

    /// Topics that all replicas gave away by load.
    fn moves(&self) -> u64 {
        self.flows.iter().map(|flow| flow.control.moves().by_load).sum()
    }

    fn became(&self) -> Became {
        let mut became = Became::default();
        let log = self.redis.log.lock();
        let core = &self.flows[0].plane.core;
        for stream in &self.streams {
            let records = log.get(&channel(0, Scope::Node, stream.topic.as_str()));
            let sequences: Vec<u64> = records
                .into_iter()
                .flatten()
                .filter_map(|record| match &record.content {
                    Content::Frame(frame) => Some(frame.sequence()),
                    _ => None,
                })
                .collect();
            let mut sorted = sequences.clone();
            sorted.sort_unstable();
            sorted.dedup();
            became.lost += stream.sent - sorted.len() as u64;
            became.twice += sequences.len() - sorted.len();
            became.late += sequences.windows(2).filter(|pair| pair[1] < pair[0]).count();
            let id = core.find(stream.topic.as_str());
            became.repeats += id.map_or(0, |id| core.path(id).ingress_drops.total());
        }
        became
    }

    /// The replica that another one is giving a topic to.
    fn given_to(&self, giver: usize) -> usize {
        let parts = self.flows[giver].control.world().own().unwrap().parts.values();
        let mut named = parts.filter_map(|part| match (&part.hold, &part.carrying) {
            (Hold::GivesTo(to), _) => Some(to),
            (_, Carrying::HandedOver(handover)) => handover.to.as_ref(),
            _ => None,
        });
        let to = named.next().unwrap();
        self.flows.iter().position(|flow| flow.id == *to).unwrap()
    }

    /// Runs until it is so; fails if it takes longer.
    fn run_until(&mut self, most: Duration, what: &str, is_so: impl Fn(&Self) -> bool) -> Duration {
        let begin = self.now;
        while !is_so(self) {
            assert!(self.now - begin < most, "{what}: {:?} {:?}", self.carried(), self.loads());
            self.run_for(Duration::from_millis(5));
        }
        self.now - begin
    }

    fn finish(&mut self) -> Became {
        self.stop_publishing();
        self.run_for(4 * SECOND);
        self.became()
    }
}

fn is_even(loads: &[u64]) -> bool {
    let (most, least) = (loads.iter().max().unwrap(), loads.iter().min().unwrap());
    let mean = loads.iter().sum::<u64>() as f64 / loads.len() as f64;
    *most as f64 <= 1.25 * mean || most - least <= 64 * 1024
}

#[test]
fn skewed_loads_become_even_and_stay_so() {
    for seed in seeds() {
        for replicas in [2, 3] {
            let (mut world, repeats) = World::skewed(seed, replicas);
            let nothing = Became { repeats, ..Became::default() };
            let took = world.run_until(120 * SECOND, "it never gets even", |world| {
                world.carried().values().sum::<usize>() == STREAMS.len() && is_even(&world.loads())
            });
            let (moves, loads) = (world.moves(), world.loads());
            println!("seed {seed}, {replicas} replicas: {moves} moves in {took:?}: {loads:?}");
            assert!(moves >= 2 && moves as usize <= STREAMS.len(), "seed {seed}: {moves} moves");
            world.run_for(90 * SECOND);
            assert_eq!((world.moves(), world.loads()), (moves, loads), "seed {seed}: it stays");
            assert_eq!(world.finish(), nothing, "seed {seed}, {replicas} replicas");
        }
    }
}

/// One end of a move dies when nothing more is read, or when the other end has been told where to
/// begin.
fn dies_in_the_middle(of_giver: bool, told: bool) {
    let mut repeats = 0;
    for seed in seeds() {
        let (mut world, before) = World::skewed(seed, 3);
        // So that there is always something on its way.
        world.one_way = Duration::from_millis(30);
        let moved = world.moves();
        world.run_until(60 * SECOND, "nothing is ever moved", |world| {
            let giver = &world.flows[1].control;
            if told { giver.moves().by_load > moved } else { !giver.emptying().is_empty() }
        });
        let victim = if of_giver { 1 } else { world.given_to(1) };
        world.end_now(victim, End::Killed);
        let alive: Vec<usize> = (1..=3).filter(|index| *index != victim).collect();
        world.run_for(6 * SECOND);
        let carried = world.carried();
        assert_eq!(carried.values().sum::<usize>(), STREAMS.len(), "seed {seed}: {carried:?}");
        assert!(carried.keys().all(|index| alive.contains(index)), "seed {seed}: {carried:?}");
        let became = world.finish();
        repeats += became.repeats - before;
        let nothing_lost = Became { repeats: became.repeats, ..Became::default() };
        assert_eq!(became, nothing_lost, "seed {seed}, giver {of_giver}, told {told}");
        if !of_giver {
            assert_eq!(became.repeats, before, "seed {seed}: the one that got it had sent nothing");
        }
    }
    println!("giver {of_giver}, told {told}: {repeats} repeats were dropped on the way");
}

#[test]
fn a_target_that_dies_before_it_is_told_gets_nothing() {
    dies_in_the_middle(false, false);
}

#[test]
fn a_target_that_dies_before_it_begins_is_replaced_at_the_same_place() {
    dies_in_the_middle(false, true);
}

#[test]
fn a_giver_that_dies_before_it_has_told_is_replaced() {
    dies_in_the_middle(true, false);
}

#[test]
fn a_giver_that_dies_after_it_has_told_does_no_harm() {
    dies_in_the_middle(true, true);
}

/// What is on its way takes longer than a move may take: nothing moves, and nothing is lost.
#[test]
fn over_a_slow_link_nothing_moves() {
    let mut world = World::loaded(1, 2, &STREAMS);
    world.end(2, End::Killed);
    world.run_for(8 * SECOND);
    world.one_way = Duration::from_millis(300);
    world.restart(2);
    world.run_for(60 * SECOND);
    assert_eq!((world.moves(), world.carried()), (0, [(1, STREAMS.len())].into()));
    let became = world.finish();
    assert_eq!((became.lost, became.twice), (0, 0), "{became:?}");
}

/// What is on its way when a topic is to go is acknowledged too late: the topic stays, and goes on
/// where it stopped.
#[test]
fn a_move_that_takes_too_long_is_taken_back() {
    for seed in seeds() {
        let (mut world, before) = World::skewed(seed, 2);
        world.one_way = Duration::from_millis(30);
        let mut taken_back = 0;
        while world.moves() < 2 {
            world.run_until(60 * SECOND, "nothing is ever moved", |world| {
                !world.flows[1].control.emptying().is_empty()
            });
            let late = taken_back < 2;
            if late {
                world.one_way = Duration::from_millis(400);
            }
            world.run_for(Duration::from_millis(500));
            world.one_way = Duration::from_millis(30);
            taken_back += u64::from(late);
            assert_eq!(world.flows[1].control.moves().taken_back, taken_back, "seed {seed}");
            world.run_for(SECOND);
            assert_eq!(world.carried().values().sum::<usize>(), STREAMS.len(), "seed {seed}");
        }
        let nothing = Became { repeats: before, ..Became::default() };
        assert_eq!(world.finish(), nothing, "seed {seed}");
    }
}

/// Replicas are stopped and killed while topics move.
#[test]
fn moves_and_ends_of_replicas_go_together() {
    let (mut moved, mut worlds) = (0, 0);
    for seed in seeds() {
        let (mut world, _) = World::skewed(seed, 3);
        for round in 0..6 {
            world.run_for(12 * SECOND);
            let victim = 1 + (seed as usize + round) % 3;
            let end = if round % 2 == 0 { End::Stopped } else { End::Killed };
            world.end(victim, end);
            world.run_for(4 * SECOND);
            world.restart(victim);
        }
        world.run_for(8 * SECOND);
        let carried = world.carried();
        assert_eq!(carried.values().sum::<usize>(), STREAMS.len(), "seed {seed}: {carried:?}");
        // Where each flow ends again before it has settled, nothing may move.
        moved += usize::from(world.moves() > 0);
        worlds += 1;
        let became = world.finish();
        assert_eq!((became.lost, became.twice), (0, 0), "seed {seed}: {became:?}");
    }
    assert!(moved * 2 > worlds, "topics moved in {moved} of {worlds} worlds");
}
