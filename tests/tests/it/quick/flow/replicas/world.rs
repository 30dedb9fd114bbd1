//! The simulated system: brokers, wire and clock around the cores of production.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::Content;
use blaze_domain::node_file::{AccessRules, AutoBool};
use blaze_domain::{FlowId, LayerKind, Origin, Scope, TopicName, WriterId};
use blaze_flow::control::{ControlConfig, ControlCore};
use blaze_flow::flow::plane::PlaneState;
use blaze_flow::lane::core::{DataConfig, DataCore};
use blaze_flow::link::transport::Endpoint;
use blaze_flow::link::{Engine, EngineConfig, Limits};
use blaze_flow::plan::{PlanRules, Target, TopicPlan};
use blaze_flow::registry::LayerNames;
use blaze_flow::world::LayerScopeId;
use blaze_proto::link::link_control::LayerScope;
use blaze_proto::{Frame, Header};
use bytes::Bytes;
use parking_lot::Mutex;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use serde_json::json;

use super::parts::{End, Flow, Found, Life, Log, Packet, Record, Server, Stream, channel};
use crate::quick::flow::flights::Flights;

const STEP: Duration = Duration::from_millis(5);
const WALL_NS: u64 = 1_700_000_000_000_000_000;
/// From the robot to the cloud, and back.
const UP: &str = "imu/data";
const DOWN: &str = "cmd/vel";
/// From the node of each cloud flow to the robot, and from the robot to each.
pub(crate) const STATUS: &str = "status";
pub(crate) const TELEOP: &str = "teleop";
/// Between two messages of a publisher.
const PERIOD: Duration = Duration::from_millis(20);

pub(crate) struct World {
    pub(crate) random: StdRng,
    pub(crate) start: Instant,
    pub(crate) now: Instant,
    pub(crate) clock: Arc<Mutex<Instant>>,
    /// 0 is the robot.
    pub(crate) flows: Vec<Flow>,
    pub(crate) kafka: Server,
    pub(crate) redis: Server,
    pub(crate) network: Flights<Packet>,
    pub(crate) known: HashMap<(usize, usize), (u64, u64)>,
    pub(crate) one_way: Duration,
    pub(crate) kafka_delay: Duration,
    pub(crate) publishing: bool,
    pub(crate) next_publish: Instant,
    pub(crate) sent: u64,
    pub(crate) split: bool,
    pub(crate) handed_over: u64,
    /// How many messages the services of a node had when its flow was started again, each time.
    pub(crate) lives: BTreeMap<usize, Vec<usize>>,
    /// How many flows share Kafka.
    pub(crate) clouds: usize,
    /// Services on the nodes of the cloud publish, too.
    pub(crate) of_nodes: bool,
    /// What services on nodes have published: flow and sequence.
    pub(crate) said: Vec<(usize, u64)>,
    pub(crate) round: u64,
    /// More topics from the cloud to the robot.
    pub(crate) streams: Vec<Stream>,
}

impl World {
    /// Two replicas.
    pub(crate) fn new(seed: u64) -> Self {
        Self::loaded(seed, 2, &[])
    }

    /// So many replicas, and more topics to the robot: bytes of a message, messages per second.
    pub(crate) fn loaded(seed: u64, replicas: usize, streams: &[(usize, u32)]) -> Self {
        let mut world = Self::begin(seed, replicas, streams);
        world.run_for(Duration::from_secs(6));
        world.publishing = true;
        world.next_publish = world.now;
        for stream in &mut world.streams {
            stream.next = world.now;
        }
        world
    }

    /// A robot and so many flows on one Kafka, which have just begun.
    pub(crate) fn with(seed: u64, clouds: usize) -> Self {
        Self::begin(seed, clouds, &[])
    }

    fn begin(seed: u64, clouds: usize, streams: &[(usize, u32)]) -> Self {
        let mut random = StdRng::seed_from_u64(seed);
        let now = Instant::now();
        let mut world = Self {
            one_way: Duration::from_millis(random.random_range(1..=20)),
            kafka_delay: Duration::from_millis(random.random_range(5..=20)),
            random,
            start: now,
            now,
            clock: Arc::new(Mutex::new(now)),
            flows: Vec::new(),
            kafka: Server::default(),
            redis: Server::default(),
            network: Flights::default(),
            known: HashMap::new(),
            publishing: false,
            next_publish: now,
            sent: 0,
            split: false,
            handed_over: 0,
            lives: BTreeMap::new(),
            clouds,
            of_nodes: false,
            said: Vec::new(),
            round: 0,
            streams: Vec::new(),
        };
        for (number, (bytes, hz)) in streams.iter().enumerate() {
            world.streams.push(Stream {
                topic: format!("stream/{number}").parse().unwrap(),
                bytes: *bytes,
                period: Duration::from_secs(1) / *hz,
                next: now,
                sent: 0,
            });
        }
        for index in 0..=clouds {
            let flow = world.make_flow(index, 1);
            world.flows.push(flow);
        }
        for index in 0..=clouds {
            world.lease(index);
        }
        world
    }

    /// Another flow comes to the same Kafka.
    pub(crate) fn add(&mut self) {
        self.clouds += 1;
        let flow = self.make_flow(self.clouds, 1);
        self.flows.push(flow);
        self.lease(self.clouds);
    }

    pub(crate) fn wall(&self) -> u64 {
        WALL_NS + (self.now - self.start).as_nanos() as u64
    }

    fn make_flow(&self, index: usize, epoch: u64) -> Flow {
        let robot = index == 0;
        let name = if robot { "edge/robot-1".to_owned() } else { format!("cloud/cloud-{index}") };
        let id: FlowId = name.parse().unwrap();
        let kind = if robot { LayerKind::Edge } else { LayerKind::Cloud };
        let layer_scope = (!robot).then(|| LayerScopeId::kafka(""));
        let control = ControlConfig {
            me: id.clone(),
            kind,
            epoch,
            node_scope: true,
            layer_scope,
            replicas: (!robot).then_some(LayerScope::Kafka),
            gateway: AutoBool::Auto,
            inter_scope: true,
            layer_answers_need_id: true,
            layer_names: LayerNames::Any,
            lease_stores: BTreeSet::new(),
            rules: PlanRules::default(),
            access: AccessRules::default(),
        };
        let core = DataCore::new(DataConfig {
            me: id.clone(),
            epoch,
            large_bytes: 65_536,
            salt: index as u32,
        });
        let said = layer_scope.map_or((LayerScope::None, 0), |scope| (LayerScope::Kafka, scope.0));
        let engine = EngineConfig {
            me: id.clone(),
            kind,
            epoch,
            layer_scope: said,
            max_datagram: 1300,
            limits: Limits::default(),
        };
        let inside = control.begins_inside();
        let mut control = ControlCore::new(control, self.now);
        control.hears_replicas(self.now);
        Flow {
            control,
            plane: PlaneState { core, engine: Some(Engine::new(engine, self.now, self.wall())) },
            id,
            epoch,
            life: Life::Alive,
            reads: BTreeMap::new(),
            peers: self.kafka.log.lock().get("peers").map_or(0, Vec::len),
            inside,
            was_inside: inside,
            leaves: None,
            measured: self.now,
            deaf: false,
            mute: false,
        }
    }

    /// The services of a flow's broker send their leases; on Kafka each replica hears them.
    fn lease(&mut self, index: usize) {
        let message = |op: &str, topic: &str| {
            json!({"op": op, "topic": topic, "service": "s", "ttl_s": 0, "reliability": "reliable"})
                .to_string()
        };
        let (scope, messages) = if index == 0 {
            (Scope::Node, [message("advertise", UP), message("request", DOWN)])
        } else {
            (Scope::Layer, [message("request", UP), message("advertise", DOWN)])
        };
        let op = if index == 0 { "request" } else { "advertise" };
        let streams = self.streams.iter().map(|stream| message(op, stream.topic.as_str()));
        let messages: Vec<String> = messages.into_iter().chain(streams).collect();
        let (now, wall_ms) = (self.now, self.wall() / 1_000_000);
        let control = &mut self.flows[index].control;
        for message in messages {
            control.control(now, wall_ms, scope, message.as_bytes());
        }
        let of_node = match index {
            0 => [message("request", STATUS), message("advertise", TELEOP)],
            _ => [message("advertise", STATUS), message("request", TELEOP)],
        };
        for message in of_node {
            control.control(now, wall_ms, Scope::Node, message.as_bytes());
        }
        if index > 0 {
            // A service on the replica's own node wants what the layer publishes, too.
            control.control(now, wall_ms, Scope::Node, message("request", DOWN).as_bytes());
        }
    }

    pub(crate) fn random_cloud(&mut self) -> usize {
        self.random.random_range(1..=self.clouds)
    }

    pub(crate) fn end(&mut self, index: usize, end: End) {
        // Not always at the same moment between two Hellos and two messages.
        let pause = self.random.random_range(0..120);
        self.run_for(STEP * pause);
        self.end_now(index, end);
    }

    pub(crate) fn end_now(&mut self, index: usize, end: End) {
        let (now, wall_ms) = (self.now, self.wall() / 1_000_000);
        let flow = &mut self.flows[index];
        self.handed_over += flow.control.handovers().0;
        match end {
            End::Killed => {
                flow.life = Life::Dead;
                self.kafka.forget(index);
            }
            End::Stopped => {
                flow.life = Life::Draining(now);
                flow.control.start_draining(now, wall_ms);
                flow.plane.core.leave(now);
            }
        }
    }

    pub(crate) fn restart(&mut self, index: usize) {
        assert_eq!(self.flows[index].life, Life::Dead, "it has not ended in time");
        let heard =
            self.redis.log.lock().get(&channel(index, Scope::Node, DOWN)).map_or(0, Vec::len);
        self.lives.entry(index).or_default().push(heard);
        self.flows[index] = self.make_flow(index, self.flows[index].epoch + 1);
        self.lease(index);
    }

    pub(crate) fn stop_publishing(&mut self) {
        self.publishing = false;
    }

    /// The replica that the robot sends to.
    pub(crate) fn receiver_up(&self) -> Option<FlowId> {
        let plan = self.flows[0].control.plans().get(UP)?;
        let receivers = plan.bridges.iter().filter_map(|bridge| match &bridge.to {
            Target::Inter { receiver, .. } => Some(receiver.clone()),
            _ => None,
        });
        receivers.min()
    }

    /// The replica that carries what the robot asks for.
    pub(crate) fn carrier_down(&self) -> Option<usize> {
        let topic: TopicName = DOWN.parse().unwrap();
        let carries =
            |flow: &Flow| flow.control.plans().get(&topic).is_some_and(TopicPlan::carries_out);
        self.flows.iter().position(carries)
    }

    /// Kafka stands still for so long.
    pub(crate) fn freeze_kafka(&mut self, time: Duration) {
        self.kafka.freeze(self.now);
        self.run_for(time);
        self.kafka.thaw(self.now, &mut self.random);
    }

    /// Whether the replicas hear each other, on Kafka and over the link.
    pub(crate) fn split(&mut self, split: bool) {
        self.split = split;
    }

    pub(crate) fn run_for(&mut self, time: Duration) {
        let end = self.now + time;
        while self.now < end {
            self.step();
        }
    }

    fn step(&mut self) {
        self.now += STEP;
        *self.clock.lock() = self.now;
        self.publish();
        self.discover();
        while let Some(packet) = self.network.arrived(self.now) {
            let reads = |flow: &&mut Flow| {
                flow.life != Life::Dead
                    && flow.id == packet.to.flow
                    && flow.epoch == packet.to.epoch
            };
            if let Some(engine) =
                self.flows.iter_mut().find(reads).and_then(|flow| flow.plane.engine.as_mut())
            {
                engine.receive(self.now, packet.datagram, packet.class);
            }
        }
        for index in 0..self.flows.len() {
            if self.flows[index].life != Life::Dead {
                self.read(index);
                self.run_control(index);
                self.leave(index);
                self.transmit(index);
            }
        }
    }

    /// Services on all nodes whose flow lives publish one message each.
    pub(crate) fn publish_on_nodes(&mut self) {
        self.round += 1;
        let sequence = self.round;
        let alive: Vec<usize> =
            (0..=self.clouds).filter(|index| self.flows[*index].life == Life::Alive).collect();
        for index in alive {
            let (topic, id) = (if index == 0 { TELEOP } else { STATUS }, &self.flows[index].id);
            let origin = Origin {
                layer: id.layer.to_string(),
                node: id.node.to_string(),
                service: "s".into(),
                ..Origin::default()
            };
            let header = Header {
                reliable: true,
                ..Header::new(topic, origin, node_writer(index), sequence, self.wall())
            };
            let record = Record {
                content: Content::Frame(
                    Frame::new(&header, Bytes::from_static(b"payload")).unwrap(),
                ),
                at: self.now,
                by: usize::MAX,
            };
            let channel = channel(index, Scope::Node, topic);
            self.redis.log.lock().entry(channel).or_default().push(record);
            self.said.push((index, sequence));
        }
    }

    fn publish(&mut self) {
        if self.of_nodes && self.now >= self.next_publish && !self.publishing {
            self.next_publish += PERIOD;
            self.publish_on_nodes();
        }
        if self.publishing {
            self.publish_streams();
        }
        if !self.publishing || self.now < self.next_publish {
            return;
        }
        self.next_publish += PERIOD;
        self.sent += 1;
        let ways = [
            (&self.redis.log, Scope::Node, UP, "edge", "robot-1"),
            (&self.kafka.log, Scope::Layer, DOWN, "cloud", ""),
        ];
        for (log, scope, topic, layer, node) in ways {
            let origin = Origin {
                layer: layer.into(),
                node: node.into(),
                service: "s".into(),
                ..Origin::default()
            };
            let header = Header {
                reliable: true,
                ..Header::new(
                    topic,
                    origin,
                    WriterId([topic.len() as u8; 16]),
                    self.sent,
                    self.wall(),
                )
            };
            let record = Record {
                content: Content::Frame(
                    Frame::new(&header, Bytes::from_static(b"payload")).unwrap(),
                ),
                at: self.now,
                by: usize::MAX,
            };
            log.lock().entry(channel(0, scope, topic)).or_default().push(record);
        }
    }

    fn discover(&mut self) {
        for a in 0..self.flows.len() {
            for b in 0..self.flows.len() {
                let lives = (self.flows[a].epoch, self.flows[b].epoch);
                let both = a != b
                    && [a, b]
                        .iter()
                        .all(|at| self.flows[*at].life == Life::Alive && self.flows[*at].inside);
                if both && self.known.get(&(a, b)) != Some(&lives) && self.random.random_bool(0.05)
                {
                    self.known.insert((a, b), lives);
                    let endpoint = Endpoint { flow: self.flows[b].id.clone(), epoch: lives.1 };
                    let now = self.now;
                    if let Some(engine) = &mut self.flows[a].plane.engine {
                        engine.peer_discovered(now, endpoint);
                    }
                }
            }
        }
    }

    /// What flows wrote to a channel: how often each sequence.
    fn written(log: &Log, topic: &str) -> BTreeMap<u64, usize> {
        let mut counts = BTreeMap::new();
        for record in log.lock().get(topic).into_iter().flatten() {
            if let Content::Frame(frame) = &record.content
                && frame.hops() > 0
            {
                *counts.entry(frame.sequence()).or_default() += 1;
            }
        }
        counts
    }

    /// Messages that were written to Kafka behind a newer one.
    fn late(&self, topic: &str) -> usize {
        let mut newest = 0;
        let mut late = 0;
        for record in self.kafka.log.lock().get(topic).into_iter().flatten() {
            if let Content::Frame(frame) = &record.content
                && frame.hops() > 0
            {
                late += usize::from(frame.sequence() < newest);
                newest = newest.max(frame.sequence());
            }
        }
        late
    }

    /// Messages that services of the replicas' nodes missed or got out of turn within a life of
    /// their flow.
    fn holes(&self) -> usize {
        let log = self.redis.log.lock();
        let mut holes = 0;
        for index in 1..=self.clouds {
            let all = log.get(&channel(index, Scope::Node, DOWN)).map_or(&[][..], Vec::as_slice);
            let begins = self.lives.get(&index).map_or(&[][..], Vec::as_slice);
            let sequence = |record: &Record| match &record.content {
                Content::Frame(frame) => frame.sequence(),
                _ => 0,
            };
            let pairs = all.windows(2).enumerate().filter(|(at, _)| !begins.contains(&(at + 1)));
            holes += pairs.filter(|(_, pair)| sequence(&pair[1]) != sequence(&pair[0]) + 1).count();
        }
        holes
    }

    pub(crate) fn judge(&mut self) -> Found {
        let up = Self::written(&self.kafka.log, UP);
        let down = Self::written(&self.redis.log, &channel(0, Scope::Node, DOWN));
        let lost = |counts: &BTreeMap<u64, usize>| {
            (1..=self.sent).filter(|n| !counts.contains_key(n)).count()
        };
        let twice =
            |counts: &BTreeMap<u64, usize>| counts.values().filter(|count| **count > 1).count();
        let topic: TopicName = DOWN.parse().unwrap();
        let carries =
            |flow: &&Flow| flow.control.plans().get(&topic).is_some_and(TopicPlan::carries_out);
        let core = &self.flows[0].plane.core;
        let dropped = core.find(DOWN).map_or(0, |id| core.path(id).ingress_drops.total());
        Found {
            sent_up: self.sent as usize,
            sent_down: self.sent as usize,
            lost_up: lost(&up),
            lost_down: lost(&down),
            twice_up: twice(&up),
            twice_down: twice(&down),
            late_up: self.late(UP),
            repeats_down: dropped,
            carriers: self.flows.iter().filter(carries).count(),
            handed_over: self.handed_over,
            holes: self.holes(),
        }
    }
}

/// The writer of what services on a flow's node publish.
pub(crate) fn node_writer(index: usize) -> WriterId {
    let mut writer = [0xAB; 16];
    writer[..8].copy_from_slice(&(index as u64).to_le_bytes());
    WriterId(writer)
}
