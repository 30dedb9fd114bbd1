//! One publisher and one requester: the hops between them, and what each of them says.

use std::fmt::Write as _;

use blaze_domain::{DropReason, FlowId, Reliability, Scope, WhyCode};

use super::{
    BridgeFacts, BridgeState, BrokerFacts, BrokerHealth, Step, StepKind, Verdict, WhyInput,
    absence, absent,
};
use crate::plan::{
    Blocked, Destination, Form, Pairing, Publisher, Requester, Target, TopicView, asks_too_much,
    meets_directly, type_detail,
};
use crate::world::{Reach, Request};

/// The steps of one pair, in the order of a message's way.
pub(super) struct Trace {
    pub(super) steps: Vec<Step>,
}

impl Trace {
    pub(super) fn failed(flow: &FlowId, step: StepKind, code: WhyCode, detail: String) -> Self {
        let mut trace = Self { steps: Vec::new() };
        trace.fail(flow, step, code, detail);
        trace
    }

    /// Messages pass a step.
    fn pass(&mut self, flow: &FlowId, step: StepKind, detail: impl Into<String>) {
        self.add(flow, step, true, WhyCode::Ok, detail);
    }

    /// They do not.
    fn fail(&mut self, flow: &FlowId, step: StepKind, code: WhyCode, detail: impl Into<String>) {
        self.add(flow, step, false, code, detail);
    }

    fn add(
        &mut self,
        flow: &FlowId,
        step: StepKind,
        ok: bool,
        code: WhyCode,
        detail: impl Into<String>,
    ) {
        self.steps.push(Step { flow: flow.clone(), step, ok, code, detail: detail.into() });
    }

    pub(super) fn verdict(&self) -> Verdict {
        if self.steps.iter().any(|step| !step.ok) {
            Verdict::NotFlowing
        } else if matches!(self.code(), WhyCode::Ok | WhyCode::NativePath) {
            Verdict::Flowing
        } else {
            Verdict::Degraded
        }
    }

    /// That of the first failing step, else the first that says that something is not as asked for;
    /// of what flows without a bridge, that.
    pub(super) fn code(&self) -> WhyCode {
        let failing = self.steps.iter().find(|step| !step.ok);
        let remark = || {
            self.steps.iter().find(|step| {
                !matches!(step.code, WhyCode::Ok | WhyCode::NativePath | WhyCode::NotOwner)
            })
        };
        let native = || self.steps.iter().find(|step| step.code == WhyCode::NativePath);
        failing.or_else(remark).or_else(native).map_or(WhyCode::Ok, |step| step.code)
    }
}

/// One bridge on the way.
struct Hop<'w> {
    flow: &'w FlowId,
    from: Scope,
    to: Target,
}

pub(super) struct Tracer<'a, 'w> {
    pub(super) input: &'a WhyInput<'w>,
    pub(super) view: &'a TopicView<'w>,
}

impl<'w> Tracer<'_, 'w> {
    pub(super) fn trace(&self, publisher: &Publisher<'w>, requester: &Requester<'w>) -> Trace {
        let mut trace = Trace { steps: Vec::new() };
        trace.pass(publisher.flow, StepKind::Advertise, advertised(publisher));
        trace.pass(requester.flow, StepKind::Request, requested(requester));
        if self.plan(&mut trace, publisher, requester) {
            self.note_owner(&mut trace, publisher, requester);
            if publisher.scope == Scope::Inter {
                self.over_gateways(&mut trace, StepKind::Deliver);
            }
            for hop in self.hops(publisher, requester) {
                self.hop(&mut trace, &hop, requester);
            }
            if requester.scope == Scope::Inter {
                self.over_gateways(&mut trace, StepKind::Bridge);
            }
        }
        trace
    }

    /// Whether the two match at all; the hops say the rest.
    fn plan(
        &self,
        trace: &mut Trace,
        publisher: &Publisher<'w>,
        requester: &Requester<'w>,
    ) -> bool {
        let (flow, plan) = (publisher.flow, StepKind::Plan);
        match publisher.pairing(requester.request) {
            Pairing::OtherOrigin => {
                let detail = format!("`from` of {} matches no publisher", requester.flow);
                trace.fail(flow, plan, WhyCode::NoMatchingOrigin, detail);
                return false;
            }
            Pairing::OtherType => {
                trace.fail(flow, plan, WhyCode::TypeMismatch, type_detail(publisher, requester));
                return false;
            }
            Pairing::Matches => {}
        }
        if let Some(view) = self.input.world.flows.get(requester.flow)
            && !self.input.world.carries(requester.flow)
        {
            let step =
                if absent(view) == WhyCode::PeerDown { StepKind::Link } else { StepKind::Plan };
            trace.fail(requester.flow, step, absent(view), absence(requester.flow, view));
            return false;
        }
        if let Some(detail) = self.view.denial(publisher, requester) {
            trace.fail(self.view.me, plan, WhyCode::AccessDenied, detail);
            return false;
        }
        if asks_too_much(publisher.advertise, requester.request) {
            trace.add(
                flow,
                plan,
                true,
                WhyCode::QosMismatch,
                "more is asked than offered: it flows as offered",
            );
        } else if publisher.scope == Scope::Ros2 && publisher.shares_network(requester) {
            let detail = "one ROS 2 network: no bridge is needed";
            trace.add(flow, plan, true, WhyCode::NativePath, detail);
        } else if meets_directly(publisher, requester) {
            trace.pass(flow, plan, "one scope: no bridge is needed");
        } else {
            trace.pass(flow, plan, "they match");
        }
        self.note_broker(trace, publisher, requester);
        true
    }

    /// What the gateways say of their way into the layer or out of it, for a flow that is not on
    /// the inter scope.
    fn over_gateways(&self, trace: &mut Trace, step: StepKind) {
        let gateways = self.view.gateways();
        let here = &self.view.me.layer;
        let fits = |route: &&super::RouteFacts| {
            let way = match step {
                StepKind::Deliver => route.receiver.as_ref() == Some(&route.flow),
                _ => route.receiver.as_ref().is_some_and(|receiver| *receiver != route.flow),
            };
            gateways.contains(&&route.flow) && route.step == step && way
        };
        let before = trace.steps.len();
        for route in self.input.routes.iter().filter(fits) {
            let to = route.receiver.as_ref().filter(|receiver| **receiver != route.flow);
            let to = to.map_or_else(|| here.to_string(), ToString::to_string);
            let detail = format!("the gateway {} says so of its way to {to}", route.flow);
            trace.add(&route.flow, route.step, route.ok, route.code, detail);
        }
        if trace.steps.len() == before {
            let names: Vec<String> = gateways.iter().map(ToString::to_string).collect();
            let detail = format!("over a gateway: {}", names.join(", "));
            trace.pass(self.view.me, StepKind::Plan, detail);
        }
    }

    /// Of several flows that share a layer broker one carries what is published there: the others
    /// say which.
    fn note_owner(&self, trace: &mut Trace, publisher: &Publisher<'w>, requester: &Requester<'w>) {
        let leaves = publisher.scope == Scope::Layer && publisher.group == self.view.group;
        if !leaves
            || requester.group == publisher.group
            || self.view.own_layer_publisher().is_none()
        {
            return;
        }
        if let Some(owner) = self.view.owner().filter(|owner| *owner != self.view.me) {
            let detail = format!("{owner} carries it for the layer");
            trace.add(self.view.me, StepKind::Plan, true, WhyCode::NotOwner, detail);
        }
    }

    /// A broker that loses messages of reliable topics says so.
    fn note_broker(&self, trace: &mut Trace, publisher: &Publisher<'w>, requester: &Requester<'w>) {
        let reliable = [publisher.advertise.reliability, requester.request.reliability]
            == [Reliability::Reliable; 2];
        let ends = [(publisher.flow, publisher.scope), (requester.flow, requester.scope)];
        let mut own = ends.iter().filter(|(flow, _)| *flow == self.view.me);
        let broker =
            own.find_map(|(_, scope)| self.broker(*scope).filter(|broker| broker.at_most_once));
        if let (true, Some(broker), Some(step)) = (reliable, broker, trace.steps.last_mut()) {
            let _ =
                write!(step.detail, "; {} delivers at most once whatever is asked", broker.name);
        }
    }

    /// The bridges between a publisher and a requester that match.
    fn hops(&self, publisher: &Publisher<'w>, requester: &Requester<'w>) -> Vec<Hop<'w>> {
        let hop = |flow, from, to| Hop { flow, from, to };
        let targets: Vec<Target> = match requester.scope {
            Scope::Node => {
                let forms = Form::ALL.into_iter().filter(|form| form.is_asked(requester.request));
                forms.map(Target::Node).collect()
            }
            Scope::Ros2 => vec![Target::Ros2],
            Scope::Layer | Scope::Inter => Vec::new(),
        };
        let last = |flow, from| targets.iter().map(move |to| hop(flow, from, to.clone()));
        let mut hops = Vec::new();
        if meets_directly(publisher, requester)
            || publisher.is_of_flow()
                && (publisher.flow, publisher.scope) == (requester.flow, requester.scope)
        {
            // On one node other forms need a copy; framed ones read what is published.
            hops.extend(last(requester.flow, Scope::Node).filter(|hop| hop.to.is_headless()));
            return hops;
        }
        let one_flow = publisher.flow == requester.flow && !targets.is_empty();
        if publisher.is_of_flow() && (one_flow || publisher.shares_network(requester)) {
            hops.extend(last(publisher.flow, publisher.scope));
            return hops;
        }
        let layers: &[bool] = match (requester.scope, requester.request) {
            (Scope::Layer, Request { framed: true, json: true, .. }) => &[false, true],
            (Scope::Layer, Request { framed: false, json: true, .. }) => &[true],
            _ => &[false],
        };
        let layer = |flow, from| {
            layers.iter().map(move |json| hop(flow, from, Target::Layer { json: *json }))
        };
        if publisher.group == requester.group {
            if publisher.is_of_flow() {
                hops.extend(layer(publisher.flow, publisher.scope));
            } else if let Some(converter) = self.view.converter_in(publisher.group) {
                let copies = layer(converter, Scope::Layer);
                hops.extend(copies.filter(|hop| hop.to.is_json()));
            }
            hops.extend(last(requester.flow, Scope::Layer));
            return hops;
        }
        let sender = if publisher.scope == Scope::Layer {
            self.view.owner_in(publisher.group)
        } else {
            Some(publisher.flow)
        };
        let sender = sender.unwrap_or(publisher.flow);
        let Some(receiver) = self.receiver(sender, publisher, requester) else {
            return hops;
        };
        let target = Target::Inter { layer: receiver.layer.clone(), receiver: receiver.clone() };
        hops.push(hop(sender, publisher.scope, target));
        if !targets.is_empty() && requester.flow == receiver {
            hops.extend(last(receiver, Scope::Inter));
        } else {
            hops.extend(layer(receiver, Scope::Inter));
            hops.extend(last(requester.flow, Scope::Layer));
        }
        hops
    }

    /// The flow that the sender chose: as planned here, as it says, else as it would choose.
    fn receiver(
        &self,
        sender: &FlowId,
        publisher: &Publisher<'w>,
        requester: &Requester<'w>,
    ) -> Option<&'w FlowId> {
        let kept: Vec<&FlowId> = if sender == self.view.me {
            let targets =
                self.input.plan.bridges.iter().filter(|bridge| bridge.from == publisher.scope);
            targets.filter_map(|bridge| bridge.to.receiver()).collect()
        } else {
            let routes = self.input.routes.iter().filter(|route| route.flow == *sender);
            routes.filter_map(|route| route.receiver.as_ref()).collect()
        };
        self.view.receiver(publisher, requester.group, &kept)
    }

    fn hop(&self, trace: &mut Trace, hop: &Hop<'w>, requester: &Requester<'w>) {
        if hop.flow == self.view.me {
            self.own_hop(trace, hop);
        } else if self.denies(hop.flow, requester) {
            let detail = format!("{} says so: its rules flow.access do not allow it", hop.flow);
            trace.fail(hop.flow, StepKind::Plan, WhyCode::AccessDenied, detail);
        } else {
            self.other_hop(trace, hop);
        }
    }

    /// Whether another flow says that its rules keep the topic from the requester.
    fn denies(&self, flow: &FlowId, requester: &Requester<'w>) -> bool {
        // Of services of a layer it names the layer alone.
        let asks = (requester.scope != Scope::Layer).then_some(requester.flow);
        let mut routes = self.input.routes.iter().filter(|route| route.flow == *flow);
        routes.any(|route| {
            route.code == WhyCode::AccessDenied
                && route.to_layer == requester.flow.layer
                && route.receiver.as_ref() == asks
        })
    }

    /// What another flow says of its part.
    fn other_hop(&self, trace: &mut Trace, hop: &Hop<'w>) {
        let (to_layer, receiver) = match &hop.to {
            Target::Inter { layer, receiver } => (layer, Some(receiver)),
            Target::Node(_) | Target::Layer { .. } | Target::Ros2 => (&hop.flow.layer, None),
        };
        // A way that ends in the flow's own layer names the flow itself, or nobody where it is
        // blocked.
        let fits = |route: &&super::RouteFacts| {
            let to = route.receiver.as_ref();
            let same = to == receiver || (receiver.is_none() && to == Some(hop.flow));
            route.flow == *hop.flow && route.to_layer == *to_layer && same
        };
        let route = self.input.routes.iter().filter(fits).min_by_key(|route| route.ok);
        let own_layer = self.view.own_layer_publisher().is_some() && hop.from == Scope::Layer;
        if let Some(route) = route {
            let detail = format!("{} says so of its way to {}", hop.flow, describe(&hop.to));
            trace.add(hop.flow, route.step, route.ok, route.code, detail);
        } else if own_layer && receiver.is_some() {
            let detail =
                format!("{} carries it for the layer and has told nothing of it", hop.flow);
            trace.fail(self.view.me, StepKind::Plan, WhyCode::NotOwner, detail);
        }
        self.link(trace, hop);
    }

    /// What is known of a bridge of this flow.
    fn own_hop(&self, trace: &mut Trace, hop: &Hop<'w>) {
        let (flow, bridge) = (hop.flow, StepKind::Bridge);
        let way = format!("{} to {}", hop.from, describe(&hop.to));
        if let Some((code, detail)) = self.broker(hop.from).and_then(fault) {
            return trace.fail(flow, bridge, code, detail);
        }
        if let Some(blocked) = self.blocked(hop) {
            return trace.fail(flow, StepKind::Plan, blocked.code, blocked.detail.clone());
        }
        let planned = self
            .input
            .plan
            .bridges
            .iter()
            .any(|planned| (planned.from, &planned.to) == (hop.from, &hop.to));
        // What is addressed to a flow is delivered even where it did not expect to be chosen.
        let unplanned = hop.from == Scope::Inter && !planned;
        let facts =
            self.input.bridges.iter().find(|facts| (facts.from, &facts.to) == (hop.from, &hop.to));
        match facts.map(|facts| &facts.state) {
            Some(BridgeState::Failed(detail)) => {
                return trace.fail(flow, bridge, WhyCode::BridgeFailed, format!("{way}: {detail}"));
            }
            Some(BridgeState::Up) => {}
            None if unplanned => {}
            Some(BridgeState::Starting) | None => {
                let what = if planned { "is being made" } else { "is not planned yet" };
                return trace.fail(flow, bridge, WhyCode::BridgeStarting, format!("{way} {what}"));
            }
        }
        trace.pass(flow, bridge, way);
        let target = hop.to.scope();
        // A broker that is away explains what was dropped on the way to it.
        if let Some((code, detail)) = self.broker(target).and_then(fault) {
            return trace.fail(flow, StepKind::Deliver, code, detail);
        }
        if let Some(facts) = facts {
            drops(trace, hop, facts);
        }
        self.link(trace, hop);
        if target != Scope::Inter {
            let counted = facts.map_or_else(String::new, counts);
            trace.pass(flow, StepKind::Deliver, counted);
        }
    }

    /// Why this flow makes no bridge for a hop over the layer scope, if its broker cannot have the
    /// topic.
    fn blocked(&self, hop: &Hop<'w>) -> Option<&Blocked> {
        let on_layer = hop.from == Scope::Layer || hop.to.scope() == Scope::Layer;
        let of_layer = |blocked: &&Blocked| {
            let layer = Destination::Layer(self.view.me.layer.clone());
            let of_name =
                matches!(blocked.code, WhyCode::NameCollision | WhyCode::NameNotExpressible);
            blocked.to == layer && of_name
        };
        self.input.plan.blocked.iter().filter(|_| on_layer).find(of_layer)
    }

    /// Whether the receiver of a hop over the inter scope answers.
    fn link(&self, trace: &mut Trace, hop: &Hop<'w>) {
        let Target::Inter { receiver, .. } = &hop.to else {
            return;
        };
        // Of the two ends one may be this flow, which knows that it lives.
        let peer = if receiver == self.view.me { hop.flow } else { receiver };
        let suspect =
            self.input.world.flows.get(peer).is_some_and(|view| view.reach == Reach::Suspect);
        if suspect {
            let detail = format!("{peer} has not answered for a moment");
            trace.fail(hop.flow, StepKind::Link, WhyCode::PeerSuspect, detail);
        } else {
            trace.pass(hop.flow, StepKind::Link, format!("to {receiver}"));
        }
    }

    fn broker(&self, scope: Scope) -> Option<&BrokerFacts> {
        match scope {
            Scope::Node => self.input.node_broker.as_ref(),
            Scope::Layer => self.input.layer_broker.as_ref(),
            Scope::Ros2 | Scope::Inter => None,
        }
    }
}

/// What is wrong with a broker.
pub(super) fn fault(broker: &BrokerFacts) -> Option<(WhyCode, String)> {
    let BrokerFacts { name, detail, .. } = broker;
    let because = |what: String| {
        if detail.is_empty() { what } else { format!("{what}: {detail}") }
    };
    match broker.health {
        BrokerHealth::Up => None,
        BrokerHealth::Down => {
            Some((WhyCode::BrokerDown, because(format!("{name} does not answer"))))
        }
        BrokerHealth::InUse => {
            Some((WhyCode::ScopeInUse, because(format!("another flow uses this {name}"))))
        }
    }
}

/// Drops that explain why messages are missing: all of them failed, or some.
fn drops(trace: &mut Trace, hop: &Hop<'_>, facts: &BridgeFacts) {
    let last =
        if matches!(hop.to, Target::Inter { .. }) { StepKind::Link } else { StepKind::Deliver };
    let none_passed = facts.sent == 0;
    let mut found = Vec::new();
    if facts.denied > 0 {
        let detail = format!(
            "{} dropped by the rules flow.access ({}), {}",
            facts.denied,
            DropReason::ForeignOrigin,
            counts(facts)
        );
        found.push((StepKind::Admit, WhyCode::AccessDenied, detail));
    }
    if let Some((code, detail)) = &facts.unconverted {
        found.push((StepKind::Deliver, *code, detail.clone()));
    }
    // That says it better.
    let is_said = |reason: &DropReason| {
        let code = facts.unconverted.as_ref().map(|(code, _)| *code);
        match reason {
            DropReason::ConvertError => code.is_some(),
            DropReason::TypeMismatch => code == Some(WhyCode::TypeMismatch),
            DropReason::TooLarge => code == Some(WhyCode::TooLarge),
            _ => false,
        }
    };
    let dropped = facts.dropped.iter().filter(|(reason, count)| **count > 0 && !is_said(reason));
    for (reason, count) in dropped {
        let (step, code) = match reason {
            DropReason::RateLimit if none_passed => (StepKind::Admit, WhyCode::BudgetStarved),
            DropReason::RateLimit => (StepKind::Admit, WhyCode::RateLimited),
            DropReason::TooLarge => (StepKind::Admit, WhyCode::TooLarge),
            DropReason::TypeMismatch => (StepKind::Admit, WhyCode::TypeMismatch),
            DropReason::ConvertError => (StepKind::Deliver, WhyCode::ConvertError),
            DropReason::ForeignOrigin => (StepKind::Admit, WhyCode::SourceMismatch),
            DropReason::QueueFull => (last, WhyCode::RateLimited),
            DropReason::Lifespan => (last, WhyCode::Lifespan),
            DropReason::LinkDown => (last, WhyCode::PeerDown),
            DropReason::BrokerError => (last, WhyCode::BrokerDown),
            // As asked for, repeats, or faults of single messages that no setting cures.
            DropReason::MaxRate
            | DropReason::Duplicate
            | DropReason::Echo
            | DropReason::DecodeError
            | DropReason::DecompressError
            | DropReason::ReassemblyTimeout
            | DropReason::NoDestination
            | DropReason::Shutdown => continue,
        };
        let excess = if *reason == DropReason::RateLimit && facts.exceeds_advertised {
            "; more is published than was advertised"
        } else {
            ""
        };
        found.push((step, code, format!("{count} dropped ({reason}), {}{excess}", counts(facts))));
    }
    found.sort();
    for (step, code, detail) in found {
        trace.add(hop.flow, step, !none_passed, code, detail);
    }
}

fn counts(facts: &BridgeFacts) -> String {
    format!("{} in, {} out lately", facts.received, facts.sent)
}

pub(super) fn describe(target: &Target) -> String {
    match target {
        Target::Node(Form::Bare) => "node (bare)".to_owned(),
        Target::Inter { receiver, .. } => format!("inter, {receiver}"),
        local if local.is_json() => format!("{} (JSON)", local.scope()),
        local => local.scope().to_string(),
    }
}

fn advertised(publisher: &Publisher<'_>) -> String {
    let mut services: Vec<&str> =
        publisher.advertise.sources.iter().map(|source| source.service.as_str()).collect();
    services.dedup();
    services.truncate(4);
    format!("{} on {} scope", services.join(", "), publisher.scope)
}

fn requested(requester: &Requester<'_>) -> String {
    let request = requester.request;
    let mut services: Vec<&str> =
        request.services.iter().map(|service| service.service.as_str()).collect();
    services.dedup();
    let more = match request.more_services {
        0 => String::new(),
        more => format!(" and {more} more"),
    };
    format!("{}{more} on {} scope", services.join(", "), requester.scope).trim_start().to_owned()
}
