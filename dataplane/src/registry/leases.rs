//! Leases of the local services: who holds which, and until when.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use blaze_domain::control::{
    AdvertiseMessage, Common, ControlError, ControlMessage, ErrorCode, LeaseKind, OriginSelector,
    Quality, RequestMessage,
};
use blaze_domain::node_file::{AccessRules, TopicAccess};
use blaze_domain::{FlowId, InstanceName, LayerName, NodeName, Scope, ServiceName, TopicName};

use super::holder::{key_of, lease_of};

/// Most lapsed leases that are remembered for people who ask why a topic stopped.
const MAX_LAPSED: usize = 1024;

/// Who holds a lease of a topic. The scope belongs to it: the same service may be on both brokers
/// of a node.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct LeaseKey {
    /// Where it was received.
    pub scope: Scope,
    /// What it says.
    pub kind: LeaseKind,
    /// Layer of the holder.
    pub layer: LayerName,
    /// Node of the holder; `None` for a service of the layer that names none.
    pub node: Option<NodeName>,
    /// The holder.
    pub service: ServiceName,
    /// Its instance.
    pub instance: InstanceName,
}

impl LeaseKey {
    /// Whether the rules of its topic allow it.
    #[must_use]
    pub fn may(&self, access: &TopicAccess) -> bool {
        let node = self.node.as_ref().map_or("", NodeName::as_str);
        access.allows(self.kind, self.layer.as_str(), node, self.service.as_str())
    }
}

/// What a lease is about.
#[derive(Debug, Clone, PartialEq)]
pub enum Terms {
    /// What is published.
    Advertise {
        /// Messages per second, if told.
        rate_hz: Option<f64>,
        /// Largest payload in bytes, if told.
        max_bytes: Option<u64>,
        /// Type and quality of service.
        quality: Quality,
    },
    /// What is wanted.
    Request {
        /// Most messages per second; `None` = all.
        max_rate_hz: Option<f64>,
        /// Payloads without a header.
        bare: bool,
        /// Payloads as JSON.
        json: bool,
        /// Only messages of that origin.
        from: OriginSelector,
        /// Type and quality of service.
        quality: Quality,
    },
}

/// One lease.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Lease {
    pub(super) epoch: u64,
    pub(super) ttl_s: u32,
    pub(super) expires_at: Option<Instant>,
    pub(super) terms: Terms,
}

/// A lease as others see it.
#[derive(Debug, Clone, Copy)]
pub struct LeaseView<'a> {
    /// The topic.
    pub topic: &'a TopicName,
    /// The holder.
    pub key: &'a LeaseKey,
    /// Life of the holder.
    pub epoch: u64,
    /// Lifetime in seconds from each renewal; 0 = until withdrawn.
    pub ttl_s: u32,
    /// When it lapses; `None` = when withdrawn.
    pub expires_at: Option<Instant>,
    /// What it is about.
    pub terms: &'a Terms,
}

impl<'a> LeaseView<'a> {
    /// Time until it lapses; `None` = until withdrawn.
    #[must_use]
    pub fn expires_in(&self, now: Instant) -> Option<Duration> {
        self.expires_at.map(|at| at.saturating_duration_since(now))
    }

    /// Type and quality of service.
    #[must_use]
    pub fn quality(&self) -> &'a Quality {
        match self.terms {
            Terms::Advertise { quality, .. } | Terms::Request { quality, .. } => quality,
        }
    }

    /// The control message that makes this lease anew (leases survive a restart of their flow).
    #[must_use]
    pub fn to_message(&self) -> ControlMessage {
        let common = Common {
            topic: self.topic.clone(),
            service: self.key.service.clone(),
            instance: self.key.instance.clone(),
            layer: Some(self.key.layer.clone()),
            node: self.key.node.clone(),
            epoch: self.epoch,
            id: None,
            reply_to: None,
        };
        let ttl_s = self.ttl_s;
        match self.terms.clone() {
            Terms::Advertise { rate_hz, max_bytes, quality } => {
                ControlMessage::Advertise(AdvertiseMessage {
                    common,
                    ttl_s,
                    rate_hz,
                    max_bytes,
                    quality,
                })
            }
            Terms::Request { max_rate_hz, bare, json, from, quality } => {
                ControlMessage::Request(RequestMessage {
                    common,
                    ttl_s,
                    max_rate_hz,
                    bare,
                    json,
                    from,
                    quality,
                })
            }
        }
    }
}

/// Why a lease is missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LapseReason {
    /// It was not renewed.
    Expired,
    /// The rules of `flow.access` do not allow it.
    Denied,
    /// The flow holds as many as it can.
    TooMany,
    /// The message named another layer or node than the one where it came.
    SourceMismatch,
    /// The broker has no such names.
    NameNotExpressible,
    /// Another topic has its name on the broker.
    NameCollision,
}

/// A lease that was not renewed, or that was refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LapsedLease {
    /// The topic.
    pub topic: TopicName,
    /// Who held it.
    pub key: LeaseKey,
    /// When it lapsed.
    pub at: Instant,
    /// Why.
    pub reason: LapseReason,
    /// The facts, for people; empty where the reason says all.
    pub detail: String,
}

/// All leases of one flow, bounded.
#[derive(Default)]
pub(super) struct LeaseTable {
    pub(super) topics: BTreeMap<TopicName, BTreeMap<LeaseKey, Lease>>,
    pub(super) expiry: BTreeSet<(Instant, TopicName, LeaseKey)>,
    pub(super) count: usize,
    pub(super) limit: usize,
    lapsed: VecDeque<LapsedLease>,
    /// Scopes whose broker keeps leases.
    pub(super) stores: BTreeSet<Scope>,
    /// Leases that are to be written to or removed from the broker that keeps them.
    pub(super) unsaved: BTreeSet<(TopicName, LeaseKey)>,
    /// Scopes whose kept leases are being read.
    pub(super) reading: BTreeSet<Scope>,
    /// Leases that ended while those of their scope were being read: what is read of them is old.
    pub(super) ended: BTreeSet<(TopicName, LeaseKey)>,
    /// Scopes whose broker is away.
    pub(super) not_renewable: BTreeSet<Scope>,
}

/// What a message did to the table.
pub(super) struct Applied {
    /// Lifetime of the lease in seconds, 0 for one without end or withdrawn.
    pub(super) lease_s: u32,
    /// Whether what the topic's leases say has changed; a mere renewal does not.
    pub(super) changed: bool,
}

impl LeaseTable {
    /// A table without leases; those that the brokers of `stores` keep are still to be read.
    pub(super) fn new(limit: usize, stores: BTreeSet<Scope>) -> Self {
        Self { limit, reading: stores.clone(), stores, ..Self::default() }
    }

    pub(super) fn get<'a>(
        &'a self,
        topic: &'a TopicName,
        key: &'a LeaseKey,
    ) -> Option<LeaseView<'a>> {
        let lease = self.topics.get(topic)?.get(key)?;
        Some(view(topic, key, lease))
    }

    /// Whether any lease of the topic is of that scope.
    pub(super) fn has(&self, topic: &TopicName, scope: Scope) -> bool {
        let leases = self.topics.get(topic);
        leases.is_some_and(|leases| leases.keys().any(|key| key.scope == scope))
    }

    pub(super) fn topics(&self) -> impl Iterator<Item = &TopicName> {
        self.topics.keys()
    }

    pub(super) fn len(&self) -> usize {
        self.count
    }

    /// Grants, renews or ends leases. `pointer` begins the pointers of errors.
    pub(super) fn apply(
        &mut self,
        now: Instant,
        scope: Scope,
        me: &FlowId,
        message: &ControlMessage,
        pointer: &str,
    ) -> Result<Applied, ControlError> {
        if let ControlMessage::Withdraw(withdraw) = message {
            let kinds = withdraw.kind.as_ref().map_or(LeaseKind::ALL, std::slice::from_ref);
            let keys: Result<Vec<LeaseKey>, ControlError> = kinds
                .iter()
                .map(|kind| key_of(scope, me, *kind, &withdraw.common, pointer))
                .collect();
            return self.withdraw(&withdraw.common.topic, &keys?, withdraw.common.epoch, pointer);
        }
        let (topic, key, lease) = lease_of(now, scope, me, message, pointer)?;
        let lease_s = lease.ttl_s;
        let changed = self.grant(topic, key, lease, now, pointer)?;
        Ok(Applied { lease_s, changed })
    }

    pub(super) fn grant(
        &mut self,
        topic: &TopicName,
        key: LeaseKey,
        lease: Lease,
        now: Instant,
        pointer: &str,
    ) -> Result<bool, ControlError> {
        let held = self.topics.get(topic).and_then(|leases| leases.get(&key));
        // A mere renewal changes nothing of what is kept.
        let unsaved = held.is_none_or(|held| {
            (held.epoch, held.ttl_s) != (lease.epoch, lease.ttl_s) || held.terms != lease.terms
        });
        let changed = match held {
            Some(held) => {
                check_epoch(held, lease.epoch, pointer)?;
                if let Some(at) = held.expires_at {
                    self.expiry.remove(&(at, topic.clone(), key.clone()));
                }
                held.terms != lease.terms
            }
            None if self.count >= self.limit => {
                let detail = format!("the flow holds {} leases, its limit", self.limit);
                self.remember(LapsedLease {
                    topic: topic.clone(),
                    key,
                    at: now,
                    reason: LapseReason::TooMany,
                    detail: detail.clone(),
                });
                return Err(ControlError::new(ErrorCode::TooManyLeases, pointer, detail));
            }
            None => {
                self.count += 1;
                true
            }
        };
        if let Some(at) = lease.expires_at {
            self.expiry.insert((at, topic.clone(), key.clone()));
        }
        if self.stores.contains(&key.scope) {
            let entry = (topic.clone(), key.clone());
            self.ended.remove(&entry);
            // While those of the broker are being read nobody knows what it keeps of this one.
            if unsaved || self.reading.contains(&key.scope) {
                self.unsaved.insert(entry);
            }
        }
        self.topics.entry(topic.clone()).or_default().insert(key, lease);
        Ok(changed)
    }

    /// Ends the leases with these keys, all or none; one that does not exist is no error.
    fn withdraw(
        &mut self,
        topic: &TopicName,
        keys: &[LeaseKey],
        epoch: u64,
        pointer: &str,
    ) -> Result<Applied, ControlError> {
        if let Some(leases) = self.topics.get(topic) {
            keys.iter()
                .filter_map(|key| leases.get(key))
                .try_for_each(|held| check_epoch(held, epoch, pointer))?;
        }
        let mut changed = false;
        for key in keys {
            let removed = self.remove(topic, key);
            // One that is not known here may be among those that are still being read.
            if removed || self.reading.contains(&key.scope) {
                self.note_end(topic, key);
            }
            changed |= removed;
        }
        Ok(Applied { lease_s: 0, changed })
    }

    fn remove(&mut self, topic: &TopicName, key: &LeaseKey) -> bool {
        let Some(leases) = self.topics.get_mut(topic) else {
            return false;
        };
        let Some(lease) = leases.remove(key) else {
            return false;
        };
        if leases.is_empty() {
            self.topics.remove(topic);
        }
        if let Some(at) = lease.expires_at {
            self.expiry.remove(&(at, topic.clone(), key.clone()));
        }
        self.count -= 1;
        true
    }

    /// Ends the leases whose time has come.
    pub(super) fn expire(&mut self, now: Instant) -> Vec<LapsedLease> {
        let mut lapsed = Vec::new();
        while self.next_expiry().is_some_and(|at| at <= now) {
            let Some((at, topic, key)) = self.expiry.pop_first() else {
                break;
            };
            if self.not_renewable.contains(&key.scope) {
                self.renew(now, &topic, &key);
                continue;
            }
            self.remove(&topic, &key);
            self.note_end(&topic, &key);
            lapsed.push(LapsedLease {
                topic,
                key,
                at,
                reason: LapseReason::Expired,
                detail: String::new(),
            });
        }
        for lease in &lapsed {
            self.remember(lease.clone());
        }
        lapsed
    }

    /// Notes for people who ask that a lease is missing.
    pub(super) fn remember(&mut self, lease: LapsedLease) {
        self.lapsed.retain(|other| other.topic != lease.topic || other.key != lease.key);
        if self.lapsed.len() == MAX_LAPSED {
            self.lapsed.pop_front();
        }
        self.lapsed.push_back(lease);
    }

    /// Ends the leases that the rules do not allow. Returns them.
    pub(super) fn end_denied(&mut self, now: Instant, rules: &AccessRules) -> Vec<LapsedLease> {
        let mut denied = Vec::new();
        for (topic, leases) in &self.topics {
            let access = rules.of(topic);
            let keys = leases.keys().filter(|key| !key.may(&access));
            denied.extend(keys.map(|key| LapsedLease {
                topic: topic.clone(),
                key: key.clone(),
                at: now,
                reason: LapseReason::Denied,
                detail: String::new(),
            }));
        }
        // Who is allowed now only has to ask again.
        self.lapsed.retain(|lease| {
            lease.reason != LapseReason::Denied || !lease.key.may(&rules.of(&lease.topic))
        });
        for lease in &denied {
            self.remove(&lease.topic, &lease.key);
            self.note_end(&lease.topic, &lease.key);
            self.remember(lease.clone());
        }
        denied
    }

    pub(super) fn next_expiry(&self) -> Option<Instant> {
        self.expiry.first().map(|(at, _, _)| *at)
    }

    /// Leases that lapsed or were refused and were not made anew, newest first: what is the matter
    /// now hides what was before.
    pub(super) fn lapsed(&self, topic: &TopicName) -> impl Iterator<Item = &LapsedLease> {
        self.lapsed.iter().rev().filter(move |lease| {
            lease.topic == *topic
                && !self
                    .topics
                    .get(&lease.topic)
                    .is_some_and(|leases| leases.contains_key(&lease.key))
        })
    }

    pub(super) fn of_topic(
        &self,
        topic: &TopicName,
    ) -> impl Iterator<Item = LeaseView<'_>> + Clone {
        self.topics.get_key_value(topic).into_iter().flat_map(|(topic, leases)| {
            leases.iter().map(move |(key, lease)| view(topic, key, lease))
        })
    }

    pub(super) fn all(&self) -> impl Iterator<Item = LeaseView<'_>> {
        self.topics.iter().flat_map(|(topic, leases)| {
            leases.iter().map(move |(key, lease)| view(topic, key, lease))
        })
    }
}

fn view<'a>(topic: &'a TopicName, key: &'a LeaseKey, lease: &'a Lease) -> LeaseView<'a> {
    LeaseView {
        topic,
        key,
        epoch: lease.epoch,
        ttl_s: lease.ttl_s,
        expires_at: lease.expires_at,
        terms: &lease.terms,
    }
}

fn check_epoch(held: &Lease, epoch: u64, pointer: &str) -> Result<(), ControlError> {
    if epoch < held.epoch {
        return Err(ControlError::new(
            ErrorCode::StaleEpoch,
            format!("{pointer}/epoch"),
            format!("{epoch} is below {}, the epoch of the live lease", held.epoch),
        ));
    }
    Ok(())
}
