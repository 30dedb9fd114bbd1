//! A simulated network for tests: seeded, with its own time. [`Network`] carries datagrams for
//! anybody; [`Sim`] drives engines over it and keeps account of their messages.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::time::{Duration, Instant};

use blaze_domain::{DropReason, FlowId, LayerKind, Origin, Priority, WriterId};
use blaze_proto::link::link_control::LayerScope;
use blaze_proto::{Frame, Header};
use bytes::Bytes;

use super::flights::Flights;
use super::transport::Endpoint;
use super::{Engine, EngineConfig, LaneId, Limits, LinkEvent, StreamKey, Submit, Tally};
use crate::testing::Random;

/// What a path does to datagrams.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Weather {
    /// One way.
    pub delay: Duration,
    /// Added at random, so that datagrams overtake one another.
    pub jitter: Duration,
    /// Share that is lost.
    pub loss: f64,
    /// Share that comes twice.
    pub duplicated: f64,
}

impl Weather {
    pub(crate) fn delay(milliseconds: u64) -> Self {
        Self { delay: Duration::from_millis(milliseconds), ..Self::default() }
    }
}

/// A datagram that has arrived.
#[derive(Debug, Clone)]
pub(crate) struct Arrival {
    pub to: Endpoint,
    pub class: Priority,
    pub datagram: Bytes,
}

/// Decides about single datagrams: `true` = lose it.
pub(crate) type Censor = Box<dyn FnMut(&Endpoint, &Endpoint, Priority, &Bytes) -> bool>;

/// Carries datagrams between endpoints. An endpoint that nobody listens on swallows them.
pub(crate) struct Network {
    pub random: Random,
    pub weather: Weather,
    paths: HashMap<(FlowId, FlowId), Weather>,
    cuts: HashSet<(FlowId, FlowId)>,
    flights: Flights<Arrival>,
    pub censor: Option<Censor>,
}

impl Network {
    pub(crate) fn new(seed: u64, weather: Weather) -> Self {
        Self {
            random: Random(seed),
            weather,
            paths: HashMap::new(),
            cuts: HashSet::new(),
            flights: Flights::default(),
            censor: None,
        }
    }

    /// Weather of one direction; otherwise that of the whole network holds.
    pub(crate) fn set_path(&mut self, from: &FlowId, to: &FlowId, weather: Weather) {
        self.paths.insert((from.clone(), to.clone()), weather);
    }

    /// Cuts or heals one direction.
    pub(crate) fn set_cut(&mut self, from: &FlowId, to: &FlowId, cut: bool) {
        let path = (from.clone(), to.clone());
        if cut {
            self.cuts.insert(path);
        } else {
            self.cuts.remove(&path);
        }
    }

    /// Cuts or heals both directions.
    pub(crate) fn set_partition(&mut self, a: &FlowId, b: &FlowId, cut: bool) {
        self.set_cut(a, b, cut);
        self.set_cut(b, a, cut);
    }

    pub(crate) fn send(
        &mut self,
        now: Instant,
        from: &Endpoint,
        to: &Endpoint,
        class: Priority,
        datagram: &Bytes,
    ) {
        let path = (from.flow.clone(), to.flow.clone());
        let weather = self.paths.get(&path).copied().unwrap_or(self.weather);
        let censored = self.censor.as_mut().is_some_and(|lose| lose(from, to, class, datagram));
        if censored || self.cuts.contains(&path) || self.random.chance(weather.loss) {
            return;
        }
        let copies = 1 + u32::from(self.random.chance(weather.duplicated));
        for _ in 0..copies {
            let due = now + weather.delay + self.random.duration(weather.jitter);
            let arrival = Arrival { to: to.clone(), class, datagram: datagram.clone() };
            self.flights.send(due, arrival);
        }
    }

    /// When the next datagram arrives.
    pub(crate) fn next_arrival(&self) -> Option<Instant> {
        self.flights.next_due()
    }

    /// The next datagram that has arrived by `now`.
    pub(crate) fn arrival(&mut self, now: Instant) -> Option<Arrival> {
        self.flights.arrived(now)
    }
}

/// A delivered message.
#[derive(Debug, Clone)]
pub(crate) struct Delivered {
    pub from: FlowId,
    /// Life of the receiver.
    pub epoch: u64,
    pub at: Instant,
    pub frame: Frame,
}

/// What became of the messages of one lane.
#[derive(Debug, Clone, Default)]
pub(crate) struct LaneAccount {
    pub submitted: u64,
    pub sent: u64,
    pub out: u64,
    pub dropped: BTreeMap<DropReason, u64>,
}

/// One flow in the simulation.
pub(crate) struct Node {
    pub engine: Engine,
    pub alive: bool,
    /// Bytes per second that it sends at most, as a pacer would see to.
    pub rate: Option<f64>,
    free_at: Instant,
    pub delivered: Vec<Delivered>,
    pub lanes: BTreeMap<LaneId, LaneAccount>,
    pub events: Vec<(Instant, LinkEvent)>,
    pub receiver_dropped: BTreeMap<DropReason, u64>,
    pub sent_bytes: u64,
    pub sent_datagrams: u64,
    /// Datagrams to each flow, and their bytes.
    pub sent_to: BTreeMap<FlowId, (u64, u64)>,
}

/// Engines on a network.
pub(crate) struct Sim {
    pub now: Instant,
    pub start: Instant,
    pub network: Network,
    pub nodes: Vec<Node>,
    /// Last sequence of each stream of each flow.
    sequences: HashMap<(usize, u32), u64>,
}

pub(crate) fn flow(name: &str) -> FlowId {
    name.parse().unwrap()
}

pub(crate) fn writer(number: u32) -> WriterId {
    let mut id = [7; 16];
    id[..4].copy_from_slice(&number.to_le_bytes());
    WriterId(id)
}

/// A message for [`Sim::publish`].
#[derive(Debug, Clone, Copy)]
pub(crate) struct Post {
    pub class: Priority,
    /// Its topic, writer and lane.
    pub stream: u32,
    pub bytes: usize,
    pub reliable: bool,
    pub lifespan: Option<Duration>,
    pub keep_newest: usize,
}

impl Post {
    pub(crate) fn small(stream: u32) -> Self {
        Self {
            class: Priority::State,
            stream,
            bytes: 100,
            reliable: false,
            lifespan: None,
            keep_newest: 0,
        }
    }

    pub(crate) fn reliable(stream: u32) -> Self {
        Self { reliable: true, ..Self::small(stream) }
    }

    pub(crate) fn large(stream: u32, bytes: usize) -> Self {
        Self::small(stream).class(Priority::Bulk).bytes(bytes)
    }

    pub(crate) fn class(self, class: Priority) -> Self {
        Self { class, ..self }
    }

    pub(crate) fn bytes(self, bytes: usize) -> Self {
        Self { bytes, ..self }
    }

    pub(crate) fn lifespan(self, lifespan: Option<Duration>) -> Self {
        Self { lifespan, ..self }
    }

    /// Of those that wait only the newest stays.
    pub(crate) fn newest(self) -> Self {
        Self { keep_newest: 1, ..self }
    }
}

/// The content that a message of a stream has.
pub(crate) fn payload(stream: u32, sequence: u64, bytes: usize) -> Bytes {
    let mut random = Random(u64::from(stream) << 32 | sequence);
    let mut content = Vec::with_capacity(bytes + 8);
    while content.len() < bytes {
        content.extend(random.next().to_le_bytes());
    }
    content.truncate(bytes);
    content.into()
}

pub(crate) fn frame(post: Post, sequence: u64) -> Frame {
    let header = Header {
        lifespan_ms: post.lifespan.map_or(0, |span| u32::try_from(span.as_millis()).unwrap()),
        reliable: post.reliable,
        ..Header::new(
            &format!("stream/{}", post.stream),
            Origin::default(),
            writer(post.stream),
            sequence,
            1,
        )
    };
    Frame::new(&header, payload(post.stream, sequence, post.bytes)).unwrap()
}

impl Sim {
    /// Flows with these names, which find one another at once.
    pub(crate) fn new(seed: u64, weather: Weather, names: &[&str]) -> Self {
        Self::with_limits(seed, weather, names, Limits::default())
    }

    pub(crate) fn with_limits(seed: u64, weather: Weather, names: &[&str], limits: Limits) -> Self {
        let start = Instant::now();
        let mut sim = Self {
            now: start,
            start,
            network: Network::new(seed, weather),
            nodes: Vec::new(),
            sequences: HashMap::new(),
        };
        for name in names {
            sim.add(name, limits);
        }
        for at in 0..sim.nodes.len() {
            sim.announce(at);
        }
        sim
    }

    fn add(&mut self, name: &str, limits: Limits) {
        let config = EngineConfig {
            me: flow(name),
            kind: LayerKind::Edge,
            epoch: 1,
            layer_scope: (LayerScope::None, 0),
            max_datagram: 1300,
            limits,
        };
        self.nodes.push(Node {
            engine: Engine::new(config, self.now, 1_700_000_000_000_000_000),
            alive: true,
            rate: None,
            free_at: self.now,
            delivered: Vec::new(),
            lanes: BTreeMap::new(),
            events: Vec::new(),
            receiver_dropped: BTreeMap::new(),
            sent_bytes: 0,
            sent_datagrams: 0,
            sent_to: BTreeMap::new(),
        });
    }

    /// One more flow, now. It and all others discover one another. Returns its place.
    pub(crate) fn join(&mut self, name: &str) -> usize {
        self.add(name, Limits::default());
        let at = self.nodes.len() - 1;
        self.announce(at);
        at
    }

    /// One more process with the name of a flow, in a newer life. Returns its place.
    pub(crate) fn double(&mut self, of: usize) -> usize {
        let name = self.id(of).to_string();
        self.add(&name, Limits::default());
        let at = self.nodes.len() - 1;
        self.crash(at);
        at
    }

    /// Lets a flow and all others discover one another.
    pub(crate) fn announce(&mut self, at: usize) {
        let endpoint = self.endpoint(at);
        for other in 0..self.nodes.len() {
            if other != at && self.nodes[other].alive {
                let theirs = self.endpoint(other);
                self.nodes[other].engine.peer_discovered(self.now, endpoint.clone());
                self.nodes[at].engine.peer_discovered(self.now, theirs);
                self.take_events(other);
            }
        }
        self.take_events(at);
    }

    pub(crate) fn endpoint(&self, at: usize) -> Endpoint {
        self.nodes[at].engine.endpoint()
    }

    pub(crate) fn id(&self, at: usize) -> FlowId {
        self.endpoint(at).flow
    }

    /// Replaces a flow by a new life of it, as after a crash: a new engine with the next epoch.
    pub(crate) fn crash(&mut self, at: usize) {
        let old = self.endpoint(at);
        let config = EngineConfig { epoch: old.epoch + 1, ..self.nodes[at].engine.config.clone() };
        let node = &mut self.nodes[at];
        // What a dead process had waiting is counted by nobody.
        node.lanes.clear();
        node.engine = Engine::new(config, self.now, 1_700_000_000_000_000_000);
        self.announce(at);
    }

    /// The flow's own participant is rebuilt: the engine goes on under the next epoch.
    pub(crate) fn rebuild(&mut self, at: usize) {
        let epoch = self.endpoint(at).epoch + 1;
        self.nodes[at].engine.restart(self.now, epoch);
        self.take_events(at);
        self.announce(at);
    }

    /// Submits the next message of a stream. Returns its sequence, or why it was not taken.
    pub(crate) fn publish(
        &mut self,
        from: usize,
        to: usize,
        post: Post,
    ) -> Result<u64, DropReason> {
        let sequence = self.sequences.entry((from, post.stream)).or_insert(0);
        *sequence += 1;
        let sequence = *sequence;
        let to = self.id(to);
        let lane = LaneId(post.stream);
        let submit = Submit {
            to: &to,
            class: post.class,
            lane,
            stream: StreamKey { topic: post.stream, writer: writer(post.stream) },
            frame: frame(post, sequence),
            arrived: self.now,
            reliable: post.reliable,
            lifespan: post.lifespan,
            keep_newest: post.keep_newest,
        };
        let node = &mut self.nodes[from];
        node.engine.submit(self.now, submit)?;
        node.lanes.entry(lane).or_default().submitted += 1;
        self.take_events(from);
        Ok(sequence)
    }

    fn take_events(&mut self, at: usize) {
        let epoch = self.endpoint(at).epoch;
        let node = &mut self.nodes[at];
        while let Some(event) = node.engine.poll_event() {
            match event {
                LinkEvent::Deliver { from, frame, at } => {
                    node.delivered.push(Delivered { from, epoch, at, frame });
                }
                LinkEvent::LaneSent { lane, .. } => node.lanes.entry(lane).or_default().sent += 1,
                LinkEvent::LaneOut { lane, .. } => node.lanes.entry(lane).or_default().out += 1,
                LinkEvent::LaneDropped { lane, reason } => {
                    let lane = node.lanes.entry(lane).or_default();
                    *lane.dropped.entry(reason).or_default() += 1;
                }
                LinkEvent::ReceiverDropped { reason, messages, .. } => {
                    *node.receiver_dropped.entry(reason).or_default() += messages;
                }
                event => node.events.push((self.now, event)),
            }
        }
    }

    /// Sends what a node may send now.
    fn transmit(&mut self, at: usize) {
        let from = self.endpoint(at);
        while self.nodes[at].alive && self.nodes[at].free_at <= self.now {
            let Some(transmit) = self.nodes[at].engine.poll_transmit(self.now) else {
                break;
            };
            let node = &mut self.nodes[at];
            node.sent_bytes += transmit.datagram.len() as u64;
            node.sent_datagrams += 1;
            let sent = node.sent_to.entry(transmit.to.flow.clone()).or_default();
            *sent = (sent.0 + 1, sent.1 + transmit.datagram.len() as u64);
            assert!(transmit.datagram.len() <= 1300, "{} bytes", transmit.datagram.len());
            if let Some(rate) = node.rate {
                #[allow(clippy::cast_precision_loss, reason = "a datagram")]
                let seconds = transmit.datagram.len() as f64 / rate;
                node.free_at = self.now + Duration::from_secs_f64(seconds);
            }
            let (class, datagram) = (transmit.class, &transmit.datagram);
            self.network.send(self.now, &from, &transmit.to, class, datagram);
        }
        self.take_events(at);
    }

    fn next_step(&self) -> Option<Instant> {
        let nodes = self.nodes.iter().filter(|node| node.alive);
        let timeouts = nodes.clone().filter_map(|node| node.engine.next_timeout());
        let pacers = nodes.clone().map(|node| node.free_at);
        let links = nodes.filter_map(|node| node.engine.paced_until());
        let later = pacers.chain(links).filter(|at| *at > self.now);
        timeouts.chain(later).chain(self.network.next_arrival()).min()
    }

    /// Lets time pass up to an instant.
    pub(crate) fn run_until(&mut self, end: Instant) {
        loop {
            for at in 0..self.nodes.len() {
                self.transmit(at);
            }
            let Some(next) = self.next_step().filter(|next| *next <= end) else {
                break;
            };
            // A timeout that does nothing would spin here; time moves on, so that the test fails
            // instead.
            self.now = next.max(self.now + Duration::from_nanos(1));
            if self.now > end {
                break;
            }
            while let Some(arrival) = self.network.arrival(self.now) {
                let to = (0..self.nodes.len())
                    .find(|at| self.endpoint(*at) == arrival.to && self.nodes[*at].alive);
                if let Some(to) = to {
                    self.nodes[to].engine.receive(self.now, arrival.datagram, arrival.class);
                    self.take_events(to);
                }
            }
            for at in 0..self.nodes.len() {
                let node = &mut self.nodes[at];
                if node.alive && node.engine.next_timeout().is_some_and(|due| due <= self.now) {
                    node.engine.handle_timeout(self.now);
                    self.take_events(at);
                }
            }
        }
        self.now = self.now.max(end);
    }

    pub(crate) fn run(&mut self, time: Duration) {
        self.run_until(self.now + time);
    }

    pub(crate) fn run_ms(&mut self, milliseconds: u64) {
        self.run(Duration::from_millis(milliseconds));
    }

    /// Runs until a condition holds. Panics after `limit`.
    pub(crate) fn run_to(
        &mut self,
        limit: Duration,
        what: &str,
        mut done: impl FnMut(&Self) -> bool,
    ) {
        let end = self.now + limit;
        while !done(self) {
            assert!(self.now < end, "not within {limit:?}: {what}");
            let next = self.next_step().unwrap_or(end).clamp(self.now, end);
            self.run_until(next);
            self.now += Duration::from_micros(1);
        }
    }

    /// Sequences of one stream that one flow delivered, as they came.
    pub(crate) fn sequences(&self, at: usize, stream: u32) -> Vec<u64> {
        let delivered = self.nodes[at].delivered.iter();
        let of_stream = delivered.filter(|delivered| delivered.frame.writer() == writer(stream));
        of_stream.map(|delivered| delivered.frame.sequence()).collect()
    }

    /// Every submitted message is out, dropped or queued.
    pub(crate) fn check_accounts(&self) {
        for (at, node) in self.nodes.iter().enumerate() {
            for (lane, account) in &node.lanes {
                let Tally { messages: queued, .. } = node.engine.lane_queued(*lane);
                let dropped: u64 = account.dropped.values().sum();
                assert_eq!(
                    account.submitted,
                    account.out + dropped + queued,
                    "flow {at}, {lane:?}: {account:?}, {queued} queued"
                );
            }
        }
    }

    /// What was delivered is whole, in order per stream, once in each life of the receiver, and
    /// never in two of them.
    pub(crate) fn check_deliveries(&self) {
        for (at, node) in self.nodes.iter().enumerate() {
            let mut newest: HashMap<(u64, WriterId, FlowId), u64> = HashMap::new();
            let mut seen = BTreeSet::new();
            for delivered in &node.delivered {
                let (writer, sequence) = (delivered.frame.writer(), delivered.frame.sequence());
                let stream = u32::from_le_bytes(writer.0[..4].try_into().unwrap());
                let key = (delivered.epoch, writer, delivered.from.clone());
                let before = newest.insert(key, sequence).unwrap_or(0);
                assert!(before < sequence, "flow {at}, stream {stream}: {sequence} after {before}");
                assert!(
                    seen.insert((delivered.from.clone(), writer, sequence)),
                    "flow {at}, stream {stream}: {sequence} in two lives"
                );
                let content = payload(stream, sequence, delivered.frame.payload().len());
                assert!(content == delivered.frame.payload(), "flow {at}: {stream}/{sequence}");
                assert_eq!(delivered.frame.hops(), 1);
            }
        }
    }
}
