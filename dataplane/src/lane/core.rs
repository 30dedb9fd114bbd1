//! The data plane of one flow: every message passes here.
//!
//! ```text
//! ingest:   local scope ─► wrap bare, check origin and duplicates ─► each bridge: filter, lifespan, rate ─► broker or lane
//! deliver:  link ─► check origin and duplicates ─► each bridge from inter ─► broker
//! ```
//!
//! Without input or output of its own: brokers are writers that never wait, the link is a [`LaneLink`], time is given.
//! Production holds it behind one lock that is taken once per batch; the simulated network drives the same code.

use std::collections::HashMap;
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::{Content, Publisher, Received};
use blaze_domain::{DropReason, FlowId, Origin, Scope, TopicName, WriterId};
use blaze_proto::{Frame, Header};
use bytes::Bytes;
use lru::LruCache;

use super::measure::micros;
use super::path::{BridgeState, Phase, Sink, TopicId, TopicInfo, TopicPath};
use super::stats::Drops;
use super::window::DuplicateWindow;
use crate::link::{Engine, LaneId, Submit};
use crate::plan::{Target, TopicPlan};

/// Writers whose duplicate window a flow keeps; the least recently used go first.
pub const MAX_WRITERS: usize = 65_536;
/// Topics that a flow carries.
pub const MAX_TOPICS: usize = 10_000;
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
    /// What could not be attributed to a topic.
    pub unattributed: Drops,
    /// Windows that gave way to newer writers.
    pub evicted_writers: u64,
}

/// Where a message stands when it reaches the bridges.
pub(super) struct Admitted {
    pub(super) frame: Frame,
    pub(super) born_here: bool,
    pub(super) age_us: u64,
    /// Since it came to this flow.
    pub(super) here_us: u64,
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
            unattributed: Drops::default(),
            evicted_writers: 0,
        }
    }

    /// All topics, also those that nobody uses any more.
    #[must_use]
    pub fn topics(&self) -> &[TopicPath] {
        &self.topics
    }

    /// All topics, for what reads meters.
    pub fn topics_mut(&mut self) -> &mut [TopicPath] {
        &mut self.topics
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

    /// Whether a payload of that size makes a topic `bulk`.
    #[must_use]
    pub fn is_large(&self, bytes: Option<u64>) -> bool {
        bytes.is_some_and(|bytes| bytes > self.config.large_bytes)
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
            bridge.stats.mark();
        }
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
        if self.topics.len() >= MAX_TOPICS {
            return None;
        }
        let id = TopicId(u32::try_from(self.topics.len()).ok()?);
        self.topics.push(TopicPath::new(name.clone(), now));
        self.by_name.insert(name.clone(), id);
        Some(id)
    }

    /// Makes the bridges of a topic equal to its plan. `publisher` gives the writer for a local target, if there is one.
    /// Bridges that are no longer planned drain.
    pub fn apply(
        &mut self,
        now: Instant,
        topic: TopicId,
        info: TopicInfo,
        plan: &TopicPlan,
        mut publisher: impl FnMut(&Target) -> Option<Arc<dyn Publisher>>,
    ) {
        let Self {
            topics, lanes, config, ..
        } = self;
        let path = &mut topics[topic.0 as usize];
        path.info = info;
        for bridge in &mut path.bridges {
            let planned = plan
                .bridges
                .iter()
                .any(|p| p.from == bridge.from && p.to == bridge.target);
            if !planned && matches!(bridge.phase, Phase::Up { .. }) {
                bridge.phase = Phase::Draining { until: now + DRAIN };
            }
        }
        for planned in &plan.bridges {
            let class = path.class(&planned.lane, config.large_bytes);
            let existing = path
                .bridges
                .iter_mut()
                .find(|b| b.from == planned.from && b.target == planned.to);
            if let Some(bridge) = existing {
                bridge.renew(now, planned, &mut publisher);
                continue;
            }
            let sink = match &planned.to {
                Target::Inter { .. } => {
                    let lane = LaneId(u32::try_from(lanes.len()).unwrap_or(u32::MAX));
                    lanes.push((topic, path.bridges.len()));
                    Sink::Lane { lane, class }
                }
                target => match publisher(target) {
                    Some(publisher) => Sink::Publish {
                        publisher,
                        bare: is_bare(target),
                    },
                    None => continue,
                },
            };
            path.bridges.push(BridgeState::new(now, planned, sink));
        }
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
        self.fan_out(
            now,
            topic,
            Scope::Inter,
            &Admitted {
                frame,
                born_here: false,
                age_us,
                here_us: 0,
            },
            link,
        );
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
        let mut next = None;
        for bridge in self.topics.iter_mut().flat_map(|topic| &mut topic.bridges) {
            let Phase::Draining { until } = bridge.phase else {
                continue;
            };
            let lane = match bridge.sink {
                Sink::Lane { lane, .. } => Some(lane),
                Sink::Publish { .. } => None,
            };
            // What a bridge from the inter scope has to empty is on its way to it: it stays until the end.
            let empty = bridge.from != Scope::Inter && lane.is_none_or(|lane| link.queued(lane) == 0);
            if empty || now >= until {
                if let Some(lane) = lane {
                    bridge
                        .stats
                        .dropped
                        .add(DropReason::NoDestination, link.drop_lane(lane));
                }
                bridge.phase = Phase::Ended;
            } else {
                next = Some(next.map_or(until, |other: Instant| other.min(until)));
            }
        }
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
        Ok(Admitted {
            frame,
            born_here,
            age_us,
            here_us,
        })
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
        let info = &path.info;
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
