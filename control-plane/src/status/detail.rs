//! What is read of a summary when somebody looks: problems, services, links.

use std::collections::BTreeMap;

use blaze_domain::{FlowId, LayerName};
use serde::Deserialize;
use serde_json::{Value, json};

use super::health::Health;
use super::limits::{MAX_FLOWS, MAX_LINKS, MAX_PROBLEMS, MAX_SERVICES, MAX_TEXT_CHARS};

/// What is read when somebody asks.
#[derive(Debug, Default)]
pub struct Detail {
    /// When the state began, in the words of the monitor.
    pub since: String,
    /// The first problems of node and services.
    pub problems: Vec<HealthProblem>,
    /// Problems beyond those.
    pub left_out: usize,
    /// Services: name, instance, state, since, codes.
    pub services: Vec<ServiceHealth>,
    /// Links of the node's flows.
    pub links: Vec<Link>,
}

/// Something that is wrong, as `/v1/health` has it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct HealthProblem {
    /// The worst first.
    pub state: Health,
    /// When it began, RFC 3339.
    pub since: String,
    /// What kind.
    pub code: String,
    /// `node`, `service`, `topic`, `link` or `layer`.
    pub scope: String,
    /// Of what.
    pub name: String,
    /// What is seen.
    pub detail: String,
    /// What to do.
    pub remedy: String,
}

impl HealthProblem {
    /// As JSON, with the members of the contract.
    #[must_use]
    pub fn to_json(&self) -> Value {
        json!({
            "code": self.code, "scope": self.scope, "name": self.name,
            "state": self.state.as_str(), "since": self.since, "detail": self.detail,
            "remedy": self.remedy,
        })
    }
}

/// A service as its node's monitor sees it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServiceHealth {
    /// Service.
    pub service: String,
    /// Instance.
    pub instance: String,
    /// State.
    pub state: Health,
    /// Since when, RFC 3339.
    pub since: String,
    /// Codes of its problems.
    pub codes: Vec<String>,
}

/// The link of a flow to another.
#[derive(Debug, Clone, PartialEq)]
pub struct Link {
    /// The flow that says so.
    pub from: FlowId,
    /// The other flow.
    pub to: FlowId,
    /// `up`, `suspect` or `down`.
    pub state: String,
    /// Round trip, in ms.
    pub rtt_ms: Option<f64>,
    /// Lost fraction, 0 to 1.
    pub loss: Option<f64>,
    /// Bytes on the wire per second.
    pub bytes_per_s: Option<f64>,
    /// Limit of the link, in the same unit.
    pub limit_bytes_per_s: Option<f64>,
    /// Bytes that wait.
    pub queued_bytes: Option<f64>,
    /// Messages dropped since the start.
    pub dropped: u64,
}

impl Detail {
    /// Reads the text of a summary; what cannot be read is left out. `layer` is that of the node.
    #[must_use]
    pub fn read(text: &str, layer: &LayerName) -> Self {
        let read: DetailText = serde_json::from_str(text).unwrap_or_default();
        read.detail(layer)
    }
}

#[derive(Deserialize, Default)]
struct DetailText {
    #[serde(default)]
    health: HealthText,
    #[serde(default)]
    flows: Vec<Value>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct HealthText {
    since: Value,
    problems: Vec<Value>,
    services: Vec<Value>,
}

impl DetailText {
    fn detail(self, layer: &LayerName) -> Detail {
        let services: Vec<(ServiceHealth, Vec<HealthProblem>)> =
            self.health.services.iter().filter_map(service).take(MAX_SERVICES).collect();
        let of_services = services.iter().flat_map(|(_, problems)| problems);
        let of_node = self.health.problems.iter().filter_map(problem);
        // A problem of a service may stand at the node, too.
        let mut problems: BTreeMap<(String, String, String), HealthProblem> = BTreeMap::new();
        for found in of_node.chain(of_services.cloned()) {
            let key = (found.code.clone(), found.scope.clone(), found.name.clone());
            problems.entry(key).or_insert(found);
        }
        let mut problems: Vec<HealthProblem> = problems.into_values().collect();
        problems.sort_by(worst_first);
        let left_out = problems.len().saturating_sub(MAX_PROBLEMS);
        problems.truncate(MAX_PROBLEMS);
        let links = self.flows.iter().take(MAX_FLOWS).flat_map(|flow| links_of(flow, layer));
        Detail {
            since: text(&self.health.since),
            problems,
            left_out,
            services: services.into_iter().map(|(service, _)| service).collect(),
            links: links.take(MAX_LINKS).collect(),
        }
    }
}

/// The worst first, then the oldest.
#[must_use]
pub fn worst_first(a: &HealthProblem, b: &HealthProblem) -> std::cmp::Ordering {
    let place = |problem: &HealthProblem| (problem.code.clone(), problem.name.clone());
    b.state.cmp(&a.state).then_with(|| a.since.cmp(&b.since)).then_with(|| place(a).cmp(&place(b)))
}

/// A text for people: short, without control characters.
fn text(value: &Value) -> String {
    let letters = value.as_str().unwrap_or_default().chars();
    letters.filter(|letter| !letter.is_control()).take(MAX_TEXT_CHARS).collect()
}

fn problem(value: &Value) -> Option<HealthProblem> {
    let member = |name: &str| text(&value[name]);
    let code = member("code");
    (!code.is_empty()).then(|| HealthProblem {
        code,
        state: Health::of_word(&member("state")),
        since: member("since"),
        scope: member("scope"),
        name: member("name"),
        detail: member("detail"),
        remedy: member("remedy"),
    })
}

fn service(value: &Value) -> Option<(ServiceHealth, Vec<HealthProblem>)> {
    let service = text(&value["service"]);
    let problems: Vec<HealthProblem> =
        value["problems"].as_array().into_iter().flatten().filter_map(problem).collect();
    (!service.is_empty()).then(|| {
        let health = ServiceHealth {
            service,
            instance: text(&value["instance"]),
            state: Health::of_word(value["state"].as_str().unwrap_or_default()),
            since: text(&value["since"]),
            codes: problems.iter().map(|problem| problem.code.clone()).collect(),
        };
        (health, problems)
    })
}

fn links_of<'v>(flow: &'v Value, layer: &LayerName) -> impl Iterator<Item = Link> + use<'v> {
    let from: Option<FlowId> = flow["flow"].as_str().and_then(|name| name.parse().ok());
    let from = from.filter(|from| from.layer == *layer);
    let links = from.and_then(|from| Some((from, flow["links"].as_array()?)));
    links.into_iter().flat_map(|(from, links)| {
        links.iter().filter_map(move |link| {
            let number = |name: &str| link[name].as_f64();
            Some(Link {
                from: from.clone(),
                to: link["flow"].as_str()?.parse().ok()?,
                state: text(&link["state"]),
                rtt_ms: number("rtt_ms"),
                loss: number("loss"),
                bytes_per_s: number("wire_bytes_per_s"),
                limit_bytes_per_s: number("limit_bytes_per_s"),
                queued_bytes: number("queued_bytes"),
                dropped: link["dropped"].as_u64().unwrap_or_default(),
            })
        })
    })
}
