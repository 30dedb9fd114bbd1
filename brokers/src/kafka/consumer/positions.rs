//! What the server says of a topic, against where the client reads it.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::{Consumer, State};
use crate::kafka::directory::{Marks, TopicInfo};

/// A beginning or an end that does not hold what is to be read next is believed after this time: a server that stood still for a moment,
/// and begins to lead the partition again, names others first. To believe them would be to read the last records twice, or never.
const BELIEVED: Duration = Duration::from_secs(3);

impl Consumer {
    /// A topic has so many partitions: those that are new are read from their beginning.
    pub(in crate::kafka) fn note_partitions(&self, topic: &str, partitions: usize) {
        let Some((mut state, client)) = self.reading() else {
            return;
        };
        let Some(topic) = state.topics.get_mut(topic) else {
            return;
        };
        if topic.assigned && partitions > topic.partitions.len() {
            topic.grow(partitions, &self.layer);
            topic.reassign(&client);
        }
    }

    /// Looks whether the positions of a topic are on the server, and moves those that are not to what is nearest.
    pub(in crate::kafka) fn check_positions(&self, now: Instant, topic: &str, info: &TopicInfo, marks: &[Marks]) {
        let Some((mut state, client)) = self.reading() else {
            return;
        };
        let State { topics, moved, .. } = &mut *state;
        let Some(topic) = topics.get_mut(topic) else {
            return;
        };
        if !topic.assigned || topic.uuid != info.uuid {
            return;
        }
        for (number, (partition, mark)) in topic.partitions.iter_mut().zip(marks).enumerate() {
            if mark.holds(partition.next) {
                partition.doubted_since = None;
            } else if now.saturating_duration_since(*partition.doubted_since.get_or_insert(now)) < BELIEVED {
                self.look_again();
                continue;
            }
            let at = partition.next.clamp(mark.low, mark.high.max(mark.low));
            if at != partition.next {
                tracing::warn!(
                    topic = %topic.source.topic, partition = number, position = partition.next, moved_to = at,
                    "the server no longer has what was to be read next"
                );
                if at < partition.next {
                    moved.insert(Arc::clone(&topic.source.topic));
                }
                partition.next = at;
            }
        }
        // Also where nothing moved: the client stops reading a partition whose position it could not find for a moment.
        topic.reassign(&client);
    }

    /// Looks whether a topic is read although records wait.
    pub(in crate::kafka) fn watch(&self, topic: &str, info: &TopicInfo, marks: &[Marks]) {
        let Some((mut state, client)) = self.reading() else {
            return;
        };
        if let Some(topic) = state.topics.get_mut(topic)
            && topic.assigned
            && topic.uuid == info.uuid
        {
            topic.watch(marks, Instant::now(), &client);
        }
    }
}
