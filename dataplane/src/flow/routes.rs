//! Makes reality equal to the plan: writers of brokers, and one task for each (topic, scope) that is read.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use blaze_brokers::{Broker, Publisher, PublisherOptions, SubscribeOptions};
use blaze_domain::names::ChannelName;
use blaze_domain::{Scope, TopicName};
use blaze_runtime::supervisor::{Supervisor, TaskHandle, TaskPolicy};
use parking_lot::Mutex;

use super::plane::Plane;
use crate::lane::path::{TopicId, TopicInfo};
use crate::plan::{LaneSpec, Target, TopicPlan};

/// Messages that a source task takes at once.
const BATCH: usize = 64;
/// Between attempts to subscribe to a broker that is away.
const RETRY: Duration = Duration::from_millis(250);

/// The local brokers of one flow.
#[derive(Clone, Default)]
pub struct LocalBrokers {
    /// Node scope.
    pub node: Option<Arc<dyn Broker>>,
    /// Layer scope.
    pub layer: Option<Arc<dyn Broker>>,
}

impl LocalBrokers {
    /// The broker of a local scope.
    #[must_use]
    pub fn of(&self, scope: Scope) -> Option<&Arc<dyn Broker>> {
        match scope {
            Scope::Node => self.node.as_ref(),
            Scope::Layer => self.layer.as_ref(),
            Scope::Inter => None,
        }
    }
}

struct Source {
    task: TaskHandle,
    subscribed: Arc<AtomicBool>,
}

type WriterKey = (Scope, ChannelName, PublisherOptions);

/// Writers and source tasks of one flow.
pub(crate) struct Routes {
    plane: Arc<Plane>,
    brokers: LocalBrokers,
    supervisor: Supervisor,
    sources: Mutex<BTreeMap<(TopicId, Scope), Source>>,
    writers: Mutex<HashMap<WriterKey, Arc<dyn Publisher>>>,
}

impl Routes {
    /// Without any route.
    #[must_use]
    pub(super) fn new(plane: Arc<Plane>, brokers: LocalBrokers, supervisor: Supervisor) -> Self {
        Self {
            plane,
            brokers,
            supervisor,
            sources: Mutex::default(),
            writers: Mutex::default(),
        }
    }

    /// Makes the bridges of a topic equal to its plan.
    pub(super) fn apply(&self, topic: &TopicName, plan: &TopicPlan, info: TopicInfo) {
        if plan.bridges.is_empty() && self.plane.read(|state| state.core.find(topic.as_str()).is_none()) {
            // A topic of other flows that this one has no part in takes no place here.
            return;
        }
        let now = Instant::now();
        let large = self.plane.read(|state| state.core.is_large(info.max_bytes));
        let mut writers: HashMap<Target, Arc<dyn Publisher>> = HashMap::new();
        for bridge in &plan.bridges {
            if let Some(writer) = self.writer(topic, &bridge.to, &bridge.lane, large) {
                writers.insert(bridge.to.clone(), writer);
            }
        }
        let applied = self.plane.with(|state| {
            let id = state.core.intern(topic, now)?;
            state
                .core
                .apply(now, id, info, plan, |target| writers.get(target).cloned());
            let path = state.core.path(id);
            Some((id, [Scope::Node, Scope::Layer].map(|scope| (scope, path.reads(scope)))))
        });
        let Some((id, reads)) = applied else {
            tracing::error!(%topic, "too many topics: this one is not carried");
            return;
        };
        for (scope, wanted) in reads {
            self.read(id, topic, scope, wanted, large);
        }
        if plan.bridges.is_empty() {
            self.writers.lock().retain(|(_, channel, _), _| {
                *channel != ChannelName::from(topic) && *channel != ChannelName::bare(topic)
            });
        }
    }

    /// Whether everything that the topic's bridges read is subscribed.
    #[must_use]
    pub(super) fn is_subscribed(&self, topic: TopicId, scope: Scope) -> bool {
        match scope {
            Scope::Inter => true,
            _ => self
                .sources
                .lock()
                .get(&(topic, scope))
                .is_some_and(|s| s.subscribed.load(Ordering::Relaxed)),
        }
    }

    /// What is subscribed.
    pub(super) fn subscribed(&self) -> BTreeSet<(TopicId, Scope)> {
        let sources = self.sources.lock();
        let there = sources
            .iter()
            .filter(|(_, source)| source.subscribed.load(Ordering::Relaxed));
        there.map(|(key, _)| *key).collect()
    }

    /// Ends all source tasks.
    pub(super) fn stop(&self) {
        for (_, source) in std::mem::take(&mut *self.sources.lock()) {
            source.task.stop();
        }
    }

    fn writer(&self, topic: &TopicName, target: &Target, lane: &LaneSpec, large: bool) -> Option<Arc<dyn Publisher>> {
        let (scope, channel) = match target {
            Target::Node { bare: true } => (Scope::Node, ChannelName::bare(topic)),
            Target::Node { bare: false } => (Scope::Node, topic.into()),
            Target::Layer => (Scope::Layer, topic.into()),
            Target::Inter { .. } => return None,
        };
        let depth = if lane.durable { lane.depth } else { 0 };
        let options = PublisherOptions {
            depth,
            reliable: lane.reliable,
            large,
        };
        let key = (scope, channel, options);
        if let Some(writer) = self.writers.lock().get(&key) {
            return Some(Arc::clone(writer));
        }
        match self.brokers.of(scope)?.publisher(&key.1, options) {
            Ok(writer) => {
                self.writers.lock().insert(key, Arc::clone(&writer));
                Some(writer)
            }
            Err(error) => {
                tracing::error!(%topic, %scope, %error, "this topic cannot be written");
                None
            }
        }
    }

    fn read(&self, id: TopicId, topic: &TopicName, scope: Scope, wanted: bool, large: bool) {
        let mut sources = self.sources.lock();
        if !wanted {
            if let Some(source) = sources.remove(&(id, scope)) {
                source.task.stop();
            }
            return;
        }
        if sources.contains_key(&(id, scope)) {
            return;
        }
        let Some(broker) = self.brokers.of(scope) else { return };
        let subscribed = Arc::new(AtomicBool::new(false));
        let source = SourceTask {
            plane: Arc::clone(&self.plane),
            broker: Arc::clone(broker),
            channel: topic.into(),
            topic: id,
            scope,
            options: SubscribeOptions {
                large,
                ..SubscribeOptions::default()
            },
            subscribed: Arc::clone(&subscribed),
        };
        let name = format!("source {scope} {topic}");
        let task = self.supervisor.spawn(name, TaskPolicy::Essential, source.run());
        sources.insert((id, scope), Source { task, subscribed });
    }
}

/// Reads one topic from one scope.
struct SourceTask {
    plane: Arc<Plane>,
    broker: Arc<dyn Broker>,
    channel: ChannelName,
    topic: TopicId,
    scope: Scope,
    options: SubscribeOptions,
    subscribed: Arc<AtomicBool>,
}

impl SourceTask {
    async fn run(self) {
        let mut reported = false;
        loop {
            match self.broker.subscribe(&self.channel, self.options).await {
                Ok(mut subscription) => {
                    self.subscribed.store(true, Ordering::Relaxed);
                    reported = false;
                    let mut batch = Vec::with_capacity(BATCH);
                    while subscription.receive(&mut batch, BATCH).await > 0 {
                        let overrun = subscription.take_dropped();
                        if overrun > 0 {
                            self.plane.read(|state| state.core.count_overrun(self.topic, overrun));
                        }
                        self.plane.ingest(self.topic, self.scope, &mut batch);
                    }
                    self.subscribed.store(false, Ordering::Relaxed);
                }
                Err(error) if !reported => {
                    reported = true;
                    tracing::warn!(channel = %self.channel, scope = %self.scope, %error, "cannot subscribe, trying on");
                }
                Err(_) => {}
            }
            tokio::time::sleep(RETRY).await;
        }
    }
}
