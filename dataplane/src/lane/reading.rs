//! Where a topic is read on a layer broker that keeps messages in places, by partition.
//!
//! A flow that comes to carry a topic out of the layer begins where the one before it has stopped. If it reads the topic for
//! its own node already, that place lies before or behind: what lies before is read once more, for the bridges out of the layer
//! alone, and what lies between is not for them.

use std::sync::Arc;

use blaze_brokers::{Begin, Place};
use blaze_domain::Scope;

use super::core::DataCore;
use super::path::TopicId;

/// Places of one topic.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Places {
    /// Offset of the next message; empty while nothing is read.
    next: Vec<i64>,
    /// What lies before is not for bridges out of the layer.
    carried_from: Vec<i64>,
    /// What lies before is for bridges out of the layer alone: the others had it.
    again_until: Vec<i64>,
}

/// Which bridges a message of the layer scope is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum For {
    /// All.
    All,
    /// Those out of the layer: the others had it before.
    Outside,
    /// Those within the layer: another flow has carried it out.
    Inside,
}

fn at(offsets: &[i64], partition: usize) -> i64 {
    offsets.get(partition).copied().unwrap_or(0)
}

impl Places {
    /// Takes note of a message that was read, and says whom it is for.
    pub(super) fn take(&mut self, place: Option<Place>) -> For {
        let Some(place) = place else { return For::All };
        if self.next.len() <= place.partition {
            // Kafka's partitions are few; a number beyond is none.
            if place.partition >= MAX_PARTITIONS {
                return For::All;
            }
            self.next.resize(place.partition + 1, 0);
        }
        self.next[place.partition] = place.offset.saturating_add(1);
        if place.offset < at(&self.again_until, place.partition) {
            For::Outside
        } else if place.offset < at(&self.carried_from, place.partition) {
            For::Inside
        } else {
            For::All
        }
    }

    /// Whether it is known of every partition where the next one begins, and they are few enough to be told.
    pub(super) fn are_exact(&self, most: usize) -> bool {
        (1..=most).contains(&self.next.len())
    }

    /// Where the one that comes next begins; empty where nothing is known of it.
    fn stopped_at(&self) -> Vec<i64> {
        if self.next.is_empty() {
            return self.carried_from.clone();
        }
        let partitions = self.next.len();
        (0..partitions)
            .map(|partition| at(&self.next, partition).max(at(&self.carried_from, partition)))
            .collect()
    }

    /// Where a new subscription begins, if bridges out of the layer are to begin there; `again` = it replaces another one.
    fn begin(&mut self, begin: &Begin, again: bool) -> Begin {
        let held: Arc<[i64]> = if again {
            self.next.as_slice().into()
        } else {
            Arc::default()
        };
        match begin {
            Begin::Now if held.is_empty() => {
                self.again_until.clear();
                Begin::Now
            }
            Begin::Now => Begin::At(held),
            Begin::At(offsets) => {
                self.carried_from = offsets.to_vec();
                self.again_until = held.to_vec();
                let earlier = |(partition, offset): (usize, &i64)| match held.get(partition) {
                    Some(held) => (*held).min(*offset),
                    None => *offset,
                };
                Begin::At(offsets.iter().enumerate().map(earlier).collect())
            }
            Begin::Since { appended_ms, .. } => {
                self.carried_from.clear();
                self.again_until = held.to_vec();
                Begin::Since {
                    appended_ms: *appended_ms,
                    latest: held,
                }
            }
        }
    }
}

/// Partitions of a topic whose places are kept.
const MAX_PARTITIONS: usize = 4096;

impl DataCore {
    /// Where the layer scope is to be subscribed for a topic. `again`: another subscription was read until now.
    pub fn begin_reading(&mut self, topic: TopicId, begin: &Begin, again: bool) -> Begin {
        self.path_mut(topic).places.begin(begin, again)
    }

    /// The layer scope is subscribed for a topic, from these offsets on.
    pub fn reads_from(&mut self, topic: TopicId, starts: &[i64]) {
        self.path_mut(topic).places.next = starts.to_vec();
    }

    /// Where the flow stands that carries a topic out of the layer next begins; empty where the broker has no places.
    #[must_use]
    pub fn stopped_at(&self, topic: TopicId) -> Vec<i64> {
        self.path(topic).places.stopped_at()
    }

    /// Nothing of a scope is read of a topic any more. Only the layer scope has places.
    pub fn reads_no_more(&mut self, topic: TopicId, scope: Scope) {
        if scope == Scope::Layer {
            self.path_mut(topic).places = Places::default();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(offset: i64) -> Option<Place> {
        Some(Place {
            partition: 0,
            offset,
            appended_ms: None,
        })
    }

    fn at_0(offset: i64) -> Begin {
        Begin::At([offset].into())
    }

    #[test]
    fn a_topic_that_was_not_read_is_read_from_where_the_other_stopped() {
        let mut places = Places::default();
        assert_eq!(places.begin(&at_0(7), false), at_0(7));
        assert_eq!(
            places.stopped_at(),
            [7],
            "nothing was read yet: the next one begins there too"
        );
        assert_eq!(places.take(place(7)), For::All);
        assert_eq!(places.stopped_at(), [8]);
    }

    #[test]
    fn what_was_read_before_is_read_again_for_the_bridges_out_of_the_layer_alone() {
        let mut places = Places::default();
        places.take(place(9));
        assert_eq!(places.begin(&at_0(7), true), at_0(7));
        let taken: Vec<For> = (7..12).map(|offset| places.take(place(offset))).collect();
        assert_eq!(taken, [For::Outside, For::Outside, For::Outside, For::All, For::All]);
    }

    #[test]
    fn what_another_has_carried_is_not_carried_again() {
        let mut places = Places::default();
        places.take(place(4));
        assert_eq!(places.begin(&at_0(7), true), at_0(5));
        assert_eq!(places.stopped_at(), [7]);
        let taken: Vec<For> = (5..9).map(|offset| places.take(place(offset))).collect();
        assert_eq!(taken, [For::Inside, For::Inside, For::All, For::All]);
    }

    #[test]
    fn after_a_crash_it_begins_by_time_and_no_later_than_it_stood() {
        let mut places = Places::default();
        let since = |latest: &[i64]| Begin::Since {
            appended_ms: 5,
            latest: latest.into(),
        };
        assert_eq!(places.begin(&since(&[]), false), since(&[]));
        places.take(place(9));
        assert_eq!(places.begin(&since(&[]), true), since(&[10]));
        assert_eq!(
            [places.take(place(8)), places.take(place(10))],
            [For::Outside, For::All]
        );
    }

    #[test]
    fn a_subscription_that_is_replaced_goes_on_where_it_was() {
        let mut places = Places::default();
        assert_eq!(places.begin(&Begin::Now, true), Begin::Now, "a broker without places");
        places.take(place(3));
        assert_eq!(places.begin(&Begin::Now, true), at_0(4));
        assert_eq!(places.begin(&Begin::Now, false), Begin::Now, "there was a pause");
        assert_eq!(places.take(None), For::All);
        let far = Place {
            partition: usize::MAX,
            offset: i64::MAX,
            appended_ms: None,
        };
        assert_eq!(places.take(Some(far)), For::All);
    }
}
