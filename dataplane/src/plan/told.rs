//! What a gateway tells of flows that others cannot hear: outside of those of its group that are
//! not on the inter scope, and those of the flows outside.

use std::collections::BTreeSet;

use blaze_domain::{FlowId, TopicName};

use super::Group;
use super::network::{self, Network};
use super::survey::{Survey, carries};
use crate::registry::requesters;
use crate::world::{Advertise, FlowView, OriginFilter, Request, ScopeEntry, Source, TopicEntry};

/// Most services that one merged entry lists.
const MAX_SOURCES: usize = 256;
/// Most different origin filters of one merged request; with more, messages of any origin are asked
/// for.
const MAX_FILTERS: usize = 128;

/// What the own flow tells flows of other groups of a topic: what its own services say, and as of
/// its layer scope what those of the flows say that are not on the inter scope. `None` where nobody
/// says anything.
#[must_use]
pub(crate) fn told_outside(survey: &Survey<'_>, topic: &TopicName) -> Option<TopicEntry> {
    let own = survey.world.own()?;
    let mut told = own.topics.get(topic).cloned().unwrap_or_default();
    if survey.speaks_for_others() {
        let mut own_layer = std::mem::take(&mut told.layer);
        let mut of_nodes = Vec::new();
        // Another flow may write to the network.
        let mut of_networks = Vec::new();
        for (id, view, entry) in survey.entries(topic, |id, view| survey.is_behind(id, view)) {
            // Every flow of the group has the same leases there, so one of them is enough.
            own_layer.advertise = own_layer.advertise.or_else(|| entry.layer.advertise.clone());
            own_layer.request = own_layer.request.or_else(|| entry.layer.request.clone());
            of_nodes.extend(view.node_scope.then_some(&entry.node));
            of_networks.extend(Network::of(id, view).map(|network| {
                let reads = network::writer(&survey.networks, network, topic) == Some(id);
                let request = entry.ros2.request.clone().filter(|_| reads);
                ScopeEntry { advertise: entry.ros2.advertise.clone(), request }
            }));
        }
        let others = of_nodes.into_iter().chain(&of_networks);
        told.layer = merge(std::iter::once(&own_layer).chain(others));
    }
    (!told.is_empty()).then_some(told)
}

/// What the own flow tells flows of its group that are not on the inter scope: what other groups
/// advertise and request.
#[must_use]
pub(crate) fn told_inside(survey: &Survey<'_>, topic: &TopicName) -> ScopeEntry {
    let Some(here) = survey.group().filter(|_| survey.speaks_for_others()) else {
        return ScopeEntry::default();
    };
    let mut groups = BTreeSet::new();
    let mut entries = Vec::new();
    let is_outside = |id: &FlowId, view: &FlowView| carries(view) && Group::of(id, view) != here;
    for (id, view, entry) in survey.entries(topic, is_outside) {
        entries.extend(view.node_scope.then_some(&entry.node));
        entries.extend(view.ros2.map(|_| &entry.ros2));
        // Flows that share a broker say the same of it.
        let says_something = entry.layer.advertise.is_some() || entry.layer.request.is_some();
        if view.layer_scope.is_some() && says_something && groups.insert(Group::of(id, view)) {
            entries.push(&entry.layer);
        }
    }
    merge(entries)
}

/// What several scopes say, as of one.
fn merge<'a>(entries: impl IntoIterator<Item = &'a ScopeEntry>) -> ScopeEntry {
    let (mut offers, mut requests) = (Vec::new(), Vec::new());
    for entry in entries {
        offers.extend(&entry.advertise);
        requests.extend(&entry.request);
    }
    ScopeEntry { advertise: merge_offers(offers), request: merge_requests(requests) }
}

/// Advertisements of several scopes as one: sum of rates, largest size, strongest quality of
/// service.
pub(crate) fn merge_offers<'a>(
    offers: impl IntoIterator<Item = &'a Advertise>,
) -> Option<Advertise> {
    let mut offers = offers.into_iter().peekable();
    let first = offers.next()?;
    let mut merged = first.clone();
    if offers.peek().is_none() {
        return Some(merged);
    }
    let mut sources: BTreeSet<&Source> = first.sources.iter().collect();
    for other in offers {
        add_offer(&mut merged, other);
        if merged.more_sources && sources.len() >= MAX_SOURCES {
            // Not all are told anyway, and those of a thousand flows take long to look at.
            continue;
        }
        for source in &other.sources {
            if sources.insert(source) && sources.len() > MAX_SOURCES {
                sources.pop_last();
                merged.more_sources = true;
            }
        }
    }
    merged.sources = sources.into_iter().cloned().collect();
    Some(merged)
}

/// All but the sources.
fn add_offer(merged: &mut Advertise, other: &Advertise) {
    merged.rate_hz = merged.rate_hz.zip(other.rate_hz).map(|(a, b)| a + b);
    merged.max_bytes = merged.max_bytes.zip(other.max_bytes).map(|(a, b)| a.max(b));
    keep_same(&mut merged.type_name, &other.type_name);
    keep_same(&mut merged.type_hash, &other.type_hash);
    merged.reliability = merged.reliability.max(other.reliability);
    merged.durability = merged.durability.max(other.durability);
    merged.depth = merged.depth.max(other.depth);
    merged.priority = [merged.priority, other.priority].into_iter().flatten().min();
    merged.lifespan_ms = longer(merged.lifespan_ms, other.lifespan_ms);
    merged.more_sources |= other.more_sources;
}

/// Requests of several scopes as one: highest rate, strongest quality of service, every origin that
/// one of them asks for.
pub(crate) fn merge_requests<'a>(
    requests: impl IntoIterator<Item = &'a Request>,
) -> Option<Request> {
    let mut requests = requests.into_iter().peekable();
    let first = requests.next()?;
    let mut merged = first.clone();
    if requests.peek().is_none() {
        return Some(merged);
    }
    // How a scope behind a gateway is served is the affair of the flow that has it.
    (merged.framed, merged.bare, merged.json) = (true, false, false);
    let mut filters: BTreeSet<&OriginFilter> = first.from.iter().collect();
    let mut any_origin = filters.is_empty();
    for other in requests {
        add_request(&mut merged, other);
        any_origin |= other.from.is_empty();
        if !any_origin {
            filters.extend(&other.from);
            any_origin = filters.len() > MAX_FILTERS;
        }
    }
    if any_origin {
        filters.clear();
    }
    merged.from = filters.into_iter().cloned().collect();
    Some(merged)
}

/// All but the origins.
fn add_request(merged: &mut Request, other: &Request) {
    merged.max_rate_hz = merged.max_rate_hz.zip(other.max_rate_hz).map(|(a, b)| a.max(b));
    merged.lifespan_ms = longer(merged.lifespan_ms, other.lifespan_ms);
    merged.reliability = merged.reliability.max(other.reliability);
    merged.durability = merged.durability.max(other.durability);
    merged.depth = merged.depth.max(other.depth);
    // A request may only lower the class, so one that says nothing asks for the highest there is.
    merged.priority = merged.priority.zip(other.priority).map(|(a, b)| a.min(b));
    keep_same(&mut merged.type_name, &other.type_name);
    keep_same(&mut merged.type_hash, &other.type_hash);
    let all = merged.services.iter().chain(&other.services).cloned();
    let others = merged.more_services.saturating_add(other.more_services);
    (merged.services, merged.more_services) = requesters(all, others);
}

/// A type or hash that both give; where they differ, none: nobody is to miss what another one's
/// type keeps away.
fn keep_same(held: &mut String, other: &str) {
    if held != other {
        held.clear();
    }
}

/// The longer lifespan, where 0 is infinite.
fn longer(a: u32, b: u32) -> u32 {
    if a == 0 || b == 0 { 0 } else { a.max(b) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tests::worlds::{filter, offer, topic, world};
    use crate::world::{Role, World};

    fn inside(lines: &[&str]) -> ScopeEntry {
        told_inside(&Survey::new(&world(lines)), &topic())
    }

    #[test]
    fn outside_hears_what_is_behind_a_gateway_as_of_its_layer_scope() {
        let mut world = world(&[
            "c/a@1 layer- node+",
            "c/b@1 node+ layer-",
            "c/m@1 member node+ layer-",
            "c/n@1 member node-",
        ]);
        offer(&mut world, "c/m", "node").sources[0].node = "m".to_owned();
        let told = told_outside(&Survey::new(&world), &topic()).unwrap();
        let layer = told.layer.advertise.unwrap();
        assert_eq!(
            layer.sources[0].node, "m",
            "members alone: other gateways speak for themselves"
        );
        assert_eq!((layer.rate_hz, told.node.advertise.unwrap().rate_hz), (Some(50.0), Some(50.0)));
        assert!(told.layer.request.is_some() && told.node.request.is_none());
        world.flows.get_mut(&"c/a".parse().unwrap()).unwrap().role = Role::Leaving;
        let told = told_outside(&Survey::new(&world), &topic()).unwrap();
        assert!(told.layer.advertise.is_none(), "one that leaves speaks for itself alone");
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
        let told = inside(&lines);
        assert_eq!(told.advertise.unwrap().rate_hz, Some(50.0), "of the flow that lives");
        assert!(told.request.is_some());
        assert_eq!(inside(&["c/a@1", "c/b@1", "f/z node+"]), ScopeEntry::default());
        assert_eq!(inside(&["c/a@1 member", "c/m@1 member", "f/z node+"]), ScopeEntry::default());
    }

    #[test]
    fn merging_asks_for_the_most() {
        let mut world = world(&["c/a@1", "c/m@1 member node-", "c/n@1 member node-"]);
        for (flow, text, rate) in
            [("c/m", "edge/*/driver", Some(5.0)), ("c/n", "fog/*/*", Some(7.0))]
        {
            let ask = crate::plan::tests::worlds::ask(&mut world, flow, "node");
            (ask.from, ask.max_rate_hz) = (vec![filter(text)], rate);
        }
        let asked = |world: &World| {
            told_outside(&Survey::new(world), &topic()).unwrap().layer.request.unwrap()
        };
        assert_eq!((asked(&world).from.len(), asked(&world).max_rate_hz), (2, Some(7.0)));
        crate::plan::tests::worlds::ask(&mut world, "c/n", "node").from.clear();
        assert!(asked(&world).from.is_empty(), "one asks for any origin");
    }

    #[test]
    fn of_many_services_some_are_told_and_that_there_are_more() {
        let offer = |names: std::ops::Range<usize>| {
            let source = |n| Source { node: format!("n{n:04}"), service: "s".to_owned() };
            let mut world = world(&["c/a@1 node+"]);
            let one = crate::plan::tests::worlds::offer(&mut world, "c/a", "node");
            one.sources = names.map(source).collect();
            one.clone()
        };
        let parts = [offer(300..310), offer(0..200), offer(100..MAX_SOURCES), offer(400..401)];
        let merged = merge_offers(&parts).unwrap();
        let first: Vec<String> = (0..MAX_SOURCES).map(|n| format!("n{n:04}")).collect();
        let told: Vec<&String> = merged.sources.iter().map(|source| &source.node).collect();
        assert_eq!(told, first.iter().collect::<Vec<_>>());
        assert!(merged.more_sources && !merge_offers(&parts[1..3]).unwrap().more_sources);
        assert_eq!(merged.rate_hz, Some(200.0));
    }
}
