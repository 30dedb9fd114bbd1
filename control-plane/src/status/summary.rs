//! One summary of a node: the text as it came, the few values that every evaluation needs, and the
//! rest, which is read when somebody asks for it.
//!
//! ```text
//! text ─▶ Head     state, ready flows, sums: at arrival, one pass that keeps no names
//!      ├▶ seen_up  hashes of flows whose link is up: when some node is late
//!      └▶ Detail   problems, services, links: when somebody looks
//! ```

use std::collections::BTreeMap;
use std::fmt;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::sync::OnceLock;

use blaze_domain::{FlowId, LayerName};
use serde::Deserialize;
use serde::de::{Deserializer, IgnoredAny, MapAccess, Visitor};
use serde_json::{Value, json};

use super::health::{Health, Now};
use super::limits::{MAX_FLOWS, MAX_LINKS, MAX_PROBLEMS, MAX_SERVICES, MAX_TEXT_CHARS};

/// A summary, and when it came.
#[derive(Debug)]
pub struct Report {
    text: Box<str>,
    /// When it came.
    pub arrived: Now,
    /// What is looked at of every summary.
    pub head: Head,
    seen_up: OnceLock<Box<[u64]>>,
    detail: OnceLock<Detail>,
}

/// What is looked at of every summary.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Head {
    /// State of the node, as its monitor says.
    pub state: Health,
    /// CPU in use, 0 to 1.
    pub cpu_ratio: Option<f64>,
    /// Memory in use, 0 to 1.
    pub memory_ratio: Option<f64>,
    /// The hottest sensor.
    pub celsius: Option<f64>,
    /// Flows that answered.
    pub flows: usize,
    /// Those of them that are ready.
    pub ready_flows: usize,
    /// Topics that the flows know.
    pub topics: u64,
    /// Messages since the flows started.
    pub sums: Sums,
}

/// Messages since the flows started.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Sums {
    /// Taken in.
    pub taken: u64,
    /// Given out.
    pub given: u64,
    /// Dropped.
    pub dropped: u64,
}

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

/// A summary that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the summary cannot be read: {0}")]
pub struct BadSummary(String);

impl Report {
    /// Reads what every evaluation needs.
    ///
    /// # Errors
    /// If it is no summary.
    pub fn read(text: String, arrived: Now) -> Result<Self, BadSummary> {
        let read: QuickText<'_> =
            serde_json::from_str(&text).map_err(|error| BadSummary(error.to_string()))?;
        let head = read.head();
        Ok(Self {
            text: text.into_boxed_str(),
            arrived,
            head,
            seen_up: OnceLock::new(),
            detail: OnceLock::new(),
        })
    }

    /// The text, as it came.
    #[must_use]
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Flows to which a flow of this node has a link that is up, as [`flow_hash`].
    pub fn seen_up(&self) -> &[u64] {
        self.seen_up.get_or_init(|| {
            let links: LinksText<'_> = serde_json::from_str(&self.text).unwrap_or_default();
            let links = links.flows.into_iter().flatten().flat_map(|flow| flow.links);
            links.filter(|link| link.state == "up").map(|link| flow_hash(&link.flow)).collect()
        })
    }

    /// Problems, services and links; `layer` is that of the node: flows of others are not its
    /// matter.
    pub fn detail(&self, layer: &LayerName) -> &Detail {
        self.detail.get_or_init(|| {
            let read: DetailText = serde_json::from_str(&self.text).unwrap_or_default();
            read.detail(layer)
        })
    }

    /// What was read for somebody who looked.
    #[must_use]
    pub fn known_detail(&self) -> Option<&Detail> {
        self.detail.get()
    }
}

/// A flow's name as it is compared.
#[must_use]
pub fn flow_hash(flow: &str) -> u64 {
    let mut hasher = DefaultHasher::new();
    flow.hash(&mut hasher);
    hasher.finish()
}

// --- what is read at arrival ---

#[derive(Deserialize)]
struct QuickText<'a> {
    #[serde(borrow)]
    health: StateText<'a>,
    #[serde(default)]
    node: Option<NodeText>,
    #[serde(default)]
    flows: Vec<Option<FlowText<'a>>>,
}

#[derive(Deserialize)]
struct StateText<'a> {
    #[serde(borrow)]
    state: std::borrow::Cow<'a, str>,
}

#[derive(Deserialize, Default)]
struct NodeText {
    cpu_ratio: Option<f64>,
    memory_ratio: Option<f64>,
    celsius: Option<f64>,
}

#[derive(Deserialize)]
struct FlowText<'a> {
    #[serde(borrow, default)]
    state: Option<std::borrow::Cow<'a, str>>,
    #[serde(default)]
    topics: Sum,
    #[serde(default, rename = "in")]
    taken: Option<MessagesText>,
    #[serde(default, rename = "out")]
    given: Option<MessagesText>,
    #[serde(default)]
    dropped: Sum,
}

#[derive(Deserialize)]
struct MessagesText {
    #[serde(default)]
    messages: u64,
}

/// The sum of an object's numbers; its names are not kept.
#[derive(Default)]
struct Sum(u64);

impl<'de> Deserialize<'de> for Sum {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct OfMap;
        impl<'de> Visitor<'de> for OfMap {
            type Value = Sum;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an object of counts")
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Sum, A::Error> {
                let mut sum = 0_u64;
                while let Some((_, count)) = map.next_entry::<IgnoredAny, u64>()? {
                    sum = sum.saturating_add(count);
                }
                Ok(Sum(sum))
            }
            fn visit_unit<E>(self) -> Result<Sum, E> {
                Ok(Sum(0))
            }
        }
        deserializer.deserialize_any(OfMap)
    }
}

impl QuickText<'_> {
    fn head(&self) -> Head {
        let node = self.node.as_ref();
        let mut head = Head {
            state: Health::of_word(&self.health.state),
            cpu_ratio: node.and_then(|node| node.cpu_ratio),
            memory_ratio: node.and_then(|node| node.memory_ratio),
            celsius: node.and_then(|node| node.celsius),
            ..Head::default()
        };
        for flow in self.flows.iter().flatten().take(MAX_FLOWS) {
            head.flows += 1;
            head.ready_flows += usize::from(flow.state.as_deref() == Some("ready"));
            head.topics = head.topics.saturating_add(flow.topics.0);
            let messages = |part: &Option<MessagesText>| part.as_ref().map_or(0, |p| p.messages);
            let sums = &mut head.sums;
            sums.taken = sums.taken.saturating_add(messages(&flow.taken));
            sums.given = sums.given.saturating_add(messages(&flow.given));
            sums.dropped = sums.dropped.saturating_add(flow.dropped.0);
        }
        head
    }
}

// --- what is read when a node is late ---

#[derive(Deserialize, Default)]
struct LinksText<'a> {
    #[serde(borrow, default)]
    flows: Vec<Option<LinksOfFlow<'a>>>,
}

#[derive(Deserialize)]
struct LinksOfFlow<'a> {
    #[serde(borrow, default)]
    links: Vec<LinkState<'a>>,
}

#[derive(Deserialize)]
struct LinkState<'a> {
    #[serde(borrow)]
    flow: std::borrow::Cow<'a, str>,
    #[serde(borrow)]
    state: std::borrow::Cow<'a, str>,
}

// --- what is read when somebody asks ---

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
