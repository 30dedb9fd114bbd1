//! Many leases of one topic become one entry: what the planner sees and other flows are told.

use std::collections::BTreeSet;

use blaze_domain::control::{DEFAULT_ENCODING, LeaseKind, Quality};
use blaze_domain::{LayerName, NodeName, Priority, Scope, ServiceName};

use super::leases::{LeaseView, Terms};
use crate::world::{
    Advertise, MAX_REQUESTERS, OriginFilter, Request, ScopeEntry, Source, TopicEntry,
};

/// Most services that one entry lists.
const MAX_SOURCES: usize = 256;
/// Most different origin filters of one scope; with more, messages of any origin are asked for.
pub(super) const MAX_FILTERS: usize = 128;

/// Merges the leases of one topic per scope.
pub(super) fn merge<'a>(leases: &(impl Iterator<Item = LeaseView<'a>> + Clone)) -> TopicEntry {
    let of = |scope: Scope| {
        let of_kind = |kind| {
            leases.clone().filter(move |lease| lease.key.scope == scope && lease.key.kind == kind)
        };
        ScopeEntry {
            advertise: merge_advertise(of_kind(LeaseKind::Advertise)),
            request: merge_request(of_kind(LeaseKind::Request)),
        }
    };
    TopicEntry { node: of(Scope::Node), layer: of(Scope::Layer), ..TopicEntry::default() }
}

fn merge_advertise<'a>(leases: impl Iterator<Item = LeaseView<'a>> + Clone) -> Option<Advertise> {
    let terms = leases.clone().filter_map(|lease| match lease.terms {
        Terms::Advertise { rate_hz, max_bytes, .. } => Some((*rate_hz, *max_bytes)),
        Terms::Request { .. } => None,
    });
    let quality = merge_quality(leases.clone().map(|lease| lease.quality()))?;
    let mut sources: BTreeSet<Source> = leases.clone().map(|lease| source(&lease)).collect();
    let more_sources = sources.len() > MAX_SOURCES;
    while sources.len() > MAX_SOURCES {
        sources.pop_last();
    }
    Some(Advertise {
        rate_hz: terms.clone().map(|(rate, _)| rate).sum(),
        max_bytes: terms
            .map(|(_, bytes)| bytes)
            .collect::<Option<Vec<_>>>()
            .and_then(|all| all.into_iter().max()),
        encoding: quality.encoding.unwrap_or_else(|| DEFAULT_ENCODING.into()),
        type_name: quality.type_name,
        type_hash: quality.type_hash,
        reliability: quality.reliability,
        durability: quality.durability,
        depth: quality.depth,
        // The highest class that any of them gives; one that gives none goes with the others.
        priority: leases.filter_map(|lease| lease.quality().priority).min(),
        lifespan_ms: quality.lifespan_ms,
        sources: sources.into_iter().collect(),
        more_sources,
    })
}

fn merge_request<'a>(leases: impl Iterator<Item = LeaseView<'a>> + Clone) -> Option<Request> {
    let terms = leases.clone().filter_map(|lease| match lease.terms {
        Terms::Request { max_rate_hz, from, .. } => Some((*max_rate_hz, from)),
        Terms::Advertise { .. } => None,
    });
    let quality = merge_quality(leases.clone().map(|lease| lease.quality()))?;
    let (services, more_services) = requesters(leases.clone().map(|lease| source(&lease)), 0);
    let mut filters = BTreeSet::new();
    let mut any_origin = false;
    for (_, from) in terms.clone() {
        any_origin |= from.is_any();
        if !any_origin {
            filters.insert(OriginFilter {
                layer: from.layer.as_ref().map(LayerName::to_string),
                node: from.node.as_ref().map(NodeName::to_string),
                service: from.service.as_ref().map(ServiceName::to_string),
            });
            any_origin = filters.len() > MAX_FILTERS;
        }
    }
    Some(Request {
        max_rate_hz: highest_rate(terms.map(|(rate, _)| rate)),
        lifespan_ms: quality.lifespan_ms,
        reliability: quality.reliability,
        durability: quality.durability,
        depth: quality.depth,
        // A request may only lower the class, so one that says nothing asks for the highest there
        // is: as published.
        priority: leases
            .clone()
            .map(|lease| lease.quality().priority)
            .collect::<Option<Vec<Priority>>>()
            .and_then(|all| all.into_iter().min()),
        from: if any_origin { Vec::new() } else { filters.into_iter().collect() },
        type_name: quality.type_name,
        type_hash: quality.type_hash,
        services,
        more_services,
        framed: leases.clone().any(|lease| wants_header(&lease)),
        bare: leases.clone().any(|lease| matches!(lease.terms, Terms::Request { bare: true, .. })),
        json: leases
            .into_iter()
            .any(|lease| matches!(lease.terms, Terms::Request { json: true, .. })),
    })
}

/// Whether a request is served with messages that have a header. On a layer scope there are no
/// bare copies: there it gets these instead.
fn wants_header(lease: &LeaseView<'_>) -> bool {
    match lease.terms {
        Terms::Request { bare, json, .. } if lease.key.scope == Scope::Node => !bare && !json,
        Terms::Request { bare, json, .. } => *bare || !json,
        Terms::Advertise { .. } => false,
    }
}

/// The first services of all, and how many more there are beside `others`, which are not named.
pub(crate) fn requesters(all: impl Iterator<Item = Source>, others: u32) -> (Vec<Source>, u32) {
    let all: BTreeSet<Source> = all.collect();
    let more = u32::try_from(all.len().saturating_sub(MAX_REQUESTERS)).unwrap_or(u32::MAX);
    (all.into_iter().take(MAX_REQUESTERS).collect(), others.saturating_add(more))
}

/// The highest limit; `None` where one of them sets none.
fn highest_rate(rates: impl Iterator<Item = Option<f64>>) -> Option<f64> {
    rates.collect::<Option<Vec<f64>>>()?.into_iter().reduce(f64::max)
}

/// All but the class; `None` for no lease at all.
fn merge_quality<'a>(all: impl Iterator<Item = &'a Quality> + Clone) -> Option<Quality> {
    let first = all.clone().next()?;
    // Type and hash come from one lease where possible; leases come in the order of their keys, so
    // every flow that sees the same leases takes the same one.
    let typed = all.clone().find(|quality| !quality.type_name.is_empty()).unwrap_or(first);
    let type_hash = if typed.type_hash.is_empty() {
        all.clone()
            .filter(|quality| quality.type_name == typed.type_name)
            .map(|quality| &quality.type_hash)
            .find(|hash| !hash.is_empty())
            .cloned()
            .unwrap_or_default()
    } else {
        typed.type_hash.clone()
    };
    let endless = all.clone().any(|quality| quality.lifespan_ms == 0);
    let longest = all.clone().map(|quality| quality.lifespan_ms).max().unwrap_or(0);
    Some(Quality {
        encoding: all.clone().find_map(|quality| quality.encoding.clone()),
        type_name: typed.type_name.clone(),
        type_hash,
        reliability: all.clone().map(|quality| quality.reliability).max()?,
        durability: all.clone().map(|quality| quality.durability).max()?,
        depth: all.map(|quality| quality.depth).max()?,
        priority: None,
        lifespan_ms: if endless { 0 } else { longest },
    })
}

fn source(lease: &LeaseView<'_>) -> Source {
    Source {
        node: lease.key.node.as_ref().map(NodeName::to_string).unwrap_or_default(),
        service: lease.key.service.to_string(),
    }
}
