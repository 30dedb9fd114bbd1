//! What local advertisements say of a topic.

use std::collections::BTreeSet;

use blaze_domain::control::{DEFAULT_ENCODING, LeaseKind};
use blaze_domain::{Durability, FlowId, MAX_PAYLOAD_BYTES, Reliability, Scope, TopicName};

use crate::lane::path::{BareInfo, TopicInfo};
use crate::plan::network::Servers;
use crate::registry::{LeaseView, Registry, Terms};
use crate::types::{MessageType, TopicTypes, Wanted};
use crate::world::{FlowView, OriginFilter, TopicEntry};

/// The largest payload in bytes that any flow announces of a topic. Of which connection a message
/// goes to its broker is decided by that where it arrives as well: a flow whose own services only
/// ask for it has no other way to know before one has come.
pub(super) fn announced_bytes(holders: &[(&FlowId, &FlowView)], topic: &TopicName) -> Option<u64> {
    let entries = holders.iter().filter_map(|(_, view)| view.topics.get(topic));
    let scopes = entries.flat_map(TopicEntry::scopes);
    let largest = scopes.filter_map(|(_, scope)| scope.advertise.as_ref()?.max_bytes).max();
    largest.map(|bytes| bytes.min(MAX_PAYLOAD_BYTES as u64))
}

/// Whether some service advertises a topic, and whether some service requests it.
pub(super) fn sides(holders: &[(&FlowId, &FlowView)], topic: &TopicName) -> (bool, bool) {
    let entries = holders.iter().filter_map(|(_, view)| view.topics.get(topic));
    entries.flat_map(TopicEntry::scopes).fold((false, false), |(advertised, requested), (_, it)| {
        (advertised || it.advertise.is_some(), requested || it.request.is_some())
    })
}

/// The types of a topic: that of its publishers, of all flows, and that of its readers on the own
/// ROS 2 network.
pub(super) fn types(
    registry: &Registry,
    holders: &[(&FlowId, &FlowView)],
    topic: &TopicName,
) -> TopicTypes {
    let entries = holders.iter().filter_map(|(_, view)| view.topics.get(topic));
    let offers = entries.flat_map(TopicEntry::scopes);
    let offers = offers.filter_map(|(_, scope)| scope.advertise.as_ref());
    let published: BTreeSet<(&str, &str)> = offers
        .filter(|offer| !offer.type_name.is_empty())
        .map(|offer| (offer.type_name.as_str(), offer.type_hash.as_str()))
        .collect();
    let published = only(&published).ok().flatten();
    let readers = registry.found(topic).map(|(endpoint, _)| endpoint);
    let readers: BTreeSet<(&str, &str)> = readers
        .filter(|endpoint| endpoint.kind == LeaseKind::Request)
        .map(|endpoint| (endpoint.type_name.as_str(), endpoint.type_hash.as_str()))
        .collect();
    TopicTypes { wanted: wanted(&readers, published.as_ref()), published }
}

/// The only type, with its hash if one of them gives it; or all their names.
fn only(types: &BTreeSet<(&str, &str)>) -> Result<Option<MessageType>, String> {
    let names: BTreeSet<&str> = types.iter().map(|(name, _)| *name).collect();
    let mut hashes = types.iter().map(|(_, hash)| *hash).filter(|hash| !hash.is_empty());
    let hash = hashes.next().unwrap_or_default();
    match names.first() {
        None => Ok(None),
        Some(name) if names.len() > 1 => {
            let others = names.iter().skip(1).copied().collect::<Vec<_>>().join(", ");
            Err(format!("{name}, {others}"))
        }
        Some(name) if hashes.next().is_some() => Err(format!("{name} in several versions")),
        Some(name) => Ok(Some(MessageType { name: *name, hash }.owned())),
    }
}

/// The type that JSON becomes for these readers.
fn wanted(readers: &BTreeSet<(&str, &str)>, published: Option<&MessageType>) -> Wanted {
    let Some(published) = published else {
        return match only(readers) {
            Ok(Some(ty)) => Wanted::Type(ty),
            Ok(None) => Wanted::Nothing,
            Err(types) => Wanted::Mismatch(format!(
                "readers ask for {types}: name one as `type` of the publisher"
            )),
        };
    };
    let differ = |a: &str, b: &str| !a.is_empty() && !b.is_empty() && a != b;
    let fits =
        |(name, hash): &&(&str, &str)| *name == published.name && !differ(hash, &published.hash);
    match only(&readers.iter().filter(fits).copied().collect()) {
        Ok(Some(ty)) => Wanted::Type(ty),
        Ok(None) if readers.is_empty() => Wanted::Nothing,
        _ => {
            let mut names: Vec<&str> = readers.iter().map(|(name, _)| *name).collect();
            names.dedup();
            let (names, name) = (names.join(", "), &published.name);
            Wanted::Mismatch(format!("{name} is published, readers ask for {names}"))
        }
    }
}

/// What the advertisements of a topic on this flow's own brokers say.
pub(super) fn local_info(registry: &Registry, topic: &TopicName) -> TopicInfo {
    let all: Vec<LeaseView<'_>> = registry.local_advertisers(topic).collect();
    let of = |scope: Scope| -> Vec<LeaseView<'_>> {
        let of_scope = all.iter().filter(|lease| lease.key.scope == scope);
        of_scope.copied().collect()
    };
    let offers = || {
        all.iter().filter_map(|lease| match lease.terms {
            Terms::Advertise { rate_hz, max_bytes, .. } => Some((*rate_hz, *max_bytes)),
            Terms::Request { .. } => None,
        })
    };
    TopicInfo {
        node: bare_info(&of(Scope::Node)),
        layer: bare_info(&of(Scope::Layer)),
        max_bytes: offers().filter_map(|(_, bytes)| bytes).max(),
        rate_hz: offers().map(|(rate, _)| rate).sum::<Option<f64>>().filter(|_| !all.is_empty()),
        access: registry.access_of(topic),
        types: TopicTypes::default(),
        servers: Servers::default(),
    }
}

/// Who advertises a topic as transient_local.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Sources {
    pub(super) known: BTreeSet<OriginFilter>,
    /// There are more, which nobody named.
    pub(super) more: bool,
}

/// Who advertises a topic as transient_local, of flows that hold it and are not forgotten. One that
/// is down is still one of them: its services may well live.
pub(super) fn durable_sources(holders: &[(&FlowId, &FlowView)], topic: &TopicName) -> Sources {
    let mut found = Sources::default();
    for (flow, view) in holders {
        let Some(entry) = view.topics.get(topic) else {
            continue;
        };
        // What a gateway tells of flows outside names no layers.
        let layer = |scope| (scope != Scope::Inter).then(|| flow.layer.to_string());
        let offers = entry
            .scopes()
            .into_iter()
            .filter_map(|(scope, entry)| Some((layer(scope), entry.advertise.as_ref()?)));
        for (layer, offer) in
            offers.filter(|(_, offer)| offer.durability == Durability::TransientLocal)
        {
            found.more |= offer.more_sources;
            found.known.extend(offer.sources.iter().map(|source| OriginFilter {
                layer: layer.clone(),
                node: Some(source.node.clone()),
                service: Some(source.service.clone()),
            }));
        }
    }
    found
}

/// The header of what comes without one from a scope: where several advertise, nobody knows who of
/// them it was.
fn bare_info(advertised: &[LeaseView<'_>]) -> BareInfo {
    let Some(first) = advertised.first() else {
        return BareInfo::default();
    };
    let only = (advertised.len() == 1).then_some(first.key);
    let qualities = || advertised.iter().map(LeaseView::quality);
    let kept = qualities().filter(|quality| quality.durability == Durability::TransientLocal);
    let endless = qualities().any(|quality| quality.lifespan_ms == 0);
    BareInfo {
        encoding: qualities()
            .find_map(|quality| quality.encoding.clone())
            .unwrap_or_else(|| DEFAULT_ENCODING.to_owned()),
        service: only.map(|key| key.service.to_string()).unwrap_or_default(),
        instance: only.map(|key| key.instance.to_string()).unwrap_or_default(),
        priority: qualities().filter_map(|quality| quality.priority).min(),
        reliable: qualities().any(|quality| quality.reliability == Reliability::Reliable),
        depth: kept.map(|quality| quality.depth).max().unwrap_or(0),
        // 0 = endless, which is the longest.
        lifespan_ms: if endless {
            0
        } else {
            qualities().map(|quality| quality.lifespan_ms).max().unwrap_or(0)
        },
    }
}
