//! Roll-outs that are tried here: on which nodes, whose configuration they change, and how one is
//! undone.

use std::sync::Arc;
use std::time::Duration;

use blaze_domain::config::effective::{Sources, canaries};
use blaze_domain::config::placement::{is_active, placement, rollout_target};
use blaze_domain::config::{Document, Key, Kind};
use blaze_domain::{DocumentName, NodeName};

use super::{MAX_FAILED, Served, Told};
use crate::core::served_target::ServedTarget;

/// Window of a gate that does not say how long it is, in seconds.
const WINDOW_S: u64 = 60;
/// Longest window, in seconds: a mounted file may say anything.
const MAX_WINDOW_S: u64 = 3600;

/// A roll-out that is on its canaries, as the shown documents have it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Trial {
    /// Which one; another one of the same name has another.
    pub uid: String,
    /// Its name, for people.
    pub name: DocumentName,
    /// Nodes that it is tried on, of those that this worker may serve.
    pub nodes: Vec<NodeName>,
    /// How long the services are watched.
    pub window: Duration,
    /// How many of them may be in trouble.
    pub max_unhealthy: u64,
    /// It has failed here already, in this life or in an earlier one.
    pub has_failed: bool,
}

impl Served {
    /// Undoes a roll-out here, before the main service knows. Of too many those go first that are
    /// over.
    pub fn fail_rollout(&mut self, uid: &str) {
        if self.next.failed.iter().any(|failed| failed == uid) {
            return;
        }
        let state = &self.next.state;
        let found = |uid: &str| {
            let mut rollouts = state.of_kind(Kind::Rollout, None);
            rollouts.find(|(_, held)| held.document.uid == uid)
        };
        self.pending.extend(found(uid).map(|(key, _)| key.clone()));
        let failed = Arc::make_mut(&mut self.next.failed);
        if failed.len() >= MAX_FAILED {
            let is_over =
                |uid: &String| found(uid).is_none_or(|(_, held)| !is_active(&held.document));
            let over = failed.iter().position(is_over);
            let forgotten = failed.remove(over.unwrap_or(0));
            if over.is_none() {
                tracing::warn!(
                    uid = forgotten,
                    "too many roll-outs failed; this one may be tried again"
                );
            }
        }
        failed.push(uid.to_owned());
    }

    /// Whether a roll-out that is on its canaries has an effect on the configuration of a place, in
    /// the shown documents: the health of such places tells whether it goes well.
    #[must_use]
    pub fn is_changed_by(&self, uid: &str, place: &ServedTarget) -> bool {
        if place.node.is_none() || self.places.get(place).is_none() {
            return false;
        }
        let at = place.at(&self.site);
        let with = self.shown.sources(&at);
        let without = Sources::at_where(&self.shown.state, &at, |rollout| {
            rollout.uid != uid && !self.shown.failed.contains(&rollout.uid)
        });
        with.rollout.is_some() && with.hash() != without.hash()
    }

    /// What a place was told last; `None`: it is not told of changes.
    #[must_use]
    pub fn told_to(&self, place: &ServedTarget) -> Option<&Told> {
        self.places.get(place)
    }

    /// Whether somebody on a node has asked here lately.
    #[must_use]
    pub fn is_asked_from(&self, node: &NodeName) -> bool {
        self.places.on_node(node).any(|place| self.asked.contains(place))
    }

    /// The roll-outs that are on their canaries in the shown documents, in the order of their
    /// names. Those without a uid (of a mounted file) are left out: nobody could be told which one
    /// failed.
    #[must_use]
    pub fn trials(&self) -> Vec<Trial> {
        let rollouts = self.shown.state.of_kind(Kind::Rollout, None);
        let rollouts = rollouts.map(|(_, held)| &*held.document);
        let is_tried = |rollout: &&Document| is_active(rollout) && !rollout.uid.is_empty();
        rollouts.filter(is_tried).map(|rollout| self.trial(rollout)).collect()
    }

    fn trial(&self, rollout: &Document) -> Trial {
        let gate = |name: &str| rollout.spec_member("gate")?.get(name)?.as_u64();
        Trial {
            uid: rollout.uid.clone(),
            name: rollout.key.name().clone(),
            nodes: self.canary_nodes(rollout),
            window: Duration::from_secs(gate("window_s").unwrap_or(WINDOW_S).min(MAX_WINDOW_S)),
            max_unhealthy: gate("max_unhealthy").unwrap_or(0),
            has_failed: self.shown.failed.contains(&rollout.uid),
        }
    }

    fn canary_nodes(&self, rollout: &Document) -> Vec<NodeName> {
        let state = &self.shown.state;
        let target = rollout_target(rollout).and_then(|key| state.get(&key));
        let (Some(selector), Some(target)) = (canaries(rollout), target) else {
            return Vec::new();
        };
        // A change of what one node alone has cannot be tried on another one.
        let own = placement(state, &target.document).node;
        let is_canary = |key: &Key, node: &Document| {
            let name = NodeName::from(key.name());
            (selector.matches(&node.labels) && own.as_ref().is_none_or(|own| *own == name))
                .then_some(name)
        };
        match &self.site.node {
            Some(node) => {
                let held = state.get(&Key::node(node));
                held.and_then(|held| is_canary(&held.document.key, &held.document))
                    .into_iter()
                    .collect()
            }
            None => {
                let nodes = state.of_kind(Kind::Node, None);
                nodes.filter_map(|(key, held)| is_canary(key, &held.document)).collect()
            }
        }
    }
}
