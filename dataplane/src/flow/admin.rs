//! `GET /v1/…`: what the flow knows and does, as JSON. Each answer also names the flow, its epoch
//! and the time.

mod allocation;
mod peers;
pub(super) mod ros2;
mod summary;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

use axum::extract::{Query, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Json, Router};
use blaze_domain::control::{LeaseKind, rfc3339_millis};
use blaze_domain::{Scope, ServiceName, TopicName};
use serde_json::{Map, Value, json};

use super::Shared;
use super::plane::wall_ms;
use super::routes::SourceState;
use crate::control::{ControlCore, TopicState};
use crate::lane::path::{BridgeState, Phase, Sink, TopicPath};
use crate::lane::stats::Drops;
use crate::plan::{Form, Target, TopicPlan};
use crate::registry::{FoundEndpoint, LeaseView, Terms};
use crate::world::{Advertise, Request};

type App = State<Arc<Shared>>;

/// What a question is about: one topic, those in a state, or all.
#[derive(serde::Deserialize)]
struct Asked {
    topic: Option<String>,
    state: Option<String>,
}

impl Asked {
    fn includes(&self, topic: &TopicName) -> bool {
        self.topic.as_deref().is_none_or(|asked| asked == topic.as_str())
    }
}

/// The routes below `/v1`.
pub(super) fn router(shared: Arc<Shared>) -> Router {
    Router::new()
        .route("/v1/topics", get(topics))
        .route("/v1/bridges", get(bridges))
        .route("/v1/peers", get(peers::peers))
        .route("/v1/allocation", get(allocation::allocation))
        .route("/v1/ros2", get(ros2::ros2))
        .route("/v1/ros2/types", get(ros2::types))
        .route("/v1/summary", get(summary::summary))
        .route("/v1/why", get(super::why::why))
        .with_state(shared)
}

/// An answer with the flow's name, epoch and the time before its own members.
pub(super) fn answer(shared: &Shared, body: Value) -> Json<Value> {
    let mut whole = Map::new();
    whole.insert("flow".into(), json!(shared.me));
    whole.insert("epoch".into(), json!(shared.epoch.load(Ordering::Relaxed)));
    whole.insert("time".into(), json!(rfc3339_millis(wall_ms())));
    if let Value::Object(members) = body {
        whole.extend(members);
    }
    Json(Value::Object(whole))
}

/// A refusal.
pub(super) fn refusal(status: StatusCode, code: &str, detail: &str) -> Response {
    (status, Json(json!({"error": {"code": code, "detail": detail}}))).into_response()
}

/// Rounds for people: three digits behind the point.
fn rounded(value: f64) -> Value {
    json!((value * 1000.0).round() / 1000.0)
}

async fn topics(State(shared): App, Query(asked): Query<Asked>) -> Json<Value> {
    let now = Instant::now();
    let rates: BTreeMap<TopicName, (f64, f64)> = shared.plane.read(|state| {
        let topics = state.core.topics_mut();
        topics
            .filter(|(_, path)| asked.includes(&path.name))
            .map(|(_, path)| (path.name.clone(), path.in_rate.rate(now)))
            .collect()
    });
    let control = shared.control.lock();
    let registry = control.registry();
    let no_plan = TopicPlan::default();
    let mut rows = Vec::new();
    let topics: Vec<TopicName> = match (&asked.topic, &asked.state) {
        (Some(topic), _) => topic.parse().into_iter().collect(),
        (None, Some(state)) => control.topics_in_state(state).cloned().collect(),
        (None, None) => registry.all_topics().into_iter().collect(),
    };
    for topic in topics {
        let mut advertised: Vec<Value> = Vec::new();
        let mut requested: Vec<Value> = Vec::new();
        for lease in registry.leases_of(&topic) {
            let row = lease_row(&shared, now, &lease);
            match lease.key.kind {
                LeaseKind::Advertise => advertised.push(row),
                LeaseKind::Request => requested.push(row),
            }
        }
        for (endpoint, owner) in registry.found(&topic) {
            let row = found_row(&shared, endpoint);
            match endpoint.kind {
                LeaseKind::Advertise if owner == Some(&shared.me) => advertised.push(row),
                LeaseKind::Advertise => {}
                LeaseKind::Request => requested.push(row),
            }
        }
        for remote in registry.remote_leases(&topic) {
            advertised.extend(
                remote
                    .advertise
                    .iter()
                    .flat_map(|a| remote_advertise(remote.flow, remote.scope, a)),
            );
            requested.extend(
                remote.request.iter().map(|r| remote_request(remote.flow, remote.scope, r)),
            );
        }
        let sides = (!advertised.is_empty(), !requested.is_empty());
        let plan = control.plans().get(&topic).unwrap_or(&no_plan);
        let Some(state) = TopicState::of(sides, plan).map(TopicState::as_str) else {
            continue;
        };
        let (rate_hz, bytes_per_s) = rates.get(&topic).copied().unwrap_or_default();
        rows.push(json!({
            "topic": topic, "state": state, "rate_hz": rounded(rate_hz),
            "bytes_per_s": bytes_per_s.round(),
            "advertised": advertised, "requested": requested,
        }));
    }
    drop(control);
    answer(&shared, json!({"topics": rows}))
}

fn broker_of(shared: &Shared, scope: Scope) -> Value {
    json!(shared.brokers.of(scope).map(|broker| broker.kind().as_str()))
}

fn lease_row(shared: &Shared, now: Instant, lease: &LeaseView<'_>) -> Value {
    let key = lease.key;
    let quality = lease.quality();
    let mut row = json!({
        "layer": key.layer, "node": key.node.as_ref().map_or("", |node| node.as_str()),
        "service": key.service,
        "instance": key.instance, "scope": key.scope, "broker": broker_of(shared, key.scope),
    });
    let terms = match lease.terms {
        Terms::Advertise { rate_hz, max_bytes, .. } => {
            json!({"rate_hz": rate_hz, "max_bytes": max_bytes})
        }
        Terms::Request { max_rate_hz, bare, json, from, .. } => json!({
            "max_rate_hz": max_rate_hz, "lifespan_ms": quality.lifespan_ms, "bare": bare,
            "json": json, "from": (!from.is_any())
                .then(|| json!({"layer": from.layer, "node": from.node, "service": from.service})),
        }),
    };
    extend(&mut row, terms);
    extend(
        &mut row,
        json!({
            "priority": quality.priority, "reliability": quality.reliability,
            "durability": quality.durability,
            "type": quality.type_name, "type_hash": quality.type_hash,
            "encoding": quality.encoding,
            "expires_in_s": lease.expires_in(now).map(|left| rounded(left.as_secs_f64())),
            "local": true,
        }),
    );
    row
}

/// A writer or reader of the ROS 2 network.
fn found_row(shared: &Shared, endpoint: &FoundEndpoint) -> Value {
    json!({
        "layer": shared.me.layer, "node": shared.me.node,
        "service": ServiceName::of_ros2_node(&endpoint.node), "instance": "0",
        "scope": Scope::Ros2, "broker": "ros2", "ros_node": endpoint.node,
        "guid": endpoint.guid.to_string(), "lifespan_ms": endpoint.lifespan_ms,
        "reliability": endpoint.reliability, "durability": endpoint.durability,
        "type": endpoint.type_name, "type_hash": endpoint.type_hash,
        "encoding": "application/cdr", "expires_in_s": null, "local": true,
    })
}

fn extend(row: &mut Value, more: Value) {
    if let (Value::Object(row), Value::Object(more)) = (row, more) {
        row.extend(more);
    }
}

/// What another flow announced: its services merged, so that per-service rates are not known.
fn remote_advertise(
    flow: &blaze_domain::FlowId,
    scope: Scope,
    advertise: &Advertise,
) -> Vec<Value> {
    let row = |source: &crate::world::Source| {
        json!({
            "layer": layer_of(flow, scope), "node": source.node, "service": source.service,
            "instance": "", "scope": scope,
            "broker": null, "rate_hz": advertise.rate_hz, "max_bytes": advertise.max_bytes,
            "priority": advertise.priority, "reliability": advertise.reliability,
            "durability": advertise.durability, "type": advertise.type_name,
            "type_hash": advertise.type_hash, "encoding": advertise.encoding,
            "expires_in_s": null, "local": false, "flow": flow,
        })
    };
    advertise.sources.iter().map(row).collect()
}

/// The layer of what a flow tells of a scope: what a gateway tells of flows outside is of any
/// other, so empty.
fn layer_of(flow: &blaze_domain::FlowId, scope: Scope) -> &str {
    if scope == Scope::Inter { "" } else { flow.layer.as_str() }
}

fn remote_request(flow: &blaze_domain::FlowId, scope: Scope, request: &Request) -> Value {
    json!({
        "layer": layer_of(flow, scope),
        "node": if scope == Scope::Node { flow.node.as_str() } else { "" }, "service": "",
        "instance": "", "scope": scope, "broker": null, "max_rate_hz": request.max_rate_hz,
        "lifespan_ms": request.lifespan_ms, "bare": request.bare, "priority": request.priority,
        "reliability": request.reliability, "durability": request.durability,
        "json": request.json, "type": request.type_name, "type_hash": request.type_hash,
        "encoding": null, "expires_in_s": null, "local": false,
        "flow": flow,
        "services": request.services.iter().map(|service| json!({
            "node": service.node, "service": service.service,
        })).collect::<Vec<_>>(),
        "more_services": request.more_services,
    })
}

async fn bridges(State(shared): App, Query(asked): Query<Asked>) -> Json<Value> {
    let now = Instant::now();
    // First the places, then whether they are subscribed: the two locks are never held together.
    let (mut rows, before_bridges) = shared.plane.read(|state| {
        let mut rows = Vec::new();
        let mut before_bridges: Vec<Value> =
            dropped_row("", &state.core.unattributed).into_iter().collect();
        let topics = state.core.topics_mut().filter(|(_, path)| asked.includes(&path.name));
        for (id, path) in topics {
            before_bridges.extend(dropped_row(path.name.as_str(), &path.ingress_drops));
            path.bridges.iter_mut().for_each(|bridge| {
                bridge.settle();
            });
            for bridge in path.bridges.iter().filter(|bridge| bridge.phase != Phase::Ended) {
                rows.push((id, bridge.from, bridge_row(&shared, now, path, bridge)));
            }
        }
        (rows, before_bridges)
    });
    for (id, from, row) in &mut rows {
        if row["state"] != "up" {
            continue;
        }
        match shared.routes.source_state(*id, *from) {
            SourceState::Subscribed => {}
            SourceState::Starting => row["state"] = json!("starting"),
            SourceState::Failed(reason) => {
                row["state"] = json!("failed");
                row["detail"] = json!(reason);
            }
        }
    }
    let rows: Vec<Value> = rows.into_iter().map(|(_, _, row)| row).collect();
    // What another flow on the same layer broker carries out of the layer.
    let control = shared.control.lock();
    let plans = control.plans().iter();
    let not_owner: Vec<Value> = plans
        .filter(|(topic, _)| asked.includes(topic))
        .filter_map(|(topic, plan)| Some(json!({"topic": topic, "owner": plan.carrier.as_ref()?})))
        .collect();
    let balance = balance(now, &control);
    drop(control);
    let answers = json!({
        "bridges": rows, "not_owner": not_owner, "balance": balance,
        "dropped_before_bridges": before_bridges,
    });
    answer(&shared, answers)
}

fn dropped(drops: &Drops) -> Map<String, Value> {
    drops.iter().map(|(reason, count)| (reason.as_str().to_owned(), json!(count))).collect()
}

/// Messages of a topic that were dropped before a bridge took them; nothing if there are none.
fn dropped_row(topic: &str, drops: &Drops) -> Option<Value> {
    let dropped = dropped(drops);
    (!dropped.is_empty()).then(|| json!({"topic": topic, "dropped": dropped}))
}

/// How much this flow carries, and the topics that it gave to other flows of its layer.
fn balance(now: Instant, control: &ControlCore) -> Value {
    let (load, moves) = (control.load(), control.moves());
    let last = moves.last.as_ref().map(|last| {
        json!({
            "topic": last.topic, "to": last.to, "reason": last.reason.as_str(),
            "ago_s": rounded(now.saturating_duration_since(last.at).as_secs_f64()),
        })
    });
    json!({
        "out_bytes_per_s": load.out_bytes_per_s, "in_bytes_per_s": load.in_bytes_per_s,
        "moves": {
            "load": moves.by_load,
            "settled": moves.settled,
            "taken_back": moves.taken_back,
        }, "last_move": last,
    })
}

fn scope_and_broker(shared: &Shared, scope: Scope) -> Value {
    let broker = if scope == Scope::Inter { json!("dds") } else { broker_of(shared, scope) };
    json!({"scope": scope, "broker": broker})
}

/// `imu/data|node>inter|cloud`; where one layer has several receivers, the receiver's node follows.
fn bridge_id(path: &TopicPath, bridge: &BridgeState, own_layer: &str) -> String {
    let topic = &path.name;
    let from = bridge.from;
    match &bridge.target {
        target @ (Target::Node(_) | Target::Layer { .. } | Target::Ros2) => {
            let form = match target {
                Target::Node(Form::Bare) => "|bare",
                target if target.is_json() => "|json",
                _ => "",
            };
            format!("{topic}|{from}>{}|{own_layer}{form}", target.scope())
        }
        Target::Inter { layer, receiver } => {
            let same_layer = |other: &&BridgeState| {
                other.from == from
                    && other.phase != Phase::Ended
                    && other.receiver().is_some_and(|(other_layer, _)| other_layer == layer)
            };
            let several = path.bridges.iter().filter(same_layer).count() > 1;
            let node = if several { format!("|{}", receiver.node) } else { String::new() };
            format!("{topic}|{from}>inter|{layer}{node}")
        }
    }
}

fn bridge_row(shared: &Shared, now: Instant, path: &TopicPath, bridge: &BridgeState) -> Value {
    let (state, since) = match bridge.phase {
        Phase::Up { since } => ("up", now.saturating_duration_since(since).as_secs_f64()),
        Phase::Failed { since } => ("failed", now.saturating_duration_since(since).as_secs_f64()),
        Phase::Draining { .. } | Phase::Ended => ("draining", 0.0),
    };
    let (layer, flow) = match &bridge.target {
        Target::Node(_) | Target::Layer { .. } | Target::Ros2 => {
            (shared.me.layer.to_string(), shared.me.to_string())
        }
        Target::Inter { layer, receiver } => (layer.to_string(), receiver.to_string()),
    };
    let mut to = scope_and_broker(shared, bridge.target.scope());
    extend(&mut to, json!({"layer": layer, "flow": flow}));
    let dropped = dropped(&bridge.stats.dropped);
    let class = match bridge.sink {
        Sink::Lane { class, .. } => json!(class),
        Sink::Publish { .. } => Value::Null,
    };
    json!({
        "id": bridge_id(path, bridge, shared.me.layer.as_str()), "topic": path.name,
        "from": scope_and_broker(shared, bridge.from), "to": to, "state": state,
        "since_s": rounded(since),
        "in": {"messages": bridge.stats.taken.messages, "bytes": bridge.stats.taken.bytes},
        "out": {"messages": bridge.stats.out.messages, "bytes": bridge.stats.out.bytes},
        "load_bytes_per_s": bridge.load(), "queued": bridge.stats.queued(), "dropped": dropped,
        "latency_ms": {
            "p50": bridge.stats.latency.quantile_ms(0.5),
            "p99": bridge.stats.latency.quantile_ms(0.99),
        },
        "age_ms": bridge.receiver().is_none().then(|| {
            let ages = bridge.stats.ages.all();
            json!({"p50": ages.quantile_ms(0.5), "p99": ages.quantile_ms(0.99)})
        }),
        "detail": bridge.failure, "class": class, "reliable": bridge.lane.reliable,
        "max_rate_hz": bridge.lane.max_rate_hz,
        "lifespan_ms": bridge.lane.lifespan_ms,
    })
}

/// Largest topic name plus room for `to`: anything longer is no question.
const MAX_QUERY: usize = 1024;

/// `topic` and `to` of a question, checked for length.
pub(super) fn query_text(query: &Query<BTreeMap<String, String>>, key: &str) -> Option<String> {
    query.get(key).filter(|text| text.len() <= MAX_QUERY).cloned()
}
