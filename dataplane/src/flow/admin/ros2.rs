//! `GET /v1/ros2`: the ROS 2 network, and what of it is bridged.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use axum::extract::State;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use blaze_brokers::{Broker as _, Health};
use blaze_domain::control::LeaseKind;
use blaze_domain::{Scope, TopicName, WriterId};
use serde_json::{Value, json};

use super::super::ros2::{Refusal, Seen};
use super::{App, answer, refusal};
use crate::control::ControlCore;
use crate::registry::FoundEndpoint;
use crate::world::TopicEntry;

pub(super) async fn ros2(State(shared): App) -> Response {
    let Some(ros2) = &shared.ros2 else {
        let detail = "this flow is on no ROS 2 network: its node file has no brokers.plugins ros2";
        return refusal(StatusCode::NOT_FOUND, "not_found", detail);
    };
    let network = Arc::clone(&ros2.broker.network().borrow());
    let status = ros2.broker.status().borrow().clone();
    let control = shared.control.lock();
    let in_use = ros2.in_use(&control);
    let state = match status.health {
        _ if in_use.is_some() => "in_use",
        Health::Up => "up",
        _ => "down",
    };
    let mut detail = in_use.unwrap_or(status.detail);
    for (count, what) in [
        (network.refused, "endpoints beyond the limit"),
        (ros2.refused_shows(), "topics that other flows offer beyond those that may show"),
    ] {
        if count > 0 {
            detail = format!("{detail}; {count} {what}");
        }
    }
    let mut topics = BTreeMap::new();
    let endpoints: Vec<Value> = ros2
        .seen()
        .iter()
        .map(|seen| {
            let topic = seen.topic.as_ref().ok().map(|topic| {
                topics.entry(topic.clone()).or_insert_with(|| Facts::of(&control, topic))
            });
            row(seen, topic.as_deref())
        })
        .collect();
    let answers = json!({
        "domain": ros2.domain, "interface": ros2.interface, "state": state, "detail": detail,
        "guid_prefix": network.own.map(|own| own.to_string()), "node": shared.me.ros2_node(),
        "participants": network.participants, "endpoints": endpoints,
    });
    drop(control);
    answer(&shared, answers).into_response()
}

/// What the rows of one topic's endpoints need to know of it.
struct Facts {
    found: Vec<(FoundEndpoint, Option<String>)>,
    /// Whether something is read from the network, and written to it.
    bridged: [bool; 2],
    /// The types in which it is offered and asked for, anywhere, where all are known.
    types: [Option<BTreeSet<String>>; 2],
}

impl Facts {
    fn of(control: &ControlCore, topic: &TopicName) -> Self {
        let owned = |(endpoint, owner): (&FoundEndpoint, Option<&_>)| {
            (endpoint.clone(), owner.map(ToString::to_string))
        };
        let bridges = control.plans().get(topic).map_or(&[][..], |plan| &plan.bridges);
        let found: Vec<_> = control.registry().found(topic).map(owned).collect();
        let mut types = [Some(BTreeSet::new()), Some(BTreeSet::new())];
        let mut note = |at: usize, type_name: &str| match &mut types[at] {
            _ if type_name.is_empty() => types[at] = None,
            Some(types) => _ = types.insert(type_name.to_owned()),
            None => {}
        };
        for (endpoint, _) in &found {
            note(usize::from(endpoint.kind == LeaseKind::Request), &endpoint.type_name);
        }
        let entries = control.world().flows.values().filter_map(|flow| flow.topics.get(topic));
        for (scope, entry) in entries.flat_map(TopicEntry::scopes) {
            // Those of the network itself were found, type by type.
            if scope != Scope::Ros2 {
                entry.advertise.iter().for_each(|offer| note(0, &offer.type_name));
                entry.request.iter().for_each(|request| note(1, &request.type_name));
            }
        }
        Self {
            found,
            bridged: [
                bridges.iter().any(|bridge| bridge.from == Scope::Ros2),
                bridges.iter().any(|bridge| bridge.to.scope() == Scope::Ros2),
            ],
            types,
        }
    }

    /// Whether the other side has other types alone.
    fn is_mismatch(&self, is_writer: bool, type_name: &str) -> bool {
        let others = &self.types[usize::from(is_writer)];
        others.as_ref().is_some_and(|others| !others.is_empty() && !others.contains(type_name))
    }

    /// Whether the network itself has an endpoint that it meets.
    fn is_native(&self, is_writer: bool, type_name: &str) -> bool {
        let other = if is_writer { LeaseKind::Request } else { LeaseKind::Advertise };
        self.found.iter().any(|(found, _)| found.kind == other && found.type_name == type_name)
    }
}

fn row(seen: &Seen, facts: Option<&Facts>) -> Value {
    let endpoint = &seen.endpoint;
    let type_name = endpoint.type_name.as_deref();
    let guid = WriterId(endpoint.id);
    let mismatch = |facts: &&Facts| facts.is_mismatch(endpoint.is_writer, type_name.unwrap_or(""));
    let refused = match facts {
        None => seen.topic.as_ref().err().copied(),
        Some(facts) => Some(Refusal::TypeMismatch).filter(|_| mismatch(&facts)),
    };
    let state = match facts {
        _ if refused.is_some() => "refused",
        Some(facts) if facts.bridged[usize::from(!endpoint.is_writer)] => "bridged",
        Some(facts) if facts.is_native(endpoint.is_writer, type_name.unwrap_or("")) => "native",
        _ => "idle",
    };
    let owner = facts
        .filter(|_| endpoint.is_writer)
        .and_then(|facts| facts.found.iter().find(|(found, _)| found.guid == guid)?.1.clone());
    json!({
        "name": endpoint.name.to_string(), "kind": if endpoint.is_writer { "publisher" } else { "subscription" },
        "topic": seen.topic.as_ref().ok(), "type": type_name.unwrap_or(&endpoint.dds_type),
        "type_hash": endpoint.type_hash, "node": endpoint.node, "guid": guid.to_string(),
        "vendor": endpoint.vendor.as_str(),
        "reliability": if endpoint.reliable { "reliable" } else { "best_effort" },
        "durability": if endpoint.durable { "transient_local" } else { "volatile" },
        "owner": owner, "state": state,
        "code": refused.map_or(json!("ok"), |refusal| json!(refusal)),
    })
}
