//! Leases that a broker keeps, so that they survive a restart of the flow and of the broker.
//!
//! ```text
//! granted, withdrawn, lapsed ─► Registry::take_unsaved ─► key and value to write, or key to remove
//! key and value, read at the start ─► Registry::restore ─► lease with its whole ttl, unless a service was faster
//! ```
//!
//! The value is the control message that makes the lease, so it does not change when the lease is
//! renewed.

use std::collections::BTreeSet;
use std::fmt;
use std::time::Instant;

use blaze_domain::control::{ControlMessage, parse_payload};
use blaze_domain::{FlowId, NodeName, Scope, TopicName};
use bytes::Bytes;

use super::Registry;
use super::holder::{key_of, kind_of};
use super::kept::Taken;
use super::leases::{LeaseKey, LeaseTable};

/// What a broker is to do to the leases that it keeps.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnsavedLease {
    /// The scope whose broker keeps it.
    pub scope: Scope,
    /// `kind|topic|layer|node|service|instance`; an absent node is empty.
    pub key: String,
    /// The control message as JSON; `None` = the lease is no more.
    pub value: Option<Bytes>,
}

/// What became of the leases that a broker had kept.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Restored {
    /// Topics whose own entry in the world changed.
    pub changed: BTreeSet<TopicName>,
    /// Topics of the restored leases.
    pub topics: BTreeSet<TopicName>,
    /// Leases that live again.
    pub restored: u64,
    /// Leases that a service had renewed or ended before they were read.
    pub newer: u64,
    /// Leases of another node or layer, which are left alone.
    pub foreign: u64,
    /// What is no lease of this version, and what is beyond bounds; left alone.
    pub skipped: u64,
}

/// The key under which a broker keeps a lease.
pub(super) struct StoredKey<'a>(pub(super) &'a TopicName, pub(super) &'a LeaseKey);

impl fmt::Display for StoredKey<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(topic, key) = self;
        let node = key.node.as_ref().map_or("", NodeName::as_str);
        let (kind, layer, service, instance) = (key.kind, &key.layer, &key.service, &key.instance);
        write!(f, "{kind}|{topic}|{layer}|{node}|{service}|{instance}")
    }
}

enum Kept {
    Ours(Box<ControlMessage>),
    Foreign,
    Unreadable,
}

/// What a kept lease says, if it is one of this flow.
fn read(scope: Scope, me: &FlowId, key: &str, value: &[u8]) -> Kept {
    let parts: Vec<&str> = key.split('|').collect();
    let &[_, _, layer, node, _, _] = parts.as_slice() else {
        return Kept::Unreadable;
    };
    if layer != me.layer.as_str() || (scope == Scope::Node && node != me.node.as_str()) {
        return Kept::Foreign;
    }
    let objects = parse_payload(value).unwrap_or_default();
    let [object] = objects.as_slice() else {
        return Kept::Unreadable;
    };
    match &object.message {
        Ok(message) if is_under(scope, me, message, key) => Kept::Ours(Box::new(message.clone())),
        _ => Kept::Unreadable,
    }
}

/// Whether a message makes the lease that it is kept as.
fn is_under(scope: Scope, me: &FlowId, message: &ControlMessage, key: &str) -> bool {
    let Some(kind) = kind_of(message) else { return false };
    let common = message.common();
    let found = key_of(scope, me, kind, common, "");
    found.is_ok_and(|found| StoredKey(&common.topic, &found).to_string() == key)
}

impl Registry {
    /// What has changed in the leases that brokers keep, since the last call.
    pub fn take_unsaved(&mut self) -> Vec<UnsavedLease> {
        self.leases.take_unsaved()
    }

    /// Takes the leases that the broker of a scope has kept, each with its whole ttl. One that a
    /// service has renewed or ended meanwhile is left as it is. From then on the leases of that
    /// scope are known to be complete.
    pub fn restore(&mut self, now: Instant, scope: Scope, kept: &[(String, Bytes)]) -> Restored {
        let mut outcome = Restored::default();
        for (key, value) in kept {
            let message = match read(scope, &self.config.me, key, value) {
                Kept::Ours(message) => message,
                Kept::Foreign => {
                    outcome.foreign += 1;
                    continue;
                }
                Kept::Unreadable => {
                    outcome.skipped += 1;
                    tracing::warn!(
                        %scope,
                        key = short(key),
                        "a kept lease cannot be read and is left alone",
                    );
                    continue;
                }
            };
            let topic = message.common().topic.clone();
            if let Err(denied) = self.check_access(now, scope, &message, "") {
                tracing::warn!(%scope, %topic, detail = denied.detail, "a kept lease is not taken");
                outcome.skipped += 1;
                continue;
            }
            let granted = match self.claim_name(scope, &topic) {
                Ok(()) => self.leases.restore(now, scope, &self.config.me, &message),
                Err(fault) => {
                    tracing::warn!(%scope, %topic, %fault, "a kept lease is not taken");
                    Taken::Refused
                }
            };
            match granted {
                Taken::Restored => {
                    outcome.restored += 1;
                    outcome.topics.insert(topic);
                }
                Taken::Newer => outcome.newer += 1,
                Taken::Refused => outcome.skipped += 1,
            }
        }
        self.leases.set_reading(scope, false);
        outcome.changed = self.refresh(now, outcome.topics.clone());
        outcome
    }

    /// Nobody can renew leases of a scope while its broker is away, so none lapses; when it is
    /// back, each finite one has its whole ttl.
    pub fn set_renewable(&mut self, now: Instant, scope: Scope, renewable: bool) {
        self.leases.set_renewable(now, scope, renewable);
    }
}

/// A text of unknown origin, cut for the log.
fn short(text: &str) -> String {
    text.chars().take(100).collect()
}

/// Leases to write, from those that changed.
pub(super) fn unsaved(
    table: &LeaseTable,
    changed: BTreeSet<(TopicName, LeaseKey)>,
) -> Vec<UnsavedLease> {
    let entry = |(topic, key): (TopicName, LeaseKey)| UnsavedLease {
        scope: key.scope,
        key: StoredKey(&topic, &key).to_string(),
        value: table
            .get(&topic, &key)
            .map(|lease| Bytes::from(lease.to_message().to_json().to_string())),
    };
    changed.into_iter().map(entry).collect()
}
