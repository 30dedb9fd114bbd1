//! The task that drives the control core: control channels and link news in, answers, plans and
//! registry messages out.

use std::collections::{BTreeSet, HashMap};
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use blaze_brokers::{
    Broker, BrokerError, BrokerKind, Content, FlowSide, Publisher, PublisherOptions, Received,
    SubscribeOptions, Subscription,
};
use blaze_domain::names::ChannelName;
use blaze_domain::{Scope, TopicName, WriterId};
use blaze_proto::link::link_control::LayerScope;
use blaze_runtime::{BEAT, ticks};
use bytes::Bytes;
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

use super::Shared;
use super::plane::{News, wall_ms, wall_ns};
use super::routes::SourceState;
use crate::control::{Duty, Output};
use crate::lane::path::TopicInfo;
use crate::plan::TopicPlan;
use crate::registry::peers_channel;
use crate::world::FlowState;

/// How often what is due is looked for.
const TICK: Duration = BEAT;
/// Between attempts to subscribe to a broker that is away.
const RETRY: Duration = Duration::from_millis(250);
/// How often it is measured what this flow carries.
const MEASURE: Duration = Duration::from_secs(1);
/// Control payloads that are taken at once, and that wait at most.
const BATCH: usize = 64;
const MAX_WAITING: usize = 4096;
/// Reply channels whose writers are kept.
const MAX_WRITERS: usize = 1024;

/// Drives the control core until the flow drains.
pub(super) struct ControlTask {
    pub(super) shared: Arc<Shared>,
    pub(super) ready: Arc<Notify>,
    /// Whether it has been ready.
    pub(super) was_ready: bool,
    pub(super) writers: HashMap<(Scope, ChannelName), Arc<dyn Publisher>>,
    pub(super) leave: Leave,
    /// When it was last measured what this flow carries.
    pub(super) measured: Instant,
}

/// How a flow goes, step by step.
#[derive(Clone, Default)]
pub(super) struct Leave {
    /// It takes in nothing more.
    pub(super) draining: CancellationToken,
    /// Others have been told where it stopped.
    pub(super) handed_over: CancellationToken,
    /// Nothing of it is left to tell.
    pub(super) gone: CancellationToken,
}

impl ControlTask {
    pub(super) async fn run(mut self) {
        let mut node = ControlChannel::new(self.shared.brokers.node.clone());
        let mut layer = ControlChannel::new(self.shared.brokers.layer.clone());
        let mut tick = ticks(TICK);
        let mut announced = false;
        let (mut of_node, mut of_layer): (Vec<Received>, Vec<Received>) = (Vec::new(), Vec::new());
        loop {
            tokio::select! {
                () = self.leave.draining.cancelled() => break,
                _ = tick.tick() => {}
                () = self.shared.plane.news() => {}
                () = node.receive(&mut of_node) => {}
                () = layer.receive(&mut of_layer) => {}
            }
            self.take_control(Scope::Node, &mut of_node);
            self.take_control(Scope::Layer, &mut of_layer);
            for (hears, channel) in self.shared.hears.iter().zip([&node, &layer]) {
                hears.store(channel.is_settled(), Ordering::Relaxed);
            }
            let overrun = node.take_dropped() + layer.take_dropped();
            if overrun > 0 {
                tracing::warn!(overrun, "control messages came faster than they could be read");
                self.shared.control.lock().overrun += overrun;
            }
            if !announced && node.is_settled() && layer.is_settled() {
                announced = true;
                self.shared.control.lock().announce_start(wall_ms());
            }
            self.work();
        }
        self.drain(tick).await;
    }

    /// Takes in nothing more, but tells others how it goes on until the flow has nothing left to
    /// do.
    async fn drain(&mut self, mut tick: tokio::time::Interval) {
        self.shared.control.lock().start_draining(Instant::now(), wall_ms());
        loop {
            self.work();
            if self.shared.control.lock().has_handed_over() {
                self.leave.handed_over.cancel();
            }
            tokio::select! {
                () = self.leave.gone.cancelled() => break,
                _ = tick.tick() => {}
                () = self.shared.plane.news() => {}
            }
        }
        self.shared.control.lock().say_goodbye();
        // A Hello after it would make the flow live again for the others.
        self.carry_out_all(Instant::now());
    }

    fn take_control(&self, scope: Scope, batch: &mut Vec<Received>) {
        let mut control = self.shared.control.lock();
        for received in batch.drain(..) {
            match received.content {
                Content::Bare { payload, .. } => {
                    control.control(Instant::now(), wall_ms(), scope, &payload);
                }
                // Control channels carry JSON as it is.
                Content::Frame(_) | Content::Malformed { .. } => control.refused += 1,
            }
        }
    }

    fn work(&mut self) {
        let now = Instant::now();
        let collisions = self.side(Scope::Layer).map(|side| side.take_collisions());
        for (channel, other) in collisions.unwrap_or_default() {
            self.refuse_name(now, &channel, other);
        }
        self.measure(now);
        {
            let mut control = self.shared.control.lock();
            for news in self.shared.plane.take_news() {
                if let Some(inter) = &self.shared.inter {
                    inter.follow(&news);
                }
                match news {
                    News::Link(event) => control.link_event(now, *event),
                    News::Rebuilt(epoch) => {
                        self.shared.epoch.store(epoch, Ordering::Relaxed);
                        control.set_epoch(epoch);
                    }
                    News::Joined => control.joined(now),
                    News::Lost => control.lost(now),
                    News::Left => control.left(now),
                    News::Discovered(_) => {}
                }
            }
            control.tick(now, wall_ms());
            if control.state() == FlowState::Ready && !std::mem::replace(&mut self.was_ready, true)
            {
                self.ready.notify_one();
            }
        }
        self.report_failures();
        self.follow_calls();
        self.carry_out_all(now);
        self.send_calls(now);
        self.empty(now);
        self.shared.allocate(now);
        for (topic, writer) in self.shared.plane.with(|state| state.core.take_superseded()) {
            self.forget_writer(&topic, writer);
        }
        // A flow without an inter scope has no pacer that would do it.
        self.shared.plane.with(|state| state.run_timers(now));
    }

    /// Lets the control core publish events about messages that could not be converted.
    fn report_failures(&self) {
        let failures = self.shared.plane.read(|state| state.core.take_convert_failures());
        for (topic, failure) in failures {
            self.shared.control.lock().convert_failed(wall_ms(), topic, &failure);
        }
    }

    /// Gives the control core the replies to calls that have arrived.
    fn follow_calls(&self) {
        let arrived = self.shared.plane.read(|state| state.core.take_arrived());
        for reply in arrived {
            self.shared.control.lock().call_reply(&reply);
        }
    }

    /// Sends the calls whose ways stand: their plans are carried out.
    fn send_calls(&mut self, now: Instant) {
        let awaited = self.shared.control.lock().awaited_replies();
        if awaited.is_empty() {
            return;
        }
        let is_read = |topic: &TopicName| {
            let reads = self.shared.plane.read(|state| {
                let id = state.core.find(topic.as_str())?;
                let path = state.core.path(id);
                Some((id, Scope::LOCAL.map(|scope| (scope, path.reads(scope)))))
            });
            reads.is_some_and(|(id, reads)| {
                reads.into_iter().filter(|(_, reads)| *reads).all(|(scope, _)| {
                    self.shared.routes.source_state(id, scope) == SourceState::Subscribed
                })
            })
        };
        let read: BTreeSet<TopicName> = awaited.into_iter().filter(is_read).collect();
        self.shared.control.lock().send_calls(now, wall_ns(), |topic| read.contains(topic));
        self.carry_out_all(now);
    }

    /// Tells the control core once a second what this flow carries.
    fn measure(&mut self, now: Instant) {
        if now.saturating_duration_since(self.measured) < MEASURE {
            return;
        }
        self.measured = now;
        let loads = self.shared.plane.read(|state| state.measure(now));
        let limit = self.shared.egress.budget() as u64;
        self.shared.control.lock().set_loads(now, &loads, limit);
    }

    /// Topics that were given up are handed over as soon as nothing of them waits in a lane.
    fn empty(&mut self, now: Instant) {
        let mut topics = self.shared.control.lock().emptying();
        if topics.is_empty() {
            return;
        }
        self.shared.plane.with(|state| {
            state.run_timers(now);
            topics.retain(|topic| state.core.has_emptied(topic));
        });
        for topic in &topics {
            self.shared.control.lock().emptied(now, wall_ms(), topic);
        }
        self.carry_out_all(now);
    }

    fn carry_out_all(&mut self, now: Instant) {
        // Not locked meanwhile: what is carried out may have a consequence, which is carried out
        // too.
        loop {
            let output = self.shared.control.lock().poll();
            let Some(output) = output else { break };
            self.carry_out(now, output);
        }
    }

    fn carry_out(&mut self, now: Instant, output: Output) {
        let plane = &self.shared.plane;
        match output {
            Output::Publish { scope, channel, body } => self.publish(scope, channel, &body, None),
            Output::Link { to, body } => {
                plane.link(|engine| engine.send_control(&to, *body));
            }
            Output::Types { from, body } => self.shared.definitions.take(from, *body),
            Output::Announce { version, digest } => {
                plane.link(|engine| engine.set_registry(version, digest));
            }
            Output::State(state) => {
                plane.link(|engine| engine.set_state(now, state.into()));
            }
            Output::Inter { join } => {
                if let Some(inter) = &self.shared.inter {
                    inter.want(join);
                }
            }
            Output::Call { request } => {
                plane.with(|state| state.send_call(now, wall_ns(), request));
            }
            Output::Plan { topic, plan, info, duty } => {
                self.prepare_types(now, &plan, &info);
                let places = self.shared.routes.apply(&topic, &plan, *info, &duty);
                if duty == Duty::GivesUp {
                    self.shared.control.lock().given_up(now, wall_ms(), &topic, places);
                }
            }
            Output::Replicas { body, deadline } => {
                if let Some(channel) = peers_channel() {
                    self.publish(Scope::Layer, channel, &body, deadline);
                }
            }
            Output::LayerAway(away) => {
                plane.link(|engine| engine.set_layer_away(now, away));
            }
            Output::Ros2(network) => {
                plane.link(|engine| engine.set_ros2(now, network));
            }
            Output::Owned(owned) => {
                if let Some(ros2) = &self.shared.ros2 {
                    ros2.set_owned(owned);
                }
            }
            Output::Show { topic, shown } => {
                if let Some(ros2) = &self.shared.ros2 {
                    ros2.show(topic, shown);
                }
            }
            Output::LayerScope { shared } => {
                let said = if shared { self.shared.layer_scope } else { (LayerScope::None, 0) };
                plane.link(|engine| engine.set_layer_scope(now, said.0, said.1));
            }
            Output::SaveLease(lease) => {
                if let Some(side) = self.side(lease.scope) {
                    match lease.value {
                        Some(value) => side.put_lease(&lease.key, value),
                        None => side.remove_lease(&lease.key),
                    }
                }
            }
            Output::Prepare { scope, channel, depth } => {
                if let Some(side) = self.side(scope)
                    && let Err(error) = side.prepare(&channel, depth)
                {
                    tracing::warn!(%channel, %scope, %error, "the broker cannot have this channel");
                    if let BrokerError::Collision { other, .. } = error {
                        self.refuse_name(now, &channel, other);
                    }
                }
            }
            Output::ForgetWriters { topic, of, but } => {
                let writers = plane.with(|state| {
                    let id = state.core.find(topic.as_str())?;
                    Some(state.core.forget_writers(now, id, &of, &but))
                });
                for writer in writers.into_iter().flatten() {
                    self.forget_writer(&topic, writer);
                }
            }
            Output::Release { scope, channel } => {
                if let Some(side) = self.side(scope) {
                    side.release(&channel);
                }
            }
        }
    }

    /// A type that is to be converted is sought before its first message comes.
    fn prepare_types(&self, now: Instant, plan: &TopicPlan, info: &TopicInfo) {
        let to_json = plan.bridges.iter().any(|bridge| bridge.to.is_json());
        if let Some(published) = info.types.published.as_ref().filter(|_| to_json) {
            self.shared.types.prepare(now, published.borrowed());
        }
    }

    fn refuse_name(&self, now: Instant, channel: &ChannelName, other: String) {
        if let Ok(topic) = channel.as_str().parse() {
            self.shared.control.lock().refuse_name(now, topic, other);
        }
    }

    /// What the own brokers keep of a writer goes.
    fn forget_writer(&self, topic: &TopicName, writer: WriterId) {
        for side in Scope::LOCAL.into_iter().filter_map(|scope| self.side(scope)) {
            side.forget_writer(&topic.into(), writer);
        }
    }

    fn side(&self, scope: Scope) -> Option<Arc<dyn FlowSide>> {
        self.shared.brokers.of(scope)?.flow_side()
    }

    fn publish(
        &mut self,
        scope: Scope,
        channel: ChannelName,
        body: &Bytes,
        deadline: Option<Instant>,
    ) {
        let Some(broker) = self.shared.brokers.of(scope) else {
            return;
        };
        if self.writers.len() >= MAX_WRITERS {
            self.writers.clear();
        }
        let key = (scope, channel);
        let writer = match self.writers.get(&key) {
            Some(writer) => Arc::clone(writer),
            None => match broker.publisher(&key.1, options_of(broker.kind(), &key.1)) {
                Ok(writer) => {
                    self.writers.insert(key, Arc::clone(&writer));
                    writer
                }
                Err(error) => {
                    tracing::warn!(channel = %key.1, %error, "cannot answer");
                    return;
                }
            },
        };
        writer.publish_bare(body, deadline);
    }
}

/// How a reserved channel is written. What flows of a layer tell one another goes reliably where
/// the broker is DDS: there a burst of best-effort samples may be lost, and asking for it again
/// takes longer. On Kafka it is reliable as it is.
fn options_of(kind: BrokerKind, channel: &ChannelName) -> PublisherOptions {
    PublisherOptions {
        reliable: kind == BrokerKind::Dds && peers_channel().as_ref() == Some(channel),
        ..PublisherOptions::default()
    }
}

/// The control channel of one scope, subscribed anew whenever it ends.
struct ControlChannel {
    broker: Option<Arc<dyn Broker>>,
    subscription: Option<Subscription>,
    attempt: Option<Attempt>,
}

/// An attempt to subscribe that goes on.
type Attempt = Pin<Box<dyn Future<Output = Result<Subscription, BrokerError>> + Send>>;

impl ControlChannel {
    fn new(broker: Option<Arc<dyn Broker>>) -> Self {
        Self { broker, subscription: None, attempt: None }
    }

    /// Whether it is subscribed, or there is none.
    fn is_settled(&self) -> bool {
        self.broker.is_none() || self.subscription.is_some()
    }

    /// Waits for payloads; returns also when it has just been subscribed. Without a broker it never
    /// returns. Cancelling it loses nothing: an attempt to subscribe goes on with the next call,
    /// however long the broker takes.
    async fn receive(&mut self, batch: &mut Vec<Received>) {
        let Some(broker) = &self.broker else {
            return std::future::pending().await;
        };
        if let Some(subscription) = &mut self.subscription {
            if subscription.receive(batch, BATCH).await > 0 {
                return;
            }
            self.subscription = None;
        }
        let attempt = self.attempt.get_or_insert_with(|| Box::pin(subscribe(Arc::clone(broker))));
        let subscribed = attempt.await;
        self.attempt = None;
        match subscribed {
            Ok(subscription) => self.subscription = Some(subscription),
            Err(BrokerError::Closed) => {
                self.broker = None;
                std::future::pending::<()>().await;
            }
            Err(error) => {
                tracing::debug!(%error, "cannot subscribe to the control channel, trying on");
            }
        }
    }

    /// Payloads that the broker dropped because this flow was slow, since the last call.
    fn take_dropped(&self) -> u64 {
        self.subscription.as_ref().map_or(0, Subscription::take_dropped)
    }
}

/// Subscribes to the control channel; a failure is told after a while, so that trying on does no
/// harm.
async fn subscribe(broker: Arc<dyn Broker>) -> Result<Subscription, BrokerError> {
    let options = SubscribeOptions { max_messages: MAX_WAITING, ..SubscribeOptions::default() };
    let subscribed = broker.subscribe(&ChannelName::control(), options).await;
    if subscribed.is_err() {
        tokio::time::sleep(RETRY).await;
    }
    subscribed
}
