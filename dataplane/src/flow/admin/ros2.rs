//! `GET /v1/ros2`: the ROS 2 network, and what of it is bridged.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use axum::extract::{Query, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use blaze_brokers::{Broker as _, Health};
use blaze_convert::definition_text;
use blaze_domain::control::LeaseKind;
use blaze_domain::{Scope, TopicName, WriterId};
use serde_json::{Value, json};

use super::super::Shared;
use super::super::definitions::wait_for;
use super::super::ros2::{Refusal, Ros2Scope, Seen};
use super::{App, answer, query_text, refusal};
use crate::control::ControlCore;
use crate::types::MessageType;
use crate::world::TopicEntry;

pub(super) async fn ros2(State(shared): App) -> Response {
    let Some(ros2) = &shared.ros2 else {
        let detail = "this flow is on no ROS 2 network: its node file has no brokers.plugins ros2";
        return refusal(StatusCode::NOT_FOUND, "not_found", detail);
    };
    let seen = ros2.seen();
    let answers = network(&shared, ros2, &seen);
    let answers = with_types(&shared, answers, &seen).await;
    answer(&shared, answers).into_response()
}

fn network(shared: &Shared, ros2: &Ros2Scope, seen: &[Seen]) -> Value {
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
    let (pending, given_up) = ros2.broker.requests();
    for (count, what) in [
        (network.refused as u64, "endpoints beyond the limit"),
        (ros2.refused_shows() as u64, "topics that other flows offer beyond those that may show"),
        (given_up, "requests were given up, since too many of their clients waited (queue_full)"),
    ] {
        if count > 0 {
            detail = format!("{detail}; {count} {what}");
        }
    }
    let endpoints: Vec<Value> = rows(seen, &control).iter().map(Row::json).collect();
    json!({
        "domain": ros2.domain, "interface": ros2.interface, "state": state, "detail": detail,
        "guid_prefix": network.own.map(|own| own.to_string()), "node": shared.me.ros2_node(),
        "participants": network.participants, "endpoints": endpoints,
        "calls": {"pending": pending + control.pending_calls()},
    })
}

/// Adds the types of the endpoints, and where their definitions come from.
async fn with_types(shared: &Arc<Shared>, mut answers: Value, seen: &[Seen]) -> Value {
    let of_endpoint = |seen: &Seen| {
        let endpoint = &seen.endpoint;
        let name = endpoint.type_name.clone()?;
        Some(MessageType { name, hash: endpoint.type_hash.clone().unwrap_or_default() })
    };
    let names: BTreeSet<_> = seen.iter().filter_map(of_endpoint).collect();
    let types = Arc::clone(&shared.types);
    let found = move || {
        let row = |of: &MessageType| {
            let found = types.find(of.borrowed());
            let source = found.map_or("none", |found| found.source.as_str());
            let hash = Some(&of.hash).filter(|hash| !hash.is_empty());
            json!({"type": of.name, "hash": hash, "source": source})
        };
        names.iter().map(row).collect::<Vec<_>>()
    };
    // Files may be read.
    let found = tokio::task::spawn_blocking(found).await;
    answers["types"] = json!(found.unwrap_or_default());
    answers
}

/// `GET /v1/ros2/types?type=pkg/msg/Name`: the definition of a type.
pub(super) async fn types(State(shared): App, query: Query<BTreeMap<String, String>>) -> Response {
    let Some(name) = query_text(&query, "type").filter(|name| !name.is_empty()) else {
        let detail = "the parameter type is missing: /v1/ros2/types?type=sensor_msgs/msg/Imu";
        return refusal(StatusCode::BAD_REQUEST, "invalid_request", detail);
    };
    let sought = MessageType { name: name.clone(), hash: String::new() };
    let Some(found) = wait_for(&shared.types, sought).await else {
        let detail = format!(
            "no definition of {name}: it is not built in, nor in a folder of brokers.plugins ros2 \
             interfaces, and no node or flow has sent it"
        );
        return refusal(StatusCode::NOT_FOUND, "type_unknown", &detail);
    };
    let body = json!({
        "type": name, "hash": found.hash.to_string(), "source": found.source.as_str(),
        "definition": definition_text(&found.description),
    });
    answer(&shared, body).into_response()
}

/// What the rows of one topic's endpoints need to know of it. Of pairs the first one is for what is
/// offered, the second for what is asked for.
struct Facts {
    owners: HashMap<WriterId, String>,
    /// Whether something is read from the network, and written to it.
    bridged: [bool; 2],
    /// Types of the network's own endpoints.
    native: [BTreeSet<String>; 2],
    /// Types of all, where each is known.
    types: [Option<BTreeSet<String>>; 2],
}

impl Facts {
    fn of(control: &ControlCore, topic: &TopicName) -> Self {
        let bridges = control.plans().get(topic).map_or(&[][..], |plan| &plan.bridges);
        let mut facts = Self {
            owners: HashMap::new(),
            bridged: [
                bridges.iter().any(|bridge| bridge.from == Scope::Ros2),
                bridges.iter().any(|bridge| bridge.to.scope() == Scope::Ros2),
            ],
            native: Default::default(),
            types: [Some(BTreeSet::new()), Some(BTreeSet::new())],
        };
        for (endpoint, owner) in control.registry().found(topic) {
            let side = usize::from(endpoint.kind == LeaseKind::Request);
            facts.native[side].insert(endpoint.type_name.clone());
            facts.note(side, &endpoint.type_name);
            facts.owners.extend(owner.map(|owner| (endpoint.guid, owner.to_string())));
        }
        let entries = control.world().flows.values().filter_map(|flow| flow.topics.get(topic));
        for (scope, entry) in entries.flat_map(TopicEntry::scopes) {
            // Those of the network itself were found, type by type.
            if scope != Scope::Ros2 {
                entry.advertise.iter().for_each(|offer| facts.note(0, &offer.type_name));
                entry.request.iter().for_each(|request| facts.note(1, &request.type_name));
            }
        }
        facts
    }

    fn note(&mut self, side: usize, type_name: &str) {
        if type_name.is_empty() {
            self.types[side] = None;
        } else if let Some(types) = &mut self.types[side] {
            types.insert(type_name.to_owned());
        }
    }

    /// Whether the other side has other types alone.
    fn is_mismatch(&self, side: usize, type_name: &str) -> bool {
        let others = &self.types[1 - side];
        others.as_ref().is_some_and(|others| !others.is_empty() && !others.contains(type_name))
    }
}

/// One endpoint, and what becomes of it.
pub(in crate::flow) struct Row<'a> {
    seen: &'a Seen,
    pub(in crate::flow) kind: &'static str,
    owner: Option<String>,
    pub(in crate::flow) state: &'static str,
    refused: Option<Refusal>,
}

/// All endpoints that were found.
pub(in crate::flow) fn rows<'a>(seen: &'a [Seen], control: &ControlCore) -> Vec<Row<'a>> {
    let mut topics = BTreeMap::new();
    let row = |seen: &'a Seen| {
        let facts = seen.topic.as_ref().ok();
        let facts =
            facts.map(|topic| &*topics.entry(topic).or_insert_with(|| Facts::of(control, topic)));
        Row::of(seen, facts)
    };
    seen.iter().map(row).collect()
}

impl<'a> Row<'a> {
    fn of(seen: &'a Seen, facts: Option<&Facts>) -> Self {
        let endpoint = &seen.endpoint;
        let (is_writer, side) = (endpoint.is_writer, usize::from(!endpoint.is_writer));
        let type_name = endpoint.type_name.as_deref().unwrap_or_default();
        let refused = match facts {
            None => seen.topic.as_ref().err().copied(),
            Some(facts) => facts.is_mismatch(side, type_name).then_some(Refusal::TypeMismatch),
        };
        let state = match facts {
            _ if refused.is_some() => "refused",
            Some(facts) if facts.bridged[side] => "bridged",
            Some(facts) if facts.native[1 - side].contains(type_name) => "native",
            _ => "idle",
        };
        let owner =
            facts.filter(|_| is_writer).and_then(|it| it.owners.get(&WriterId(endpoint.id)));
        let owner = owner.cloned();
        let kind = if is_writer { "publisher" } else { "subscription" };
        Self { seen, kind, owner, state, refused }
    }

    fn json(&self) -> Value {
        let endpoint = &self.seen.endpoint;
        json!({
            "name": endpoint.name.to_string(), "kind": self.kind,
            "topic": self.seen.topic.as_ref().ok(),
            "type": endpoint.type_name.as_deref().unwrap_or(&endpoint.dds_type),
            "type_hash": endpoint.type_hash, "node": endpoint.node,
            "guid": WriterId(endpoint.id).to_string(), "vendor": endpoint.vendor.as_str(),
            "reliability": if endpoint.reliable { "reliable" } else { "best_effort" },
            "durability": if endpoint.durable { "transient_local" } else { "volatile" },
            "owner": self.owner, "state": self.state,
            "code": self.refused.map_or(json!("ok"), |refusal| json!(refusal)),
        })
    }
}
