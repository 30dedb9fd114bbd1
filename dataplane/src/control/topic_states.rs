//! How many topics are in which state, kept while they are planned.

use std::collections::BTreeMap;

use blaze_domain::TopicName;

use crate::plan::TopicPlan;

/// Whether a topic is carried.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum TopicState {
    /// Advertised, and nobody requests it.
    NoRequest,
    /// Requested, and nobody advertises it.
    NoAdvertise,
    /// Both, but no bridge can be made.
    Blocked,
    /// Both.
    Flowing,
}

impl TopicState {
    /// The state of a topic by whether it is advertised and requested, and by its plan; `None`
    /// where it is neither.
    #[must_use]
    pub fn of((advertised, requested): (bool, bool), plan: &TopicPlan) -> Option<Self> {
        match (advertised, requested) {
            (false, false) => None,
            (true, false) => Some(Self::NoRequest),
            (false, true) => Some(Self::NoAdvertise),
            (true, true) if plan.bridges.is_empty() && !plan.blocked.is_empty() => {
                Some(Self::Blocked)
            }
            (true, true) => Some(Self::Flowing),
        }
    }

    /// As it stands in answers.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::NoRequest => "no_request",
            Self::NoAdvertise => "no_advertise",
            Self::Blocked => "blocked",
            Self::Flowing => "flowing",
        }
    }
}

/// The states of all topics.
#[derive(Debug, Default)]
pub(super) struct TopicStates {
    by_topic: BTreeMap<TopicName, TopicState>,
    counts: BTreeMap<TopicState, u64>,
}

impl TopicStates {
    pub(super) fn set(&mut self, topic: &TopicName, state: Option<TopicState>) {
        let before = match state {
            Some(state) => self.by_topic.insert(topic.clone(), state),
            None => self.by_topic.remove(topic),
        };
        if before == state {
            return;
        }
        if let Some(count) = before.and_then(|before| self.counts.get_mut(&before)) {
            *count -= 1;
        }
        if let Some(state) = state {
            *self.counts.entry(state).or_default() += 1;
        }
    }

    /// Topics that are in a state, by its name in answers.
    pub(super) fn in_state(&self, state: &str) -> impl Iterator<Item = &TopicName> {
        self.by_topic.iter().filter(move |(_, at)| at.as_str() == state).map(|(topic, _)| topic)
    }

    /// Topics by state, without states that no topic has.
    pub(super) fn counts(&self) -> impl Iterator<Item = (TopicState, u64)> {
        self.counts.iter().map(|(state, count)| (*state, *count)).filter(|(_, count)| *count > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_topic_counts_once_with_its_newest_state() {
        let mut states = TopicStates::default();
        let [a, b] = ["a", "b"].map(|topic| topic.parse::<TopicName>().unwrap());
        for (topic, state) in [
            (&a, Some(TopicState::NoRequest)),
            (&b, Some(TopicState::NoRequest)),
            (&a, Some(TopicState::Flowing)),
            (&a, Some(TopicState::Flowing)),
            (&b, None),
            (&b, None),
        ] {
            states.set(topic, state);
        }
        assert_eq!(states.counts().collect::<Vec<_>>(), [(TopicState::Flowing, 1)]);
        assert_eq!(states.in_state("flowing").collect::<Vec<_>>(), [&a]);
        assert_eq!(states.in_state("no_request").count(), 0);
    }
}
