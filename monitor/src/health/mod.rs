//! Health of this node and its services: pure, with `now` as a parameter.
//!
//! ```text
//! Inputs ──Finder, Services──► conditions ──Tracker──► problems ──► states
//!                                                        └─► /v1/health ◄──┘
//! ```
//!
//! A problem of the node itself counts in full for the node's state; a link, topic or service that
//! is down leaves the node degraded.

mod codes;
mod conditions;
mod inputs;
mod limits;
mod rate;
mod services;
mod tracker;

#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};

use blaze_domain::FlowId;
use blaze_domain::control::rfc3339_millis;
use blaze_domain::node_file::Thresholds;
use prometheus::IntGaugeVec;
use prometheus::core::Collector as _;
use prometheus::proto::MetricFamily;
use serde::Serialize;

pub use codes::{CODES, Code, Scope, find};
pub use inputs::{
    ConfigState, FlowInput, Inputs, Link, Moment, OffsetInput, ProgramInput, ServiceInput, Summary,
    TopicInput, Vitals,
};

use crate::metric::metrics;
use conditions::Finder;
use limits::MAX_LABELS;
use services::Services;
use tracker::{Standing, Tracker};

metrics! {
    HEALTH Gauge "blaze_health" ["scope", "name", "state"] "1"
        "1 for the present state of the node or service, 0 for the others."
    PROBLEM Gauge "blaze_problem" ["scope", "code", "name"] "1"
        "1 for each present problem; at most 256 names, the rest `_other`."
}
/// Label of what is beyond the bound of labels.
const OTHER: &str = "_other";

/// How something is; the later is the worse.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Nothing is wrong.
    Ok,
    /// Nothing is known.
    Unknown,
    /// It works, with a problem.
    Degraded,
    /// It does not work.
    Down,
}

impl State {
    /// All states.
    pub const ALL: [Self; 4] = [Self::Ok, Self::Unknown, Self::Degraded, Self::Down];

    /// The word in answers and labels.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Unknown => "unknown",
            Self::Degraded => "degraded",
            Self::Down => "down",
        }
    }
}

/// Something that is wrong.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Problem {
    /// Its code, see [`CODES`].
    pub code: &'static str,
    /// What it is about.
    pub scope: Scope,
    /// Name of the subject: mount, program, `service/instance`, topic, `flow>flow`.
    pub name: String,
    /// State of the subject.
    pub state: State,
    /// Since when, RFC 3339.
    pub since: String,
    /// The figures, for people.
    pub detail: String,
    /// What to do.
    pub remedy: String,
}

impl Problem {
    fn new(code: &'static Code, name: String, since_unix_ms: u64, detail: String) -> Self {
        Self {
            code: code.code,
            scope: code.scope,
            state: code.state,
            since: rfc3339_millis(since_unix_ms),
            remedy: code.remedy.replace("{name}", &name),
            name,
            detail,
        }
    }
}

/// What an update changed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Change {
    /// There is a problem.
    Raised(Problem),
    /// It is over.
    Cleared(Problem),
    /// The state of the node or a service is another one.
    State {
        /// `node` or `service`.
        scope: Scope,
        /// The node, or `service/instance`.
        name: String,
        /// State before.
        from: State,
        /// State now.
        to: State,
    },
}

/// `/v1/health`, without the members of every answer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Body {
    /// State of the node.
    pub state: State,
    /// Since when.
    pub since: String,
    /// Problems of node, links and topics.
    pub problems: Vec<Problem>,
    /// Services with theirs.
    pub services: Vec<ServiceBody>,
}

impl Body {
    /// With at most so many problems, the worst ones first, of services last.
    #[must_use]
    pub fn bounded(mut self, most: usize) -> Self {
        self.problems.truncate(most);
        let mut left = most - self.problems.len();
        self.services.truncate(most);
        for service in &mut self.services {
            service.problems.truncate(left);
            left -= service.problems.len();
        }
        self
    }
}

/// One service in [`Body`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ServiceBody {
    /// The service.
    pub service: String,
    /// Its instance.
    pub instance: String,
    /// Its state.
    pub state: State,
    /// Since when.
    pub since: String,
    /// Its problems.
    pub problems: Vec<Problem>,
}

/// Health of a node.
#[derive(Debug)]
pub struct Health {
    node: FlowId,
    thresholds: Thresholds,
    finder: Finder,
    services: Services,
    tracker: Tracker,
    node_state: Standing,
    /// By service and instance.
    service_states: BTreeMap<(String, String), Standing>,
}

impl Health {
    /// Nothing is known yet.
    #[must_use]
    pub fn new(node: FlowId, thresholds: Thresholds, now: Moment) -> Self {
        Self {
            node,
            thresholds,
            finder: Finder::default(),
            services: Services::default(),
            tracker: Tracker::default(),
            node_state: Standing::new(State::Unknown, now.unix_ms),
            service_states: BTreeMap::new(),
        }
    }

    /// Thresholds of a changed configuration.
    pub fn set_thresholds(&mut self, thresholds: Thresholds) {
        self.thresholds = thresholds;
    }

    /// Evaluates what is known now; to be called once a second. The detail of a problem may change
    /// without a [`Change`].
    pub fn update(&mut self, now: Moment, inputs: &Inputs) -> Vec<Change> {
        let mut conditions = self.finder.find(now.at, inputs, &self.thresholds);
        conditions.extend(self.services.update(now, inputs.services.as_deref()));
        let frozen = inputs.services.is_none().then_some(Scope::Service);
        let left_out = self.finder.unwatched + self.services.left_out;
        let mut changes = self.tracker.update(now, conditions, frozen, left_out);
        changes.extend(self.set_node_state(now));
        self.set_service_states(now, &mut changes);
        changes
    }

    fn set_node_state(&mut self, now: Moment) -> Option<Change> {
        let own = self.tracker.worst(|scope, _| scope == Scope::Node);
        let other = self.tracker.worst(|scope, _| scope != Scope::Node);
        let state = own.max(other.map(|state| state.min(State::Degraded))).unwrap_or(State::Ok);
        let from = self.node_state.state;
        self.node_state.set(state, now).then(|| Change::State {
            scope: Scope::Node,
            name: self.node.to_string(),
            from,
            to: state,
        })
    }

    fn set_service_states(&mut self, now: Moment, changes: &mut Vec<Change>) {
        let is_unknown = self.services.is_unknown(now.at);
        let mut before = std::mem::take(&mut self.service_states);
        let mut worst: BTreeMap<String, State> = BTreeMap::new();
        let mut keys: BTreeSet<(String, String)> = self.services.names().cloned().collect();
        for problem in self.tracker.problems().filter(|problem| problem.scope == Scope::Service) {
            let state = worst.entry(problem.name.clone()).or_insert(problem.state);
            *state = problem.state.max(*state);
            keys.insert(split(&problem.name));
        }
        for key in keys {
            let name = format!("{}/{}", key.0, key.1);
            let state = match worst.get(&name) {
                _ if is_unknown => State::Unknown,
                worst => worst.copied().unwrap_or(State::Ok),
            };
            let fresh = || Standing::new(State::Ok, now.unix_ms);
            let mut standing = before.remove(&key).unwrap_or_else(fresh);
            let from = standing.state;
            if standing.set(state, now) {
                changes.push(Change::State { scope: Scope::Service, name, from, to: state });
            }
            self.service_states.insert(key, standing);
        }
    }

    /// State of the node.
    #[must_use]
    pub fn state(&self) -> State {
        self.node_state.state
    }

    /// All problems; at most 1,000, and one that counts the rest.
    #[must_use]
    pub fn problems(&self) -> Vec<Problem> {
        let mut problems: Vec<Problem> = self.tracker.problems().collect();
        problems.sort_by(|a, b| b.state.cmp(&a.state).then_with(|| a.since.cmp(&b.since)));
        problems
    }

    /// The answer of `/v1/health`.
    #[must_use]
    pub fn body(&self) -> Body {
        let is_of_service = |problem: &Problem| problem.scope == Scope::Service;
        let (mut of_services, problems): (Vec<_>, Vec<_>) =
            self.problems().into_iter().partition(is_of_service);
        let services = self.service_states.iter().map(|((service, instance), standing)| {
            let name = format!("{service}/{instance}");
            let is_own = |problem: &mut Problem| problem.name == name;
            ServiceBody {
                service: service.clone(),
                instance: instance.clone(),
                state: standing.state,
                since: rfc3339_millis(standing.since_unix_ms),
                problems: of_services.extract_if(.., is_own).collect(),
            }
        });
        Body {
            state: self.node_state.state,
            since: rfc3339_millis(self.node_state.since_unix_ms),
            services: services.collect(),
            problems,
        }
    }

    /// `blaze_health` of the node and its services.
    #[must_use]
    pub fn metrics(&self) -> Vec<MetricFamily> {
        let mut services: BTreeMap<String, State> = BTreeMap::new();
        for ((service, instance), standing) in &self.service_states {
            let has_room = services.len() < MAX_LABELS - 1;
            let name = if has_room { format!("{service}/{instance}") } else { OTHER.to_owned() };
            let state = services.entry(name).or_insert(standing.state);
            *state = standing.state.max(*state);
        }
        let node = (Scope::Node, self.node.node.to_string(), self.node_state.state);
        let services = services.into_iter().map(|(name, state)| (Scope::Service, name, state));
        let rows = std::iter::once(node).chain(services);
        let mut families = gauge(rows);
        families.extend(self.problem_metric());
        families
    }

    /// `blaze_problem`, without a family where there is none.
    fn problem_metric(&self) -> Vec<MetricFamily> {
        let Ok(gauge) = IntGaugeVec::new(PROBLEM.opts(), PROBLEM.labels) else { return Vec::new() };
        for (count, problem) in self.problems().into_iter().enumerate() {
            let name = if count < MAX_LABELS - 1 { problem.name.as_str() } else { OTHER };
            gauge.with_label_values(&[problem.scope.as_str(), problem.code, name]).set(1);
        }
        gauge.collect()
    }
}

fn gauge(rows: impl Iterator<Item = (Scope, String, State)>) -> Vec<MetricFamily> {
    let Ok(gauge) = IntGaugeVec::new(HEALTH.opts(), HEALTH.labels) else { return Vec::new() };
    for (scope, name, state) in rows {
        for other in State::ALL {
            let labels = [scope.as_str(), &name, other.as_str()];
            gauge.with_label_values(&labels).set(i64::from(other == state));
        }
    }
    gauge.collect()
}

/// `service/instance`, as problems name it; a program without instances is instance 0.
fn split(name: &str) -> (String, String) {
    let (service, instance) = name.rsplit_once('/').unwrap_or((name, "0"));
    (service.to_owned(), instance.to_owned())
}
