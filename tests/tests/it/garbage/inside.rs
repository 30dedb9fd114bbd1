//! A flow inside the test, with brokers of which the test holds every end, and traffic that must not suffer.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use async_trait::async_trait;
use blaze_brokers::memory::{MemoryBroker, MemoryHub};
use blaze_brokers::{
    Broker, BrokerError, BrokerKind, BrokerStatus, Content, Publisher, PublisherOptions, Received, SubscribeOptions,
    Subscription, SubscriptionSender,
};
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::FlowSection;
use blaze_domain::{FlowId, LayerKind, Origin, Scope, WriterId};
use blaze_flow::flow::settings::{FlowSettings, LiveSettings};
use blaze_flow::flow::{FlowOptions, LayerBroker, RunningFlow};
use blaze_flow::world::LayerScopeId;
use blaze_proto::{Frame, Header};
use blaze_runtime::Supervisor;
use blaze_sdk::{
    Advertise, Lease, PublishOptions, Request, ServiceManager, ServiceOptions, SubscribeOptions as Listen,
};
use blaze_tests::admin::Admin;
use blaze_tests::wait;
use bytes::Bytes;
use tokio::sync::watch;

pub(crate) const DEADLINE: Duration = Duration::from_secs(20);
/// The topic of the traffic that must not suffer.
pub(crate) const LIVE_TOPIC: &str = "imu/data";

/// A memory broker whose subscriptions can also be given what no memory publisher would take, as a server in another
/// process could send it.
pub(crate) struct OpenBroker {
    inner: MemoryBroker,
    ends: parking::Ends,
}

/// The sending ends of the subscriptions, by channel.
mod parking {
    use std::sync::Mutex;

    use super::{ChannelName, SubscriptionSender};

    #[derive(Default)]
    pub(super) struct Ends(Mutex<Vec<(ChannelName, SubscriptionSender)>>);

    impl Ends {
        pub(super) fn keep(&self, channel: &ChannelName, end: SubscriptionSender) {
            self.0.lock().unwrap().push((channel.clone(), end));
        }

        pub(super) fn of(&self, channel: &ChannelName) -> Vec<SubscriptionSender> {
            let ends = self.0.lock().unwrap();
            ends.iter()
                .filter(|(of, _)| of == channel)
                .map(|(_, end)| end.clone())
                .collect()
        }
    }
}

impl OpenBroker {
    pub(crate) fn new(hub: &MemoryHub) -> Arc<Self> {
        Arc::new(Self {
            inner: hub.broker(),
            ends: parking::Ends::default(),
        })
    }

    /// Hands bytes to whoever reads the channel, as an adapter that found them on its server. Returns how many read.
    pub(crate) fn inject(&self, channel: &str, bytes: &Bytes) -> usize {
        let ends = self.ends.of(&channel.parse().unwrap());
        let message = Received::live(Content::from_bytes(bytes.clone()), std::time::Instant::now());
        ends.iter().filter(|end| end.send(message.clone())).count()
    }
}

#[async_trait]
impl Broker for OpenBroker {
    fn kind(&self) -> BrokerKind {
        self.inner.kind()
    }

    fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.inner.status()
    }

    fn publisher(&self, channel: &ChannelName, options: PublisherOptions) -> Result<Arc<dyn Publisher>, BrokerError> {
        self.inner.publisher(channel, options)
    }

    #[allow(clippy::disallowed_methods, reason = "a pump of the test, not of the product")]
    async fn subscribe(&self, channel: &ChannelName, options: SubscribeOptions) -> Result<Subscription, BrokerError> {
        let mut source = self.inner.subscribe(channel, options).await?;
        let (end, subscription) = blaze_brokers::subscription(options);
        self.ends.keep(channel, end.clone());
        tokio::spawn(async move {
            let mut batch = Vec::new();
            while source.receive(&mut batch, 64).await > 0 {
                if !batch.drain(..).all(|message| end.send(message)) {
                    return;
                }
            }
            end.close();
        });
        Ok(subscription)
    }

    async fn close(&self) {
        self.inner.close().await;
    }
}

/// One flow `edge/robot-1` between a node hub and a layer hub.
pub(crate) struct Inside {
    pub(crate) node: MemoryHub,
    pub(crate) layer: MemoryHub,
    pub(crate) node_broker: Arc<OpenBroker>,
    pub(crate) flow: RunningFlow,
    pub(crate) admin: Admin,
    pub(crate) supervisor: Supervisor,
}

impl Inside {
    pub(crate) async fn start() -> Self {
        let supervisor = Supervisor::new("garbage");
        let (node, layer) = (MemoryHub::new("node"), MemoryHub::new("layer"));
        let node_broker = OpenBroker::new(&node);
        let live = LiveSettings::from(&FlowSection::default());
        let options = FlowOptions {
            settings: FlowSettings {
                gateway: blaze_domain::node_file::AutoBool::Auto,
                me: FlowId::new("edge".parse().unwrap(), "robot-1".parse().unwrap()),
                kind: LayerKind::Edge,
                admin: "127.0.0.1:0".parse().unwrap(),
                inter: None,
                live,
            },
            node: Some(Arc::clone(&node_broker) as Arc<dyn Broker>),
            layer: Some(LayerBroker {
                broker: Arc::new(layer.broker()),
                id: LayerScopeId::private(),
            }),
            state_dir: None,
        };
        let flow = blaze_flow::flow::start(options, supervisor.clone()).await.unwrap();
        flow.ready().await;
        let admin = Admin {
            address: flow.admin(),
            namespace: None,
        };
        Self {
            node,
            layer,
            node_broker,
            flow,
            admin,
            supervisor,
        }
    }

    /// A metric of this flow; 0 where there is no such line. Never call it on the thread of a single-threaded runtime.
    pub(crate) fn metric(&self, name: &str, labels: &[&str]) -> u64 {
        self.admin.metric(name, labels).unwrap_or(0.0) as u64
    }

    /// Messages dropped on a topic for a reason, before they reached a bridge.
    pub(crate) fn dropped(&self, topic: &str, reason: &str) -> u64 {
        let (topic, reason) = (format!("topic=\"{topic}\""), format!("reason=\"{reason}\""));
        self.metric("blaze_flow_dropped_total", &[&topic, "to=\"\"", &reason])
    }

    /// Publishes bytes as they are on the node hub, as a service without SDK.
    pub(crate) fn publish(&self, channel: &str, bytes: impl Into<Bytes>) -> blaze_brokers::PublishOutcome {
        let broker = self.node.broker();
        let publisher = broker
            .publisher(&channel.parse().unwrap(), PublisherOptions::default())
            .unwrap();
        publisher.publish_bare(&bytes.into(), None)
    }

    /// Ends everything; fails if a task of the flow did.
    pub(crate) async fn end(self) {
        assert_eq!(self.supervisor.failure(), None, "no task of the flow failed");
        self.flow.shutdown().await;
        assert_eq!(self.supervisor.failure(), None, "no task of the flow failed at its end");
    }
}

/// A header of the live topic as a service of this node would write it.
pub(crate) fn header(topic: &str, writer: u8, sequence: u64) -> Header {
    let now = std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap();
    Header::new(
        topic,
        Origin {
            layer: "edge".into(),
            node: "robot-1".into(),
            service: "hostile".into(),
            instance: "0".into(),
            epoch: 1,
        },
        WriterId([writer; 16]),
        sequence,
        u64::try_from(now.as_nanos()).unwrap(),
    )
}

/// The bytes of a message that is in order.
pub(crate) fn frame_bytes(header: &Header, payload: &'static [u8]) -> Bytes {
    Frame::new(header, Bytes::from_static(payload)).unwrap().to_bytes()
}

/// A publisher on the node scope and a consumer on the layer scope, all the time.
pub(crate) struct Traffic {
    publisher: ServiceManager,
    consumer: ServiceManager,
    subscription: blaze_sdk::Subscription,
    _leases: [Lease; 2],
    sent: Arc<AtomicU64>,
    heard: Arc<AtomicU64>,
    /// Messages of others that the consumer heard.
    strangers: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Traffic {
    pub(crate) async fn start(inside: &Inside) -> Self {
        let topic: blaze_domain::TopicName = LIVE_TOPIC.parse().unwrap();
        let layer: blaze_domain::LayerName = "edge".parse().unwrap();
        let service = |name: &str, hub: &MemoryHub, scope| ServiceOptions {
            pool_threads: 2,
            ..ServiceOptions::new(layer.clone(), name.parse().unwrap(), Arc::new(hub.broker()), scope)
        };
        let options = service("imu-driver", &inside.node, Scope::Node).on_node("robot-1".parse().unwrap());
        let publisher = ServiceManager::start(options).await.unwrap();
        let consumer = ServiceManager::start(service("logger", &inside.layer, Scope::Layer))
            .await
            .unwrap();
        let writer = publisher
            .broker()
            .publisher(&topic, &PublishOptions::default())
            .unwrap();
        let own = writer.writer();
        let (heard, strangers) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicU64::new(0)));
        let (count, others) = (Arc::clone(&heard), Arc::clone(&strangers));
        let subscription = consumer
            .broker()
            .subscribe(&topic, Listen::default(), move |message| {
                let counter = if message.writer() == Some(own) { &count } else { &others };
                counter.fetch_add(1, Ordering::Relaxed);
            })
            .await
            .unwrap();
        let leases = [
            publisher.flow().advertise(Advertise::new(topic.clone())).await.unwrap(),
            consumer.flow().request(Request::new(topic.clone())).await.unwrap(),
        ];
        let (sent, stop) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
        let (count, ends) = (Arc::clone(&sent), Arc::clone(&stop));
        let thread = std::thread::spawn(move || {
            while !ends.load(Ordering::Relaxed) {
                writer.publish(Bytes::from_static(b"{\"w\":0.5}"));
                count.fetch_add(1, Ordering::Relaxed);
                // The pace of the publisher, nothing that is waited for.
                std::thread::sleep(Duration::from_millis(4));
            }
        });
        let traffic = Self {
            publisher,
            consumer,
            subscription,
            _leases: leases,
            sent,
            heard,
            strangers,
            stop,
            thread: Some(thread),
        };
        traffic.flows();
        traffic
    }

    /// Waits until more messages have arrived than now.
    pub(crate) fn flows(&self) {
        let before = self.heard.load(Ordering::Relaxed);
        wait::until(
            "messages flow",
            DEADLINE,
            || self.heard.load(Ordering::Relaxed) >= before + 20,
            || format!("{before} before, {} now", self.heard.load(Ordering::Relaxed)),
        )
        .unwrap();
    }

    pub(crate) fn strangers(&self) -> u64 {
        self.strangers.load(Ordering::Relaxed)
    }

    /// Ends it. From the first message that was heard on, none may be missing.
    pub(crate) async fn end(mut self) {
        self.flows();
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
        let stats = || self.subscription.stats();
        let sent = self.sent.load(Ordering::Relaxed);
        wait::until(
            "the last message arrives",
            DEADLINE,
            || stats().lost == 0 && stats().received >= sent / 2,
            || format!("{sent} sent, {:?}", stats()),
        )
        .unwrap();
        let end = stats();
        assert_eq!(
            (end.lost, end.duplicated, end.reordered, end.queue_dropped),
            (0, 0, 0, 0),
            "{end:?}"
        );
        self.publisher.shutdown().await;
        self.consumer.shutdown().await;
    }
}
