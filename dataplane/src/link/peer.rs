//! One peer: its life, its clocks, and the two halves of each class.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use blaze_domain::{DropReason, Priority};
use blaze_proto::link::link_control::Hello;
use bytes::Bytes;

use super::budget::PathBudget;
use super::clock::{ClockOffset, RoundTrip};
use super::event::{Ledger, PeerInfo, PeerState};
use super::receiver::ReceiveClass;
use super::sender::{SendClass, SendLimits};
use super::transport::Endpoint;
use super::wire::{SenderId, kind_from_wire};

/// How often a Hello goes to each peer.
pub(crate) const HELLO_EVERY: Duration = Duration::from_millis(500);
/// Silence after which a peer is down.
pub(crate) const DOWN_AFTER: Duration = Duration::from_millis(2_500);
/// Silence after which a peer is forgotten.
pub(crate) const FORGET_AFTER: Duration = Duration::from_secs(60);
/// LinkControl of the registry that wait for one peer.
pub(crate) const MAX_CONTROLS: usize = 512;

/// Where a peer is in its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Phase {
    /// Never heard: it gets Hello alone.
    Connecting,
    /// Heard, and it acknowledges.
    Up,
    /// It does not acknowledge.
    Suspect,
    /// Silent: it gets Hello alone.
    Down,
    /// It said Goodbye: late datagrams of that life are ignored.
    Gone,
}

/// A Hello of the peer, to be echoed.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Echo {
    pub sent_monotonic_ns: u64,
    pub sent_wall_ns: u64,
    pub at: Instant,
    pub wall_ns: u64,
}

#[derive(Debug)]
pub(crate) struct Peer {
    pub endpoint: Endpoint,
    pub sender: SenderId,
    pub phase: Phase,
    /// When it was found, or left.
    pub since: Instant,
    pub last_hello: Option<Instant>,
    /// A newer life of this flow that has said Goodbye: late datagrams of it are ignored.
    pub ended: Option<u64>,
    /// It has been up, in this place or in one before.
    pub was_heard: bool,
    pub hello: Option<Box<Hello>>,
    pub hello_at: Instant,
    pub hello_due: bool,
    pub goodbye_due: bool,
    pub controls: VecDeque<Bytes>,
    pub echo: Option<Echo>,
    pub round_trip: RoundTrip,
    pub clock: ClockOffset,
    pub last_feedback: Option<Instant>,
    pub send: [SendClass; 3],
    pub receive: [ReceiveClass; 3],
    pub path: PathBudget,
}

impl Peer {
    /// Whether messages wait to be sent, credit or not.
    pub(crate) fn has_work(&self) -> bool {
        self.send.iter().any(SendClass::has_work)
    }

    pub(crate) fn new(
        now: Instant,
        endpoint: Endpoint,
        first_link_epoch: u32,
        limits: [SendLimits; 3],
        streams: usize,
    ) -> Self {
        let mut link_epoch = first_link_epoch;
        let mut class = |at: usize| {
            let class = SendClass::new(Priority::ALL[at], link_epoch, limits[at]);
            link_epoch = link_epoch.saturating_add(1);
            class
        };
        Self {
            sender: SenderId::of(&endpoint.flow, endpoint.epoch),
            endpoint,
            phase: Phase::Connecting,
            since: now,
            last_hello: None,
            ended: None,
            was_heard: false,
            hello: None,
            hello_at: now,
            hello_due: true,
            goodbye_due: false,
            controls: VecDeque::new(),
            echo: None,
            round_trip: RoundTrip::default(),
            clock: ClockOffset::default(),
            last_feedback: None,
            send: [class(0), class(1), class(2)],
            receive: std::array::from_fn(|_| ReceiveClass::new(streams)),
            path: PathBudget::default(),
        }
    }

    pub(crate) fn is_connected(&self) -> bool {
        matches!(self.phase, Phase::Up | Phase::Suspect)
    }

    /// Memory that it takes here with unfinished and waiting messages.
    pub(crate) fn reserved(&self) -> usize {
        self.receive.iter().map(ReceiveClass::reserved).sum()
    }

    fn outstanding(&self) -> usize {
        self.send.iter().map(SendClass::outstanding).sum()
    }

    /// When it becomes suspect, unless a Feedback comes first.
    pub(crate) fn suspect_at(&self) -> Option<Instant> {
        if self.phase != Phase::Up || self.outstanding() == 0 {
            return None;
        }
        let since = self.send.iter().filter_map(SendClass::outstanding_since).min()?;
        let since = self.last_feedback.map_or(since, |last| last.max(since));
        Some(since + (self.round_trip.get() * 4).max(Duration::from_millis(300)))
    }

    /// When silence ends its phase.
    pub(crate) fn silent_at(&self) -> Option<Instant> {
        let heard = self.last_hello.unwrap_or(self.since);
        Some(match self.phase {
            Phase::Up | Phase::Suspect => heard + DOWN_AFTER,
            Phase::Down | Phase::Connecting => heard + FORGET_AFTER,
            Phase::Gone => self.since + FORGET_AFTER,
        })
    }

    /// Drops what waits for it and begins new link epochs from `link_epoch` on. Returns the next
    /// unused one.
    pub(crate) fn drop_outgoing(&mut self, link_epoch: u32, ledger: &mut Ledger) -> u32 {
        let newest = self.send.iter().map(SendClass::link_epoch).max().unwrap_or(0);
        let mut next = link_epoch.max(newest.saturating_add(1));
        for class in &mut self.send {
            class.restart(next, DropReason::LinkDown, ledger);
            next = next.saturating_add(1);
        }
        self.controls.clear();
        self.last_feedback = None;
        next
    }

    pub(crate) fn next_timeout(&self) -> Option<Instant> {
        let hello = (self.phase != Phase::Gone && !self.hello_due).then_some(self.hello_at);
        let connected = self.is_connected();
        let fixed = [hello, self.silent_at(), self.suspect_at()];
        let sending = self.send.iter().map(SendClass::next_timeout);
        let receiving = self.receive.iter().map(|class| class.next_timeout(connected));
        fixed.into_iter().chain(sending).chain(receiving).flatten().min()
    }

    pub(crate) fn info(&self) -> PeerInfo {
        let hello = self.hello.as_deref();
        let clock = self.clock.get();
        let (mut received, mut lost) = (0.0, 0.0);
        for class in &self.send {
            let counts = class.loss.counts();
            received += counts.0;
            lost += counts.1;
        }
        PeerInfo {
            flow: self.endpoint.flow.clone(),
            kind: hello.and_then(|hello| kind_from_wire(hello.kind())),
            epoch: self.endpoint.epoch,
            version: hello.map_or(0, |hello| hello.registry_version),
            digest: hello.map_or(0, |hello| hello.registry_digest),
            state: match self.phase {
                Phase::Up => PeerState::Up,
                Phase::Suspect => PeerState::Suspect,
                Phase::Connecting | Phase::Down | Phase::Gone => PeerState::Down,
            },
            last_heard: self.last_hello,
            rtt: self.round_trip.measured(),
            clock_offset_ns: clock.map(|clock| clock.0),
            clock_error: clock.map(|clock| clock.1),
            loss: if lost > 0.0 { lost / (received + lost) } else { 0.0 },
            receiving_bytes_per_s: self.send.iter().map(|class| class.rate.bytes_per_s()).sum(),
            queueing_delay: self.round_trip.queueing(),
            capacity: self.path.capacity(),
            window_bytes: [0, 1, 2].map(|at| self.send[at].window()),
            outstanding_bytes: [0, 1, 2].map(|at| self.send[at].outstanding()),
            queue_bytes: [0, 1, 2].map(|at| self.send[at].queue_bytes()),
        }
    }
}
