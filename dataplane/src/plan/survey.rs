//! What the plans of many topics have in common, so that it is looked for once: with a thousand flows of their own topics each,
//! asking every flow for every topic takes seconds.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use blaze_domain::{FlowId, TopicName};

use super::gateway;
use crate::world::{FlowView, World};

/// A world, and who in it has to do with which topic.
pub struct Survey<'w> {
    pub(super) world: &'w World,
    /// Flows of the own group that are on the inter scope for it and carry topics.
    pub(super) gateways: Arc<[&'w FlowId]>,
    /// Flows of the own group that are not.
    pub(super) members: Arc<BTreeSet<&'w FlowId>>,
    by_topic: Option<HashMap<&'w TopicName, Vec<(&'w FlowId, &'w FlowView)>>>,
}

impl<'w> Survey<'w> {
    /// For one topic, or a few.
    #[must_use]
    pub fn new(world: &'w World) -> Self {
        Self {
            world,
            gateways: gateway::gateways(world).collect(),
            members: Arc::new(gateway::members(world).collect()),
            by_topic: None,
        }
    }

    /// For many topics.
    #[must_use]
    pub fn of_all(world: &'w World) -> Self {
        let mut by_topic: HashMap<&TopicName, Vec<(&FlowId, &FlowView)>> = HashMap::new();
        for (id, flow) in &world.flows {
            let only_parts = flow.parts.keys().filter(|topic| !flow.topics.contains_key(*topic));
            for topic in flow.topics.keys().chain(only_parts) {
                by_topic.entry(topic).or_default().push((id, flow));
            }
        }
        Self {
            by_topic: Some(by_topic),
            ..Self::new(world)
        }
    }

    /// Flows, by name, that announced something of a topic or have a part in it.
    #[must_use]
    pub fn holders(&self, topic: &TopicName) -> Vec<(&'w FlowId, &'w FlowView)> {
        match &self.by_topic {
            Some(by_topic) => by_topic.get(topic).cloned().unwrap_or_default(),
            None => {
                let holds = |flow: &FlowView| flow.topics.contains_key(topic) || flow.parts.contains_key(topic);
                self.world.flows.iter().filter(|(_, flow)| holds(flow)).collect()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tests::worlds::{flow, id};
    use crate::world::{Carrying, Part, TopicEntry};

    #[test]
    fn holders_are_the_same_with_and_without_an_index() {
        let topics: Vec<TopicName> = ["a", "b", "c"].iter().map(|name| name.parse().unwrap()).collect();
        let names = [("x/1", None), ("x/2", None), ("y/1", Some(1))];
        let mut world = World {
            me: id("x/1"),
            flows: names.map(|(name, scope)| (id(name), flow(scope))).into(),
        };
        let part = Part {
            carrying: Carrying::Carries,
            ..Part::default()
        };
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
        }
    }
}
