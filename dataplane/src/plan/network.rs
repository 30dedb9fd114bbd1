//! ROS 2 networks: which flow owns a writer there, which one writes a message there, and which
//! layer a network belongs to.
//!
//! ```text
//! writers ──► one flow owns each: it reads it, and announces it as a service of its own
//! readers ◄── one flow writes a message: that of its origin if it is on the network, else the one
//!             that hashing chooses for the topic
//! ```
//!
//! Between endpoints of one network there is no bridge. To the flow that writes for it, a network
//! is like a node scope: a message from elsewhere comes to it over the layer broker or the inter
//! scope.

use std::collections::{BTreeMap, BTreeSet};
use std::net::Ipv4Addr;

use blaze_domain::{Durability, FlowId, LayerName, Reliability, Scope, TopicName, WriterId};

use super::told::merge_offers;
use super::{Survey, rendezvous};
use crate::world::{
    Advertise, FlowView, Reach, Request, Ros2Network, Ros2NetworkId, ScopeEntry, TopicEntry, World,
};

/// The flows of a layer on one ROS 2 network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct Network<'w> {
    layer: &'w LayerName,
    id: Ros2NetworkId,
}

impl<'w> Network<'w> {
    /// The network that a flow is on.
    pub(crate) fn of(id: &'w FlowId, flow: &FlowView) -> Option<Self> {
        flow.ros2.map(|network| Self { layer: &id.layer, id: network.id })
    }
}

/// Flows on a network, sorted. What was born on their nodes, or on the network, they write there
/// themselves, so that the flow that writes the rest leaves it out. A service of the layer scope
/// may name any node of its layer: what counts is the way that a message has come.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Natives {
    /// Those that share the layer broker.
    pub here: Vec<FlowId>,
    /// The others.
    pub elsewhere: Vec<FlowId>,
}

impl Natives {
    /// Whether one of them writes a message to the network that came from this scope after so many
    /// hops, with this layer and node as its origin.
    #[must_use]
    pub fn write(&self, from: Scope, hops: u32, layer: &str, node: &str) -> bool {
        match (from, hops) {
            (Scope::Layer, 0) => false,
            (Scope::Layer, 1) => holds(&self.here, layer, node),
            _ => holds(&self.elsewhere, layer, node),
        }
    }
}

/// Whether sorted flows hold that of a node.
pub(super) fn holds(flows: &[FlowId], layer: &str, node: &str) -> bool {
    let order = |flow: &FlowId| (flow.layer.as_str(), flow.node.as_str()).cmp(&(layer, node));
    flows.binary_search_by(order).is_ok()
}

/// The networks of a world, each with its flows that carry topics.
pub(crate) type Networks<'w> = BTreeMap<Network<'w>, Vec<&'w FlowId>>;

/// The networks of a world.
pub(crate) fn networks(world: &World) -> Networks<'_> {
    let mut networks = Networks::new();
    for (id, flow) in &world.flows {
        if let Some(network) = Network::of(id, flow).filter(|_| world.carries(id)) {
            networks.entry(network).or_default().push(id);
        }
    }
    networks
}

/// The flow that writes messages of a topic to a network whose origin is on none of its flows.
pub(crate) fn writer<'w>(
    networks: &Networks<'w>,
    network: Network<'w>,
    topic: &TopicName,
) -> Option<&'w FlowId> {
    rendezvous::choose(topic.as_str(), networks.get(&network)?.iter().copied())
}

/// Whether messages of the topic are requests to a service or replies of one: they are written by
/// the flow that they name.
#[must_use]
pub fn is_of_service(topic: &TopicName) -> bool {
    topic.as_str().rsplit('/').next().is_some_and(|last| matches!(last, "_request" | "_reply"))
}

/// What shows of a topic on a network before anybody there asks for it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Shown {
    /// ROS type, such as `sensor_msgs/msg/Imu`.
    pub type_name: String,
    /// As it is offered.
    pub reliability: Reliability,
    /// As it is offered.
    pub durability: Durability,
}

/// What the own flow shows of a topic on its network: what is offered elsewhere in one ROS type, or
/// on its own node.
pub(crate) fn shown(survey: &Survey<'_>, topic: &TopicName) -> Option<Shown> {
    let world = survey.world;
    let (me, own) = world.flows.get_key_value(&world.me)?;
    let network = Network::of(me, own).filter(|_| world.carries(me))?;
    if is_of_service(topic) {
        return shown_server(survey, network, topic);
    }
    let is_own = |id: &FlowId, scope| id == me && scope == Scope::Node;
    let writes_others = || writer(&survey.networks, network, topic) == Some(me);
    // What flows of the network offer on their nodes, each of them shows itself.
    let is_of_others = |id: &FlowId, flow: &FlowView, scope| {
        let on_network = Network::of(id, flow) == Some(network);
        !on_network || matches!(scope, Scope::Layer | Scope::Inter)
    };
    let holders = survey.holders(topic).into_iter().filter(|(id, _)| world.carries(id));
    let offers = holders.flat_map(|(id, flow)| {
        let entries = flow.topics.get(topic).map(TopicEntry::scopes).into_iter().flatten();
        entries.filter_map(move |(scope, entry)| Some((id, flow, scope, entry.advertise.as_ref()?)))
    });
    let shown = offers.filter(|(id, flow, scope, _)| {
        is_own(id, *scope) || (is_of_others(id, flow, *scope) && writes_others())
    });
    let offer = merge_offers(shown.map(|(.., offer)| offer))?;
    let Advertise { type_name, reliability, durability, .. } = offer;
    (!type_name.is_empty()).then_some(Shown { type_name, reliability, durability })
}

/// What shows of a server elsewhere: that it reads requests, or writes replies. Each flow of a
/// network shows it, as each takes the requests of its own clients; none does where the network has
/// a server of its own.
fn shown_server(survey: &Survey<'_>, network: Network<'_>, topic: &TopicName) -> Option<Shown> {
    let of = |entry: &ScopeEntry| {
        if is_request(topic) {
            let Request { type_name, reliability, durability, .. } = entry.request.clone()?;
            return Some(Shown { type_name, reliability, durability });
        }
        let Advertise { type_name, reliability, durability, .. } = entry.advertise.clone()?;
        Some(Shown { type_name, reliability, durability })
    };
    let mut shown = None;
    for (id, flow) in survey.holders(topic).into_iter().filter(|(id, _)| survey.world.carries(id)) {
        let Some(entry) = flow.topics.get(topic) else { continue };
        let of_ros2 = flow.ros2.and_then(|_| of(&entry.ros2));
        if of_ros2.is_some() && Network::of(id, flow) == Some(network) {
            return None;
        }
        shown = shown.or(of_ros2).or_else(|| of(&entry.layer));
    }
    shown.filter(|shown| !shown.type_name.is_empty())
}

/// The flows whose networks have a server of a service, sorted; a client that one of these is on
/// the network of needs none of them.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Servers {
    /// Those of the own layer, which come first.
    pub here: Vec<FlowId>,
    /// Those of other layers.
    pub elsewhere: Vec<FlowId>,
}

impl Servers {
    /// The flow that a client's requests go to. `before`: where they went until now, which stays as
    /// long as there is a server.
    #[must_use]
    pub fn choose(&self, client: WriterId, before: Option<&FlowId>) -> Option<&FlowId> {
        let all = || self.here.iter().chain(&self.elsewhere);
        let kept = before.and_then(|before| all().find(|flow| *flow == before));
        let key = client.to_string();
        kept.or_else(|| rendezvous::choose(&key, self.here.iter()))
            .or_else(|| rendezvous::choose(&key, self.elsewhere.iter()))
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.here.is_empty() && self.elsewhere.is_empty()
    }
}

/// The flows that requests of a topic may go to; none for other topics.
pub(crate) fn servers(survey: &Survey<'_>, topic: &TopicName) -> Servers {
    let world = survey.world;
    let mut all = BTreeSet::new();
    if is_request(topic) {
        for (id, flow) in survey.holders(topic).into_iter().filter(|(id, _)| world.carries(id)) {
            let Some(entry) = flow.topics.get(topic) else { continue };
            all.extend((flow.ros2.is_some() && entry.ros2.request.is_some()).then(|| id.clone()));
            // A gateway names the nodes of those that it speaks for.
            let told = entry.layer.request.iter().flat_map(|request| &request.services);
            all.extend(
                told.filter_map(|of| Some(FlowId::new(id.layer.clone(), of.node.parse().ok()?))),
            );
        }
    }
    let (here, elsewhere) = all.into_iter().partition(|flow| flow.layer == world.me.layer);
    Servers { here, elsewhere }
}

/// Whether messages of the topic are requests to a service.
pub(super) fn is_request(topic: &TopicName) -> bool {
    topic.as_str().rsplit('/').next() == Some("_request")
}

/// A flow that could own a writer of its network.
pub type Candidate = (FlowId, Ipv4Addr);

/// The flows on the network of the own flow that could own a writer there.
#[must_use]
pub fn candidates(world: &World) -> Vec<Candidate> {
    let here = world.flows.get_key_value(&world.me).and_then(|(id, own)| Network::of(id, own));
    let able = |(id, flow): (&FlowId, &FlowView)| {
        let same = here.is_some() && Network::of(id, flow) == here;
        (same && world.carries(id)).then_some((id.clone(), flow.ros2?.address))
    };
    world.flows.iter().filter_map(able).collect()
}

/// The flow that owns a writer because it has one of the writer's addresses; of several, as on
/// loopback, the one that hashing chooses for the writer.
#[must_use]
pub fn claimant<'c>(
    candidates: &'c [Candidate],
    locators: &[Ipv4Addr],
    guid: WriterId,
) -> Option<&'c FlowId> {
    let claims = candidates.iter().filter(|(_, address)| locators.contains(address));
    rendezvous::choose(&guid.to_string(), claims.map(|(flow, _)| flow))
}

/// The flow that owns a writer which nobody has claimed for some time.
#[must_use]
pub fn heir(candidates: &[Candidate], guid: WriterId) -> Option<&FlowId> {
    rendezvous::choose(&guid.to_string(), candidates.iter().map(|(flow, _)| flow))
}

/// The flow of another layer that the own flow has to leave its network to, if any: one with a
/// smaller epoch, or the same and a smaller name. `network`: where the own flow would be. `nodes`:
/// those of flows that were found on it.
#[must_use]
pub fn holder<'w>(
    world: &'w World,
    network: Ros2Network,
    nodes: &BTreeSet<String>,
) -> Option<&'w FlowId> {
    let own = world.own()?;
    let is_there = |id: &FlowId, flow: &FlowView| {
        let is_found = || !nodes.is_empty() && nodes.contains(&id.ros2_node());
        flow.ros2.is_some_and(|other| other.id == network.id || is_found())
    };
    let mut others = world.flows.iter().filter(|(id, flow)| {
        id.layer != world.me.layer && flow.reach != Reach::Down && is_there(id, flow)
    });
    let precedes = |(id, flow): &(&FlowId, &FlowView)| (flow.epoch, *id) < (own.epoch, &world.me);
    others.find(precedes).map(|(id, _)| id)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tests::worlds::{id, network, topic, world};

    fn guid(n: u8) -> WriterId {
        WriterId([n; 16])
    }

    #[test]
    fn a_writer_belongs_to_the_flow_that_has_one_of_its_addresses() {
        let mut world = world(&["e/a net1", "e/b net1", "e/c net2", "f/d net1", "e/e net1 down"]);
        let at = |n: u8| Ipv4Addr::new(10, 0, 0, n);
        for (n, view) in (1..).zip(world.flows.values_mut()) {
            view.ros2.as_mut().unwrap().address = at(n);
        }
        let all = candidates(&world);
        assert_eq!(all, [(id("e/a"), at(1)), (id("e/b"), at(2))], "of one layer, alive");
        assert_eq!(claimant(&all, &[at(9), at(2)], guid(1)), Some(&id("e/b")));
        assert_eq!(claimant(&all, &[at(9)], guid(1)), None);
        world.me = id("f/d");
        assert_eq!(candidates(&world).len(), 1);
    }

    #[test]
    fn of_several_that_could_own_a_writer_hashing_chooses_one() {
        let flows = ["e/a net1", "e/b net1", "e/c net1"];
        let all = candidates(&world(&flows));
        let mut owned = BTreeMap::new();
        for n in 0..90 {
            let owner = claimant(&all, &[Ipv4Addr::LOCALHOST], guid(n)).unwrap();
            assert_eq!(heir(&all, guid(n)), Some(owner), "the same hash");
            *owned.entry(owner).or_insert(0) += 1;
        }
        assert!(owned.len() == 3 && owned.values().all(|count| *count > 10), "{owned:?}");
        assert_eq!(heir(&[], guid(1)), None);
    }

    #[test]
    fn one_flow_writes_a_topic_to_a_network() {
        let lines = ["e/a net1", "e/b net1", "e/c net1", "e/d net2", "e/x net1 draining"];
        let world = world(&lines);
        let networks = networks(&world);
        let of = |flow: &str| {
            let (id, view) = world.flows.get_key_value(&id(flow)).unwrap();
            Network::of(id, view).unwrap()
        };
        let chosen = writer(&networks, of("e/a"), &topic()).unwrap();
        assert_eq!(writer(&networks, of("e/c"), &topic()), Some(chosen));
        assert_eq!(writer(&networks, of("e/d"), &topic()), Some(&id("e/d")));
        for (name, is_one) in
            [("add/_request", true), ("add/_reply", true), ("a/_request/b", false), ("x", false)]
        {
            assert_eq!(is_of_service(&name.parse().unwrap()), is_one, "{name}");
        }
    }

    #[test]
    fn a_client_has_a_server_of_its_layer_and_stays_with_the_one_that_it_has() {
        let flows = |names: &[&str]| names.iter().map(|name| id(name)).collect::<Vec<_>>();
        let of = |here: &[&str], elsewhere: &[&str]| Servers {
            here: flows(here),
            elsewhere: flows(elsewhere),
        };
        assert_eq!(of(&[], &[]).choose(guid(1), Some(&id("f/a"))), None);
        let far = of(&[], &["f/a", "f/b"]);
        let mut chosen: Vec<&FlowId> = (0..40).filter_map(|n| far.choose(guid(n), None)).collect();
        chosen.sort();
        chosen.dedup();
        assert_eq!(chosen.len(), 2, "different clients have different ones");
        let near = of(&["e/x"], &["f/a", "f/b"]);
        assert_eq!(near.choose(guid(1), None), Some(&id("e/x")));
        assert_eq!(near.choose(guid(1), Some(&id("f/b"))), Some(&id("f/b")));
        assert_eq!(near.choose(guid(1), Some(&id("f/gone"))), Some(&id("e/x")));
    }

    #[test]
    fn a_network_belongs_to_the_layer_whose_flow_is_older() {
        let nobody = BTreeSet::new();
        let of = |lines: &[&str], epochs: [u64; 2], found: &BTreeSet<String>| {
            let mut world = world(lines);
            for (view, epoch) in world.flows.values_mut().zip(epochs) {
                view.epoch = epoch;
            }
            world.me = id("f/m");
            holder(&world, network(1), found).cloned()
        };
        let one = ["e/a net1", "f/m net1"];
        let held = Some(id("e/a"));
        assert_eq!(of(&one, [1, 2], &nobody), held);
        assert_eq!(of(&one, [2, 2], &nobody), held, "the smaller name");
        assert_eq!(of(&one, [3, 2], &nobody), None);
        assert_eq!(of(&["e/a net1 starting", "f/m net1"], [1, 2], &nobody), held);
        assert_eq!(of(&["e/a net1 down", "f/m net1"], [1, 2], &nobody), None);
        assert_eq!(of(&["f/a net1", "f/m net1"], [1, 2], &nobody), None, "one layer");
        let two = ["e/a net9", "f/m net1"];
        assert_eq!(of(&two, [1, 2], &nobody), None);
        assert_eq!(of(&two, [1, 2], &BTreeSet::from([id("e/a").ros2_node()])), held, "found on it");
        assert_eq!(
            of(&["e/a", "f/m net1"], [1, 2], &BTreeSet::from([id("e/a").ros2_node()])),
            None
        );
    }
}
