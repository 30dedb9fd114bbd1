//! What the plans of many topics have in common, so that it is looked for once: with a thousand
//! flows of their own topics each, asking every flow for every topic takes seconds.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use blaze_domain::{FlowId, TopicName};

use super::network::{self, Networks};
use super::{Group, gateway};
use crate::world::{FlowState, FlowView, Reach, Role, TopicEntry, World};

/// From so many topics at once on it pays to look first who has to do with which.
const MANY: usize = 16;

/// A world, and who in it has to do with which topic.
pub struct Survey<'w> {
    pub(super) world: &'w World,
    /// Flows of the own group that are on the inter scope for it and carry topics.
    pub(super) gateways: Arc<[&'w FlowId]>,
    /// Flows of the own group that are not.
    pub(super) members: Arc<BTreeSet<&'w FlowId>>,
    pub(super) networks: Arc<Networks<'w>>,
    by_topic: Option<HashMap<&'w TopicName, Vec<Holder<'w>>>>,
}

/// A flow that has to do with a topic.
#[derive(Clone, Copy)]
pub(super) struct Holder<'w> {
    pub(super) id: &'w FlowId,
    pub(super) flow: &'w FlowView,
    /// What it announced of it.
    pub(super) entry: Option<&'w TopicEntry>,
}

impl<'w> Survey<'w> {
    /// For one topic, or a few.
    #[must_use]
    pub fn new(world: &'w World) -> Self {
        Self {
            world,
            gateways: gateway::gateways(world).collect(),
            members: Arc::new(gateway::members(world).collect()),
            networks: Arc::new(network::networks(world)),
            by_topic: None,
        }
    }

    /// For so many topics.
    #[must_use]
    pub fn of(world: &'w World, topics: usize) -> Self {
        if topics < MANY { Self::new(world) } else { Self::of_all(world) }
    }

    /// For many topics.
    #[must_use]
    pub fn of_all(world: &'w World) -> Self {
        let mut by_topic: HashMap<&TopicName, Vec<Holder<'_>>> = HashMap::new();
        for (id, flow) in &world.flows {
            let entries = flow.topics.iter().map(|(topic, entry)| (topic, Some(entry)));
            let only_parts = flow.parts.keys().filter(|topic| !flow.topics.contains_key(*topic));
            for (topic, entry) in entries.chain(only_parts.map(|topic| (topic, None))) {
                by_topic.entry(topic).or_default().push(Holder { id, flow, entry });
            }
        }
        Self { by_topic: Some(by_topic), ..Self::new(world) }
    }

    /// Flows, by name, that announced something of a topic or have a part in it.
    #[must_use]
    pub fn holders(&self, topic: &TopicName) -> Vec<(&'w FlowId, &'w FlowView)> {
        let holders = self.find(topic).into_iter();
        holders.map(|holder| (holder.id, holder.flow)).collect()
    }

    /// Whether anybody asks for a topic. Where that is not known without looking at every flow, it
    /// may be.
    pub(super) fn may_be_requested(&self, topic: &TopicName) -> bool {
        let requested = |holder: &Holder<'_>| holder.entry.is_some_and(TopicEntry::is_requested);
        self.by_topic.as_ref().is_none_or(|by_topic| {
            by_topic.get(topic).is_some_and(|holders| holders.iter().any(requested))
        })
    }

    /// The same as [`Survey::holders`], with what they announced.
    pub(super) fn find(&self, topic: &TopicName) -> Vec<Holder<'w>> {
        let holder = |(id, flow): (&'w FlowId, &'w FlowView)| {
            let entry = flow.topics.get(topic);
            let holds = entry.is_some() || flow.parts.contains_key(topic);
            holds.then_some(Holder { id, flow, entry })
        };
        match &self.by_topic {
            Some(by_topic) => by_topic.get(topic).cloned().unwrap_or_default(),
            None => self.world.flows.iter().filter_map(holder).collect(),
        }
    }

    /// Such flows, by name, as announced something of a topic, and what.
    pub(super) fn entries<'s>(
        &'s self,
        topic: &'s TopicName,
        is_such: impl Fn(&FlowId, &FlowView) -> bool + 's,
    ) -> impl Iterator<Item = (&'w FlowId, &'w FlowView, &'w TopicEntry)> + 's {
        let known = self.by_topic.as_ref().map(|by_topic| by_topic.get(topic));
        // Without an index every flow may be one, and looking into its topics is what takes time.
        let all = self.world.flows.iter().filter(move |_| known.is_none()).map(|(id, flow)| {
            let entry = None;
            Holder { id, flow, entry }
        });
        let holders = known.flatten().into_iter().flatten().copied();
        let such = all.chain(holders).filter(move |holder| is_such(holder.id, holder.flow));
        such.filter_map(move |Holder { id, flow, entry }| {
            let looked_up = || known.is_none().then(|| flow.topics.get(topic)).flatten();
            Some((id, flow, entry.or_else(looked_up)?))
        })
    }

    /// Whether the own flow speaks for flows that are not on the inter scope.
    pub(crate) fn speaks_for_others(&self) -> bool {
        !self.members.is_empty() && self.world.own().is_some_and(|own| own.role.is_gateway())
    }

    /// Whether a flow is one of those, where the own flow speaks for any.
    pub(super) fn is_behind(&self, id: &FlowId, flow: &FlowView) -> bool {
        flow.role == Role::Member && carries(flow) && Some(Group::of(id, flow)) == self.group()
    }

    /// The own group.
    pub(super) fn group(&self) -> Option<Group<'w>> {
        let own = self.world.flows.get_key_value(&self.world.me);
        own.map(|(id, view)| Group::of(id, view))
    }
}

/// Whether a flow carries topics.
pub(super) fn carries(view: &FlowView) -> bool {
    view.state == FlowState::Ready && view.reach != Reach::Down
}

#[cfg(test)]
mod tests {
    use blaze_domain::node_file::AccessRules;

    use super::*;
    use crate::plan::tests::worlds::{flow, id};
    use crate::world::{Carrying, Part, TopicEntry};

    #[test]
    fn holders_are_the_same_with_and_without_an_index() {
        let topics: Vec<TopicName> =
            ["a", "b", "c"].iter().map(|name| name.parse().unwrap()).collect();
        let names = [("x/1", None), ("x/2", None), ("y/1", Some(1))];
        let mut world = World {
            me: id("x/1"),
            flows: names.map(|(name, scope)| (id(name), flow(scope))).into(),
            access: AccessRules::default(),
        };
        let part = Part { carrying: Carrying::Carries, ..Part::default() };
        for (number, view) in world.flows.values_mut().enumerate() {
            view.topics.insert(topics[number % 2].clone(), TopicEntry::default());
            view.parts.insert(topics[0].clone(), part.clone());
        }
        let (one, all) = (Survey::new(&world), Survey::of_all(&world));
        for (topic, count) in topics.iter().zip([3, 1, 0]) {
            let names = |survey: &Survey<'_>| -> Vec<FlowId> {
                survey.holders(topic).into_iter().map(|(id, _)| id.clone()).collect()
            };
            assert_eq!(names(&one), names(&all));
            assert_eq!(names(&all).len(), count, "{topic}");
            let entries = |survey: &Survey<'_>| -> Vec<FlowId> {
                survey.entries(topic, |_, _| true).map(|(id, ..)| id.clone()).collect()
            };
            assert_eq!(entries(&one), entries(&all));
        }
    }
}
