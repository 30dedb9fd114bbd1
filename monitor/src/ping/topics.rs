//! Topics that the engine needs: requested and advertised.

use std::collections::BTreeSet;

use blaze_domain::{FlowId, TopicName};

/// Changes of what to request and to advertise.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TopicChanges {
    /// Topics to request.
    pub request: Vec<TopicName>,
    /// Topics whose requests end.
    pub release: Vec<TopicName>,
    /// Topics to advertise.
    pub advertise: Vec<TopicName>,
    /// Topics whose advertisements end.
    pub withdraw: Vec<TopicName>,
}

/// What the caller was asked for so far.
#[derive(Debug, Default)]
pub(super) struct Topics {
    requested: BTreeSet<TopicName>,
    advertised: BTreeSet<TopicName>,
    unchanged: bool,
}

impl Topics {
    /// Other nodes are asked from now on.
    pub(super) fn change(&mut self) {
        self.unchanged = false;
    }

    /// Changes since the last call: the topics of this node always, and those of the nodes asked.
    pub(super) fn take_changes<'a>(
        &mut self,
        own: &FlowId,
        asked: impl Iterator<Item = &'a FlowId>,
    ) -> TopicChanges {
        if std::mem::replace(&mut self.unchanged, true) {
            return TopicChanges::default();
        }
        let mut requested = BTreeSet::from([TopicName::ping(&own.layer)]);
        let mut advertised = BTreeSet::from([TopicName::pong(own)]);
        for node in asked {
            requested.insert(TopicName::pong(node));
            advertised.insert(TopicName::ping(&node.layer));
        }
        let (request, release) = changes(&mut self.requested, requested);
        let (advertise, withdraw) = changes(&mut self.advertised, advertised);
        TopicChanges { request, release, advertise, withdraw }
    }
}

/// What is added and what goes.
fn changes(
    before: &mut BTreeSet<TopicName>,
    after: BTreeSet<TopicName>,
) -> (Vec<TopicName>, Vec<TopicName>) {
    let added = after.difference(before).cloned().collect();
    let gone = before.difference(&after).cloned().collect();
    *before = after;
    (added, gone)
}
