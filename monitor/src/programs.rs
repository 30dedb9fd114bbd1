//! What the flows and the worker of this node say on their admin ports.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use blaze_domain::{FlowId, LayerName};
use blaze_runtime::http::{GetLimits, get};
use futures::StreamExt as _;
use serde_json::Value;
use tokio::net::lookup_host;
use tokio::time::timeout;

use crate::limits::{ANSWER, MAX_BLOCKED, MAX_FLOWS, RESOLVE};

/// Questions at a time.
const AT_ONCE: usize = 8;

/// What a flow says.
#[derive(Debug, Clone, Default)]
pub struct FlowView {
    /// Where it is asked.
    pub address: String,
    /// Its name, once it has answered.
    pub name: Option<FlowId>,
    /// Its answer to `/v1/summary`; `None`: it does not answer.
    pub summary: Option<Value>,
    /// Why it does not answer, or is not ready.
    pub away: String,
    /// Fault of its configuration, with which it goes on as before.
    pub config_fault: Option<String>,
    /// Rows of `/v1/peers`, some seconds old.
    pub peers: Vec<Value>,
    /// Rows of `/v1/bridges`, some seconds old.
    pub bridges: Vec<Value>,
    /// Rows of `/v1/topics` of those that flow, some seconds old.
    pub topics: Vec<Value>,
    /// Rows of `/v1/topics` of those that nobody requests, if they were asked for.
    pub unrequested: Vec<Value>,
    /// Answers to `/v1/why` about topics that are blocked, some seconds old.
    pub blocked: Vec<Value>,
    /// How long it took to answer all but its summary, the last time.
    pub took: Duration,
}

/// What is asked besides the summary.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Closeness {
    /// Nothing.
    Summary,
    /// Peers, bridges, topics that flow, and why others are blocked.
    Closer,
    /// Besides, topics that nobody requests.
    AllTopics,
}

impl FlowView {
    /// Whether it is ready.
    #[must_use]
    pub fn is_ready(&self) -> bool {
        self.summary.as_ref().is_some_and(|summary| summary["state"] == "ready")
    }
}

/// What the worker says.
#[derive(Debug, Clone, Default)]
pub struct WorkerView {
    /// Its answer to `/v1/status`; `None`: it does not answer.
    pub status: Option<Value>,
    /// Whether it answers at all.
    pub is_reachable: bool,
    /// Whether `/readyz` says ready.
    pub is_ready: bool,
    /// Fault of its configuration, with which it goes on as before.
    pub config_fault: Option<String>,
    /// Why it is not ready, or does not answer.
    pub detail: String,
}

/// The programs of this node.
#[derive(Debug, Clone, Default)]
pub struct Programs {
    /// In the order of `monitor.flows`.
    pub flows: Vec<FlowView>,
    /// The worker.
    pub worker: WorkerView,
}

impl Programs {
    /// Asks all of them. `before` is the last answer: what is asked more rarely is taken from it
    /// where it is not asked now.
    pub async fn look(flows: &[String], worker: &str, before: &Self, closeness: Closeness) -> Self {
        let addresses = addresses(flows).await;
        let flows = futures::stream::iter(addresses)
            .map(|address| {
                let known = before.flows.iter().find(|flow| flow.address == address);
                look_at_flow(address, known.cloned().unwrap_or_default(), closeness)
            })
            .buffered(AT_ONCE);
        let (flows, worker) = tokio::join!(flows.collect::<Vec<_>>(), look_at_worker(worker));
        Self { flows, worker }
    }

    /// States of the flows and of their links, by their names.
    #[must_use]
    pub fn states(&self) -> BTreeMap<String, String> {
        let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
        let summaries = self.flows.iter().filter_map(|flow| flow.summary.as_ref());
        let states = summaries.flat_map(|summary| {
            let flow = text(&summary["flow"]);
            let links = summary["links"].as_array().into_iter().flatten();
            let links: Vec<(String, String)> = links
                .map(|link| (format!("{flow}>{}", text(&link["flow"])), text(&link["state"])))
                .collect();
            links.into_iter().chain([(flow, text(&summary["state"]))])
        });
        states.collect()
    }

    /// Layers that a flow here knows, with their own ones.
    #[must_use]
    pub fn layers(&self) -> BTreeSet<LayerName> {
        let peers = self.flows.iter().flat_map(|flow| &flow.peers);
        let of_peers = peers.filter_map(|peer| peer["layer"].as_str()?.parse().ok());
        let own = self.flows.iter().filter_map(|flow| flow.name.as_ref());
        of_peers.chain(own.map(|name| name.layer.clone())).collect()
    }
}

/// One address for each of a name.
async fn addresses(flows: &[String]) -> Vec<String> {
    let mut out: Vec<String> = Vec::new();
    for flow in flows {
        let found: Vec<SocketAddr> = match flow.parse::<SocketAddr>() {
            Ok(address) => vec![address],
            Err(_) => match timeout(RESOLVE, lookup_host(flow.as_str())).await {
                Ok(Ok(found)) => found.collect(),
                Ok(Err(_)) | Err(_) => Vec::new(),
            },
        };
        match found.is_empty() {
            true => out.push(flow.clone()),
            false => out.extend(found.iter().map(ToString::to_string)),
        }
    }
    let mut seen = BTreeSet::new();
    out.retain(|address| seen.insert(address.clone()));
    out.truncate(MAX_FLOWS);
    out
}

async fn look_at_flow(address: String, before: FlowView, closeness: Closeness) -> FlowView {
    let (summary, ready) = tokio::join!(json(&address, "/v1/summary", ANSWER), readiness(&address));
    let summary = match summary {
        Ok(summary) => summary,
        Err(away) => return FlowView { address, name: before.name, away, ..FlowView::default() },
    };
    let name = summary["flow"].as_str().and_then(|name| name.parse().ok());
    let view = FlowView {
        name,
        away: ready.detail,
        config_fault: ready.config_fault,
        address: address.clone(),
        ..before
    };
    if closeness == Closeness::Summary {
        return FlowView { summary: Some(summary), ..view };
    }
    let began = Instant::now();
    let is_blocked = summary["topics"]["blocked"].as_u64().unwrap_or(0) > 0;
    let (peers, bridges, topics, unrequested, blocked) = tokio::join!(
        rows(&address, "/v1/peers", "peers"),
        rows(&address, "/v1/bridges", "bridges"),
        rows(&address, "/v1/topics?state=flowing", "topics"),
        async {
            match closeness {
                Closeness::AllTopics => {
                    rows(&address, "/v1/topics?state=no_request", "topics").await
                }
                Closeness::Summary | Closeness::Closer => Some(Vec::new()),
            }
        },
        async {
            match is_blocked {
                true => blocked(&address).await,
                false => Vec::new(),
            }
        }
    );
    // What is not answered now stays as it was: no row would mean that nothing is there.
    FlowView {
        summary: Some(summary),
        peers: peers.unwrap_or(view.peers),
        bridges: bridges.unwrap_or(view.bridges),
        topics: topics.unwrap_or(view.topics),
        unrequested: unrequested.unwrap_or(view.unrequested),
        blocked,
        took: began.elapsed(),
        ..view
    }
}

/// Why the topics that are blocked do not flow, of the first ones.
async fn blocked(address: &str) -> Vec<Value> {
    let topics = rows(address, "/v1/topics?state=blocked", "topics").await.unwrap_or_default();
    let names = topics.iter().filter(|row| row["state"] == "blocked");
    let names = names.filter_map(|row| Some(row["topic"].as_str()?.to_owned()));
    let names: Vec<String> = names.take(MAX_BLOCKED).collect();
    let address = address.to_owned();
    futures::stream::iter(names)
        .map(move |topic| why(address.clone(), topic))
        .buffered(AT_ONCE)
        .filter_map(|why| async { why })
        .collect()
        .await
}

async fn why(address: String, topic: String) -> Option<Value> {
    json(&address, &format!("/v1/why?topic={topic}"), ANSWER).await.ok()
}

async fn look_at_worker(address: &str) -> WorkerView {
    let (ready, status) = tokio::join!(readiness(address), json(address, "/v1/status", ANSWER));
    WorkerView {
        status: status.ok(),
        is_reachable: ready.is_reachable,
        is_ready: ready.is_ready,
        config_fault: ready.config_fault,
        detail: ready.detail,
    }
}

/// What `/readyz` of a program says.
#[derive(Debug, Default, PartialEq)]
struct Ready {
    is_reachable: bool,
    is_ready: bool,
    /// Checks that fail, or why it does not answer; empty while it is ready.
    detail: String,
    config_fault: Option<String>,
}

async fn readiness(address: &str) -> Ready {
    match get(address, "/readyz", ANSWER).await {
        Ok((code, body)) => ready(code == 200, &body),
        Err(error) => Ready { detail: format!("{address}: {error}"), ..Ready::default() },
    }
}

fn ready(is_ready: bool, body: &[u8]) -> Ready {
    let report: Value = serde_json::from_slice(body).unwrap_or_default();
    let checks = report["checks"].as_object().into_iter().flatten();
    let failed = checks.filter(|(_, check)| check["status"] == "failed");
    let detail = |check: &Value| check["detail"].as_str().unwrap_or_default().to_owned();
    let config_fault =
        failed.clone().find(|(name, _)| *name == "config").map(|(_, check)| detail(check));
    let words: Vec<String> =
        failed.map(|(name, check)| format!("{name}: {}", detail(check))).collect();
    let detail = if is_ready { String::new() } else { words.join("; ") };
    Ready { is_reachable: true, is_ready, detail, config_fault }
}

/// Nodes whose monitors request the pings of a layer, as a flow knows them.
pub async fn ping_requesters(address: &str, layers: &BTreeSet<LayerName>) -> BTreeSet<FlowId> {
    let mut out = BTreeSet::new();
    for layer in layers {
        let path = format!("/v1/topics?topic=blaze/ping/{layer}");
        for topic in rows(address, &path, "topics").await.unwrap_or_default() {
            out.extend(requesters(layer, &topic));
        }
    }
    out
}

/// The nodes of a layer that request a topic, of its row in `/v1/topics`.
fn requesters(layer: &LayerName, topic: &Value) -> Vec<FlowId> {
    let requested = topic["requested"].as_array().into_iter().flatten();
    let rows = requested.filter(|row| row["layer"] == layer.as_str());
    let names = rows.flat_map(|row| {
        let services = row["services"].as_array().into_iter().flatten();
        services.map(|service| &service["node"]).chain([&row["node"]])
    });
    names
        .filter_map(Value::as_str)
        .filter_map(|node| Some(FlowId::new(layer.clone(), node.parse().ok()?)))
        .collect()
}

/// Offsets of the clocks of the other flows, as a flow knows them: seconds, with their errors.
#[must_use]
pub fn link_offsets(peers: &[Value]) -> BTreeMap<FlowId, (f64, f64)> {
    peers
        .iter()
        .filter(|peer| peer["state"] == "up")
        .filter_map(|peer| {
            let flow = peer["flow"].as_str()?.parse().ok()?;
            let offset = peer["clock_offset_ms"].as_f64()? / 1e3;
            Some((flow, (offset, peer["clock_error_ms"].as_f64()? / 1e3)))
        })
        .collect()
}

/// The rows of an answer; `None`: there is none.
async fn rows(address: &str, path: &str, member: &str) -> Option<Vec<Value>> {
    match json(address, path, ANSWER).await {
        Ok(mut body) => match body[member].take() {
            Value::Array(rows) => Some(rows),
            _ => None,
        },
        Err(error) => {
            tracing::debug!(address, path, error, "no answer");
            None
        }
    }
}

/// The JSON object that `path` answers with.
async fn json(address: &str, path: &str, limits: GetLimits) -> Result<Value, String> {
    let (status, body) =
        get(address, path, limits).await.map_err(|error| format!("{address}: {error}"))?;
    if status != 200 {
        return Err(format!("{address}: status {status}"));
    }
    serde_json::from_slice(&body).map_err(|error| format!("{address}: no JSON: {error}"))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn requesters_are_found_among_merged_services_and_own_leases() {
        let topic = json!({"topic": "blaze/ping/edge", "requested": [
            {"layer": "edge", "node": "robot-1", "service": "blaze-monitor"},
            {"layer": "edge", "node": "", "service": "", "flow": "edge/robot-2",
             "services": [{"node": "robot-2", "service": "blaze-monitor"},
                          {"node": "Not a name!", "service": "x"}]},
            {"layer": "fog", "node": "fog-1", "service": "blaze-monitor"},
        ]});
        let found = requesters(&"edge".parse().unwrap(), &topic);
        let names: Vec<String> = found.iter().map(ToString::to_string).collect();
        assert_eq!(names, ["edge/robot-1", "edge/robot-2"]);
    }

    #[test]
    fn readiness_names_the_checks_that_fail_and_a_fault_of_the_configuration() {
        let checks = json!({"checks": {
            "config": {"status": "failed", "detail": "blaze.yaml:3: no"},
            "inter": {"status": "failed", "detail": "no interface"},
            "node_broker": {"status": "ok", "detail": "redis"},
        }});
        let body = checks.to_string();
        let not_ready = ready(false, body.as_bytes());
        assert_eq!(not_ready.detail, "config: blaze.yaml:3: no; inter: no interface");
        let is_ready = ready(true, body.as_bytes());
        assert_eq!(is_ready.detail, "");
        assert_eq!(is_ready.config_fault.as_deref(), Some("blaze.yaml:3: no"));
        assert_eq!(
            ready(true, b"no json"),
            Ready { is_reachable: true, is_ready: true, ..Ready::default() }
        );
    }

    #[test]
    fn another_state_of_a_link_is_another_state() {
        let programs = |state: &str| {
            let links = json!([{"flow": "fog/f", "state": state, "rtt_ms": 1.0}]);
            let summary = json!({"flow": "edge/a", "state": "ready", "links": links});
            let flow = FlowView { summary: Some(summary), ..FlowView::default() };
            Programs { flows: vec![flow], ..Programs::default() }
        };
        let states = programs("up").states();
        assert_eq!(states["edge/a>fog/f"], "up");
        assert_eq!(states["edge/a"], "ready");
        assert_ne!(states, programs("down").states());
    }

    #[test]
    fn only_links_that_are_up_give_an_offset() {
        let peer = |flow: &str, state: &str, offset: Value| json!({"flow": flow, "state": state, "clock_offset_ms": offset, "clock_error_ms": 2.0});
        let offsets = link_offsets(&[
            peer("fog/fog-1", "up", json!(-3000.0)),
            peer("fog/fog-2", "down", json!(1.0)),
            peer("fog/fog-3", "up", Value::Null),
        ]);
        assert_eq!(offsets, [("fog/fog-1".parse().unwrap(), (-3.0, 0.002))].into());
    }
}
