//! The part of the lease table that brokers which keep leases have to do with.

use std::time::{Duration, Instant};

use blaze_domain::control::ControlMessage;
use blaze_domain::{FlowId, Scope, TopicName};

use super::holder::lease_of;
use super::leases::{LeaseKey, LeaseTable};
use super::stored::{UnsavedLease, unsaved};

/// What became of a kept lease.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Taken {
    /// It lives again.
    Restored,
    /// A service was faster.
    Newer,
    /// There is no room for it.
    Refused,
}

impl LeaseTable {
    pub(super) fn take_unsaved(&mut self) -> Vec<UnsavedLease> {
        let changed = std::mem::take(&mut self.unsaved);
        unsaved(self, changed)
    }

    pub(super) fn set_reading(&mut self, scope: Scope, reading: bool) {
        if reading && self.stores.contains(&scope) {
            self.reading.insert(scope);
        } else {
            self.reading.remove(&scope);
            self.ended.retain(|(_, key)| key.scope != scope);
        }
    }

    /// Forgets the leases of a scope, without a word to the broker that keeps them: it belongs to
    /// another flow, whose they are now. Once it is ours again they are to be read.
    pub(super) fn give_up(&mut self, scope: Scope) {
        for leases in self.topics.values_mut() {
            let before = leases.len();
            leases.retain(|key, _| key.scope != scope);
            self.count -= before - leases.len();
        }
        self.topics.retain(|_, leases| !leases.is_empty());
        self.expiry.retain(|(_, _, key)| key.scope != scope);
        self.unsaved.retain(|(_, key)| key.scope != scope);
        self.set_reading(scope, true);
    }

    pub(super) fn is_reading(&self, scope: Scope) -> bool {
        self.reading.contains(&scope)
    }

    pub(super) fn set_renewable(&mut self, now: Instant, scope: Scope, renewable: bool) {
        if !renewable {
            self.not_renewable.insert(scope);
        } else if self.not_renewable.remove(&scope) {
            let finite = self.expiry.iter().filter(|(_, _, key)| key.scope == scope);
            let finite: Vec<_> =
                finite.map(|(_, topic, key)| (topic.clone(), key.clone())).collect();
            for (topic, key) in finite {
                self.renew(now, &topic, &key);
            }
        }
    }

    /// Gives a finite lease its whole ttl.
    pub(super) fn renew(&mut self, now: Instant, topic: &TopicName, key: &LeaseKey) {
        let Some(lease) = self.topics.get_mut(topic).and_then(|leases| leases.get_mut(key)) else {
            return;
        };
        if let Some(at) = lease.expires_at {
            let until = now + Duration::from_secs(lease.ttl_s.into());
            lease.expires_at = Some(until);
            self.expiry.remove(&(at, topic.clone(), key.clone()));
            self.expiry.insert((until, topic.clone(), key.clone()));
        }
    }

    /// Takes a lease that a broker has kept, unless a service was faster.
    pub(super) fn restore(
        &mut self,
        now: Instant,
        scope: Scope,
        me: &FlowId,
        message: &ControlMessage,
    ) -> Taken {
        let Ok((topic, key, lease)) = lease_of(now, scope, me, message, "") else {
            return Taken::Refused;
        };
        let entry = (topic.clone(), key);
        if self.get(&entry.0, &entry.1).is_some() || self.ended.contains(&entry) {
            return Taken::Newer;
        }
        match self.grant(topic, entry.1.clone(), lease, now, "") {
            Ok(_) => {
                // It is there as it was written.
                self.unsaved.remove(&entry);
                Taken::Restored
            }
            Err(_) => Taken::Refused,
        }
    }

    /// A lease has ended: the broker that keeps it is to forget it.
    pub(super) fn note_end(&mut self, topic: &TopicName, key: &LeaseKey) {
        if !self.stores.contains(&key.scope) {
            return;
        }
        self.unsaved.insert((topic.clone(), key.clone()));
        if self.reading.contains(&key.scope) && self.ended.len() < self.limit {
            self.ended.insert((topic.clone(), key.clone()));
        }
    }
}
