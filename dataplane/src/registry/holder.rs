//! From a control message to the lease that it makes, and to its holder.

use std::time::{Duration, Instant};

use blaze_domain::control::{Common, ControlError, ControlMessage, ErrorCode, LeaseKind};
use blaze_domain::{FlowId, MAX_PAYLOAD_BYTES, MAX_RATE_HZ, Scope, TopicName};

use super::leases::{Lease, LeaseKey, Terms};

/// Who holds the lease that a message is about.
pub(super) fn key_of(
    scope: Scope,
    me: &FlowId,
    kind: LeaseKind,
    common: &Common,
    pointer: &str,
) -> Result<LeaseKey, ControlError> {
    check_source(scope, me, common, pointer)?;
    Ok(key_here(scope, me, kind, common))
}

/// The same for a message that is refused: of one from elsewhere the key that it would have if it
/// was from here, so that a right one takes its place.
pub(super) fn key_here(scope: Scope, me: &FlowId, kind: LeaseKind, common: &Common) -> LeaseKey {
    LeaseKey {
        scope,
        kind,
        layer: me.layer.clone(),
        node: match scope {
            Scope::Node => Some(me.node.clone()),
            Scope::Layer | Scope::Ros2 | Scope::Inter => common.node.clone(),
        },
        service: common.service.clone(),
        instance: common.instance.clone(),
    }
}

/// The lease that a message asks for; a withdrawal and a call ask for none.
pub(super) fn kind_of(message: &ControlMessage) -> Option<LeaseKind> {
    match message {
        ControlMessage::Advertise(_) => Some(LeaseKind::Advertise),
        ControlMessage::Request(_) => Some(LeaseKind::Request),
        ControlMessage::Withdraw(_) | ControlMessage::Call(_) => None,
    }
}

/// The lease that a message grants or renews; a withdrawal and a call have none.
pub(super) fn lease_of<'m>(
    now: Instant,
    scope: Scope,
    me: &FlowId,
    message: &'m ControlMessage,
    pointer: &str,
) -> Result<(&'m TopicName, LeaseKey, Lease), ControlError> {
    let (kind, ttl_s, terms) = match message {
        ControlMessage::Advertise(message) => (
            LeaseKind::Advertise,
            message.ttl_s,
            Terms::Advertise {
                // More cannot be published, and would take the room of those who publish something.
                rate_hz: message.rate_hz.map(|hz| hz.min(MAX_RATE_HZ)),
                max_bytes: message.max_bytes.map(|bytes| bytes.min(MAX_PAYLOAD_BYTES as u64)),
                quality: message.quality.clone(),
            },
        ),
        ControlMessage::Request(message) => (
            LeaseKind::Request,
            message.ttl_s,
            Terms::Request {
                max_rate_hz: message.max_rate_hz,
                bare: message.bare,
                json: message.json,
                from: message.from.clone(),
                quality: message.quality.clone(),
            },
        ),
        ControlMessage::Withdraw(_) | ControlMessage::Call(_) => {
            let error = ControlError::new(ErrorCode::UnknownOp, pointer, "it grants nothing");
            return Err(error);
        }
    };
    let common = message.common();
    let lease = Lease {
        epoch: common.epoch,
        ttl_s,
        expires_at: (ttl_s > 0).then(|| now + Duration::from_secs(ttl_s.into())),
        terms,
    };
    Ok((&common.topic, key_of(scope, me, kind, common, pointer)?, lease))
}

/// Whoever speaks is where it was received, unless it says otherwise and may.
fn check_source(
    scope: Scope,
    me: &FlowId,
    common: &Common,
    pointer: &str,
) -> Result<(), ControlError> {
    let (field, found, here) = match (&common.layer, &common.node) {
        (Some(layer), _) if *layer != me.layer => ("layer", layer.as_str(), me.layer.as_str()),
        (_, Some(node)) if scope == Scope::Node && *node != me.node => {
            ("node", node.as_str(), me.node.as_str())
        }
        _ => return Ok(()),
    };
    Err(ControlError::new(
        ErrorCode::SourceMismatch,
        format!("{pointer}/{field}"),
        format!("{found} is not the {field} where the message was received, {here}"),
    ))
}
