//! Topics that this flow carries out of its layer: it takes them over where the one before it has
//! stopped, and says where it stops itself.
//!
//! ```text
//! gives up ─► stopped at these places ─► lanes are empty ─► handed over
//!                                     └► not within 400 ms ─► taken back: it goes on from these places
//! ```
//!
//! Until it is handed over the others hear that it is still carried. So nothing that this flow has
//! sent is overtaken by what the next one sends, and nothing is dropped that waits in a lane. A
//! flow that is going away does not wait.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::Begin;
use blaze_domain::{FlowId, TopicName};

use super::ControlCore;
use crate::plan::TopicPlan;
use crate::registry::LEGACY;
use crate::world::{Carrying, FlowState, Handover, Hold};

/// What is on its way when a topic is given up must have arrived, and have been written, within
/// this time. Well below [`DRAIN`](crate::lane::core::DRAIN), after which what waits in a lane is
/// dropped.
const EMPTY_WITHIN: Duration = Duration::from_millis(400);

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

/// A topic that is given up.
#[derive(Debug, Default)]
struct GivingUp {
    /// Who it is given to; `None`: whoever hashing chooses.
    to: Option<FlowId>,
    /// When it was stopped and where, once the executor has said so.
    stopped: Option<(Instant, Arc<[i64]>)>,
}

/// What is given up and was given up.
#[derive(Debug, Default)]
pub(super) struct Carriers {
    /// Others hear that these are still carried.
    giving_up: BTreeMap<TopicName, GivingUp>,
    /// Where this flow stopped, told until another one carries it, or it would be old.
    handed_over: BTreeMap<TopicName, (Instant, Handover)>,
    /// Topics that were given up with the place where this flow stopped.
    handovers: u64,
    /// Topics that were taken over at the place where another flow stopped.
    taken_over: u64,
}

impl Carriers {
    /// Whether nothing is being given up.
    pub(super) fn is_idle(&self) -> bool {
        self.giving_up.is_empty()
    }

    /// The executor has not said yet where a topic that is given up was stopped: until then nothing
    /// else can be planned for it.
    pub(super) fn awaits_places(&self, topic: &TopicName) -> bool {
        self.giving_up.get(topic).is_some_and(|giving| giving.stopped.is_none())
    }

    /// Whether a topic is being given up.
    pub(super) fn gives_up(&self, topic: &TopicName) -> bool {
        self.giving_up.contains_key(topic)
    }

    /// Whether a topic is being given up, or was a moment ago.
    pub(super) fn knows(&self, topic: &TopicName) -> bool {
        self.gives_up(topic) || self.handed_over.contains_key(topic)
    }

    fn stopped_since(&self, topic: &TopicName) -> Option<Instant> {
        Some(self.giving_up.get(topic)?.stopped.as_ref()?.0)
    }
}

impl ControlCore {
    /// Where this flow has stopped reading a topic that it gave up, by partition; `None` where the
    /// broker has no places.
    pub fn given_up(
        &mut self,
        now: Instant,
        wall_ms: u64,
        topic: &TopicName,
        places: Option<Vec<i64>>,
    ) {
        let Some(giving) = self.carriers.giving_up.get_mut(topic) else {
            return;
        };
        let places = places.filter(|places| !places.is_empty());
        let waits = places.is_some() && self.state == FlowState::Ready;
        giving.stopped = places.map(|places| (now, places.into()));
        if !waits {
            self.hand_over(now, wall_ms, topic);
        }
    }

    /// Topics that were given up and are to be handed over as soon as nothing of them waits in a
    /// lane: call [`ControlCore::emptied`] then.
    #[must_use]
    pub fn emptying(&self) -> Vec<TopicName> {
        let stopped = self.carriers.giving_up.iter().filter(|(_, giving)| giving.stopped.is_some());
        stopped.map(|(topic, _)| topic.clone()).collect()
    }

    /// Nothing of a topic that was given up waits in a lane any more.
    pub fn emptied(&mut self, now: Instant, wall_ms: u64, topic: &TopicName) {
        if self.carriers.stopped_since(topic).is_some() {
            self.hand_over(now, wall_ms, topic);
        }
    }

    /// Whether everything that is given up has been told.
    #[must_use]
    pub fn has_handed_over(&self) -> bool {
        self.carriers.is_idle() && !self.registry.has_unannounced()
    }

    /// Topics that were handed over, and that were taken over at a given place, since the start.
    #[must_use]
    pub fn handovers(&self) -> (u64, u64) {
        (self.carriers.handovers, self.carriers.taken_over)
    }

    /// Tells the others where the next one begins.
    fn hand_over(&mut self, now: Instant, wall_ms: u64, topic: &TopicName) {
        let Some(giving) = self.carriers.giving_up.remove(topic) else {
            return;
        };
        if self.state == FlowState::Ready {
            self.balance.note_gone(now, topic, giving.to.as_ref());
        }
        if let Some((_, offsets)) = giving.stopped {
            let handover = Handover { offsets, to: giving.to };
            self.carriers.handovers += 1;
            self.carriers.handed_over.insert(topic.clone(), (now, handover));
        }
        self.touch_urgent(now, topic);
        self.plan_due(now, wall_ms);
    }

    /// A flow that goes waits for nothing.
    pub(super) fn hand_over_all(&mut self, now: Instant, wall_ms: u64) {
        for topic in self.emptying() {
            self.hand_over(now, wall_ms, &topic);
        }
    }

    /// What could not be emptied in time stays here.
    pub(super) fn take_back_late(&mut self, now: Instant, wall_ms: u64) {
        let late = |topic: &TopicName| {
            let since = self.carriers.stopped_since(topic);
            since.is_some_and(|since| now.saturating_duration_since(since) >= EMPTY_WITHIN)
        };
        let late: Vec<TopicName> = self.emptying().into_iter().filter(late).collect();
        for topic in late {
            tracing::info!(
                %topic,
                "what was on its way was not acknowledged in time: the topic stays",
            );
            self.registry.set_hold(&topic, Hold::Stays);
            self.touch_urgent(now, &topic);
            self.plan_due(now, wall_ms);
            // Unless another one carries it by now, or nobody asks for it any more.
            self.hand_over(now, wall_ms, &topic);
        }
    }

    /// What a new plan means for who carries the topic.
    pub(super) fn duty(
        &mut self,
        now: Instant,
        topic: &TopicName,
        carried: bool,
        plan: &TopicPlan,
    ) -> Duty {
        match (carried, plan.carries_out()) {
            (false, true) => Duty::Takes(self.take(now, topic, plan)),
            (true, false) if plan.carrier.is_some() => {
                let to = self.balance.gift_of(topic).filter(|to| plan.carrier.as_ref() == Some(to));
                let giving = GivingUp { to: to.cloned(), stopped: None };
                self.carriers.giving_up.insert(topic.clone(), giving);
                Duty::GivesUp
            }
            _ => Duty::Same,
        }
    }

    /// This flow carries the topic from now on. Returns where it begins.
    fn take(&mut self, now: Instant, topic: &TopicName, plan: &TopicPlan) -> Begin {
        let left = self.carriers.handed_over.remove(topic);
        if let Some(giving) = self.carriers.giving_up.remove(topic) {
            self.balance.note_taken_back(now, topic);
            self.registry.set_hold(topic, Hold::Stays);
            if let Some((_, offsets)) = giving.stopped {
                return Begin::At(offsets);
            }
        }
        if self.registry.was_given(topic) {
            self.balance.note_got(now, topic);
            self.registry.set_hold(topic, Hold::Stays);
        }
        let out = plan.bridges.iter().filter(|bridge| bridge.carries_out());
        let reliable = out.into_iter().any(|bridge| bridge.lane.reliable);
        let begin = match (self.registry.begin_carrying(now, topic, reliable), left) {
            // Nobody has begun where this flow stopped: the one that was to do it goes away itself.
            (Begin::Now, Some((since, handover)))
                if now.saturating_duration_since(since) < LEGACY =>
            {
                Begin::At(handover.offsets)
            }
            (begin, _) => begin,
        };
        self.carriers.taken_over += u64::from(begin != Begin::Now);
        begin
    }

    /// What is told of the own part in a topic.
    pub(super) fn carrying(
        &mut self,
        now: Instant,
        topic: &TopicName,
        plan: &TopicPlan,
    ) -> Carrying {
        if plan.carries_out() || self.carriers.giving_up.contains_key(topic) {
            return Carrying::Carries;
        }
        let old = |since: Instant| now.saturating_duration_since(since) >= LEGACY / 2;
        match self.carriers.handed_over.get(topic) {
            Some((since, _)) if old(*since) || self.registry.is_carried_elsewhere(topic) => {
                self.carriers.handed_over.remove(topic);
                Carrying::No
            }
            Some((_, handover)) => Carrying::HandedOver(handover.clone()),
            None => Carrying::No,
        }
    }
}
