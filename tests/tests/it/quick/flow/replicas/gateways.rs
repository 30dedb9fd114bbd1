//! A layer with more flows than are on the inter scope: gateways are chosen, replaced and given up,
//! and services on the nodes of the others reach a robot outside, and it them, all the while.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use blaze_brokers::Content;
use blaze_domain::{Scope, WriterId};
use blaze_flow::control::Stage;

use super::parts::{End, Life, channel};
use super::world::{STATUS, TELEOP, World, node_writer};

/// What services on nodes got of services on other nodes.
#[derive(Debug, Default, PartialEq, Eq)]
struct Heard {
    sent: usize,
    lost: usize,
    twice: usize,
    /// Came behind a later one of its writer.
    late: usize,
}

impl World {
    fn stages(&self) -> BTreeMap<usize, Stage> {
        let living = (1..=self.clouds).filter(|index| self.flows[*index].life == Life::Alive);
        living.map(|index| (index, self.flows[index].control.stage())).collect()
    }

    fn gateways(&self) -> Vec<usize> {
        let stages = self.stages().into_iter();
        stages.filter(|(_, stage)| *stage == Stage::Gateway).map(|(index, _)| index).collect()
    }

    /// Flows of the cloud that the robot hears.
    fn heard_by_robot(&self) -> usize {
        let engine = self.flows[0].plane.engine.as_ref().unwrap();
        engine.peers().iter().filter(|peer| peer.last_heard.is_some()).count()
    }

    /// How often flows wrote a message to a channel, by writer and sequence.
    fn on_channel(&self, index: usize, topic: &str) -> BTreeMap<(WriterId, u64), usize> {
        let mut counts = BTreeMap::new();
        for record in
            self.redis.log.lock().get(&channel(index, Scope::Node, topic)).into_iter().flatten()
        {
            if let Content::Frame(frame) = &record.content
                && frame.hops() > 0
            {
                *counts.entry((frame.writer(), frame.sequence())).or_default() += 1;
            }
        }
        counts
    }

    /// How many messages came to a channel behind a later one of their writers.
    fn late_on_channel(&self, index: usize, topic: &str) -> usize {
        let mut newest: BTreeMap<WriterId, u64> = BTreeMap::new();
        let log = self.redis.log.lock();
        let records = log.get(&channel(index, Scope::Node, topic)).into_iter().flatten();
        let mut late = 0;
        for record in records {
            if let Content::Frame(frame) = &record.content
                && frame.hops() > 0
            {
                let newest = newest.entry(frame.writer()).or_default();
                late += usize::from(frame.sequence() < *newest);
                *newest = frame.sequence().max(*newest);
            }
        }
        late
    }

    /// What became of everything that was published on nodes of the flows that live.
    fn heard(&self) -> Heard {
        let mut heard = Heard::default();
        let mut count = |times: Option<&usize>| {
            heard.sent += 1;
            heard.lost += usize::from(times.is_none());
            heard.twice += usize::from(times.is_some_and(|times| *times > 1));
        };
        let at_robot = self.on_channel(0, STATUS);
        let living: Vec<usize> = self.stages().into_keys().collect();
        let at_nodes: Vec<_> = living.iter().map(|index| self.on_channel(*index, TELEOP)).collect();
        heard.late = self.late_on_channel(0, STATUS);
        for index in &living {
            heard.late += self.late_on_channel(*index, TELEOP);
        }
        for (index, sequence) in &self.said {
            let key = (node_writer(*index), *sequence);
            if *index == 0 {
                at_nodes.iter().for_each(|written| count(written.get(&key)));
            } else if living.contains(index) {
                count(at_robot.get(&key));
            }
        }
        heard
    }

    /// Everybody publishes for a second; each message is to arrive once wherever it is asked for.
    fn round(&mut self, what: &str) {
        self.said.clear();
        for _ in 0..50 {
            self.publish_on_nodes();
            self.run_for(Duration::from_millis(20));
        }
        self.run_for(Duration::from_secs(2));
        let heard = self.heard();
        let flows = self.stages().len();
        assert_eq!(heard, Heard { sent: 2 * 50 * flows, lost: 0, twice: 0, late: 0 }, "{what}");
    }
}

#[test]
fn of_twenty_flows_four_are_gateways_and_all_nodes_reach_the_robot_and_are_reached() {
    for seed in 0..3 {
        let mut world = World::with(seed, 20);
        world.run_for(Duration::from_secs(8));
        let first = world.gateways();
        assert_eq!(
            (first.len(), world.heard_by_robot()),
            (4, 4),
            "seed {seed}: {:?}",
            world.stages()
        );
        world.round("after the start");
        for _ in 0..3 {
            let victim = world.gateways()[0];
            world.end(victim, End::Killed);
            world.run_for(Duration::from_secs(8));
            let now = world.gateways();
            let stayed = first.iter().filter(|index| now.contains(index)).count();
            assert!(now.len() == 4 && !now.contains(&victim), "seed {seed}: {:?}", world.stages());
            assert!(stayed > 0 || first.len() < 4);
            world.round("after a gateway was killed");
            world.restart(victim);
            world.run_for(Duration::from_secs(12));
            assert_eq!(world.gateways(), now, "seed {seed}: who comes back finds enough gateways");
            world.round("after it came back");
        }
    }
}

#[test]
fn a_gateway_that_is_stopped_hands_over_what_it_carries_without_loss_or_repeat() {
    for seed in 0..3 {
        let mut world = World::with(seed, 18);
        world.run_for(Duration::from_secs(8));
        world.publishing = true;
        world.next_publish = world.now;
        world.run_for(Duration::from_secs(2));
        for _ in 0..3 {
            let victim = world.gateways()[0];
            world.end(victim, End::Stopped);
            world.run_for(Duration::from_secs(5));
            world.restart(victim);
            world.run_for(Duration::from_secs(10));
        }
        world.stop_publishing();
        world.run_for(Duration::from_secs(3));
        let found = world.judge();
        assert_eq!(
            (found.lost_down, found.twice_down, found.lost_up, found.twice_up),
            (0, 0, 0, 0),
            "seed {seed}: {found:?}"
        );
        assert_eq!((found.carriers, found.holes), (1, 0), "seed {seed}: {found:?}");
    }
}

/// While services on all nodes publish, most flows leave the inter scope, as the layer has become
/// large, and come back when it is small again for a minute.
#[test]
fn who_becomes_a_member_or_a_gateway_misses_nothing_meanwhile() {
    for seed in 0..2 {
        let mut world = World::with(seed, 16);
        world.run_for(Duration::from_secs(8));
        assert_eq!(world.gateways().len(), 16, "seed {seed}: {:?}", world.stages());
        world.of_nodes = true;
        world.next_publish = world.now;
        world.run_for(Duration::from_secs(1));
        for _ in 0..2 {
            world.add();
        }
        // Those who have just come hear the robot only when they are ready: what was said before is
        // not for them.
        world.of_nodes = false;
        world.run_for(Duration::from_secs(5));
        world.said.clear();
        world.of_nodes = true;
        world.next_publish = world.now;
        world.run_for(Duration::from_secs(15));
        world.of_nodes = false;
        world.run_for(Duration::from_secs(2));
        assert_eq!(
            (world.gateways().len(), world.heard_by_robot()),
            (4, 4),
            "seed {seed}: {:?}",
            world.stages()
        );
        let heard = world.heard();
        assert_eq!(
            (heard.lost, heard.twice, heard.late),
            (0, 0, 0),
            "seed {seed}, leaving: {heard:?}"
        );
        let members: BTreeSet<usize> =
            world.stages().into_keys().filter(|index| !world.gateways().contains(index)).collect();
        for index in members.into_iter().take(3) {
            world.end(index, End::Stopped);
            world.run_for(Duration::from_secs(1));
        }
        world.said.clear();
        world.of_nodes = true;
        world.next_publish = world.now;
        world.run_for(Duration::from_secs(70));
        world.of_nodes = false;
        world.run_for(Duration::from_secs(2));
        assert_eq!(world.gateways().len(), 15, "seed {seed}: {:?}", world.stages());
        let heard = world.heard();
        assert_eq!(
            (heard.lost, heard.twice, heard.late),
            (0, 0, 0),
            "seed {seed}, joining: {heard:?}"
        );
        assert!(heard.sent > 50_000, "{heard:?}");
    }
}

/// What flows tell one another on the channel of the layer broker, once all are known.
#[test]
fn control_traffic_grows_with_the_flows_alone() {
    for clouds in if blaze_tests::long() { vec![20, 100] } else { vec![20] } {
        let mut world = World::with(1, clouds);
        let said = |world: &World| -> (usize, usize) {
            let log = world.kafka.log.lock();
            let all = log.get("peers").map_or(&[][..], Vec::as_slice);
            let bytes = all.iter().map(|record| match &record.content {
                Content::Bare { payload, .. } => payload.len(),
                _ => 0,
            });
            (all.len(), bytes.sum())
        };
        world.run_for(Duration::from_secs(15));
        let start = said(&world);
        world.run_for(Duration::from_secs(10));
        let end = said(&world);
        let (messages, bytes) = ((end.0 - start.0) / 10, (end.1 - start.1) / 10);
        println!(
            "{clouds} flows: {} messages and {} bytes on the channel until all are known, then \
             {messages} messages and {bytes} \
             bytes a second; {} flows on the inter scope",
            start.0,
            start.1,
            world.gateways().len()
        );
        assert_eq!(world.gateways().len(), 4);
        assert!(messages <= 2 * clouds + 2, "Hellos alone: {messages}");
        assert!(bytes <= 150 * 2 * clouds, "{bytes} bytes");
    }
}
