//! What a gateway tells of flows that others cannot hear: outside of those of its group that are not on the inter scope, and
//! those of the flows outside.

use std::collections::BTreeSet;

use blaze_domain::{FlowId, TopicName};

use super::view::Group;
use crate::world::{Advertise, FlowState, FlowView, Reach, Request, Role, ScopeEntry, TopicEntry, World};

/// Most services that one merged entry lists.
const MAX_SOURCES: usize = 256;
/// Most different origin filters of one merged request; with more, messages of any origin are asked for.
const MAX_FILTERS: usize = 128;

/// What the flow `world.me` tells flows of other groups of a topic: what its own services say, and as of its layer scope what
/// those of the flows say that are not on the inter scope. `None` where nobody says anything.
#[must_use]
pub(crate) fn told_outside(world: &World, topic: &TopicName) -> Option<TopicEntry> {
    let own = world.own()?;
    let mut told = own.topics.get(topic).cloned().unwrap_or_default();
    let members = members_behind(world).filter_map(|(_, view)| Some((view, view.topics.get(topic)?)));
    let mut own_layer = std::mem::take(&mut told.layer);
    let mut of_nodes = Vec::new();
    for (view, entry) in members {
        // Every flow of the group has the same leases there, so one of them is enough.
        own_layer.advertise = own_layer.advertise.or_else(|| entry.layer.advertise.clone());
        own_layer.request = own_layer.request.or_else(|| entry.layer.request.clone());
        of_nodes.extend(view.node_scope.then_some(&entry.node));
    }
    told.layer = merge(std::iter::once(&own_layer).chain(of_nodes));
    (!told.is_empty()).then_some(told)
}

/// What the flow `world.me` tells flows of its group that are not on the inter scope: what other groups advertise and request.
#[must_use]
pub(crate) fn told_inside(world: &World, topic: &TopicName) -> ScopeEntry {
    let Some((me, own)) = world.flows.get_key_value(&world.me) else {
        return ScopeEntry::default();
    };
    if members_behind(world).next().is_none() {
        return ScopeEntry::default();
    }
    let here = Group::of(me, own);
    let mut groups = BTreeSet::new();
    let mut entries = Vec::new();
    for (id, view) in &world.flows {
        let group = Group::of(id, view);
        if group == here || !carries(view) {
            continue;
        }
        let Some(entry) = view.topics.get(topic) else { continue };
        entries.extend(view.node_scope.then_some(&entry.node));
        // Flows that share a broker say the same of it.
        let says_something = entry.layer.advertise.is_some() || entry.layer.request.is_some();
        if view.layer_scope.is_some() && says_something && groups.insert(group) {
            entries.push(&entry.layer);
        }
    }
    merge(entries)
}

/// Whether the flow `world.me` speaks for flows that are not on the inter scope.
#[must_use]
pub(crate) fn speaks_for_others(world: &World) -> bool {
    members_behind(world).next().is_some()
}

/// Flows of the own group that are reached over this one; none unless it is a gateway.
fn members_behind(world: &World) -> impl Iterator<Item = (&FlowId, &FlowView)> {
    let own = world.flows.get_key_value(&world.me);
    let group = own
        .filter(|(_, view)| view.role.is_gateway())
        .map(|(id, view)| Group::of(id, view));
    let behind = move |(id, view): &(&FlowId, &FlowView)| {
        Some(Group::of(id, view)) == group && view.role == Role::Member && carries(view)
    };
    world.flows.iter().filter(behind)
}

fn carries(view: &FlowView) -> bool {
    view.state == FlowState::Ready && view.reach != Reach::Down
}

/// What several scopes say, as of one.
fn merge<'a>(entries: impl IntoIterator<Item = &'a ScopeEntry>) -> ScopeEntry {
    let mut merged = ScopeEntry::default();
    for entry in entries {
        if let Some(offer) = &entry.advertise {
            merged.advertise = Some(match merged.advertise.take() {
                Some(held) => with_offer(held, offer),
                None => offer.clone(),
            });
        }
        if let Some(ask) = &entry.request {
            merged.request = Some(match merged.request.take() {
                Some(held) => with_request(held, ask),
                None => ask.clone(),
            });
        }
    }
    merged
}

/// Advertisements of several scopes as one: sum of rates, largest size, strongest quality of service.
pub(super) fn merge_offers<'a>(offers: impl IntoIterator<Item = &'a Advertise>) -> Option<Advertise> {
    let mut offers = offers.into_iter();
    let first = offers.next()?.clone();
    Some(offers.fold(first, with_offer))
}

fn with_offer(held: Advertise, other: &Advertise) -> Advertise {
    let mut sources: BTreeSet<_> = held.sources.into_iter().collect();
    sources.extend(other.sources.iter().cloned());
    let mut more_sources = held.more_sources || other.more_sources;
    while sources.len() > MAX_SOURCES {
        sources.pop_last();
        more_sources = true;
    }
    let (type_name, type_hash) = one_type((held.type_name, held.type_hash), (&other.type_name, &other.type_hash));
    Advertise {
        rate_hz: held.rate_hz.zip(other.rate_hz).map(|(a, b)| a + b),
        max_bytes: held.max_bytes.zip(other.max_bytes).map(|(a, b)| a.max(b)),
        encoding: held.encoding,
        type_name,
        type_hash,
        reliability: held.reliability.max(other.reliability),
        durability: held.durability.max(other.durability),
        depth: held.depth.max(other.depth),
        priority: [held.priority, other.priority].into_iter().flatten().min(),
        lifespan_ms: longer(held.lifespan_ms, other.lifespan_ms),
        sources: sources.into_iter().collect(),
        more_sources,
    }
}

fn with_request(held: Request, other: &Request) -> Request {
    let any_origin = held.from.is_empty() || other.from.is_empty();
    let mut from: BTreeSet<_> = held.from.into_iter().collect();
    from.extend(other.from.iter().cloned());
    if any_origin || from.len() > MAX_FILTERS {
        from.clear();
    }
    let (type_name, type_hash) = one_type((held.type_name, held.type_hash), (&other.type_name, &other.type_hash));
    Request {
        max_rate_hz: held.max_rate_hz.zip(other.max_rate_hz).map(|(a, b)| a.max(b)),
        lifespan_ms: longer(held.lifespan_ms, other.lifespan_ms),
        reliability: held.reliability.max(other.reliability),
        durability: held.durability.max(other.durability),
        depth: held.depth.max(other.depth),
        // A request may only lower the class, so one that says nothing asks for the highest there is.
        priority: held.priority.zip(other.priority).map(|(a, b)| a.min(b)),
        from: from.into_iter().collect(),
        type_name,
        type_hash,
        // How a scope behind a gateway is served is the affair of the flow that has it.
        framed: true,
        bare: false,
    }
}

/// Type and hash that both give; where they differ, none: nobody is to miss what another one's type keeps away.
fn one_type(held: (String, String), other: (&String, &String)) -> (String, String) {
    let one = |held: String, other: &String| if held == *other { held } else { String::new() };
    (one(held.0, other.0), one(held.1, other.1))
}

/// The longer lifespan, where 0 is infinite.
fn longer(a: u32, b: u32) -> u32 {
    if a == 0 || b == 0 { 0 } else { a.max(b) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tests::worlds::{filter, offer, topic, world};

    #[test]
    fn outside_hears_what_is_behind_a_gateway_as_of_its_layer_scope() {
        let mut world = world(&[
            "c/a@1 layer- node+",
            "c/b@1 node+ layer-",
            "c/m@1 member node+ layer-",
            "c/n@1 member node-",
        ]);
        offer(&mut world, "c/m", "node").sources[0].node = "m".to_owned();
        let told = told_outside(&world, &topic()).unwrap();
        let layer = told.layer.advertise.unwrap();
        assert_eq!(
            layer.sources[0].node, "m",
            "members alone: other gateways speak for themselves"
        );
        assert_eq!(
            (layer.rate_hz, told.node.advertise.unwrap().rate_hz),
            (Some(50.0), Some(50.0))
        );
        assert!(told.layer.request.is_some() && told.node.request.is_none());
        world.flows.get_mut(&"c/a".parse().unwrap()).unwrap().role = Role::Leaving;
        let told = told_outside(&world, &topic()).unwrap();
        assert!(
            told.layer.advertise.is_none(),
            "one that leaves speaks for itself alone"
        );
    }

    #[test]
    fn members_hear_what_is_outside_and_nothing_is_said_to_a_group_without_any() {
        let lines = [
            "c/a@1",
            "c/m@1 member node+",
            "c/b@1 node+ layer+",
            "e/x@1 layer-",
            "e/y@1 layer-",
            "f/z node+",
            "f/d node+ down",
        ];
        let told = told_inside(&world(&lines), &topic());
        assert_eq!(told.advertise.unwrap().rate_hz, Some(50.0), "of the flow that lives");
        assert!(told.request.is_some());
        assert_eq!(
            told_inside(&world(&["c/a@1", "c/b@1", "f/z node+"]), &topic()),
            ScopeEntry::default()
        );
        assert_eq!(
            told_inside(&world(&["c/a@1 member", "c/m@1 member", "f/z node+"]), &topic()),
            ScopeEntry::default()
        );
    }

    #[test]
    fn merging_asks_for_the_most() {
        let mut world = world(&["c/a@1", "c/m@1 member node-", "c/n@1 member node-"]);
        for (flow, text, rate) in [("c/m", "edge/*/driver", Some(5.0)), ("c/n", "fog/*/*", Some(7.0))] {
            let ask = crate::plan::tests::worlds::ask(&mut world, flow, "node");
            (ask.from, ask.max_rate_hz) = (vec![filter(text)], rate);
        }
        let asked = |world: &World| told_outside(world, &topic()).unwrap().layer.request.unwrap();
        assert_eq!((asked(&world).from.len(), asked(&world).max_rate_hz), (2, Some(7.0)));
        crate::plan::tests::worlds::ask(&mut world, "c/n", "node").from.clear();
        assert!(asked(&world).from.is_empty(), "one asks for any origin");
    }
}
