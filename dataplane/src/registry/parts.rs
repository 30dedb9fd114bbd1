//! Who carries what is published on a layer scope out of the layer: as it travels, and what follows
//! when it changes.
//!
//! ```text
//! carry ─► (drain, a better one has settled, or one has less to carry) ─► handover: next_offset ─► the next one begins there
//!       └► silence ─► the next one begins on the broker a second before the last sign of life
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::Begin;
use blaze_domain::{FlowId, TopicName};
use blaze_proto::link::link_control::RouteState;

use super::Registry;
use super::announce::MAX_ENTRIES;
use super::remote::Remote;
use super::wire::MAX_ROUTES;
use crate::world::{Carrying, Handover, Hold, Part, Reach, TopicEntry};

/// A route state with this step says that the flow carries the topic out of its layer.
const CARRY: &str = "carry";
/// One with this step says that it did, and where in a partition the next one begins.
const HANDOVER: &str = "handover";
/// Partitions whose offsets are handed over; of topics with more only the time of the last sign of
/// life is known.
pub(crate) const MAX_PARTITIONS: usize = MAX_ROUTES / 2;
/// What a flow has left behind is taken up within this time: later it would be old.
pub const LEGACY: Duration = Duration::from_secs(10);
/// How much before the last sign of life of a flow that has died the next one begins.
const BEFORE_LAST_SIGN_MS: i64 = 1000;
/// How much before the last sign of life of a flow that lives, but has lost its way out, the next
/// one begins: as much more as it takes to notice that on the inter scope.
const BEFORE_LOST_WAY_MS: i64 = BEFORE_LAST_SIGN_MS + 2500;

/// Where another flow of the group stopped.
pub(super) struct Legacy {
    begin: Begin,
    at: Instant,
}

/// What has been left behind, by topic.
pub(super) type Legacies = BTreeMap<TopicName, Legacy>;

/// The route states that say who carries a topic.
#[must_use]
pub(crate) fn carrying_states(me: &FlowId, carrying: &Carrying) -> Vec<RouteState> {
    let state = |step: &str, receiver: &FlowId, next_offset: u64| RouteState {
        to_layer: me.layer.to_string(),
        receiver: receiver.to_string(),
        step: step.to_owned(),
        ok: true,
        code: "ok".to_owned(),
        next_offset,
    };
    match carrying {
        Carrying::No => Vec::new(),
        Carrying::Carries => vec![state(CARRY, me, 0)],
        Carrying::HandedOver(Handover { offsets, to }) => {
            let to = to.as_ref().unwrap_or(me);
            let offsets = offsets.iter().take(MAX_PARTITIONS);
            offsets.map(|offset| state(HANDOVER, to, u64::try_from(*offset).unwrap_or(0))).collect()
        }
    }
}

/// The part of a flow in a topic, as its route states tell; of its receivers those of one layer.
pub(super) fn part_of(flow: &FlowId, routes: &[RouteState], layer: &str) -> Part {
    let handed = || routes.iter().filter(|route| route.step == HANDOVER);
    let offsets: Arc<[i64]> =
        handed().map(|route| i64::try_from(route.next_offset).unwrap_or(i64::MAX)).collect();
    let to = handed().next().and_then(|route| route.receiver.parse::<FlowId>().ok());
    let carrying = if routes.iter().any(|route| route.step == CARRY) {
        Carrying::Carries
    } else if offsets.is_empty() {
        Carrying::No
    } else {
        Carrying::HandedOver(Handover {
            offsets,
            to: to.filter(|to| to != flow && to.layer == flow.layer),
        })
    };
    let sent = routes.iter().filter(|route| route.step == "bridge");
    let receivers: BTreeSet<FlowId> = sent
        .filter_map(|route| route.receiver.parse::<FlowId>().ok())
        .filter(|receiver| receiver.layer.as_str() == layer && receiver != flow)
        .collect();
    Part {
        carrying,
        receivers: receivers.into_iter().collect(),
        more_receivers: routes.len() >= MAX_ROUTES,
        hold: Hold::default(),
    }
}

impl Registry {
    /// Where this flow begins with what it is to carry out of the layer from now on: where the flow
    /// before it has stopped, if there was one lately. After a crash only `reliable` topics are
    /// begun in the past.
    pub fn begin_carrying(&mut self, now: Instant, topic: &TopicName, reliable: bool) -> Begin {
        let Some(legacy) = self.legacies.remove(topic) else {
            return Begin::Now;
        };
        let fresh = now.saturating_duration_since(legacy.at) < LEGACY;
        match legacy.begin {
            Begin::Since { .. } if !reliable => Begin::Now,
            begin if fresh => begin,
            _ => Begin::Now,
        }
    }

    /// Another flow of the group that lives says that it carries the topic.
    #[must_use]
    pub fn is_carried_elsewhere(&self, topic: &TopicName) -> bool {
        let others = self.world.flows.iter().filter(|(flow, _)| **flow != self.config.me);
        let mut living =
            others.filter(|(flow, view)| view.reach != Reach::Down && self.shares_layer(flow));
        living.any(|(flow, _)| self.carrying(flow, topic) == Some(&Carrying::Carries))
    }

    /// Topics that cannot wait for quiet: who carries them has changed.
    pub fn take_urgent(&mut self) -> BTreeSet<TopicName> {
        std::mem::take(&mut self.urgent)
    }

    /// Whether a flow shares the layer broker with this one.
    pub(super) fn shares_layer(&self, flow: &FlowId) -> bool {
        let own = self.world.own().and_then(|own| own.layer_scope);
        let view = self.world.flows.get(flow);
        flow.layer == self.config.me.layer
            && own.is_some()
            && view.is_some_and(|view| view.layer_scope == own)
    }

    fn part(&self, flow: &FlowId, topic: &TopicName) -> Option<&Part> {
        self.world.flows.get(flow)?.parts.get(topic)
    }

    fn carrying(&self, flow: &FlowId, topic: &TopicName) -> Option<&Carrying> {
        self.part(flow, topic).map(|part| &part.carrying)
    }

    /// Whether the own flow keeps a topic that it carries, or is about to.
    pub fn set_hold(&mut self, topic: &TopicName, hold: Hold) {
        if let Some(own) = self.world.flows.get_mut(&self.config.me) {
            own.parts.entry(topic.clone()).or_default().hold = hold;
        }
    }

    /// Whether the own flow keeps a topic that it carries.
    #[must_use]
    pub fn hold(&self, topic: &TopicName) -> &Hold {
        self.part(&self.config.me, topic).map_or(&Hold::Hashing, |part| &part.hold)
    }

    /// A flow of the group has given this one the topic by name.
    #[must_use]
    pub fn was_given(&self, topic: &TopicName) -> bool {
        let others = self.world.flows.keys().filter(|flow| **flow != self.config.me);
        let mut given =
            others.filter(|flow| self.shares_layer(flow)).map(|flow| self.carrying(flow, topic));
        given.any(|carrying| match carrying {
            Some(Carrying::HandedOver(handover)) => handover.to.as_ref() == Some(&self.config.me),
            _ => false,
        })
    }

    /// The own part in a topic, as it is told to others.
    pub(super) fn note_own_part(&mut self, now: Instant, topic: &TopicName, routes: &[RouteState]) {
        let me = self.config.me.clone();
        let mut part = part_of(&me, routes, me.layer.as_str());
        let carrying = part.carrying.clone();
        let before = self.part(&me, topic);
        let moves = before.is_none_or(|before| before.carrying != carrying);
        if let (Carrying::Carries, Some(before)) = (&carrying, before) {
            part.hold = before.hold.clone();
        }
        self.put_part(&me, topic, part);
        match carrying {
            Carrying::Carries => drop(self.legacies.remove(topic)),
            Carrying::HandedOver(handover) => {
                if moves {
                    self.note_move(now, &me, &handover);
                    // Should the next one fail before it begins, this flow knows where.
                    self.leave_behind(now, topic, Begin::At(handover.offsets));
                }
            }
            Carrying::No => {}
        }
    }

    /// What another flow told of some topics has changed.
    pub(super) fn note_parts(&mut self, now: Instant, flow: &FlowId, topics: &BTreeSet<TopicName>) {
        let Some(remote) = self.remotes.get(flow) else { return };
        let layer = self.config.me.layer.as_str();
        let parts: Vec<(TopicName, Part)> = topics
            .iter()
            .map(|topic| (topic.clone(), part_of(flow, remote.routes(topic), layer)))
            .collect();
        let shares = self.shares_layer(flow);
        for (topic, part) in parts {
            let moves = self.carrying(flow, &topic).unwrap_or(&Carrying::No) != &part.carrying;
            if shares && moves {
                match &part.carrying {
                    Carrying::HandedOver(handover) => {
                        self.note_move(now, flow, handover);
                        self.leave_behind(now, &topic, Begin::At(Arc::clone(&handover.offsets)));
                    }
                    Carrying::Carries => drop(self.legacies.remove(&topic)),
                    Carrying::No => self.take_up_lost(now, flow, &topic),
                }
                self.urgent.insert(topic.clone());
            } else if !shares
                && self.legacies.contains_key(&topic)
                && !self.is_asked_outside(&topic)
            {
                // What is left behind is for those who asked all the while. Few topics are, and
                // looking for them takes all flows.
                self.legacies.remove(&topic);
            }
            self.put_part(flow, &topic, part);
        }
    }

    /// A flow of the group does not carry a topic any more and has handed it to nobody, though
    /// somebody elsewhere asks for it whom this flow reaches: that one has lost its way to them.
    /// What it sent since is lost.
    fn take_up_lost(&mut self, now: Instant, flow: &FlowId, topic: &TopicName) {
        let carried = self.carrying(flow, topic) == Some(&Carrying::Carries);
        let sign = self.remotes.get(flow).and_then(Remote::last_read_ms);
        if let Some(last_ms) = sign.filter(|_| carried && self.is_asked_outside(topic)) {
            let since = Begin::Since {
                appended_ms: last_ms.saturating_sub(BEFORE_LOST_WAY_MS),
                latest: Arc::default(),
            };
            self.leave_behind(now, topic, since);
        }
    }

    /// Whether a flow of another group that can be reached asks for the topic.
    fn is_asked_outside(&self, topic: &TopicName) -> bool {
        let others = self.world.flows.iter().filter(|(flow, _)| **flow != self.config.me);
        let mut outside =
            others.filter(|(flow, view)| view.reach != Reach::Down && !self.shares_layer(flow));
        outside.any(|(_, view)| view.topics.get(topic).is_some_and(TopicEntry::is_requested))
    }

    fn put_part(&mut self, flow: &FlowId, topic: &TopicName, part: Part) {
        let Some(view) = self.world.flows.get_mut(flow) else {
            return;
        };
        if part == Part::default() {
            view.parts.remove(topic);
        } else {
            view.parts.insert(topic.clone(), part);
        }
    }

    /// A flow of the group has gone without a word: what it carried begins a second before its last
    /// sign of life.
    pub(super) fn inherit(&mut self, now: Instant, flow: &FlowId) {
        let Some(view) = self.world.flows.get(flow).filter(|_| self.shares_layer(flow)) else {
            return;
        };
        let carried = view.parts.iter().filter(|(_, part)| part.carrying == Carrying::Carries);
        let topics: Vec<TopicName> = carried.map(|(topic, _)| topic.clone()).collect();
        let sign = self.remotes.get(flow).and_then(Remote::last_read_ms);
        for topic in topics {
            if let Some(last_ms) = sign {
                let since = Begin::Since {
                    appended_ms: last_ms.saturating_sub(BEFORE_LAST_SIGN_MS),
                    latest: Arc::default(),
                };
                self.leave_behind(now, &topic, since);
            }
            self.urgent.insert(topic);
        }
    }

    fn leave_behind(&mut self, now: Instant, topic: &TopicName, begin: Begin) {
        if self.carrying(&self.config.me, topic) == Some(&Carrying::Carries) {
            return;
        }
        if self.legacies.len() >= MAX_ENTRIES {
            self.legacies.retain(|_, legacy| now.saturating_duration_since(legacy.at) < LEGACY);
        }
        if self.legacies.len() < MAX_ENTRIES {
            self.legacies.insert(topic.clone(), Legacy { begin, at: now });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_carries_a_topic_survives_its_way() {
        let me: FlowId = "cloud/a".parse().unwrap();
        for carrying in [
            Carrying::No,
            Carrying::Carries,
            Carrying::HandedOver([0].into()),
            Carrying::HandedOver([17, 0, i64::MAX].into()),
            Carrying::HandedOver(Handover {
                to: Some("cloud/b".parse().unwrap()),
                ..[5, 6].into()
            }),
        ] {
            let part = part_of(&me, &carrying_states(&me, &carrying), "cloud");
            assert_eq!(part.carrying, carrying);
            assert!(part.receivers.is_empty());
        }
    }

    #[test]
    fn offsets_beyond_what_fits_are_left_out_and_absurd_ones_do_no_harm() {
        let me: FlowId = "cloud/a".parse().unwrap();
        let many = Carrying::HandedOver([7; 100].into());
        assert_eq!(carrying_states(&me, &many).len(), MAX_PARTITIONS);
        let mut states = carrying_states(&me, &Carrying::HandedOver([-5].into()));
        states[0].next_offset = u64::MAX;
        assert_eq!(
            part_of(&me, &states, "cloud").carrying,
            Carrying::HandedOver([i64::MAX].into())
        );
    }

    #[test]
    fn a_topic_is_given_within_the_layer_alone() {
        let me: FlowId = "cloud/a".parse().unwrap();
        for receiver in ["cloud/a", "fog/b", "garbage", ""] {
            let mut states = carrying_states(&me, &Carrying::HandedOver([5].into()));
            states[0].receiver = receiver.to_owned();
            assert_eq!(
                part_of(&me, &states, "cloud").carrying,
                Carrying::HandedOver([5].into()),
                "{receiver}"
            );
        }
    }

    #[test]
    fn of_its_receivers_those_of_the_own_layer_count() {
        let flow: FlowId = "edge/r".parse().unwrap();
        let route = |receiver: &str, step: &str| RouteState {
            receiver: receiver.into(),
            step: step.into(),
            ..RouteState::default()
        };
        let routes = [
            route("cloud/b", "bridge"),
            route("cloud/a", "bridge"),
            route("fog/a", "bridge"),
            route("cloud/c", "deliver"),
            route("garbage", "bridge"),
        ];
        let expected: Vec<FlowId> = vec!["cloud/a".parse().unwrap(), "cloud/b".parse().unwrap()];
        assert_eq!(part_of(&flow, &routes, "cloud").receivers, expected);
    }
}
