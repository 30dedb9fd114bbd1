//! Signs of life of services, and what follows from those that are missing.

use std::collections::BTreeMap;
use std::time::Instant;

use blaze_domain::config::ServiceState;

use super::Moment;
use super::codes::Scope;
use super::inputs::{ConfigState, ServiceInput};
use super::limits::{EXPIRY_MARGIN, FORGET_GONE, MAX_SERVICES, RENEW_GRACE, UNKNOWN_AFTER};
use super::tracker::Condition;

#[derive(Debug)]
struct Known {
    last: ServiceInput,
    seen: Instant,
}

impl Known {
    /// A record that vanished before it could expire was deleted: the service ended cleanly.
    fn ended(&self, now: Instant) -> bool {
        let silent = now.saturating_duration_since(self.seen);
        silent + EXPIRY_MARGIN < self.last.expires_in
            || self.last.state == ServiceState::Stopping
            || silent >= FORGET_GONE
    }
}

/// The services of this node.
#[derive(Debug, Default)]
pub(super) struct Services {
    known: BTreeMap<(String, String), Known>,
    /// Since when signs of life cannot be read.
    unreadable: Option<Instant>,
    /// When the last outage of the signs of life ended.
    recovered: Option<Instant>,
    /// Instances for which there is no room.
    pub(super) left_out: usize,
}

impl Services {
    /// Takes all signs of life; without them nothing is known and nothing is found.
    pub(super) fn update(&mut self, now: Moment, signs: Option<&[ServiceInput]>) -> Vec<Condition> {
        let Some(signs) = signs else {
            self.unreadable.get_or_insert(now.at);
            return Vec::new();
        };
        if self.unreadable.take().is_some() {
            self.recovered = Some(now.at);
        }
        self.note(now.at, signs);
        self.known.retain(|_, known| known.seen == now.at || !known.ended(now.at));
        // What expired while nobody could renew it has some time to come back.
        let recovered = self.recovered.map(|when| now.at.saturating_duration_since(when));
        let is_grace = recovered.is_some_and(|since| since < RENEW_GRACE);
        let known = self.known.values().filter(|known| known.seen == now.at || !is_grace);
        known.flat_map(|known| of_service(known, now.at)).flatten().collect()
    }

    fn note(&mut self, now: Instant, signs: &[ServiceInput]) {
        self.left_out = 0;
        for sign in signs {
            let key = (sign.service.clone(), sign.instance.clone());
            if self.known.len() >= MAX_SERVICES && !self.known.contains_key(&key) {
                self.left_out += 1;
                continue;
            }
            self.known.insert(key, Known { last: sign.clone(), seen: now });
        }
    }

    /// Whether signs of life could not be read for so long that states are unknown.
    pub(super) fn is_unknown(&self, now: Instant) -> bool {
        let unreadable = self.unreadable.map(|since| now.saturating_duration_since(since));
        unreadable.is_some_and(|unreadable| unreadable >= UNKNOWN_AFTER)
    }

    /// Service and instance of all that are known.
    pub(super) fn names(&self) -> impl Iterator<Item = &(String, String)> {
        self.known.keys()
    }
}

fn of_service(known: &Known, now: Instant) -> Vec<Option<Condition>> {
    let name = known.last.name();
    let one = |code, detail| Condition::new(Scope::Service, code, &name, detail);
    if known.seen != now {
        let silent = now.saturating_duration_since(known.seen).as_secs();
        return vec![one("service_gone", format!("no sign of life for {silent} s"))];
    }
    let state = match known.last.state {
        ServiceState::Unhealthy => one("service_unhealthy", "it reports `unhealthy`".to_owned()),
        ServiceState::Starting => one("service_starting", "it reports `starting`".to_owned()),
        ServiceState::Ready | ServiceState::Stopping => None,
    };
    let config = match &known.last.config {
        ConfigState::Unknown | ConfigState::Current => None,
        ConfigState::Rejected(reason) => one("config_rejected", reason.clone()),
        ConfigState::Stale { has, delivered } => {
            one("config_stale", format!("runs with revision {has}, {delivered} was delivered"))
        }
    };
    vec![state, config]
}
