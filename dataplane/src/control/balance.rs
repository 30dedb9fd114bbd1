//! Topics that are given to other flows of the layer because they carry less, and how much this
//! flow carries itself.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_domain::{FlowId, Scope, TopicName};
use blaze_proto::link::link_control::LayerScope;

use super::{ControlCore, ScopeHealth};
use crate::lane::load::{Loads, TopicLoad};
use crate::plan::TopicPlan;
use crate::plan::balance::{Burden, MIN_GAP, Member, Proposal, next_move};
use crate::registry::{Load, REST};
use crate::world::{FlowState, Hold};

/// A topic that was given to this flow by load stays at least this long, whatever the loads are.
pub const STAY: Duration = Duration::from_secs(60);
/// Loads must differ for this long before something is moved: longer than it takes until others
/// have heard of a move.
const PERSIST: Duration = Duration::from_secs(3);
/// Each flow that carries more has so much time to move something first.
const TURN: Duration = Duration::from_secs(3);
/// A move that has not begun after this long is not to be.
const BEGIN_WITHIN: Duration = Duration::from_secs(1);
/// While the layer broker is away nothing comes, which says nothing of what a topic weighs; nor
/// does the mean for so long after.
const UNWEIGHED: Duration = Duration::from_secs(10);
/// A topic that weighs less is placed by hashing, as one that is idle.
const LIGHT: u64 = MIN_GAP;

/// Why a topic went to another flow of the layer that goes on with it while this one lives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MoveReason {
    /// That one carries less.
    Load,
    /// Hashing prefers that one, and it has settled.
    Settled,
}

impl MoveReason {
    /// Its name in `/v1/bridges` and metrics.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Load => "load",
            Self::Settled => "settled",
        }
    }
}

/// The last topic that went to another flow.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LastMove {
    /// The topic.
    pub topic: TopicName,
    /// Who carries it now; `None`: whoever hashing chose.
    pub to: Option<FlowId>,
    /// Why.
    pub reason: MoveReason,
    /// When.
    pub at: Instant,
}

/// Topics that went to other flows of the layer while this one lives.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Moves {
    /// By load.
    pub by_load: u64,
    /// To one that hashing prefers.
    pub settled: u64,
    /// Moves that were begun and taken back, because what was on its way was not acknowledged in
    /// time or the other one was gone.
    pub taken_back: u64,
    /// The last one.
    pub last: Option<LastMove>,
}

/// A topic that is to be given away.
#[derive(Debug)]
struct Gift {
    topic: TopicName,
    to: FlowId,
    at: Instant,
}

/// What the core remembers of loads and moves.
#[derive(Debug, Default)]
pub(super) struct Balance {
    /// How much this flow carries.
    pub(super) own: Load,
    /// Topics that this flow got by load, and since when.
    got: BTreeMap<TopicName, Instant>,
    /// Topics that were taken back: they stay until then.
    kept: BTreeMap<TopicName, Instant>,
    gift: Option<Gift>,
    /// Since when something should be moved.
    uneven: Option<Instant>,
    /// Nothing is moved before.
    pause: Option<Instant>,
    /// What topics weigh is not looked at before.
    weighed_from: Option<Instant>,
    moves: Moves,
}

impl Balance {
    /// This flow was given a topic by load.
    pub(super) fn note_got(&mut self, now: Instant, topic: &TopicName) {
        self.got.insert(topic.clone(), now);
    }

    /// The flow that a topic is being given to by load.
    pub(super) fn gift_of(&self, topic: &TopicName) -> Option<&FlowId> {
        let gift = self.gift.as_ref().filter(|gift| gift.topic == *topic);
        gift.map(|gift| &gift.to)
    }

    /// A topic is another flow's now.
    pub(super) fn note_gone(&mut self, now: Instant, topic: &TopicName, to: Option<&FlowId>) {
        let reason = if to.is_some() {
            self.moves.by_load += 1;
            MoveReason::Load
        } else {
            self.moves.settled += 1;
            MoveReason::Settled
        };
        self.end_gift(topic);
        self.moves.last = Some(LastMove { topic: topic.clone(), to: to.cloned(), reason, at: now });
    }

    /// A topic that was to go stays: for a while nothing is tried.
    pub(super) fn note_taken_back(&mut self, now: Instant, topic: &TopicName) {
        self.moves.taken_back += 1;
        self.kept.insert(topic.clone(), now + REST);
        self.pause = Some(now + REST);
        self.end_gift(topic);
    }

    fn end_gift(&mut self, topic: &TopicName) {
        self.gift.take_if(|gift| gift.topic == *topic);
    }

    /// Forgets topics that this flow does not carry any more.
    fn retain(&mut self, now: Instant, carries: impl Fn(&TopicName) -> bool) {
        self.got.retain(|topic, _| carries(topic));
        self.kept.retain(|topic, until| *until > now && carries(topic));
    }

    /// Whether a topic that weighs so much stays here whatever a hash says. One that was kept for
    /// its weight stays until it is only half as much.
    fn stays(&self, topic: &TopicName, bytes_per_s: u64, before: &Hold) -> bool {
        let light = if *before == Hold::Stays { LIGHT / 2 } else { LIGHT };
        self.got.contains_key(topic) || self.kept.contains_key(topic) || bytes_per_s >= light
    }

    /// Whether a topic has been here long enough to be moved by load.
    fn may_go(&self, now: Instant, topic: &TopicName) -> bool {
        let stayed =
            self.got.get(topic).is_none_or(|since| now.saturating_duration_since(*since) >= STAY);
        stayed && !self.kept.contains_key(topic)
    }

    /// Whether a move that should be made for a while may be made now.
    fn is_due(&mut self, now: Instant, proposal: &Proposal, last_move: Option<Instant>) -> bool {
        let since = *self.uneven.get_or_insert(now);
        let since = last_move.map_or(since, |last| last.max(since));
        let turn = TURN.saturating_mul(proposal.rank);
        self.pause.is_none_or(|pause| pause <= now)
            && now.saturating_duration_since(since) >= PERSIST + turn
    }
}

impl ControlCore {
    /// What this flow carries, measured once a second, and the bytes per second that its wire may
    /// take: other flows of the layer are told, and a topic may go to one that carries less.
    pub fn set_loads(&mut self, now: Instant, loads: &Loads, limit_bytes_per_s: u64) {
        self.balance.own = Load {
            out_bytes_per_s: loads.out_bytes_per_s,
            in_bytes_per_s: loads.in_bytes_per_s,
            limit_bytes_per_s,
        };
        if self.config.replicas != Some(LayerScope::Kafka) {
            return;
        }
        let (plans, carriers) = (&self.plans, &self.carriers);
        // What is being given up may be taken back.
        let carries = |topic: &TopicName| {
            plans.get(topic).is_some_and(TopicPlan::carries_out) || carriers.gives_up(topic)
        };
        self.balance.retain(now, carries);
        let gift = self.balance.gift.take_if(|gift| {
            now.saturating_duration_since(gift.at) >= BEGIN_WITHIN
                && !carriers.gives_up(&gift.topic)
        });
        if let Some(gift) = gift {
            // The one that was to get it is gone or cannot have it, or nobody asks for the topic
            // any more.
            self.balance.note_taken_back(now, &gift.topic);
        }
        if self.state == FlowState::Ready && self.scopes.health(Scope::Layer) != ScopeHealth::Up {
            self.balance.weighed_from = Some(now + UNWEIGHED);
        }
        if self.balance.weighed_from.is_none_or(|from| from <= now) {
            self.hold_heavy(&loads.carried);
        }
        self.give(now, &loads.carried);
    }

    /// Topics that went to other flows of the layer since the start.
    #[must_use]
    pub fn moves(&self) -> &Moves {
        &self.balance.moves
    }

    /// How much this flow carries, as the others are told.
    #[must_use]
    pub fn load(&self) -> Load {
        self.balance.own
    }

    /// What weighs something, or was placed by load, stays until it is given away by load.
    fn hold_heavy(&mut self, carried: &[TopicLoad]) {
        for load in carried {
            let before = self.registry.hold(&load.topic);
            if matches!(before, Hold::GivesTo(_)) && self.balance.gift_of(&load.topic).is_some() {
                continue;
            }
            let hold = if self.balance.stays(&load.topic, load.bytes_per_s, before) {
                Hold::Stays
            } else {
                Hold::Hashing
            };
            if *before != hold {
                self.registry.set_hold(&load.topic, hold);
            }
        }
    }

    /// Gives a topic away, if this flow carries too much for a while.
    fn give(&mut self, now: Instant, carried: &[TopicLoad]) {
        // While the layer broker is away nobody hears where a topic was stopped.
        let heard =
            self.state == FlowState::Ready && self.scopes.health(Scope::Layer) == ScopeHealth::Up;
        let idle = heard && self.balance.gift.is_none() && self.carriers.is_idle();
        let Some(proposal) = idle.then(|| self.proposal(now, carried)).flatten() else {
            self.balance.uneven = None;
            return;
        };
        if !self.balance.is_due(now, &proposal, self.registry.last_move()) {
            return;
        }
        let Proposal { topic, to, .. } = proposal;
        tracing::info!(%topic, %to, "this flow carries more than the others: the topic goes");
        self.balance.uneven = None;
        self.registry.set_hold(&topic, Hold::GivesTo(to.clone()));
        self.touch_urgent(now, &topic);
        self.balance.gift = Some(Gift { topic, to, at: now });
    }

    fn proposal(&self, now: Instant, carried: &[TopicLoad]) -> Option<Proposal> {
        let me = &self.config.me;
        let member = |flow, load: Load| Member {
            flow,
            bytes_per_s: load.total(),
            rests: self.registry.rests(now, flow),
        };
        let others = self.registry.settled_replicas();
        // While one of them says nothing of its load, as those of earlier versions do, nobody knows
        // who carries too much.
        let others: Option<Vec<Member<'_>>> =
            others.map(|flow| Some(member(flow, self.registry.load_of(flow)?))).collect();
        let mut group = others.filter(|others| !others.is_empty())?;
        group.push(member(me, self.balance.own));
        let burdens: Vec<Burden<'_>> = carried
            .iter()
            .map(|load| Burden {
                topic: &load.topic,
                bytes_per_s: load.bytes_per_s,
                may_move: load.may_move && self.balance.may_go(now, &load.topic),
            })
            .collect();
        next_move(me, &group, &burdens)
    }
}
