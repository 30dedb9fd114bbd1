//! The data plane of one flow: every message passes here.
//!
//! ```text
//! ingest:   local scope ─► wrap bare, check origin and duplicates ─► each bridge: filter, lifespan, rate ─► broker or lane
//! deliver:  link ─► check origin and duplicates ─► each bridge from inter ─► broker
//! ```
//!
//! Without input or output of its own: brokers are writers that never wait, the link is a
//! [`LaneLink`], time is given. Production holds it behind one lock that is taken once per batch;
//! the simulated network drives the same code.

use std::collections::{BTreeSet, HashMap};
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::Received;
use blaze_domain::{DropReason, FlowId, Priority, Scope, TopicName, WriterId};
use blaze_proto::Frame;
use blaze_proto::link::link_control::Body;
use lru::LruCache;

use super::admit::{Admitted, Refusal};
use super::allocation::Reckoned;
use super::bridge::Passed;
use super::calls::Calls;
use super::compress_stage::{Arrival, CompressStage, ToBrokers, ToLanes};
use super::early::Early;
use super::kept::KeptMessages;
use super::measure::micros;
use super::path::{BridgeState, Phase, Sink, TopicId, TopicInfo, TopicPath};
use super::places::topic_id;
use super::reading::For;
use super::stats::{Drops, Phases, Totals};
use super::succession::Succession;
use super::window::DuplicateWindow;
use super::writer::{NewWriter, Writer};
use crate::link::{Engine, LaneId, PeerState, Submit};
use crate::plan::Target;
use crate::types::{ConvertFailure, Encoding, MessageType, Types};

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
    /// Drops what is queued of a lane, and gives how many messages that were; the caller counts
    /// them.
    fn drop_lane(&mut self, lane: LaneId) -> u64;
    /// Whether a flow does not acknowledge for the moment, or is not known.
    fn is_suspect(&self, to: &FlowId) -> bool;
    /// Whether a flow lives, as far as is known, and answers when it is asked what it has written.
    fn answers(&self, to: &FlowId) -> bool;
    /// Whether the queue to a flow takes so many bytes more without coming near its bound.
    fn has_room(&self, to: &FlowId, class: Priority, bytes: usize) -> bool;
    /// Whether a flow decompresses what comes over the link; one that is not known does not.
    fn takes_lz4(&self, to: &FlowId) -> bool;
    /// Tells a flow something. `false`: it could not be queued.
    fn tell(&mut self, to: &FlowId, body: Body) -> bool;
}

/// The link of a flow; one without an inter scope has none, and sends nothing.
impl LaneLink for Option<Engine> {
    fn submit(&mut self, now: Instant, message: Submit<'_>) -> Result<(), DropReason> {
        self.as_mut().ok_or(DropReason::LinkDown)?.submit(now, message)
    }
    fn queued(&self, lane: LaneId) -> u64 {
        self.as_ref().map_or(0, |engine| engine.lane_queued(lane).messages)
    }
    fn drop_lane(&mut self, lane: LaneId) -> u64 {
        self.as_mut().map_or(0, |engine| engine.drop_lane(lane).messages)
    }
    fn is_suspect(&self, to: &FlowId) -> bool {
        let peer = self.as_ref().and_then(|engine| engine.peer(to));
        peer.is_none_or(|peer| peer.state != PeerState::Up)
    }
    fn answers(&self, to: &FlowId) -> bool {
        self.as_ref().is_some_and(|engine| engine.answers_written(to))
    }
    fn has_room(&self, to: &FlowId, class: Priority, bytes: usize) -> bool {
        self.as_ref().is_none_or(|engine| engine.has_room(to, class, bytes))
    }
    fn takes_lz4(&self, to: &FlowId) -> bool {
        self.as_ref().is_some_and(|engine| engine.takes_lz4(to))
    }
    fn tell(&mut self, to: &FlowId, body: Body) -> bool {
        self.as_mut().is_some_and(|engine| engine.send_control(to, body).is_ok())
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
    pub(super) config: DataConfig,
    pub(super) topics: Vec<TopicPath>,
    pub(super) by_name: HashMap<TopicName, TopicId>,
    pub(super) windows: LruCache<(TopicId, WriterId), DuplicateWindow>,
    pub(super) lanes: Vec<(TopicId, usize)>,
    /// Places of topics that were forgotten.
    pub(super) vacant: Vec<TopicId>,
    /// Topics that were ever given a place.
    pub(super) placed: u64,
    /// Lanes of topics that were forgotten.
    pub(super) free_lanes: Vec<LaneId>,
    /// Topics with bridges that empty their queues, or hold messages.
    pub(super) draining: BTreeSet<TopicId>,
    /// Something has happened to one of these since they were looked at.
    pub(super) stirred: bool,
    /// When they are to be looked at, whatever happens.
    look_at: Option<Instant>,
    /// Came over the link before their bridge stood.
    pub(super) early: Early,
    /// What waits for the last receivers of their topics, and questions of others.
    pub(super) succession: Succession,
    /// Of transient_local writers, for bridges that begin later.
    pub(super) kept: KeptMessages,
    /// Compression, decompression and conversion.
    pub(super) compress: CompressStage,
    /// Calls of ROS 2 services.
    pub(super) calls: Calls,
    /// Types of ROS 2 for conversions.
    pub(super) types: Arc<Types>,
    /// Messages that could not be converted, for events.
    pub(super) convert_failures: Vec<(TopicName, ConvertFailure)>,
    /// Durable bridges that have just begun: topic and place.
    pub(super) begun: Vec<(TopicId, usize)>,
    /// What could not be attributed to a topic.
    pub unattributed: Drops,
    totals: Totals,
    /// Topics with lanes, and some that had one.
    pub(super) leaving: BTreeSet<TopicId>,
    /// What lanes have sent.
    pub(super) reckoned: Reckoned,
    /// The rates of lanes have to be worked out anew: a size has grown …
    pub(super) allocation_due: bool,
    /// … or anything else has changed.
    pub(super) lanes_changed: bool,
    /// Windows that gave way to newer writers.
    pub evicted_writers: u64,
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
            placed: 0,
            free_lanes: Vec::new(),
            draining: BTreeSet::new(),
            stirred: false,
            look_at: None,
            early: Early::default(),
            succession: Succession::default(),
            kept: KeptMessages::default(),
            compress: CompressStage::default(),
            calls: Calls::default(),
            types: Arc::default(),
            convert_failures: Vec::new(),
            begun: Vec::new(),
            unattributed: Drops::default(),
            totals: Totals::default(),
            leaving: BTreeSet::new(),
            reckoned: Reckoned::default(),
            allocation_due: false,
            lanes_changed: false,
            evicted_writers: 0,
        }
    }

    /// Takes the types of the flow. Without this it has those that are built in.
    pub fn set_types(&mut self, types: Arc<Types>) {
        self.types = types;
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

    /// Whether brokers are to make room for large messages of a topic: as advertised, as seen, or
    /// as its type lets expect.
    #[must_use]
    pub fn is_large(&self, topic: &TopicName, info: &TopicInfo) -> bool {
        let seen = self.find(topic.as_str()).map_or(0, |id| self.path(id).largest_bytes);
        let published = info.types.published.as_ref();
        seen.max(info.max_bytes.unwrap_or(0)) > self.config.large_bytes
            || published.is_some_and(MessageType::is_large)
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

    /// Puts a mark into the counters of every bridge: what happened since the one before is
    /// "lately".
    pub fn mark(&mut self) {
        let totals = &mut self.totals;
        totals.phases = Phases::default();
        self.topics.iter_mut().for_each(|path| path.mark(totals));
    }

    /// What all bridges did up to the last mark.
    #[must_use]
    pub fn totals(&self) -> &Totals {
        &self.totals
    }

    /// Forgets what was dropped on the way to flows that are no longer known.
    pub fn keep_totals_of(&mut self, is_known: impl Fn(&FlowId) -> bool) {
        self.totals.dropped_to.retain(|flow, _| is_known(flow));
    }

    /// Bridges that take messages from a scope of a topic, if the topic is still there.
    #[must_use]
    pub fn bridges_up_from(&self, topic: TopicId, from: Scope) -> u64 {
        let path = self.topics.get(topic.0 as usize);
        let bridges = path.map(|path| path.bridges.iter()).unwrap_or_default();
        let is_up = |bridge: &&BridgeState| matches!(bridge.phase, Phase::Up { .. });
        bridges.filter(|bridge| bridge.from == from).filter(is_up).count() as u64
    }

    /// Changes what counts as large, from the next message on.
    pub fn set_large_bytes(&mut self, bytes: u64) {
        self.config.large_bytes = bytes;
        self.lanes_changed = true;
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
        if from == Scope::Layer && !self.path(topic).reads(from) {
            // What still comes after the last bridge has gone is nobody's. Who reads on from there
            // must not find it noted.
            batch.clear();
            return;
        }
        for received in batch.drain(..) {
            let kept = received.kept;
            let meant = match from {
                Scope::Layer if !kept => self.path_mut(topic).places.take(received.place),
                Scope::Layer | Scope::Node | Scope::Ros2 | Scope::Inter => For::All,
            };
            match self.check_local(now, wall_ns, topic, from, received, meant) {
                Ok(admitted) => self.fan_out(now, topic, from, &admitted, link),
                // What a broker keeps is read again with each subscription.
                Err(Refusal::Dropped(DropReason::Duplicate | DropReason::Echo)) if kept => {}
                Err(refusal) => self.path_mut(topic).refuse(from, refusal),
            }
        }
    }

    /// Counts what a subscription of this topic dropped because the flow was slow.
    pub fn count_overrun(&mut self, topic: TopicId, messages: u64) {
        self.topics[topic.0 as usize].ingress_drops.add(DropReason::QueueFull, messages);
    }

    /// Takes a message that came over the link; its age is right at `now`.
    pub fn deliver(&mut self, now: Instant, frame: Frame, link: &mut dyn LaneLink) {
        let delivering =
            self.find(frame.topic()).filter(|topic| self.topics[topic.0 as usize].delivers());
        let Some(topic) = delivering else {
            // The sender knew of the pair before this flow did: the bridge may come in a moment.
            let gone = self.early.hold(now, frame);
            self.look_at = earlier(self.look_at, self.early.next_expiry());
            self.without_destination(gone);
            return;
        };
        let own_layer = frame.origin_layer() == self.config.me.layer.as_str();
        let refused = if own_layer && frame.origin_node() == self.config.me.node.as_str() {
            Some(Refusal::Dropped(DropReason::Echo))
        } else if !self.path(topic).info.takes(&frame) {
            Some(Refusal::Denied)
        } else if !self.is_new_here(now, topic, &frame) {
            Some(Refusal::Dropped(DropReason::Duplicate))
        } else {
            None
        };
        if let Some(refusal) = refused {
            self.path_mut(topic).refuse(Scope::Inter, refusal);
            return;
        }
        let age_us = frame.age_us();
        let message = Admitted::new(now, frame, false, age_us, 0);
        self.compress_in(now, topic, message, link);
    }

    /// Delivers what waited for the bridges of a topic: what is kept for late joiners, and what
    /// came over the link before they stood. To be called after [`DataCore::apply`].
    pub fn deliver_waiting(&mut self, now: Instant, topic: TopicId, link: &mut dyn LaneLink) {
        self.deliver_kept(now, topic, link);
        let path = &self.topics[topic.0 as usize];
        if !path.delivers() {
            return;
        }
        for frame in self.early.take(now, path.name.as_str()) {
            self.deliver(now, frame, link);
        }
    }

    fn without_destination(&mut self, frames: Vec<Frame>) {
        for frame in frames {
            match self.find(frame.topic()) {
                Some(topic) => {
                    self.topics[topic.0 as usize].ingress_drops.add(DropReason::NoDestination, 1);
                }
                None => self.unattributed.add(DropReason::NoDestination, 1),
            }
        }
    }

    /// The link has sent the last byte of a message for the first time.
    pub fn lane_sent(&mut self, now: Instant, lane: LaneId, bytes: u64, wait: Duration) {
        let Some((topic, at)) = self.lanes.get(lane.0 as usize) else {
            return;
        };
        let Some(path) = self.topics.get_mut(topic.0 as usize) else {
            return;
        };
        let reckoned = path.reckoned_bytes(bytes);
        let Some(bridge) = path.bridges.get_mut(*at) else {
            return;
        };
        bridge.out_rate.add(now, bytes);
        bridge.stats.latency.record(micros(wait));
        if let Some((layer, _)) = bridge.receiver() {
            self.reckoned.add(layer, reckoned);
        }
    }

    /// Messages of a lane have left for good.
    pub fn lane_out(&mut self, lane: LaneId, messages: u64, bytes: u64) {
        self.stir_lane(lane);
        if let Some(bridge) = self.lane_bridge(lane) {
            bridge.stats.out.add_many(messages, bytes);
        }
    }

    /// What the link dropped of a lane.
    pub fn lane_dropped(&mut self, lane: LaneId, reason: DropReason, messages: u64) {
        self.stir_lane(lane);
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

    /// Something has changed that bridges may wait for: who is there, what waits in lanes.
    pub fn stir(&mut self) {
        self.stirred |= !self.draining.is_empty();
    }

    fn stir_lane(&mut self, lane: LaneId) {
        if let Some((topic, _)) = self.lanes.get(lane.0 as usize) {
            self.stirred |= self.draining.contains(topic);
        }
    }

    /// Ends bridges that have drained, sends what was held, and answers questions. Returns when it
    /// wants to be called again; calls before that cost nothing.
    pub fn drain(&mut self, now: Instant, link: &mut dyn LaneLink) -> Option<Instant> {
        if !self.stirred && self.look_at.is_none_or(|at| now < at) {
            return self.look_at;
        }
        self.stirred = false;
        let gone = self.early.expire(now);
        self.without_destination(gone);
        let mut next = earlier(self.early.next_expiry(), self.answer(now, link));
        for topic in std::mem::take(&mut self.draining) {
            let mut again = None;
            let path = &mut self.topics[topic.0 as usize];
            for bridge in &mut path.bridges {
                let at = bridge.empty(now, path.name.as_str(), &mut self.succession, link);
                again = earlier(again, at);
            }
            again = earlier(again, self.release(now, topic, link));
            if again.is_some() {
                self.draining.insert(topic);
                next = earlier(next, again);
            }
        }
        self.look_at = next;
        next
    }

    fn lane_bridge(&mut self, lane: LaneId) -> Option<&mut BridgeState> {
        let (topic, bridge) = *self.lanes.get(lane.0 as usize)?;
        self.topics.get_mut(topic.0 as usize)?.bridges.get_mut(bridge)
    }

    pub(super) fn fan_out(
        &mut self,
        now: Instant,
        topic: TopicId,
        from: Scope,
        message: &Admitted,
        link: &mut dyn LaneLink,
    ) {
        if self.take_reply(from, message) {
            return;
        }
        self.kept.keep(now, topic, from, message);
        let me = &self.config.me;
        let path = &mut self.topics[topic.0 as usize];
        let large = path.is_large(self.config.large_bytes);
        let mut lanes = ToLanes::new();
        let (mut as_json, mut as_cdr) = (ToBrokers::new(), ToBrokers::new());
        let mut offered = false;
        for (at, bridge) in
            path.bridges.iter_mut().enumerate().filter(|(_, bridge)| bridge.from == from)
        {
            if bridge.takes() && bridge.wants(me, message) && bridge.is_meant(message.meant) {
                offered |= bridge.lane_id().is_some();
                match bridge.pass(now, message, large, &mut path.gates) {
                    Some(Passed::ToLane(waiting)) => lanes.push((at, waiting)),
                    Some(Passed::ToConvert { to: Encoding::Json, deadline }) => {
                        as_json.push((at, deadline));
                    }
                    Some(Passed::ToConvert { to: Encoding::Cdr, deadline }) => {
                        as_cdr.push((at, deadline));
                    }
                    None => {}
                }
            }
        }
        if offered {
            let bytes = message.frame.payload().len();
            // What is kept for late joiners comes at once, which is no rate.
            if !message.kept {
                path.note_offered(now, bytes as u64);
            }
            self.note_size(now, topic, bytes, link);
        }
        if !lanes.is_empty() {
            self.compress_out(now, topic, &message.frame, lanes, Arrival::Live, link);
        }
        if !as_cdr.is_empty() {
            self.calls.note_served(&message.frame);
        }
        for (to, bridges) in [(Encoding::Json, as_json), (Encoding::Cdr, as_cdr)] {
            if !bridges.is_empty() {
                self.convert(now, topic, message, to, bridges);
            }
        }
    }
}

fn earlier(one: Option<Instant>, other: Option<Instant>) -> Option<Instant> {
    one.into_iter().chain(other).min()
}

#[cfg(test)]
mod tests;
