//! Services that call ROS 2 services through this flow: it advertises their requests and asks for
//! their replies, as a service of its own node.
//!
//! Beside leases and [found endpoints](super::found) the third source of what is announced. Whoever
//! holds the calls says who calls what; nothing is stored.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use blaze_domain::control::LeaseKind;
use blaze_domain::media::JSON;
use blaze_domain::{Durability, FlowId, Reliability, ServiceName, TopicName};

use super::Registry;
use crate::plan::told::{merge_offers, merge_requests};
use crate::world::{Advertise, Request, ScopeEntry, Source};

/// Callers by topic of requests or replies.
#[derive(Default)]
pub(super) struct Callers(BTreeMap<TopicName, (LeaseKind, BTreeSet<ServiceName>)>);

impl Callers {
    /// Whether nobody calls anything.
    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Adds what they advertise or request of a topic to what else is of the own node.
    pub(super) fn add(&self, me: &FlowId, topic: &TopicName, node: &mut ScopeEntry) {
        let Some((kind, services)) = self.0.get(topic) else { return };
        let source = |service: &ServiceName| Source {
            node: me.node.to_string(),
            service: service.to_string(),
        };
        let sources = services.iter().map(source).collect();
        match kind {
            LeaseKind::Advertise => {
                let ours = advertise(sources);
                node.advertise = merge_offers(node.advertise.iter().chain([&ours]));
            }
            LeaseKind::Request => {
                let ours = request(sources);
                // The services of the node are still served in the forms that they ask for.
                let (bare, json) =
                    node.request.as_ref().map_or((false, false), |held| (held.bare, held.json));
                let merged = merge_requests(node.request.iter().chain([&ours]));
                node.request = merged.map(|merged| Request { framed: true, bare, json, ..merged });
            }
        }
    }
}

impl Registry {
    /// Who calls a service through this flow: `topic` is that of its requests, which they
    /// advertise, or of its replies, which they request. Returns the topics to plan anew.
    pub fn set_callers(
        &mut self,
        now: Instant,
        topic: &TopicName,
        kind: LeaseKind,
        services: BTreeSet<ServiceName>,
    ) -> BTreeSet<TopicName> {
        if services.is_empty() {
            self.callers.0.remove(topic);
        } else {
            self.callers.0.insert(topic.clone(), (kind, services));
        }
        self.show_node();
        self.refresh(now, BTreeSet::from([topic.clone()]))
    }
}

fn advertise(sources: Vec<Source>) -> Advertise {
    Advertise {
        rate_hz: None,
        max_bytes: None,
        encoding: JSON.to_owned(),
        type_name: String::new(),
        type_hash: String::new(),
        reliability: Reliability::Reliable,
        durability: Durability::Volatile,
        depth: 1,
        priority: None,
        lifespan_ms: 0,
        sources,
        more_sources: false,
    }
}

fn request(services: Vec<Source>) -> Request {
    let (services, more_services) = super::requesters(services.into_iter(), 0);
    Request {
        max_rate_hz: None,
        lifespan_ms: 0,
        reliability: Reliability::Reliable,
        durability: Durability::Volatile,
        depth: 1,
        priority: None,
        from: Vec::new(),
        type_name: String::new(),
        type_hash: String::new(),
        services,
        more_services,
        framed: true,
        bare: false,
        json: false,
    }
}
