//! Flows that share a layer broker hear one another there. Of a Kafka broker those of one layer
//! share its topics, and two layers never use one; on DDS frames of another layer are told apart.
//!
//! ```text
//! control core: Hello, Delta, … ─► blaze/flow/peers ─┬─► Hellos of other layers ─► Claims ─► stand back, or not (Kafka)
//!                                                    └─► what the own layer says ─► control core
//! ```
//!
//! Of two layers with one broker and one prefix the one whose flow began first has it; the other's
//! flows bridge nothing there until they have not heard of it for 2.5 s.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::{Broker, Content, FlowSide, Health, Received, SubscribeOptions, Subscription};
use blaze_domain::FlowId;
use blaze_domain::names::ChannelName;
use blaze_proto::link::LinkControl;
use blaze_proto::link::link_control::Body;
use blaze_runtime::{BEAT, ticks};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::Shared;
use crate::control::{ControlCore, LISTEN, read_replica_message};

/// How often it is looked at who has gone silent.
const LOOK: Duration = BEAT.saturating_mul(4);
/// A Hello counts this long.
const LIVE: Duration = Duration::from_millis(2500);
/// Flows that are followed.
const MAX_FLOWS: usize = 1024;
/// Messages that are taken at once.
const BATCH: usize = 64;

/// Flows of other layers that say Hello on the layer broker, and should not be there.
pub(super) struct Claims {
    me: FlowId,
    epoch: u64,
    others: BTreeMap<FlowId, (u64, Instant)>,
}

impl Claims {
    pub(super) fn new(me: FlowId, epoch: u64) -> Self {
        Self { me, epoch, others: BTreeMap::new() }
    }

    /// Takes what came on the channel.
    pub(super) fn hear(&mut self, now: Instant, message: &LinkControl) {
        let Some(Body::Hello(hello)) = &message.body else {
            return;
        };
        // The life on the link may have begun later than the process.
        let began = message.channel.as_ref().map_or(hello.epoch, |channel| channel.began);
        if hello.layer == self.me.layer.as_str() {
            // Replicas share the broker on purpose.
            return;
        }
        let Ok(flow) = format!("{}/{}", hello.layer, hello.node).parse::<FlowId>() else {
            return;
        };
        if self.others.len() < MAX_FLOWS || self.others.contains_key(&flow) {
            self.others.insert(flow, (began, now));
        }
    }

    /// The broker is away: that nothing is heard says nothing of who lives.
    pub(super) fn excuse(&mut self, now: Instant) {
        for (_, heard) in self.others.values_mut() {
            *heard = now;
        }
    }

    /// The flow of another layer that was first, if there is one that lives.
    pub(super) fn first(&mut self, now: Instant) -> Option<&FlowId> {
        self.others.retain(|_, (_, heard)| now.saturating_duration_since(*heard) < LIVE);
        let own = (self.epoch, &self.me);
        let others = self.others.iter().map(|(flow, (epoch, _))| (*epoch, flow));
        others.filter(|other| *other < own).min().map(|(_, flow)| flow)
    }
}

/// Hears the flows on the layer broker, and stands back where another layer was first.
pub(super) struct PeersTask {
    pub(super) shared: Arc<Shared>,
    pub(super) broker: Arc<dyn Broker>,
    /// Where two layers could meet on one broker by mistake.
    pub(super) side: Option<Arc<dyn FlowSide>>,
    pub(super) channel: ChannelName,
    /// The epoch that this process began with.
    pub(super) began: u64,
    /// Is told when this flow has listened long enough to know who was first.
    pub(super) listened: watch::Sender<bool>,
    pub(super) stop: CancellationToken,
}

impl PeersTask {
    pub(super) async fn run(self) {
        let claims = || Claims::new(self.shared.me.clone(), self.began);
        // Elsewhere frames of other layers are told apart, and nobody has to stand back.
        let mut claims = self.side.as_ref().map(|_| claims());
        let mut subscription: Option<Subscription> = None;
        let mut since = Instant::now();
        let mut standing_back = false;
        let mut batch = Vec::with_capacity(BATCH);
        let mut tick = ticks(LOOK);
        loop {
            if subscription.is_none() {
                subscription =
                    self.broker.subscribe(&self.channel, SubscribeOptions::default()).await.ok();
                since = Instant::now();
                if subscription.is_some() {
                    self.shared.control.lock().hears_replicas(since);
                }
            }
            let ended = tokio::select! {
                () = self.stop.cancelled() => return,
                _ = tick.tick() => false,
                ended = receive(&mut subscription, &mut batch) => ended,
            };
            let now = Instant::now();
            self.count_overrun(subscription.as_ref().map_or(0, Subscription::take_dropped));
            self.hear(now, claims.as_mut(), &mut batch);
            let first = claims.as_mut().and_then(|claims| claims.first(now));
            if let Some(side) = &self.side
                && first.is_some() != standing_back
            {
                standing_back = first.is_some();
                if let Some(first) = first {
                    tracing::warn!(
                        %first,
                        "another layer's flow uses this Kafka: give each layer a prefix",
                    );
                } else {
                    tracing::info!("the Kafka of this layer is free again");
                }
                side.stand_back(first.map(ToString::to_string));
            }
            if subscription.is_some() && now.saturating_duration_since(since) >= LISTEN {
                self.listened.send_replace(true);
            }
            if ended {
                subscription = None;
            }
        }
    }

    fn count_overrun(&self, overrun: u64) {
        if overrun > 0 {
            tracing::warn!(overrun, "other flows' messages came faster than they could be read");
            self.shared.control.lock().count_replica_overrun(overrun);
        }
    }

    fn hear(&self, now: Instant, mut claims: Option<&mut Claims>, batch: &mut Vec<Received>) {
        let health = self.broker.status().borrow().health;
        let away = !matches!(health, Health::Up | Health::InUse);
        if let Some(claims) = claims.as_mut().filter(|_| away) {
            claims.excuse(now);
        }
        if batch.is_empty() && !away {
            return;
        }
        let messages = read(batch);
        if let Some(claims) = claims {
            let read = messages.iter().filter_map(|(message, _)| message.as_ref());
            read.for_each(|message| claims.hear(now, message));
        }
        if take(&mut self.shared.control.lock(), now, away, messages) {
            self.shared.plane.nudge();
        }
    }
}

/// A message of another flow, if it can be read, and when the server took it, by its own clock.
type Message = (Option<LinkControl>, Option<i64>);

/// Reads what came, each message once. Others than bare ones are nobody's.
fn read(batch: &mut Vec<Received>) -> Vec<Message> {
    let read = |received: Received| match &received.content {
        Content::Bare { payload, .. } => {
            let appended_ms = received.place.and_then(|place| place.appended_ms);
            Some((read_replica_message(payload), appended_ms))
        }
        Content::Frame(_) | Content::Malformed { .. } => None,
    };
    batch.drain(..).filter_map(read).collect()
}

/// Tells the control core. Whether it is to work at once: a sign of life alone changes nothing, and
/// comes a thousand times a second.
fn take(control: &mut ControlCore, now: Instant, away: bool, messages: Vec<Message>) -> bool {
    if away {
        control.excuse_replicas(now);
    }
    let mut changed = false;
    for (message, appended_ms) in messages {
        changed |= control.replica_message(now, message, appended_ms);
    }
    changed
}

/// Waits for Hellos; true when the subscription has ended. Never returns without one.
async fn receive(subscription: &mut Option<Subscription>, batch: &mut Vec<Received>) -> bool {
    match subscription {
        Some(subscription) => subscription.receive(batch, BATCH).await == 0,
        None => std::future::pending().await,
    }
}

#[cfg(test)]
mod tests {
    use blaze_proto::link::link_control::Hello;

    use super::*;

    fn hello(flow: &str, epoch: u64) -> LinkControl {
        let (layer, node) = flow.split_once('/').unwrap();
        let hello =
            Hello { layer: layer.to_owned(), node: node.to_owned(), epoch, ..Hello::default() };
        LinkControl::from(Body::Hello(hello))
    }

    /// Who is first after these Hellos, seen by `cloud/b` with epoch 10.
    fn first_of(hellos: &[(&str, u64)]) -> Option<String> {
        let now = Instant::now();
        let mut claims = Claims::new("cloud/b".parse().unwrap(), 10);
        for (flow, epoch) in hellos {
            claims.hear(now, &hello(flow, *epoch));
        }
        claims.first(now).map(ToString::to_string)
    }

    #[test]
    fn whoever_began_first_has_the_broker() {
        assert_eq!(first_of(&[]), None);
        assert_eq!(first_of(&[("fog/a", 9)]).as_deref(), Some("fog/a"));
        assert_eq!(first_of(&[("fog/a", 11)]), None);
        assert_eq!(first_of(&[("fog/a", 9), ("edge/x", 8)]).as_deref(), Some("edge/x"));
        assert_eq!(
            first_of(&[("a/z", 10)]).as_deref(),
            Some("a/z"),
            "of equal epochs the smaller name"
        );
        assert_eq!(first_of(&[("fog/a", 10)]), None);
        assert_eq!(first_of(&[("cloud/a", 1), ("cloud/b", 2)]), None, "the own layer shares it");
    }

    #[test]
    fn one_that_is_silent_for_2500_ms_is_gone() {
        let now = Instant::now();
        let mut claims = Claims::new("cloud/b".parse().unwrap(), 10);
        claims.hear(now, &hello("fog/a", 9));
        assert!(claims.first(now + Duration::from_millis(2499)).is_some());
        claims.hear(now + Duration::from_millis(2499), &hello("fog/a", 9));
        assert!(claims.first(now + Duration::from_millis(4998)).is_some());
        assert!(claims.first(now + Duration::from_millis(4999)).is_none());
        claims.hear(now + Duration::from_secs(6), &hello("fog/a", 12));
        assert!(claims.first(now + Duration::from_secs(6)).is_none(), "it began anew, after us");
    }

    #[test]
    fn garbage_and_crowds_do_no_harm() {
        let now = Instant::now();
        let mut claims = Claims::new("cloud/b".parse().unwrap(), 10);
        claims.hear(now, &LinkControl::default());
        claims.hear(now, &hello("Fog/A", 1));
        for n in 0..2 * MAX_FLOWS {
            claims.hear(now, &hello(&format!("fog/n{n}"), 20));
        }
        assert!(claims.others.len() == MAX_FLOWS && claims.first(now).is_none());
    }
}
