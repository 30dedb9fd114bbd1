//! Asks flows and worker once a second, and hands what they say to pings, latency and health.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use blaze_domain::{FlowId, TopicName};
use serde_json::Value;

use crate::gather::{self, Seen};
use crate::health::OffsetInput;
use crate::latency::FlowFigures;
use crate::limits::{LOOK, LOOK_CLOSER, LOOK_CLOSER_AT_LEAST};
use crate::ping::LinkOffset;
use crate::programs::{Closeness, FlowView, Programs, link_offsets, ping_requesters};
use crate::shared::Shared;

/// A closer look comes at most so often that the answers of a flow take this part of its time: one
/// with thousands of topics needs longer.
const PART_OF_TIME: u32 = 20;

/// Looks, for ever.
pub async fn run(shared: Arc<Shared>) {
    let mut seen = Seen::default();
    let mut next_closer = Instant::now();
    let mut live = shared.live_changes();
    loop {
        let began = Instant::now();
        let is_closer = began >= next_closer;
        let settings = shared.live();
        let before = shared.programs();
        let closeness = match (is_closer, settings.subscribes()) {
            (false, _) => Closeness::Summary,
            (true, false) => Closeness::Closer,
            (true, true) => Closeness::AllTopics,
        };
        let programs = Programs::look(&settings.flows, &settings.worker, &before, closeness).await;
        seen.note(&programs);
        if is_closer {
            follow_flows(&shared, &programs).await;
            let took = programs.flows.iter().map(|flow| flow.took).max().unwrap_or_default();
            let pause = (took * PART_OF_TIME).clamp(LOOK_CLOSER, LOOK_CLOSER_AT_LEAST);
            next_closer = began + pause;
        }
        judge(&shared, &programs, &seen);
        shared.set_programs(programs);
        tokio::select! {
            () = tokio::time::sleep(LOOK.saturating_sub(began.elapsed())) => {}
            Ok(()) = live.changed() => {}
        }
    }
}

/// Pings and latency learn what flows know.
async fn follow_flows(shared: &Shared, programs: &Programs) {
    let figures: Vec<FlowFigures> =
        programs.flows.iter().filter_map(|flow| figures(&shared.me, flow)).collect();
    let answering = programs.flows.iter().find(|flow| flow.summary.is_some());
    let requesters = match answering {
        Some(flow) => Some(ping_requesters(&flow.address, &programs.layers()).await),
        None => None,
    };
    let mut latency = shared.latency.lock();
    let measured: Vec<FlowId> = figures
        .iter()
        .flat_map(|figures| &figures.publishers)
        .filter(|(topic, _)| {
            topic.parse::<TopicName>().is_ok_and(|topic| latency.rule_of(&topic).is_some())
        })
        .flat_map(|(_, nodes)| nodes.clone())
        .collect();
    latency.observe(figures);
    drop(latency);
    let (own, others): (Vec<_>, Vec<_>) =
        programs.flows.iter().partition(|flow| flow.name.as_ref() == Some(&shared.me));
    shared.pings.with(|engine, now| {
        if let Some(requesters) = requesters {
            engine.set_requesters(now, requesters);
        }
        engine.set_measured(now, measured);
        engine.set_links(now, own.into_iter().flat_map(offsets));
        let relayed = others.into_iter();
        engine
            .set_relayed(now, relayed.filter_map(|flow| Some((flow.name.clone()?, offsets(flow)))));
    });
}

fn offsets(flow: &FlowView) -> Vec<(FlowId, LinkOffset)> {
    let offsets = link_offsets(&flow.peers).into_iter();
    offsets.map(|(flow, (offset_s, error_s))| (flow, LinkOffset { offset_s, error_s })).collect()
}

/// What latency needs of a flow.
fn figures(own: &FlowId, flow: &FlowView) -> Option<FlowFigures> {
    let name = flow.name.clone()?;
    let summary = flow.summary.as_ref()?;
    let links = summary["links"].as_array().into_iter().flatten();
    let publishers: BTreeMap<String, Vec<FlowId>> = flow
        .topics
        .iter()
        .filter_map(|row| Some((row["topic"].as_str()?.to_owned(), publishers(row))))
        .collect();
    Some(FlowFigures {
        is_here: name == *own || name.layer == own.layer,
        flow: name,
        bridges: flow.bridges.iter().filter_map(parsed).collect(),
        links: links.filter_map(parsed).collect(),
        publishers,
    })
}

fn parsed<T: serde::de::DeserializeOwned>(value: &Value) -> Option<T> {
    serde_json::from_value(value.clone()).ok()
}

/// Nodes that advertise the topic of a row.
fn publishers(row: &Value) -> Vec<FlowId> {
    let advertised = row["advertised"].as_array().into_iter().flatten();
    advertised
        .filter_map(|offer| {
            let (layer, node) = (offer["layer"].as_str()?, offer["node"].as_str()?);
            Some(FlowId::new(layer.parse().ok()?, node.parse().ok()?))
        })
        .collect()
}

fn judge(shared: &Shared, programs: &Programs, seen: &Seen) {
    let values = shared.vitals();
    shared.pings.set_synchronized(values.clock_synchronized == Some(true));
    let offsets = shared.pings.read(|engine, now| {
        let nodes = engine.view(now).nodes.into_iter();
        let known = nodes.filter_map(|node| {
            Some(OffsetInput {
                offset_s: node.clock_offset_ms? / 1e3,
                error_s: node.clock_error_ms? / 1e3,
                node: FlowId::new(node.layer, node.node),
            })
        });
        known.collect()
    });
    let vitals = gather::vitals(values, offsets);
    let signs = shared.signs.now(Instant::now());
    let expected = shared.live().expected;
    let inputs = gather::inputs(&shared.me, programs, (expected, seen), signs, vitals);
    shared.judge(&inputs);
}
