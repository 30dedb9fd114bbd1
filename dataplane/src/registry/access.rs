//! Who may advertise and request what: the rules of `flow.access`, where leases are granted.

use std::time::Instant;

use blaze_domain::control::{ControlError, ControlMessage, ErrorCode, EventKind, LeaseKind};
use blaze_domain::node_file::{AccessRules, TopicAccess};
use blaze_domain::{Scope, TopicName};

use super::Registry;
use super::holder::key_of;
use super::leases::{LapseReason, LapsedLease, LeaseKey};
use super::types::{Changes, EventDraft};

impl Registry {
    /// What the rules say of a topic.
    #[must_use]
    pub fn access_of(&self, topic: &TopicName) -> TopicAccess {
        self.config.access.of(topic)
    }

    /// Changes the rules. Leases that they do not allow end.
    pub fn set_access(&mut self, now: Instant, access: AccessRules) -> Changes {
        self.config.access = access;
        let denied = self.leases.end_denied(now, &self.config.access);
        let events = denied.iter().map(|lease| EventDraft {
            event: EventKind::LeaseRefused,
            topic: Some(lease.topic.clone()),
            code: ErrorCode::AccessDenied.as_str(),
            detail: self.denial(&lease.topic, &lease.key),
        });
        let events = events.collect();
        let changed = self.refresh(now, denied.iter().map(|lease| lease.topic.clone()).collect());
        Changes {
            events,
            changed,
            lapsed: denied,
        }
    }

    /// Whether whoever sends a message may have the lease that it asks for.
    pub(super) fn check_access(
        &mut self,
        now: Instant,
        scope: Scope,
        message: &ControlMessage,
        pointer: &str,
    ) -> Result<(), ControlError> {
        let kind = match message {
            ControlMessage::Advertise(_) => LeaseKind::Advertise,
            ControlMessage::Request(_) => LeaseKind::Request,
            // Whoever may have nothing may still give it back.
            ControlMessage::Withdraw(_) => return Ok(()),
        };
        let common = message.common();
        let key = key_of(scope, &self.config.me, kind, common, pointer)?;
        if key.may(&self.config.access.of(&common.topic)) {
            return Ok(());
        }
        let detail = self.denial(&common.topic, &key);
        self.leases.remember(LapsedLease {
            topic: common.topic.clone(),
            key,
            at: now,
            reason: LapseReason::Denied,
        });
        Err(ControlError::new(
            ErrorCode::AccessDenied,
            format!("{pointer}/service"),
            detail,
        ))
    }

    fn denial(&self, topic: &TopicName, key: &LeaseKey) -> String {
        let node = key.node.as_ref().map_or_else(String::new, ToString::to_string);
        format!(
            "{}/{node}/{} may not {} {topic}: the rules flow.access of {} do not allow it",
            key.layer, key.service, key.kind, self.config.me
        )
    }
}
