//! The registry as its owner drives it.

mod control;
mod found;
mod gateways;
mod replicas;
mod stored;
mod sync;

use std::time::Duration;

use blaze_domain::control::{AdvertiseMessage, ControlMessage, RequestMessage};
use blaze_domain::node_file::AccessRules;
use blaze_proto::link::link_control::{Hello, State};
use serde_json::{Value, json};

use super::*;
use crate::link::kind_to_wire;
use crate::world::LayerScopeId;

fn config(me: &str, epoch: u64, started: Instant) -> RegistryConfig {
    let me: FlowId = me.parse().unwrap();
    RegistryConfig {
        kind: me.layer.as_str().parse().unwrap(),
        me,
        epoch,
        node_scope: true,
        layer_scope: Some(LayerScopeId(9)),
        max_leases: 10_000,
        layer_answers_need_id: true,
        layer_names: LayerNames::Any,
        lease_stores: BTreeSet::new(),
        access: AccessRules::default(),
        started,
    }
}

fn topic(text: &str) -> TopicName {
    text.parse().unwrap()
}

/// The Hello that a registry's flow would send.
fn hello(registry: &Registry) -> Hello {
    let own = registry.world().own().unwrap();
    let (registry_version, registry_digest) = registry.announced();
    Hello {
        layer: registry.world().me.layer.to_string(),
        node: registry.world().me.node.to_string(),
        kind: kind_to_wire(own.kind).into(),
        epoch: own.epoch,
        registry_version,
        registry_digest,
        state: State::Ready.into(),
        layer_scope_id: own.layer_scope.map_or(0, |id| id.0),
        ..Hello::default()
    }
}

/// A lease that stays until it is withdrawn.
fn lease(op: &str, topic: &str, service: &str) -> Value {
    json!({"op": op, "topic": topic, "service": service, "ttl_s": 0})
}

fn say(registry: &mut Registry, now: Instant, scope: Scope, message: &Value) -> ControlOutcome {
    registry.control(now, scope, message.to_string().as_bytes())
}
