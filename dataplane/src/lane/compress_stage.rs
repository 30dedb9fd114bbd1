//! Compression on the way of a message: after a lane has admitted it and before it is queued, and
//! back after it came over the link.
//!
//! ```text
//! gate ─► outward: a place in the line of topic and writer ─► begin ─► LZ4 ─► finished ─► in order ─► lanes
//! link ─► inward:  a place in the line of topic and writer ─► begin ─► LZ4 ─► finished ─► in order ─► bridges to brokers
//! gate ─► convert: a place in the line of topic, writer and encoding ─► begin ─► types ─► finished ─► in order ─► brokers
//! ```
//!
//! A message is compressed once, whatever the number of its lanes. What needs no compression waits
//! behind what does of the same writer, so its order is that of admission.
//!
//! This stage only queues. The caller asks how many jobs the pool should run
//! ([`DataCore::take_pool_requests`]). For each of them a pool thread calls [`DataCore::begin`],
//! and [`DataCore::finished`] with the result. A message that no thread has started may still be
//! replaced by a newer one or expire.

mod convert;
mod inward;
mod level;
mod outward;

use std::collections::BTreeMap;
use std::ops::AddAssign;
use std::time::Instant;

use blaze_domain::node_file::{Compression, TopicRule, TopicValues};
use blaze_domain::{DropReason, TopicName, WriterId};
use blaze_proto::Frame;
use bytes::Bytes;

use super::admit::Admitted;
use super::core::{DataCore, LaneLink};
use super::path::TopicId;
use crate::codec::effort::shares;
use crate::codec::order::{Bounds, InOrder, Ticket, Waiting};
use crate::codec::pool::{Urgency, threads_for_long};
use crate::codec::{Done, Work};
use crate::types::{Encoding, MessageType};
use convert::Converting;
pub(super) use convert::ToBrokers;
pub use convert::{ConvertStats, Unconverted};
pub(super) use inward::plain;
pub use level::{CompressStats, TopicEffort};
use outward::Outward;
pub(super) use outward::ToLanes;

/// Whether a message comes alone or as one of many at the same moment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Arrival {
    /// As it was published.
    Live,
    /// With all that is kept for a late joiner, before anything of it can be compressed. What the
    /// codec has no room for goes as it is: nobody sends it again.
    Kept,
}

/// Of what came over the link so many bytes wait for the pool (16 MiB) before the thread that
/// brings more does the work itself.
const OWN_ABOVE: usize = 16 * 1024 * 1024;

/// Topic and writer: what stays in order.
type Line = (TopicId, WriterId);

/// How payloads are compressed, by topic.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CompressionRules {
    /// `flow.compression`.
    pub base: Compression,
    /// `flow.topics`.
    pub topics: Vec<TopicRule>,
}

impl CompressionRules {
    /// What holds for a topic.
    #[must_use]
    pub fn find(&self, topic: &TopicName) -> Compression {
        self.base.with(TopicValues::of(&self.topics, topic).compression)
    }
}

/// Jobs that are to be run, as far as they were not requested before.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PoolRequests {
    /// Short jobs for the pool.
    pub quick: usize,
    /// Jobs with large payloads for the pool.
    pub long: usize,
    /// Jobs for the calling thread, see [`DataCore::begin_by_caller`]: the pool is behind.
    pub by_caller: usize,
}

impl AddAssign for PoolRequests {
    fn add_assign(&mut self, more: Self) {
        self.quick += more.quick;
        self.long += more.long;
        self.by_caller += more.by_caller;
    }
}

/// What is to be done for one message.
#[derive(Debug, Clone)]
pub struct CodecJob {
    /// To be given back with the result.
    pub ticket: CodecTicket,
    /// The payload.
    pub payload: Bytes,
    /// What is to be done with it.
    pub work: Work,
}

type ConvertTicket = Ticket<TopicId, (WriterId, Encoding)>;

/// Which message that is.
#[derive(Debug, Clone, Copy)]
pub struct CodecTicket {
    place: Place,
}

#[derive(Debug, Clone, Copy)]
enum Place {
    Out(Ticket<TopicId, WriterId>),
    Into(Ticket<TopicId, WriterId>),
    Convert(ConvertTicket),
}

/// Ways through the stage; jobs of one urgency take turns among them, so that none starves another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    Into,
    Out,
    Convert,
}

/// What waits for the codec, and what did not get that far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct CompressCounters {
    /// Messages that no thread has started.
    pub waiting: usize,
    /// Bytes of their payloads; of those that came over the link, as they are to become.
    pub waiting_bytes: usize,
    /// Messages for which there was no room, since the start.
    pub refused: u64,
    /// Payloads with which the codec panicked, since the start.
    pub failed: u64,
}

/// The stage in both directions.
pub(super) struct CompressStage {
    /// Whether there is a pool.
    enabled: bool,
    rules: CompressionRules,
    out: InOrder<TopicId, WriterId, Outward>,
    into: InOrder<TopicId, WriterId, Box<Admitted>>,
    convert: InOrder<TopicId, (WriterId, Encoding), Converting>,
    /// Messages whose types are sought with others, as if somebody worked on them.
    unknown: BTreeMap<MessageType, Vec<ConvertTicket>>,
    /// Jobs that were requested and have not begun, by urgency.
    requested: [usize; Urgency::ALL.len()],
    /// The way of the last job, by urgency.
    last: [Way; Urgency::ALL.len()],
    refused: u64,
    failed: u64,
}

impl Default for CompressStage {
    fn default() -> Self {
        let bounds = Bounds::default();
        Self {
            enabled: false,
            rules: CompressionRules::default(),
            out: InOrder::new(bounds),
            // Inbound messages of a topic get its full byte bound while waiting: the sender has
            // already paced them and decompression is fast.
            into: InOrder::new(Bounds { waiting_of_one: bounds.bytes_of_one, ..bounds }),
            convert: InOrder::new(bounds),
            unknown: BTreeMap::new(),
            requested: [0; Urgency::ALL.len()],
            last: [Way::Convert; Urgency::ALL.len()],
            refused: 0,
            failed: 0,
        }
    }
}

impl CompressStage {
    pub(super) fn find(&self, topic: &TopicName) -> Compression {
        self.rules.find(topic)
    }

    /// Whether something of a topic that came over the link may not be with its brokers yet.
    pub(super) fn delays(&self, topic: TopicId) -> bool {
        self.into.holds(&topic) || self.convert.holds(&topic)
    }

    pub(super) fn delays_any(&self) -> bool {
        self.into.held().items > 0 || self.convert.held().items > 0
    }

    /// Whether it holds anything of a topic.
    pub(super) fn holds(&self, topic: TopicId) -> bool {
        self.out.holds(&topic) || self.delays(topic)
    }

    /// What it holds for one bridge of a topic goes to another one. Returns how many messages that
    /// are.
    pub(super) fn hand_over(&mut self, topic: TopicId, from: usize, to: usize) -> u64 {
        let mut moved = 0;
        for lanes in self.out.items_mut(&topic).map(|out| &mut out.lanes) {
            for (at, _) in lanes.iter_mut().filter(|(at, _)| *at == from) {
                *at = to;
                moved += 1;
            }
        }
        moved
    }

    /// What it holds for one bridge of a topic.
    pub(super) fn frames_for(&self, topic: TopicId, bridge: usize) -> impl Iterator<Item = &Frame> {
        let lanes = self.out.items(topic).flat_map(|out| &out.lanes);
        let sent = lanes.filter(move |(at, _)| *at == bridge).map(|(_, waiting)| &waiting.frame);
        let of_bridge =
            move |message: &&Converting| message.bridges.iter().any(|(at, _)| *at == bridge);
        let written = self.convert.items(topic).filter(of_bridge).map(|message| &message.frame);
        sent.chain(written)
    }

    fn waiting(&self, urgency: Urgency) -> usize {
        self.waits(urgency).items
    }

    fn waits(&self, urgency: Urgency) -> Waiting {
        let [out, into, convert] =
            [self.out.waits(urgency), self.into.waits(urgency), self.convert.waits(urgency)];
        Waiting {
            items: out.items + into.items + convert.items,
            bytes: out.bytes + into.bytes + convert.bytes,
        }
    }

    /// Jobs that are still to be requested. A request whose message was replaced is reused for the
    /// next message.
    fn missing_requests(&self) -> [usize; Urgency::ALL.len()] {
        Urgency::ALL
            .map(|urgency| self.waiting(urgency).saturating_sub(self.requested[urgency as usize]))
    }

    fn request_starts(&mut self, urgency: Urgency) {
        let requested = &mut self.requested[urgency as usize];
        *requested = requested.saturating_sub(1);
    }

    /// What came over the link, to be decompressed.
    fn begin_inward(&mut self) -> Option<CodecJob> {
        let (place, message) = self.into.begin(Urgency::Quick)?;
        let job = CodecJob {
            ticket: CodecTicket { place: Place::Into(place) },
            payload: message.frame.payload().clone(),
            work: Work::Decompress(message.frame.uncompressed_bytes()),
        };
        Some(job)
    }
}

impl DataCore {
    /// There is a pool: payloads are compressed from now on. Without this they go as they are, and
    /// what comes is decompressed at once.
    pub fn enable_compression(&mut self) {
        self.compress.enabled = true;
    }

    /// There is no pool any more. What waits for it is dropped; what it is at comes back.
    pub fn stop_compression(&mut self, now: Instant, link: &mut dyn LaneLink) {
        self.compress.enabled = false;
        self.compress.requested = Default::default();
        self.give_up_unknown(now);
        for urgency in Urgency::ALL {
            while let Some(place) = self.compress.out.begin(urgency).map(|(place, _)| place) {
                if let Some(out) = self.compress.out.give_up(&place) {
                    self.lose(place.key().0, &out, DropReason::Shutdown);
                }
                self.flush_out(now, *place.key(), link);
            }
            while let Some(place) = self.compress.into.begin(urgency).map(|(place, _)| place) {
                self.compress.into.give_up(&place);
                self.refuse_inward(place.key().0, DropReason::Shutdown);
                self.flush_in(now, *place.key(), link);
            }
            while let Some(place) = self.compress.convert.begin(urgency).map(|(place, _)| place) {
                if let Some(message) = self.compress.convert.give_up(&place) {
                    self.refuse_to_convert(place.key().0, &message, DropReason::Shutdown);
                }
                self.flush_convert(now, *place.key());
            }
        }
        self.stir();
    }

    /// Changes how payloads are compressed, from the next message on.
    pub fn set_compression(&mut self, rules: CompressionRules) {
        for path in &mut self.topics {
            path.set_compression(rules.find(&path.name));
        }
        self.compress.rules = rules;
    }

    /// New requests since the last call. The caller must run all of [`PoolRequests::by_caller`].
    pub fn take_pool_requests(&mut self) -> PoolRequests {
        let stage = &mut self.compress;
        let [quick, long] = stage.missing_requests();
        stage.requested[Urgency::Quick as usize] += quick;
        stage.requested[Urgency::Long as usize] += long;
        let is_behind = stage.into.waits(Urgency::Quick).bytes > OWN_ABOVE;
        let by_caller = if is_behind { quick } else { 0 };
        PoolRequests { quick: quick - by_caller, long, by_caller }
    }

    /// Whether there are new requests.
    #[must_use]
    pub fn has_pool_requests(&self) -> bool {
        self.compress.missing_requests().iter().any(|requests| *requests > 0)
    }

    /// A pool thread takes the next job. `None`: nothing is left to be done.
    pub fn begin(
        &mut self,
        now: Instant,
        urgency: Urgency,
        link: &mut dyn LaneLink,
    ) -> Option<CodecJob> {
        self.compress.request_starts(urgency);
        let ways = match self.compress.last[urgency as usize] {
            Way::Convert => [Way::Into, Way::Out, Way::Convert],
            Way::Into => [Way::Out, Way::Convert, Way::Into],
            Way::Out => [Way::Convert, Way::Into, Way::Out],
        };
        for way in ways {
            let job = match (way, urgency) {
                (Way::Into, Urgency::Quick) => self.compress.begin_inward(),
                (Way::Into, Urgency::Long) => None,
                (Way::Out, _) => self.begin_outward(now, urgency, link),
                (Way::Convert, _) => self.begin_convert(now, urgency),
            };
            if job.is_some() {
                self.compress.last[urgency as usize] = way;
                return job;
            }
        }
        None
    }

    /// The calling thread takes the next inbound job. `None`: nothing is left to be done.
    pub fn begin_by_caller(&mut self) -> Option<CodecJob> {
        self.compress.request_starts(Urgency::Quick);
        let job = self.compress.begin_inward()?;
        self.compress.last[Urgency::Quick as usize] = Way::Into;
        Some(job)
    }

    /// Takes the result of a job.
    pub fn finished(
        &mut self,
        now: Instant,
        ticket: CodecTicket,
        done: Done,
        link: &mut dyn LaneLink,
    ) {
        self.compress.failed += u64::from(done == Done::Failed);
        match &ticket.place {
            Place::Out(place) => self.finished_out(now, place, done, link),
            Place::Into(place) => self.finished_in(now, place, done, link),
            Place::Convert(place) => self.finished_convert(now, place, done),
        }
        self.stir();
    }

    /// Divides the pool among topics by what they need; to be called about twice a second.
    pub fn share_pool(&mut self, now: Instant, threads: usize) {
        let mut topics = Vec::new();
        let mut wanted = Vec::new();
        for (at, path) in self.topics.iter_mut().enumerate().filter(|(_, path)| !path.vacant) {
            if let Some(effort) = path.effort.get_mut() {
                topics.push(at);
                wanted.push(effort.wanted());
            }
        }
        // First what a topic may use, then what it is to do with it.
        let threads = threads_for_long(threads) as f64;
        for (at, share) in topics.into_iter().zip(shares(threads, &wanted)) {
            let path = &mut self.topics[at];
            let rate_hz = path.worth_rate.rate(now).0;
            if let Some(effort) = path.effort.get_mut() {
                effort.set_threads(share);
                effort.demand(now, rate_hz);
            }
        }
    }

    /// What waits for the codec, and what did not get that far.
    #[must_use]
    pub fn compress_counters(&self) -> CompressCounters {
        let stage = &self.compress;
        let waits = Urgency::ALL.map(|urgency| stage.waits(urgency).bytes);
        CompressCounters {
            waiting: Urgency::ALL.iter().map(|urgency| stage.waiting(*urgency)).sum(),
            waiting_bytes: waits.iter().sum(),
            refused: stage.refused,
            failed: stage.failed,
        }
    }
}
