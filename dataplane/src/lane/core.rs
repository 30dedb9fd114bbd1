//! The data plane of one flow: every message passes here.
//!
//! ```text
//! ingest:   local scope ─► wrap bare, check origin and duplicates ─► each bridge: filter, lifespan, rate ─► broker or lane
//! deliver:  link ─► check origin and duplicates ─► each bridge from inter ─► broker
//! ```
//!
//! Without input or output of its own: brokers are writers that never wait, the link is a [`LaneLink`], time is given.
//! Production holds it behind one lock that is taken once per batch; the simulated network drives the same code.

use std::collections::{HashMap, HashSet};
use std::num::NonZeroUsize;
use std::time::{Duration, Instant};

use blaze_brokers::{Content, Received};
use blaze_domain::{DropReason, FlowId, Origin, Scope, TopicName, WriterId};
use blaze_proto::{Frame, Header};
use bytes::Bytes;
use lru::LruCache;

use super::measure::micros;
use super::path::{BridgeState, Phase, Sink, TopicId, TopicInfo, TopicPath};
use super::stats::Drops;
use super::window::DuplicateWindow;
use super::writer::{NewWriter, Writer};
use crate::link::{Engine, LaneId, Submit};
use crate::plan::{Bridge, Target, TopicPlan};

/// Writers whose duplicate window a flow keeps; the least recently used go first.
pub const MAX_WRITERS: usize = 65_536;
/// Topics that a flow carries at a time.
pub const MAX_TOPICS: usize = 10_000;
/// A topic, or a bridge, that nobody has used for this long is forgotten.
pub const FORGET: Duration = Duration::from_secs(600);
/// How long a bridge whose pair has vanished may empty its queue.
pub const DRAIN: Duration = Duration::from_millis(500);

/// The link, as the data plane sees it.
pub trait LaneLink {
    /// Queues a message.
    ///
    /// # Errors
    /// Why it was not taken; the caller counts it.
    fn submit(&mut self, now: Instant, message: Submit<'_>) -> Result<(), DropReason>;
    /// Messages of a lane that are queued or not yet acknowledged.
    fn queued(&self, lane: LaneId) -> u64;
    /// Drops what is queued of a lane, and gives how many messages that were; the caller counts them.
    fn drop_lane(&mut self, lane: LaneId) -> u64;
}

impl LaneLink for Engine {
    fn submit(&mut self, now: Instant, message: Submit<'_>) -> Result<(), DropReason> {
        Engine::submit(self, now, message)
    }
    fn queued(&self, lane: LaneId) -> u64 {
        self.lane_queued(lane).messages
    }
    fn drop_lane(&mut self, lane: LaneId) -> u64 {
        Engine::drop_lane(self, lane).messages
    }
}

/// What a data plane is told at its start, and what may change while it runs.
#[derive(Debug, Clone)]
pub struct DataConfig {
    /// The flow.
    pub me: FlowId,
    /// Epoch of the flow.
    pub epoch: u64,
    /// Payloads above this many bytes make a topic `bulk`.
    pub large_bytes: u64,
    /// 32 random bits: they make the identities of bare messages new at each start.
    pub salt: u32,
}

/// The data plane of one flow.
pub struct DataCore {
    config: DataConfig,
    topics: Vec<TopicPath>,
    by_name: HashMap<TopicName, TopicId>,
    windows: LruCache<(TopicId, WriterId), DuplicateWindow>,
    lanes: Vec<(TopicId, usize)>,
    /// Places of topics that were forgotten.
    vacant: Vec<TopicId>,
    /// Lanes of topics that were forgotten.
    free_lanes: Vec<LaneId>,
    /// A bridge empties its queue.
    draining: bool,
    /// What could not be attributed to a topic.
    pub unattributed: Drops,
    /// Windows that gave way to newer writers.
    pub evicted_writers: u64,
}

/// Where a message stands when it reaches the bridges.
pub(super) struct Admitted {
    /// As a broker gets it: with the hop that writing it is, and its age.
    pub(super) frame: Frame,
    /// Flows that wrote it so far, this one not among them.
    pub(super) hops: u32,
    pub(super) born_here: bool,
    pub(super) age_us: u64,
    /// Since it came to this flow.
    pub(super) here_us: u64,
}

impl Admitted {
    fn new(frame: Frame, born_here: bool, age_us: u64, here_us: u64) -> Self {
        let hops = frame.hops();
        Self {
            frame: frame.with_hops_and_age(hops.saturating_add(1), age_us),
            hops,
            born_here,
            age_us,
            here_us,
        }
    }
}

impl DataCore {
    /// A data plane without topics.
    #[must_use]
    pub fn new(config: DataConfig) -> Self {
        let capacity = NonZeroUsize::new(MAX_WRITERS).unwrap_or(NonZeroUsize::MIN);
        Self {
            config,
            topics: Vec::new(),
            by_name: HashMap::new(),
            windows: LruCache::new(capacity),
            lanes: Vec::new(),
            vacant: Vec::new(),
            free_lanes: Vec::new(),
            draining: false,
            unattributed: Drops::default(),
            evicted_writers: 0,
        }
    }

    /// All topics, also those that nobody has used for a while.
    pub fn topics(&self) -> impl Iterator<Item = (TopicId, &TopicPath)> {
        let all = self.topics.iter().enumerate().filter(|(_, path)| !path.vacant);
        all.map(|(index, path)| (topic_id(index), path))
    }

    /// All topics, for what reads meters.
    pub fn topics_mut(&mut self) -> impl Iterator<Item = (TopicId, &mut TopicPath)> {
        let all = self.topics.iter_mut().enumerate().filter(|(_, path)| !path.vacant);
        all.map(|(index, path)| (topic_id(index), path))
    }

    /// A topic by name.
    #[must_use]
    pub fn find(&self, name: &str) -> Option<TopicId> {
        self.by_name.get(name).copied()
    }

    /// A topic's path.
    #[must_use]
    pub fn path(&self, topic: TopicId) -> &TopicPath {
        &self.topics[topic.0 as usize]
    }

    /// A topic's path, for what reads counters.
    pub fn path_mut(&mut self, topic: TopicId) -> &mut TopicPath {
        &mut self.topics[topic.0 as usize]
    }

    /// Whether a topic is large, as advertised or as seen.
    #[must_use]
    pub fn is_large(&self, topic: &TopicName, advertised: Option<u64>) -> bool {
        let seen = self.find(topic.as_str()).map_or(0, |id| self.path(id).largest_bytes);
        seen.max(advertised.unwrap_or(0)) > self.config.large_bytes
    }

    /// The writer that a bridge to a local broker has, or had and has not emptied yet.
    #[must_use]
    pub fn writer_of(&self, topic: &TopicName, from: Scope, to: &Target) -> Option<&NewWriter> {
        let path = self.path(self.find(topic.as_str())?);
        let bridge = path.bridges.iter().find(|b| b.from == from && b.target == *to)?;
        match &bridge.sink {
            Sink::Publish { writer, .. } => writer.as_ref().map(Writer::made),
            Sink::Lane { .. } => None,
        }
    }

    /// Whether a bridge still empties its queue.
    #[must_use]
    pub fn is_draining(&self) -> bool {
        let mut bridges = self.topics.iter().flat_map(|topic| &topic.bridges);
        bridges.any(|bridge| matches!(bridge.phase, Phase::Draining { .. }))
    }

    /// Bytes of payload per second that local publishers have for other flows: one copy per lane.
    pub fn link_demand(&mut self, now: Instant) -> f64 {
        let mut demand = 0.0;
        for path in &mut self.topics {
            let is_lane = |b: &&BridgeState| matches!((&b.phase, &b.sink), (Phase::Up { .. }, Sink::Lane { .. }));
            let lanes = path.bridges.iter().filter(is_lane).count();
            if lanes > 0 {
                demand += path.in_rate.rate(now).1 * lanes as f64;
            }
        }
        demand
    }

    /// Puts a mark into the counters of every bridge: what happened since the one before is "lately".
    pub fn mark(&mut self) {
        for bridge in self.topics.iter_mut().flat_map(|topic| &mut topic.bridges) {
            bridge.settle();
            bridge.stats.mark();
        }
    }

    /// Forgets topics that nobody has used for [`FORGET`]; to be called every few seconds. Returns how many.
    pub fn forget_unused(&mut self, now: Instant) -> usize {
        let before = self.vacant.len();
        for (index, path) in self.topics.iter_mut().enumerate().filter(|(_, path)| !path.vacant) {
            if !path.is_idle() {
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
        }
        forgotten.len()
    }

    /// Changes what counts as large, from the next message on.
    pub fn set_large_bytes(&mut self, bytes: u64) {
        self.config.large_bytes = bytes;
    }

    /// The number of a topic, given at first use. `None` when there are [`MAX_TOPICS`] already.
    pub fn intern(&mut self, name: &TopicName, now: Instant) -> Option<TopicId> {
        if let Some(id) = self.by_name.get(name) {
            return Some(*id);
        }
        let path = TopicPath::new(name.clone(), now);
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
        self.by_name.insert(name.clone(), id);
        Some(id)
    }

    /// Makes the bridges of a topic equal to its plan. `writer` gives what writes to a local target, for each bridge one of
    /// its own, or says why it cannot be made: then the bridge has failed. Bridges that are no longer planned drain.
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
            let planned = plan
                .bridges
                .iter()
                .any(|p| p.from == bridge.from && p.to == bridge.target);
            match bridge.phase {
                Phase::Up { .. } if !planned => {
                    bridge.phase = Phase::Draining { until: now + DRAIN };
                    self.draining = true;
                }
                Phase::Failed { .. } if !planned => bridge.end(now),
                _ => {}
            }
        }
        for planned in &plan.bridges {
            let at = self.place_of(now, topic, planned);
            let bridge = &mut self.topics[topic.0 as usize].bridges[at];
            bridge.renew(now, planned);
            if let Sink::Publish { .. } = bridge.sink {
                bridge.set_writer(now, writer(planned));
            }
        }
    }

    /// Where the bridge is in its topic; it is made where there is none yet.
    fn place_of(&mut self, now: Instant, topic: TopicId, planned: &Bridge) -> usize {
        let path = &mut self.topics[topic.0 as usize];
        let same = |b: &BridgeState| b.from == planned.from && b.target == planned.to;
        if let Some(at) = path.bridges.iter().position(same) {
            return at;
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
                Sink::Publish {
                    writer: None,
                    past: Vec::new(),
                    bare: is_bare(target),
                }
            }
        };
        let bridge = BridgeState::new(now, planned, sink);
        match path.bridges.get_mut(at) {
            Some(place) => *place = bridge,
            None => path.bridges.push(bridge),
        }
        at
    }

    /// Takes a batch that a local scope delivered. `wall_ns` is the clock since 1970 at `now`.
    pub fn ingest(
        &mut self,
        now: Instant,
        wall_ns: u64,
        topic: TopicId,
        from: Scope,
        batch: &mut Vec<Received>,
        link: &mut dyn LaneLink,
    ) {
        for received in batch.drain(..) {
            match self.check_local(now, wall_ns, topic, from, received) {
                Ok(admitted) => self.fan_out(now, topic, from, &admitted, link),
                Err(reason) => self.topics[topic.0 as usize].ingress_drops.add(reason, 1),
            }
        }
    }

    /// Counts what a subscription of this topic dropped because the flow was slow.
    pub fn count_overrun(&mut self, topic: TopicId, messages: u64) {
        self.topics[topic.0 as usize]
            .ingress_drops
            .add(DropReason::QueueFull, messages);
    }

    /// Takes a message that came over the link; its age is right at `now`.
    pub fn deliver(&mut self, now: Instant, frame: Frame, link: &mut dyn LaneLink) {
        let Some(topic) = self.find(frame.topic()) else {
            self.unattributed.add(DropReason::NoDestination, 1);
            return;
        };
        let own_layer = frame.origin_layer() == self.config.me.layer.as_str();
        let refused = if own_layer && frame.origin_node() == self.config.me.node.as_str() {
            Some(DropReason::Echo)
        } else if !self.topics[topic.0 as usize].delivers() {
            Some(DropReason::NoDestination)
        } else if !self.is_new(topic, &frame) {
            Some(DropReason::Duplicate)
        } else {
            None
        };
        if let Some(reason) = refused {
            self.topics[topic.0 as usize].ingress_drops.add(reason, 1);
            return;
        }
        let age_us = frame.age_us();
        let message = Admitted::new(frame, false, age_us, 0);
        self.fan_out(now, topic, Scope::Inter, &message, link);
    }

    /// The link has sent the last byte of a message for the first time.
    pub fn lane_sent(&mut self, now: Instant, lane: LaneId, bytes: u64, wait: Duration) {
        if let Some(bridge) = self.lane_bridge(lane) {
            bridge.out_rate.add(now, bytes);
            bridge.stats.latency.record(micros(wait));
        }
    }

    /// Messages of a lane have left for good.
    pub fn lane_out(&mut self, lane: LaneId, messages: u64, bytes: u64) {
        if let Some(bridge) = self.lane_bridge(lane) {
            bridge.stats.out.add_many(messages, bytes);
        }
    }

    /// What the link dropped of a lane.
    pub fn lane_dropped(&mut self, lane: LaneId, reason: DropReason, messages: u64) {
        if let Some(bridge) = self.lane_bridge(lane) {
            bridge.stats.dropped.add(reason, messages);
        }
    }

    /// Counts what the link dropped on the receiving side.
    pub fn receiver_dropped(&mut self, topic: &str, reason: DropReason, messages: u64) {
        match self.find(topic) {
            Some(topic) => self.topics[topic.0 as usize].ingress_drops.add(reason, messages),
            None => self.unattributed.add(reason, messages),
        }
    }

    /// Ends bridges that have drained. Returns when it wants to be called again.
    pub fn drain(&mut self, now: Instant, link: &mut dyn LaneLink) -> Option<Instant> {
        if !self.draining {
            return None;
        }
        let mut next = None;
        for bridge in self.topics.iter_mut().flat_map(|topic| &mut topic.bridges) {
            let Phase::Draining { until } = bridge.phase else {
                continue;
            };
            let lane = bridge.lane_id();
            let queued = match lane {
                Some(lane) => link.queued(lane),
                None => bridge.settle(),
            };
            // What a bridge from the inter scope has to empty is on its way to it: it stays until the end.
            let empty = bridge.from != Scope::Inter && queued == 0;
            if empty || now >= until {
                if let Some(lane) = lane {
                    bridge
                        .stats
                        .dropped
                        .add(DropReason::NoDestination, link.drop_lane(lane));
                }
                bridge.end(now);
            } else {
                next = Some(next.map_or(until, |other: Instant| other.min(until)));
            }
        }
        self.draining = next.is_some();
        next
    }

    fn lane_bridge(&mut self, lane: LaneId) -> Option<&mut BridgeState> {
        let (topic, bridge) = *self.lanes.get(lane.0 as usize)?;
        self.topics.get_mut(topic.0 as usize)?.bridges.get_mut(bridge)
    }

    fn check_local(
        &mut self,
        now: Instant,
        wall_ns: u64,
        topic: TopicId,
        from: Scope,
        received: Received,
    ) -> Result<Admitted, DropReason> {
        let at = received.at;
        let waited_us = received.broker_age_us + micros(now.saturating_duration_since(at));
        let (frame, bare) = match received.content {
            Content::Malformed { .. } => return Err(DropReason::DecodeError),
            Content::Frame(frame) => (frame, false),
            Content::Bare { payload, identity } => (
                self.wrap(wall_ns.saturating_sub(waited_us * 1000), topic, from, payload, identity)?,
                true,
            ),
        };
        if frame.topic() != self.path(topic).name.as_str() {
            return Err(DropReason::DecodeError);
        }
        let born_here = frame.hops() == 0;
        if from == Scope::Node && !born_here {
            // Only this flow writes to its node scope, and what it writes carries hops.
            return Err(DropReason::Echo);
        }
        let me = &self.config.me;
        let own_layer = frame.origin_layer() == me.layer.as_str();
        let own_node = frame.origin_node() == me.node.as_str();
        let foreign = match from {
            Scope::Node => !(own_layer && own_node),
            Scope::Layer | Scope::Inter => born_here && !own_layer,
        };
        // Before the window takes the number: a foreign message must not silence the writer whose name it bears.
        if foreign {
            return Err(DropReason::ForeignOrigin);
        }
        if !self.is_new(topic, &frame) {
            // What a flow has written carries hops; a publisher that repeats itself does not.
            return Err(if born_here {
                DropReason::Duplicate
            } else {
                DropReason::Echo
            });
        }
        let mut age_us = frame.age_us().saturating_add(waited_us);
        if from == Scope::Node && !bare {
            // One host, one clock: the publisher's time tells what nobody could measure.
            age_us = age_us.max(wall_ns.saturating_sub(frame.publish_time_ns()) / 1000);
        }
        let path = &mut self.topics[topic.0 as usize];
        let bytes = frame.payload().len() as u64;
        path.largest_bytes = path.largest_bytes.max(bytes);
        path.in_rate.add(now, bytes);
        let here_us = micros(now.saturating_duration_since(at));
        Ok(Admitted::new(frame, born_here, age_us, here_us))
    }

    /// Gives a bare payload its header.
    fn wrap(
        &mut self,
        publish_time_ns: u64,
        topic: TopicId,
        from: Scope,
        payload: Bytes,
        identity: Option<(WriterId, u64)>,
    ) -> Result<Frame, DropReason> {
        let config = &self.config;
        let path = &mut self.topics[topic.0 as usize];
        let (writer, sequence) = identity.unwrap_or_else(|| {
            let (writer, sequence) = path
                .bare
                .entry(from)
                .or_insert_with(|| (bare_writer(config, from, path.name.as_str()), 0));
            *sequence += 1;
            (*writer, *sequence)
        });
        let info = path.info.bare(from);
        let node = if from == Scope::Node {
            config.me.node.to_string()
        } else {
            String::new()
        };
        let origin = Origin {
            layer: config.me.layer.to_string(),
            node,
            service: info.service.clone(),
            instance: info.instance.clone(),
            epoch: config.epoch,
        };
        let header = Header {
            encoding: info.encoding.clone(),
            lifespan_ms: info.lifespan_ms,
            priority: info.priority,
            reliable: info.reliable,
            depth: info.depth,
            ..Header::new(path.name.as_str(), origin, writer, sequence, publish_time_ns)
        };
        Frame::new(&header, payload).map_err(|_| DropReason::TooLarge)
    }

    fn is_new(&mut self, topic: TopicId, frame: &Frame) -> bool {
        let key = (topic, frame.writer());
        if let Some(window) = self.windows.get_mut(&key) {
            return window.insert(frame.sequence());
        }
        if self.windows.len() == self.windows.cap().get() {
            self.evicted_writers += 1;
        }
        let mut window = DuplicateWindow::default();
        window.insert(frame.sequence());
        self.windows.put(key, window);
        true
    }

    fn fan_out(&mut self, now: Instant, topic: TopicId, from: Scope, message: &Admitted, link: &mut dyn LaneLink) {
        let large_bytes = self.config.large_bytes;
        let path = &mut self.topics[topic.0 as usize];
        let large = path.largest_bytes.max(path.info.max_bytes.unwrap_or(0)) > large_bytes;
        for bridge in path.bridges.iter_mut().filter(|bridge| bridge.from == from) {
            if bridge.takes() && bridge.wants(message) {
                bridge.pass(now, topic, message, large, link);
            }
        }
    }
}

fn topic_id(index: usize) -> TopicId {
    TopicId(u32::try_from(index).unwrap_or(u32::MAX))
}

fn is_bare(target: &Target) -> bool {
    matches!(target, Target::Node { bare: true })
}

/// Writer of bare messages that this flow numbers: new at each start of the flow.
fn bare_writer(config: &DataConfig, from: Scope, topic: &str) -> WriterId {
    use sha2::{Digest, Sha256};
    let text = format!(
        "{from}|{}|{}|{topic}|{}|{}",
        config.me.layer, config.me.node, config.epoch, config.salt
    );
    let digest = Sha256::digest(text.as_bytes());
    let mut id = [0; 16];
    id.copy_from_slice(&digest[..16]);
    WriterId(id)
}

#[cfg(test)]
mod tests;
