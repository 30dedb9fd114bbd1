//! The services of the demo on its nodes, as the session uses them.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use blaze_domain::ServiceName;
use blaze_sdk::{
    Advertise, ConfigListener, Lease, MetricsEndpoint, PublishOptions, Publisher, Request,
    ServiceManager, ServiceOptions, SubscribeOptions, Subscription,
};
use bytes::Bytes;
use futures::future::join_all;
use tokio::sync::Mutex;

use super::analytics::Analytics;
use super::board::{Board, ConsumerId};
use super::changes::{Taken, Wanted};
use super::configuration::Configuration;
use super::nodes::Nodes;
use super::options::DemoNode;
use super::roles::{Consumer, MOVES_FROM, MOVING_SERVICE, PUBLISHING_NODE, PlayedTopic, scope_of};
use super::stage::Stage;
use crate::ends::Ends;
use crate::exit::CliError;

/// All nodes of this process and the services on them.
pub(super) struct System {
    pub(super) nodes: Nodes,
    /// Where changes of the configuration are shown.
    pub(super) configuration: Option<Configuration>,
    /// The services whose configuration is changed.
    pub(super) analytics: parking_lot::Mutex<HashMap<DemoNode, Arc<Analytics>>>,
    pub(super) topics: Vec<PlayedTopic>,
    pub(super) board: Arc<Board>,
    pub(super) services: Mutex<HashMap<(&'static str, DemoNode), Arc<ServiceManager>>>,
    /// In the order of `topics`; none where robot-1 runs elsewhere.
    pub(super) publishers: Vec<Publisher>,
    pub(super) _advertised: Vec<Lease>,
    pub(super) listeners: Mutex<HashMap<ConsumerId, Listener>>,
}

/// What a consumer holds.
pub(super) struct Listener {
    subscription: Subscription,
    lease: Lease,
    /// Held as long as it follows its configuration.
    _follows: Option<ConfigListener>,
}

impl System {
    /// The service of that name on that node, started with its first topic.
    async fn service(
        &self,
        name: &'static str,
        node: DemoNode,
    ) -> Result<Arc<ServiceManager>, String> {
        let mut services = self.services.lock().await;
        if let Some(service) = services.get(&(name, node)) {
            return Ok(Arc::clone(service));
        }
        let running = self.nodes.running.iter().find(|running| running.node == node);
        let running = running.ok_or_else(|| format!("{} does not run here", node.name()))?;
        let scope = scope_of(name, node);
        let broker = Arc::clone(running.brokers.of_services(scope));
        let id = running.flow.id();
        let service_name: ServiceName = name.parse().map_err(|error| format!("{name} {error}"))?;
        let options = ServiceOptions {
            pool_threads: 2,
            metrics: MetricsEndpoint::Off,
            ..ServiceOptions::new(id.layer.clone(), service_name, broker, scope)
        };
        let service = ServiceManager::start(options.on_node(id.node.clone()))
            .await
            .map_err(|error| error.to_string())?;
        let service = Arc::new(service);
        services.insert((name, node), Arc::clone(&service));
        Ok(service)
    }

    /// The same, with everything that is played advertised, if robot-1 runs here.
    ///
    /// # Errors
    /// [`CliError::Failed`] for a topic that cannot be published.
    pub(super) async fn with_publishers(mut self) -> Result<Self, CliError> {
        if self.nodes.robot().is_none() {
            return Ok(self);
        }
        for topic in self.topics.clone() {
            let (publisher, lease) = self.advertise(&topic).await.map_err(|fault| {
                CliError::Failed(format!(
                    "{} cannot publish {}: {fault}",
                    topic.service, topic.name
                ))
            })?;
            self.publishers.push(publisher);
            self._advertised.push(lease);
        }
        Ok(self)
    }

    async fn advertise(&self, topic: &PlayedTopic) -> Result<(Publisher, Lease), String> {
        let service = self.service(topic.service, PUBLISHING_NODE).await?;
        let publish = PublishOptions {
            encoding: topic.encoding.clone(),
            reliability: topic.reliability(),
            depth: topic.depth,
            lifespan: topic.lifespan(),
            large: topic.large,
            ..PublishOptions::default()
        };
        let publisher =
            service.broker().publisher(&topic.name, &publish).map_err(|error| error.to_string())?;
        let advertise = Advertise {
            rate_hz: Some(topic.rate_hz),
            max_bytes: Some(topic.max_bytes as u64),
            encoding: topic.encoding.clone(),
            type_name: topic.type_name.clone(),
            reliability: topic.reliability(),
            durability: topic.durability(),
            depth: topic.depth.max(1),
            lifespan: topic.lifespan(),
            ..Advertise::new(topic.name.clone())
        };
        let lease = service.flow().advertise(advertise).await.map_err(|error| error.to_string())?;
        Ok((publisher, lease))
    }

    /// Ends everything in order: services, what configures them, nodes.
    pub(super) async fn shutdown(self) {
        self.listeners.lock().await.clear();
        drop(self.publishers);
        drop(self._advertised);
        let services = std::mem::take(&mut *self.services.lock().await);
        join_all(services.into_values().filter_map(Arc::into_inner).map(ServiceManager::shutdown))
            .await;
        if let Some(configuration) = self.configuration {
            configuration.shutdown(Duration::from_secs(2)).await;
        }
        self.nodes.shutdown().await;
    }
}

/// A system, and what may end it before its time.
pub(super) struct EndableSystem {
    pub(super) system: System,
    pub(super) ends: Ends,
}

impl Stage for EndableSystem {
    fn admin_ports(&self) -> Vec<(DemoNode, SocketAddr)> {
        let running = self.system.nodes.running.iter();
        running.map(|running| (running.node, running.flow.admin())).collect()
    }

    async fn listen(&self, consumer: &Consumer, id: ConsumerId) -> Result<(), String> {
        let system = &self.system;
        let topic = system
            .topics
            .iter()
            .find(|topic| topic.name == consumer.topic)
            .ok_or("nobody plays it")?;
        let service = system.service(consumer.service, consumer.node).await?;
        let board = Arc::clone(&system.board);
        let analytics =
            (consumer.service == MOVING_SERVICE).then(|| Arc::new(Analytics::default()));
        let follows = analytics
            .as_ref()
            .filter(|_| system.configuration.is_some())
            .map(|analytics| analytics.follow(&service));
        let takes = analytics.clone();
        let options = SubscribeOptions {
            large: topic.large,
            with_kept: topic.depth > 0,
            ..SubscribeOptions::default()
        };
        let subscription = service
            .broker()
            .subscribe(&topic.name, options, move |message| {
                let now = Instant::now();
                if let Some(frame) = message.frame() {
                    board.frame_arrived(id, frame, unix_ns(), now);
                }
                if let Some(analytics) = &takes {
                    analytics.take(now);
                }
            })
            .await
            .map_err(|error| error.to_string())?;
        let request = Request {
            type_name: topic.type_name.clone(),
            reliability: topic.reliability(),
            durability: topic.durability(),
            depth: topic.depth.max(1),
            lifespan: topic.lifespan(),
            ..Request::new(topic.name.clone())
        };
        let lease = service.flow().request(request).await.map_err(|error| error.to_string())?;
        if let Some(analytics) = analytics {
            system.analytics.lock().insert(consumer.node, analytics);
        }
        let listener = Listener { subscription, lease, _follows: follows };
        system.listeners.lock().await.insert(id, listener);
        Ok(())
    }

    async fn change(&self, wanted: &Wanted) -> Result<Taken, String> {
        let configuration = self.system.configuration.as_ref();
        let configuration = configuration.ok_or("there is no main service in this process")?;
        let analytics = self.system.analytics.lock().get(&MOVES_FROM).cloned();
        configuration.change(wanted, analytics.as_deref()).await
    }

    fn results(&self) -> u64 {
        let analytics = self.system.analytics.lock();
        analytics.get(&MOVES_FROM).map_or(0, |analytics| analytics.results())
    }

    async fn stop_listening(&self, id: ConsumerId) -> Result<(), String> {
        let Some(listener) = self.system.listeners.lock().await.remove(&id) else {
            return Ok(());
        };
        let withdrawn = listener.lease.withdraw().await;
        self.system.board.set_consumer_counts(id, listener.subscription.stats());
        listener.subscription.close().await;
        withdrawn.map_err(|error| error.to_string())
    }

    fn publisher(&self) -> Option<Box<dyn FnMut(usize, Bytes) + Send>> {
        let publishers = self.system.publishers.clone();
        if publishers.is_empty() {
            return None;
        }
        Some(Box::new(move |topic, payload| {
            if let Some(publisher) = publishers.get(topic) {
                publisher.publish(payload);
            }
        }))
    }

    async fn look(&self) {
        for (id, listener) in self.system.listeners.lock().await.iter() {
            self.system.board.set_consumer_counts(*id, listener.subscription.stats());
        }
    }

    async fn interrupted(&self) -> Option<String> {
        self.ends.wait().await
    }
}

fn unix_ns() -> u64 {
    let since_epoch = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since_epoch.as_nanos()).unwrap_or(u64::MAX)
}
