//! What services say about themselves, and what becomes of roll-outs by it.

use std::collections::BTreeMap;

use blaze_proto::v1;
use blaze_runtime::on_beat;
use bytes::Bytes;
use tokio::time::Instant;

use super::{ACK_AFTER, ACK_PACE, Engine, LOOK};
use crate::core::messages::{ConfigAck, ServiceState, WatchdogKey};
use crate::core::{Complaint, RolloutState, ServedTarget};

/// Something that was heard of services.
#[derive(Debug)]
pub enum Sign {
    /// A message of `blaze/config/ack`.
    Ack(Bytes),
    /// A message of `blaze/watchdog`.
    Beat(Bytes),
    /// The records below `blaze:watchdog:`.
    Scan {
        /// Keys, without the prefix of the server, with their members.
        records: Vec<(String, BTreeMap<String, String>)>,
        /// Whether these are all; if not, what is missing may be there nevertheless.
        is_whole: bool,
    },
    /// The broker is away, or was until now.
    Deaf,
}

impl Engine {
    pub(super) fn on_sign(&mut self, sign: Sign) {
        let now = Instant::now().into_std();
        let complaints = match sign {
            Sign::Ack(bytes) => match ConfigAck::parse(&bytes) {
                Ok(ack) => {
                    self.counts.signs += 1;
                    self.signs.acked(ack, now).into_iter().collect()
                }
                Err(error) => self.misunderstood(&error),
            },
            Sign::Beat(bytes) => match ServiceState::parse(&bytes) {
                Ok(state) => {
                    self.counts.signs += 1;
                    self.meet(&state);
                    self.signs.beat(state, now).into_iter().collect()
                }
                Err(error) => self.misunderstood(&error),
            },
            Sign::Scan { records, is_whole } => {
                let mut states = Vec::with_capacity(records.len());
                for (key, members) in &records {
                    match read_record(key, members) {
                        Ok(state) => states.push(state),
                        Err(error) => {
                            self.misunderstood(&error);
                        }
                    }
                }
                self.counts.signs += states.len() as u64;
                states.iter().for_each(|state| self.meet(state));
                self.signs.scanned(states, is_whole, now)
            }
            Sign::Deaf => {
                self.signs.deaf(now);
                Vec::new()
            }
        };
        self.judge(&complaints);
    }

    /// An instance that runs with a configuration is told of changes, whoever gave it that one.
    /// Workers know it by themselves.
    fn meet(&mut self, state: &ServiceState) {
        let site = &self.identity.site;
        let is_elsewhere = state.layer.as_ref().is_some_and(|layer| *layer != site.layer)
            || site.node.as_ref().is_some_and(|node| *node != state.key.node);
        let own = self.outputs.own.as_ref();
        let is_worker = own.is_some_and(|own| own.place.service == state.key.service);
        if state.config_hash.is_empty() || is_elsewhere || is_worker {
            return;
        }
        let WatchdogKey { service, node, instance } = state.key.clone();
        let place = ServedTarget { service, instance: Some(instance), node: Some(node) };
        let now = Instant::now().into_std();
        let notice = self.served.meet(&place, now);
        self.note_new_places();
        // Another replica tells it, where that one leads.
        if let Some(notice) = notice.filter(|_| self.tells) {
            let told = self.of_notice(&notice);
            self.tell(told.into_iter().collect());
        }
    }

    fn misunderstood(&mut self, error: &str) -> Vec<Complaint> {
        self.counts.misunderstood += 1;
        tracing::debug!(error, "what a service says about itself cannot be read");
        Vec::new()
    }

    /// Looks whether anything has run out.
    pub(super) fn look_at_signs(&mut self) {
        self.look_at = on_beat(Instant::now() + LOOK);
        let complaints = self.signs.expire(Instant::now().into_std());
        self.judge(&complaints);
    }

    fn judge(&mut self, complaints: &[Complaint]) {
        let now = Instant::now().into_std();
        for complaint in complaints {
            for failure in self.gate.complain(&self.served, complaint, now) {
                let reason = failure.reason.as_str();
                tracing::warn!(
                    rollout = %failure.name,
                    reason,
                    "a roll-out has failed here and is undone",
                );
                self.counts.failed_rollouts += 1;
                self.served.fail_rollout(&failure.uid);
                // A new life must not try it again, whether it tells anybody of the former
                // configuration or not.
                self.renew_notes();
                self.keep(true);
                if let Some(copies) = &self.outputs.copies {
                    copies.hurry();
                }
                self.flush_soon();
                self.acknowledge_soon();
            }
        }
        if self.signs.take_changed() {
            self.acknowledge_soon();
        }
    }

    /// Roll-outs that began or ended with what is shown, and windows of those that services were
    /// told of by now.
    pub(super) fn follow_rollouts(&mut self) {
        if self.gate.follow(&self.served) {
            self.acknowledge_soon();
        }
        self.open_windows();
    }

    /// Windows of roll-outs that services were told of by now.
    pub(super) fn open_windows(&mut self) {
        if self.gate.open(self.told_up_to(), Instant::now().into_std()) {
            self.acknowledge_soon();
        }
    }

    /// Revision up to which services were notified: by this worker, since it notified all, or else
    /// by others.
    fn told_up_to(&self) -> Option<u64> {
        if self.tells {
            return self.delivered(false).filter(|_| self.has_announced);
        }
        let (noted, shown) = (self.noted.as_ref()?, self.shown.as_ref()?);
        (noted.store_id == shown.store_id).then_some(noted.revision)
    }

    /// The main service is to know soon, together with what comes until then.
    pub(super) fn acknowledge_soon(&mut self) {
        if self.stream.is_some() {
            let soon = (Instant::now() + ACK_AFTER).max(self.acked + ACK_PACE);
            self.ack_at = self.ack_at.min(soon);
        }
    }

    /// How roll-outs go on the nodes that are served here. On the broker of a layer these are the
    /// nodes that anything was heard from: the others have brokers and workers of their own.
    pub(super) fn rollouts(&self) -> Vec<RolloutState> {
        let own = &self.identity.node;
        self.gate.states(|node| {
            node == own || self.served.is_asked_from(node) || self.signs.is_heard_from(node)
        })
    }

    pub(super) fn services_of_ack(&self) -> Vec<v1::ServiceState> {
        let row = self.signs.rows().map(|(key, row)| v1::ServiceState {
            service: key.service.to_string(),
            instance: key.instance.to_string(),
            node: key.node.to_string(),
            state: row.health.as_str().to_owned(),
            config_revision: row.config_revision,
            config_hash: row.config_hash.clone(),
        });
        row.collect()
    }

    pub(super) fn rollouts_of_ack(&self) -> Vec<v1::RolloutReport> {
        let states = self.rollouts().into_iter().map(|state| v1::RolloutReport {
            uid: state.uid,
            node: state.node.to_string(),
            phase: state.phase.as_str().to_owned(),
            reason: state.reason,
        });
        states.collect()
    }
}

/// A record of Redis. Its key decides where it is looked for, so it must say the same.
fn read_record(key: &str, members: &BTreeMap<String, String>) -> Result<ServiceState, String> {
    let fields = members.iter().map(|(name, value)| (name.as_str(), value.as_str()));
    let state = ServiceState::of_fields(fields)?;
    match WatchdogKey::parse(key) {
        Some(named) if named == state.key => Ok(state),
        Some(_) | None => Err("the record is of another instance than its key".to_owned()),
    }
}
