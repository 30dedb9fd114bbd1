//! The engine of pings among the brokers and flows of this node: what it wants published is
//! published, and what it wants requested is requested.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

use blaze_domain::{FlowId, Priority, TopicName};
use blaze_sdk::{
    Advertise, FlowManager, LocalBroker, Message, PublishOptions, Publisher, Request, SdkError,
    SubscribeOptions,
};
use parking_lot::Mutex;
use tokio::sync::Notify;

use crate::limits::PING_QUEUE;
use crate::ping::{Engine, Now, OrderError, Output, PingSample, Settings};
use crate::tasks::Tasks;

/// A ping or an answer is of no use later: it counts as lost then.
const LIFESPAN: Duration = Duration::from_secs(5);
/// Between two tries to subscribe or to lease a topic.
const AGAIN: Duration = Duration::from_secs(1);
/// The name under which monitors publish pings.
const SERVICE: &str = "blaze-monitor";
/// Both clocks are read again if the two readings are further apart.
const ONE_MOMENT: Duration = Duration::from_millis(1);
/// So often at most.
const CLOCK_READINGS: u32 = 10;
/// Between two looks whether a request for pings is done.
const DONE: Duration = Duration::from_millis(20);
/// Media type of pings.
const ENCODING: &str = "application/json";

/// The engine with its clocks. Shared by the task, the callbacks and the admin port.
pub struct Pings {
    engine: Mutex<Engine>,
    started: Instant,
    /// Whether the kernel says that the clock is synchronised.
    synchronized: AtomicBool,
    /// Whether they are sent: there is a broker.
    are_sent: AtomicBool,
    /// Something is due earlier than it was.
    wake: Notify,
}

impl Pings {
    /// The pings of a node.
    #[must_use]
    pub fn new(own: FlowId, period: Duration) -> Self {
        let started = Instant::now();
        let now = Now { monotonic: Duration::ZERO, wall_ns: wall_ns(), synchronized: false };
        let engine = Engine::new(own, Settings { period }, rand::random(), now);
        Self {
            engine: Mutex::new(engine),
            started,
            synchronized: AtomicBool::new(false),
            are_sent: AtomicBool::new(false),
            wake: Notify::new(),
        }
    }

    /// Both clocks, as of one moment: a thread that loses the processor between the two readings
    /// would see a step of the clock.
    #[must_use]
    pub fn now(&self) -> Now {
        let synchronized = self.synchronized.load(Ordering::Relaxed);
        let mut before = self.started.elapsed();
        for _ in 0..CLOCK_READINGS {
            let wall_ns = wall_ns();
            let monotonic = self.started.elapsed();
            if monotonic.saturating_sub(before) <= ONE_MOMENT {
                return Now { monotonic, wall_ns, synchronized };
            }
            before = monotonic;
        }
        Now { monotonic: before, wall_ns: wall_ns(), synchronized }
    }

    /// Whether pings are sent at all: only where the monitor is on a broker.
    #[must_use]
    pub fn are_sent(&self) -> bool {
        self.are_sent.load(Ordering::Relaxed)
    }

    /// What the kernel says of the clock.
    pub fn set_synchronized(&self, is_synchronized: bool) {
        self.synchronized.store(is_synchronized, Ordering::Relaxed);
    }

    /// Works with the engine, which is polled afterwards.
    pub fn with<T>(&self, work: impl FnOnce(&mut Engine, Now) -> T) -> T {
        let out = {
            let mut engine = self.engine.lock();
            work(&mut engine, self.now())
        };
        self.wake.notify_one();
        out
    }

    /// Looks at the engine.
    pub fn read<T>(&self, look: impl FnOnce(&Engine, Now) -> T) -> T {
        look(&self.engine.lock(), self.now())
    }

    /// Pings a node now, and waits for the results.
    ///
    /// # Errors
    /// An unknown node, another request under way, or a count or interval out of range.
    pub async fn order(
        &self,
        to: FlowId,
        count: u32,
        interval: Duration,
    ) -> Result<Vec<PingSample>, OrderError> {
        let id = self.with(|engine, now| engine.order(now, to, count, interval))?;
        // Also when whoever asked is gone.
        let cancel = Cancel(|| self.with(|engine, _| engine.cancel_order(id)));
        let samples = loop {
            if let Some(samples) = self.engine.lock().take_samples(id) {
                break samples;
            }
            tokio::time::sleep(DONE).await;
        };
        drop(cancel);
        Ok(samples)
    }

    fn poll(&self) -> (Vec<Output>, crate::ping::TopicChanges, Duration) {
        let mut engine = self.engine.lock();
        let outputs = engine.poll(self.now());
        let changes = engine.take_topics();
        let now = self.now();
        let wait = engine.next_deadline(now).saturating_sub(now.monotonic);
        (outputs, changes, wait)
    }
}

struct Cancel<F: FnMut()>(F);

impl<F: FnMut()> Drop for Cancel<F> {
    fn drop(&mut self) {
        (self.0)();
    }
}

/// Pings through a broker, for ever.
pub async fn run(pings: Arc<Pings>, broker: LocalBroker, flow: FlowManager) {
    pings.are_sent.store(true, Ordering::Relaxed);
    let mut requested = Tasks::default();
    let mut advertised = Tasks::default();
    let mut publishers: BTreeMap<TopicName, Publisher> = BTreeMap::new();
    loop {
        let (outputs, changes, wait) = pings.poll();
        changes.release.iter().for_each(|topic| requested.end(topic));
        for topic in &changes.withdraw {
            advertised.end(topic);
            publishers.remove(topic);
        }
        for topic in changes.request {
            let task = request(Arc::clone(&pings), broker.clone(), flow.clone(), topic.clone());
            requested.start(topic, task);
        }
        for topic in changes.advertise {
            advertised.start(topic.clone(), advertise(flow.clone(), topic));
        }
        for output in outputs {
            publish(&mut publishers, &broker, &output);
        }
        tokio::select! {
            () = tokio::time::sleep(wait) => {}
            () = pings.wake.notified() => {}
            () = requested.ended() => {}
            () = advertised.ended() => {}
        }
    }
}

/// Publishes, with the publisher of the topic; one that could not be made is tried again the next
/// time.
fn publish(publishers: &mut BTreeMap<TopicName, Publisher>, broker: &LocalBroker, output: &Output) {
    let topic = output.topic();
    let made = match publishers.remove(&topic) {
        Some(publisher) => Ok(publisher),
        None => publisher(broker, &topic),
    };
    match made {
        Ok(publisher) => {
            publisher.publish(output.payload());
            publishers.insert(topic, publisher);
        }
        Err(error) => tracing::debug!(%error, %topic, "pings cannot be published"),
    }
}

fn publisher(broker: &LocalBroker, topic: &TopicName) -> Result<Publisher, SdkError> {
    let options = PublishOptions {
        encoding: ENCODING.to_owned(),
        lifespan: LIFESPAN,
        priority: Some(Priority::State),
        ..PublishOptions::default()
    };
    broker.publisher(topic, &options)
}

/// Holds an advertisement until it is aborted.
async fn advertise(flow: FlowManager, topic: TopicName) {
    let advertise = Advertise {
        encoding: ENCODING.to_owned(),
        lifespan: LIFESPAN,
        priority: Some(Priority::State),
        ..Advertise::new(topic)
    };
    let _lease = until_held(|| flow.advertise(advertise.clone())).await;
    std::future::pending::<()>().await;
}

/// Subscribes and requests a topic until it is aborted.
async fn request(pings: Arc<Pings>, broker: LocalBroker, flow: FlowManager, topic: TopicName) {
    let options = SubscribeOptions {
        lifespan: LIFESPAN,
        max_messages: PING_QUEUE,
        ..SubscribeOptions::default()
    };
    let _subscription = loop {
        let pings = Arc::clone(&pings);
        let is_ping = topic.as_str().starts_with("blaze/ping/");
        let take = move |message: Message| take(&pings, is_ping, &message);
        match broker.subscribe(&topic, options, take).await {
            Ok(subscription) => break subscription,
            Err(error) => {
                tracing::debug!(%error, %topic, "not subscribed yet");
                tokio::time::sleep(AGAIN).await;
            }
        }
    };
    let request = Request {
        lifespan: LIFESPAN,
        priority: Some(Priority::State),
        ..Request::new(topic.clone())
    };
    let _lease = until_held(|| flow.request(request.clone())).await;
    std::future::pending::<()>().await;
}

/// Tries again until a flow agrees. A monitor without a flow pings those on its broker.
pub(crate) async fn until_held<F>(ask: impl Fn() -> F) -> blaze_sdk::Lease
where
    F: Future<Output = Result<blaze_sdk::Lease, blaze_sdk::FlowError>>,
{
    loop {
        match ask().await {
            Ok(lease) => return lease,
            Err(error) => {
                tracing::debug!(%error, "a topic of pings is not leased yet");
                tokio::time::sleep(AGAIN).await;
            }
        }
    }
}

/// Hands a message to the engine, with the node that published it by its header. One without a
/// header, or of another service, is nobody's ping.
fn take(pings: &Pings, is_ping: bool, message: &Message) {
    let origin = message.origin();
    if origin.service != SERVICE {
        return;
    }
    let (Ok(layer), Ok(node)) = (origin.layer.parse(), origin.node.parse()) else {
        return;
    };
    let from = FlowId::new(layer, node);
    pings.with(|engine, now| match is_ping {
        true => engine.ping_received(now, &from, message.payload()),
        false => engine.pong_received(now, &from, message.payload()),
    });
}

/// Nanoseconds since 1970.
fn wall_ns() -> i64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}
