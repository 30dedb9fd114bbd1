//! The link of one flow to all others: a state machine without input, output or clock.
//!
//! ```text
//! submit, send_control ─►┌────────┐─► poll_transmit ─► pacer ─► transport
//! transport ─► receive ─►│ Engine │─► poll_event: deliveries, peers, what became of each message
//! clock ─► handle_timeout►└────────┘─► next_timeout
//! ```
//!
//! Who drives it takes all events after each call, and calls [`Engine::handle_timeout`] when
//! [`Engine::next_timeout`] has come.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::hash::RandomState;
use std::num::NonZeroUsize;
use std::time::{Duration, Instant};

use blaze_domain::{DropReason, FlowId, LayerKind, Priority};
use blaze_proto::link::LinkControl;
use blaze_proto::link::link_control::{Body, Egress, LayerScope, State};
use lru::LruCache;
use prost::Message as _;

use super::addresses::Addresses;
use super::budget::{Budgets, LinkBudgets, LinkCapacity};
use super::clock::Clocks;
use super::event::{
    Begun, LaneId, Ledger, LinkCounters, LinkEvent, PeerInfo, Submit, Tally, Transmit,
};
use super::lifecycle::Missed;
use super::peer::{HELLO_EVERY, MAX_CONTROLS, Peer, Phase};
use super::sender::SendClass;
use super::transport::Endpoint;
use super::wire::{HEADER_BYTES, RECORD_BYTES, SenderId};
use crate::world::Ros2Network;

/// Smallest datagram size that an engine uses, in bytes.
pub const MIN_DATAGRAM_BYTES: usize = 1024;
/// Peers of one flow, at most. Each takes six file descriptors (RustDDS has two per writer), twelve
/// for as long as a dead participant is laid aside, up to 3.3 MiB in DDS, and a look at each
/// datagram that is sent; and all flows know all writers of all.
pub const MAX_PEERS: usize = 128;
/// Flows that are remembered as heard when they have no place any more; beyond that those that went
/// first are forgotten.
const MAX_HEARD: NonZeroUsize = NonZeroUsize::new(8 * MAX_PEERS).unwrap();

/// Bounds of an engine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Bytes per destination and class (control, state, bulk) that wait, and as many again that
    /// were sent and may have to be repaired; one message always fits besides.
    pub queue_bytes: [usize; 3],
    /// Bytes of unfinished and waiting messages of all peers.
    pub reassembly_bytes: usize,
    /// Peers.
    pub peers: usize,
    /// Streams whose order is remembered, per peer and class.
    pub streams: usize,
}

impl Default for Limits {
    fn default() -> Self {
        const MIB: usize = 1024 * 1024;
        Self {
            queue_bytes: [MIB, 4 * MIB, 16 * MIB],
            reassembly_bytes: 64 * MIB,
            peers: MAX_PEERS,
            streams: 16_384,
        }
    }
}

/// Who the engine speaks for.
#[derive(Debug, Clone)]
pub struct EngineConfig {
    /// The own flow.
    pub me: FlowId,
    /// Kind of its layer.
    pub kind: LayerKind,
    /// Its life on the link; larger is newer.
    pub epoch: u64,
    /// Layer broker that it uses, and that broker's identity; 0 = shared with nobody.
    pub layer_scope: (LayerScope, u64),
    /// Largest datagram in bytes, at least [`MIN_DATAGRAM_BYTES`].
    pub max_datagram: usize,
    /// Bounds.
    pub limits: Limits,
}

/// See the module.
#[derive(Debug)]
pub struct Engine {
    pub(super) config: EngineConfig,
    pub(super) clocks: Clocks,
    pub(super) sender: SenderId,
    pub(super) state: State,
    pub(super) layer_away: bool,
    /// The ROS 2 network that this flow is on.
    pub(super) ros2: Option<Ros2Network>,
    pub(super) registry: (u64, u64),
    pub(super) addresses: Addresses,
    pub(super) egress: Option<Egress>,
    pub(super) peers: Vec<Option<Peer>>,
    pub(super) by_flow: HashMap<FlowId, usize>,
    pub(super) by_sender: HashMap<SenderId, usize>,
    /// Flows that were heard before a new life began, here or there, and not since.
    pub(super) missed: BTreeMap<FlowId, Missed>,
    /// Flows that were heard in a place that they have no more: what their links carry has to be
    /// found out from below when they come back.
    pub(super) heard: LruCache<FlowId, ()>,
    /// Endpoints that found no place, and those of whose flows newer lives speak; those first that
    /// wait longest.
    pub(super) waiting: VecDeque<Endpoint>,
    /// When it was last told that one found none.
    pub(super) refusal_told: Option<Instant>,
    pub(super) next_link_epoch: u32,
    /// Peer that was served last, for LinkControl and per class.
    pub(super) cursors: [usize; 4],
    pub(super) ledger: Ledger,
    pub(super) counters: LinkCounters,
    pub(super) hasher: RandomState,
    pub(super) budgets: Budgets,
}

impl Engine {
    /// An engine without peers. `wall_ns` is the time since 1970 at `now`.
    #[must_use]
    pub fn new(config: EngineConfig, now: Instant, wall_ns: u64) -> Self {
        let config =
            EngineConfig { max_datagram: config.max_datagram.max(MIN_DATAGRAM_BYTES), ..config };
        Self {
            clocks: Clocks::new(now, wall_ns),
            sender: SenderId::of(&config.me, config.epoch),
            state: State::Starting,
            layer_away: false,
            ros2: None,
            registry: (0, 0),
            addresses: Addresses::default(),
            egress: None,
            peers: Vec::new(),
            by_flow: HashMap::new(),
            by_sender: HashMap::new(),
            missed: BTreeMap::new(),
            heard: LruCache::new(MAX_HEARD),
            waiting: VecDeque::new(),
            refusal_told: None,
            next_link_epoch: 1,
            cursors: [0; 4],
            ledger: Ledger::default(),
            counters: LinkCounters::default(),
            hasher: RandomState::new(),
            budgets: Budgets::default(),
            config,
        }
    }

    /// The own endpoint: flow and life.
    #[must_use]
    pub fn endpoint(&self) -> Endpoint {
        Endpoint { flow: self.config.me.clone(), epoch: self.config.epoch }
    }

    /// Tells the wall clock anew, in nanoseconds since 1970.
    pub fn set_wall_clock(&mut self, now: Instant, wall_ns: u64) {
        self.clocks.set_wall(now, wall_ns);
    }

    /// What the next Hellos say of this flow.
    pub fn set_state(&mut self, now: Instant, state: State) {
        if self.state != state {
            self.state = state;
            self.hello_soon(now);
        }
    }

    /// Version and digest of the announced registry state, for the next Hellos.
    pub fn set_registry(&mut self, version: u64, digest: u64) {
        self.registry = (version, digest);
    }

    /// Layer broker for the next Hellos, and its identity.
    pub fn set_layer_scope(&mut self, now: Instant, scope: LayerScope, id: u64) {
        if self.config.layer_scope != (scope, id) {
            self.config.layer_scope = (scope, id);
            self.hello_soon(now);
        }
    }

    /// Whether the layer broker has not answered for some seconds, for the next Hellos.
    pub fn set_layer_away(&mut self, now: Instant, away: bool) {
        if self.layer_away != away {
            self.layer_away = away;
            self.hello_soon(now);
        }
    }

    /// The ROS 2 network that this flow is on, for the next Hellos.
    pub fn set_ros2(&mut self, now: Instant, network: Option<Ros2Network>) {
        if self.ros2 != network {
            self.ros2 = network;
            self.hello_soon(now);
        }
    }

    /// Own addresses for the next Hellos.
    pub fn set_addresses(&mut self, addresses: Vec<String>) {
        self.addresses.set_own(addresses);
    }

    /// Demand and limit of the own egress, for the next Hellos.
    pub fn set_egress(&mut self, egress: Egress) {
        self.egress = Some(egress);
    }

    /// What may go to each peer from now on. Before the first call nothing is held back here.
    pub fn set_budgets(&mut self, now: Instant, budgets: LinkBudgets) {
        let max_datagram = self.config.max_datagram;
        self.budgets.set(now, budgets, max_datagram);
        for peer in self.peers.iter_mut().flatten() {
            let layer = &peer.endpoint.flow.layer;
            self.budgets.fit(now, layer, max_datagram, &mut peer.path);
        }
    }

    /// What is small needs so many wire bytes per second to each flow; to those that are not named
    /// nothing.
    pub fn set_needed(&mut self, now: Instant, wire_bytes_per_s: &BTreeMap<FlowId, f64>) {
        for peer in self.peers.iter_mut().flatten() {
            let needed = wire_bytes_per_s.get(&peer.endpoint.flow).copied();
            peer.path.set_needed(now, needed.unwrap_or(0.0));
        }
    }

    /// What is known of the links to flows that are up or suspect, where that is estimated.
    #[must_use]
    pub fn capacities(&self) -> Vec<(FlowId, LinkCapacity)> {
        let connected = self.peers.iter().flatten().filter(|peer| peer.is_connected());
        connected
            .filter_map(|peer| Some((peer.endpoint.flow.clone(), peer.path.capacity()?)))
            .collect()
    }

    /// Messages of which some parts have left and others have not: at most one of each class and
    /// peer.
    pub fn begun(&self) -> impl Iterator<Item = (LaneId, Begun)> {
        let classes = self.peers.iter().flatten().flat_map(|peer| &peer.send);
        classes.filter_map(SendClass::begun)
    }

    /// When a peer may be sent to for which [`Engine::poll_transmit`] has something and its link no
    /// budget.
    #[must_use]
    pub fn paced_until(&self) -> Option<Instant> {
        self.budgets.paced_until
    }

    fn hello_soon(&mut self, now: Instant) {
        for peer in self.peers.iter_mut().flatten().filter(|peer| peer.is_connected()) {
            peer.hello_due = true;
            peer.hello_at = now + HELLO_EVERY;
        }
    }

    /// Takes a message for a peer. From then on it ends in exactly one [`LinkEvent::LaneOut`] or
    /// [`LinkEvent::LaneDropped`], or in what [`Engine::drop_lane`] returns. Older ones that wait
    /// give way if the queue is full.
    ///
    /// # Errors
    /// The reason why it was not taken, for the caller to count: `no_destination` (the flow is not
    /// known), `link_down` (it is not up), `lifespan` (too old already).
    pub fn submit(&mut self, now: Instant, submit: Submit<'_>) -> Result<(), DropReason> {
        let at = *self.by_flow.get(submit.to).ok_or(DropReason::NoDestination)?;
        let peer = self.peers[at].as_ref().ok_or(DropReason::NoDestination)?;
        if !peer.is_connected() {
            return Err(DropReason::LinkDown);
        }
        let residence = now.saturating_duration_since(submit.arrived);
        let age = Duration::from_micros(submit.frame.age_us()).saturating_add(residence);
        if submit.lifespan.is_some_and(|lifespan| age >= lifespan) {
            return Err(DropReason::Lifespan);
        }
        if !peer.has_work() {
            self.note_rest(now, at);
        }
        if let Some(peer) = &mut self.peers[at] {
            peer.send[submit.class as usize].submit(submit, &mut self.ledger);
        }
        Ok(())
    }

    /// Nothing was to be sent to a peer until now.
    fn note_rest(&mut self, now: Instant, at: usize) {
        let Some(layer) = self.peers[at].as_ref().map(|peer| &peer.endpoint.flow.layer) else {
            return;
        };
        let mut of_layer =
            self.peers.iter().flatten().filter(|peer| peer.endpoint.flow.layer == *layer);
        let rests = self.budgets.has_limit(layer) && !of_layer.any(Peer::has_work);
        if let Some(peer) = &mut self.peers[at] {
            self.budgets.rest(now, &peer.endpoint.flow.layer, &mut peer.path, rests);
        }
    }

    /// Queues a Delta, SnapshotRequest or Snapshot for a peer.
    ///
    /// # Errors
    /// `no_destination`, `link_down`, `too_large` (it must fit one datagram) or `queue_full`.
    pub fn send_control(&mut self, to: &FlowId, body: Body) -> Result<(), DropReason> {
        let at = *self.by_flow.get(to).ok_or(DropReason::NoDestination)?;
        let peer = self.peers[at].as_mut().ok_or(DropReason::NoDestination)?;
        if !peer.is_connected() {
            return Err(DropReason::LinkDown);
        }
        let control = LinkControl::from(body);
        if control.encoded_len() > self.config.max_datagram - HEADER_BYTES - RECORD_BYTES {
            return Err(DropReason::TooLarge);
        }
        if peer.controls.len() >= MAX_CONTROLS {
            self.counters.control_refused += 1;
            return Err(DropReason::QueueFull);
        }
        peer.controls.push_back(control.encode_to_vec().into());
        Ok(())
    }

    /// Says Goodbye to every peer with the next datagrams.
    pub fn goodbye(&mut self) {
        for peer in self.peers.iter_mut().flatten() {
            peer.goodbye_due = peer.phase != Phase::Gone;
        }
    }

    /// What happened, oldest first.
    pub fn poll_event(&mut self) -> Option<LinkEvent> {
        self.ledger.events.pop_front()
    }

    /// When [`Engine::handle_timeout`] has something to do next.
    #[must_use]
    pub fn next_timeout(&self) -> Option<Instant> {
        let peers = self.peers.iter().flatten().filter_map(Peer::next_timeout);
        // One that can be written to again has as long as that.
        let missed = self.missed.iter().filter(|(flow, _)| !self.by_flow.contains_key(*flow));
        peers.chain(missed.map(|(_, missed)| missed.until)).min()
    }

    /// Drops what a lane has waiting; what is on its way goes on and ends in an event. The caller
    /// counts what is returned.
    pub fn drop_lane(&mut self, lane: LaneId) -> Tally {
        let mut dropped = Tally::default();
        for class in self.peers.iter_mut().flatten().flat_map(|peer| &mut peer.send) {
            SendClass::drop_lane(class, lane, &mut dropped, &mut self.ledger);
        }
        dropped
    }

    /// What a lane has waiting or on its way.
    #[must_use]
    pub fn lane_queued(&self, lane: LaneId) -> Tally {
        self.ledger.queued(lane)
    }

    /// All peers but those that said Goodbye.
    #[must_use]
    pub fn peers(&self) -> Vec<PeerInfo> {
        let peers = self.peers.iter().flatten();
        peers.filter(|peer| peer.phase != Phase::Gone).map(Peer::info).collect()
    }

    /// One peer.
    #[must_use]
    pub fn peer(&self, flow: &FlowId) -> Option<PeerInfo> {
        let peer = self.known(flow).filter(|peer| peer.phase != Phase::Gone);
        peer.map(Peer::info)
    }

    fn known(&self, flow: &FlowId) -> Option<&Peer> {
        self.peers[*self.by_flow.get(flow)?].as_ref()
    }

    /// Flows that found no place among the peers, and wait for one.
    #[must_use]
    pub fn waiting_peers(&self) -> usize {
        self.waiting.iter().filter(|endpoint| self.known(&endpoint.flow).is_none()).count()
    }

    /// Counts since the start.
    #[must_use]
    pub fn counters(&self) -> LinkCounters {
        self.counters
    }

    /// Bytes of memory that unfinished and waiting messages of all peers hold.
    #[must_use]
    pub fn reassembly_bytes(&self) -> usize {
        self.peers.iter().flatten().map(Peer::reserved).sum()
    }

    /// Whether a flow lives and answers when it is asked what it has written.
    #[must_use]
    pub fn answers_written(&self, flow: &FlowId) -> bool {
        let peer = self.known(flow).filter(|peer| peer.is_connected());
        let hello = peer.and_then(|peer| peer.hello.as_ref());
        hello.is_some_and(|hello| hello.answers_written)
    }

    /// Whether a flow says that it decompresses; one that was never heard does not.
    #[must_use]
    pub fn takes_lz4(&self, flow: &FlowId) -> bool {
        let hello = self.known(flow).and_then(|peer| peer.hello.as_ref());
        hello.is_some_and(|hello| hello.takes_lz4)
    }

    /// Whether the queue of a class to a flow is empty, or takes so many bytes more and is at most
    /// half full then. Of a flow that cannot be written to: yes, as nothing waits for it.
    #[must_use]
    pub fn has_room(&self, flow: &FlowId, class: Priority, bytes: usize) -> bool {
        let peer = self.known(flow).filter(|peer| peer.is_connected());
        peer.is_none_or(|peer| peer.send[class as usize].has_room(bytes))
    }

    /// The next datagram, most urgent first: LinkControl and probes, then control, state and bulk,
    /// each in turn over the peers. `None`: nothing to send now.
    pub fn poll_transmit(&mut self, now: Instant) -> Option<Transmit> {
        self.poll_control(now)
            .or_else(|| self.transmit_messages(now))
            .or_else(|| self.poll_control(now))
    }
}
