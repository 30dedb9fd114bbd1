//! Values of keys in compacted topics: leases, and what is taken away of writers that have gone.
//! Only the last value of a key counts, so one that the server did not take is simply written
//! again.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::{Notify, oneshot};

use super::gate::Gate;
use super::inner::Shared;
use super::producer::Producer;
use super::topics::Topic;
use crate::outbox::Fate;
use crate::pending::Pending;

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

/// Topic and key.
type Key = (Arc<str>, String);

/// What waits to be written, each key once.
#[derive(Default)]
pub(super) struct KeyedWriter {
    waiting: Mutex<Pending<Key, Entry>>,
    /// Values for which there was no room.
    dropped: AtomicU64,
    filled: Notify,
}

impl KeyedWriter {
    /// Writes a value when the server can be reached, in place of an older one of the key that
    /// still waits.
    pub(super) fn put(
        &self,
        topic: &Arc<Topic>,
        partition: Option<i32>,
        key: String,
        value: Option<Bytes>,
    ) {
        let entry = Entry { topic: Arc::clone(topic), partition, value };
        if !self.waiting.lock().put((Arc::clone(&topic.name), key), entry) {
            let dropped = self.dropped.fetch_add(1, Ordering::Relaxed) + 1;
            if dropped.is_power_of_two() {
                tracing::warn!(
                    dropped,
                    "too many lease changes wait for Kafka: the newest are lost"
                );
            }
        }
        self.filled.notify_one();
    }

    /// Something may have become possible.
    pub(super) fn wake(&self) {
        self.filled.notify_one();
    }

    /// Whether everything has been written.
    pub(super) fn is_drained(&self) -> bool {
        self.waiting.lock().is_settled()
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
            let batch = self.take(gate);
            if batch.is_empty() {
                return true;
            }
            let mut answers = Vec::with_capacity(batch.len());
            for (key, entry) in batch {
                let (done, answer) = oneshot::channel();
                producer.send_keyed(
                    &entry.topic,
                    entry.partition,
                    &key.1,
                    entry.value.as_ref(),
                    done,
                );
                answers.push((key, entry, answer));
            }
            let mut refused = Vec::new();
            for (key, entry, answer) in answers {
                if !matches!(answer.await, Ok(Fate::Delivered)) {
                    refused.push((key, entry));
                }
            }
            let all_written = refused.is_empty();
            self.waiting.lock().put_back(refused);
            if !all_written {
                return false;
            }
        }
    }

    /// The oldest whose topics are there.
    fn take(&self, gate: &Gate) -> Vec<(Key, Entry)> {
        let may_go = |entry: &Entry| {
            let topic = &entry.topic;
            gate.is_open() && gate.lets(topic.stays_open) && topic.partitions().is_some()
        };
        self.waiting.lock().take(BATCH, may_go)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kafka::topics::Topics;

    #[test]
    fn a_value_waits_for_its_topic_and_the_server() {
        let (topics, gate, writer) = (Topics::default(), Gate::default(), KeyedWriter::default());
        let topic = topics.of(&Arc::from("t"), false).0;
        writer.put(&topic, None, "a".to_owned(), None);
        gate.set_up(true);
        assert!(writer.take(&gate).is_empty());
        topics.note(&[("t".to_owned(), 1)].into(), false);
        gate.set_up(false);
        assert!(writer.take(&gate).is_empty());
        gate.set_up(true);
        assert_eq!(writer.take(&gate).len(), 1);
        assert!(!writer.is_drained(), "it is on its way");
        assert!(writer.take(&gate).is_empty() && writer.is_drained());
    }
}
