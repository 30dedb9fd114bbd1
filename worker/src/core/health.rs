//! How services say they are: of each the last word, for as long as it counts.
//!
//! ```text
//! blaze/config/ack  ─ConfigAck───▶┌───────┐──▶ rows: who runs with what          (the main service, the admin port)
//! blaze/watchdog    ─ServiceState▶│ Signs │
//! blaze:watchdog:…  ─scan────────▶└───────┘──▶ Complaint: rejected, unhealthy, lost     ([`super::Gate`] judges them)
//! ```
//!
//! A sign of life that does not come back is lost only if the worker could have heard it: an outage
//! of the broker or of the Redis is no fault of a service.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use blaze_domain::NodeName;
use blaze_domain::config::AckStatus;

use super::messages::{ConfigAck, DEFAULT_TTL_MS, Health, ServiceState, WatchdogKey};
use super::served_target::{ServedTarget, Site};

/// Instances that are known, at most; more are counted and not known.
pub const MAX_SIGNS: usize = 10_000;
/// How long the word of an instance without a watchdog is shown. Those who ask again do so every 60
/// s.
const ACK_FOR: Duration = Duration::from_secs(180);
/// How long a record of Redis is shown after the last look that found it, while nobody can look.
const RECORD_FOR: Duration = Duration::from_secs(60);
/// What is told of a complaint's detail, in characters.
const MAX_DETAIL: usize = 200;

/// What speaks against the configuration of a place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trouble {
    /// The service does not take it.
    Rejected,
    /// The service does not run well.
    Unhealthy,
    /// It said that it is alive, and does not any more.
    Lost,
}

/// That something speaks against the configuration of a place.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Complaint {
    /// Whose configuration.
    pub place: ServedTarget,
    /// What.
    pub trouble: Trouble,
    /// Which configuration, if that is said.
    pub hash: Option<String>,
    /// Its revision, if that is said.
    pub revision: Option<u64>,
    /// For people; at most 200 characters.
    pub detail: String,
}

/// How an instance is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Row {
    /// How it is.
    pub health: Health,
    /// Revision of the configuration that it runs with; 0: not known.
    pub config_revision: u64,
    /// Hash of the configuration that it runs with; empty: not known.
    pub config_hash: String,
}

/// Where a word came from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Origin {
    Message,
    Redis,
    Ack,
}

#[derive(Debug)]
struct Known {
    row: Row,
    origin: Origin,
    /// Number of the life that said it.
    epoch: u64,
    /// How long a message counts.
    ttl: Duration,
    until: Instant,
}

/// How the services of a site are.
#[derive(Debug)]
pub struct Signs {
    site: Site,
    known: BTreeMap<WatchdogKey, Known>,
    /// Whether a row is another one since this was last asked.
    is_changed: bool,
    left_out: u64,
}

impl Signs {
    /// Nobody has said anything.
    #[must_use]
    pub fn new(site: Site) -> Self {
        Self { site, known: BTreeMap::new(), is_changed: false, left_out: 0 }
    }

    /// Takes what a service says about its configuration.
    pub fn acked(&mut self, ack: ConfigAck, now: Instant) -> Option<Complaint> {
        let node = match (&self.site.node, ack.node) {
            (Some(own), Some(node)) if *own != node => return None,
            (Some(own), _) => Some(own.clone()),
            (None, node) => node,
        };
        if let (Some(node), Some(instance)) = (&node, &ack.instance) {
            let key = WatchdogKey {
                service: ack.service.clone(),
                node: node.clone(),
                instance: instance.clone(),
            };
            let words = (ack.revision, ack.hash.as_deref());
            self.note_ack(key, ack.status, words, now);
        }
        let trouble = match ack.status {
            AckStatus::Applied | AckStatus::Healthy => return None,
            AckStatus::Rejected => Trouble::Rejected,
            AckStatus::Unhealthy => Trouble::Unhealthy,
        };
        Some(Complaint {
            place: ServedTarget { service: ack.service, instance: ack.instance, node },
            trouble,
            hash: ack.hash,
            revision: ack.revision,
            detail: ack.detail.chars().take(MAX_DETAIL).collect(),
        })
    }

    /// The word of an instance without a watchdog; one that has a watchdog says more by that.
    fn note_ack(
        &mut self,
        key: WatchdogKey,
        status: AckStatus,
        said: (Option<u64>, Option<&str>),
        now: Instant,
    ) {
        let old = self.known.get(&key);
        if old.is_some_and(|known| known.origin != Origin::Ack) {
            return;
        }
        let (config_revision, config_hash) = match (status, old) {
            // It goes on with the configuration before.
            (AckStatus::Rejected, Some(old)) => {
                (old.row.config_revision, old.row.config_hash.clone())
            }
            (AckStatus::Rejected, None) => (0, String::new()),
            (AckStatus::Applied | AckStatus::Healthy | AckStatus::Unhealthy, _) => {
                (said.0.unwrap_or(0), said.1.unwrap_or_default().to_owned())
            }
        };
        let row = Row {
            health: match status {
                AckStatus::Applied | AckStatus::Healthy => Health::Ready,
                AckStatus::Rejected | AckStatus::Unhealthy => Health::Unhealthy,
            },
            config_revision,
            config_hash,
        };
        let known =
            Known { row, origin: Origin::Ack, epoch: 0, ttl: ACK_FOR, until: now + ACK_FOR };
        self.put(key, known);
    }

    /// Takes a message of `blaze/watchdog`.
    pub fn beat(&mut self, state: ServiceState, now: Instant) -> Option<Complaint> {
        self.living(state, Origin::Message, now)
    }

    /// Takes the records that were found in Redis; `is_whole`: those that are not among them are
    /// not there.
    pub fn scanned(
        &mut self,
        states: Vec<ServiceState>,
        is_whole: bool,
        now: Instant,
    ) -> Vec<Complaint> {
        let mut out = Vec::new();
        let mut found = BTreeSet::new();
        for state in states {
            found.insert(state.key.clone());
            out.extend(self.living(state, Origin::Redis, now));
        }
        if is_whole {
            let is_gone = |key: &WatchdogKey, known: &Known| {
                known.origin == Origin::Redis && !found.contains(key)
            };
            out.extend(self.take_out(is_gone).into_iter().map(|(key, _)| lost(key)));
        }
        out
    }

    fn living(&mut self, state: ServiceState, origin: Origin, now: Instant) -> Option<Complaint> {
        let is_elsewhere = self.site.node.as_ref().is_some_and(|own| *own != state.key.node)
            || state.layer.is_some_and(|layer| layer != self.site.layer);
        let is_older = |known: &Known| known.origin != Origin::Ack && known.epoch > state.epoch;
        if is_elsewhere || self.known.get(&state.key).is_some_and(is_older) {
            return None;
        }
        let ttl = Duration::from_millis(state.ttl_ms);
        let counts_for = match origin {
            Origin::Message => ttl,
            Origin::Redis => RECORD_FOR,
            Origin::Ack => ACK_FOR,
        };
        let known = Known {
            row: Row {
                health: state.health,
                config_revision: state.config_revision,
                config_hash: state.config_hash,
            },
            origin,
            epoch: state.epoch,
            ttl,
            until: now + counts_for,
        };
        let complaint = match state.health {
            Health::Unhealthy => {
                Some(Complaint { trouble: Trouble::Unhealthy, ..lost(state.key.clone()) })
            }
            Health::Starting | Health::Ready | Health::Stopping => None,
        };
        self.put(state.key, known);
        complaint
    }

    fn put(&mut self, key: WatchdogKey, known: Known) {
        if let Some(held) = self.known.get_mut(&key) {
            self.is_changed |= held.row != known.row;
            *held = known;
        } else if self.known.len() < MAX_SIGNS {
            self.is_changed = true;
            self.known.insert(key, known);
        } else {
            self.left_out += 1;
        }
    }

    /// The broker is away, or was until now: what could not be heard is not lost.
    pub fn deaf(&mut self, now: Instant) {
        for known in self.known.values_mut().filter(|known| known.origin == Origin::Message) {
            // A service that says it often may still need its usual time to find the broker again.
            let patience = known.ttl.max(Duration::from_millis(DEFAULT_TTL_MS));
            known.until = known.until.max(now + patience);
        }
    }

    /// Forgets what counts no longer. To be called about once a second.
    pub fn expire(&mut self, now: Instant) -> Vec<Complaint> {
        let gone = self.take_out(|_, known| known.until <= now);
        let lost = gone.into_iter().filter_map(|(key, known)| match known.origin {
            Origin::Message => Some(lost(key)),
            // Nobody said that it would say it again, or nobody could look.
            Origin::Redis | Origin::Ack => None,
        });
        lost.collect()
    }

    fn take_out(
        &mut self,
        is_gone: impl Fn(&WatchdogKey, &Known) -> bool,
    ) -> Vec<(WatchdogKey, Known)> {
        let gone: Vec<_> = self.known.extract_if(.., |key, known| is_gone(key, known)).collect();
        self.is_changed |= !gone.is_empty();
        gone
    }

    /// How the instances are, in the order of their services.
    pub fn rows(&self) -> impl Iterator<Item = (&WatchdogKey, &Row)> {
        self.known.iter().map(|(key, known)| (key, &known.row))
    }

    /// How the instance of a place is.
    #[must_use]
    pub fn of(&self, place: &ServedTarget) -> Option<&Row> {
        let key = WatchdogKey {
            service: place.service.clone(),
            node: place.node.clone()?,
            instance: place.instance.clone()?,
        };
        self.known.get(&key).map(|known| &known.row)
    }

    /// Whether an instance on a node has said anything here.
    #[must_use]
    pub fn is_heard_from(&self, node: &NodeName) -> bool {
        self.known.keys().any(|key| key.node == *node)
    }

    /// Whether a row is another one since this was last asked.
    pub fn take_changed(&mut self) -> bool {
        std::mem::take(&mut self.is_changed)
    }

    /// Words that were not kept because too many instances are known.
    #[must_use]
    pub fn left_out(&self) -> u64 {
        self.left_out
    }
}

fn lost(key: WatchdogKey) -> Complaint {
    Complaint {
        place: ServedTarget {
            service: key.service,
            instance: Some(key.instance),
            node: Some(key.node),
        },
        trouble: Trouble::Lost,
        hash: None,
        revision: None,
        detail: String::new(),
    }
}

#[cfg(test)]
#[path = "health_tests.rs"]
mod tests;
