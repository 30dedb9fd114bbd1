//! From what programs, services and the kernel say to what health is judged by.

use std::collections::BTreeMap;
use std::time::Instant;

use blaze_domain::{FlowId, Priority, WhyCode};
use serde_json::Value;

use crate::health::{
    ConfigState, FlowInput, Inputs, OffsetInput, ProgramInput, ServiceInput, TopicInput, Vitals,
};
use crate::node;
use crate::programs::{FlowView, Programs, WorkerView};
use crate::services::Sign;
use crate::settings::Expected;

/// Programs that were there once: since then their absence is a problem, too.
#[derive(Debug, Clone, Default)]
pub struct Seen {
    flows: BTreeMap<String, FlowId>,
    worker: bool,
}

impl Seen {
    /// Keeps in mind what answers now.
    pub fn note(&mut self, programs: &Programs) {
        for flow in &programs.flows {
            if let Some(name) = &flow.name {
                self.flows.insert(flow.address.clone(), name.clone());
            }
        }
        self.flows.retain(|address, _| programs.flows.iter().any(|flow| flow.address == *address));
        self.worker |= programs.worker.is_ready;
    }
}

/// All that health is judged by. `own` names a flow that never answered.
#[must_use]
pub fn inputs(
    own: &FlowId,
    programs: &Programs,
    (expected, seen): (Expected, &Seen),
    signs: Option<Vec<Sign>>,
    vitals: Vitals,
) -> Inputs {
    let is_there = |flow: &&FlowView| {
        expected.flow || flow.summary.is_some() || seen.flows.contains_key(&flow.address)
    };
    let flows = programs.flows.iter().filter(is_there).map(|flow| {
        let name = flow.name.as_ref().or_else(|| seen.flows.get(&flow.address)).unwrap_or(own);
        flow_input(name, flow)
    });
    let has_worker = expected.worker || seen.worker || programs.worker.is_ready;
    let worker = has_worker.then(|| ProgramInput {
        name: format!("worker {own}"),
        is_reachable: programs.worker.is_reachable,
        is_ready: programs.worker.is_ready,
        detail: programs.worker.detail.clone(),
        config_fault: programs.worker.config_fault.clone(),
    });
    let services = signs.map(|signs| {
        let now = Instant::now();
        signs.iter().map(|sign| service_input(own, sign, &programs.worker, now)).collect()
    });
    Inputs { vitals, flows: flows.collect(), worker, services }
}

fn flow_input(name: &FlowId, flow: &FlowView) -> FlowInput {
    let program = ProgramInput {
        name: name.to_string(),
        is_reachable: flow.summary.is_some(),
        is_ready: flow.is_ready(),
        detail: flow.away.clone(),
        config_fault: flow.config_fault.clone(),
    };
    let summary =
        flow.summary.as_ref().and_then(|summary| serde_json::from_value(summary.clone()).ok());
    let flowing = flow.topics.iter().filter_map(|row| topic_input(row, &flow.bridges));
    let topics = flowing.chain(flow.blocked.iter().filter_map(blocked_input)).collect();
    FlowInput { program, summary, topics }
}

/// A topic that flows.
fn topic_input(row: &Value, bridges: &[Value]) -> Option<TopicInput> {
    let topic = row["topic"].as_str()?;
    let advertised = row["advertised"].as_array()?;
    let local = advertised.iter().filter(|offer| offer["local"] == true);
    let rates: Vec<f64> = local.filter_map(|offer| offer["rate_hz"].as_f64()).collect();
    let of_topic = bridges.iter().filter(|bridge| bridge["topic"] == topic);
    let mut dropped: BTreeMap<String, u64> = BTreeMap::new();
    let mut class = None;
    for bridge in of_topic {
        class = class.or_else(|| bridge["class"].as_str()?.parse().ok());
        for (reason, count) in bridge["dropped"].as_object().into_iter().flatten() {
            *dropped.entry(reason.clone()).or_default() += count.as_u64().unwrap_or(0);
        }
    }
    let offered = advertised.iter().find_map(|offer| offer["priority"].as_str()?.parse().ok());
    Some(TopicInput {
        topic: topic.to_owned(),
        is_advertised: true,
        is_requested: row["requested"].as_array().is_some_and(|rows| !rows.is_empty()),
        code: WhyCode::Ok,
        detail: String::new(),
        advertised_hz: (!rates.is_empty()).then(|| rates.iter().sum()).filter(|rate| *rate > 0.0),
        rate_hz: row["rate_hz"].as_f64(),
        priority: class.or(offered).unwrap_or(Priority::Bulk),
        dropped,
    })
}

/// A topic that does not flow though it has both ends, from an answer to `/v1/why`.
fn blocked_input(why: &Value) -> Option<TopicInput> {
    let steps = why["steps"].as_array()?;
    let failed = steps.iter().find(|step| step["ok"] == false)?;
    let detail = match failed["detail"].as_str() {
        Some(detail) if !detail.is_empty() => {
            format!("{}: {detail}", failed["flow"].as_str().unwrap_or_default())
        }
        _ => String::new(),
    };
    Some(TopicInput {
        topic: why["topic"].as_str()?.to_owned(),
        is_advertised: true,
        is_requested: true,
        code: why["code"].as_str()?.parse().ok()?,
        detail,
        advertised_hz: None,
        rate_hz: None,
        priority: Priority::Bulk,
        dropped: BTreeMap::new(),
    })
}

fn service_input(own: &FlowId, sign: &Sign, worker: &WorkerView, now: Instant) -> ServiceInput {
    ServiceInput {
        service: sign.service.clone(),
        instance: sign.instance.clone(),
        state: sign.state,
        expires_in: sign.expires.saturating_duration_since(now),
        config: config_state(own, sign, worker),
    }
}

/// What the service has against what the worker delivered to it.
fn config_state(own: &FlowId, sign: &Sign, worker: &WorkerView) -> ConfigState {
    let rows = worker.status.as_ref().and_then(|status| status["services"].as_array());
    let is_same = |row: &&Value| {
        let is_here = row["node"].is_null() || row["node"] == own.node.as_str();
        is_here
            && row["service"] == sign.service.as_str()
            && row["instance"] == sign.instance.as_str()
    };
    let Some(row) = rows.and_then(|rows| rows.iter().find(is_same)) else {
        return ConfigState::Unknown;
    };
    if row["state"] == "rejected" {
        let detail = row["detail"].as_str().unwrap_or("it rejected the newest configuration");
        return ConfigState::Rejected(detail.to_owned());
    }
    match row["revision"].as_u64() {
        Some(delivered) if sign.config_revision > 0 && sign.config_revision < delivered => {
            // The revision goes on with the store also where nothing changed for this service.
            match row["hash"] == row["config_hash"] {
                true => ConfigState::Current,
                false => ConfigState::Stale { has: sign.config_revision, delivered },
            }
        }
        Some(_) => ConfigState::Current,
        None => ConfigState::Unknown,
    }
}

/// Values of the node, as health takes them. A clock that the kernel does not call synchronised is
/// judged by the other nodes alone: its stated error is then only a convention (16 s).
#[must_use]
pub fn vitals(of_node: node::Vitals, offsets: Vec<OffsetInput>) -> Vitals {
    Vitals {
        disks: of_node.disks,
        memory_available: of_node.memory_ratio,
        hottest: of_node.celsius_max,
        clock_error_s: of_node.clock_error_s.filter(|_| of_node.clock_synchronized == Some(true)),
        offsets,
        udp_buffer_errors: of_node.udp_buffer_errors_total.map(|count| count as u64),
        throttled_s: of_node.cgroup_throttled_s_total,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_topic_has_the_rates_of_publishers_here_and_the_drops_of_all_bridges() {
        let row = json!({"topic": "imu/data", "state": "flowing", "rate_hz": 49.9,
            "advertised": [{"rate_hz": 50.0, "local": true, "priority": null},
                           {"rate_hz": 10.0, "local": false}],
            "requested": [{"service": "log"}]});
        let bridge = |topic: &str, class: Value, drops: u64| json!({"topic": topic, "class": class, "dropped": {"queue_full": drops}});
        let bridges = [
            bridge("imu/data", json!(null), 1),
            bridge("imu/data", json!("state"), 2),
            bridge("scan", json!("bulk"), 9),
        ];
        let input = topic_input(&row, &bridges).unwrap();
        assert_eq!((input.advertised_hz, input.rate_hz), (Some(50.0), Some(49.9)));
        assert_eq!((input.priority, input.dropped["queue_full"]), (Priority::State, 3));
    }

    #[test]
    fn a_blocked_topic_has_the_code_of_why_and_the_step_that_failed() {
        let why = json!({"topic": "imu/data", "code": "type_mismatch", "steps": [
            {"flow": "edge/a", "step": "advertise", "ok": true, "code": "ok", "detail": ""},
            {"flow": "edge/a", "step": "plan", "ok": false, "code": "type_mismatch", "detail": "A, B"},
        ]});
        let input = blocked_input(&why).unwrap();
        assert_eq!((input.code, input.detail.as_str()), (WhyCode::TypeMismatch, "edge/a: A, B"));
        assert!(blocked_input(&json!({})).is_none());
    }

    #[test]
    fn only_programs_that_belong_here_or_were_here_are_missed() {
        let own: FlowId = "edge/robot-1".parse().unwrap();
        let away = FlowView { address: "a".to_owned(), ..FlowView::default() };
        let programs = Programs { flows: vec![away], ..Programs::default() };
        let found = |expected: Expected, seen: &Seen| {
            let inputs = inputs(&own, &programs, (expected, seen), None, Vitals::default());
            (inputs.flows.len(), inputs.worker.is_some())
        };
        let (none, both) =
            (Expected { flow: false, worker: false }, Expected { flow: true, worker: true });
        let mut seen = Seen::default();
        assert_eq!(found(none, &seen), (0, false));
        assert_eq!(found(both, &seen), (1, true));
        let mut before = programs.clone();
        before.flows[0].name = Some(own.clone());
        before.worker.is_ready = true;
        seen.note(&before);
        assert_eq!(found(none, &seen), (1, true));
    }
}
