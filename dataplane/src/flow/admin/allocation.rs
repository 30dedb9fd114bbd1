//! `/v1/allocation`: which rate each topic gets at each destination, and what the links carry.

use std::time::Instant;

use axum::Json;
use axum::extract::State;
use blaze_domain::LayerName;
use serde_json::{Value, json};

use super::{App, answer, rounded};
use crate::flow::Shared;
use crate::flow::pacing::LayerTraffic;
use crate::lane::allocation::{LaneFacts, TopicFacts};
use crate::limit::limiter::Limiter;

/// Topics that are looked at while the message path waits.
const AT_ONCE: usize = 256;

pub(super) async fn allocation(State(shared): App) -> Json<Value> {
    let now = Instant::now();
    let topics: Vec<Value> = facts(&shared, now).iter().map(topic_row).collect();
    let mut traffic = shared.egress.traffic();
    let limiter = shared.limiter.lock();
    let mut layers = limiter.layers();
    layers.extend(traffic.by_layer.keys().cloned());
    let links: Vec<Value> = layers
        .iter()
        .map(|layer| link_row(now, layer, traffic.by_layer.get_mut(layer), &limiter))
        .collect();
    let bandwidth = limiter.bandwidth();
    let body = json!({
        "limit_mbps": bandwidth.limit_mbps, "budget_bytes_per_s": bandwidth.limit_bytes_per_s(),
        "measured_bytes_per_s": limiter.measured_bytes_per_s(None),
        "wire_factor": limiter.wire_factor(None).map(rounded_finely),
        "feasible": limiter.last().is_none_or(|last| last.feasible), "share": bandwidth.share,
        "wire_bytes": traffic.wire_bytes, "control_wire_bytes": traffic.control_bytes,
        "allocations": limiter.runs(),
        "topics": topics, "links": links,
    });
    drop(limiter);
    answer(&shared, body)
}

/// What there is to say of all topics that leave, taken bit by bit.
fn facts(shared: &Shared, now: Instant) -> Vec<TopicFacts> {
    let mut all = Vec::new();
    let mut after = None;
    loop {
        let (some, last) =
            shared.plane.read(|state| state.core.allocation_facts(now, after, AT_ONCE));
        all.extend(some);
        if last.is_none() {
            return all;
        }
        after = last;
    }
}

fn link_row(
    now: Instant,
    layer: &LayerName,
    traffic: Option<&mut LayerTraffic>,
    limiter: &Limiter,
) -> Value {
    let last = limiter.last();
    let wire_bytes_per_s = traffic.map_or(0.0, |traffic| traffic.rate.rate(now).1);
    json!({
        "layer": layer, "limit_bytes_per_s": limiter.bandwidth().link_limit_bytes_per_s(layer),
        "measured_bytes_per_s": limiter.measured_bytes_per_s(Some(layer)),
        "wire_factor": limiter.wire_factor(Some(layer)).map(rounded_finely),
        "load_bytes_per_s": last.and_then(|last| last.load_bytes_per_s.get(layer)),
        "feasible": last.map(|last| !last.infeasible_links.contains(layer)),
        "wire_bytes_per_s": wire_bytes_per_s.round(),
    })
}

/// One topic that leaves on the inter scope.
fn topic_row(topic: &TopicFacts) -> Value {
    let granted = &topic.granted;
    json!({
        "topic": topic.name, "class": granted.class.as_str(), "size_bytes": granted.size_bytes,
        "compression": compression(topic), "advertised_hz": rounded(granted.advertised_hz),
        "published_hz": rounded(topic.published_hz),
        "lanes": topic.lanes.iter().map(lane_row).collect::<Vec<_>>(),
    })
}

/// What compression does to a topic; null where it does nothing.
fn compression(topic: &TopicFacts) -> Value {
    let stats = &topic.compress_stats;
    if stats.messages == 0 {
        return Value::Null;
    }
    json!({
        "level": topic.level, "messages": stats.messages, "bytes_before": stats.before,
        "bytes_after": stats.after,
        "ratio": rounded(stats.after as f64 / stats.before.max(1) as f64),
        "cpu_ms": rounded(stats.seconds * 1e3 / stats.messages as f64),
        "as_it_is": topic.level == 0,
    })
}

fn lane_row(lane: &LaneFacts) -> Value {
    json!({
        "layer": lane.receiver.layer, "flow": lane.receiver,
        "allocated_hz": lane.allocated_hz.map(rounded_finely),
        "actual_hz": rounded(lane.actual_hz), "asked_hz": lane.asked_hz, "limited": lane.limited,
        "exceeds_advertised": lane.exceeds_advertised, "skipped": lane.skipped,
        "queued": lane.queued,
        "wait_ms": {"p50": lane.waits.quantile_ms(0.5), "p99": lane.waits.quantile_ms(0.99)},
    })
}

/// Rates are compared with what was reckoned, so they keep more places than what is only shown.
fn rounded_finely(number: f64) -> Value {
    json!((number * 1e6).round() / 1e6)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use blaze_domain::node_file::{BandwidthSection, LinkLimit};

    use super::*;

    /// A link with a limit is shown before anything went there, and what was not measured is null.
    #[test]
    fn a_link_without_traffic_says_what_is_known_of_it() {
        let cloud: LayerName = "cloud".parse().unwrap();
        let mut limiter = Limiter::new(BandwidthSection {
            links: [(cloud.clone(), LinkLimit { limit_mbps: 8.0 })].into(),
            ..BandwidthSection::default()
        });
        assert_eq!(limiter.layers(), BTreeSet::from([cloud.clone()]));
        limiter.run(Instant::now(), &[]);
        let row = link_row(Instant::now(), &cloud, None, &limiter);
        let expected = json!({
            "layer": "cloud", "limit_bytes_per_s": 1_048_576.0, "measured_bytes_per_s": null,
            "wire_factor": null,
            "load_bytes_per_s": null, "feasible": true, "wire_bytes_per_s": 0.0,
        });
        assert_eq!(row, expected);
    }
}
