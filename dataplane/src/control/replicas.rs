//! Flows of one layer that share a layer broker with a channel of their own (`blaze/flow/peers`):
//! what they say there, and what follows.
//!
//! ```text
//! Hello every 500 ms and when the state changes ─┐
//! Delta to all, SnapshotRequest and Snapshot to one ─┼─► LinkControl with a `channel`: from, epoch, to ─► ControlCore of the others
//! Goodbye ───────────────────────────────────────┘
//! ```

use std::time::{Duration, Instant};

use blaze_domain::FlowId;
use blaze_domain::node_file::AutoBool;
use blaze_proto::link::LinkControl;
use blaze_proto::link::link_control::{
    Body, Channel, Egress, Gateway, Goodbye, Hello, LayerScope, State,
};
use bytes::Bytes;
use prost::Message as _;

use super::{ControlCore, LISTEN, Output};
use crate::link::{NameConflict, kind_to_wire};
use crate::registry::SILENT;

/// Between two Hellos.
const HELLO_EVERY: Duration = Duration::from_millis(500);
/// A flow waits so long for what others have announced before it is ready without it.
pub(super) const KNOW_OTHERS: Duration = Duration::from_secs(2);
/// Largest message that is looked at, in bytes: those of flows have at most 1,200, and the names of
/// sender and addressee.
const MAX_MESSAGE: usize = 4096;

/// What another flow said on the channel of the layer broker; `None` where it cannot be read.
#[must_use]
pub fn read_replica_message(payload: &[u8]) -> Option<LinkControl> {
    let fits = payload.len() <= MAX_MESSAGE;
    fits.then(|| LinkControl::decode(payload).ok()).flatten()
}

/// What the core remembers of the channel.
#[derive(Debug, Default)]
pub(super) struct Replicas {
    /// When the next Hello is due.
    next_hello: Option<Instant>,
    /// The epoch that the process began with.
    began: u64,
    /// Another program that says Hello under the own name.
    namesake: Option<Namesake>,
    /// Messages that could not be read.
    refused: u64,
    /// Messages that came faster than they could be read.
    overrun: u64,
}

impl Replicas {
    pub(super) fn new(began: u64) -> Self {
        Self { began, ..Self::default() }
    }

    fn hear_namesake(&mut self, now: Instant, began: u64) {
        let known = self.namesake.filter(|known| known.began == began && known.lives(now));
        let first = known.map_or(now, |known| known.first);
        self.namesake = Some(Namesake { began, first, last: now });
    }
}

/// Another program that says Hello under the name of this flow.
#[derive(Debug, Clone, Copy)]
struct Namesake {
    /// The epoch that it began with.
    began: u64,
    first: Instant,
    last: Instant,
}

impl Namesake {
    fn lives(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.last) < SILENT
    }
}

impl ControlCore {
    /// Takes what another flow said on the channel of the layer broker, as [`read_replica_message`]
    /// gives it; the server took it at `appended_ms` of its clock. Whether a topic changed by it, or
    /// it is to be answered: nothing else is in a hurry, the next tick is soon enough.
    pub fn replica_message(
        &mut self,
        now: Instant,
        message: Option<LinkControl>,
        appended_ms: Option<i64>,
    ) -> bool {
        let Some(message) = message else {
            self.replicas.refused += 1;
            return false;
        };
        let (Some(channel), Some(body)) = (message.channel, message.body) else {
            return false;
        };
        let Ok(from) = channel.from.parse::<FlowId>() else {
            self.replicas.refused += 1;
            return false;
        };
        let me = &self.config.me;
        let for_me = channel.to.is_empty() || channel.to == me.to_string();
        if from == *me && channel.began != self.replicas.began && matches!(body, Body::Hello(_)) {
            self.replicas.hear_namesake(now, channel.began);
        }
        if from == *me {
            // Not of an earlier life, which may still be on its way.
            if channel.began == self.replicas.began && matches!(body, Body::Hello(_)) {
                self.registry.on_own_hello(now, appended_ms);
            }
            return false;
        }
        if !for_me || from.layer != me.layer {
            return false;
        }
        let changed = match body {
            Body::Hello(hello) => {
                self.registry.on_layer_hello(now, &from, &hello, channel.began, appended_ms)
            }
            body => match self.of_types(&from, body) {
                Some(body) => self.registry.on_layer_control(now, &from, channel.epoch, body),
                None => return true,
            },
        };
        let any = !changed.is_empty();
        self.touch(now, changed);
        self.hurry(now);
        any || self.registry.next_poll().is_some_and(|at| at <= now)
    }

    /// The layer broker is away: that nothing is heard says nothing of who lives.
    pub fn excuse_replicas(&mut self, now: Instant) {
        self.registry.excuse_silence(now);
    }

    /// Another program that runs under the name of this flow on the layer broker. An older one
    /// counts when it is heard for some time: what it has said may still be on its way after its
    /// end.
    #[must_use]
    pub fn namesake(&self, now: Instant) -> Option<NameConflict> {
        let other = self.replicas.namesake.filter(|other| other.lives(now))?;
        let is_refused = other.began > self.replicas.began;
        let flow = self.config.me.clone();
        let goes_on = other.last.saturating_duration_since(other.first) >= SILENT;
        (is_refused || goes_on).then(|| NameConflict {
            detail: format!(
                "2 programs run under the name {flow} on one layer broker: with the epochs {} \
                    (this program) and {}",
                self.replicas.began, other.began
            ),
            is_refused,
            flow,
        })
    }

    /// Messages on the channel of the layer broker that could not be read.
    #[must_use]
    pub fn refused_replica_messages(&self) -> u64 {
        self.replicas.refused
    }

    /// Messages on that channel came faster than they could be read.
    pub fn count_replica_overrun(&mut self, messages: u64) {
        self.replicas.overrun += messages;
    }

    /// Messages on the channel of the layer broker that came faster than they could be read.
    #[must_use]
    pub fn replica_overrun(&self) -> u64 {
        self.replicas.overrun
    }

    /// Says on the channel of the layer broker that this flow goes.
    pub fn say_goodbye(&mut self) {
        if self.config.replicas.is_some() {
            let epoch = self.epoch();
            self.say(None, Body::Goodbye(Goodbye { epoch }), None);
        }
    }

    /// Whether what the flows next to this one have announced is known, or was waited for long
    /// enough.
    pub(super) fn knows_replicas(&self, now: Instant) -> bool {
        self.config.replicas.is_none()
            || self.registry.knows_replicas()
            || now.saturating_duration_since(self.started) >= LISTEN + KNOW_OTHERS
    }

    /// The next Hello goes at once.
    pub(super) fn hello_now(&mut self) {
        self.replicas.next_hello = None;
    }

    /// Says what is due on the channel. To be called after the registry was polled.
    pub(super) fn tell_replicas(&mut self, now: Instant) {
        let messages = self.registry.poll_layer();
        if self.config.replicas.is_none() {
            return;
        }
        for (to, body) in messages {
            self.say(to.as_ref(), body, None);
        }
        if self.replicas.next_hello.is_none_or(|at| at <= now) {
            self.replicas.next_hello = Some(now + HELLO_EVERY);
            let hello = Body::Hello(self.hello());
            // One that waits longer would be followed by a newer one.
            self.say(None, hello, Some(now + HELLO_EVERY));
        }
    }

    /// Topics whose carrier has changed are planned at once.
    pub(super) fn hurry(&mut self, now: Instant) {
        for topic in self.registry.take_urgent() {
            self.touch_urgent(now, &topic);
        }
    }

    fn epoch(&self) -> u64 {
        self.registry.world().own().map_or(self.config.epoch, |own| own.epoch)
    }

    fn hello(&self) -> Hello {
        let scope = self.registry.world().own().and_then(|own| own.layer_scope);
        let shown = self.config.replicas.filter(|_| scope.is_some());
        let (registry_version, registry_digest) = self.registry.announced_on_layer();
        let gateway = match self.gateways.setting(&self.config) {
            AutoBool::Auto => Gateway::Auto,
            AutoBool::Yes => Gateway::Always,
            AutoBool::No => Gateway::Never,
        };
        let load = self.balance.own;
        let ros2 = self.registry.world().own().and_then(|own| own.ros2);
        Hello {
            layer: self.config.me.layer.to_string(),
            node: self.config.me.node.to_string(),
            kind: kind_to_wire(self.config.kind).into(),
            epoch: self.epoch(),
            registry_version,
            registry_digest,
            state: State::from(self.state).into(),
            layer_scope: shown.unwrap_or(LayerScope::None).into(),
            gateway: gateway.into(),
            is_gateway: self.gateways.role().is_gateway(),
            layer_scope_id: scope.map_or(0, |id| id.0),
            egress: Some(Egress {
                demand_bytes_per_s: load.out_bytes_per_s,
                limit_bytes_per_s: load.limit_bytes_per_s,
            }),
            ingress_bytes_per_s: Some(load.in_bytes_per_s),
            link_peers: self.registry.link_peers(),
            heard_ms: self.registry.heard_ms(),
            ros2_network: ros2.map_or(0, |network| network.id.0),
            ros2_address: ros2.map(|network| network.address.to_string()).unwrap_or_default(),
            ..Hello::default()
        }
    }

    pub(super) fn say(&mut self, to: Option<&FlowId>, body: Body, deadline: Option<Instant>) {
        let message = LinkControl {
            body: Some(body),
            channel: Some(Channel {
                from: self.config.me.to_string(),
                epoch: self.epoch(),
                began: self.replicas.began,
                to: to.map(ToString::to_string).unwrap_or_default(),
            }),
        };
        self.outputs
            .push_back(Output::Replicas { body: Bytes::from(message.encode_to_vec()), deadline });
    }
}
