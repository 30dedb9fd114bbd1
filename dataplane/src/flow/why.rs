//! `GET /v1/why`: gathers what the flow knows of a topic and asks for the verdict.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::{Query, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use blaze_brokers::{Broker, BrokerKind, Health};
use blaze_domain::control::LeaseKind;
use blaze_domain::{DropReason, TopicName, WhyCode};
use blaze_proto::link::link_control::RouteState;
use serde_json::{Value, json};

use super::Shared;
use super::admin::{answer, query_text, refusal};
use super::routes::SourceState;
use crate::control::ControlCore;
use crate::lane::path::{BridgeState as Bridge, Phase};
use crate::plan::TopicPlan;
use crate::registry::{LapseReason, LapsedLease};
use crate::why::{
    BridgeFacts, BridgeState, BrokerFacts, BrokerHealth, LeaseHint, RouteFacts, StepKind, WhyInput,
    WhyTarget, explain,
};

/// How long a message that could not be converted is shown.
const SHOWN: Duration = Duration::from_secs(10);
/// Lapsed leases that are looked at.
const MAX_HINTS: usize = 16;

pub(super) async fn why(
    State(shared): State<Arc<Shared>>,
    query: Query<BTreeMap<String, String>>,
) -> Response {
    let Some(text) = query_text(&query, "topic").filter(|text| !text.is_empty()) else {
        return refusal(
            StatusCode::BAD_REQUEST,
            "invalid_request",
            "the parameter topic is missing: /v1/why?topic=imu/data",
        );
    };
    let asked_to = query_text(&query, "to");
    let topic: TopicName = match text.parse() {
        Ok(topic) => topic,
        Err(error) => {
            let remedy = format!("No topic has such a name: it {error}.");
            return nothing_such(
                &shared,
                &text,
                asked_to.as_deref(),
                WhyCode::NoAdvertise,
                &remedy,
            );
        }
    };
    let to: Option<WhyTarget> = match asked_to.as_deref().map(str::parse).transpose() {
        Ok(to) => to,
        Err(error) => {
            let remedy = format!(
                "Nobody has such a name: to is layer[/node[/service]], and a part of it {error}."
            );
            return nothing_such(&shared, &text, asked_to.as_deref(), WhyCode::NoRequest, &remedy);
        }
    };
    let bridges = bridge_facts(&shared, &topic);
    let conflicts = shared.name_conflicts();
    let control = shared.control.lock();
    let nothing = TopicPlan::default();
    let verdict = explain(&WhyInput {
        world: control.world(),
        topic: &topic,
        to,
        plan: control.plans().get(&topic).unwrap_or(&nothing),
        bridges,
        node_broker: shared.brokers.node.as_deref().map(broker_facts),
        layer_broker: shared.brokers.layer.as_deref().map(broker_facts),
        routes: route_facts(&control, &topic),
        leases: lease_hints(&shared, &control, &topic),
        conflicts,
    });
    drop(control);
    answer(&shared, serde_json::to_value(verdict).unwrap_or(Value::Null)).into_response()
}

/// The verdict for names that nothing can have.
fn nothing_such(
    shared: &Shared,
    topic: &str,
    to: Option<&str>,
    code: WhyCode,
    remedy: &str,
) -> Response {
    let verdict = json!({
        "topic": topic, "to": to, "verdict": "not_flowing", "code": code, "remedy": remedy,
        "steps": [],
    });
    answer(shared, verdict).into_response()
}

fn bridge_facts(shared: &Shared, topic: &TopicName) -> Vec<BridgeFacts> {
    let found = shared.plane.read(|state| {
        let id = state.core.find(topic.as_str())?;
        let path = state.core.path_mut(id);
        let live =
            |bridge: &&mut Bridge| matches!(bridge.phase, Phase::Up { .. } | Phase::Failed { .. });
        let mut facts: Vec<BridgeFacts> =
            path.bridges.iter_mut().filter(live).map(facts_of).collect();
        // What was refused on the way in never reached a bridge, and yet is missing behind those
        // that read its scope.
        for fact in &mut facts {
            let refused = path.refused_lately(fact.from);
            *fact.dropped.entry(DropReason::TooLarge).or_default() += refused.too_large;
            *fact.dropped.entry(DropReason::ForeignOrigin).or_default() += refused.foreign;
            fact.denied = refused.denied;
        }
        Some((id, facts))
    });
    let Some((id, mut facts)) = found else {
        return Vec::new();
    };
    for fact in facts.iter_mut().filter(|fact| fact.state == BridgeState::Up) {
        fact.state = match shared.routes.source_state(id, fact.from) {
            SourceState::Subscribed => BridgeState::Up,
            SourceState::Starting => BridgeState::Starting,
            SourceState::Failed(reason) => BridgeState::Failed(reason),
        };
    }
    facts
}

fn facts_of(bridge: &mut Bridge) -> BridgeFacts {
    bridge.settle();
    let lately = bridge.stats.lately();
    BridgeFacts {
        from: bridge.from,
        to: bridge.target.clone(),
        state: match bridge.phase {
            Phase::Failed { .. } => BridgeState::Failed(bridge.failure.clone().unwrap_or_default()),
            _ => BridgeState::Up,
        },
        received: lately.taken,
        sent: lately.out,
        dropped: lately.dropped.into_iter().collect(),
        exceeds_advertised: bridge.exceeds_advertised,
        denied: 0,
        unconverted: bridge
            .unconverted
            .as_ref()
            .filter(|last| last.at.elapsed() < SHOWN)
            .map(|last| (last.failure.code, last.failure.to_string())),
    }
}

fn broker_facts(broker: &dyn Broker) -> BrokerFacts {
    let status = broker.status().borrow().clone();
    let kind = broker.kind().to_string();
    let (name, health, detail) = match status.health {
        // Up, it says server and version, which are the better name.
        Health::Up if status.detail.is_empty() => (kind, BrokerHealth::Up, String::new()),
        Health::Up => (status.detail, BrokerHealth::Up, String::new()),
        Health::InUse => (kind, BrokerHealth::InUse, status.detail),
        Health::Connecting | Health::Down | Health::Closed => {
            (kind, BrokerHealth::Down, status.detail)
        }
    };
    BrokerFacts { name, health, detail, at_most_once: broker.kind() == BrokerKind::Redis }
}

fn route_facts(control: &ControlCore, topic: &TopicName) -> Vec<RouteFacts> {
    let world = control.world();
    let flows = world.flows.keys().filter(|flow| **flow != world.me);
    let routes = flows.flat_map(|flow| {
        let of_flow = control.registry().remote_routes(flow, topic).iter();
        of_flow.filter_map(move |route| route_of(flow, route))
    });
    routes.collect()
}

/// A route as another flow told it; one with words that this version does not know says nothing.
fn route_of(flow: &blaze_domain::FlowId, route: &RouteState) -> Option<RouteFacts> {
    Some(RouteFacts {
        flow: flow.clone(),
        to_layer: route.to_layer.parse().ok()?,
        receiver: route.receiver.parse().ok(),
        step: match route.step.as_str() {
            "plan" => StepKind::Plan,
            "bridge" => StepKind::Bridge,
            "deliver" => StepKind::Deliver,
            _ => return None,
        },
        ok: route.ok,
        code: route.code.parse::<WhyCode>().ok()?,
    })
}

fn lease_hints(shared: &Shared, control: &ControlCore, topic: &TopicName) -> Vec<LeaseHint> {
    let lapsed = control.registry().lapsed(topic).take(MAX_HINTS);
    let hint = |lapsed: &LapsedLease| LeaseHint {
        flow: shared.me.clone(),
        kind: match lapsed.key.kind {
            LeaseKind::Advertise => StepKind::Advertise,
            LeaseKind::Request => StepKind::Request,
        },
        service: lapsed.key.service.to_string(),
        code: match lapsed.reason {
            LapseReason::Expired => WhyCode::LeaseExpired,
            LapseReason::Denied => WhyCode::AccessDenied,
            LapseReason::TooMany => WhyCode::TooManyLeases,
            LapseReason::SourceMismatch => WhyCode::SourceMismatch,
            LapseReason::NameNotExpressible => WhyCode::NameNotExpressible,
            LapseReason::NameCollision => WhyCode::NameCollision,
        },
        detail: lapsed.detail.clone(),
    };
    lapsed.map(hint).collect()
}
