//! Who is ready, of those that a service waits for.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use blaze_brokers::redis::Record;
use blaze_domain::ServiceName;
use blaze_domain::config::ServiceState;

use super::record::Heard;

/// Instances that are remembered while a service waits, at most.
const MAX_INSTANCES: usize = 4_096;

/// Whether a record says that its instance is ready.
pub(super) fn is_ready(record: &Record) -> bool {
    record.get("state").is_some_and(|state| state == ServiceState::Ready.as_str())
}

/// What was heard of the instances of those that are waited for.
pub(super) struct Roll {
    services: BTreeSet<ServiceName>,
    /// Of each instance (service, node, instance): its epoch, and until when it counts as ready.
    instances: BTreeMap<(String, String, String), (u64, Option<Instant>)>,
}

impl Roll {
    pub(super) fn new(services: &[ServiceName]) -> Self {
        Self { services: services.iter().cloned().collect(), instances: BTreeMap::new() }
    }

    /// Takes a message in.
    pub(super) fn hear(&mut self, heard: Heard, now: Instant) {
        if !self.services.iter().any(|service| service.as_str() == heard.service) {
            return;
        }
        let key = (heard.service, heard.node, heard.instance);
        let known = self.instances.get(&key).map(|(epoch, _)| *epoch);
        // Of two processes of one place the newer one counts.
        if known.is_some_and(|known| heard.epoch < known) {
            return;
        }
        if known.is_some() || self.instances.len() < MAX_INSTANCES {
            let until = heard.is_ready.then(|| now + heard.ttl);
            self.instances.insert(key, (heard.epoch, until));
        }
    }

    /// Those of which no instance is ready now.
    pub(super) fn missing(&self, now: Instant) -> Vec<ServiceName> {
        let is_there = |service: &ServiceName| {
            let mut all = self.instances.iter().filter(|((name, ..), _)| name == service.as_str());
            all.any(|(_, (_, until))| until.is_some_and(|until| until > now))
        };
        self.services.iter().filter(|service| !is_there(service)).cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn heard(service: &str, epoch: u64, is_ready: bool) -> Heard {
        Heard {
            service: service.to_owned(),
            node: "robot-1".to_owned(),
            instance: "0".to_owned(),
            epoch,
            is_ready,
            ttl: Duration::from_secs(15),
        }
    }

    #[test]
    fn all_are_there_when_each_is_ready_at_the_same_time() {
        let (flow, config): (ServiceName, ServiceName) =
            ("flow".parse().unwrap(), "config".parse().unwrap());
        let mut roll = Roll::new(&[flow.clone(), config.clone()]);
        let now = Instant::now();
        roll.hear(heard("flow", 1, true), now);
        roll.hear(heard("other", 1, true), now);
        assert_eq!(roll.missing(now), std::slice::from_ref(&config));
        let later = now + Duration::from_secs(15);
        roll.hear(heard("config", 1, true), later);
        assert_eq!(roll.missing(later), std::slice::from_ref(&flow), "its time is over");
        roll.hear(heard("flow", 1, true), later);
        assert!(roll.missing(later).is_empty());
        roll.hear(heard("flow", 2, false), later);
        roll.hear(heard("flow", 1, true), later);
        assert_eq!(
            roll.missing(later),
            [flow],
            "it was started anew, and the old process does not count any more"
        );
    }
}
