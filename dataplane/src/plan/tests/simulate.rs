//! One message through all plans, by the rules of scopes and flows alone; it knows nothing of how
//! plans are made.
//!
//! A scope gives what is written to it to its services and to every flow that reads it. A flow that
//! reads back what it wrote drops it as an echo. Everything else that a flow or a scope sees twice
//! is a fault here, although real flows drop repeats.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use blaze_domain::{FlowId, Scope};

use super::generate::{System, share_broker};
use super::worlds::topic;
use crate::plan::{LaneSpec, PlanRules, Target, TopicPlan, delivery};
use crate::world::{Advertise, FlowState, FlowView, Reach, Request, ScopeEntry, Source};

/// Something that services attach to. A layer scope is named by the first flow that uses it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Place {
    Node(FlowId),
    Bare(FlowId),
    Layer(FlowId),
}

/// One message of one service.
#[derive(Debug)]
struct Message {
    born: Place,
    layer: String,
    source: Source,
    type_name: String,
}

/// A bridge: the flow that has it, its source and its target.
type BridgeKey = (FlowId, Scope, Target);

/// A message on its way to a place.
struct Copy {
    place: Place,
    writer: Option<FlowId>,
    hops: u32,
    crossed: bool,
    trail: Vec<BridgeKey>,
}

/// How a flow treats a message from the inter scope.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Intake {
    /// By its bridges alone: all flows planned without a past.
    Bridges,
    /// As its data path does: whatever is addressed to it.
    Delivery,
}

pub(super) struct Simulation<'a> {
    system: &'a System,
    plans: &'a BTreeMap<FlowId, TopicPlan>,
    intake: Intake,
    useful: BTreeSet<BridgeKey>,
    /// Messages that reached a requester over a bridge.
    pub(super) carried: usize,
    /// Messages that a gateway sent to another group for a flow that is not on the inter scope.
    pub(super) relayed: usize,
}

pub(super) fn is_live(view: &FlowView) -> bool {
    view.state == FlowState::Ready && view.reach != Reach::Down
}

fn wants(request: &Request, message: &Message) -> bool {
    let same_type = [&request.type_name, &message.type_name].iter().any(|name| name.is_empty())
        || request.type_name == message.type_name;
    same_type && wants_origin(request, message)
}

fn wants_origin(request: &Request, message: &Message) -> bool {
    let matches = |layer: &str| {
        let mut filters = request.from.iter();
        filters.any(|filter| filter.matches(layer, &message.source.node, &message.source.service))
    };
    request.from.is_empty() || matches(&message.layer)
}

impl<'a> Simulation<'a> {
    pub(super) fn new(
        system: &'a System,
        plans: &'a BTreeMap<FlowId, TopicPlan>,
        intake: Intake,
    ) -> Self {
        Self { system, plans, intake, useful: BTreeSet::new(), carried: 0, relayed: 0 }
    }

    /// Sends one message of each service that publishes, then looks for bridges that did nothing.
    pub(super) fn run(&mut self) -> Result<(), String> {
        for message in self.messages() {
            self.send(&message).map_err(|fault| format!("{fault}\nmessage {message:?}"))?;
        }
        if self.intake == Intake::Bridges {
            self.check_needless()?;
        }
        Ok(())
    }

    fn flows(&self) -> impl Iterator<Item = (&'a FlowId, &'a FlowView)> + use<'a> {
        self.system.world.flows.iter()
    }

    fn view(&self, id: &FlowId) -> &'a FlowView {
        &self.system.world.flows[id]
    }

    fn layer_of(&self, id: &FlowId) -> Option<Place> {
        let scope = self.view(id).layer_scope;
        scope?;
        let mut sharing = self
            .flows()
            .filter(|(other, view)| share_broker((id, scope), (other, view.layer_scope)));
        sharing.next().map(|(first, _)| Place::Layer(first.clone()))
    }

    /// All places with what their services say.
    fn places(&self) -> Vec<(Place, &'a ScopeEntry)> {
        let mut places = Vec::new();
        for (id, view) in self.flows() {
            let Some(entry) = view.topics.get(&topic()) else {
                continue;
            };
            if view.node_scope {
                places.push((Place::Node(id.clone()), &entry.node));
            }
            if self.layer_of(id) == Some(Place::Layer(id.clone())) {
                places.push((Place::Layer(id.clone()), &entry.layer));
            }
        }
        places
    }

    fn messages(&self) -> Vec<Message> {
        let mut messages = Vec::new();
        for (place, entry) in self.places() {
            let Some(advertise) = &entry.advertise else { continue };
            let (flow, node) = match &place {
                Place::Node(flow) | Place::Bare(flow) => (flow, Some(flow.node.as_str())),
                Place::Layer(flow) => (flow, None),
            };
            messages.extend(self.messages_of(&place, flow, node, advertise));
        }
        messages
    }

    fn messages_of(
        &self,
        place: &Place,
        flow: &FlowId,
        node: Option<&str>,
        advertise: &Advertise,
    ) -> Vec<Message> {
        let message = |source| Message {
            born: place.clone(),
            layer: flow.layer.to_string(),
            source,
            type_name: advertise.type_name.clone(),
        };
        self.system.sources(advertise, node).into_iter().map(message).collect()
    }

    /// Flows that read a place.
    fn readers(&self, place: &Place) -> Vec<&'a FlowId> {
        let reads = |id: &FlowId| match place {
            Place::Node(flow) => id == flow,
            Place::Bare(_) => false,
            Place::Layer(_) => self.layer_of(id).as_ref() == Some(place),
        };
        self.flows().filter(|(id, view)| is_live(view) && reads(id)).map(|(id, _)| id).collect()
    }

    fn send(&mut self, message: &Message) -> Result<(), String> {
        let mut arrived: BTreeMap<Place, bool> = BTreeMap::new();
        let mut seen: BTreeSet<FlowId> = BTreeSet::new();
        let mut queue = VecDeque::from([Copy {
            place: message.born.clone(),
            writer: None,
            hops: 0,
            crossed: false,
            trail: Vec::new(),
        }]);
        while let Some(copy) = queue.pop_front() {
            if arrived.insert(copy.place.clone(), copy.writer.is_some()).is_some() {
                return Err(format!("{:?} got it twice, last from {:?}", copy.place, copy.writer));
            }
            self.arrive(message, &copy)?;
            for flow in self.readers(&copy.place) {
                if copy.writer.as_ref() == Some(flow) {
                    continue;
                }
                if !self.reads(flow, &copy.place) {
                    continue;
                }
                if !seen.insert(flow.clone()) {
                    return Err(format!("{flow} took it in twice, last from {:?}", copy.place));
                }
                self.bridge(message, flow, &copy, &mut seen, &mut queue)?;
            }
        }
        self.check_served(message, &arrived)
    }

    /// Whether a flow has a bridge that reads the place.
    fn reads(&self, flow: &FlowId, place: &Place) -> bool {
        let scope = scope_of(place);
        self.plans[flow].bridges.iter().any(|bridge| bridge.from == scope)
    }

    /// A flow that read a message passes it on.
    fn bridge(
        &mut self,
        message: &Message,
        flow: &FlowId,
        copy: &Copy,
        seen: &mut BTreeSet<FlowId>,
        queue: &mut VecDeque<Copy>,
    ) -> Result<(), String> {
        let scope = scope_of(&copy.place);
        let plans = self.plans;
        for bridge in plans[flow].bridges.iter().filter(|bridge| bridge.from == scope) {
            if !carries(&bridge.lane, message) {
                continue;
            }
            let mut trail = copy.trail.clone();
            trail.push((flow.clone(), scope, bridge.to.clone()));
            let Target::Inter { layer, receiver } = &bridge.to else {
                queue.push_back(self.written(flow, &bridge.to, copy, trail)?);
                continue;
            };
            if scope == Scope::Layer && copy.hops > 0 {
                let relayed =
                    copy.hops == 1 && bridge.lane.relays(&message.layer, &message.source.node);
                if !relayed {
                    continue;
                }
                self.relayed += 1;
            }
            if copy.crossed || receiver == flow || *layer != receiver.layer {
                return Err(format!(
                    "{flow} sends it on to {receiver} (crossed before: {})",
                    copy.crossed
                ));
            }
            if !is_live(self.view(receiver)) {
                return Err(format!("{flow} sends to {receiver}, which carries nothing"));
            }
            if !seen.insert(receiver.clone()) {
                return Err(format!("{receiver} took it in twice, last from {flow}"));
            }
            let crossed = Copy {
                place: copy.place.clone(),
                writer: None,
                hops: copy.hops + 1,
                crossed: true,
                trail,
            };
            for (target, lane) in self.intake(receiver) {
                if carries(&lane, message) {
                    let mut trail = crossed.trail.clone();
                    trail.push((receiver.clone(), Scope::Inter, target.clone()));
                    queue.push_back(self.written(receiver, &target, &crossed, trail)?);
                }
            }
        }
        Ok(())
    }

    /// What a flow does with a message from the inter scope.
    fn intake(&self, receiver: &FlowId) -> Vec<(Target, LaneSpec)> {
        let bridges = self.plans[receiver].bridges.iter();
        let bridges = bridges.filter(|bridge| bridge.from == Scope::Inter);
        if self.intake == Intake::Bridges {
            return bridges.map(|bridge| (bridge.to.clone(), bridge.lane.clone())).collect();
        }
        let delivery = delivery(&self.system.known_to(receiver), &topic(), &PlanRules::default());
        let framed = delivery.node_framed.map(|lane| (Target::Node { bare: false }, lane));
        let bare = delivery.node_bare.map(|lane| (Target::Node { bare: true }, lane));
        let layer = delivery.layer.map(|lane| (Target::Layer, lane));
        framed.into_iter().chain(bare).chain(layer).collect()
    }

    fn written(
        &self,
        flow: &FlowId,
        target: &Target,
        copy: &Copy,
        trail: Vec<BridgeKey>,
    ) -> Result<Copy, String> {
        let place = match target {
            Target::Node { .. } if !self.view(flow).node_scope => {
                return Err(format!("{flow} has no node scope"));
            }
            Target::Node { bare: false } => Place::Node(flow.clone()),
            Target::Node { bare: true } => Place::Bare(flow.clone()),
            Target::Layer => {
                self.layer_of(flow).ok_or_else(|| format!("{flow} has no layer scope"))?
            }
            Target::Inter { .. } => return Err(format!("{flow} goes from inter to inter")),
        };
        Ok(Copy {
            place,
            writer: Some(flow.clone()),
            hops: copy.hops + 1,
            crossed: copy.crossed,
            trail,
        })
    }

    /// A copy reaches a place: somebody there, or behind it, must have asked for its origin.
    fn arrive(&mut self, message: &Message, copy: &Copy) -> Result<(), String> {
        let here = self.requests_at(&copy.place);
        if here.iter().any(|request| wants(request, message)) {
            self.useful.extend(copy.trail.iter().cloned());
            self.carried += usize::from(!copy.trail.is_empty());
        }
        let mut asked = here;
        if matches!(copy.place, Place::Layer(_)) {
            let readers = self
                .readers(&copy.place)
                .into_iter()
                .filter(|flow| copy.writer.as_ref() != Some(flow));
            asked.extend(readers.flat_map(|flow| self.node_requests(flow)));
            // Who is not on the inter scope writes for other groups, too.
            let apart = |flow: &FlowId| !self.view(flow).role.is_inside();
            if copy.writer.as_ref().is_some_and(apart) {
                let all = self.places().into_iter();
                asked.extend(all.filter_map(|(_, entry)| entry.request.as_ref()));
            }
        }
        if copy.writer.is_some() && !asked.iter().any(|request| wants_origin(request, message)) {
            return Err(format!(
                "{:?} wrote to {:?}, where nobody asked for it",
                copy.writer, copy.place
            ));
        }
        Ok(())
    }

    fn node_requests(&self, flow: &FlowId) -> Vec<&'a Request> {
        let framed = self.requests_at(&Place::Node(flow.clone()));
        framed.into_iter().chain(self.requests_at(&Place::Bare(flow.clone()))).collect()
    }

    fn requests_at(&self, place: &Place) -> Vec<&'a Request> {
        let all = self.places();
        let node = match place {
            Place::Node(flow) | Place::Bare(flow) => Place::Node(flow.clone()),
            Place::Layer(flow) => Place::Layer(flow.clone()),
        };
        let requests = all
            .into_iter()
            .filter(|(other, _)| *other == node)
            .filter_map(|(_, entry)| entry.request.as_ref());
        let fits = |request: &&Request| match place {
            Place::Node(_) => request.framed,
            Place::Bare(_) => request.bare,
            Place::Layer(_) => true,
        };
        requests.filter(fits).collect()
    }

    /// Whether the message can leave the scope where it was born for the flow or the layer that
    /// asks.
    fn can_reach(&self, born: &Place, to: &Place) -> bool {
        let (Place::Node(to_flow) | Place::Bare(to_flow) | Place::Layer(to_flow)) = to;
        let live = |id: &FlowId| is_live(self.view(id));
        let to_live = match to {
            Place::Node(_) | Place::Bare(_) => live(to_flow),
            Place::Layer(_) => !self.readers(to).is_empty(),
        };
        let joined = |place: &Place| {
            let (Place::Node(flow) | Place::Bare(flow) | Place::Layer(flow)) = place;
            let layer = self.layer_of(flow);
            let inside = |id: &FlowId| live(id) && self.view(id).role.is_inside();
            let mut flows = self.flows().map(|(id, _)| id);
            flows.any(|id| {
                inside(id) && (id == flow || (layer.is_some() && self.layer_of(id) == layer))
            })
        };
        let one_group = self.group_of(born) == self.group_of(to);
        born == to
            || (!self.readers(born).is_empty()
                && to_live
                && (one_group || (joined(born) && joined(to))))
    }

    /// The layer scope that a place belongs to, or the flow that has none.
    fn group_of(&self, place: &Place) -> Place {
        let (Place::Node(flow) | Place::Bare(flow) | Place::Layer(flow)) = place;
        self.layer_of(flow).unwrap_or_else(|| Place::Node(flow.clone()))
    }

    /// Every request that matches was served once.
    fn check_served(
        &self,
        message: &Message,
        arrived: &BTreeMap<Place, bool>,
    ) -> Result<(), String> {
        for (place, entry) in self.places() {
            let Some(request) = &entry.request else { continue };
            if !wants(request, message) {
                continue;
            }
            let targets = match &place {
                Place::Node(flow) => {
                    let framed = request.framed.then(|| place.clone());
                    framed
                        .into_iter()
                        .chain(request.bare.then(|| Place::Bare(flow.clone())))
                        .collect()
                }
                Place::Bare(_) | Place::Layer(_) => vec![place.clone()],
            };
            for target in targets {
                if self.can_reach(&message.born, &target) && !arrived.contains_key(&target) {
                    return Err(format!("{target:?} did not get it"));
                }
            }
        }
        Ok(())
    }

    /// Every bridge carried something towards a requester, or waits beside an intake that a sender
    /// could move away.
    fn check_needless(&self) -> Result<(), String> {
        for (flow, plan) in self.plans {
            for bridge in &plan.bridges {
                let key = (flow.clone(), bridge.from, bridge.to.clone());
                if !self.useful.contains(&key) && !self.stands_by(flow, bridge.from, &bridge.to) {
                    return Err(format!(
                        "{flow} has a needless bridge {:?} to {:?}",
                        bridge.from, bridge.to
                    ));
                }
            }
        }
        Ok(())
    }

    /// A bridge from the layer to the node of a flow that takes the same from the inter scope,
    /// while another flow of the layer asks for something of the same publishing scope too, so that
    /// its sender may have chosen that one.
    fn stands_by(&self, flow: &FlowId, from: Scope, to: &Target) -> bool {
        if !self.view(flow).role.is_inside() && (from == Scope::Layer || *to == Target::Layer) {
            // It is not told which origins there are outside.
            return true;
        }
        let takes_it = self.useful.contains(&(flow.clone(), Scope::Inter, to.clone()));
        let Some(layer) = self.layer_of(flow).filter(|_| from == Scope::Layer && takes_it) else {
            return false;
        };
        let messages = self.messages();
        let wanted = |requests: &[&Request], from: &Place| {
            let mut sent = messages.iter().filter(|message| message.born == *from);
            sent.any(|message| requests.iter().any(|request| wants(request, message)))
        };
        let shared = self.requests_at(&layer);
        let (others, members): (Vec<_>, Vec<_>) = self
            .readers(&layer)
            .into_iter()
            .filter(|other| *other != flow)
            .partition(|other| self.view(other).role.is_inside());
        let for_members =
            |born: &Place| members.iter().any(|other| wanted(&self.node_requests(other), born));
        messages.iter().map(|message| &message.born).any(|born| {
            let outside = match born {
                Place::Node(born) | Place::Bare(born) => {
                    self.layer_of(born).as_ref() != Some(&layer)
                }
                Place::Layer(_) => *born != layer,
            };
            let could = |other: &FlowId| {
                wanted(&shared, born)
                    || wanted(&self.node_requests(other), born)
                    || for_members(born)
            };
            let sent = outside && !self.readers(born).is_empty();
            sent && wanted(&self.node_requests(flow), born)
                && others.iter().any(|other| could(other))
        })
    }
}

fn scope_of(place: &Place) -> Scope {
    match place {
        Place::Node(_) | Place::Bare(_) => Scope::Node,
        Place::Layer(_) => Scope::Layer,
    }
}

fn carries(lane: &LaneSpec, message: &Message) -> bool {
    lane.carries(&message.layer, &message.source.node, &message.source.service)
}
