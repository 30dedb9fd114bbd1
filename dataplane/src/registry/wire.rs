//! Entries as they travel, and their conversion.
//!
//! ```text
//! TopicEntry ─to_wire─► Entry ─pieces─► [Entry ≤ 1150 B] ─pack─► parts of a Delta or Snapshot
//! parts ─join─► Entry (equal to the one that was cut) ─from_wire─► TopicEntry
//! ```

use blaze_domain::control::{DEFAULT_ENCODING, MAX_ENCODING_BYTES, MAX_TYPE_BYTES};
use blaze_domain::{Durability, Reliability, TopicName};
use blaze_proto::link::link_control as wire;
use prost::Message;

use super::merge::MAX_FILTERS;
use super::pieces::MAX_PIECE_BYTES;
use crate::link::{class_code, class_of};
use crate::world::{
    Advertise, MAX_REQUESTERS, OriginFilter, Request, ScopeEntry, Source, TopicEntry,
};

/// Largest advertisement, and largest request without its filters: with the longest topic each
/// fits a piece.
const MAX_ADVERTISE_BYTES: usize = MAX_PIECE_BYTES - 212;
/// Most services that an announced entry lists.
const MAX_ANNOUNCED_SOURCES: usize = 8;
/// Most routes that an entry tells of.
pub(crate) const MAX_ROUTES: usize = 16;
/// Longest text of a route state, in bytes; `layer/node` has 127.
const MAX_ROUTE_TEXT: usize = 127;
/// Longest name of a layer, node or service, in bytes.
const MAX_NAME: usize = blaze_domain::names::MAX_NAME_BYTES;

/// What is wrong with an entry of another flow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum EntryFault {
    #[error("its topic is not a name")]
    Topic,
    #[error("{0} is too long")]
    TooLong(&'static str),
    #[error("it has too many {0}")]
    TooMany(&'static str),
}

/// An own entry as it is announced; what does not fit is left out and said to be.
pub(super) fn to_wire(
    topic: &TopicName,
    entry: &TopicEntry,
    routes: &[wire::RouteState],
) -> wire::Entry {
    wire::Entry {
        topic: topic.to_string(),
        removed: false,
        node_advertise: entry.node.advertise.as_ref().map(advertise_to_wire),
        layer_advertise: entry.layer.advertise.as_ref().map(advertise_to_wire),
        node_request: entry.node.request.as_ref().map(request_to_wire),
        layer_request: entry.layer.request.as_ref().map(request_to_wire),
        route_state: routes.iter().take(MAX_ROUTES).map(trim_route).collect(),
        outside_advertise: entry.outside.advertise.as_ref().map(advertise_to_wire),
        outside_request: entry.outside.request.as_ref().map(request_to_wire),
        ros2_advertise: entry.ros2.advertise.as_ref().map(advertise_to_wire),
        ros2_request: entry.ros2.request.as_ref().map(request_to_wire),
    }
}

/// Says that nothing is left of a topic.
pub(super) fn removed(topic: &TopicName) -> wire::Entry {
    wire::Entry { topic: topic.to_string(), removed: true, ..wire::Entry::default() }
}

fn advertise_to_wire(advertise: &Advertise) -> wire::Advertise {
    let mut message = wire::Advertise {
        rate_hz: advertise.rate_hz.unwrap_or(0.0),
        max_bytes: advertise.max_bytes.unwrap_or(0),
        encoding: advertise.encoding.clone(),
        r#type: advertise.type_name.clone(),
        type_hash: advertise.type_hash.clone(),
        reliable: advertise.reliability == Reliability::Reliable,
        transient_local: advertise.durability == Durability::TransientLocal,
        depth: advertise.depth,
        priority: advertise.priority.map_or(0, class_code).into(),
        lifespan_ms: advertise.lifespan_ms,
        sources: Vec::new(),
        // Set while measuring, so that setting it later does not make the message longer.
        more_sources: true,
    };
    for source in advertise.sources.iter().take(MAX_ANNOUNCED_SOURCES) {
        message
            .sources
            .push(wire::Source { node: source.node.clone(), service: source.service.clone() });
        if message.encoded_len() > MAX_ADVERTISE_BYTES {
            message.sources.pop();
            break;
        }
    }
    message.more_sources =
        advertise.more_sources || message.sources.len() < advertise.sources.len();
    message
}

fn request_to_wire(request: &Request) -> wire::Request {
    let mut message = wire::Request {
        max_rate_hz: request.max_rate_hz.unwrap_or(0.0),
        lifespan_ms: request.lifespan_ms,
        reliable: request.reliability == Reliability::Reliable,
        transient_local: request.durability == Durability::TransientLocal,
        depth: request.depth,
        priority: request.priority.map_or(0, class_code).into(),
        from: Vec::new(),
        r#type: request.type_name.clone(),
        type_hash: request.type_hash.clone(),
        json: request.json,
        unframed: !request.framed,
        services: Vec::new(),
        // Set while measuring, so that setting it later does not make the message longer.
        more_services: u32::MAX,
    };
    for service in request.services.iter().take(MAX_REQUESTERS) {
        message
            .services
            .push(wire::Source { node: service.node.clone(), service: service.service.clone() });
        if message.encoded_len() > MAX_ADVERTISE_BYTES {
            message.services.pop();
            break;
        }
    }
    let left_out = request.services.len() - message.services.len();
    let left_out = u32::try_from(left_out).unwrap_or(u32::MAX);
    message.more_services = request.more_services.saturating_add(left_out);
    let filter = |filter: &OriginFilter| wire::From {
        layer: filter.layer.clone().unwrap_or_default(),
        node: filter.node.clone().unwrap_or_default(),
        service: filter.service.clone().unwrap_or_default(),
    };
    message.from = request.from.iter().map(filter).collect();
    message
}

fn trim_route(route: &wire::RouteState) -> wire::RouteState {
    wire::RouteState {
        to_layer: cut(&route.to_layer),
        receiver: cut(&route.receiver),
        step: cut(&route.step),
        ok: route.ok,
        code: cut(&route.code),
        next_offset: route.next_offset,
    }
}

fn cut(text: &str) -> String {
    text.get(..text.floor_char_boundary(MAX_ROUTE_TEXT)).unwrap_or_default().to_owned()
}

/// Another flow's entry, checked.
pub(super) fn from_wire(entry: &wire::Entry) -> Result<(TopicName, TopicEntry), EntryFault> {
    let topic = entry.topic.parse().map_err(|_| EntryFault::Topic)?;
    if entry.route_state.len() > MAX_ROUTES {
        return Err(EntryFault::TooMany("route states"));
    }
    for route in &entry.route_state {
        for text in [&route.to_layer, &route.receiver, &route.step, &route.code] {
            within(text, MAX_ROUTE_TEXT, "a route state")?;
        }
    }
    let scope = |advertise: Option<&wire::Advertise>,
                 request: Option<&wire::Request>|
     -> Result<_, EntryFault> {
        Ok(ScopeEntry {
            advertise: advertise.map(advertise_from_wire).transpose()?,
            request: request.map(request_from_wire).transpose()?,
        })
    };
    let merged = TopicEntry {
        node: scope(entry.node_advertise.as_ref(), entry.node_request.as_ref())?,
        layer: scope(entry.layer_advertise.as_ref(), entry.layer_request.as_ref())?,
        ros2: scope(entry.ros2_advertise.as_ref(), entry.ros2_request.as_ref())?,
        outside: scope(entry.outside_advertise.as_ref(), entry.outside_request.as_ref())?,
    };
    Ok((topic, merged))
}

fn within(text: &str, limit: usize, what: &'static str) -> Result<(), EntryFault> {
    if text.len() > limit { Err(EntryFault::TooLong(what)) } else { Ok(()) }
}

fn rate_from_wire(rate: f64) -> Option<f64> {
    (rate.is_finite() && rate > 0.0).then_some(rate)
}

fn advertise_from_wire(message: &wire::Advertise) -> Result<Advertise, EntryFault> {
    within(&message.encoding, MAX_ENCODING_BYTES, "the encoding")?;
    within(&message.r#type, MAX_TYPE_BYTES, "the type")?;
    within(&message.type_hash, MAX_TYPE_BYTES, "the type hash")?;
    Ok(Advertise {
        rate_hz: rate_from_wire(message.rate_hz),
        max_bytes: (message.max_bytes > 0).then_some(message.max_bytes),
        encoding: if message.encoding.is_empty() {
            DEFAULT_ENCODING.into()
        } else {
            message.encoding.clone()
        },
        type_name: message.r#type.clone(),
        type_hash: message.type_hash.clone(),
        reliability: reliability(message.reliable),
        durability: durability(message.transient_local),
        depth: message.depth.max(1),
        priority: class_of(message.priority),
        lifespan_ms: message.lifespan_ms,
        sources: sources_from_wire(&message.sources, MAX_ANNOUNCED_SOURCES)?,
        more_sources: message.more_sources,
    })
}

fn sources_from_wire(sources: &[wire::Source], most: usize) -> Result<Vec<Source>, EntryFault> {
    if sources.len() > most {
        return Err(EntryFault::TooMany("services"));
    }
    let mut read = Vec::with_capacity(sources.len());
    for source in sources {
        within(&source.node, MAX_NAME, "a service's node")?;
        within(&source.service, MAX_NAME, "a service's name")?;
        read.push(Source { node: source.node.clone(), service: source.service.clone() });
    }
    read.sort();
    Ok(read)
}

fn request_from_wire(message: &wire::Request) -> Result<Request, EntryFault> {
    within(&message.r#type, MAX_TYPE_BYTES, "the type")?;
    within(&message.type_hash, MAX_TYPE_BYTES, "the type hash")?;
    if message.from.len() > MAX_FILTERS {
        return Err(EntryFault::TooMany("origin filters"));
    }
    let mut from = Vec::with_capacity(message.from.len());
    for filter in &message.from {
        for part in [&filter.layer, &filter.node, &filter.service] {
            within(part, MAX_NAME, "an origin filter")?;
        }
        let part = |text: &String| Some(text).filter(|text| !text.is_empty()).cloned();
        from.push(OriginFilter {
            layer: part(&filter.layer),
            node: part(&filter.node),
            service: part(&filter.service),
        });
    }
    // A filter without any part lets everything pass.
    if from.contains(&OriginFilter::default()) {
        from.clear();
    }
    from.sort();
    Ok(Request {
        max_rate_hz: rate_from_wire(message.max_rate_hz),
        lifespan_ms: message.lifespan_ms,
        reliability: reliability(message.reliable),
        durability: durability(message.transient_local),
        depth: message.depth.max(1),
        priority: class_of(message.priority),
        from,
        type_name: message.r#type.clone(),
        type_hash: message.type_hash.clone(),
        services: sources_from_wire(&message.services, MAX_REQUESTERS)?,
        more_services: message.more_services,
        framed: !message.unframed,
        // What a flow copies on its node scope is its affair.
        bare: false,
        json: message.json,
    })
}

fn reliability(reliable: bool) -> Reliability {
    if reliable { Reliability::Reliable } else { Reliability::BestEffort }
}

fn durability(transient_local: bool) -> Durability {
    if transient_local { Durability::TransientLocal } else { Durability::Volatile }
}

#[cfg(test)]
#[path = "wire_tests.rs"]
mod tests;
