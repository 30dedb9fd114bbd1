//! The thread that reads: what it has polled goes to the readers of the topic.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use rdkafka::error::{KafkaError, KafkaResult, RDKafkaErrorCode};
use rdkafka::message::{BorrowedMessage, Message as _};
use tokio_util::sync::CancellationToken;

use super::topic::Reader;
use super::{Client, Consumer, POLL, State, forget};
use crate::kafka::receive::receive;

impl Consumer {
    /// Hands records out until it is to stop.
    pub(super) fn run(&self, stop: &CancellationToken) {
        while !stop.is_cancelled() {
            let Some(client) = self.client.lock().clone() else {
                break;
            };
            let next = client.poll(POLL);
            self.hand_out(next);
        }
        self.close();
        let client = self.client.lock().take();
        drop(client);
    }

    /// Hands out what was polled, be it of a client that was replaced meanwhile.
    pub(super) fn hand_out(&self, next: Option<KafkaResult<BorrowedMessage<'_>>>) {
        let Some((mut state, client)) = self.reading() else {
            return;
        };
        let client = &*client;
        let reset = self.follow_identities(&mut state, client);
        let moved = std::mem::take(&mut state.moved);
        match next {
            None => {}
            // It was read at a position of the topic that was before, and comes again.
            Some(Ok(message)) if reset.iter().any(|topic| &**topic == message.topic()) => {}
            // It was polled before its topic was moved, or after that: nobody can tell. So it is read again in any case.
            Some(Ok(message)) if moved.contains(message.topic()) => {
                if let Some(topic) = state.topics.get_mut(message.topic()).filter(|topic| topic.assigned) {
                    topic.reassign(client);
                }
            }
            Some(Ok(message)) => self.deliver(&mut state, client, &message),
            Some(Err(error)) => self.note_error(&error),
        }
    }

    fn note_error(&self, error: &KafkaError) {
        if matches!(
            error.rdkafka_error_code(),
            Some(RDKafkaErrorCode::AutoOffsetReset | RDKafkaErrorCode::OffsetOutOfRange)
        ) {
            self.lost_position.store(true, Ordering::Release);
        }
        self.last_error.note(error.to_string());
        tracing::debug!(%error, "reading");
    }

    /// Topics that were made anew are read from their beginning. Returns which.
    fn follow_identities(&self, state: &mut State, client: &Client) -> Vec<Arc<str>> {
        let changes = self.identities.changes();
        if changes == state.identities_seen {
            return Vec::new();
        }
        state.identities_seen = changes;
        let mut reset = Vec::new();
        for topic in state.topics.values_mut() {
            let Some(uuid) = self.identities.of(&topic.source.topic) else {
                continue;
            };
            match &topic.uuid {
                Some(before) if *before == uuid => {}
                None => topic.identify(Some(uuid), &self.layer),
                Some(before) => {
                    tracing::info!(topic = %topic.source.topic, ?before, now = ?uuid, "the topic was made anew");
                    topic.made_anew(uuid, &self.layer);
                    if topic.assigned {
                        topic.reassign(client);
                    }
                    reset.push(Arc::clone(&topic.source.topic));
                }
            }
        }
        reset
    }

    fn deliver(&self, state: &mut State, client: &Client, message: &BorrowedMessage<'_>) {
        let Some(topic) = state.topics.get_mut(message.topic()) else {
            return;
        };
        let Ok(number) = usize::try_from(message.partition()) else {
            return;
        };
        let Some(partition) = topic.partitions.get_mut(number) else {
            return;
        };
        let offset = message.offset();
        if offset < partition.next {
            return;
        }
        partition.next = offset + 1;
        let identity = partition.bare_writer.zip(u64::try_from(offset + 1).ok());
        // A tombstone takes away; there is nothing to deliver.
        let Some(payload) = message.payload() else { return };
        let wanted = |reader: &Reader| reader.starts.get(number).is_none_or(|start| offset >= *start);
        if topic.readers.iter().any(wanted) {
            let received = receive(&topic.source.channel, message, payload, identity, &self.clock);
            topic
                .readers
                .retain(|reader| !wanted(reader) || reader.sender.send(received.clone()));
        }
        if topic.readers.is_empty() {
            let name = Arc::clone(&topic.source.topic);
            forget(state, client, &name);
        }
    }
}
