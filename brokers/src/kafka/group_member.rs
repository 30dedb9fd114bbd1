//! What a member of a consumer group knows of its place in it.

use std::sync::Arc;

use parking_lot::Mutex;
use rdkafka::ClientContext;
use rdkafka::config::RDKafkaLogLevel;
use rdkafka::consumer::{BaseConsumer, Consumer as _, ConsumerContext, Rebalance};
use rdkafka::error::KafkaError;
use rdkafka::topic_partition_list::TopicPartitionList;

use super::context::{self, LastError};

/// A time without interruption in which the member has the partition; each has another number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Seat(u64);

#[derive(Default)]
struct State {
    seats: u64,
    has: bool,
}

/// The callbacks of one member of a group that shares out the first partition of a topic.
pub(super) struct GroupContext {
    topic: Arc<str>,
    last_error: Arc<LastError>,
    state: Mutex<State>,
}

impl GroupContext {
    pub(super) fn new(topic: &Arc<str>, last_error: &Arc<LastError>) -> Self {
        Self {
            topic: Arc::clone(topic),
            last_error: Arc::clone(last_error),
            state: Mutex::default(),
        }
    }

    /// The seat, if the member has the partition as far as it has heard.
    pub(super) fn seat(&self) -> Option<Seat> {
        let state = self.state.lock();
        state.has.then_some(Seat(state.seats))
    }

    fn is_it(&self, list: &TopicPartitionList) -> bool {
        list.find_partition(&self.topic, 0).is_some()
    }
}

impl ClientContext for GroupContext {
    fn log(&self, level: RDKafkaLogLevel, facility: &str, line: &str) {
        context::log(level, facility, line);
    }

    fn error(&self, error: KafkaError, reason: &str) {
        self.last_error.note(format!("{error}: {reason}"));
    }
}

impl ConsumerContext for GroupContext {
    fn pre_rebalance(&self, _: &BaseConsumer<Self>, rebalance: &Rebalance<'_>) {
        let mut state = self.state.lock();
        match rebalance {
            Rebalance::Revoke(list) if self.is_it(list) => state.has = false,
            Rebalance::Error(_) => state.has = false,
            Rebalance::Revoke(_) | Rebalance::Assign(_) => {}
        }
    }

    fn post_rebalance(&self, member: &BaseConsumer<Self>, rebalance: &Rebalance<'_>) {
        let Rebalance::Assign(list) = rebalance else { return };
        if !self.is_it(list) {
            return;
        }
        // There is nothing to read.
        if let Err(error) = member.pause(list) {
            tracing::debug!(%error, topic = %self.topic, "the partition of the lease is read in vain");
        }
        let mut state = self.state.lock();
        state.seats += 1;
        state.has = true;
    }
}
