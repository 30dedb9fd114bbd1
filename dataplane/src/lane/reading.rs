//! Where a topic is read on a layer broker that keeps messages in places, by partition.
//!
//! A flow that comes to carry a topic out of the layer begins where the one before it has stopped.
//! If it reads the topic for its own node already, that place lies before or behind: what lies
//! before is read once more, for the bridges out of the layer alone, and what lies between is not
//! for them.

use std::sync::Arc;

use blaze_brokers::{Begin, ConsumerOffset};
use blaze_domain::Scope;

use super::core::DataCore;
use super::path::TopicId;

/// Places of one topic.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Places {
    /// Offset of the next message, of all partitions; empty while it is not known where reading
    /// began. Partitions that the topic gets later are read from their beginning.
    next: Vec<i64>,
    /// What lies before is not for bridges out of the layer.
    carried_from: Vec<i64>,
    /// What lies before is for bridges out of the layer alone: the others had it.
    again_until: Vec<i64>,
    /// Where bridges out of the layer are to begin. What the subscription that is to be replaced
    /// still reads is not for them: they get it with the next one.
    takes: Option<Begin>,
    /// The same, from the attempt to subscribe there until the subscription stands: one that is
    /// replaced before has read nothing, and the next one begins there.
    taking: Option<Begin>,
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
    pub(super) fn take(&mut self, place: Option<ConsumerOffset>) -> For {
        let Some(ConsumerOffset { partition, offset, .. }) = place else {
            return For::All;
        };
        // Kafka's partitions are few; a number beyond is none.
        if partition >= MAX_PARTITIONS {
            return For::All;
        }
        // Of the others nothing would be known.
        if !self.next.is_empty() {
            if self.next.len() <= partition {
                self.next.resize(partition + 1, 0);
            }
            if offset < self.next[partition] {
                // A subscription only goes on: the topic was made anew, and nobody had anything of
                // it.
                self.carried_from.clear();
                self.again_until.clear();
            }
            self.next[partition] = offset.saturating_add(1);
        }
        if self.takes.is_some() {
            For::Inside
        } else if offset < at(&self.again_until, partition) {
            For::Outside
        } else if offset < at(&self.carried_from, partition) {
            For::Inside
        } else {
            For::All
        }
    }

    /// Whether it is known of every partition where the next one begins, and they are few enough to
    /// be told.
    pub(super) fn are_exact(&self, most: usize) -> bool {
        self.pending().is_none() && (1..=most).contains(&self.next.len())
    }

    /// Where bridges out of the layer are to begin, while no subscription from there stands.
    fn pending(&self) -> Option<&Begin> {
        self.takes.as_ref().or(self.taking.as_ref())
    }

    /// Where the one that comes next begins; empty where nothing is known of it.
    fn stopped_at(&self) -> Vec<i64> {
        match self.pending() {
            // Nothing was carried from there yet; further partitions were to begin where they
            // stand.
            Some(Begin::At(offsets)) => {
                let further = self.next.iter().skip(offsets.len());
                offsets.iter().chain(further).copied().collect()
            }
            // It is a time, which no one can be told.
            Some(Begin::Since { .. }) => Vec::new(),
            Some(Begin::Now) | None => {
                let stands = |(partition, next): (usize, &i64)| {
                    (*next).max(at(&self.carried_from, partition))
                };
                self.next.iter().enumerate().map(stands).collect()
            }
        }
    }

    /// Bridges out of the layer are to begin there, with the next subscription.
    fn take_over(&mut self, begin: &Begin) {
        self.takes = Some(begin.clone());
    }

    /// Where a new subscription begins; `again` = it replaces another one.
    fn begin(&mut self, again: bool) -> Begin {
        if !again {
            self.next.clear();
        }
        let held: Arc<[i64]> = self.next.as_slice().into();
        self.taking = self.takes.take().or(self.taking.take());
        match &self.taking {
            Some(Begin::At(offsets)) => {
                self.carried_from = offsets.to_vec();
                self.again_until = held.to_vec();
                let earlier = |(partition, offset): (usize, &i64)| match held.get(partition) {
                    Some(held) => (*held).min(*offset),
                    None => *offset,
                };
                let further = held.iter().skip(offsets.len()).copied();
                Begin::At(offsets.iter().enumerate().map(earlier).chain(further).collect())
            }
            Some(Begin::Since { appended_ms, .. }) => {
                self.carried_from.clear();
                self.again_until = held.to_vec();
                Begin::Since { appended_ms: *appended_ms, latest: held }
            }
            Some(Begin::Now) | None if held.is_empty() => {
                self.again_until.clear();
                Begin::Now
            }
            Some(Begin::Now) | None => Begin::At(held),
        }
    }

    /// The subscription stands, from these offsets on.
    fn stands(&mut self, starts: &[i64]) {
        self.next = starts.to_vec();
        self.taking = None;
    }
}

/// Partitions of a topic whose places are kept.
const MAX_PARTITIONS: usize = 4096;

impl DataCore {
    /// The bridges out of the layer that a topic got now begin there, as soon as its layer scope is
    /// subscribed anew.
    pub fn takes_over(&mut self, topic: TopicId, begin: &Begin) {
        let path = self.path_mut(topic);
        if path.reads(Scope::Layer) && *begin != Begin::Now {
            path.places.take_over(begin);
        }
    }

    /// Where the layer scope is to be subscribed for a topic. `again`: another subscription was
    /// read until now.
    pub fn begin_reading(&mut self, topic: TopicId, again: bool) -> Begin {
        self.path_mut(topic).places.begin(again)
    }

    /// The layer scope is subscribed for a topic, from these offsets on; none where its broker has
    /// no places.
    pub fn reads_from(&mut self, topic: TopicId, starts: &[i64]) {
        self.path_mut(topic).places.stands(starts);
    }

    /// Where the flow stands that carries a topic out of the layer next begins; empty where the
    /// broker has no places.
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

    fn place_in(partition: usize, offset: i64) -> Option<ConsumerOffset> {
        Some(ConsumerOffset { partition, offset, appended_ms: None })
    }

    fn place(offset: i64) -> Option<ConsumerOffset> {
        place_in(0, offset)
    }

    fn at_0(offset: i64) -> Begin {
        Begin::At([offset].into())
    }

    fn since(latest: &[i64]) -> Begin {
        Begin::Since { appended_ms: 5, latest: latest.into() }
    }

    /// One partition, read until there.
    fn read_until(next: i64) -> Places {
        let mut places = Places::default();
        assert_eq!(places.begin(false), Begin::Now);
        places.stands(&[next]);
        places
    }

    impl Places {
        /// Takes over, and subscribes at once.
        fn takes(&mut self, begin: &Begin) -> Begin {
            self.take_over(begin);
            let begin = self.begin(!self.next.is_empty());
            if let Begin::At(offsets) = &begin {
                self.stands(offsets);
            }
            begin
        }

        fn read<const COUNT: usize>(&mut self, offsets: [i64; COUNT]) -> [For; COUNT] {
            offsets.map(|offset| self.take(place(offset)))
        }
    }

    #[test]
    fn a_topic_that_was_not_read_is_read_from_where_the_other_stopped() {
        let mut places = Places::default();
        places.take_over(&at_0(7));
        assert_eq!(places.begin(false), at_0(7));
        assert_eq!(places.stopped_at(), [7], "nothing was read yet: the next one begins there too");
        places.stands(&[7]);
        assert_eq!(places.read([7]), [For::All]);
        assert_eq!(places.stopped_at(), [8]);
    }

    #[test]
    fn what_was_read_before_is_read_again_for_the_bridges_out_of_the_layer_alone() {
        let mut places = read_until(10);
        assert_eq!(places.takes(&at_0(7)), at_0(7));
        assert_eq!(places.read([7, 9, 10, 11]), [For::Outside, For::Outside, For::All, For::All]);
    }

    #[test]
    fn what_another_has_carried_is_not_carried_again() {
        let mut places = read_until(5);
        assert_eq!(places.takes(&at_0(7)), at_0(5));
        assert_eq!(places.stopped_at(), [7]);
        assert_eq!(places.read([5, 6, 7, 8]), [For::Inside, For::Inside, For::All, For::All]);
    }

    #[test]
    fn after_a_crash_it_begins_by_time_and_no_later_than_it_stood() {
        assert_eq!(Places::default().takes(&since(&[])), since(&[]));
        let mut places = read_until(10);
        assert_eq!(places.takes(&since(&[])), since(&[10]));
        assert!(!places.are_exact(8) && places.stopped_at().is_empty(), "found out by the server");
        places.stands(&[8]);
        assert_eq!(places.read([8, 10]), [For::Outside, For::All]);
    }

    #[test]
    fn a_subscription_that_is_replaced_goes_on_where_it_was() {
        let mut places = Places::default();
        assert_eq!(places.begin(true), Begin::Now, "a broker without places");
        places.stands(&[]);
        assert_eq!(places.begin(true), Begin::Now, "still none");
        let mut places = read_until(3);
        places.take(place(3));
        assert_eq!(places.begin(true), at_0(4));
        assert_eq!(places.begin(false), Begin::Now, "there was a pause");
        assert_eq!(places.take(None), For::All);
        assert_eq!(places.take(place_in(usize::MAX, i64::MAX)), For::All);
    }

    #[test]
    fn a_takeover_lasts_until_its_subscription_stands() {
        for (takes, begins) in [(at_0(7), at_0(7)), (since(&[]), since(&[]))] {
            let mut places = Places::default();
            places.take_over(&takes);
            assert_eq!(places.begin(false), begins);
            assert_eq!(places.begin(true), begins, "what replaces it begins there");
            places.stands(&[7]);
            assert_eq!(places.begin(true), at_0(7), "from now on it goes on where it is");
        }
        for (takes, begins) in
            [(at_0(7), at_0(7)), (at_0(12), at_0(10)), (since(&[]), since(&[10]))]
        {
            let mut places = read_until(10);
            places.take_over(&takes);
            assert_eq!(places.begin(true), begins);
            assert_eq!(places.begin(true), begins, "also where it was read already");
        }
    }

    #[test]
    fn what_is_given_up_before_its_subscription_stands_begins_where_it_was_taken() {
        let mut places = read_until(10);
        places.take_over(&at_0(7));
        assert_eq!((places.stopped_at(), places.are_exact(8)), (vec![7], false));
        places.begin(true);
        assert_eq!((places.stopped_at(), places.are_exact(8)), (vec![7], false));
        places.stands(&[7]);
        assert_eq!((places.stopped_at(), places.are_exact(8)), (vec![7], true));
    }

    #[test]
    fn what_comes_before_the_new_subscription_is_carried_once() {
        let mut places = read_until(10);
        places.take_over(&at_0(7));
        assert_eq!(places.take(place(10)), For::Inside, "it comes again");
        assert_eq!(places.begin(true), at_0(7));
        places.stands(&[7]);
        assert_eq!(places.read([10, 11]), [For::Outside, For::All]);
    }

    #[test]
    fn a_subscription_that_was_overtaken_by_another_takeover_changes_nothing() {
        let mut places = Places::default();
        places.take_over(&at_0(7));
        places.begin(false);
        places.take_over(&at_0(9));
        places.stands(&[7]);
        assert_eq!(places.stopped_at(), [9]);
        assert_eq!(places.take(place(7)), For::Inside);
        assert_eq!(places.begin(true), at_0(8));
    }

    #[test]
    fn partitions_of_which_nothing_is_known_are_not_taken_for_known() {
        let mut places = Places::default();
        assert_eq!(places.take(place_in(2, 9)), For::All);
        assert_eq!(places.stopped_at(), Vec::<i64>::new());
        assert!(!places.are_exact(8));
        assert_eq!(places.begin(true), Begin::Now);
        places.stands(&[5, 6, 9]);
        places.take(place_in(2, 9));
        assert_eq!(places.stopped_at(), [5, 6, 10]);
        assert!(places.are_exact(8));
        // Who takes over was told of two: the third goes on where it stands.
        places.take_over(&Begin::At([4, 8].into()));
        assert_eq!(places.stopped_at(), [4, 8, 10]);
        assert_eq!(places.begin(true), Begin::At([4, 6, 10].into()));
    }

    #[test]
    fn nobody_had_anything_of_a_topic_that_was_made_anew() {
        let mut places = read_until(10);
        places.takes(&at_0(20));
        assert_eq!(places.read([10, 0, 1]), [For::Inside, For::All, For::All]);
        assert_eq!(places.stopped_at(), [2]);
    }

    #[test]
    fn a_partition_that_comes_later_was_read_from_its_beginning() {
        let mut places = read_until(5);
        places.take(place_in(2, 0));
        assert_eq!(places.stopped_at(), [5, 0, 1]);
        assert!(places.are_exact(8));
    }
}
