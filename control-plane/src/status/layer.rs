//! The state of a layer, from those of its nodes.

use blaze_domain::config::Timestamp;
use blaze_domain::{LayerName, NodeName};

use super::detail::HealthProblem;
use super::health::{Damped, Health, Now};

/// Nodes that are named where several are down.
const MAX_NAMED: usize = 5;

/// What the nodes of a layer are, for one evaluation.
#[derive(Debug, Default)]
pub struct Nodes {
    /// Nodes that have reported.
    pub seen: usize,
    /// Flows of them that are ready.
    pub ready_flows: usize,
    /// Nodes that are not `ok`.
    pub not_ok: usize,
    /// Nodes that are down.
    pub down: Vec<NodeName>,
}

/// A layer.
#[derive(Debug)]
pub struct LayerHealth {
    /// `edge`, `fog` or `cloud`.
    pub kind: String,
    health: Damped<Health>,
    nodes: Nodes,
    down_since: Option<Timestamp>,
}

impl LayerHealth {
    pub(super) fn new(kind: String, now: Now) -> Self {
        let health = Damped::new(Health::Unknown, now);
        Self { kind, health, nodes: Nodes::default(), down_since: None }
    }

    /// The same layer, of a kind that may have changed.
    pub(super) fn with_kind(self, kind: String) -> Self {
        Self { kind, ..self }
    }

    /// Its state.
    #[must_use]
    pub fn state(&self) -> Health {
        self.health.value()
    }

    /// Since when.
    #[must_use]
    pub fn since(&self) -> Timestamp {
        self.health.since()
    }

    /// What is wrong with the layer as a whole.
    #[must_use]
    pub fn problems(&self, layer: &LayerName) -> Vec<HealthProblem> {
        let problem = |code: &str, state, since: Timestamp, detail, remedy: &str| HealthProblem {
            state,
            since: since.to_string(),
            code: code.to_owned(),
            scope: "layer".to_owned(),
            name: layer.to_string(),
            detail,
            remedy: remedy.to_owned(),
        };
        let no_flow = (self.state() == Health::Down).then(|| {
            let detail = format!("none of {} nodes that report has a ready flow", self.nodes.seen);
            let remedy = "Look at the problems of its nodes, then at /readyz of a flow.";
            problem("no_ready_flow", Health::Down, self.since(), detail, remedy)
        });
        let down = self.down_since.map(|since| {
            let names: Vec<&str> =
                self.nodes.down.iter().take(MAX_NAMED).map(NodeName::as_str).collect();
            let more = if self.nodes.down.len() > names.len() { ", …" } else { "" };
            let detail = format!("{} down: {}{more}", self.nodes.down.len(), names.join(", "));
            let remedy = "Look at the problems of these nodes.";
            problem("nodes_down", Health::Degraded, since, detail, remedy)
        });
        no_flow.into_iter().chain(down).collect()
    }

    /// Takes what its nodes are now. Whether its state has changed.
    pub(super) fn tick(&mut self, nodes: Nodes, now: Now) -> bool {
        self.down_since = match (nodes.down.is_empty(), self.down_since) {
            (true, _) => None,
            (false, known) => known.or(Some(now.time)),
        };
        let seen = match nodes {
            Nodes { seen: 0, .. } => Health::Unknown,
            Nodes { ready_flows: 0, .. } => Health::Down,
            Nodes { not_ok: 0, .. } => Health::Ok,
            _ => Health::Degraded,
        };
        self.nodes = nodes;
        let before = self.state();
        match (before, seen) {
            // What is heard first is taken at once, unless others may still report a ready flow.
            (Health::Unknown, Health::Ok | Health::Degraded) => self.health.set(seen, now),
            (_, seen) => {
                self.health.update(seen, now);
            }
        }
        before != self.state()
    }
}
