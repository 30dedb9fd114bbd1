//! Leases of the local services: who holds which, and until when.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use blaze_domain::control::{
    AdvertiseMessage, Common, ControlError, ControlMessage, ErrorCode, LeaseKind, OriginSelector, Quality,
    RequestMessage,
};
use blaze_domain::{FlowId, InstanceName, LayerName, NodeName, Scope, ServiceName, TopicName};

use super::stored::{UnsavedLease, unsaved};

/// Most lapsed leases that are remembered for people who ask why a topic stopped.
const MAX_LAPSED: usize = 1024;

/// Who holds a lease of a topic. The scope belongs to it: the same service may be on both brokers of a node.
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
            Terms::Advertise {
                rate_hz,
                max_bytes,
                quality,
            } => ControlMessage::Advertise(AdvertiseMessage {
                common,
                ttl_s,
                rate_hz,
                max_bytes,
                quality,
            }),
            Terms::Request {
                max_rate_hz,
                bare,
                from,
                quality,
            } => ControlMessage::Request(RequestMessage {
                common,
                ttl_s,
                max_rate_hz,
                bare,
                from,
                quality,
            }),
        }
    }
}

/// A lease that was not renewed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LapsedLease {
    /// The topic.
    pub topic: TopicName,
    /// Who held it.
    pub key: LeaseKey,
    /// When it lapsed.
    pub at: Instant,
}

/// All leases of one flow, bounded.
pub(super) struct LeaseTable {
    topics: BTreeMap<TopicName, BTreeMap<LeaseKey, Lease>>,
    expiry: BTreeSet<(Instant, TopicName, LeaseKey)>,
    count: usize,
    limit: usize,
    lapsed: VecDeque<LapsedLease>,
    /// Scopes whose broker keeps leases.
    stores: BTreeSet<Scope>,
    /// Leases that are to be written to or removed from the broker that keeps them.
    unsaved: BTreeSet<(TopicName, LeaseKey)>,
    /// Scopes whose kept leases are being read.
    reading: BTreeSet<Scope>,
    /// Leases that ended while those of their scope were being read: what is read of them is old.
    ended: BTreeSet<(TopicName, LeaseKey)>,
    /// Scopes whose broker is away.
    not_renewable: BTreeSet<Scope>,
}

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
        Self {
            topics: BTreeMap::new(),
            expiry: BTreeSet::new(),
            count: 0,
            limit,
            lapsed: VecDeque::new(),
            unsaved: BTreeSet::new(),
            reading: stores.clone(),
            stores,
            ended: BTreeSet::new(),
            not_renewable: BTreeSet::new(),
        }
    }

    pub(super) fn get<'a>(&'a self, topic: &'a TopicName, key: &'a LeaseKey) -> Option<LeaseView<'a>> {
        let lease = self.topics.get(topic)?.get(key)?;
        Some(view(topic, key, lease))
    }

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

    pub(super) fn is_reading(&self, scope: Scope) -> bool {
        self.reading.contains(&scope)
    }

    pub(super) fn set_renewable(&mut self, now: Instant, scope: Scope, renewable: bool) {
        if !renewable {
            self.not_renewable.insert(scope);
        } else if self.not_renewable.remove(&scope) {
            let finite = self.expiry.iter().filter(|(_, _, key)| key.scope == scope);
            let finite: Vec<_> = finite.map(|(_, topic, key)| (topic.clone(), key.clone())).collect();
            for (topic, key) in finite {
                self.renew(now, &topic, &key);
            }
        }
    }

    /// Gives a finite lease its whole ttl.
    fn renew(&mut self, now: Instant, topic: &TopicName, key: &LeaseKey) {
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

    /// Whether any lease of the topic is of that scope.
    pub(super) fn has(&self, topic: &TopicName, scope: Scope) -> bool {
        let leases = self.topics.get(topic);
        leases.is_some_and(|leases| leases.keys().any(|key| key.scope == scope))
    }

    pub(super) fn topics(&self) -> impl Iterator<Item = &TopicName> {
        self.topics.keys()
    }

    /// Takes a lease that a broker has kept, unless a service was faster.
    pub(super) fn restore(&mut self, now: Instant, scope: Scope, me: &FlowId, message: &ControlMessage) -> Taken {
        let Ok((topic, key, lease)) = lease_of(now, scope, me, message, "") else {
            return Taken::Refused;
        };
        let entry = (topic.clone(), key);
        if self.get(&entry.0, &entry.1).is_some() || self.ended.contains(&entry) {
            return Taken::Newer;
        }
        match self.grant(topic, entry.1.clone(), lease, "") {
            Ok(_) => {
                // It is there as it was written.
                self.unsaved.remove(&entry);
                Taken::Restored
            }
            Err(_) => Taken::Refused,
        }
    }

    /// A lease has ended: the broker that keeps it is to forget it.
    fn note_end(&mut self, topic: &TopicName, key: &LeaseKey) {
        if !self.stores.contains(&key.scope) {
            return;
        }
        self.unsaved.insert((topic.clone(), key.clone()));
        if self.reading.contains(&key.scope) && self.ended.len() < self.limit {
            self.ended.insert((topic.clone(), key.clone()));
        }
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
        let changed = self.grant(topic, key, lease, pointer)?;
        Ok(Applied { lease_s, changed })
    }

    fn grant(&mut self, topic: &TopicName, key: LeaseKey, lease: Lease, pointer: &str) -> Result<bool, ControlError> {
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
                return Err(ControlError::new(
                    ErrorCode::TooManyLeases,
                    pointer,
                    format!("the flow holds {} leases, its limit", self.limit),
                ));
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
            lapsed.push(LapsedLease { topic, key, at });
        }
        for lease in &lapsed {
            if self.lapsed.len() == MAX_LAPSED {
                self.lapsed.pop_front();
            }
            self.lapsed.push_back(lease.clone());
        }
        lapsed
    }

    pub(super) fn next_expiry(&self) -> Option<Instant> {
        self.expiry.first().map(|(at, _, _)| *at)
    }

    /// Leases that lapsed and were not made anew, oldest first.
    pub(super) fn lapsed(&self, topic: &TopicName) -> impl Iterator<Item = &LapsedLease> {
        self.lapsed.iter().filter(move |lease| {
            lease.topic == *topic
                && !self
                    .topics
                    .get(&lease.topic)
                    .is_some_and(|leases| leases.contains_key(&lease.key))
        })
    }

    pub(super) fn of_topic(&self, topic: &TopicName) -> impl Iterator<Item = LeaseView<'_>> + Clone {
        self.topics
            .get_key_value(topic)
            .into_iter()
            .flat_map(|(topic, leases)| leases.iter().map(move |(key, lease)| view(topic, key, lease)))
    }

    pub(super) fn all(&self) -> impl Iterator<Item = LeaseView<'_>> {
        self.topics
            .iter()
            .flat_map(|(topic, leases)| leases.iter().map(move |(key, lease)| view(topic, key, lease)))
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

/// Who holds the lease that a message is about.
fn key_of(
    scope: Scope,
    me: &FlowId,
    kind: LeaseKind,
    common: &Common,
    pointer: &str,
) -> Result<LeaseKey, ControlError> {
    let (layer, node) = holder(scope, me, common, pointer)?;
    Ok(LeaseKey {
        scope,
        kind,
        layer,
        node,
        service: common.service.clone(),
        instance: common.instance.clone(),
    })
}

/// The lease that a message grants or renews; a withdrawal has none.
fn lease_of<'m>(
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
                rate_hz: message.rate_hz,
                max_bytes: message.max_bytes,
                quality: message.quality.clone(),
            },
        ),
        ControlMessage::Request(message) => (
            LeaseKind::Request,
            message.ttl_s,
            Terms::Request {
                max_rate_hz: message.max_rate_hz,
                bare: message.bare,
                from: message.from.clone(),
                quality: message.quality.clone(),
            },
        ),
        ControlMessage::Withdraw(_) => {
            let error = ControlError::new(ErrorCode::UnknownOp, pointer, "a withdrawal grants nothing");
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

/// Layer and node of whoever speaks: where it was received, unless it says otherwise and may.
pub(super) fn holder(
    scope: Scope,
    me: &FlowId,
    common: &Common,
    pointer: &str,
) -> Result<(LayerName, Option<NodeName>), ControlError> {
    let mismatch = |field: &str, found: &str, here: &str| {
        Err(ControlError::new(
            ErrorCode::SourceMismatch,
            format!("{pointer}/{field}"),
            format!("{found} is not the {field} where the message was received, {here}"),
        ))
    };
    match &common.layer {
        Some(layer) if *layer != me.layer => return mismatch("layer", layer.as_str(), me.layer.as_str()),
        _ => {}
    }
    match (scope, &common.node) {
        (Scope::Node, Some(node)) if *node != me.node => mismatch("node", node.as_str(), me.node.as_str()),
        (Scope::Node, _) => Ok((me.layer.clone(), Some(me.node.clone()))),
        (Scope::Layer | Scope::Inter, node) => Ok((me.layer.clone(), node.clone())),
    }
}
