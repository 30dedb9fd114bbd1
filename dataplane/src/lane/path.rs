//! One topic in one flow: its bridges and what is known of its messages.

use std::collections::{BTreeMap, HashMap};
use std::time::Instant;

use blaze_domain::control::LeaseKind;
use blaze_domain::node_file::{Compression, TopicAccess};
use blaze_domain::{DropReason, FlowId, LayerName, Priority, Scope, TopicName, WriterId};
use blaze_proto::Frame;

use super::admit::Refusal;
use super::allocation::{Granted, LaneGates, Published, Told};
use super::compress_stage::{CompressStats, ConvertStats, TopicEffort, Unconverted};
use super::core::FORGET;
use super::load::LoadMeter;
use super::measure::RateMeter;
use super::reading::Places;
use super::stats::{BridgeStats, Drops, Totals};
use super::succession::{Held, Unwritten};
use super::writer::Writer;
use crate::limit::gate::Gate;
use crate::limit::size::SizeMeter;
use crate::link::LaneId;
use crate::plan::network::Servers;
use crate::plan::{LaneSpec, Target};
use crate::types::TopicTypes;

/// A topic, interned: its place in the data plane.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TopicId(pub u32);

/// What local advertisements say of a topic: the ground for headers of bare messages and for its
/// class.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TopicInfo {
    /// Those of the node scope.
    pub node: BareInfo,
    /// Those of the layer scope.
    pub layer: BareInfo,
    /// Largest payload as advertised.
    pub max_bytes: Option<u64>,
    /// Advertised rate in Hz, summed over the writers; `None` where one of them gives none.
    pub rate_hz: Option<f64>,
    /// Whose messages are taken: the rules of `flow.access`.
    pub access: TopicAccess,
    /// Its types, for conversions.
    pub types: TopicTypes,
    /// Where requests may go, if the topic is that of a service's requests.
    pub servers: Servers,
}

/// What the advertisements of one scope say of messages that come without a header.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct BareInfo {
    /// Media type as advertised.
    pub encoding: String,
    /// The only advertising service; empty where there are several or none.
    pub service: String,
    /// Instance of that service.
    pub instance: String,
    /// Class as advertised.
    pub priority: Option<Priority>,
    /// Advertised as reliable.
    pub reliable: bool,
    /// Samples kept per writer for late joiners.
    pub depth: u32,
    /// Lifespan in milliseconds; 0 = none.
    pub lifespan_ms: u32,
}

impl TopicInfo {
    /// Whether the rules let the origin of a message publish it.
    #[must_use]
    pub(super) fn takes(&self, frame: &Frame) -> bool {
        let origin = (frame.origin_layer(), frame.origin_node(), frame.origin_service());
        self.access.allows(LeaseKind::Advertise, origin.0, origin.1, origin.2)
    }

    /// What is said on the scope that a bare message came from.
    #[must_use]
    pub fn bare(&self, from: Scope) -> &BareInfo {
        match from {
            Scope::Node => &self.node,
            // There is nothing without a header on ROS 2.
            Scope::Layer | Scope::Ros2 | Scope::Inter => &self.layer,
        }
    }
}

/// Scopes that messages come from.
const SCOPES: usize = Scope::ALL.len();

/// Messages that were refused before any bridge, by causes that somebody can cure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Refused {
    /// Larger than is carried.
    pub too_large: u64,
    /// Born in another layer or node than the scope that they came from.
    pub foreign: u64,
    /// Of origins that the rules of `flow.access` do not let publish the topic.
    pub denied: u64,
}

impl Refused {
    fn add(&mut self, refusal: Refusal) {
        match refusal {
            Refusal::Denied => self.denied += 1,
            Refusal::Dropped(DropReason::ForeignOrigin) => self.foreign += 1,
            Refusal::Dropped(DropReason::TooLarge) => self.too_large += 1,
            Refusal::Dropped(_) => {}
        }
    }

    fn since(self, before: Self) -> Self {
        Self {
            too_large: self.too_large - before.too_large,
            foreign: self.foreign - before.foreign,
            denied: self.denied - before.denied,
        }
    }
}

/// Where a bridge writes.
pub enum Sink {
    /// A local broker.
    Publish {
        /// Writer of the channel, of this bridge alone; absent while it cannot be made, and when
        /// the bridge has ended.
        writer: Option<Writer>,
        /// Writers that were replaced and have not delivered all yet.
        past: Vec<Writer>,
        /// Payloads only.
        bare: bool,
    },
    /// The link to another flow.
    Lane {
        /// The lane's number in the engine.
        lane: LaneId,
        /// Its class today.
        class: Priority,
    },
}

/// Whether a bridge takes messages in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// It does.
    Up {
        /// Since when.
        since: Instant,
    },
    /// Its pair has vanished: it empties its queue.
    Draining {
        /// Until then, unless more comes that was on its way to it …
        until: Instant,
        /// … but until then at most.
        latest: Instant,
    },
    /// Its writer cannot be made: the reason is with the bridge.
    Failed {
        /// Since when.
        since: Instant,
    },
    /// Its counters alone remain.
    Ended,
}

/// One bridge of one topic.
pub struct BridgeState {
    /// Where it reads.
    pub from: Scope,
    /// Where it writes, as planned.
    pub target: Target,
    /// Rate, lifespan, reliability and filters.
    pub lane: LaneSpec,
    /// Whether it takes messages in.
    pub phase: Phase,
    /// Why it failed.
    pub failure: Option<String>,
    /// When it ended, if it did.
    pub ended: Option<Instant>,
    /// Thins to what requesters ask for.
    pub gate: Gate,
    /// What the budget allows its lane, in Hz, once it is worked out.
    pub allocated_hz: Option<f64>,
    /// Its lane is held to the rate that was advertised, because more is published.
    pub exceeds_advertised: bool,
    /// Where it writes.
    pub sink: Sink,
    /// Messages that are being compressed or converted, or wait behind such.
    pub(super) in_codec: u64,
    /// It has given messages to its lane since it last ended.
    pub(super) submitted: bool,
    /// Messages that wait until the receiver before this one has written its own.
    pub(super) held: Option<Held>,
    /// It drains, and what its receiver got must be written before another one goes on.
    pub(super) unwritten: Option<Unwritten>,
    /// The last message that could not be converted for it.
    pub unconverted: Option<Unconverted>,
    /// Counters.
    pub stats: BridgeStats,
    /// Written per second.
    pub out_rate: RateMeter,
    /// Carried, after filters and rate.
    pub load: LoadMeter,
}

impl BridgeState {
    /// `inter/<layer>`, `layer`, `node` or `ros2`: the label `to` of metrics.
    #[must_use]
    pub fn to_label(&self) -> String {
        match &self.target {
            Target::Inter { layer, .. } => format!("inter/{layer}"),
            local => local.scope().to_string(),
        }
    }

    /// Whether it takes messages in now. One from the inter scope does so while it drains, too: a
    /// flow that stops says so at once, and what it had queued for us comes after.
    #[must_use]
    pub fn takes(&self) -> bool {
        match self.phase {
            Phase::Up { .. } => true,
            Phase::Draining { .. } => self.from == Scope::Inter,
            Phase::Failed { .. } | Phase::Ended => false,
        }
    }

    /// Whether it has ended and nothing of it waits for a broker, or is being compressed.
    #[must_use]
    pub fn is_over(&self) -> bool {
        let waits = match &self.sink {
            Sink::Publish { writer, past, .. } => writer.is_some() || !past.is_empty(),
            Sink::Lane { .. } => false,
        };
        self.phase == Phase::Ended && !waits && self.in_codec == 0
    }

    /// Whether it ended so long ago that another bridge may have its place.
    #[must_use]
    pub fn is_forgotten(&self, now: Instant) -> bool {
        let long_ago = |ended| now.saturating_duration_since(ended) >= FORGET;
        self.is_over() && self.ended.is_some_and(long_ago)
    }

    /// Its lane, if it writes to one.
    #[must_use]
    pub fn lane_id(&self) -> Option<LaneId> {
        match self.sink {
            Sink::Lane { lane, .. } => Some(lane),
            Sink::Publish { .. } => None,
        }
    }

    /// Layer and receiver of a bridge to the inter scope.
    #[must_use]
    pub fn receiver(&self) -> Option<(&LayerName, &FlowId)> {
        match &self.target {
            Target::Inter { layer, receiver } => Some((layer, receiver)),
            Target::Node(_) | Target::Layer { .. } | Target::Ros2 => None,
        }
    }
}

/// One topic.
pub struct TopicPath {
    /// Its name.
    pub name: TopicName,
    /// Another number each time that a topic is given a place, so that bare messages of a topic
    /// that was forgotten have another writer.
    pub(super) life: u64,
    /// What local advertisements say of it.
    pub info: TopicInfo,
    /// Its bridges, ended ones included: they come back with their counters.
    pub bridges: Vec<BridgeState>,
    /// Largest payload seen, in bytes.
    pub largest_bytes: u64,
    /// How its payloads are compressed for the inter scope.
    pub compression: Compression,
    /// The level over time.
    pub effort: TopicEffort,
    /// What compression did.
    pub compress_stats: CompressStats,
    /// What conversion did.
    pub convert_stats: ConvertStats,
    /// When a message that could not be converted was last reported.
    pub(super) failure_reported: Option<Instant>,
    /// Messages that are worth compressing and that some lane has admitted.
    pub(super) worth_rate: RateMeter,
    /// Largest payload as sent on the inter scope.
    pub sent_size: SizeMeter,
    /// The level that the last payload that is worth compressing was sent at; 0: as it is.
    pub(super) sent_level: u8,
    /// What was decided for it, where it leaves on the inter scope.
    pub granted: Option<Granted>,
    /// What came for its lanes, whether it passed there or not.
    pub offered: RateMeter,
    /// What is believed of that.
    pub(super) published: Published,
    /// What the allocator was told last.
    pub(super) told: Option<Told>,
    /// What thins its lanes.
    pub(super) gates: LaneGates,
    /// What came from local scopes.
    pub in_rate: RateMeter,
    /// Dropped before any bridge: echoes, duplicates, what could not be read.
    pub ingress_drops: Drops,
    /// Those at the last mark.
    ingress_drops_marked: Drops,
    /// Those of them that people ask for, by the scope that they came from.
    refused: [Refused; SCOPES],
    /// Those at two moments, so that what happened lately can be told.
    refused_marks: [[Refused; SCOPES]; 2],
    /// Where the layer scope is read, if its broker keeps places.
    pub places: Places,
    /// Identity that the flow gives to bare messages, per source scope.
    pub bare: BTreeMap<Scope, (WriterId, u64)>,
    /// Where the requests of each client go, if the topic is that of a service's requests.
    pub(super) clients: HashMap<WriterId, FlowId>,
    /// Since when nobody has used it.
    pub(super) idle: Option<Instant>,
    /// It was forgotten: its place waits for another topic.
    pub(super) vacant: bool,
}

impl TopicPath {
    /// A topic without bridges.
    #[must_use]
    pub fn new(name: TopicName, life: u64, now: Instant) -> Self {
        Self {
            name,
            life,
            info: TopicInfo::default(),
            clients: HashMap::new(),
            bridges: Vec::new(),
            largest_bytes: 0,
            compression: Compression::default(),
            effort: TopicEffort::default(),
            compress_stats: CompressStats::default(),
            convert_stats: ConvertStats::default(),
            failure_reported: None,
            worth_rate: RateMeter::new(now),
            sent_size: SizeMeter::default(),
            sent_level: 0,
            granted: None,
            offered: RateMeter::new(now),
            published: Published::default(),
            told: None,
            gates: LaneGates::default(),
            in_rate: RateMeter::new(now),
            ingress_drops: Drops::default(),
            ingress_drops_marked: Drops::default(),
            refused: Default::default(),
            refused_marks: Default::default(),
            places: Places::default(),
            bare: BTreeMap::new(),
            idle: None,
            vacant: false,
        }
    }

    /// Puts a mark into all counters.
    pub(super) fn mark(&mut self, totals: &mut Totals) {
        self.refused_marks = [self.refused_marks[1], self.refused];
        for (reason, count) in self.ingress_drops.since(&self.ingress_drops_marked) {
            totals.dropped.add(reason, count);
        }
        self.ingress_drops_marked = self.ingress_drops.clone();
        for bridge in &mut self.bridges {
            bridge.settle();
            let to = match &bridge.target {
                Target::Inter { receiver, .. } => Some(receiver),
                Target::Node(_) | Target::Layer { .. } | Target::Ros2 => None,
            };
            bridge.stats.mark(totals, to);
            match bridge.phase {
                Phase::Up { .. } => totals.phases.up += 1,
                Phase::Draining { .. } => totals.phases.draining += 1,
                Phase::Failed { .. } => totals.phases.failed += 1,
                Phase::Ended => {}
            }
        }
    }

    /// Counts a message that is not taken in.
    pub(super) fn refuse(&mut self, from: Scope, refusal: Refusal) {
        self.ingress_drops.add(refusal.reason(), 1);
        self.refused[from as usize].add(refusal);
    }

    /// What was refused of a scope since the mark before the last.
    #[must_use]
    pub fn refused_lately(&self, from: Scope) -> Refused {
        let at = from as usize;
        self.refused[at].since(self.refused_marks[0][at])
    }

    /// Whether nothing goes through it and nothing waits.
    #[must_use]
    pub fn is_idle(&self) -> bool {
        self.bridges.iter().all(BridgeState::is_over)
    }

    /// Size that decides the class: the largest seen, else as advertised.
    #[must_use]
    pub fn size_bytes(&self) -> u64 {
        if self.largest_bytes > 0 { self.largest_bytes } else { self.info.max_bytes.unwrap_or(0) }
    }

    /// Whether its messages are large, as seen or as advertised.
    #[must_use]
    pub fn is_large(&self, large_bytes: u64) -> bool {
        self.largest_bytes.max(self.info.max_bytes.unwrap_or(0)) > large_bytes
    }

    /// Class of a lane: bulk if the topic is large, else as the lane says, else state.
    #[must_use]
    pub fn class(&self, lane: &LaneSpec, large_bytes: u64) -> Priority {
        if self.is_large(large_bytes) {
            Priority::Bulk
        } else {
            lane.priority.unwrap_or(Priority::State)
        }
    }

    /// Whether messages that come over the link are written somewhere.
    #[must_use]
    pub fn delivers(&self) -> bool {
        self.bridges.iter().any(|bridge| bridge.from == Scope::Inter && bridge.takes())
    }

    /// Whether a bridge from that scope takes what was published before it.
    #[must_use]
    pub fn reads_kept(&self, scope: Scope) -> bool {
        self.bridges
            .iter()
            .any(|bridge| bridge.from == scope && bridge.takes() && bridge.lane.durable)
    }

    /// Whether a bridge takes messages in from that scope.
    #[must_use]
    pub fn reads(&self, scope: Scope) -> bool {
        self.bridges
            .iter()
            .any(|bridge| bridge.from == scope && matches!(bridge.phase, Phase::Up { .. }))
    }
}
