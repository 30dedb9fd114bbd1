//! The simulated system: flows, their scopes, services, and the network between them.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::{Content, PublishOutcome, Publisher, PublisherOptions, Received};
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::{AccessRules, AutoBool};
use blaze_domain::{FlowId, LayerKind, Origin, Priority, Scope, TopicName, WriterId};
use blaze_flow::control::{ControlConfig, ControlCore, Output};
use blaze_flow::flow::plane::PlaneState;
use blaze_flow::lane::core::{DataConfig, DataCore};
use blaze_flow::lane::writer::NewWriter;
use blaze_flow::link::transport::Endpoint;
use blaze_flow::link::{Engine, EngineConfig, Limits};
use blaze_flow::plan::{PlanRules, Target};
use blaze_flow::registry::LayerNames;
use blaze_flow::world::{FlowState, LayerScopeId};
use blaze_proto::link::link_control::LayerScope;
use blaze_proto::{Frame, Header};
use bytes::Bytes;
use parking_lot::Mutex;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use serde_json::json;

use crate::quick::flow::flights::Flights;

const STEP: Duration = Duration::from_millis(5);
const TOPICS: [&str; 4] = ["imu/data", "odom", "camera/image", "cmd_vel"];
/// 1970 plus some; flows' clocks agree here.
const WALL_NS: u64 = 1_700_000_000_000_000_000;

/// What goes wrong before the quiet.
pub(crate) struct Chaos {
    pub(crate) loss: f64,
    pub(crate) partitions: bool,
    pub(crate) restarts: bool,
    pub(crate) churn: bool,
}

/// A message in a scope.
type Delivered = (TopicName, WriterId, u64);

/// One scope's broker: survives its flow.
#[derive(Default)]
struct ScopeState {
    /// Written and not yet read by the flow.
    pending: Vec<(ChannelName, Content)>,
    /// Every frame that a flow wrote here: what its services received.
    delivered: Vec<(TopicName, WriterId, u64)>,
    seen: HashSet<(TopicName, WriterId, u64)>,
    twice: Vec<(TopicName, WriterId, u64)>,
}

type ScopeBroker = Arc<Mutex<ScopeState>>;

struct ScopeWriter {
    scope: ScopeBroker,
    topic: TopicName,
}

impl Publisher for ScopeWriter {
    fn publish(&self, frame: &Frame, _: Option<Instant>) -> PublishOutcome {
        let mut scope = self.scope.lock();
        let key = (self.topic.clone(), frame.writer(), frame.sequence());
        if !scope.seen.insert(key.clone()) {
            scope.twice.push(key.clone());
        }
        scope.delivered.push(key);
        // What a flow writes comes back to it, as on Redis.
        scope.pending.push(((&self.topic).into(), Content::from_bytes(frame.to_bytes())));
        PublishOutcome::Taken
    }
    fn publish_bare(&self, _payload: &Bytes, _: Option<Instant>) -> PublishOutcome {
        PublishOutcome::Taken
    }
    fn later(&self) -> blaze_brokers::Later {
        blaze_brokers::Later::default()
    }
}

struct Service {
    flow: usize,
    scope: Scope,
    name: String,
    topic: TopicName,
    publishes: bool,
    reliable: bool,
    writer: WriterId,
    sequence: u64,
    active: bool,
}

struct Flow {
    id: FlowId,
    epoch: u64,
    alive: bool,
    control: ControlCore,
    plane: PlaneState,
    subscribed: BTreeSet<(TopicName, Scope)>,
}

struct Packet {
    to: Endpoint,
    class: Priority,
    datagram: Bytes,
}

pub(crate) struct Simulation<'a> {
    chaos: &'a Chaos,
    random: StdRng,
    start: Instant,
    now: Instant,
    flows: Vec<Flow>,
    scopes: Vec<BTreeMap<Scope, ScopeBroker>>,
    services: Vec<Service>,
    network: Flights<Packet>,
    cut: HashSet<(usize, usize)>,
    calm: bool,
    one_way: Duration,
    jitter: Duration,
    known: HashMap<(usize, usize), u64>,
}

impl<'a> Simulation<'a> {
    pub(crate) fn new(seed: u64, chaos: &'a Chaos) -> Self {
        let mut random = StdRng::seed_from_u64(seed);
        let start = Instant::now();
        let count = random.random_range(2..=5usize);
        let mut simulation = Self {
            chaos,
            one_way: Duration::from_millis(random.random_range(1..=40)),
            jitter: Duration::from_millis(random.random_range(0..=15)),
            start,
            now: start,
            flows: Vec::new(),
            scopes: Vec::new(),
            services: Vec::new(),
            network: Flights::default(),
            cut: HashSet::new(),
            calm: false,
            known: HashMap::new(),
            random,
        };
        for index in 0..count {
            let id: FlowId = format!("layer-{index}/node-{index}").parse().unwrap();
            let scopes: BTreeMap<Scope, ScopeBroker> =
                [(Scope::Node, ScopeBroker::default()), (Scope::Layer, ScopeBroker::default())]
                    .into();
            simulation.scopes.push(scopes);
            let flow = simulation.make_flow(index, id, 1);
            simulation.flows.push(flow);
        }
        let services = simulation.random.random_range(3..=12);
        for number in 0..services {
            simulation.add_service(number);
        }
        simulation
    }

    fn make_flow(&self, index: usize, id: FlowId, epoch: u64) -> Flow {
        let kind = LayerKind::ALL[index % 3];
        let layer_scope = LayerScopeId(index as u64 + 1);
        let control = ControlCore::new(
            ControlConfig {
                me: id.clone(),
                kind,
                epoch,
                node_scope: true,
                layer_scope: Some(layer_scope),
                replicas: None,
                gateway: AutoBool::Auto,
                inter_scope: true,
                layer_answers_need_id: false,
                layer_names: LayerNames::Any,
                lease_stores: BTreeSet::new(),
                rules: PlanRules::default(),
                access: AccessRules::default(),
            },
            self.now,
        );
        let core = DataCore::new(DataConfig {
            me: id.clone(),
            epoch,
            large_bytes: 65_536,
            salt: index as u32,
        });
        let engine_config = EngineConfig {
            me: id.clone(),
            kind,
            epoch,
            layer_scope: (LayerScope::Kafka, layer_scope.0),
            max_datagram: 1300,
            limits: Limits::default(),
        };
        let engine = Engine::new(engine_config, self.now, self.wall());
        let plane = PlaneState { core, engine: Some(engine) };
        Flow { id, epoch, alive: true, control, plane, subscribed: BTreeSet::new() }
    }

    fn add_service(&mut self, number: usize) {
        let flow = self.random.random_range(0..self.flows.len());
        let topic: TopicName = TOPICS[self.random.random_range(0..TOPICS.len())].parse().unwrap();
        let mut writer = [0; 16];
        self.random.fill(&mut writer);
        let service = Service {
            flow,
            scope: if self.random.random_bool(0.5) { Scope::Node } else { Scope::Layer },
            name: format!("service-{number}"),
            topic,
            publishes: self.random.random_bool(0.5),
            reliable: self.random.random_bool(0.6),
            writer: WriterId(writer),
            sequence: 0,
            active: true,
        };
        self.services.push(service);
    }

    fn wall(&self) -> u64 {
        WALL_NS + (self.now - self.start).as_nanos() as u64
    }

    /// The whole story of one seed.
    /// Gives how many deliveries were expected and seen in the last round.
    pub(crate) fn run(mut self) -> Result<usize, String> {
        self.lease_all();
        let chaos = Duration::from_millis(self.random.random_range(2_000..8_000));
        let end = self.now + chaos;
        while self.now < end {
            self.disturb();
            self.publish_some(0.2);
            self.step();
        }
        self.calm = true;
        self.cut.clear();
        for index in 0..self.flows.len() {
            if !self.flows[index].alive {
                self.restart(index);
            }
        }
        for index in 0..self.services.len() {
            if !self.services[index].active && self.random.random_bool(0.7) {
                self.services[index].active = true;
                self.lease(index);
            }
        }
        self.run_for(Duration::from_secs(5));
        self.nothing_twice()?;
        let before = self.delivered_counts();
        let sent = self.publish_round();
        self.run_for(Duration::from_secs(3));
        self.nothing_twice()?;
        self.everybody_has(&sent, &before)
    }

    fn run_for(&mut self, time: Duration) {
        let end = self.now + time;
        while self.now < end {
            self.step();
        }
    }

    fn lease_all(&mut self) {
        for index in 0..self.services.len() {
            self.lease(index);
        }
    }

    /// A service sends its lease, as it does at its start and after `flow_started`.
    fn lease(&mut self, index: usize) {
        let service = &self.services[index];
        if !service.active {
            return;
        }
        let message = if service.publishes {
            let reliability = if service.reliable { "reliable" } else { "best_effort" };
            json!({
                "op": "advertise",
                "topic": service.topic.as_str(),
                "service": service.name,
                "ttl_s": 0,
                "reliability": reliability,
            })
        } else {
            json!({
                "op": "request",
                "topic": service.topic.as_str(),
                "service": service.name,
                "ttl_s": 0,
                "reliability": "reliable",
            })
        };
        self.send_control(index, &message);
    }

    fn send_control(&mut self, index: usize, message: &serde_json::Value) {
        let service = &self.services[index];
        let wall_ms = self.wall() / 1_000_000;
        let flow = &mut self.flows[service.flow];
        if flow.alive {
            flow.control.control(self.now, wall_ms, service.scope, message.to_string().as_bytes());
        }
    }

    fn disturb(&mut self) {
        let flows = self.flows.len();
        if self.chaos.partitions && self.random.random_bool(0.01) {
            let pair = (self.random.random_range(0..flows), self.random.random_range(0..flows));
            if !self.cut.remove(&pair) {
                self.cut.insert(pair);
            }
        }
        if self.chaos.restarts && self.random.random_bool(0.005) {
            let index = self.random.random_range(0..flows);
            if self.flows[index].alive {
                self.flows[index].alive = false;
            } else {
                self.restart(index);
            }
        }
        if self.chaos.churn && self.random.random_bool(0.02) {
            let index = self.random.random_range(0..self.services.len());
            let active = !self.services[index].active;
            self.services[index].active = true;
            if active {
                self.lease(index);
            } else {
                let service = &self.services[index];
                let withdraw = json!({
                    "op": "withdraw",
                    "topic": service.topic.as_str(),
                    "service": service.name,
                });
                self.send_control(index, &withdraw);
                self.services[index].active = false;
            }
        }
    }

    fn restart(&mut self, index: usize) {
        let (id, epoch) = (self.flows[index].id.clone(), self.flows[index].epoch + 1);
        self.flows[index] = self.make_flow(index, id, epoch);
        for scope in self.scopes[index].values() {
            scope.lock().pending.clear();
        }
        for service in 0..self.services.len() {
            if self.services[service].flow == index {
                self.lease(service);
            }
        }
    }

    fn publish_some(&mut self, chance: f64) {
        for index in 0..self.services.len() {
            if self.services[index].publishes
                && self.services[index].active
                && self.random.random_bool(chance)
            {
                let bytes = if self.random.random_bool(0.05) { 20_000 } else { 100 };
                self.publish(index, bytes);
            }
        }
    }

    fn publish(&mut self, index: usize, bytes: usize) -> u64 {
        let wall = self.wall();
        let service = &mut self.services[index];
        service.sequence += 1;
        let flow = &self.flows[service.flow];
        let origin = Origin {
            layer: flow.id.layer.to_string(),
            node: if service.scope == Scope::Node {
                flow.id.node.to_string()
            } else {
                String::new()
            },
            service: service.name.clone(),
            ..Origin::default()
        };
        let header = Header {
            reliable: service.reliable,
            ..Header::new(service.topic.as_str(), origin, service.writer, service.sequence, wall)
        };
        let frame = Frame::new(&header, Bytes::from(vec![7; bytes])).unwrap();
        let scope = &self.scopes[service.flow][&service.scope];
        scope.lock().pending.push(((&service.topic).into(), Content::Frame(frame)));
        service.sequence
    }

    /// Ten messages of every publisher, well apart. Gives what was sent.
    fn publish_round(&mut self) -> Vec<(usize, u64)> {
        let mut sent = Vec::new();
        for _ in 0..10 {
            for index in 0..self.services.len() {
                if self.services[index].publishes && self.services[index].active {
                    sent.push((index, self.publish(index, 100)));
                }
            }
            self.run_for(Duration::from_millis(50));
        }
        sent
    }

    fn step(&mut self) {
        self.now += STEP;
        let wall = self.wall();
        self.discover();
        self.arrive();
        for index in 0..self.flows.len() {
            if self.flows[index].alive {
                self.read_scopes(index, wall);
                self.run_control(index, wall);
                self.transmit(index);
            }
        }
    }

    /// DDS discovery: each sees the other's present life soon after both are up and joined.
    fn discover(&mut self) {
        for a in 0..self.flows.len() {
            for b in 0..self.flows.len() {
                let joined = a != b
                    && self.flows[a].alive
                    && self.flows[b].alive
                    && self.joined(a, b)
                    && self.joined(b, a);
                let epoch = self.flows[b].epoch;
                let life = self.flows[a].epoch * 1_000_000 + epoch;
                if joined && self.known.get(&(a, b)) != Some(&life) && self.random.random_bool(0.05)
                {
                    self.known.insert((a, b), life);
                    let endpoint = Endpoint { flow: self.flows[b].id.clone(), epoch };
                    let now = self.now;
                    if let Some(engine) = &mut self.flows[a].plane.engine {
                        engine.peer_discovered(now, endpoint);
                    }
                }
            }
        }
    }

    fn joined(&self, a: usize, b: usize) -> bool {
        !self.cut.contains(&(a, b))
    }

    fn arrive(&mut self) {
        while let Some(packet) = self.network.arrived(self.now) {
            let reader = self
                .flows
                .iter_mut()
                .find(|f| f.alive && f.id == packet.to.flow && f.epoch == packet.to.epoch);
            if let Some(flow) = reader
                && let Some(engine) = &mut flow.plane.engine
            {
                engine.receive(self.now, packet.datagram, packet.class);
            }
        }
    }

    fn read_scopes(&mut self, index: usize, wall: u64) {
        let now = self.now;
        for (scope, broker) in &self.scopes[index] {
            let pending = std::mem::take(&mut broker.lock().pending);
            let flow = &mut self.flows[index];
            for (channel, content) in pending {
                let Ok(topic) = channel.as_str().parse::<TopicName>() else {
                    continue;
                };
                if !flow.subscribed.contains(&(topic.clone(), *scope)) {
                    continue;
                }
                let Some(id) = flow.plane.core.find(topic.as_str()) else {
                    continue;
                };
                let mut batch =
                    vec![Received { content, at: now, broker_age_us: 0, kept: false, place: None }];
                flow.plane.ingest(now, wall, id, *scope, &mut batch);
            }
        }
    }

    fn run_control(&mut self, index: usize, wall: u64) {
        let now = self.now;
        let scopes = &self.scopes[index];
        let flow = &mut self.flows[index];
        flow.plane.run_timers(now);
        let mut news = Vec::new();
        flow.plane.pump(now, |event| news.push(event));
        for event in news {
            flow.control.link_event(now, event);
        }
        flow.control.tick(now, wall / 1_000_000);
        while let Some(output) = flow.control.poll() {
            let Some(engine) = &mut flow.plane.engine else { continue };
            match output {
                Output::Publish { .. }
                | Output::LayerScope { .. }
                | Output::LayerAway(_)
                | Output::Types { .. }
                | Output::Call { .. }
                | Output::Ros2(_)
                | Output::Owned(_)
                | Output::Show { .. }
                | Output::Replicas { .. }
                | Output::Inter { .. }
                | Output::SaveLease(_)
                | Output::Prepare { .. }
                | Output::Release { .. }
                | Output::ForgetWriters { .. } => {}
                Output::Link { to, body } => drop(engine.send_control(&to, *body)),
                Output::Announce { version, digest } => engine.set_registry(version, digest),
                Output::State(state) => engine.set_state(now, state.into()),
                Output::Plan { topic, plan, info, .. } => {
                    let Some(id) = flow.plane.core.intern(&topic, now) else {
                        continue;
                    };
                    flow.plane.core.apply(now, id, *info, &plan, |bridge| {
                        let scope = match bridge.to {
                            Target::Layer { json: false } => Scope::Layer,
                            _ => Scope::Node,
                        };
                        let writer = ScopeWriter {
                            scope: Arc::clone(&scopes[&scope]),
                            topic: topic.clone(),
                        };
                        Ok(NewWriter {
                            publisher: Arc::new(writer),
                            options: PublisherOptions::default(),
                        })
                    });
                    for scope in [Scope::Node, Scope::Layer] {
                        if flow.plane.core.path(id).reads(scope) {
                            flow.subscribed.insert((topic.clone(), scope));
                        } else {
                            flow.subscribed.remove(&(topic.clone(), scope));
                        }
                    }
                }
            }
        }
    }

    fn transmit(&mut self, index: usize) {
        for _ in 0..40 {
            let now = self.now;
            let Some(transmit) = self.flows[index]
                .plane
                .engine
                .as_mut()
                .and_then(|engine| engine.poll_transmit(now))
            else {
                break;
            };
            let Some(to) = self.flows.iter().position(|flow| flow.id == transmit.to.flow) else {
                continue;
            };
            let loss = if self.calm { 0.0 } else { self.chaos.loss };
            if self.cut.contains(&(index, to)) || self.random.random_bool(loss) {
                continue;
            }
            let copies =
                if !self.calm && loss > 0.0 && self.random.random_bool(0.02) { 2 } else { 1 };
            for _ in 0..copies {
                let jitter = self.jitter.mul_f64(self.random.random());
                let packet = Packet {
                    to: transmit.to.clone(),
                    class: transmit.class,
                    datagram: transmit.datagram.clone(),
                };
                self.network.send(self.now + self.one_way + jitter, packet);
            }
        }
        let now = self.now;
        let mut news = Vec::new();
        self.flows[index].plane.pump(now, |event| news.push(event));
        for event in news {
            self.flows[index].control.link_event(now, event);
        }
    }

    fn nothing_twice(&self) -> Result<(), String> {
        for (index, scopes) in self.scopes.iter().enumerate() {
            for (scope, broker) in scopes {
                if let Some((topic, writer, sequence)) = broker.lock().twice.first() {
                    return Err(format!(
                        "{topic} {writer} {sequence} was written twice into {scope} of \
                         layer-{index}"
                    ));
                }
            }
        }
        Ok(())
    }

    fn delivered_counts(&self) -> HashMap<(usize, Scope), usize> {
        let counts = self.scopes.iter().enumerate().flat_map(|(index, scopes)| {
            scopes
                .iter()
                .map(move |(scope, broker)| ((index, *scope), broker.lock().delivered.len()))
        });
        counts.collect()
    }

    fn everybody_has(
        &self,
        sent: &[(usize, u64)],
        before: &HashMap<(usize, Scope), usize>,
    ) -> Result<usize, String> {
        let mut expected: BTreeMap<(usize, Scope), BTreeSet<Delivered>> = BTreeMap::new();
        let mut wanted: BTreeMap<(usize, Scope), BTreeSet<&TopicName>> = BTreeMap::new();
        for request in self.services.iter().filter(|service| service.active && !service.publishes) {
            wanted.entry((request.flow, request.scope)).or_default().insert(&request.topic);
        }
        for (place, topics) in &wanted {
            for (publisher, sequence) in sent {
                let publisher = &self.services[*publisher];
                // On its own scope a service hears the publisher without a flow.
                if (publisher.flow, publisher.scope) != *place && topics.contains(&publisher.topic)
                {
                    let key = (publisher.topic.clone(), publisher.writer, *sequence);
                    expected.entry(*place).or_default().insert(key);
                }
            }
        }
        let deliveries = expected.values().map(BTreeSet::len).sum();
        for (index, scopes) in self.scopes.iter().enumerate() {
            for (scope, broker) in scopes {
                let place = (index, *scope);
                let from = before.get(&place).copied().unwrap_or(0);
                let got: BTreeSet<_> = broker.lock().delivered[from..].iter().cloned().collect();
                let want = expected.remove(&place).unwrap_or_default();
                if let Some(missing) = want.difference(&got).next() {
                    return Err(format!(
                        "{missing:?} did not reach {scope} of layer-{index} ({} of {} missing); {}",
                        want.difference(&got).count(),
                        want.len(),
                        self.describe()
                    ));
                }
                let fresh: BTreeSet<_> =
                    sent.iter().map(|(s, n)| (self.services[*s].writer, *n)).collect();
                let needless =
                    got.iter().find(|key| fresh.contains(&(key.1, key.2)) && !want.contains(*key));
                if let Some(needless) = needless {
                    return Err(format!(
                        "{needless:?} reached {scope} of layer-{index} and nobody asked for it"
                    ));
                }
            }
        }
        Ok(deliveries)
    }

    fn describe(&self) -> String {
        let mut text = String::new();
        for flow in &self.flows {
            let states = flow.control.state();
            text.push_str(&format!("[{} epoch {} {states:?}", flow.id, flow.epoch));
            for (other, view) in &flow.control.world().flows {
                text.push_str(&format!(
                    " {other}:{:?}/{:?}/{} topics",
                    view.reach,
                    view.state,
                    view.topics.len()
                ));
            }
            text.push_str("] ");
        }
        if self.flows.iter().any(|flow| flow.control.state() != FlowState::Ready) {
            text.push_str("not all flows are ready");
        }
        text
    }
}
