//! Why a topic does or does not arrive: a pure verdict over what one flow knows. It calls nobody.
//!
//! ```text
//! each pair of publisher and requester ──► the hops between them ──► steps, one failing step at most per cause
//!                                                                     worst pair first ──► verdict, code, remedy
//! ```

mod facts;
mod remedy;
mod trace;

#[cfg(test)]
mod tests;

use blaze_domain::{DropReason, FlowId, Scope, TopicName, WhyCode};
use serde::Serialize;

pub use facts::{
    BridgeFacts, BridgeState, BrokerFacts, BrokerHealth, LeaseHint, RouteFacts, WhyInput, WhyTarget,
};

use crate::plan::network::Network;
use crate::plan::{Group, Pairing, Publisher, Requester, TopicView};
use crate::world::{FlowState, FlowView, Reach};
use trace::{Trace, Tracer, fault};

/// Pairs of publisher and requester that are looked at; those that the flow has a part in come
/// first.
const MAX_PAIRS: usize = 256;
/// Why a flow that is not on the inter scope knows nothing of other groups.
const NO_GATEWAY: &str = "no flow of its group is on the inter scope";
/// Steps in an answer.
const MAX_STEPS: usize = 64;

/// The answer, in the order of its keys on the wire.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Why {
    /// The topic.
    pub topic: TopicName,
    /// Whom it should reach, as asked.
    pub to: Option<WhyTarget>,
    /// The verdict.
    pub verdict: Verdict,
    /// The first cause; `ok` if there is none.
    pub code: WhyCode,
    /// What to do about it.
    pub remedy: &'static str,
    /// What was looked at, the worst pair of publisher and requester first.
    pub steps: Vec<Step>,
}

/// Whether the topic arrives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Everywhere and as asked for.
    Flowing,
    /// Not everywhere, or not as asked for.
    Degraded,
    /// Not at all.
    NotFlowing,
}

/// One thing that must be right for a message to arrive.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Step {
    /// The flow that it is about.
    pub flow: FlowId,
    /// What it is.
    pub step: StepKind,
    /// Whether messages pass it.
    pub ok: bool,
    /// Why they do not; with `ok` what is not as asked for.
    pub code: WhyCode,
    /// The facts, for people.
    pub detail: String,
}

/// The kinds of steps, in the order of a message's way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum StepKind {
    /// Somebody publishes it.
    Advertise,
    /// Somebody asks for it.
    Request,
    /// They match, and a flow carries it.
    Plan,
    /// The bridge exists and reads its scope.
    Bridge,
    /// It is let through.
    Admit,
    /// It crosses the inter scope.
    Link,
    /// It is written to the scope of the requester.
    Deliver,
}

/// The verdict for a topic.
#[must_use]
pub fn explain(input: &WhyInput<'_>) -> Why {
    let destinations = match TopicView::new(input.world, input.topic) {
        Some(view) => Explainer { input, view }.destinations(),
        None => Vec::new(),
    };
    let verdict = verdict(&destinations, input.to.is_some());
    let mut traces: Vec<Trace> = destinations.into_iter().flatten().collect();
    traces.sort_by_key(|trace| std::cmp::Reverse(trace.verdict()));
    if verdict != Verdict::Flowing
        && let Some(conflict) = conflict(input, &traces)
    {
        traces.insert(0, conflict);
    }
    let code = traces.first().map_or(WhyCode::NoAdvertise, Trace::code);
    let mut steps: Vec<Step> = Vec::new();
    for step in traces.into_iter().flat_map(|trace| trace.steps) {
        if steps.len() < MAX_STEPS && !steps.contains(&step) {
            steps.push(step);
        }
    }
    Why {
        topic: input.topic.clone(),
        to: input.to.clone(),
        verdict,
        code,
        remedy: match code {
            WhyCode::RateLimited if input.bridges.iter().any(exceeds) => remedy::OF_AN_EXCESS,
            _ => remedy::remedy(code),
        },
        steps,
    }
}

/// A flow on the way whose name another program has, too: messages may reach that one.
fn conflict(input: &WhyInput<'_>, traces: &[Trace]) -> Option<Trace> {
    let me = &input.world.me;
    let steps = || traces.iter().flat_map(|trace| &trace.steps);
    let is_on_the_way = |flow: &FlowId| flow == me || steps().any(|step| step.flow == *flow);
    let conflict = input.conflicts.iter().find(|conflict| is_on_the_way(&conflict.flow))?;
    let detail = conflict.detail.clone();
    Some(Trace::failed(&conflict.flow, StepKind::Link, WhyCode::NameInUse, detail))
}

/// Whether messages are skipped because more is published than was advertised.
fn exceeds(facts: &BridgeFacts) -> bool {
    let skipped = facts.dropped.get(&DropReason::RateLimit);
    facts.exceeds_advertised && skipped.is_some_and(|skipped| *skipped > 0)
}

/// The worst of those that were asked for; of everybody, degraded if some are served.
fn verdict(destinations: &[Vec<Trace>], asked: bool) -> Verdict {
    let served = destinations.iter().map(|traces| together(traces.iter().map(Trace::verdict)));
    if asked { served.max().unwrap_or(Verdict::NotFlowing) } else { together(served) }
}

/// All, some or none.
fn together(parts: impl Iterator<Item = Verdict> + Clone) -> Verdict {
    let worst = parts.clone().max().unwrap_or(Verdict::NotFlowing);
    let best = parts.min().unwrap_or(Verdict::NotFlowing);
    if best == worst { worst } else { Verdict::Degraded }
}

struct Explainer<'a, 'w> {
    input: &'a WhyInput<'w>,
    view: TopicView<'w>,
}

impl<'w> Explainer<'_, 'w> {
    /// What was found for each requester that is asked about.
    fn destinations(&self) -> Vec<Vec<Trace>> {
        let advertised = self.advertise_side();
        let requested = self.request_side();
        let (Ok(publishers), Ok(requesters)) = (&advertised, &requested) else {
            let failed = [advertised.err(), requested.err()].into_iter().flatten();
            return vec![vec![Trace { steps: failed.flat_map(|trace| trace.steps).collect() }]];
        };
        let tracer = Tracer { input: self.input, view: &self.view };
        let mut left = MAX_PAIRS;
        let mut destinations = Vec::new();
        for requester in requesters {
            let traces = pairs_of(&tracer, publishers, requester, left);
            left -= traces.len().min(left);
            destinations.push(traces);
            if left == 0 {
                break;
            }
        }
        destinations
    }

    /// Publishers of flows that carry topics, each scope once, those next to this flow first; or
    /// what is wrong.
    fn advertise_side(&self) -> Result<Vec<Publisher<'w>>, Trace> {
        let mut found: Vec<Publisher<'w>> = Vec::new();
        for publisher in &self.view.publishers {
            let same = |other: &Publisher<'_>| {
                !publisher.is_of_flow()
                    && other.scope == publisher.scope
                    && other.group == publisher.group
            };
            match found.iter_mut().find(|other| same(other)) {
                Some(other) if publisher.flow == self.view.me => *other = *publisher,
                Some(_) => {}
                None => found.push(*publisher),
            }
        }
        found.sort_by_key(|publisher| {
            (publisher.flow != self.view.me, publisher.group != self.view.group)
        });
        if !found.is_empty() {
            return Ok(found);
        }
        let lost = self.input.world.flows.iter().find(|(_, flow)| {
            let entry = flow.topics.get(self.input.topic);
            entry.is_some_and(|entry| {
                let offers = [&entry.node, &entry.layer, &entry.ros2];
                offers.iter().any(|offer| offer.advertise.is_some())
            })
        });
        let (flow, code, detail) = match lost {
            // A flow that waits for its broker is not merely starting.
            Some((id, flow)) => match self.broker_fault().filter(|_| id == self.view.me) {
                Some((code, detail)) => (id, code, detail),
                None => (id, absent(flow), absence(id, flow)),
            },
            None => self.missing(StepKind::Advertise, WhyCode::NoAdvertise, || {
                "nobody advertises it".to_owned()
            }),
        };
        Err(Trace::failed(flow, StepKind::Advertise, code, detail))
    }

    /// Requesters that are asked about, of all flows, each scope once; or what is wrong.
    fn request_side(&self) -> Result<Vec<Requester<'w>>, Trace> {
        let world = self.input.world;
        let mut found: Vec<Requester<'w>> = Vec::new();
        let living = self.view.requesters.iter().chain(&self.view.refused).copied();
        let all: Vec<Requester<'w>> = living.chain(self.silent_requesters()).collect();
        for requester in all.iter().filter(|requester| self.is_asked(requester, &all)) {
            let shared = |other: &Requester<'_>| {
                !is_of_flow(requester)
                    && other.scope == requester.scope
                    && other.group == requester.group
            };
            match found.iter_mut().find(|other| shared(other)) {
                Some(other) if requester.flow == self.view.me && world.carries(requester.flow) => {
                    *other = *requester;
                }
                Some(_) => {}
                None => found.push(*requester),
            }
        }
        found.sort_by_key(|requester| {
            (requester.flow != self.view.me, requester.group != self.view.group)
        });
        if !found.is_empty() {
            return Ok(found);
        }
        let (flow, code, detail) = self.missing(StepKind::Request, WhyCode::NoRequest, || {
            let to = self.input.to.as_ref();
            let place = to.map_or_else(String::new, |to| format!(" in {to}"));
            format!("nobody{place} requests it")
        });
        Err(Trace::failed(flow, StepKind::Request, code, detail))
    }

    /// Requesters of flows that carry nothing.
    fn silent_requesters(&self) -> Vec<Requester<'w>> {
        let (world, mut silent) = (self.input.world, Vec::new());
        for (id, flow) in world.flows.iter().filter(|(id, _)| !world.carries(id)) {
            let Some(entry) = flow.topics.get(self.input.topic) else {
                continue;
            };
            let (group, network) = (Group::of(id, flow), Network::of(id, flow));
            for (scope, entry) in entry.scopes() {
                // What a lost flow said of a layer scope or a network counts only while nobody else
                // is there to know better.
                let known = match scope {
                    Scope::Node => false,
                    Scope::Layer => self.has_living(group),
                    Scope::Ros2 => network.is_none_or(|network| self.view.has_flows(network)),
                    Scope::Inter => true,
                };
                silent.extend(entry.request.as_ref().filter(|_| !known).map(|request| Requester {
                    flow: id,
                    group,
                    scope,
                    network,
                    request,
                }));
            }
        }
        silent
    }

    fn has_living(&self, group: Group<'_>) -> bool {
        let world = self.input.world;
        let mut flows = world.flows.iter();
        flows.any(|(id, flow)| world.carries(id) && Group::of(id, flow) == group)
    }

    /// Of a node its own requesters; if it has none, those of the layer scope that it is on.
    fn is_asked(&self, requester: &Requester<'w>, all: &[Requester<'w>]) -> bool {
        let Some(to) = &self.input.to else { return true };
        if requester.scope == Scope::Inter {
            // A gateway does not say which layers it speaks for.
            return to.layer != self.view.me.layer;
        }
        let in_node = |requester: &Requester<'w>| {
            let flows = self.view.flows_behind(requester);
            requester.flow.layer == to.layer
                && to.node.as_ref().is_none_or(|node| flows.iter().any(|flow| flow.node == *node))
        };
        let node_asks = || all.iter().any(|other| is_of_flow(other) && in_node(other));
        in_node(requester) && (to.node.is_none() || is_of_flow(requester) || !node_asks())
    }

    /// Why a lease is missing: nobody is heard on a scope that is another flow's or whose broker is
    /// away, it lapsed or was refused, or there never was one.
    fn missing(
        &self,
        kind: StepKind,
        code: WhyCode,
        nobody: impl Fn() -> String,
    ) -> (&FlowId, WhyCode, String) {
        let me = self.view.me;
        let to = self.input.to.as_ref().filter(|_| kind == StepKind::Request);
        // Who is on a scope that is not read is not heard.
        if to.is_none_or(|to| to.layer == me.layer)
            && let Some((code, detail)) = self.broker_fault()
        {
            return (me, code, detail);
        }
        let outside = to.is_some_and(|to| to.layer != me.layer);
        let alone = self.view.lacks_gateway();
        if outside && alone {
            return (me, WhyCode::PeerDown, NO_GATEWAY.to_owned());
        }
        match self.hint(kind) {
            Some(hint) => {
                let colon = if hint.detail.is_empty() { "" } else { ": " };
                let detail = format!("{} of {}{colon}{}", hint.code, hint.service, hint.detail);
                (&hint.flow, hint.code, detail)
            }
            None if alone => (me, code, format!("{}, and {NO_GATEWAY}", nobody())),
            None => (me, code, nobody()),
        }
    }

    /// What is wrong with the own brokers.
    fn broker_fault(&self) -> Option<(WhyCode, String)> {
        let brokers = [&self.input.node_broker, &self.input.layer_broker];
        brokers.into_iter().flatten().find_map(fault)
    }

    fn hint(&self, kind: StepKind) -> Option<&LeaseHint> {
        self.input.leases.iter().find(|hint| {
            let to = self.input.to.as_ref().filter(|_| kind == StepKind::Request);
            let fits = to.is_none_or(|to| {
                hint.flow.layer == to.layer
                    && to.node.as_ref().is_none_or(|node| hint.flow.node == *node)
            });
            hint.kind == kind && fits
        })
    }
}

/// One trace per publisher that the requester asks for; one that says so if it asks for none of
/// them.
fn pairs_of<'w>(
    tracer: &Tracer<'_, 'w>,
    publishers: &[Publisher<'w>],
    requester: &Requester<'w>,
    limit: usize,
) -> Vec<Trace> {
    // What flows outside send one another is not for a flow that is not on the inter scope to say.
    let here = |publisher: &&Publisher<'w>| [publisher.scope, requester.scope] != [Scope::Inter; 2];
    let wanted =
        |publisher: &&Publisher<'w>| publisher.pairing(requester.request) != Pairing::OtherOrigin;
    let wanted: Vec<_> = publishers.iter().filter(here).filter(wanted).collect();
    let all =
        if wanted.is_empty() { publishers.iter().filter(here).take(1).collect() } else { wanted };
    all.into_iter().take(limit).map(|publisher| tracer.trace(publisher, requester)).collect()
}

/// Whether a requester is on a node or a ROS 2 network.
fn is_of_flow(requester: &Requester<'_>) -> bool {
    matches!(requester.scope, Scope::Node | Scope::Ros2)
}

/// Why a flow carries nothing.
fn absent(flow: &FlowView) -> WhyCode {
    match (flow.state, flow.reach) {
        (FlowState::Starting, Reach::Up | Reach::Suspect) => WhyCode::BridgeStarting,
        _ => WhyCode::PeerDown,
    }
}

fn absence(id: &FlowId, flow: &FlowView) -> String {
    let what = match (flow.state, flow.reach) {
        (_, Reach::Down) => "is down",
        (FlowState::Starting, _) => "is starting",
        (FlowState::Draining, _) => "is going away",
        (FlowState::Ready, _) => "has no such scope",
    };
    format!("{id} {what}")
}
