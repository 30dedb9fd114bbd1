//! The topics that are written, and whether the server has them.

use std::collections::HashMap;
use std::sync::atomic::{AtomicI32, AtomicUsize, Ordering};
use std::sync::{Arc, Weak};

use parking_lot::Mutex;

/// Not known to exist.
const ABSENT: i32 = 0;

/// A topic that is written. It lives as long as its publishers.
#[derive(Debug)]
pub(super) struct Topic {
    /// Its name on the server.
    pub(super) name: Arc<str>,
    partitions: AtomicI32,
    /// Written also while the scope belongs to another flow.
    pub(super) stays_open: bool,
}

impl Topic {
    /// How many partitions the server has of it; `None` = it is not known to be there, so that nothing is handed over.
    pub(super) fn partitions(&self) -> Option<i32> {
        let partitions = self.partitions.load(Ordering::Acquire);
        (partitions != ABSENT).then_some(partitions)
    }

    /// The server says that there is no such topic.
    pub(super) fn vanished(&self) {
        self.partitions.store(ABSENT, Ordering::Release);
    }
}

/// All topics that are written.
#[derive(Debug, Default)]
pub(super) struct Topics {
    by_name: Mutex<HashMap<Arc<str>, Weak<Topic>>>,
    /// Where the next search for absent ones begins.
    next: AtomicUsize,
}

impl Topics {
    /// The topic of a name; also whether it is new here.
    pub(super) fn of(&self, name: &Arc<str>, stays_open: bool) -> (Arc<Topic>, bool) {
        let mut by_name = self.by_name.lock();
        if let Some(topic) = by_name.get(name).and_then(Weak::upgrade) {
            return (topic, false);
        }
        if by_name.len() == by_name.capacity() {
            by_name.retain(|_, topic| topic.strong_count() > 0);
        }
        let topic = Arc::new(Topic {
            name: Arc::clone(name),
            partitions: AtomicI32::new(ABSENT),
            stays_open,
        });
        by_name.insert(Arc::clone(name), Arc::downgrade(&topic));
        (topic, true)
    }

    /// Up to `limit` topics that are not known to be there, in turns.
    pub(super) fn absent(&self, limit: usize) -> Vec<Arc<str>> {
        let by_name = self.by_name.lock();
        let absent = |topic: &Weak<Topic>| topic.upgrade().filter(|topic| topic.partitions().is_none());
        let mut names: Vec<Arc<str>> = by_name
            .values()
            .filter_map(absent)
            .map(|topic| Arc::clone(&topic.name))
            .collect();
        if names.len() > limit {
            names.sort_unstable();
            let from = self.next.fetch_add(limit, Ordering::Relaxed) % names.len();
            names.rotate_left(from);
            names.truncate(limit);
        }
        names
    }

    /// The server has a topic with so many partitions, or none of that name. Returns whether it came.
    pub(super) fn note(&self, name: &str, partitions: usize) -> bool {
        let Some(topic) = self.by_name.lock().get(name).and_then(Weak::upgrade) else {
            return false;
        };
        let partitions = i32::try_from(partitions).unwrap_or(i32::MAX);
        topic.partitions.swap(partitions, Ordering::AcqRel) == ABSENT && partitions != ABSENT
    }

    /// The server has these topics and no others. Returns whether one came.
    pub(super) fn note_all(&self, listed: &HashMap<&str, usize>) -> bool {
        let names: Vec<Arc<str>> = self.by_name.lock().keys().cloned().collect();
        let mut came = false;
        for name in names {
            came |= self.note(&name, listed.get(&*name).copied().unwrap_or(0));
        }
        came
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_come_and_go() {
        let topics = Topics::default();
        let name: Arc<str> = Arc::from("a");
        let (topic, new) = topics.of(&name, false);
        assert!(new && topic.partitions().is_none());
        assert!(!topics.of(&name, false).1);
        assert_eq!(topics.absent(16), [Arc::clone(&name)]);
        assert!(topics.note("a", 2));
        assert!(!topics.note("a", 3), "it was there already");
        assert_eq!(topic.partitions(), Some(3));
        assert!(topics.absent(16).is_empty());
        assert!(!topics.note_all(&HashMap::new()));
        assert_eq!(topic.partitions(), None);
        assert!(topics.note_all(&HashMap::from([("a", 1)])));
        drop(topic);
        assert!(topics.of(&name, false).1, "it was forgotten with its last publisher");
    }

    #[test]
    fn absent_topics_have_their_turns() {
        let topics = Topics::default();
        let names: Vec<Arc<str>> = (0..40).map(|number| Arc::from(format!("t{number:02}"))).collect();
        let kept: Vec<_> = names.iter().map(|name| topics.of(name, false).0).collect();
        let mut seen: Vec<_> = (0..3).flat_map(|_| topics.absent(16)).collect();
        seen.sort_unstable();
        seen.dedup();
        assert_eq!(seen.len(), kept.len());
    }
}
