//! How the worker is.

use blaze_domain::config::Timestamp;
use blaze_domain::{InstanceName, NodeName};
use serde_json::{Value, json};

use super::{Counts, Engine, now};
use crate::core::{Freshness, Row, ServedTarget, Source, Told};

/// What the admin port shows.
#[derive(Debug, Clone, PartialEq)]
pub struct Status {
    /// As JSON: `/v1/status`.
    pub json: Value,
    /// For the metrics.
    pub counts: Counts,
    /// Whether anybody can be answered.
    pub is_ready: bool,
    /// Whether it is certain that what is served is the main service's newest.
    pub in_sync: bool,
    /// Revision of what is served.
    pub revision: u64,
    /// Canaries that are not judged, because there are too many.
    pub unwatched: usize,
    /// Why the mounted file is not used.
    pub defaults_problem: Option<String>,
    /// Why there is no stream.
    pub reason: Option<String>,
    /// Other workers of this node that are connected to the main service, with their addresses.
    pub beside: Vec<String>,
}

impl Engine {
    pub(super) fn status(&mut self) -> Status {
        let site = self.identity.site.clone();
        let freshness = Freshness { as_of: self.view.as_of(), now: now() };
        let digest = self.view.digest();
        let services = self.services();
        let rollouts = self.rollouts().into_iter().map(|state| {
            json!({
                "uid": state.uid, "name": state.name.as_str(), "node": state.node.as_str(),
                "phase": state.phase.as_str(), "reason": state.reason,
            })
        });
        let rollouts: Vec<Value> = rollouts.collect();
        let revision = self.view.state().revision();
        let json = json!({
            "layer": site.layer.as_str(),
            "node": self.identity.node.as_str(),
            "worker_id": self.identity.worker_id,
            "leader": self.is_leader(),
            "source": self.served.source().map(Source::as_str),
            "connected": self.stream.is_some(),
            "revision": revision,
            "digest": digest,
            "as_of": freshness.as_of.map(|time: Timestamp| time.to_string()),
            "age_s": freshness.age_s(),
            "services": services,
            "rollouts": rollouts,
            "reason": self.reason,
        });
        Status {
            json,
            counts: Counts {
                left_out: self.signs.left_out(),
                forgotten_asked: self.served.evicted(),
                forgotten_ended: self.ends.forgotten,
                ..self.counts
            },
            is_ready: self.served.is_ready(),
            in_sync: self.view.is_in_sync(),
            revision,
            unwatched: self.gate.unwatched(),
            defaults_problem: self.defaults_problem.clone(),
            reason: self.reason.clone(),
            beside: self.beside.others.clone(),
        }
    }

    /// What services are told, and how they say they are; those that are not told of changes come
    /// last.
    fn services(&self) -> Vec<Value> {
        let told = self
            .served
            .told()
            .map(|(place, told)| service(place, Some(told), self.signs.of(place)));
        let of_sign = self.signs.rows().filter_map(|(key, row)| {
            let place = ServedTarget {
                service: key.service.clone(),
                instance: Some(key.instance.clone()),
                node: Some(key.node.clone()),
            };
            let is_told = self.served.told_to(&place).is_some();
            (!is_told).then(|| service(&place, None, Some(row)))
        });
        told.chain(of_sign).collect()
    }
}

fn service(place: &ServedTarget, told: Option<&Told>, row: Option<&Row>) -> Value {
    json!({
        "service": place.service.as_str(),
        "instance": place.instance.as_ref().map(InstanceName::as_str),
        "node": place.node.as_ref().map(NodeName::as_str),
        "revision": told.map(|told| told.revision),
        "hash": told.and_then(|told| told.hash.as_deref()),
        "state": row.map(|row| row.health.as_str()),
        "config_revision": row.map(|row| row.config_revision),
        "config_hash": row.map(|row| row.config_hash.as_str()),
    })
}
