//! When topics are planned, and what follows from their plans.

use std::collections::BTreeSet;
use std::time::Instant;

use blaze_domain::TopicName;
use blaze_domain::control::EventKind;

use super::info::{Sources, announced_bytes, durable_sources, local_info, sides, types};
use super::routes::route_states;
use super::topic_states::TopicState;
use super::{ControlCore, LATEST, Output, QUIET, event};
use crate::plan::network::{self, Servers, Shown};
use crate::plan::{Survey, TopicPlan, plan_within};
use crate::registry::{MAX_ROUTES, carrying_states};
use crate::types::TopicTypes;
use crate::world::OriginFilter;

/// Sources of one topic that are remembered while nobody can tell whether they are gone.
const MAX_UNNAMED: usize = 1024;

/// A new plan that has had no consequence yet.
struct Draft {
    plan: TopicPlan,
    /// Who advertises the topic as transient_local.
    durable: Sources,
    /// The largest payload that any flow announces of it, in bytes.
    max_bytes: Option<u64>,
    /// Its types.
    types: TopicTypes,
    /// Some flow announces something of the topic.
    is_known: bool,
    /// Whether some service advertises it, and requests it.
    sides: (bool, bool),
    /// How it shows on the own ROS 2 network.
    shown: Option<Shown>,
    /// Where its requests may go.
    servers: Servers,
}

pub(super) struct Dirty {
    first: Instant,
    last: Instant,
    /// It is planned with the next tick.
    urgent: bool,
}

impl ControlCore {
    /// Topics are planned when nothing more has changed for a while.
    pub(super) fn touch(&mut self, now: Instant, topics: BTreeSet<TopicName>) {
        for topic in topics {
            self.dirty.entry(topic).and_modify(|dirty| dirty.last = now).or_insert(Dirty {
                first: now,
                last: now,
                urgent: false,
            });
        }
    }

    /// A topic is planned with the next tick.
    pub(super) fn touch_urgent(&mut self, now: Instant, topic: &TopicName) {
        self.touch(now, BTreeSet::from([topic.clone()]));
        if let Some(dirty) = self.dirty.get_mut(topic) {
            dirty.urgent = true;
        }
    }

    pub(super) fn touch_all(&mut self, now: Instant) {
        let mut topics = self.registry.all_topics();
        topics.extend(self.plans.keys().cloned());
        self.touch(now, topics);
    }

    /// Plans all topics that have changed, without waiting for quiet.
    pub(super) fn plan_changed(&mut self, now: Instant, wall_ms: u64) {
        for dirty in self.dirty.values_mut() {
            dirty.urgent = true;
        }
        self.plan_due(now, wall_ms);
    }

    pub(super) fn plan_due(&mut self, now: Instant, wall_ms: u64) {
        let due = |dirty: &Dirty| {
            dirty.urgent
                || now.saturating_duration_since(dirty.last) >= QUIET
                || now.saturating_duration_since(dirty.first) >= LATEST
        };
        let topics: Vec<TopicName> = self
            .dirty
            .iter()
            .filter(|(topic, dirty)| due(dirty) && !self.carriers.awaits_places(topic))
            .map(|(topic, _)| topic.clone())
            .collect();
        for topic in &topics {
            self.dirty.remove(topic);
        }
        for (topic, draft) in topics.iter().zip(self.draft(&topics)) {
            self.carry_out(now, topic, draft, wall_ms);
        }
    }

    /// Plans topics, without any consequence yet: that of one is nothing to the plan of another.
    fn draft(&self, topics: &[TopicName]) -> Vec<Draft> {
        let world = self.registry.world();
        let survey = Survey::of(world, topics.len());
        let draft = |topic| {
            let holders = survey.holders(topic);
            Draft {
                plan: plan_within(&survey, topic, &self.config.rules, self.plans.get(topic)),
                durable: durable_sources(&holders, topic),
                max_bytes: announced_bytes(&holders, topic),
                types: types(&self.registry, &holders, topic),
                sides: sides(&holders, topic),
                is_known: holders.iter().any(|(_, flow)| flow.topics.contains_key(topic)),
                shown: network::shown(&survey, topic),
                servers: network::servers(&survey, topic),
            }
        };
        topics.iter().map(draft).collect()
    }

    fn carry_out(&mut self, now: Instant, topic: &TopicName, draft: Draft, wall_ms: u64) {
        let Draft { mut plan, durable, max_bytes, types, is_known, sides, shown, servers } = draft;
        self.show(topic, shown);
        self.topic_states.set(topic, TopicState::of(sides, &plan));
        let previous = self.plans.get(topic);
        if is_known
            && previous == Some(&plan)
            && plan.bridges.is_empty()
            && self.is_idle(topic, &durable.known)
        {
            return;
        }
        let had_route = previous.is_some_and(|plan| !plan.bridges.is_empty());
        let carried = previous.is_some_and(TopicPlan::carries_out);
        let fault = if plan.uses_layer() { self.registry.put_on_layer(topic).err() } else { None };
        if let Some(fault) = &fault {
            plan.block_layer(&self.config.me, fault.code(), &format!("{topic} {fault}"));
            self.topic_states.set(topic, TopicState::of(sides, &plan));
        }
        if !plan.uses_layer() {
            self.registry.take_off_layer(topic);
        }
        self.forget_writers(now, topic, durable);
        let has_route = !plan.bridges.is_empty();
        let duty = self.duty(now, topic, carried, &plan);
        let mut info = Box::new(local_info(&self.registry, topic));
        info.max_bytes = info.max_bytes.max(max_bytes);
        info.types = types;
        info.servers = servers;
        if plan.bridges.is_empty() && !is_known {
            self.plans.remove(topic);
        } else {
            self.plans.insert(topic.clone(), plan.clone());
        }
        let carrying = self.carrying(now, topic, &plan);
        let mut routes = carrying_states(&self.config.me, &carrying);
        routes.extend(route_states(&self.config.me, &plan, |scope| self.scopes.health(scope)));
        routes.truncate(MAX_ROUTES);
        self.registry.set_route_state(now, topic, routes);
        self.update_channels(topic);
        self.outputs.push_back(Output::Plan { topic: topic.clone(), plan, info, duty });
        if had_route != has_route {
            let kind = if has_route { EventKind::RouteUp } else { EventKind::RouteDown };
            self.tell(&event(kind, Some(topic.clone())), wall_ms);
        }
    }

    /// Whether a topic without bridges concerns nobody here: no lease, nothing that is kept, told
    /// or handed over. That is most of a large fleet's topics, and they are looked at again every
    /// few seconds.
    fn is_idle(&self, topic: &TopicName, durable: &BTreeSet<OriginFilter>) -> bool {
        self.registry.leases_of(topic).next().is_none()
            && self.durable.get(topic).is_none_or(|before| before == durable)
            && !self.registry.has_route_state(topic)
            && !self.carriers.knows(topic)
    }

    /// Notes who advertises a topic as transient_local; what is kept of those who no longer do is
    /// to be forgotten. Whoever is only not named any more is not gone.
    fn forget_writers(&mut self, now: Instant, topic: &TopicName, durable: Sources) {
        let before = self.durable.remove(topic).unwrap_or_default();
        let Sources { mut known, more } = durable;
        let gone: Vec<OriginFilter> = before.difference(&known).cloned().collect();
        let unnamed = more || self.gateways.has_just_left(now);
        let (stay, gone): (Vec<_>, Vec<_>) =
            gone.into_iter().partition(|of| unnamed || self.registry.may_return(now, of));
        if known.len() + stay.len() <= MAX_UNNAMED {
            known.extend(stay);
            self.forget_sources(topic, gone, &known);
        } else {
            self.forget_sources(topic, [gone, stay].concat(), &known);
        }
        if !known.is_empty() {
            self.durable.insert(topic.clone(), known);
        }
    }

    fn forget_sources(
        &mut self,
        topic: &TopicName,
        gone: Vec<OriginFilter>,
        known: &BTreeSet<OriginFilter>,
    ) {
        for of in gone {
            self.outputs.push_back(Output::ForgetWriters {
                topic: topic.clone(),
                of,
                but: known.clone(),
            });
        }
    }
}
