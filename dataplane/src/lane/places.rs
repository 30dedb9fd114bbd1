//! Topics and bridges come, go and are forgotten: which has which place in the message path.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::time::Instant;

use blaze_domain::{TopicName, WriterId};

use super::bridge::Passed;
use super::compress_stage::{Arrival, ToBrokers, ToLanes};
use super::core::{DRAIN, DataCore, FORGET, LaneLink, MAX_TOPICS};
use super::path::{BridgeState, Phase, Sink, TopicId, TopicInfo, TopicPath};
use super::succession::{Held, LONGEST_WAIT};
use super::writer::NewWriter;
use crate::link::LaneId;
use crate::plan::{Bridge, Target, TopicPlan};
use crate::world::OriginFilter;

impl DataCore {
    /// Forgets topics that nobody has used for [`FORGET`]; to be called every few seconds. Returns
    /// how many.
    pub fn forget_unused(&mut self, now: Instant) -> usize {
        let before = self.vacant.len();
        for (index, path) in self.topics.iter_mut().enumerate().filter(|(_, path)| !path.vacant) {
            // What is with the codec comes back to its topic.
            if !path.is_idle() || self.compress.holds(topic_id(index)) {
                path.idle = None;
                continue;
            }
            let since = *path.idle.get_or_insert(now);
            if now.saturating_duration_since(since) < FORGET {
                continue;
            }
            self.by_name.remove(&path.name);
            self.free_lanes.extend(path.bridges.iter().filter_map(BridgeState::lane_id));
            path.bridges = Vec::new();
            path.bare.clear();
            path.vacant = true;
            self.vacant.push(topic_id(index));
        }
        let forgotten: HashSet<TopicId> = self.vacant[before..].iter().copied().collect();
        if !forgotten.is_empty() {
            let windows = self.windows.iter().map(|(key, _)| *key);
            let gone: Vec<_> = windows.filter(|(topic, _)| forgotten.contains(topic)).collect();
            for key in gone {
                self.windows.pop(&key);
            }
            self.kept.forget_topics(|topic| forgotten.contains(&topic));
        }
        forgotten.len()
    }

    /// The number of a topic, given at first use. `None` when there are [`MAX_TOPICS`] already.
    pub fn intern(&mut self, name: &TopicName, now: Instant) -> Option<TopicId> {
        if let Some(id) = self.by_name.get(name) {
            return Some(*id);
        }
        let mut path = TopicPath::new(name.clone(), self.placed + 1, now);
        path.compression = self.compress.find(name);
        let id = match self.vacant.pop() {
            Some(id) => {
                self.topics[id.0 as usize] = path;
                id
            }
            None if self.topics.len() >= MAX_TOPICS => return None,
            None => {
                self.topics.push(path);
                topic_id(self.topics.len() - 1)
            }
        };
        self.placed += 1;
        self.by_name.insert(name.clone(), id);
        Some(id)
    }

    /// Makes the bridges of a topic equal to its plan. `writer` gives what writes to a local
    /// target, for each bridge one of its own, or says why it cannot be made: then the bridge has
    /// failed. Bridges that are no longer planned drain.
    pub fn apply(
        &mut self,
        now: Instant,
        topic: TopicId,
        info: TopicInfo,
        plan: &TopicPlan,
        mut writer: impl FnMut(&Bridge) -> Result<NewWriter, String>,
    ) {
        let path = &mut self.topics[topic.0 as usize];
        path.info = info;
        for bridge in &mut path.bridges {
            let planned =
                plan.bridges.iter().any(|p| p.from == bridge.from && p.to == bridge.target);
            match bridge.phase {
                Phase::Up { .. } if !planned => {
                    bridge.phase =
                        Phase::Draining { until: now + DRAIN, latest: now + LONGEST_WAIT };
                    self.draining.insert(topic);
                    if bridge.has_successor(plan) {
                        self.succession.await_written(now, topic, bridge);
                    }
                }
                Phase::Failed { .. } if !planned => bridge.end(now),
                _ => {}
            }
        }
        for planned in &plan.bridges {
            let (at, is_new) = self.place_of(now, topic, planned);
            let bridge = &mut self.topics[topic.0 as usize].bridges[at];
            let begins = bridge.renew(now, planned) || is_new;
            if let Sink::Publish { .. } = bridge.sink {
                bridge.set_writer(now, writer(planned));
            }
            if begins && bridge.lane.durable {
                self.begun.push((topic, at));
            }
            if begins {
                self.hold_back(now, topic, at);
            }
            let bridge = &mut self.topics[topic.0 as usize].bridges[at];
            if begins && bridge.lane.held {
                bridge.held.get_or_insert_default();
            }
            if bridge.held.is_some() {
                self.draining.insert(topic);
            }
        }
        self.pass_on(topic);
        self.stir();
        if plan.bridges.iter().any(|planned| planned.to.receiver().is_some()) {
            self.leaving.insert(topic);
        }
        self.lanes_changed = true;
    }

    /// Gives bridges of a topic that have begun what was kept for them. To be called after
    /// [`DataCore::apply`].
    pub(super) fn deliver_kept(&mut self, now: Instant, topic: TopicId, link: &mut dyn LaneLink) {
        let begun = std::mem::take(&mut self.begun);
        let (mine, others): (Vec<_>, Vec<_>) = begun.into_iter().partition(|(of, _)| *of == topic);
        self.begun = others;
        for (_, at) in mine {
            let path = &mut self.topics[topic.0 as usize];
            let large = path.is_large(self.config.large_bytes);
            let Some(bridge) = path.bridges.get_mut(at) else {
                continue;
            };
            let me = &self.config.me;
            // What of a writer waits for this bridge already, held or with the codec, is on its
            // way; what is kept besides is older, and goes before it.
            let passed_on = bridge.held.as_mut().map(std::mem::take);
            let mut first_waiting: HashMap<WriterId, u64> = HashMap::new();
            let held = passed_on.iter().flat_map(Held::frames);
            for frame in held.chain(self.compress.frames_for(topic, at)) {
                let first = first_waiting.entry(frame.writer()).or_insert(u64::MAX);
                *first = frame.sequence().min(*first);
            }
            let mut passed = Vec::new();
            for message in self.kept.of(now, topic, bridge.from) {
                let first = first_waiting.get(&message.frame.writer());
                if first.is_some_and(|first| *first <= message.frame.sequence()) {
                    continue;
                }
                // The rules may have changed since it came.
                if bridge.takes() && path.info.takes(&message.frame) && bridge.wants(me, &message) {
                    let way = bridge.pass(now, &message, large, &mut path.gates);
                    passed.extend(way.map(|way| (message, way)));
                }
            }
            for (message, way) in passed {
                let frame = &message.frame;
                match way {
                    // From the codec it would come back behind what waits.
                    Passed::ToLane(waiting) if first_waiting.contains_key(&frame.writer()) => {
                        self.put_to_lanes(now, topic, ToLanes::from_iter([(at, waiting)]), link);
                    }
                    Passed::ToLane(waiting) => {
                        let lanes = ToLanes::from_iter([(at, waiting)]);
                        self.compress_out(now, topic, frame, lanes, Arrival::Kept, link);
                    }
                    Passed::ToConvert { to, deadline } => {
                        let bridges = ToBrokers::from_iter([(at, deadline)]);
                        self.convert(now, topic, &message, to, bridges);
                    }
                }
            }
            let path = &mut self.topics[topic.0 as usize];
            if let Some(held) = path.bridges.get_mut(at).and_then(|bridge| bridge.held.as_mut()) {
                held.append(passed_on);
            }
        }
    }

    /// A writer's lease is over: what is kept of it goes, unless one of `but` says that it is still
    /// there. Returns which writers that were.
    pub fn forget_writers(
        &mut self,
        now: Instant,
        topic: TopicId,
        of: &OriginFilter,
        but: &BTreeSet<OriginFilter>,
    ) -> Vec<WriterId> {
        self.kept.forget(now, topic, of, but)
    }

    /// Writers of earlier lives of their services, since the last call: what brokers keep of them
    /// goes, too.
    pub fn take_superseded(&mut self) -> Vec<(TopicName, WriterId)> {
        let superseded = std::mem::take(&mut self.kept.superseded);
        let named =
            superseded.into_iter().map(|(topic, writer)| (self.path(topic).name.clone(), writer));
        named.collect()
    }

    /// Where the bridge is in its topic, and whether it was made now because there was none yet.
    fn place_of(&mut self, now: Instant, topic: TopicId, planned: &Bridge) -> (usize, bool) {
        let path = &mut self.topics[topic.0 as usize];
        let same = |b: &BridgeState| b.from == planned.from && b.target == planned.to;
        if let Some(at) = path.bridges.iter().position(same) {
            return (at, false);
        }
        let class = path.class(&planned.lane, self.config.large_bytes);
        let old = path.bridges.iter().position(|bridge| bridge.is_forgotten(now));
        let at = old.unwrap_or(path.bridges.len());
        let old_lane = old.and_then(|at| path.bridges[at].lane_id());
        let sink = match &planned.to {
            Target::Inter { .. } => {
                let lane = old_lane.or_else(|| self.free_lanes.pop()).unwrap_or_else(|| {
                    self.lanes.push((topic, at));
                    LaneId(u32::try_from(self.lanes.len() - 1).unwrap_or(u32::MAX))
                });
                if let Some(place) = self.lanes.get_mut(lane.0 as usize) {
                    *place = (topic, at);
                }
                Sink::Lane { lane, class }
            }
            target => {
                self.free_lanes.extend(old_lane);
                Sink::Publish { writer: None, past: Vec::new(), bare: target.is_headless() }
            }
        };
        let bridge = BridgeState::new(now, planned, sink);
        match path.bridges.get_mut(at) {
            Some(place) => *place = bridge,
            None => path.bridges.push(bridge),
        }
        (at, true)
    }
}

pub(super) fn topic_id(index: usize) -> TopicId {
    TopicId(u32::try_from(index).unwrap_or(u32::MAX))
}
