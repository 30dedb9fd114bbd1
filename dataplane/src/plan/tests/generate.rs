//! Random systems.

use std::collections::BTreeMap;

use blaze_domain::node_file::AccessRules;
use blaze_domain::{FlowId, LayerKind};

use crate::plan::Survey;
use crate::plan::told::{told_inside, told_outside};

use super::worlds::{advertise, flow, network, request, topic};
use crate::testing::Random;
use crate::world::{
    Advertise, FlowState, LayerScopeId, OriginFilter, Reach, Request, Role, Ros2Network,
    ScopeEntry, Source, TopicEntry, World,
};

const SERVICES: [&str; 3] = ["driver", "filter", "logger"];

/// A system: what all flows know, and who really publishes.
#[derive(Clone)]
pub(crate) struct System {
    /// The view of all flows; `me` is set by whoever plans.
    pub(crate) world: World,
    /// Names of nodes that a source or a filter may name.
    pub(crate) nodes: Vec<String>,
}

impl System {
    pub(crate) fn random(dice: &mut Random) -> Self {
        let mut flows = BTreeMap::new();
        for l in 0..3 + dice.index(4) {
            let kind = *dice.pick(LayerKind::ALL);
            // Brokers of different layers may have one number; in one layer there may be two, or
            // flows without.
            let brokers: &[Option<u64>] = match dice.index(4) {
                0 => &[None],
                1 => &[Some(1)],
                2 => &[Some(1), Some(1), None],
                _ => &[Some(1), Some(2), None],
            };
            let networks = System::networks(dice);
            for n in 0..1 + dice.index(4) {
                let mut view = flow(*dice.pick(brokers));
                view.kind = kind;
                view.ros2 = System::network(dice, networks, view.layer_scope);
                let name: FlowId = format!("layer-{l}/n{l}{n}").parse().unwrap();
                flows.insert(name, view);
            }
        }
        let nodes = flows
            .keys()
            .map(|id: &FlowId| id.node.to_string())
            .chain(["ghost".to_owned()])
            .collect();
        let me = flows.keys().next().unwrap().clone();
        let world = World { me, flows, access: AccessRules::default() };
        let mut system = Self { world, nodes };
        for id in system.ids() {
            system.reroll_flow(dice, &id);
            system.reroll_node(dice, &id);
            system.reroll_layer(dice, &id);
            system.reroll_ros2(dice, &id);
        }
        system
    }

    /// ROS 2 networks of the flows of one layer: none, one, one for each flow, several.
    fn networks(dice: &mut Random) -> &'static [Option<u64>] {
        match dice.index(4) {
            0 => &[None],
            1 => &[Some(1)],
            2 => &[Some(1), Some(2), Some(3), Some(4)],
            _ => &[Some(1), Some(1), Some(2), None],
        }
    }

    /// A network of flows that share a layer broker, or of those that have none: a service of a
    /// layer may name the node of a flow that is not on its broker, and what comes from the inter
    /// scope does not say where it was born.
    fn network(
        dice: &mut Random,
        networks: &[Option<u64>],
        broker: Option<LayerScopeId>,
    ) -> Option<Ros2Network> {
        let base = (*dice.pick(networks))?;
        Some(network(base * 10 + broker.map_or(0, |broker| broker.0)))
    }

    /// One with a group of more than 16 flows, where some flows of each group are not on the inter
    /// scope. Types and sources that are not named are left out: where a gateway tells of several
    /// scopes as of one, they match more than they do.
    pub(crate) fn with_gateways(dice: &mut Random) -> Self {
        let mut system = Self::random(dice);
        let networks = System::networks(dice);
        for n in 0..17 + dice.index(6) {
            let name: FlowId = format!("layer-9/n9{n}").parse().unwrap();
            system.nodes.push(name.node.to_string());
            let mut view = flow(Some(1));
            view.ros2 = System::network(dice, networks, view.layer_scope);
            system.world.flows.insert(name, view);
        }
        for id in system.ids() {
            if id.layer.as_str() == "layer-9" {
                system.reroll_flow(dice, &id);
                if dice.percent(40) {
                    system.reroll_node(dice, &id);
                }
                if dice.percent(40) {
                    system.reroll_ros2(dice, &id);
                }
            }
        }
        let first = system.ids().into_iter().find(|id| id.layer.as_str() == "layer-9").unwrap();
        system.reroll_layer(dice, &first);
        for view in system.world.flows.values_mut() {
            let shares = view.layer_scope.is_some();
            view.role = if shares && dice.percent(70) { Role::Member } else { Role::Gateway };
        }
        system.tell_precisely();
        system
    }

    pub(crate) fn tell_precisely(&mut self) {
        let topics = self.world.flows.values_mut().flat_map(|view| view.topics.values_mut());
        for entry in topics.flat_map(|entry| [&mut entry.node, &mut entry.layer, &mut entry.ros2]) {
            entry.advertise.iter_mut().for_each(|offer| {
                offer.type_name.clear();
                offer.more_sources = false;
            });
            entry.request.iter_mut().for_each(|ask| ask.type_name.clear());
        }
    }

    /// What a flow knows: of its group everything, of others what their gateways tell, if it is on
    /// the inter scope, or else what a gateway of its own tells.
    pub(crate) fn known_to(&self, me: &FlowId) -> World {
        let all = |me: &FlowId| World { me: me.clone(), ..self.world.clone() };
        let own = &self.world.flows[me];
        if self.world.flows.values().all(|view| view.role.is_inside()) {
            return all(me);
        }
        let group = |id: &FlowId| {
            share_broker((me, own.layer_scope), (id, self.world.flows[id].layer_scope))
        };
        let mut known = all(me);
        known.flows.retain(|id, view| group(id) || (own.role.is_inside() && view.role.is_inside()));
        for (id, view) in &mut known.flows {
            if !group(id) {
                view.topics.clear();
                view.topics.extend(
                    told_outside(&Survey::new(&all(id)), &topic()).map(|told| (topic(), told)),
                );
            } else if id != me && view.role.is_gateway() && !own.role.is_gateway() {
                let outside = told_inside(&Survey::new(&self.known_to(id)), &topic());
                view.topics.entry(topic()).or_default().outside = outside;
            }
        }
        known
    }

    pub(crate) fn ids(&self) -> Vec<FlowId> {
        self.world.flows.keys().cloned().collect()
    }

    /// Something happens somewhere.
    pub(crate) fn change(&mut self, dice: &mut Random) {
        let id = dice.pick(&self.ids()).clone();
        match dice.index(4) {
            0 => self.reroll_flow(dice, &id),
            1 => self.reroll_node(dice, &id),
            2 => self.reroll_ros2(dice, &id),
            _ => self.reroll_layer(dice, &id),
        }
    }

    fn reroll_flow(&mut self, dice: &mut Random, id: &FlowId) {
        let view = self.world.flows.get_mut(id).unwrap();
        view.node_scope = dice.percent(80);
        view.state = match dice.index(12) {
            0 => FlowState::Starting,
            1 => FlowState::Draining,
            _ => FlowState::Ready,
        };
        view.reach = match dice.index(12) {
            0 => Reach::Down,
            1 => Reach::Suspect,
            _ => Reach::Up,
        };
    }

    fn reroll_node(&mut self, dice: &mut Random, id: &FlowId) {
        let entry = self.scope_entry(dice, Some(id.node.as_str()));
        self.entry(id).node = entry;
    }

    /// Flows that share a broker know the same of it.
    fn reroll_layer(&mut self, dice: &mut Random, id: &FlowId) {
        let mut entry = self.scope_entry(dice, None);
        // There are no bare copies there.
        entry.request.iter_mut().for_each(|ask| ask.framed |= ask.bare || !ask.json);
        let broker = self.world.flows[id].layer_scope;
        for other in self.ids() {
            let same = broker.is_some()
                && other.layer == id.layer
                && self.world.flows[&other].layer_scope == broker;
            if same || other == *id {
                self.entry(&other).layer = entry.clone();
            }
        }
    }

    /// Each flow has writers of its own; those on one network know the same of its readers.
    fn reroll_ros2(&mut self, dice: &mut Random, id: &FlowId) {
        let ScopeEntry { advertise, request } = self.scope_entry(dice, Some(id.node.as_str()));
        let request =
            request.map(|request| Request { framed: true, bare: false, json: false, ..request });
        let network = self.world.flows[id].ros2;
        self.entry(id).ros2.advertise = advertise.filter(|_| network.is_some());
        for other in self.ids() {
            let same = other.layer == id.layer && self.world.flows[&other].ros2 == network;
            if network.is_some() && same {
                self.entry(&other).ros2.request.clone_from(&request);
            }
        }
    }

    fn entry(&mut self, id: &FlowId) -> &mut TopicEntry {
        self.world.flows.get_mut(id).unwrap().topics.entry(topic()).or_default()
    }

    fn scope_entry(&self, dice: &mut Random, node: Option<&str>) -> ScopeEntry {
        ScopeEntry {
            advertise: dice.percent(30).then(|| self.advertise(dice, node)),
            request: dice.percent(35).then(|| self.request(dice)),
        }
    }

    fn advertise(&self, dice: &mut Random, node: Option<&str>) -> Advertise {
        let sources = 1 + dice.index(2);
        let mut sources: Vec<Source> = (0..sources)
            .map(|_| Source {
                node: match node {
                    Some(node) => node.to_owned(),
                    None if dice.percent(50) => String::new(),
                    None => dice.pick(&self.nodes).clone(),
                },
                service: (*dice.pick(&SERVICES)).to_owned(),
            })
            .collect();
        sources.sort();
        sources.dedup();
        Advertise {
            sources,
            more_sources: dice.percent(10),
            type_name: type_name(dice),
            ..advertise()
        }
    }

    fn request(&self, dice: &mut Random) -> Request {
        let filters = if dice.percent(60) { 0 } else { 1 + dice.index(2) };
        let from = (0..filters)
            .map(|_| OriginFilter {
                layer: dice.percent(40).then(|| format!("layer-{}", dice.index(6))),
                node: dice.percent(30).then(|| dice.pick(&self.nodes).clone()),
                service: dice.percent(40).then(|| (*dice.pick(&SERVICES)).to_owned()),
            })
            .collect();
        let wish = dice.index(4);
        Request {
            from,
            type_name: type_name(dice),
            framed: wish < 3,
            bare: wish > 1,
            json: dice.percent(25),
            ..request()
        }
    }

    /// Who really publishes behind an advertisement: what it lists, and everybody that it may have
    /// left out.
    pub(crate) fn sources(&self, advertise: &Advertise, node: Option<&str>) -> Vec<Source> {
        let mut sources = advertise.sources.clone();
        if advertise.more_sources {
            let nodes: Vec<&str> = match node {
                Some(node) => vec![node],
                None => self.nodes.iter().map(String::as_str).chain([""]).collect(),
            };
            for node in nodes {
                sources.extend(
                    SERVICES.map(|service| Source {
                        node: node.to_owned(),
                        service: service.to_owned(),
                    }),
                );
            }
            sources.sort();
            sources.dedup();
        }
        sources
    }
}

fn type_name(dice: &mut Random) -> String {
    ["", "", "", "a/A", "b/B"][dice.index(5)].to_owned()
}

/// Whether two flows use one layer broker.
pub(crate) fn share_broker(
    a: (&FlowId, Option<LayerScopeId>),
    b: (&FlowId, Option<LayerScopeId>),
) -> bool {
    a.0 == b.0 || (a.0.layer == b.0.layer && a.1.is_some() && a.1 == b.1)
}
