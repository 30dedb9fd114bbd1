//! `GET /v1/summary`: the flow at a glance, as short with 5,000 topics as with one. It walks over no
//! topics and bridges: the sums are kept where topics are planned, and every two seconds where
//! bridges are marked.

use std::collections::BTreeMap;

use axum::Json;
use axum::extract::State;
use blaze_domain::FlowId;
use blaze_runtime::admin::ReadinessStatus;
use serde_json::{Value, json};

use super::super::Shared;
use super::super::routes::SourceState;
use super::{App, answer, dropped, rounded};
use crate::lane::stats::{Phases, Totals};
use crate::link::PeerInfo;

pub(super) async fn summary(State(shared): App) -> Json<Value> {
    let sources = shared.routes.not_subscribed();
    let (totals, unattributed, peers, sources) = shared.plane.read(|state| {
        let core = &state.core;
        let sources: Vec<(SourceState, u64)> = sources
            .into_iter()
            .map(|(topic, from, state)| (state, core.bridges_up_from(topic, from)))
            .collect();
        let peers = state.engine.as_ref().map(crate::link::Engine::peers).unwrap_or_default();
        (core.totals().clone(), core.unattributed.clone(), peers, sources)
    });
    let mut all_dropped = totals.dropped.clone();
    for (reason, count) in unattributed.iter() {
        all_dropped.add(reason, count);
    }
    let control = shared.control.lock();
    let topics: BTreeMap<&str, u64> =
        control.topic_states().map(|(state, count)| (state.as_str(), count)).collect();
    let registry_version = control.registry().announced().0;
    drop(control);
    let is_ready = shared.readiness.report().status == ReadinessStatus::Ready;
    let links: Vec<Value> = peers.iter().map(|peer| link(&shared, peer, &totals)).collect();
    let feasible = shared
        .limiter
        .lock()
        .last()
        .is_none_or(|last| last.process_feasible && last.infeasible_links.is_empty());
    answer(
        &shared,
        json!({
            "state": if is_ready { "ready" } else { "not_ready" },
            "topics": topics, "bridges": bridges(totals.phases, &sources),
            "in": {"messages": totals.taken.messages, "bytes": totals.taken.bytes},
            "out": {"messages": totals.out.messages, "bytes": totals.out.bytes},
            "dropped": dropped(&all_dropped), "feasible": feasible,
            "registry_version": registry_version, "links": links,
        }),
    )
}

/// Bridges by state. Those that are up in the plan and whose source is not subscribed are
/// `starting` or `failed`.
fn bridges(phases: Phases, sources: &[(SourceState, u64)]) -> Value {
    let (mut starting, mut failed) = (0, 0);
    for (state, bridges) in sources {
        match state {
            SourceState::Starting => starting += bridges,
            SourceState::Failed(_) => failed += bridges,
            SourceState::Subscribed => {}
        }
    }
    let counts = [
        ("starting", starting),
        ("up", phases.up.saturating_sub(starting + failed)),
        ("draining", phases.draining),
        ("failed", phases.failed + failed),
    ];
    json!(counts.into_iter().filter(|(_, count)| *count > 0).collect::<BTreeMap<_, _>>())
}

/// The link to one flow. The limit is that of its layer.
fn link(shared: &Shared, peer: &PeerInfo, totals: &Totals) -> Value {
    let flow: &FlowId = &peer.flow;
    let limit = {
        let limiter = shared.limiter.lock();
        limiter.bandwidth().link_limit_bytes_per_s(&flow.layer)
    };
    json!({
        "flow": flow, "state": peer.state,
        "rtt_ms": peer.rtt.map(|rtt| rounded(rtt.as_secs_f64() * 1e3)),
        "loss": rounded(peer.loss),
        "wire_bytes_per_s": peer.receiving_bytes_per_s.round(),
        "limit_bytes_per_s": limit.unwrap_or_else(|| shared.egress.budget()),
        "queued_bytes": peer.queue_bytes.iter().sum::<usize>(),
        "dropped": totals.dropped_to.get(flow).copied().unwrap_or(0),
    })
}
