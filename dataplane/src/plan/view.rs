//! The world as one topic sees it: publishers, requesters, and who of them matches whom.

mod access;
mod network;
mod successor;

use std::collections::{BTreeMap, BTreeSet};
use std::iter;
use std::sync::Arc;

use blaze_domain::node_file::TopicAccess;
use blaze_domain::{FlowId, LayerName, Scope, TopicName, WhyCode};

use super::network::{self as networks, Network, Networks};
use super::survey::Holder;
use super::{Blocked, Destination, Survey, rendezvous};
use crate::world::{
    Advertise, Carrying, FlowState, FlowView, LayerScopeId, OriginFilter, Part, Reach, Request,
    Role, TopicEntry, World,
};

/// Flows that reach each other over one layer broker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Group<'w> {
    /// All flows of the layer that use this broker.
    Shared(&'w LayerName, LayerScopeId),
    /// A flow without a layer broker.
    Alone(&'w FlowId),
}

impl<'w> Group<'w> {
    pub(crate) fn of(id: &'w FlowId, flow: &FlowView) -> Self {
        flow.layer_scope.map_or(Self::Alone(id), |scope| Self::Shared(&id.layer, scope))
    }
}

/// The services of one scope that advertise the topic, as one flow sees them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Publisher<'w> {
    pub(crate) flow: &'w FlowId,
    pub(crate) group: Group<'w>,
    pub(crate) scope: Scope,
    /// The ROS 2 network that the flow is on.
    pub(crate) network: Option<Network<'w>>,
    pub(crate) advertise: &'w Advertise,
}

/// The services of one scope that request the topic, as one flow sees them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Requester<'w> {
    pub(crate) flow: &'w FlowId,
    pub(crate) group: Group<'w>,
    pub(crate) scope: Scope,
    /// The ROS 2 network that the flow is on.
    pub(crate) network: Option<Network<'w>>,
    pub(crate) request: &'w Request,
}

/// Whether a request takes what a publisher offers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Pairing {
    Matches,
    OtherOrigin,
    OtherType,
}

impl Requester<'_> {
    pub(crate) fn destination(&self) -> Destination {
        match self.scope {
            Scope::Node | Scope::Ros2 | Scope::Inter => Destination::Flow(self.flow.clone()),
            Scope::Layer => Destination::Layer(self.flow.layer.clone()),
        }
    }
}

impl Publisher<'_> {
    /// Whether a request takes something of what is published here.
    pub(crate) fn pairing(&self, request: &Request) -> Pairing {
        if !request.from.is_empty() && !request.from.iter().any(|filter| self.has_origin(filter)) {
            Pairing::OtherOrigin
        } else if differ(&self.advertise.type_name, &request.type_name)
            || differ(&self.advertise.type_hash, &request.type_hash)
        {
            Pairing::OtherType
        } else {
            Pairing::Matches
        }
    }

    pub(super) fn matches(&self, requester: &Requester<'_>) -> bool {
        self.pairing(requester.request) == Pairing::Matches
    }

    /// Whether it is on one flow alone: on its node, or a writer that it owns.
    pub(crate) fn is_of_flow(&self) -> bool {
        matches!(self.scope, Scope::Node | Scope::Ros2)
    }

    /// Whether the requester is a network that the flow of the publisher is on, too: what it does
    /// not publish there itself, that flow writes.
    pub(crate) fn shares_network(&self, requester: &Requester<'_>) -> bool {
        requester.scope == Scope::Ros2
            && self.is_of_flow()
            && self.network.is_some()
            && self.network == requester.network
    }

    /// Whether other flows than that of the publisher may have a part in serving the requester.
    fn serves(&self, requester: &Requester<'_>) -> bool {
        self.matches(requester) && !self.shares_network(requester)
    }

    fn has_origin(&self, filter: &OriginFilter) -> bool {
        if self.scope == Scope::Inter {
            // A gateway does not say which layers it speaks for; what comes is looked at one by
            // one.
            return true;
        }
        let part = |wanted: &Option<String>, found: &str| {
            wanted.as_deref().is_none_or(|wanted| wanted == found)
        };
        if !part(&filter.layer, self.flow.layer.as_str()) {
            return false;
        }
        let on_node = self.is_of_flow();
        if on_node && !part(&filter.node, self.flow.node.as_str()) {
            return false;
        }
        self.advertise.more_sources
            || self.advertise.sources.iter().any(|source| {
                part(&filter.service, &source.service)
                    && (on_node || part(&filter.node, &source.node))
            })
    }
}

/// Both are given and not the same.
fn differ(a: &str, b: &str) -> bool {
    !a.is_empty() && !b.is_empty() && a != b
}

/// Publishers and requesters of one topic.
pub(crate) struct TopicView<'w> {
    world: &'w World,
    topic: &'w TopicName,
    pub(crate) me: &'w FlowId,
    pub(crate) group: Group<'w>,
    /// Of flows that carry topics.
    pub(crate) publishers: Vec<Publisher<'w>>,
    /// Of flows that carry topics.
    pub(crate) requesters: Vec<Requester<'w>>,
    /// The same that the own rules refuse. Other flows do not know that.
    pub(crate) refused: Vec<Requester<'w>>,
    /// Of flows that are down.
    lost_requesters: Vec<Requester<'w>>,
    /// Flows whose layer broker does not answer them.
    away: Vec<&'w FlowId>,
    /// What the own rules say of the topic.
    access: TopicAccess,
    /// Whether this flow is on the inter scope.
    role: Role,
    /// Flows of the own group that are on the inter scope for it and carry topics.
    gateways: Arc<[&'w FlowId]>,
    /// Flows of the own group that are not.
    members: Arc<BTreeSet<&'w FlowId>>,
    /// ROS 2 networks with their flows.
    networks: Arc<Networks<'w>>,
    /// Flows that have to do with the topic.
    holders: Vec<Holder<'w>>,
}

impl<'w> TopicView<'w> {
    /// `None` if the world does not hold its own flow.
    pub(crate) fn new(world: &'w World, topic: &'w TopicName) -> Option<Self> {
        Self::within(&Survey::new(world), topic)
    }

    /// The same where what topics have in common is known.
    pub(super) fn within(survey: &Survey<'w>, topic: &'w TopicName) -> Option<Self> {
        let world = survey.world;
        let (me, own) = world.flows.get_key_value(&world.me)?;
        let mut view = Self {
            world,
            topic,
            me,
            group: Group::of(me, own),
            publishers: Vec::new(),
            requesters: Vec::new(),
            refused: Vec::new(),
            lost_requesters: Vec::new(),
            away: Vec::new(),
            access: world.access.of(topic),
            role: own.role,
            gateways: Arc::clone(&survey.gateways),
            members: Arc::clone(&survey.members),
            networks: Arc::clone(&survey.networks),
            holders: survey.find(topic),
        };
        for at in 0..view.holders.len() {
            let Holder { id, flow, entry } = view.holders[at];
            if let Some(entry) = entry {
                view.add(id, flow, entry);
            }
        }
        Some(view)
    }

    fn add(&mut self, flow: &'w FlowId, view: &'w FlowView, entry: &'w TopicEntry) {
        if view.layer_away {
            self.away.push(flow);
        }
        let group = Group::of(flow, view);
        if group != self.group && !self.role.is_inside() {
            // Only a gateway knows what flows outside want, and says it.
            return;
        }
        let node = view.node_scope.then_some((Scope::Node, &entry.node));
        let layer = view.layer_scope.map(|_| (Scope::Layer, &entry.layer));
        let network = Network::of(flow, view);
        let ros2 = network.map(|_| (Scope::Ros2, &entry.ros2));
        // A flow knows that it lives; what it is told of itself does not count.
        let reachable = view.reach != Reach::Down || flow == self.me;
        let carries = reachable && view.state == FlowState::Ready;
        let behind = flow != self.me
            && group == self.group
            && view.role.is_gateway()
            && !self.role.is_gateway();
        let outside = (behind && carries).then_some((Scope::Inter, &entry.outside));
        // A call from a node is for the flow of its server, also of one on the own network.
        let of_service = networks::is_of_service(self.topic);
        for (scope, entry) in node.into_iter().chain(layer).chain(ros2).chain(outside) {
            if let Some(advertise) = entry.advertise.as_ref().filter(|_| carries) {
                let network = network.filter(|_| scope != Scope::Node || !of_service);
                self.publishers.push(Publisher { flow, group, scope, network, advertise });
            }
            // All flows of a network say the same of its readers: only the one that writes counts.
            let counts = scope != Scope::Ros2 || !carries || self.writes(flow, network);
            if let Some(request) = entry.request.as_ref().filter(|_| counts) {
                let requester = Requester { flow, group, scope, network, request };
                if carries && self.may_request(&requester) {
                    self.requesters.push(requester);
                } else if carries {
                    self.refused.push(requester);
                } else if !reachable {
                    self.lost_requesters.push(requester);
                }
            }
        }
    }

    pub(crate) fn own_node_publisher(&self) -> Option<&Publisher<'w>> {
        self.publishers
            .iter()
            .find(|publisher| publisher.flow == self.me && publisher.scope == Scope::Node)
    }

    pub(crate) fn own_layer_publisher(&self) -> Option<&Publisher<'w>> {
        self.publishers
            .iter()
            .find(|publisher| publisher.flow == self.me && publisher.scope == Scope::Layer)
    }

    pub(crate) fn own_node_requester(&self) -> Option<&Requester<'w>> {
        self.requesters
            .iter()
            .find(|requester| requester.flow == self.me && requester.scope == Scope::Node)
    }

    /// The services of the own layer scope, if they want JSON.
    pub(crate) fn own_layer_json(&self) -> Option<&Requester<'w>> {
        self.requesters.iter().find(|requester| {
            (requester.flow, requester.scope) == (self.me, Scope::Layer) && requester.request.json
        })
    }

    /// The flow of a group that makes JSON of what services of the layer scope publish, for others
    /// there.
    pub(crate) fn converter_in(&self, group: Group<'w>) -> Option<&'w FlowId> {
        let able = |(id, view): &(&'w FlowId, &'w FlowView)| {
            self.world.carries(id) && Group::of(id, view) == group
        };
        let flows = self.world.flows.iter().filter(able);
        rendezvous::choose(self.topic.as_str(), flows.map(|(id, _)| id))
    }

    /// Everybody whom a message reaches that this flow writes to its layer scope: services there,
    /// other flows' services.
    pub(crate) fn requesters_over_own_layer(&self) -> impl Iterator<Item = &Requester<'w>> + Clone {
        let of_layer = |requester: &Requester<'_>| match requester.scope {
            Scope::Layer => requester.request.framed,
            Scope::Node | Scope::Ros2 => requester.flow != self.me,
            Scope::Inter => false,
        };
        self.requesters
            .iter()
            .filter(move |requester| requester.group == self.group && of_layer(requester))
    }

    /// Flows of the own group that are on the inter scope for it and carry topics.
    pub(crate) fn gateways(&self) -> &[&'w FlowId] {
        &self.gateways
    }

    /// Whether this flow is not on the inter scope, and no other flow is for it.
    pub(crate) fn lacks_gateway(&self) -> bool {
        self.role == Role::Member && self.gateways.is_empty()
    }

    /// Requesters of other groups, as gateways say, of which this flow is none: what it writes to
    /// its layer scope reaches them.
    pub(crate) fn requesters_over_gateways(&self) -> impl Iterator<Item = &Requester<'w>> + Clone {
        self.requesters.iter().filter(|requester| requester.scope == Scope::Inter)
    }

    /// Whether this flow has been on the inter scope since a moment only: another one still carries
    /// for it.
    pub(crate) fn enters(&self) -> bool {
        self.role == Role::NewGateway
    }

    /// Requesters of other groups whom another flow still reaches for this one, if this one has
    /// been on the inter scope since a moment only.
    pub(crate) fn requesters_over_former_carrier(
        &self,
    ) -> impl Iterator<Item = &Requester<'w>> + Clone {
        let enters = self.enters();
        self.requesters.iter().filter(move |requester| enters && requester.group != self.group)
    }

    /// Publishers on nodes of flows that are not on the inter scope, or were not until a moment
    /// ago: what they write to the layer scope is carried out of it. What this flow wrote there
    /// itself it does not carry.
    pub(crate) fn relayed_publishers(&self) -> impl Iterator<Item = &Publisher<'w>> {
        // Of a thousand publishers hardly any is of the own group, so that is asked first.
        let relayed = |publisher: &&Publisher<'w>| {
            let view = || self.world.flows.get(publisher.flow);
            publisher.is_of_flow()
                && publisher.group == self.group
                && !(publisher.flow == self.me && self.enters())
                && view().is_some_and(|view| view.role != Role::Gateway)
        };
        self.publishers.iter().filter(relayed)
    }

    /// Whose messages reach the layer scope without this flow, given that its own node asks for
    /// them.
    ///
    /// A publisher outside counts if another flow could be its receiver, even where this one would
    /// be chosen: its sender may stay with an earlier choice that only it knows.
    pub(crate) fn publishers_over_own_layer(
        &self,
        own: &Requester<'w>,
    ) -> impl Iterator<Item = &Publisher<'w>> {
        self.publishers.iter().filter(move |publisher| {
            if publisher.group == self.group {
                publisher.scope == Scope::Layer || publisher.flow != self.me
            } else {
                publisher.serves(own)
                    && self.candidates(publisher, self.group).any(|flow| flow != self.me)
            }
        })
    }

    /// Publishers that only the inter scope connects with this flow.
    pub(crate) fn publishers_outside(&self) -> impl Iterator<Item = &Publisher<'w>> {
        self.publishers.iter().filter(|publisher| publisher.group != self.group)
    }

    /// Requesters that only the inter scope connects with this flow, by group.
    pub(crate) fn requesters_outside(&self) -> BTreeMap<Group<'w>, Vec<&Requester<'w>>> {
        let mut groups: BTreeMap<_, Vec<_>> = BTreeMap::new();
        for requester in self.requesters.iter().filter(|requester| requester.group != self.group) {
            groups.entry(requester.group).or_default().push(requester);
        }
        groups
    }

    /// The pairs that match, of all publishers with all requesters.
    pub(crate) fn pairs<'p>(
        &self,
        publishers: impl IntoIterator<Item = &'p Publisher<'w>>,
        requesters: impl IntoIterator<Item = &'p Requester<'w>, IntoIter: Clone>,
    ) -> impl Iterator<Item = (&'p Publisher<'w>, &'p Requester<'w>)>
    where
        'w: 'p,
    {
        let requesters = requesters.into_iter();
        publishers.into_iter().flat_map(move |publisher| {
            let matching = requesters.clone().filter(move |requester| publisher.serves(requester));
            matching.map(move |requester| (publisher, requester))
        })
    }

    /// The flows of a group that could take in what the publisher sends: those with a requester of
    /// their own for it, on their node scope or on the layer scope that they share.
    pub(crate) fn candidates<'p>(
        &'p self,
        publisher: &'p Publisher<'w>,
        group: Group<'w>,
    ) -> impl Iterator<Item = &'w FlowId> + use<'p, 'w> {
        let known = self.requesters.iter().chain(self.refused_elsewhere(publisher, group));
        let in_group = known.filter(move |requester| {
            requester.group == group
                && requester.scope != Scope::Inter
                && publisher.serves(requester)
        });
        let behind = |requester: &&Requester<'w>| self.members.contains(requester.flow);
        // For those that are not on the inter scope any gateway can: it writes to the layer scope
        // for them.
        let for_members =
            group == self.group && in_group.clone().any(|requester| behind(&requester));
        let leaving = iter::once(self.me).filter(|_| self.role == Role::Leaving);
        let gateways = self.gateways.iter().copied().chain(leaving);
        in_group
            .filter(move |requester| !behind(requester))
            .map(|requester| requester.flow)
            .chain(gateways.filter(move |_| for_members))
    }

    /// Those of the candidates whose layer broker answers them; all of them where that is so for
    /// none.
    fn able_candidates<'p>(
        &'p self,
        publisher: &'p Publisher<'w>,
        group: Group<'w>,
    ) -> impl Iterator<Item = &'w FlowId> + use<'p, 'w> {
        // Of hardly any topic there is one.
        let some = !self.away.is_empty()
            && self.candidates(publisher, group).any(|flow| !self.away.contains(&flow));
        self.candidates(publisher, group).filter(move |flow| !some || !self.away.contains(flow))
    }

    /// The flow of a group that gets what the publisher sends: one of `kept` if it still could,
    /// else by rendezvous.
    pub(crate) fn receiver(
        &self,
        publisher: &Publisher<'w>,
        group: Group<'w>,
        kept: &[&FlowId],
    ) -> Option<&'w FlowId> {
        self.able_candidates(publisher, group).find(|candidate| kept.contains(candidate)).or_else(
            || rendezvous::choose(self.topic.as_str(), self.able_candidates(publisher, group)),
        )
    }

    /// The same for the sender, who leaves the one of `kept` for a better one that has settled.
    pub(crate) fn next_receiver(
        &self,
        publisher: &Publisher<'w>,
        group: Group<'w>,
        kept: &[&FlowId],
    ) -> Option<&'w FlowId> {
        let held = self.receiver(publisher, group, kept)?;
        let able = |candidate: &&FlowId| *candidate == held || self.is_settled(candidate);
        rendezvous::choose(self.topic.as_str(), self.able_candidates(publisher, group).filter(able))
    }

    /// Whether this flow may get what a publisher outside sends: its sender says so, or would
    /// choose it.
    pub(crate) fn may_receive(&self, publisher: &Publisher<'w>) -> bool {
        if !self.candidates(publisher, self.group).any(|flow| flow == self.me) {
            return false;
        }
        let says_so = || {
            let part = self.part_of(publisher.flow);
            part.is_some_and(|part| part.more_receivers || part.receivers.contains(self.me))
        };
        self.receiver(publisher, self.group, &[]) == Some(self.me) || says_so()
    }

    fn part_of(&self, flow: &FlowId) -> Option<&'w Part> {
        self.world.flows.get(flow)?.parts.get(self.topic)
    }

    fn is_settled(&self, flow: &FlowId) -> bool {
        let view = self.world.flows.get(flow);
        // What a flow wrote to the layer scope before it was a gateway it does not carry out
        // itself.
        view.is_some_and(|view| view.settled && view.role != Role::NewGateway)
    }

    /// The flow of the own group that carries what is published on the layer scope to other groups.
    pub(crate) fn owner(&self) -> Option<&'w FlowId> {
        self.owner_in(self.group)
    }

    /// The same of any group.
    ///
    /// Whoever carries the topic stays until it gives it up: only this flow itself gives up what it
    /// carries, to the one that it chose by load, to a better one that has settled, or to the
    /// better one of two that both do. Of a flow that is going away its word is awaited, where the
    /// next one begins.
    pub(crate) fn owner_in(&self, group: Group<'w>) -> Option<&'w FlowId> {
        let of_group = |publisher: &&Publisher<'_>| {
            publisher.group == group && publisher.scope == Scope::Layer
        };
        let own = group == self.group;
        let relays = own && self.relayed_publishers().next().is_some();
        let able = || {
            let there = self.publishers.iter().filter(of_group).map(|publisher| publisher.flow);
            there
                .filter(|flow| !own || self.gateways.contains(flow))
                .chain(self.gateways.iter().copied().filter(|_| relays))
        };
        let choose = |flows: &mut dyn Iterator<Item = &'w FlowId>| {
            rendezvous::choose(self.topic.as_str(), flows)
        };
        let current = choose(&mut able().filter(|flow| self.carries_out(flow)));
        match current {
            Some(current) if current == self.me => self.successor(able()),
            Some(current) => Some(current),
            None if self.leaving_carrier(group).is_some() => None,
            None => self.given_to(group, able()).or_else(|| choose(&mut able())),
        }
    }

    /// Whether a flow says that it carries the topic out of its layer.
    fn carries_out(&self, flow: &FlowId) -> bool {
        self.part_of(flow).is_some_and(|part| part.carrying == Carrying::Carries)
    }

    /// A flow of a group that is going away, or is no gateway any more, and has not said yet where
    /// the next one begins.
    fn leaving_carrier(&self, group: Group<'w>) -> Option<&'w FlowId> {
        let leaving = |Holder { id, flow, .. }: &&Holder<'w>| {
            (flow.state == FlowState::Draining || !flow.role.is_gateway())
                && flow.reach != Reach::Down
                && *id != self.me
                && Group::of(id, flow) == group
        };
        let mut flows = self.holders.iter().filter(leaving).map(|holder| holder.id);
        flows.find(|id| self.carries_out(id))
    }

    /// The other flow of the own group that carries what is published on the layer scope to other
    /// groups, or is to; where nobody there wants it, nobody.
    pub(crate) fn other_carrier(&self) -> Option<FlowId> {
        let on_layer = |publisher: &&Publisher<'_>| {
            publisher.group == self.group && publisher.scope == Scope::Layer
        };
        let is_outside = |requester: &&Requester<'_>| {
            requester.group != self.group || requester.scope == Scope::Inter
        };
        // Another flow does not know whom this one refuses.
        let outside = || self.requesters.iter().chain(&self.refused).filter(is_outside);
        let published = self.publishers.iter().filter(on_layer).chain(self.relayed_publishers());
        self.pairs(published, outside()).next()?;
        self.owner().filter(|owner| *owner != self.me).cloned()
    }

    /// Requests that this flow or its publishers have a part in and that are not served.
    pub(crate) fn blocked(&self) -> Vec<Blocked> {
        let mut blocked = BTreeSet::new();
        let carried = |publisher: &&Publisher<'w>| match publisher.scope {
            Scope::Node | Scope::Ros2 | Scope::Inter => publisher.flow == self.me,
            Scope::Layer => publisher.flow == self.me && self.owner() == Some(self.me),
        };
        let sent: Vec<_> = self.publishers.iter().filter(carried).collect();
        for requester in &self.requesters {
            let own = requester.flow == self.me;
            let parts = self.publishers.iter().filter(|publisher| own || carried(publisher));
            for publisher in parts.filter(|publisher| !meets_directly(publisher, requester)) {
                if publisher.pairing(requester.request) == Pairing::OtherType {
                    blocked.insert((
                        requester.destination(),
                        WhyCode::TypeMismatch,
                        type_detail(publisher, requester),
                    ));
                }
            }
            let other_origin = |publisher: &Publisher<'_>| {
                publisher.pairing(requester.request) == Pairing::OtherOrigin
            };
            if (own || !sent.is_empty())
                && !self.publishers.is_empty()
                && self.publishers.iter().all(other_origin)
            {
                let detail = format!(
                    "none of {} publishing scopes has an origin that it asks for",
                    self.publishers.len()
                );
                blocked.insert((requester.destination(), WhyCode::NoMatchingOrigin, detail));
            }
        }
        for requester in &self.lost_requesters {
            let wanted = sent
                .iter()
                .any(|publisher| publisher.group != requester.group && publisher.serves(requester));
            // A layer scope has other flows to reach it by; if it has none, nobody says that it is
            // still there.
            if wanted && requester.scope == Scope::Node {
                blocked.insert((
                    requester.destination(),
                    WhyCode::PeerDown,
                    format!("{} is down", requester.flow),
                ));
            }
        }
        let denied = self.denied().into_iter();
        blocked.extend(denied.map(|(to, detail)| (to, WhyCode::AccessDenied, detail)));
        let entry = |(to, code, detail)| Blocked { to, code, detail };
        let mut blocked: Vec<_> = blocked.into_iter().map(entry).collect();
        blocked.dedup_by(|next, kept| next.to == kept.to && next.code == kept.code);
        blocked
    }
}

/// Whether the services share a scope, so that no flow is between them (a bare copy is made by
/// one).
pub(crate) fn meets_directly(publisher: &Publisher<'_>, requester: &Requester<'_>) -> bool {
    publisher.scope == requester.scope
        && match publisher.scope {
            Scope::Node | Scope::Inter => {
                publisher.flow == requester.flow
                    && !requester.request.bare
                    && !requester.request.json
            }
            Scope::Layer => publisher.group == requester.group && !requester.request.json,
            Scope::Ros2 => publisher.shares_network(requester),
        }
}

pub(crate) fn type_detail(publisher: &Publisher<'_>, requester: &Requester<'_>) -> String {
    let (offer, ask) = (publisher.advertise, requester.request);
    let (offered, asked) = if differ(&offer.type_name, &ask.type_name) {
        (&offer.type_name, &ask.type_name)
    } else {
        (&offer.type_hash, &ask.type_hash)
    };
    format!("{} advertises {offered}, {} requests {asked}", publisher.flow, requester.flow)
}
