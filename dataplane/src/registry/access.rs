//! Who may advertise and request what: the rules of `flow.access`, where leases are granted. What
//! is refused is remembered for people who ask.

use std::time::Instant;

use blaze_domain::control::{ControlError, ControlMessage, ErrorCode, EventKind};
use blaze_domain::node_file::{AccessRules, TopicAccess};
use blaze_domain::{Scope, TopicName};

use super::Registry;
use super::holder::{key_here, key_of, kind_of};
use super::leases::{LapseReason, LapsedLease, LeaseKey};
use super::names::NameFault;
use super::types::{Changes, EventDraft};

impl Registry {
    /// What the rules say of a topic.
    #[must_use]
    pub fn access_of(&self, topic: &TopicName) -> TopicAccess {
        self.world.access.of(topic)
    }

    /// Changes the rules. Leases that they do not allow end. All topics are to be planned anew: the
    /// rules hold for requesters of other flows, too.
    pub fn set_access(&mut self, now: Instant, access: AccessRules) -> Changes {
        self.world.access = access;
        let denied = self.leases.end_denied(now, &self.world.access);
        let events = denied.iter().map(|lease| EventDraft {
            event: EventKind::LeaseRefused,
            topic: Some(lease.topic.clone()),
            code: ErrorCode::AccessDenied.as_str(),
            detail: self.denial(&lease.topic, &lease.key),
        });
        let events = events.collect();
        let leased = denied.iter().map(|lease| &lease.topic);
        let changed = leased.chain(self.found.topics()).cloned().collect();
        let changed = self.refresh(now, changed);
        Changes { events, changed, lapsed: denied }
    }

    /// Whether whoever sends a message is where it came from, and may have the lease that it asks
    /// for.
    pub(super) fn check_access(
        &mut self,
        now: Instant,
        scope: Scope,
        message: &ControlMessage,
        pointer: &str,
    ) -> Result<(), ControlError> {
        let Some(kind) = kind_of(message) else {
            // Whoever may have nothing may still give it back.
            return Ok(());
        };
        let common = message.common();
        let key = match key_of(scope, &self.config.me, kind, common, pointer) {
            Ok(key) => key,
            Err(elsewhere) => {
                let key = key_here(scope, &self.config.me, kind, common);
                self.note_refused(
                    now,
                    &common.topic,
                    key,
                    LapseReason::SourceMismatch,
                    &elsewhere.detail,
                );
                return Err(elsewhere);
            }
        };
        if key.may(&self.access_of(&common.topic)) {
            return Ok(());
        }
        let detail = self.denial(&common.topic, &key);
        self.note_refused(now, &common.topic, key, LapseReason::Denied, &detail);
        Err(ControlError::new(ErrorCode::AccessDenied, format!("{pointer}/service"), detail))
    }

    /// Takes the topic's name on the broker that a message came from, for the lease that it asks
    /// for.
    pub(super) fn check_name(
        &mut self,
        now: Instant,
        scope: Scope,
        message: &ControlMessage,
        pointer: &str,
    ) -> Result<(), ControlError> {
        let Some(kind) = kind_of(message) else {
            return Ok(());
        };
        let common = message.common();
        let Err(fault) = self.claim_name(scope, &common.topic) else {
            return Ok(());
        };
        let (code, reason) = match fault {
            NameFault::TooLong { .. } | NameFault::Kept { .. } => {
                (ErrorCode::NameNotExpressible, LapseReason::NameNotExpressible)
            }
            NameFault::Collision { .. } => (ErrorCode::NameCollision, LapseReason::NameCollision),
        };
        let detail = fault.to_string();
        let key = key_here(scope, &self.config.me, kind, common);
        self.note_refused(now, &common.topic, key, reason, &detail);
        Err(ControlError::new(code, format!("{pointer}/topic"), detail))
    }

    fn note_refused(
        &mut self,
        now: Instant,
        topic: &TopicName,
        key: LeaseKey,
        reason: LapseReason,
        detail: &str,
    ) {
        self.leases.remember(LapsedLease {
            topic: topic.clone(),
            key,
            at: now,
            reason,
            detail: detail.to_owned(),
        });
    }

    fn denial(&self, topic: &TopicName, key: &LeaseKey) -> String {
        let node = key.node.as_ref().map_or_else(String::new, ToString::to_string);
        format!(
            "{}/{node}/{} may not {} {topic}: the rules flow.access of {} do not allow it",
            key.layer, key.service, key.kind, self.config.me
        )
    }
}
