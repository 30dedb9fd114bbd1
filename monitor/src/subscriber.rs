//! Topics with `observe: subscribe`: they are requested like by any service, and each message is
//! measured when it comes.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use blaze_domain::node_file::{LatencyRule, Observe, Stamp};
use blaze_domain::{FlowId, TopicName};
use blaze_sdk::{FlowManager, LocalBroker, Message, Request, SubscribeOptions};
use parking_lot::Mutex;

use crate::latency::{Latency, Message as Measured, Offset, header_stamp_cdr, header_stamp_json};
use crate::limits::{LATENCY_QUEUE, MAX_LATENCY_TOPICS};
use crate::pings::{Pings, until_held};
use crate::tasks::Tasks;

/// Between two tries to subscribe.
const AGAIN: Duration = Duration::from_secs(1);

/// What a message is measured with.
#[derive(Clone)]
pub struct Meter {
    /// This node.
    pub own: FlowId,
    /// Where measurements go.
    pub latency: Arc<Mutex<Latency>>,
    /// Offsets of the clocks.
    pub pings: Arc<Pings>,
}

/// The topics that are subscribed now. Dropping it ends them.
#[derive(Default)]
pub struct Subscribed {
    rules: BTreeMap<TopicName, LatencyRule>,
    tasks: Tasks,
}

impl Subscribed {
    /// Subscribes to the topics whose rule says so, of those that are known, and of those that a
    /// rule names without a wildcard; ends the others.
    pub fn follow(
        &mut self,
        rules: &[LatencyRule],
        known: impl IntoIterator<Item = TopicName>,
        (broker, flow): (&LocalBroker, &FlowManager),
        meter: &Meter,
    ) {
        let named = rules.iter().filter_map(|rule| rule.pattern.to_string().parse().ok());
        let mut wanted = BTreeMap::new();
        for topic in named.chain(known) {
            let rule = rules.iter().find(|rule| rule.pattern.matches(&topic));
            if let Some(rule) = rule.filter(|rule| rule.observe == Observe::Subscribe)
                && wanted.len() < MAX_LATENCY_TOPICS
            {
                wanted.insert(topic, rule.clone());
            }
        }
        self.rules.retain(|topic, rule| {
            let stays = wanted.get(topic) == Some(rule);
            if !stays {
                self.tasks.end(topic);
            }
            stays
        });
        for (topic, rule) in wanted {
            if self.rules.insert(topic.clone(), rule.clone()).is_none() {
                let task =
                    subscribe(topic.clone(), rule, broker.clone(), flow.clone(), meter.clone());
                self.tasks.start(topic, task);
            }
        }
    }

    /// Waits for a task that ended, which none does by itself.
    pub async fn ended(&mut self) {
        self.tasks.ended().await;
    }
}

async fn subscribe(
    topic: TopicName,
    rule: LatencyRule,
    broker: LocalBroker,
    flow: FlowManager,
    meter: Meter,
) {
    let options = SubscribeOptions {
        max_rate_hz: rule.max_rate_hz,
        max_messages: LATENCY_QUEUE,
        ..SubscribeOptions::default()
    };
    let _subscription = loop {
        let meter = meter.clone();
        let stamp = rule.stamp;
        match broker.subscribe(&topic, options, move |message| meter.take(&message, stamp)).await {
            Ok(subscription) => break subscription,
            Err(error) => {
                tracing::debug!(%error, %topic, "not subscribed yet");
                tokio::time::sleep(AGAIN).await;
            }
        }
    };
    let request = Request { max_rate_hz: rule.max_rate_hz, ..Request::new(topic) };
    let _lease = until_held(|| flow.request(request.clone())).await;
    std::future::pending::<()>().await;
}

impl Meter {
    fn take(&self, message: &Message, stamp: Stamp) {
        let received_ns = nanos(SystemTime::now());
        let origin = message.origin();
        let from = match (origin.layer.parse(), origin.node.parse()) {
            (Ok(layer), Ok(node)) => FlowId::new(layer, node),
            // Without a header it is of any host on the broker, whose clock is not known.
            _ => return,
        };
        let (Some(writer), Some(sequence)) = (message.writer(), message.sequence()) else {
            return;
        };
        let offset = match from == self.own {
            true => Some(Offset { offset_s: 0.0, error_s: 0.0 }),
            false => self.pings.read(|engine, now| {
                let offset = engine.offset(&from, now)?;
                Some(Offset { offset_s: offset.offset_s, error_s: offset.error_s })
            }),
        };
        let published_ns = message.publish_time().map(nanos);
        let is_aged = message.hops() > 0 || from == self.own;
        let age_ns = is_aged.then(|| u64::try_from(message.age().as_nanos()).unwrap_or(u64::MAX));
        let measured = Measured {
            topic: message.topic(),
            from: &from,
            writer,
            sequence,
            stamp_ns: match stamp {
                Stamp::Publish => published_ns,
                Stamp::Header => header_stamp(message),
            },
            published_ns,
            received_ns,
            age_ns,
            offset,
        };
        let outcome = self.latency.lock().message(Instant::now(), &measured);
        if outcome.drop_offset {
            tracing::debug!(%from, "a message came before it was sent: the offset is measured anew");
            self.pings.with(|engine, now| engine.drop_offset(now, &from));
        }
    }
}

fn header_stamp(message: &Message) -> Option<i64> {
    match message.encoding().contains("json") {
        true => header_stamp_json(message.payload()),
        false => header_stamp_cdr(message.payload()),
    }
}

fn nanos(at: SystemTime) -> i64 {
    let since = at.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}
