//! Topics that this flow carries out of its layer: it takes them over where the one before it has stopped, and says where it
//! stops itself.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Instant;

use blaze_brokers::Begin;
use blaze_domain::TopicName;

use super::ControlCore;
use crate::plan::TopicPlan;
use crate::registry::LEGACY;
use crate::world::Carrying;

/// What a plan changes of who carries a topic out of the layer.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Duty {
    /// Nothing.
    #[default]
    Same,
    /// This flow does from now on, and begins there on the layer broker.
    Takes(Begin),
    /// Another one will: it is to be told where this flow has stopped.
    GivesUp,
}

/// What is given up and was given up.
#[derive(Debug, Default)]
pub(super) struct Carriers {
    /// The executor has not said yet where it stopped: until then others hear that it is still carried.
    giving_up: BTreeSet<TopicName>,
    /// Where this flow stopped, told until another one carries it, or it would be old.
    handed_over: BTreeMap<TopicName, (Instant, Arc<[i64]>)>,
    /// Topics that were given up with the place where this flow stopped.
    handovers: u64,
    /// Topics that were taken over at the place where another flow stopped.
    taken_over: u64,
}

impl ControlCore {
    /// Where this flow has stopped reading a topic that it gave up, by partition; `None` where the broker has no places.
    pub fn given_up(&mut self, now: Instant, wall_ms: u64, topic: &TopicName, places: Option<Vec<i64>>) {
        if !self.carriers.giving_up.remove(topic) {
            return;
        }
        if let Some(places) = places.filter(|places| !places.is_empty()) {
            self.carriers.handovers += 1;
            self.carriers.handed_over.insert(topic.clone(), (now, places.into()));
        }
        self.touch_urgent(now, topic);
        self.plan_due(now, wall_ms);
    }

    /// Whether everything that is given up has been told.
    #[must_use]
    pub fn has_handed_over(&self) -> bool {
        self.carriers.giving_up.is_empty() && !self.registry.has_unannounced()
    }

    /// Topics that were handed over, and that were taken over at a given place, since the start.
    #[must_use]
    pub fn handovers(&self) -> (u64, u64) {
        (self.carriers.handovers, self.carriers.taken_over)
    }

    /// What a new plan means for who carries the topic.
    pub(super) fn duty(&mut self, now: Instant, topic: &TopicName, carried: bool, plan: &TopicPlan) -> Duty {
        let reliable = plan
            .bridges
            .iter()
            .any(|bridge| bridge.carries_out() && bridge.lane.reliable);
        match (carried, plan.carries_out()) {
            (false, true) => {
                self.carriers.handed_over.remove(topic);
                self.carriers.giving_up.remove(topic);
                let begin = self.registry.begin_carrying(now, topic, reliable);
                self.carriers.taken_over += u64::from(begin != Begin::Now);
                Duty::Takes(begin)
            }
            (true, false) if plan.carrier.is_some() => {
                self.carriers.giving_up.insert(topic.clone());
                Duty::GivesUp
            }
            _ => Duty::Same,
        }
    }

    /// What is told of the own part in a topic.
    pub(super) fn carrying(&mut self, now: Instant, topic: &TopicName, plan: &TopicPlan) -> Carrying {
        if plan.carries_out() || self.carriers.giving_up.contains(topic) {
            return Carrying::Carries;
        }
        let old = |since: Instant| now.saturating_duration_since(since) >= LEGACY / 2;
        match self.carriers.handed_over.get(topic) {
            Some((since, _)) if old(*since) || self.registry.is_carried_elsewhere(topic) => {
                self.carriers.handed_over.remove(topic);
                Carrying::No
            }
            Some((_, places)) => Carrying::HandedOver(Arc::clone(places)),
            None => Carrying::No,
        }
    }
}
