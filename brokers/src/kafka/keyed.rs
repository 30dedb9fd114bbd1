//! Values of keys in compacted topics: leases, and what is taken away of writers that have gone. Only the last value of a
//! key counts, so one that the server did not take is simply written again.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::{Notify, oneshot};

use super::gate::Gate;
use super::inner::Shared;
use super::producer::Producer;
use super::topics::Topic;
use crate::outbox::Fate;

/// Values that wait at most; those beyond are dropped and counted.
const MAX_WAITING: usize = 131_072;
/// Values that are on their way at once.
const BATCH: usize = 256;
/// How long to wait before what could not be written is tried again.
const AGAIN: Duration = Duration::from_millis(200);

/// One value that is to be written; `None` takes the key away.
#[derive(Debug, Clone)]
struct Entry {
    topic: Arc<Topic>,
    partition: Option<i32>,
    value: Option<Bytes>,
}

type Key = (Arc<str>, String);

#[derive(Default)]
struct Waiting {
    entries: HashMap<Key, Entry>,
    order: VecDeque<Key>,
    in_flight: usize,
    dropped: u64,
}

/// What waits to be written, each key once.
#[derive(Default)]
pub(super) struct KeyedWriter {
    waiting: Mutex<Waiting>,
    filled: Notify,
}

impl KeyedWriter {
    /// Writes a value when the server can be reached; an older one of the key that still waits is forgotten.
    pub(super) fn put(&self, topic: &Arc<Topic>, partition: Option<i32>, key: String, value: Option<Bytes>) {
        let entry = Entry {
            topic: Arc::clone(topic),
            partition,
            value,
        };
        self.waiting.lock().put((Arc::clone(&topic.name), key), entry, true);
        self.filled.notify_one();
    }

    /// Something may have become possible.
    pub(super) fn wake(&self) {
        self.filled.notify_one();
    }

    /// Whether everything has been written.
    pub(super) fn is_drained(&self) -> bool {
        let waiting = self.waiting.lock();
        waiting.order.is_empty() && waiting.in_flight == 0
    }

    /// Writes what waits until the end.
    pub(super) async fn run(&self, producer: &Producer, shared: &Shared) {
        let stop = &shared.stop;
        loop {
            let all_written = tokio::select! {
                () = stop.cancelled() => return,
                all_written = self.write_some(producer, &shared.gate) => all_written,
            };
            let waits = !self.is_drained();
            tokio::select! {
                () = stop.cancelled() => return,
                () = self.filled.notified(), if all_written => {}
                () = tokio::time::sleep(AGAIN), if waits || !all_written => {}
            }
        }
    }

    /// Writes as long as it can; returns whether nothing was refused.
    async fn write_some(&self, producer: &Producer, gate: &Gate) -> bool {
        loop {
            let batch = self.waiting.lock().take(gate);
            if batch.is_empty() {
                return true;
            }
            let mut answers = Vec::with_capacity(batch.len());
            for (key, entry) in batch {
                let (done, answer) = oneshot::channel();
                producer.send_keyed(&entry.topic, entry.partition, &key.1, entry.value.as_ref(), done);
                answers.push((key, entry, answer));
            }
            let mut refused = Vec::new();
            for (key, entry, answer) in answers {
                if !matches!(answer.await, Ok(Fate::Delivered)) {
                    refused.push((key, entry));
                }
            }
            let all_written = refused.is_empty();
            let mut waiting = self.waiting.lock();
            waiting.in_flight = 0;
            for (key, entry) in refused {
                waiting.put(key, entry, false);
            }
            if !all_written {
                return false;
            }
        }
    }
}

impl Waiting {
    fn put(&mut self, key: Key, entry: Entry, newer: bool) {
        if let Some(before) = self.entries.get_mut(&key) {
            if newer {
                *before = entry;
            }
            return;
        }
        if self.entries.len() >= MAX_WAITING {
            self.dropped += 1;
            if self.dropped.is_power_of_two() {
                tracing::warn!(dropped = self.dropped, "too many leases wait for Kafka");
            }
            return;
        }
        self.order.push_back(key.clone());
        self.entries.insert(key, entry);
    }

    /// The oldest whose topics are there.
    fn take(&mut self, gate: &Gate) -> Vec<(Key, Entry)> {
        let mut taken = Vec::new();
        let mut later = VecDeque::new();
        while taken.len() < BATCH
            && let Some(key) = self.order.pop_front()
        {
            let Some(entry) = self.entries.get(&key) else { continue };
            if gate.is_open() && gate.lets(entry.topic.stays_open) && entry.topic.partitions().is_some() {
                taken.extend(self.entries.remove_entry(&key));
            } else {
                later.push_back(key);
            }
        }
        later.append(&mut self.order);
        self.order = later;
        self.in_flight = taken.len();
        taken
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kafka::topics::Topics;

    #[test]
    fn the_last_value_of_a_key_counts_and_waits_for_its_topic() {
        let (topics, gate, writer) = (Topics::default(), Gate::default(), KeyedWriter::default());
        gate.set_up(true);
        let (here, _) = topics.of(&Arc::from("here"), false);
        let (absent, _) = topics.of(&Arc::from("absent"), false);
        let note = |name: &str| topics.note(&HashMap::from([(name.to_owned(), 1)]), false);
        note("here");
        for (topic, key, value) in [
            (&absent, "x", Some("0")),
            (&here, "a", Some("1")),
            (&here, "b", Some("2")),
            (&here, "a", None),
        ] {
            writer.put(topic, None, key.to_owned(), value.map(Bytes::from));
        }
        let shown = |batch: Vec<(Key, Entry)>| {
            let show = |(key, entry): (Key, Entry)| (key.1, entry.value.map(|value| value.to_vec()));
            batch.into_iter().map(show).collect::<Vec<_>>()
        };
        let batch = writer.waiting.lock().take(&gate);
        assert!(!writer.is_drained());
        assert_eq!(
            shown(batch.clone()),
            [("a".to_owned(), None), ("b".to_owned(), Some(b"2".to_vec()))]
        );
        // What was refused does not replace what is newer.
        writer.put(&here, None, "b".to_owned(), Some(Bytes::from("3")));
        for (key, entry) in batch {
            writer.waiting.lock().put(key, entry, false);
        }
        note("absent");
        let batch = shown(writer.waiting.lock().take(&gate));
        assert_eq!(
            batch,
            [
                ("x".to_owned(), Some(b"0".to_vec())),
                ("b".to_owned(), Some(b"3".to_vec())),
                ("a".to_owned(), None)
            ]
        );
        gate.set_up(false);
        writer.put(&here, None, "c".to_owned(), None);
        assert!(writer.waiting.lock().take(&gate).is_empty());
    }
}
