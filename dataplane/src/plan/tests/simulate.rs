//! One message through all plans, by the rules of scopes and flows alone; it knows nothing of how
//! plans are made.
//!
//! A scope gives what is written to it to its services and to every flow that reads it. A flow that
//! reads back what it wrote drops it as an echo. Everything else that a flow or a scope sees twice
//! is a fault here, although real flows drop repeats.

mod needless;
mod places;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use blaze_domain::{FlowId, Scope};

use places::{find_network, forms};

use super::generate::System;
use super::worlds::topic;
use crate::plan::{Form, LaneSpec, PlanRules, Target, TopicPlan, delivery};
use crate::world::{FlowState, FlowView, Reach, Request, Source};

/// Something that services attach to. A layer scope and a ROS 2 network are named by the first flow
/// that uses it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Place {
    /// A node, in one of the forms that its services may ask for.
    Node(FlowId, Form),
    /// A layer scope, or its copies as JSON.
    Layer(FlowId, bool),
    /// A ROS 2 network.
    Ros2(FlowId),
}

/// One message of one service.
#[derive(Debug)]
struct Message {
    born: Place,
    /// The flow of its node, or that owns its writer; none of a service of a layer.
    flow: Option<FlowId>,
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
    /// It has just come over the inter scope.
    on_link: bool,
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
    /// The layer scopes and the ROS 2 networks that flows are on.
    layers: BTreeMap<&'a FlowId, Place>,
    networks: BTreeMap<&'a FlowId, Place>,
    /// How flows treat what comes to them over the inter scope, as far as that was looked at.
    intakes: BTreeMap<FlowId, Vec<(Target, LaneSpec)>>,
    /// Who asks where.
    requests: BTreeMap<Place, Vec<&'a Request>>,
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
        let mut simulation = Self {
            system,
            plans,
            intake,
            useful: BTreeSet::new(),
            layers: BTreeMap::new(),
            networks: BTreeMap::new(),
            intakes: BTreeMap::new(),
            requests: BTreeMap::new(),
            carried: 0,
            relayed: 0,
        };
        for (id, view) in &system.world.flows {
            simulation.layers.extend(simulation.find_layer(id).map(|layer| (id, layer)));
            simulation.networks.extend(find_network(system, id, view).map(|network| (id, network)));
        }
        for (place, entry) in simulation.places() {
            let Some(request) = &entry.request else { continue };
            for form in forms(&place, request) {
                simulation.requests.entry(form).or_default().push(request);
            }
        }
        simulation
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

    fn send(&mut self, message: &Message) -> Result<(), String> {
        let mut arrived: BTreeMap<Place, bool> = BTreeMap::new();
        let mut seen: BTreeSet<FlowId> = BTreeSet::new();
        let mut queue = VecDeque::from([Copy {
            place: message.born.clone(),
            writer: None,
            hops: 0,
            crossed: false,
            on_link: false,
            trail: Vec::new(),
        }]);
        while let Some(copy) = queue.pop_front() {
            if arrived.insert(copy.place.clone(), copy.writer.is_some()).is_some() {
                return Err(format!("{:?} got it twice, last from {:?}", copy.place, copy.writer));
            }
            self.arrive(message, &copy)?;
            let readers = match copy.writer {
                Some(_) => self.readers(&copy.place),
                None => self.first_readers(message),
            };
            for flow in readers {
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
            if !carries(&bridge.lane, message)
                || !self.is_way(&bridge.to, &bridge.lane, message, copy)
            {
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
                on_link: true,
                trail,
            };
            for (target, lane) in self.intake(receiver) {
                if carries(&lane, message) && self.is_way(&target, &lane, message, &crossed) {
                    let mut trail = crossed.trail.clone();
                    trail.push((receiver.clone(), Scope::Inter, target.clone()));
                    queue.push_back(self.written(receiver, &target, &crossed, trail)?);
                }
            }
        }
        Ok(())
    }

    /// What a flow does with a message from the inter scope.
    fn intake(&mut self, receiver: &FlowId) -> Vec<(Target, LaneSpec)> {
        if let Some(known) = self.intakes.get(receiver) {
            return known.clone();
        }
        let intake = self.find_intake(receiver);
        self.intakes.insert(receiver.clone(), intake.clone());
        intake
    }

    fn find_intake(&self, receiver: &FlowId) -> Vec<(Target, LaneSpec)> {
        let bridges = self.plans[receiver].bridges.iter();
        let bridges = bridges.filter(|bridge| bridge.from == Scope::Inter);
        if self.intake == Intake::Bridges {
            return bridges.map(|bridge| (bridge.to.clone(), bridge.lane.clone())).collect();
        }
        delivery(&self.system.known_to(receiver), &topic(), &PlanRules::default())
            .into_iter()
            .collect()
    }

    /// What a flow looks at in each message: what other flows write or send is no matter of a
    /// bridge if they wrote it where that one writes.
    fn is_way(&self, to: &Target, lane: &LaneSpec, message: &Message, copy: &Copy) -> bool {
        match to {
            Target::Ros2 => {
                let from = if copy.on_link { Scope::Inter } else { scope_of(&copy.place) };
                !lane.natives.write(from, copy.hops, &message.layer, &message.source.node)
            }
            Target::Layer { json: true } => {
                !matches!(copy.place, Place::Layer(..)) || copy.on_link || copy.hops == 0
            }
            Target::Layer { json: false } | Target::Node(_) | Target::Inter { .. } => true,
        }
    }

    fn written(
        &self,
        flow: &FlowId,
        target: &Target,
        copy: &Copy,
        trail: Vec<BridgeKey>,
    ) -> Result<Copy, String> {
        let place = match target {
            Target::Node(_) if !self.view(flow).node_scope => {
                return Err(format!("{flow} has no node scope"));
            }
            Target::Node(form) => Place::Node(flow.clone(), *form),
            Target::Layer { json } => match self.layer_of(flow) {
                Some(Place::Layer(first, _)) => Place::Layer(first, *json),
                _ => return Err(format!("{flow} has no layer scope")),
            },
            Target::Ros2 => {
                self.network_of(flow).ok_or_else(|| format!("{flow} is on no ROS 2 network"))?
            }
            Target::Inter { .. } => return Err(format!("{flow} goes from inter to inter")),
        };
        Ok(Copy {
            place,
            writer: Some(flow.clone()),
            hops: copy.hops + 1,
            crossed: copy.crossed,
            on_link: false,
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
        if matches!(copy.place, Place::Layer(_, false)) {
            let readers = self
                .readers(&copy.place)
                .into_iter()
                .filter(|flow| copy.writer.as_ref() != Some(flow));
            asked.extend(readers.flat_map(|flow| self.requests_behind(flow, message)));
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

    /// What is asked for on the node of a flow, and on its network, if others are to write the
    /// message there.
    fn requests_behind(&self, flow: &FlowId, message: &Message) -> Vec<&'a Request> {
        let mut requests = self.node_requests(flow);
        let network = self.network_of(flow).filter(|network| {
            !message.flow.as_ref().is_some_and(|origin| self.is_on(origin, network))
        });
        requests.extend(network.iter().flat_map(|network| self.requests_at(network)));
        requests
    }

    fn node_requests(&self, flow: &FlowId) -> Vec<&'a Request> {
        let forms = Form::ALL.map(|form| self.requests_at(&Place::Node(flow.clone(), form)));
        forms.concat()
    }

    fn requests_at(&self, place: &Place) -> Vec<&'a Request> {
        self.requests.get(place).cloned().unwrap_or_default()
    }

    /// Whether the message can leave the scope where it was born for the place.
    fn can_reach(&self, message: &Message, to: &Place) -> bool {
        let share = |a: &FlowId, b: &FlowId| {
            a == b || self.layer_of(a).is_some_and(|layer| self.layer_of(b) == Some(layer))
        };
        let is_inside = |(_, view): &(&FlowId, &FlowView)| is_live(view) && view.role.is_inside();
        let joined = |flow: &FlowId| self.flows().filter(is_inside).any(|(id, _)| share(id, flow));
        let from = self.first_readers(message);
        let to_flows = self.writers(to);
        let mut pairs = from.iter().flat_map(|a| to_flows.iter().map(move |b| (*a, *b)));
        message.born == *to || pairs.any(|(a, b)| share(a, b) || (joined(a) && joined(b)))
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
            for target in forms(&place, request) {
                if self.can_reach(message, &target) && !arrived.contains_key(&target) {
                    return Err(format!("{target:?} did not get it"));
                }
            }
        }
        Ok(())
    }
}

fn scope_of(place: &Place) -> Scope {
    match place {
        Place::Node(..) => Scope::Node,
        Place::Layer(..) => Scope::Layer,
        Place::Ros2(_) => Scope::Ros2,
    }
}

fn carries(lane: &LaneSpec, message: &Message) -> bool {
    lane.carries(&message.layer, &message.source.node, &message.source.service)
}
