//! Subscriptions: from the broker's ring, through [`intake`] (repeats, lifespan, rate), into the
//! bounded queue of [`dispatch`], to the callback on a thread of the pool.

mod dispatch;
mod intake;
mod stats;

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use blaze_brokers::Received;
use blaze_domain::{Scope, TopicName};
use blaze_runtime::TaskPolicy;
use tokio_util::sync::CancellationToken;

pub(crate) use dispatch::Callback;
use dispatch::{Dispatch, Limits};
use intake::{Arrival, Intake};
use stats::Counters;
pub use stats::SubscriptionStats;

use crate::monitor::{Counted, Counting};
use crate::pool::PoolHandle;
use crate::service::Shared;
use crate::{Message, SdkError};

/// Messages taken from the broker at a time.
const BATCH: usize = 256;

/// What a subscription wants.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SubscribeOptions {
    /// Messages per second at most, of all writers together; the others are left out evenly.
    pub max_rate_hz: Option<f64>,
    /// Leaves out messages older than this; zero = none. That of their publisher holds as well.
    pub lifespan: Duration,
    /// Callbacks for one writer at a time, 1 or more; above 1 the order is lost.
    pub concurrency: usize,
    /// Messages that wait for the callback at most; the oldest give way.
    pub max_messages: usize,
    /// Bytes that wait for the callback at most; the oldest give way, but one message always fits.
    pub max_bytes: usize,
    /// Begin with what is kept for late joiners (transient_local).
    pub with_kept: bool,
    /// Messages may be large (above some 64 KB): a connection of their own, where that matters.
    pub large: bool,
}

impl Default for SubscribeOptions {
    fn default() -> Self {
        Self {
            max_rate_hz: None,
            lifespan: Duration::ZERO,
            concurrency: 1,
            max_messages: 1_024,
            max_bytes: 64 * 1024 * 1024,
            with_kept: false,
            large: false,
        }
    }
}

impl SubscribeOptions {
    pub(crate) fn check(&self) -> Result<(), SdkError> {
        let refuse =
            |option, reason: &str| Err(SdkError::Option { option, reason: reason.to_owned() });
        if self.max_rate_hz.is_some_and(|rate| !rate.is_finite() || rate <= 0.0) {
            return refuse("max_rate_hz", "must be above 0");
        }
        if self.concurrency == 0 {
            return refuse("concurrency", "must be 1 or more");
        }
        if self.max_messages == 0 {
            return refuse("max_messages", "must be 1 or more");
        }
        Ok(())
    }

    /// The ring of the port takes what comes between two turns of the reading task; it may be as
    /// large as the queue.
    pub(crate) fn of_the_port(&self) -> blaze_brokers::SubscribeOptions {
        blaze_brokers::SubscribeOptions {
            max_messages: self.max_messages.max(BATCH),
            max_bytes: self.max_bytes,
            large: self.large,
            with_kept: self.with_kept,
        }
    }
}

/// A subscription that lives. Dropping it ends it: no callback begins afterwards, one that runs
/// goes on to its end.
#[must_use = "dropping a subscription ends it"]
pub struct Subscription {
    topic: TopicName,
    dispatch: Arc<Dispatch>,
    counters: Arc<Counters>,
    ended: CancellationToken,
    _counting: Counting,
}

impl Subscription {
    /// The topic.
    #[must_use]
    pub fn topic(&self) -> &TopicName {
        &self.topic
    }

    /// What it counted so far.
    #[must_use]
    pub fn stats(&self) -> SubscriptionStats {
        self.counters.read()
    }

    /// Ends it and waits until its callback runs no more. Do not wait for it inside that callback.
    pub async fn close(self) {
        self.end();
        self.dispatch.idle().await;
    }

    fn end(&self) {
        self.ended.cancel();
        self.dispatch.close();
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        self.end();
    }
}

impl fmt::Debug for Subscription {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Subscription")
            .field("topic", &self.topic)
            .field("stats", &self.stats())
            .finish_non_exhaustive()
    }
}

/// Begins to read what the broker delivers.
pub(crate) fn start(
    service: &Shared,
    topic: &TopicName,
    options: SubscribeOptions,
    source: blaze_brokers::Subscription,
    callback: Callback,
) -> Subscription {
    let counters = Arc::new(Counters::default());
    let limits = Limits {
        max_messages: options.max_messages,
        max_bytes: options.max_bytes,
        per_writer: options.concurrency,
        at_once: service.pool_threads.saturating_sub(1).max(1),
        lifespan: options.lifespan,
    };
    let dispatch = Arc::new(Dispatch::new(topic, callback, limits, Arc::clone(&counters)));
    let ended = CancellationToken::new();
    let reading = Reading {
        topic: topic.clone(),
        scope: service.scope,
        intake: Intake::new(options.max_rate_hz, options.lifespan),
        dispatch: Arc::clone(&dispatch),
        counters: Arc::clone(&counters),
        pool: service.pool.handle(),
    };
    let (stop, end) = (service.supervisor.shutdown_token(), ended.clone());
    let name = format!("subscription {topic}");
    service.supervisor.spawn(name, TaskPolicy::MayEnd, async move {
        tokio::select! {
            () = stop.cancelled() => {}
            () = end.cancelled() => {}
            () = reading.run(source) => {}
        }
    });
    let source = Arc::clone(&dispatch) as Arc<dyn Counted>;
    let counting = service.monitor.topics().count(topic, source);
    Subscription { topic: topic.clone(), dispatch, counters, ended, _counting: counting }
}

/// Takes messages from the broker until it closes.
struct Reading {
    topic: TopicName,
    scope: Scope,
    intake: Intake,
    dispatch: Arc<Dispatch>,
    counters: Arc<Counters>,
    pool: PoolHandle,
}

impl Reading {
    async fn run(mut self, mut source: blaze_brokers::Subscription) {
        let mut batch = Vec::with_capacity(BATCH);
        while source.receive(&mut batch, BATCH).await > 0 {
            self.counters.queue_dropped.add(source.take_dropped());
            for received in batch.drain(..) {
                self.take(received);
            }
        }
    }

    fn take(&mut self, received: Received) {
        self.counters.received.add(1);
        let Some(message) = Message::new(&self.topic, self.scope, received) else {
            self.counters.malformed.add(1);
            return;
        };
        let now = Instant::now();
        let arrival = Arrival {
            identity: message.identity(),
            gaps_are_loss: message.frame().is_some(),
            age: message.age_at(now, SystemTime::now()),
            lifespan: message.lifespan(),
        };
        if self.intake.accept(&arrival, now, &self.counters) {
            self.dispatch.offer(message, &self.pool);
        }
    }
}
