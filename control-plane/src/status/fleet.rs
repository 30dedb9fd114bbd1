//! What is known of nodes and layers: the newest summary of each node, and what follows from its
//! age and from the others. No I/O and no clock.
//!
//! ```text
//! summary ─▶ entry (text, few values)         constant work
//! tick    ─▶ entries: late? ─▶ does any flow see its flow up? ─▶ presence ─▶ layers
//! ```

use std::collections::{BTreeMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::config::Kind;
use blaze_domain::config::state::{Held, State};
use blaze_domain::{FlowId, LayerName, NodeName};

use super::detail::HealthProblem;
use super::health::{Damped, Health, Now, is_late};
use super::layer::{LayerHealth, Nodes};
use super::limits::MAX_NODES;
use super::summary::{Report, flow_hash};

/// Whether a node that has reported still does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Presence {
    /// Summaries come.
    Present,
    /// None comes, and its flow is seen: the monitor is missing.
    Silent,
    /// None comes, and no flow sees its flow.
    Gone,
}

/// A node that has reported since this process started.
#[derive(Debug)]
pub struct Entry {
    /// Its layer.
    pub layer: LayerName,
    /// The newest summary.
    pub report: Option<Arc<Report>>,
    /// When it said something the last time.
    pub seen: Now,
    /// Messages per second, from the last two summaries.
    pub rates: Rates,
    /// Messages that links had dropped by the summary before, where somebody looked at it.
    pub dropped_before: Option<(Now, DroppedByLink)>,
    /// Where its metrics are scraped; empty: not from outside.
    pub metrics_address: String,
    presence: Damped<Presence>,
}

/// Messages that links have dropped since their flows started, by the flows of both ends.
pub type DroppedByLink = BTreeMap<(FlowId, FlowId), u64>;

/// Messages per second.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Rates {
    /// Taken in by the flows.
    pub taken_hz: f64,
    /// Given out.
    pub given_hz: f64,
    /// Dropped.
    pub dropped_hz: f64,
}

impl Entry {
    fn new(layer: LayerName, metrics_address: String, now: Now) -> Self {
        Self {
            layer,
            report: None,
            seen: now,
            rates: Rates::default(),
            dropped_before: None,
            metrics_address,
            presence: Damped::new(Presence::Present, now),
        }
    }

    /// Whether it reports.
    #[must_use]
    pub fn presence(&self) -> Presence {
        self.presence.value()
    }

    /// Its state.
    #[must_use]
    pub fn health(&self) -> Health {
        match self.presence.value() {
            Presence::Present => self.report.as_ref().map_or(Health::Unknown, |r| r.head.state),
            Presence::Silent => Health::Degraded,
            Presence::Gone => Health::Down,
        }
    }

    /// How long it has said nothing.
    #[must_use]
    pub fn age(&self, now: Now) -> Duration {
        now.at.saturating_duration_since(self.seen.at)
    }

    /// What the main service itself finds wrong with the node.
    #[must_use]
    pub fn own_problem(&self, node: &NodeName) -> Option<HealthProblem> {
        let (code, detail, remedy) = match self.presence.value() {
            Presence::Present => return None,
            Presence::Silent => (
                "monitor_silent",
                "the monitor has sent no status for 45 s, and other flows see this node",
                "Check blaze-monitor on the node, and its way to the main service (config.server).",
            ),
            Presence::Gone => (
                "node_gone",
                "the monitor has sent no status for 45 s, and no other flow sees this node",
                "Check whether the node has power and network.",
            ),
        };
        Some(HealthProblem {
            state: self.health(),
            since: self.presence.since().to_string(),
            code: code.to_owned(),
            scope: "node".to_owned(),
            name: node.to_string(),
            detail: detail.to_owned(),
            remedy: remedy.to_owned(),
        })
    }

    fn take(&mut self, report: Report) {
        let now = report.arrived;
        if let Some(before) = &self.report {
            self.rates = rates(before, &report);
            self.dropped_before = before.known_detail().map(|detail| {
                let links = detail.links.iter();
                let dropped = links.map(|l| ((l.from.clone(), l.to.clone()), l.dropped));
                (before.arrived, dropped.collect())
            });
        }
        self.seen = now;
        self.report = Some(Arc::new(report));
    }

    fn ready_flows(&self) -> usize {
        match (self.presence.value(), &self.report) {
            (Presence::Present, Some(report)) => report.head.ready_flows,
            // It is seen by others.
            (Presence::Silent, Some(report)) => report.head.ready_flows.min(1),
            _ => 0,
        }
    }
}

fn rates(before: &Report, after: &Report) -> Rates {
    let seconds = after.arrived.at.saturating_duration_since(before.arrived.at).as_secs_f64();
    let (old, new) = (before.head.sums, after.head.sums);
    // A flow that has begun anew counts from 0.
    let per_s = |old: u64, new: u64| match seconds > 0.0 {
        true => new.checked_sub(old).unwrap_or(new) as f64 / seconds,
        false => 0.0,
    };
    Rates {
        taken_hz: per_s(old.taken, new.taken),
        given_hz: per_s(old.given, new.given),
        dropped_hz: per_s(old.dropped, new.dropped),
    }
}

/// A state that has changed, for the log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Change {
    /// `node` or `layer`.
    pub scope: &'static str,
    /// Of what.
    pub name: String,
    /// From now on.
    pub state: Health,
    /// The code, if there is one.
    pub code: Option<&'static str>,
}

/// All of it.
#[derive(Debug, Default)]
pub struct Fleet {
    revision: Option<u64>,
    nodes: BTreeMap<NodeName, (LayerName, Arc<Held>)>,
    layers: BTreeMap<LayerName, LayerHealth>,
    entries: BTreeMap<NodeName, Entry>,
}

/// There is no room for one more node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{MAX_NODES} nodes report, more cannot")]
pub struct TooManyNodes;

impl Fleet {
    /// Takes over layers and nodes of the configuration, if they may have changed. Nodes that it
    /// does not have any more, or in another layer, are forgotten.
    pub fn configure(&mut self, state: &State, now: Now) {
        if self.revision.is_some_and(|known| known >= state.revision()) {
            return;
        }
        self.revision = Some(state.revision());
        let nodes = state.of_kind(Kind::Node, None).filter_map(|(key, held)| {
            let layer = held.document.spec_layer()?.parse().ok()?;
            Some((NodeName::from(key.name()), (layer, Arc::clone(held))))
        });
        self.nodes = nodes.collect();
        let mut before = std::mem::take(&mut self.layers);
        for (key, held) in state.of_kind(Kind::Layer, None) {
            let layer = LayerName::from(key.name());
            let kind = held.document.spec_member("kind").and_then(|kind| kind.as_str());
            let kind = kind.unwrap_or_default().to_owned();
            let health = match before.remove(&layer) {
                Some(known) => known.with_kind(kind),
                None => LayerHealth::new(kind, now),
            };
            self.layers.insert(layer, health);
        }
        let nodes = &self.nodes;
        self.entries
            .retain(|node, entry| nodes.get(node).is_some_and(|(layer, _)| *layer == entry.layer));
    }

    /// The layer of a node, by the configuration.
    #[must_use]
    pub fn layer_of(&self, node: &NodeName) -> Option<&LayerName> {
        self.nodes.get(node).map(|(layer, _)| layer)
    }

    /// Nodes of the configuration: layer and document.
    pub fn nodes(&self) -> impl Iterator<Item = (&NodeName, &LayerName, &Arc<Held>)> {
        self.nodes.iter().map(|(node, (layer, held))| (node, layer, held))
    }

    /// Layers of the configuration.
    pub fn layers(&self) -> impl Iterator<Item = (&LayerName, &LayerHealth)> {
        self.layers.iter()
    }

    /// One layer.
    #[must_use]
    pub fn layer(&self, layer: &LayerName) -> Option<&LayerHealth> {
        self.layers.get(layer)
    }

    /// A node that has reported.
    #[must_use]
    pub fn entry(&self, node: &NodeName) -> Option<&Entry> {
        self.entries.get(node)
    }

    /// All nodes that have reported.
    pub fn entries(&self) -> impl Iterator<Item = (&NodeName, &Entry)> {
        self.entries.iter()
    }

    /// A monitor has come; its node is one of the configuration.
    ///
    /// # Errors
    /// [`TooManyNodes`].
    pub fn enter(
        &mut self,
        node: &NodeName,
        layer: &LayerName,
        metrics_address: String,
        now: Now,
    ) -> Result<(), TooManyNodes> {
        if self.entries.len() >= MAX_NODES && !self.entries.contains_key(node) {
            return Err(TooManyNodes);
        }
        let entry = self.entries.entry(node.clone());
        let entry = entry.or_insert_with(|| Entry::new(layer.clone(), String::new(), now));
        entry.metrics_address = metrics_address;
        Ok(())
    }

    /// A summary has come. `false`: the node was forgotten meanwhile.
    pub fn report(&mut self, node: &NodeName, report: Report) -> bool {
        match self.entries.get_mut(node) {
            Some(entry) => {
                entry.take(report);
                true
            }
            None => false,
        }
    }

    /// Evaluates ages and layers.
    pub fn tick(&mut self, now: Now) -> Vec<Change> {
        let mut changes = self.tick_nodes(now);
        let mut nodes: BTreeMap<LayerName, Nodes> = BTreeMap::new();
        // Of a monitor that has just come nothing is known yet.
        for (node, entry) in self.entries.iter().filter(|(_, entry)| entry.report.is_some()) {
            if !nodes.contains_key(&entry.layer) {
                nodes.insert(entry.layer.clone(), Nodes::default());
            }
            let Some(of_layer) = nodes.get_mut(&entry.layer) else { continue };
            let health = entry.health();
            of_layer.seen += 1;
            of_layer.ready_flows += entry.ready_flows();
            of_layer.not_ok += usize::from(health != Health::Ok);
            if health == Health::Down {
                of_layer.down.push(node.clone());
            }
        }
        for (name, layer) in &mut self.layers {
            if layer.tick(nodes.remove(name).unwrap_or_default(), now) {
                changes.push(Change {
                    scope: "layer",
                    name: name.to_string(),
                    state: layer.state(),
                    code: (layer.state() == Health::Down).then_some("no_ready_flow"),
                });
            }
        }
        changes
    }

    fn tick_nodes(&mut self, now: Now) -> Vec<Change> {
        let mut presence = self.late(now);
        let mut changes = Vec::new();
        for (node, entry) in &mut self.entries {
            let presence = presence.remove(node).unwrap_or(Presence::Present);
            if entry.presence.update(presence, now) {
                changes.push(Change {
                    scope: "node",
                    name: node.to_string(),
                    state: entry.health(),
                    code: match entry.presence.value() {
                        Presence::Present => None,
                        Presence::Silent => Some("monitor_silent"),
                        Presence::Gone => Some("node_gone"),
                    },
                });
            }
        }
        changes
    }

    /// What late nodes are by the links of the others. Where no other flow reports, nobody can
    /// tell, and the monitor alone counts as missing.
    fn late(&self, now: Now) -> BTreeMap<NodeName, Presence> {
        let (late, heard): (Vec<_>, Vec<_>) =
            self.entries.iter().partition(|(_, entry)| is_late(entry.age(now)));
        let flows = late.iter().map(|(node, entry)| flow_hash(&format!("{}/{node}", entry.layer)));
        let flows: Vec<u64> = flows.collect();
        let mut unseen: HashSet<u64> = flows.iter().copied().collect();
        let mut has_witness = false;
        for (_, entry) in heard {
            let Some(report) = &entry.report else { continue };
            if unseen.is_empty() {
                break;
            }
            has_witness |= report.head.flows > 0;
            for flow in report.seen_up() {
                unseen.remove(flow);
            }
        }
        let presence = late.into_iter().zip(flows).map(|((node, _), flow)| {
            let gone = has_witness && unseen.contains(&flow);
            (node.clone(), if gone { Presence::Gone } else { Presence::Silent })
        });
        presence.collect()
    }
}

#[cfg(test)]
#[path = "fleet_tests.rs"]
mod tests;
