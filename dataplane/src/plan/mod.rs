//! Which bridges one flow makes for one topic: a pure function of the world that it knows.
//!
//! ```text
//! World ──► TopicView (who publishes, who requests, who shares a layer broker)
//!             │  pairs: origin filters and types agree
//!             ├─► receivers and owners (rendezvous hashing, one per pair of publisher and group)
//!             └─► bridges, each with the lane that its requesters ask for; what is blocked, and why
//! ```
//!
//! A *group* is the flows that reach each other over one layer broker; a flow without one is a
//! group of its own. Each message crosses the inter scope once per other group that wants it, to
//! one receiver, which writes its node scope for its own requesters and its layer scope for
//! everybody else's. What crossed the inter scope never leaves a layer again.
//!
//! A ROS 2 network is one more local scope; [`network`] says which of its flows reads and writes
//! what.
//!
//! In a large group only some flows are on the inter scope, its [gateways](gateway). The others
//! publish to the layer scope what flows of other groups ask for, and read there what those
//! publish: to them, other groups are what a gateway says of them.

pub(crate) mod balance;
pub mod gateway;
mod lane;
pub mod network;
pub(crate) mod rendezvous;
mod rules;
mod survey;
pub(crate) mod told;
mod view;

#[cfg(test)]
pub(crate) mod tests;

use std::collections::BTreeMap;

use blaze_domain::{FlowId, LayerName, Priority, Scope, TopicName, WhyCode};

pub(crate) use lane::asks_too_much;
pub use rules::PlanRules;
pub use survey::Survey;
pub(crate) use view::{
    Group, Pairing, Publisher, Requester, TopicView, meets_directly, type_detail,
};

use crate::world::{FlowState, LayerScopeId, OriginFilter, Request, World};
use lane::LaneBuilder;
use network::{Natives, holds};

/// What one flow does for one topic.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TopicPlan {
    /// Bridges in the order of source and target; no two have both in common.
    pub bridges: Vec<Bridge>,
    /// Requesters that get nothing, or not everything, and why; sorted, one entry per requester and
    /// code.
    pub blocked: Vec<Blocked>,
    /// Another flow of the group carries what is published on the layer scope to other groups, or
    /// is to; `None` where this flow does, or nobody needs to.
    pub carrier: Option<FlowId>,
}

impl TopicPlan {
    /// Whether a bridge reads or writes the layer scope.
    #[must_use]
    pub fn uses_layer(&self) -> bool {
        self.bridges.iter().any(Bridge::uses_layer)
    }

    /// Whether this flow carries what services of the layer scope publish to other groups.
    #[must_use]
    pub fn carries_out(&self) -> bool {
        self.bridges.iter().any(Bridge::carries_out)
    }

    /// Makes no bridge from or to the layer scope, because its broker cannot have the topic; says
    /// so to the layer, and to the own node if it was to get the topic from there.
    pub fn block_layer(&mut self, me: &FlowId, code: WhyCode, detail: &str) {
        let blocked = |to| Blocked { to, code, detail: detail.to_owned() };
        let (gone, kept): (Vec<Bridge>, Vec<Bridge>) =
            std::mem::take(&mut self.bridges).into_iter().partition(Bridge::uses_layer);
        self.bridges = kept;
        if !gone.is_empty() {
            self.blocked.push(blocked(Destination::Layer(me.layer.clone())));
        }
        if gone.iter().any(|bridge| bridge.to.scope() == Scope::Node) {
            self.blocked.push(blocked(Destination::Flow(me.clone())));
        }
        self.blocked.sort();
        self.blocked.dedup_by(|next, kept| next.to == kept.to && next.code == kept.code);
    }
}

impl Bridge {
    /// Whether it carries what services of the layer scope publish to another group.
    #[must_use]
    pub fn carries_out(&self) -> bool {
        self.from == Scope::Layer && self.to.receiver().is_some()
    }

    /// Whether it reads or writes the layer scope.
    #[must_use]
    pub fn uses_layer(&self) -> bool {
        self.from == Scope::Layer || self.to.scope() == Scope::Layer
    }
}

/// One way of a topic through the flow.
#[derive(Debug, Clone, PartialEq)]
pub struct Bridge {
    /// Scope that it reads.
    pub from: Scope,
    /// Where it writes.
    pub to: Target,
    /// How it carries messages.
    pub lane: LaneSpec,
}

/// How a message is written to a node scope.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Form {
    /// With its header.
    Framed,
    /// Its payload alone, on a channel of its own.
    Bare,
    /// Its payload as JSON, on a channel of its own.
    Json,
}

impl Form {
    /// All of them, in the order of their bridges.
    pub const ALL: [Self; 3] = [Self::Framed, Self::Bare, Self::Json];

    /// Whether a request of a node scope is for this form.
    #[must_use]
    pub fn is_asked(self, request: &Request) -> bool {
        match self {
            Self::Framed => request.framed,
            Self::Bare => request.bare,
            Self::Json => request.json,
        }
    }
}

/// Where a bridge writes.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Target {
    /// Node scope of the flow.
    Node(Form),
    /// Layer scope of the flow.
    Layer {
        /// Payloads as JSON, on a channel of their own.
        json: bool,
    },
    /// ROS 2 network of the flow.
    Ros2,
    /// Another flow over the inter scope.
    Inter {
        /// Layer of the receiver.
        layer: LayerName,
        /// The flow that takes it in for its group.
        receiver: FlowId,
    },
}

impl Target {
    /// The other flow, of a target on the inter scope.
    #[must_use]
    pub fn receiver(&self) -> Option<&FlowId> {
        match self {
            Self::Inter { receiver, .. } => Some(receiver),
            Self::Node(_) | Self::Layer { .. } | Self::Ros2 => None,
        }
    }

    /// The scope that it is on.
    #[must_use]
    pub fn scope(&self) -> Scope {
        match self {
            Self::Node(_) => Scope::Node,
            Self::Layer { .. } => Scope::Layer,
            Self::Ros2 => Scope::Ros2,
            Self::Inter { .. } => Scope::Inter,
        }
    }

    /// Whether payloads go there as JSON.
    #[must_use]
    pub fn is_json(&self) -> bool {
        matches!(self, Self::Node(Form::Json) | Self::Layer { json: true })
    }

    /// Whether payloads go there without a header.
    #[must_use]
    pub fn is_headless(&self) -> bool {
        self.is_json() || *self == Self::Node(Form::Bare)
    }
}

/// What the requesters behind a bridge ask of it, within what is offered.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LaneSpec {
    /// Highest rate that any requester takes, in messages per second; `None` = as published.
    pub max_rate_hz: Option<f64>,
    /// The smaller of the publishers' and the longest requester's lifespan, in milliseconds; 0 =
    /// infinite.
    pub lifespan_ms: u32,
    /// Lost messages are sent again.
    pub reliable: bool,
    /// Late joiners get the last `depth` messages of each writer.
    pub durable: bool,
    /// Messages kept per writer, at least 1.
    pub depth: u32,
    /// Class on the inter scope; `None` = nobody said: bulk if large, else state.
    pub priority: Option<Priority>,
    /// Origins that the requesters ask for, sorted; empty = any. Nothing else is carried.
    pub from: Vec<OriginFilter>,
    /// Out of the layer: flows, sorted, that are not on the inter scope, so that what they wrote to
    /// the layer scope from their own nodes is carried as if it was born there.
    pub relays: Vec<FlowId>,
    /// To another group: the layer broker that its flows share, so that another of them could be
    /// the receiver as well; `None`: it is alone.
    pub shared: Option<LayerScopeId>,
    /// To ROS 2, of what other flows wrote or sent: the flows on the network.
    pub natives: Natives,
    /// What it takes is held for the moment: another flow carries the same, and what is on its way
    /// there is not to be overtaken.
    pub held: bool,
}

impl LaneSpec {
    /// Whether a message of that origin is carried.
    #[must_use]
    pub fn carries(&self, layer: &str, node: &str, service: &str) -> bool {
        self.from.is_empty() || self.from.iter().any(|filter| filter.matches(layer, node, service))
    }

    /// Whether what the flow of that node wrote to the layer scope is carried out of it.
    #[must_use]
    pub fn relays(&self, layer: &str, node: &str) -> bool {
        holds(&self.relays, layer, node)
    }
}

/// Who is not served.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Destination {
    /// Services on the node scope of a flow.
    Flow(FlowId),
    /// Services on the layer scope of a layer.
    Layer(LayerName),
}

/// A request that is not served, as far as this flow has a part in it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Blocked {
    /// Who asks.
    pub to: Destination,
    /// Why it gets nothing from a publisher.
    pub code: WhyCode,
    /// The facts, for people.
    pub detail: String,
}

/// What a flow writes of a message that another flow addressed to it, by target.
pub type Delivery = BTreeMap<Target, LaneSpec>;

/// Plans what the flow `world.me` does for a topic.
///
/// `previous` is the plan in effect: as long as its receivers are still eligible they are kept,
/// until a better one is [settled](crate::world::FlowView::settled). Equal inputs give equal plans.
/// A flow that is not `Ready` takes in nothing and has no bridges.
#[must_use]
pub fn plan_topic(
    world: &World,
    topic: &TopicName,
    rules: &PlanRules,
    previous: Option<&TopicPlan>,
) -> TopicPlan {
    plan_within(&Survey::new(world), topic, rules, previous)
}

/// As [`plan_topic`], of one of many topics.
#[must_use]
pub fn plan_within(
    survey: &Survey<'_>,
    topic: &TopicName,
    rules: &PlanRules,
    previous: Option<&TopicPlan>,
) -> TopicPlan {
    let world = survey.world;
    // Of what a fleet publishes most is asked for by nobody.
    if !survey.may_be_requested(topic) {
        return TopicPlan::default();
    }
    let Some(view) = TopicView::within(survey, topic) else {
        return TopicPlan::default();
    };
    let lanes = LaneBuilder::new(rules.find(topic));
    let mut plan = Planner { view: &view, lanes: &lanes, bridges: BTreeMap::new() };
    if world.own().is_some_and(|own| own.state == FlowState::Ready) {
        plan.read_node(previous);
        plan.read_ros2(previous);
        plan.read_layer(previous);
        plan.read_inter();
    }
    TopicPlan {
        bridges: plan
            .bridges
            .into_iter()
            .map(|((from, to), lane)| Bridge { from, to, lane })
            .collect(),
        blocked: view.blocked(),
        carrier: view.other_carrier(),
    }
}

/// What the flow `world.me` writes of a message from the inter scope, whether or not it would have
/// been chosen to get it: views differ for a moment, and a sender stays with the receiver that it
/// has.
#[must_use]
pub fn delivery(world: &World, topic: &TopicName, rules: &PlanRules) -> Delivery {
    TopicView::new(world, topic)
        .map_or_else(Delivery::default, |view| deliver(&view, &LaneBuilder::new(rules.find(topic))))
}

/// The flow of `world.me`'s group that carries what services of the layer scope publish out of the
/// layer.
#[must_use]
pub fn owner(world: &World, topic: &TopicName) -> Option<FlowId> {
    TopicView::new(world, topic)?.owner().cloned()
}

fn deliver(view: &TopicView<'_>, lanes: &LaneBuilder) -> Delivery {
    let outside: Vec<_> = view.publishers_outside().collect();
    let lane = |(target, requesters): (Target, Vec<&Requester<'_>>)| {
        let lane = lanes.lane(view.pairs(outside.iter().copied(), requesters))?;
        Some((target.clone(), of_others(view, &target, lane)))
    };
    local_targets(view).into_iter().filter_map(lane).collect()
}

/// Where this flow writes what comes from elsewhere, and for whom.
fn local_targets<'a, 'w>(view: &'a TopicView<'w>) -> Vec<(Target, Vec<&'a Requester<'w>>)> {
    let mut targets: Vec<_> = node_targets(view).map(|(to, own)| (to, vec![own])).collect();
    targets.push((Target::Layer { json: false }, view.requesters_over_own_layer().collect()));
    targets.push((Target::Layer { json: true }, view.own_layer_json().into_iter().collect()));
    targets.push((Target::Ros2, view.written_network().into_iter().collect()));
    targets
}

/// The own node scope, in each form that its services ask for.
fn node_targets<'a, 'w>(
    view: &'a TopicView<'w>,
) -> impl Iterator<Item = (Target, &'a Requester<'w>)> {
    view.own_node_requester().into_iter().flat_map(|own| {
        let forms = Form::ALL.into_iter().filter(|form| form.is_asked(own.request));
        forms.map(move |form| (Target::Node(form), own))
    })
}

/// The lane of what other flows wrote or sent.
fn of_others(view: &TopicView<'_>, to: &Target, mut lane: LaneSpec) -> LaneSpec {
    if *to == Target::Ros2 {
        lane.natives = view.natives();
    }
    lane
}

/// Collects the bridges of one topic.
struct Planner<'a, 'w> {
    view: &'a TopicView<'w>,
    lanes: &'a LaneBuilder,
    bridges: BTreeMap<(Scope, Target), LaneSpec>,
}

impl<'w> Planner<'_, 'w> {
    /// What services of the own node publish: copies in other forms beside it, to the own ROS 2
    /// network, to the own layer, to every other group.
    fn read_node(&mut self, previous: Option<&TopicPlan>) {
        let Some(publisher) = self.view.own_node_publisher() else {
            return;
        };
        for (to, own) in node_targets(self.view).filter(|(to, _)| to.is_headless()) {
            let lane = self.lanes.lane(self.view.pairs([publisher], [own]));
            self.put(Scope::Node, to, lane);
        }
        if let Some(own) = self.view.own_network().filter(|own| publisher.matches(own)) {
            let lane = self.lanes.lane([(publisher, &own)].into_iter());
            self.put(Scope::Node, Target::Ros2, lane);
        }
        self.read_own(publisher, previous);
    }

    /// What the writers publish that this flow owns: to the own node, to the own layer, to every
    /// other group.
    fn read_ros2(&mut self, previous: Option<&TopicPlan>) {
        let Some(publisher) = self.view.own_ros2_publisher() else {
            return;
        };
        if self.view.serves_itself() {
            return;
        }
        for (to, own) in node_targets(self.view) {
            let lane = self.lanes.lane(self.view.pairs([publisher], [own]));
            self.put(Scope::Ros2, to, lane);
        }
        self.read_own(publisher, previous);
    }

    /// What is published on this flow alone: to the own layer, to every other group.
    fn read_own(&mut self, publisher: &Publisher<'w>, previous: Option<&TopicPlan>) {
        let over_layer = self
            .view
            .requesters_over_own_layer()
            .chain(self.view.requesters_over_gateways())
            .chain(self.view.requesters_over_former_carrier());
        let lane = self.lanes.lane(self.view.pairs([publisher], over_layer));
        self.put(publisher.scope, Target::Layer { json: false }, lane);
        let lane = self.lanes.lane(self.view.pairs([publisher], self.view.own_layer_json()));
        self.put(publisher.scope, Target::Layer { json: true }, lane);
        self.send_to_other_groups(publisher, &[], previous);
    }

    /// What is on the own layer scope: to the own node and ROS 2 network, and what was born there,
    /// or on a node that is not on the inter scope, to every other group.
    fn read_layer(&mut self, previous: Option<&TopicPlan>) {
        for (to, own) in node_targets(self.view) {
            self.put_layer(to, own);
        }
        if let Some(own) = self.view.written_network() {
            self.put_layer(Target::Ros2, own);
        }
        if let (Some(born), Some(own)) =
            (self.view.own_layer_publisher(), self.view.own_layer_json())
            && self.view.converter_in(self.view.group) == Some(self.view.me)
        {
            let lane = self.lanes.lane(self.view.pairs([born], [own]));
            self.put(Scope::Layer, Target::Layer { json: true }, lane);
        }
        if self.view.owner() == Some(self.view.me) {
            self.carry_out(previous);
        }
    }

    fn put_layer(&mut self, to: Target, own: &Requester<'w>) {
        let sources = self.view.publishers_over_own_layer(own);
        let lane = self.lanes.lane(self.view.pairs(sources, [own]));
        let lane = lane.map(|lane| of_others(self.view, &to, lane));
        self.put(Scope::Layer, to, lane);
    }

    fn carry_out(&mut self, previous: Option<&TopicPlan>) {
        let relayed: Vec<_> = self.view.relayed_publishers().collect();
        let carried = self.view.own_layer_publisher().into_iter().chain(relayed.iter().copied());
        let Some(offer) = told::merge_offers(carried.map(|publisher| publisher.advertise)) else {
            return;
        };
        let publisher = Publisher {
            flow: self.view.me,
            group: self.view.group,
            scope: Scope::Layer,
            network: None,
            advertise: &offer,
        };
        let mut relays: Vec<FlowId> =
            relayed.iter().map(|publisher| publisher.flow.clone()).collect();
        // One may have services on its node and own writers, too.
        relays.dedup();
        self.send_to_other_groups(&publisher, &relays, previous);
    }

    /// What other groups publish, where their senders choose this flow.
    fn read_inter(&mut self) {
        let mut delivery = deliver(self.view, self.lanes);
        let mine: Vec<_> = self
            .view
            .publishers_outside()
            .filter(|publisher| self.view.may_receive(publisher))
            .collect();
        for (to, requesters) in local_targets(self.view) {
            if self.view.pairs(mine.iter().copied(), requesters).next().is_some() {
                let lane = delivery.remove(&to);
                self.put(Scope::Inter, to, lane);
            }
        }
    }

    /// One copy to one flow of each other group that asks for it.
    fn send_to_other_groups(
        &mut self,
        publisher: &Publisher<'_>,
        relays: &[FlowId],
        previous: Option<&TopicPlan>,
    ) {
        let kept: Vec<&FlowId> = previous
            .iter()
            .flat_map(|plan| &plan.bridges)
            .filter(|bridge| bridge.from == publisher.scope)
            .filter_map(|bridge| bridge.to.receiver())
            .collect();
        for (group, requesters) in self.view.requesters_outside() {
            let lane = self
                .lanes
                .lane(self.view.pairs([publisher], requesters.iter().copied()))
                .map(|lane| LaneSpec {
                    relays: relays.to_vec(),
                    held: publisher.is_of_flow() && self.view.enters(),
                    shared: match group {
                        Group::Shared(_, broker) => Some(broker),
                        Group::Alone(_) => None,
                    },
                    ..lane
                });
            let Some(receiver) = self.view.next_receiver(publisher, group, &kept) else {
                continue;
            };
            let target =
                Target::Inter { layer: receiver.layer.clone(), receiver: receiver.clone() };
            self.put(publisher.scope, target, lane);
        }
    }

    fn put(&mut self, from: Scope, to: Target, lane: Option<LaneSpec>) {
        if let Some(lane) = lane {
            self.bridges.insert((from, to), lane);
        }
    }
}
