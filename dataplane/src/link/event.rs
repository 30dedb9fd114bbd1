//! What the engine is given, tells and reports.

use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use blaze_domain::{DropReason, FlowId, LayerKind, Priority, WriterId};
use blaze_proto::Frame;
use blaze_proto::link::link_control::{Body, Hello};
use bytes::Bytes;
use serde::Serialize;

use super::budget::LinkCapacity;
use super::transport::Endpoint;

/// A lane of the flow; the engine only counts by it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct LaneId(pub u32);

/// What must stay in order: one writer of one topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct StreamKey {
    /// The flow's number of the topic.
    pub topic: u32,
    /// The writer.
    pub writer: WriterId,
}

/// A message for another flow.
#[derive(Debug, Clone)]
pub struct Submit<'a> {
    /// Its destination.
    pub to: &'a FlowId,
    /// Its class.
    pub class: Priority,
    /// Whom it is counted for.
    pub lane: LaneId,
    /// What it stays in order with.
    pub stream: StreamKey,
    /// The message. It travels with one hop more than the frame has.
    pub frame: Frame,
    /// When the flow took it in; its age grows from then on.
    pub arrived: Instant,
    /// Repair it when it is lost; messages of several parts are always repaired.
    pub reliable: bool,
    /// Age (that of the frame included) at which it is of no use; `None` = never.
    pub lifespan: Option<Duration>,
    /// At most this many of its lane and stream wait unstarted, itself included: older ones give
    /// way, so that a link that is too slow for a topic carries its newest messages and not its
    /// oldest. 0 = only bytes count.
    pub keep_newest: usize,
}

/// A datagram to hand to the transport.
#[derive(Debug, Clone)]
pub struct Transmit {
    /// Its destination.
    pub to: Endpoint,
    /// The class whose topic it goes on.
    pub class: Priority,
    /// The datagram.
    pub datagram: Bytes,
    /// It carries no message: LinkControl or a probe.
    pub control: bool,
}

/// Why a peer went down.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum DownReason {
    /// No Hello for 2.5 s.
    Silent,
    /// It said Goodbye.
    Goodbye,
    /// A newer life of it was seen.
    NewEpoch,
    /// This flow began a new life.
    Restarted,
}

/// What happened on the link. The caller takes all events after each call.
#[derive(Debug, Clone)]
pub enum LinkEvent {
    /// A message came; hops and age are set.
    Deliver {
        /// The flow that sent it.
        from: FlowId,
        /// The message.
        frame: Frame,
        /// When it was handed out.
        at: Instant,
    },
    /// A Delta, SnapshotRequest or Snapshot for the registry, a TypeRequest or TypeDefinition.
    Control {
        /// The flow that sent it.
        from: FlowId,
        /// What it says.
        body: Body,
    },
    /// A peer asks whether all of a topic that came over the link is with the brokers that it is
    /// for.
    WrittenAsked {
        /// The flow that asks.
        from: FlowId,
        /// The topic.
        topic: String,
        /// To be given back in the answer.
        token: u64,
    },
    /// A peer says that it is.
    Written {
        /// The flow that was asked.
        from: FlowId,
        /// Of the question.
        token: u64,
    },
    /// A Hello, each one.
    Hello {
        /// The flow that sent it.
        from: FlowId,
        /// What it says.
        hello: Box<Hello>,
    },
    /// A peer can be written to: first heard, or back.
    PeerUp(Endpoint),
    /// A peer does not acknowledge: nothing is sent to it for the moment, what waits stays.
    PeerSuspect {
        /// The peer.
        flow: FlowId,
    },
    /// A suspect peer acknowledges again.
    PeerRecovered {
        /// The peer.
        flow: FlowId,
    },
    /// A peer is gone; what waited for it was dropped.
    PeerDown {
        /// The peer, and its life that ended.
        endpoint: Endpoint,
        /// Why.
        reason: DownReason,
    },
    /// A peer that was down is not waited for any more.
    PeerForgotten(Endpoint),
    /// The engine holds nothing of this life of a peer any more: what the transport has for it can
    /// go.
    PeerRemoved(Endpoint),
    /// There was no place for a flow; told once in a while, however many there are.
    PeerRefused {
        /// One of them.
        flow: FlowId,
        /// The peers that there are, which is the most.
        peers: usize,
    },
    /// A flow that was refused has a place now: writers to it are to be made.
    PeerAdmitted(Endpoint),
    /// Addresses that were not known before.
    Addresses(Vec<String>),
    /// The last byte of a message was sent for the first time: for rates. Each message has at most
    /// one of these.
    LaneSent {
        /// Its lane.
        lane: LaneId,
        /// Bytes of the payload.
        bytes: usize,
        /// Since it arrived at this flow.
        wait: Duration,
    },
    /// A message has left for good: best-effort ones of one part when sent, others when they are
    /// known to have arrived.
    LaneOut {
        /// Its lane.
        lane: LaneId,
        /// Bytes of the payload.
        bytes: usize,
    },
    /// A message is about to be dropped of which some parts have left and others have not.
    LaneCut {
        /// Its lane.
        lane: LaneId,
        /// What has left.
        begun: Begun,
    },
    /// A message was dropped.
    LaneDropped {
        /// Its lane.
        lane: LaneId,
        /// Why.
        reason: DropReason,
    },
    /// Something that came over the link was dropped here.
    ReceiverDropped {
        /// Its topic, at most 200 bytes; empty if that is not known.
        topic: String,
        /// Why.
        reason: DropReason,
        /// Messages.
        messages: u64,
    },
}

/// A message that is being sent: not all of its parts have left.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Begun {
    /// Bytes of its payload.
    pub payload_bytes: usize,
    /// Parts that have left.
    pub parts_sent: usize,
    /// All of its parts; 1 or more.
    pub parts: usize,
}

/// Messages and their bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Tally {
    /// Messages.
    pub messages: u64,
    /// Bytes of their payloads.
    pub bytes: u64,
}

impl Tally {
    pub(crate) fn add(&mut self, bytes: usize) {
        self.messages += 1;
        self.bytes += bytes as u64;
    }

    pub(crate) fn remove(&mut self, bytes: usize) {
        self.messages = self.messages.saturating_sub(1);
        self.bytes = self.bytes.saturating_sub(bytes as u64);
    }
}

/// Events that wait to be taken, and what each lane has waiting.
#[derive(Debug, Default)]
pub(crate) struct Ledger {
    pub events: VecDeque<LinkEvent>,
    lanes: HashMap<LaneId, Tally>,
}

impl Ledger {
    pub(crate) fn submitted(&mut self, lane: LaneId, bytes: usize) {
        self.lanes.entry(lane).or_default().add(bytes);
    }

    /// It is not in the lane any more; whoever took it out counts it.
    pub(crate) fn left(&mut self, lane: LaneId, bytes: usize) {
        if let Some(tally) = self.lanes.get_mut(&lane) {
            tally.remove(bytes);
            if tally.messages == 0 {
                self.lanes.remove(&lane);
            }
        }
    }

    pub(crate) fn sent(&mut self, lane: LaneId, bytes: usize, wait: Duration) {
        self.events.push_back(LinkEvent::LaneSent { lane, bytes, wait });
    }

    pub(crate) fn out(&mut self, lane: LaneId, bytes: usize) {
        self.left(lane, bytes);
        self.events.push_back(LinkEvent::LaneOut { lane, bytes });
    }

    pub(crate) fn cut(&mut self, lane: LaneId, begun: Begun) {
        self.events.push_back(LinkEvent::LaneCut { lane, begun });
    }

    pub(crate) fn dropped(&mut self, lane: LaneId, bytes: usize, reason: DropReason) {
        self.left(lane, bytes);
        self.events.push_back(LinkEvent::LaneDropped { lane, reason });
    }

    pub(crate) fn queued(&self, lane: LaneId) -> Tally {
        self.lanes.get(&lane).copied().unwrap_or_default()
    }
}

/// Whether a peer can be written to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PeerState {
    /// It says Hello and acknowledges.
    Up,
    /// It does not acknowledge.
    Suspect,
    /// It does not say Hello (any more).
    Down,
}

/// What the engine knows of one peer.
#[derive(Debug, Clone, PartialEq)]
pub struct PeerInfo {
    /// The peer.
    pub flow: FlowId,
    /// Kind of its layer, once it said Hello.
    pub kind: Option<LayerKind>,
    /// Its life.
    pub epoch: u64,
    /// Version of its announced registry state.
    pub version: u64,
    /// Digest of its announced registry state.
    pub digest: u64,
    /// Whether it can be written to.
    pub state: PeerState,
    /// When its last Hello came.
    pub last_heard: Option<Instant>,
    /// Round trip, once measured.
    pub rtt: Option<Duration>,
    /// Its wall clock minus ours in nanoseconds, once measured.
    pub clock_offset_ns: Option<i64>,
    /// How far `clock_offset_ns` may be off.
    pub clock_error: Option<Duration>,
    /// Share of samples to it that were lost of late, 0 to 1.
    pub loss: f64,
    /// Bytes of datagrams per second that it receives from us.
    pub receiving_bytes_per_s: f64,
    /// Queueing on the way, as far as the round trip shows.
    pub queueing_delay: Duration,
    /// What the link carries, where that is estimated.
    pub capacity: Option<LinkCapacity>,
    /// Bytes that it will take, per class (control, state, bulk).
    pub window_bytes: [u64; 3],
    /// Bytes on the way, per class.
    pub outstanding_bytes: [usize; 3],
    /// Bytes that wait or may have to be repaired, per class.
    pub queue_bytes: [usize; 3],
}

/// Things that happened, since the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LinkCounters {
    /// Datagrams, records or LinkControl that do not follow the format.
    pub decode_errors: u64,
    /// Datagrams of a sender that has not said Hello.
    pub unknown_senders: u64,
    /// Datagrams of a link epoch or a life that is over.
    pub stale: u64,
    /// Samples or messages that came again, or too late.
    pub duplicates: u64,
    /// Unfinished messages that were given up because parts of them did not come. Their senders
    /// count them as dropped.
    pub reassembly_timeouts: u64,
    /// Unfinished messages that gave way because memory was full.
    pub reassembly_evicted: u64,
    /// Samples that were refused because too many before them are missing.
    pub overrun: u64,
    /// Times that a flow was found, or said Hello, and found no place.
    pub peers_refused: u64,
    /// LinkControl that found no place in its queue.
    pub control_refused: u64,
    /// Parts that were sent again.
    pub repairs: u64,
    /// Probes sent.
    pub probes: u64,
}
