//! Makes reality equal to the plan: writers of brokers, and one task for each (topic, scope) that
//! is read.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::{
    Begin, Broker, BrokerError, BrokerKind, Later, PublishOutcome, Publisher, PublisherOptions,
    Received, SubscribeOptions,
};
use blaze_domain::names::ChannelName;
use blaze_domain::{Scope, TopicName};
use blaze_proto::Frame;
use blaze_runtime::supervisor::{Supervisor, TaskHandle, TaskPolicy};
use bytes::Bytes;
use parking_lot::Mutex;

use super::plane::Plane;
use crate::control::Duty;
use crate::lane::path::{TopicId, TopicInfo};
use crate::lane::writer::NewWriter;
use crate::plan::{Bridge, Form, Target, TopicPlan};

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
    /// ROS 2 network.
    pub ros2: Option<Arc<dyn Broker>>,
}

impl LocalBrokers {
    /// The broker of a local scope.
    #[must_use]
    pub fn of(&self, scope: Scope) -> Option<&Arc<dyn Broker>> {
        match scope {
            Scope::Node => self.node.as_ref(),
            Scope::Layer => self.layer.as_ref(),
            Scope::Ros2 => self.ros2.as_ref(),
            Scope::Inter => None,
        }
    }

    /// Scopes whose broker keeps leases.
    pub(super) fn lease_stores(&self) -> BTreeSet<Scope> {
        let keeps =
            |scope: &Scope| self.of(*scope).is_some_and(|broker| broker.flow_side().is_some());
        Scope::LOCAL.into_iter().filter(keeps).collect()
    }
}

/// Whether a source is subscribed.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) enum SourceState {
    /// Not yet, or the broker is away.
    #[default]
    Starting,
    /// It is.
    Subscribed,
    /// The broker refuses the channel, for this reason.
    Failed(String),
}

struct Source {
    task: TaskHandle,
    state: Arc<Mutex<SourceState>>,
    large: bool,
    with_kept: bool,
}

/// Writers and source tasks of one flow.
pub(crate) struct Routes {
    plane: Arc<Plane>,
    brokers: LocalBrokers,
    supervisor: Supervisor,
    sources: Mutex<BTreeMap<(TopicId, Scope), Source>>,
}

impl Routes {
    /// Without any route.
    #[must_use]
    pub(super) fn new(plane: Arc<Plane>, brokers: LocalBrokers, supervisor: Supervisor) -> Self {
        Self { plane, brokers, supervisor, sources: Mutex::default() }
    }

    /// Makes the bridges of a topic equal to its plan. Where the flow gives up to carry it out of
    /// the layer: the offsets that the next one begins at, by partition, if the broker has any.
    pub(super) fn apply(
        &self,
        topic: &TopicName,
        plan: &TopicPlan,
        info: TopicInfo,
        duty: &Duty,
    ) -> Option<Vec<i64>> {
        let now = Instant::now();
        let held = self.plane.read(|state| {
            state.core.find(topic.as_str())?;
            let large = state.core.is_large(topic, &info);
            let writers: Vec<Option<NewWriter>> = plan
                .bridges
                .iter()
                .map(|bridge| state.core.writer_of(topic, bridge.from, &bridge.to).cloned())
                .collect();
            Some((large, writers))
        });
        if held.is_none() && plan.bridges.is_empty() {
            // A topic of other flows that this one has no part in takes no place here.
            return None;
        }
        let (large, held) = held.unwrap_or_else(|| {
            let large = self.plane.read(|state| state.core.is_large(topic, &info));
            (large, vec![None; plan.bridges.len()])
        });
        // Made before the lock is taken, because making one takes time.
        let local = plan.bridges.iter().zip(held);
        let mut writers: Vec<(Scope, &Target, Result<NewWriter, String>)> = local
            .filter(|(bridge, _)| bridge.to.receiver().is_none())
            .map(|(bridge, held)| {
                (bridge.from, &bridge.to, self.writer(topic, bridge, large, held))
            })
            .collect();
        let applied = self.plane.with(|state| {
            let id = state.core.intern(topic, now)?;
            state.core.apply(now, id, info, plan, |bridge| {
                let made = writers
                    .iter()
                    .position(|(from, to, _)| (*from, *to) == (bridge.from, &bridge.to));
                made.map_or_else(|| Err(String::new()), |at| writers.swap_remove(at).2)
            });
            if let Duty::Takes(begin) = duty {
                state.core.takes_over(id, begin);
            }
            state.deliver_waiting(now, id);
            let stopped_at = state.core.stopped_at(id);
            let path = state.core.path(id);
            let reads = |scope| (scope, path.reads(scope), path.reads_kept(scope));
            Some((id, Scope::LOCAL.map(reads), stopped_at))
        });
        let Some((id, reads, stopped_at)) = applied else {
            tracing::error!(%topic, "too many topics: this one is not carried");
            return None;
        };
        for (scope, wanted, with_kept) in reads {
            let anew =
                matches!(duty, Duty::Takes(begin) if scope == Scope::Layer && *begin != Begin::Now);
            self.read(&Reading { id, topic, scope, large, with_kept }, wanted, anew);
        }
        (*duty == Duty::GivesUp && !stopped_at.is_empty()).then_some(stopped_at)
    }

    /// Whether what a topic's bridges read is subscribed.
    #[must_use]
    pub(super) fn source_state(&self, topic: TopicId, scope: Scope) -> SourceState {
        match scope {
            Scope::Inter => SourceState::Subscribed,
            _ => {
                let sources = self.sources.lock();
                let source = sources.get(&(topic, scope));
                source.map_or_else(SourceState::default, |source| source.state.lock().clone())
            }
        }
    }

    /// The states of all sources.
    pub(super) fn source_states(&self) -> BTreeMap<(TopicId, Scope), SourceState> {
        let sources = self.sources.lock();
        let states = sources.iter().map(|(key, source)| (*key, source.state.lock().clone()));
        states.collect()
    }

    /// The states of sources that are not subscribed: few, or the broker is away.
    pub(super) fn not_subscribed(&self) -> Vec<(TopicId, Scope, SourceState)> {
        let sources = self.sources.lock();
        let states = sources.iter().map(|(key, source)| (*key, source.state.lock()));
        let others = states.filter(|(_, state)| **state != SourceState::Subscribed);
        others.map(|((topic, scope), state)| (topic, scope, state.clone())).collect()
    }

    /// Ends all source tasks.
    pub(super) fn stop(&self) {
        for (_, source) in std::mem::take(&mut *self.sources.lock()) {
            source.task.stop();
        }
    }

    /// The writer of a bridge: the one that it has, unless another kind is needed now.
    fn writer(
        &self,
        topic: &TopicName,
        bridge: &Bridge,
        large: bool,
        held: Option<NewWriter>,
    ) -> Result<NewWriter, String> {
        let channel = match &bridge.to {
            Target::Node(Form::Bare) => ChannelName::bare(topic),
            target if target.is_json() => ChannelName::json(topic),
            _ => topic.into(),
        };
        let lane = &bridge.lane;
        let options = PublisherOptions {
            depth: if lane.durable { lane.depth } else { 0 },
            reliable: lane.reliable,
            large,
        };
        // While the one that it had holds messages, another could overtake it: the reconcile tries
        // again.
        let keeps = |held: &NewWriter| held.options == options || held.publisher.later().queued > 0;
        if let Some(held) = held.filter(keeps) {
            return Ok(held);
        }
        let scope = bridge.to.scope();
        let broker = match self.brokers.of(scope) {
            Some(broker) => broker,
            // Replies to calls are taken out before.
            None if scope == Scope::Node => {
                return Ok(NewWriter { publisher: Arc::new(Nowhere), options });
            }
            None => return Err("the scope has no broker".to_owned()),
        };
        let publisher = broker
            .publisher(&channel, options)
            .map_err(|error| format!("{topic} cannot be written: {error}"))?;
        Ok(NewWriter { publisher, options })
    }

    /// Reads a scope for a topic, or no longer. `anew`: bridges out of the layer begin elsewhere
    /// than where it is read now.
    fn read(&self, reading: &Reading<'_>, wanted: bool, anew: bool) {
        let &Reading { id, topic, scope, large, with_kept } = reading;
        let mut sources = self.sources.lock();
        let held = sources.remove(&(id, scope));
        if !wanted {
            drop(sources);
            if let Some(source) = held {
                source.task.stop();
                self.plane.read(|state| state.core.reads_no_more(id, scope));
            }
            return;
        }
        let Some(broker) = self.brokers.of(scope) else { return };
        let makes_room = !matches!(broker.kind(), BrokerKind::Dds | BrokerKind::Ros2);
        let before = match held {
            // Who has begun with what was kept has it. RustDDS never lowers the room of a topic, so
            // another reader would be of no use, and lose what comes between the two.
            Some(source)
                if (source.large == large || !makes_room)
                    && (source.with_kept || !with_kept)
                    && !anew =>
            {
                sources.insert((id, scope), source);
                return;
            }
            Some(source) => {
                tracing::info!(
                    %topic,
                    %scope,
                    large,
                    with_kept,
                    takes_over = anew,
                    "the subscription begins anew",
                );
                source.task.stop();
                Some(source.task)
            }
            None => None,
        };
        let state = Arc::<Mutex<SourceState>>::default();
        let source = SourceTask {
            plane: Arc::clone(&self.plane),
            broker: Arc::clone(broker),
            channel: topic.into(),
            topic: id,
            scope,
            options: SubscribeOptions { large, with_kept, ..SubscribeOptions::default() },
            state: Arc::clone(&state),
            before,
        };
        let name = format!("source {scope} {topic}");
        let task = self.supervisor.spawn(name, TaskPolicy::Essential, source.run());
        let source = Source { task, state, large, with_kept };
        sources.insert((id, scope), source);
    }
}

/// The writer of a node scope without a broker.
struct Nowhere;

impl Publisher for Nowhere {
    fn publish(&self, _: &Frame, _: Option<Instant>) -> PublishOutcome {
        PublishOutcome::Dropped
    }

    fn publish_bare(&self, _: &Bytes, _: Option<Instant>) -> PublishOutcome {
        PublishOutcome::Dropped
    }

    fn later(&self) -> Later {
        Later::default()
    }
}

/// What is to be read.
struct Reading<'a> {
    id: TopicId,
    topic: &'a TopicName,
    scope: Scope,
    large: bool,
    with_kept: bool,
}

/// Reads one topic from one scope.
struct SourceTask {
    plane: Arc<Plane>,
    broker: Arc<dyn Broker>,
    channel: ChannelName,
    topic: TopicId,
    scope: Scope,
    options: SubscribeOptions,
    state: Arc<Mutex<SourceState>>,
    /// The task that it replaces: two at a time would read everything twice.
    before: Option<TaskHandle>,
}

impl SourceTask {
    async fn run(mut self) {
        let again = self.before.is_some();
        if let Some(before) = self.before.take() {
            before.finished().await;
        }
        let mut begin = match self.scope {
            Scope::Layer => self.plane.read(|state| state.core.begin_reading(self.topic, again)),
            Scope::Node | Scope::Ros2 | Scope::Inter => Begin::Now,
        };
        let mut reported = false;
        loop {
            match self.broker.subscribe_from(&self.channel, self.options, begin.clone()).await {
                Ok(mut subscription) => {
                    // What comes after an outage begins then.
                    begin = Begin::Now;
                    if self.scope == Scope::Layer {
                        self.plane
                            .read(|state| state.core.reads_from(self.topic, subscription.starts()));
                    }
                    *self.state.lock() = SourceState::Subscribed;
                    reported = false;
                    let (plane, topic, scope) = (Arc::clone(&self.plane), self.topic, self.scope);
                    let sink = move |batch: &mut Vec<Received>, overrun| {
                        if overrun > 0 {
                            plane.read(|state| state.core.count_overrun(topic, overrun));
                        }
                        plane.ingest(topic, scope, batch);
                    };
                    subscription.forward(BATCH, Box::new(sink)).await;
                    *self.state.lock() = SourceState::Starting;
                }
                Err(error) => {
                    if !std::mem::replace(&mut reported, true) {
                        tracing::warn!(
                            channel = %self.channel,
                            scope = %self.scope,
                            %error,
                            "cannot subscribe, trying on",
                        );
                    }
                    *self.state.lock() = match error {
                        BrokerError::Name { .. }
                        | BrokerError::Collision { .. }
                        | BrokerError::TooManyChannels(_) => SourceState::Failed(error.to_string()),
                        BrokerError::Away(_) | BrokerError::Closed => SourceState::Starting,
                    };
                }
            }
            tokio::time::sleep(RETRY).await;
        }
    }
}
