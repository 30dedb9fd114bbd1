//! `/v1/allocation`: which rate each topic gets at each destination, and what the links carry.

use std::collections::BTreeMap;
use std::time::Instant;

use axum::Json;
use axum::extract::State;
use blaze_domain::{DropReason, LayerName};
use serde_json::{Value, json};

use super::{App, answer, rounded};
use crate::lane::path::{BridgeState, Phase, TopicPath};

pub(super) async fn allocation(State(shared): App) -> Json<Value> {
    let now = Instant::now();
    let mut traffic = shared.egress.traffic();
    let topics: Vec<Value> = shared.plane.read(|state| {
        let paths = state.core.topics_mut();
        paths.filter_map(|(_, path)| topic_row(now, path)).collect()
    });
    let mut wire: BTreeMap<LayerName, f64> = BTreeMap::new();
    for destination in &mut traffic.by_destination {
        *wire.entry(destination.flow.layer.clone()).or_default() += destination.rate.rate(now).1;
    }
    let limiter = shared.limiter.lock();
    let (process, links) = limiter.budgets();
    let measured = &limiter.measured().capacity_bytes_per_s;
    let factor = |budget: &crate::limit::limiter::Budget| rounded_finely(budget.wire_factor());
    let link_rows: Vec<Value> = wire
        .into_iter()
        .map(|(layer, rate)| {
            let budget = links.get(&layer);
            json!({
                "layer": layer, "limit_bytes_per_s": limiter.bandwidth().link_limit_bytes_per_s(&layer),
                "measured_bytes_per_s": measured.get(&layer), "wire_factor": budget.map(factor),
                "load_bytes_per_s": limiter.last().and_then(|last| last.load_bytes_per_s.get(&layer)),
                "feasible": limiter.last().map(|last| !last.infeasible_links.contains(&layer)),
                "wire_bytes_per_s": rate.round(),
            })
        })
        .collect();
    let total_measured = (!measured.is_empty()).then(|| measured.values().sum::<f64>());
    let body = json!({
        "limit_mbps": limiter.bandwidth().limit_mbps, "budget_bytes_per_s": limiter.bandwidth().limit_bytes_per_s(),
        "measured_bytes_per_s": total_measured, "wire_factor": factor(&process),
        "feasible": limiter.last().is_none_or(|last| last.feasible), "share": limiter.bandwidth().share,
        "wire_bytes": traffic.wire_bytes, "control_wire_bytes": traffic.control_bytes, "allocations": limiter.runs(),
        "topics": topics, "links": link_rows,
    });
    drop(limiter);
    answer(&shared, body)
}

/// One topic that leaves on the inter scope.
fn topic_row(now: Instant, path: &mut TopicPath) -> Option<Value> {
    let granted = path.granted?;
    let mut lanes = Vec::new();
    for bridge in path.bridges.iter_mut().filter(|bridge| bridge.phase != Phase::Ended) {
        lanes.extend(lane_row(now, bridge));
    }
    if lanes.is_empty() {
        return None;
    }
    Some(json!({
        "topic": path.name, "class": granted.class.as_str(), "size_bytes": granted.size_bytes,
        "compression": compression(path), "advertised_hz": rounded(granted.advertised_hz), "published_hz": rounded(path.in_rate.rate(now).0), "lanes": lanes,
    }))
}

/// What compression does to a topic; null where it does nothing.
fn compression(path: &TopicPath) -> Value {
    let press = &path.press;
    if press.messages == 0 {
        return Value::Null;
    }
    json!({
        "level": press.level, "messages": press.messages, "bytes_before": press.before, "bytes_after": press.after,
        "ratio": rounded(press.after as f64 / press.before.max(1) as f64),
        "cpu_ms": rounded(press.seconds * 1e3 / press.messages as f64), "as_it_is": path.effort.goes_as_it_is(),
    })
}

fn lane_row(now: Instant, bridge: &mut BridgeState) -> Option<Value> {
    let (layer, flow) = bridge.receiver().map(|(layer, flow)| (layer.clone(), flow.clone()))?;
    let actual = bridge.out_rate.rate(now).0;
    let stats = &bridge.stats;
    Some(json!({
        "layer": layer, "flow": flow, "allocated_hz": bridge.allocated_hz.map(rounded_finely), "actual_hz": rounded(actual),
        "asked_hz": bridge.lane.max_rate_hz, "limited": bridge.gate.is_limited(),
        "skipped": stats.dropped.get(DropReason::RateLimit) + stats.dropped.get(DropReason::MaxRate), "queued": stats.queued(),
        "wait_ms": {"p50": stats.latency.quantile_ms(0.5), "p99": stats.latency.quantile_ms(0.99)},
    }))
}

/// Rates are compared with what was reckoned, so they keep more places than what is only shown.
fn rounded_finely(number: f64) -> Value {
    json!((number * 1e6).round() / 1e6)
}
