//! The receiving half of one class of one peer.
//!
//! ```text
//! sample → seen before? → records → whole, or assembled → waits for the message that it must follow → delivered
//!             │
//!             └→ Feedback: highest sequence, what is missing
//! ```
//!
//! Each message is settled once: delivered, dropped or given up. A settled one is never looked at
//! again. What is dropped is counted here. What is given up before it was complete is counted by its
//! sender, which is told of it: it may have given it up, too, and knows the name also of one of which
//! nothing came.

mod settle;
mod timing;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::hash::{BuildHasher, RandomState};
use std::time::{Duration, Instant};

use blaze_domain::{DropReason, FlowId};
use blaze_proto::Frame;
use bytes::Bytes;
use lru::LruCache;
use smallvec::SmallVec;

use super::assembly::Assembly;
use super::event::{LinkCounters, LinkEvent};
use super::ranges::RangeSet;
use super::wire::{LinkHeader, Record};
use crate::lane::measure::micros;

/// An unfinished message is given up that long after its last part, and so is the one that another
/// waits for. Time in which nothing of the class comes does not count: the sender may have been cut
/// off, or have more urgent things to send. Nor does time in which more is missing than a Feedback
/// can tell: nobody repairs what it was not asked for.
const PATIENCE: Duration = Duration::from_secs(2);
/// … but that long at most.
const LONGEST_PATIENCE: Duration = Duration::from_secs(30);
/// A longer silence of the class counts as that much.
const ACTIVE_GAP: Duration = Duration::from_millis(250);
/// How often unfinished and waiting messages are looked at.
const SWEEP: Duration = Duration::from_millis(100);
const FEEDBACK_EVERY: Duration = Duration::from_millis(50);
const FEEDBACK_IDLE: Duration = Duration::from_millis(500);
const FEEDBACK_SAMPLES: u32 = 64;
/// Missing ranges in one Feedback, by their sequences. Flows of the first version take no more.
pub(crate) const MISSING_RANGES: usize = 32;
/// Missing ranges that a Feedback tells beyond those, by their distances, as far as its datagram
/// has room. All that is lost in a round trip should fit: what does not waits for the next one.
pub(crate) const MORE_RANGES: usize = 512;
/// Messages in one Feedback that were given up before they were complete.
pub(crate) const GIVEN_UP_TOLD: usize = 64;
/// Such messages that are kept until their sender has settled them; more are counted here.
const MAX_GIVEN_UP: usize = 1_024;
/// Gaps in the sequence that are kept; a sample that would make more is refused.
const MAX_SEQUENCE_RANGES: usize = 8_192;
/// Gaps between settled messages that are kept; the oldest is given up.
const MAX_MESSAGE_RANGES: usize = 4_096;
/// Unfinished messages of one class; the oldest gives way.
const MAX_UNFINISHED: usize = 1_024;
/// Messages of one class that wait for another; the oldest is not waited for any more.
const MAX_HELD: usize = 16_384;
/// A frame that waits is handed out so long before its lifespan ends.
const LIFESPAN_RESERVE: Duration = Duration::from_millis(1);
/// What a message costs in memory besides its bytes.
pub(crate) const MESSAGE_OVERHEAD: usize = 256;

/// A complete message that waits for the one before it.
#[derive(Debug)]
struct Held {
    message: Complete,
    before: u32,
    since: Instant,
    active: Duration,
    /// Bytes of memory that it holds.
    bytes: usize,
}

/// A complete message and what its records said.
#[derive(Debug)]
struct Complete {
    frame: Frame,
    hops: u8,
    age_us: u32,
    first_part: Instant,
    /// Half the round trip when its first part came.
    lag: Duration,
}

/// Where deliveries and drops of a receiving half go.
pub(crate) struct Inbox<'a> {
    pub now: Instant,
    pub from: &'a FlowId,
    pub half_round_trip: Duration,
    pub events: &'a mut std::collections::VecDeque<LinkEvent>,
    pub counters: &'a mut LinkCounters,
    /// Keyed anew at each start, so that nobody chooses collisions.
    pub hasher: &'a RandomState,
}

impl Inbox<'_> {
    fn dropped(&mut self, topic: &str, reason: DropReason) {
        self.events.push_back(LinkEvent::ReceiverDropped {
            topic: topic.chars().take(200).collect(),
            reason,
            messages: 1,
        });
    }
}

/// What became of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Admission {
    /// New: its records are to be taken.
    New,
    /// Known or too late.
    Repeated,
    /// Of a link epoch that is over.
    Stale,
    /// Too many before it are missing.
    Overrun,
}

#[derive(Debug)]
pub(crate) struct ReceiveClass {
    link_epoch: u32,
    sequences: RangeSet,
    sequence_floor: u64,
    received_bytes: u64,
    echo: Option<(u64, Instant)>,
    samples: u32,
    last_feedback: Option<Instant>,
    feedback_at: Option<Instant>,
    feedback_due: bool,
    /// More was missing than the last Feedback could tell.
    untold: bool,
    /// Messages below are settled.
    message_floor: u64,
    settled: RangeSet,
    /// Given up before they were complete, and not settled by the sender yet.
    given_up: BTreeSet<u32>,
    assemblies: HashMap<u32, Assembly>,
    held: BTreeMap<u32, Held>,
    /// Who waits for a message.
    waiters: HashMap<u32, SmallVec<[u32; 1]>>,
    reserved: usize,
    /// No held message has to be handed out before.
    hand_out_at: Option<Instant>,
    /// Time in which samples came and all that was missing could be told.
    active: Duration,
    last_sample: Option<Instant>,
    sweep_at: Option<Instant>,
    /// The newest message of each stream that was delivered.
    streams: LruCache<u64, u32>,
    max_streams: usize,
}

impl ReceiveClass {
    pub(crate) fn new(max_streams: usize) -> Self {
        Self {
            link_epoch: 0,
            sequences: RangeSet::default(),
            sequence_floor: 0,
            received_bytes: 0,
            echo: None,
            samples: 0,
            last_feedback: None,
            feedback_at: None,
            feedback_due: false,
            untold: false,
            message_floor: 1,
            settled: RangeSet::default(),
            given_up: BTreeSet::new(),
            assemblies: HashMap::new(),
            held: BTreeMap::new(),
            waiters: HashMap::new(),
            reserved: 0,
            hand_out_at: None,
            active: Duration::ZERO,
            last_sample: None,
            sweep_at: None,
            streams: LruCache::unbounded(),
            max_streams,
        }
    }

    /// Bytes of memory that unfinished and waiting messages hold.
    pub(crate) fn reserved(&self) -> usize {
        self.reserved
    }

    /// Bytes that are reserved and have not come yet.
    fn expected(&self) -> usize {
        self.assemblies.values().map(Assembly::missing_bytes).sum()
    }

    /// Takes note of a sample. Its records count only if it is [`Admission::New`].
    pub(crate) fn admit(
        &mut self,
        inbox: &mut Inbox<'_>,
        header: &LinkHeader,
        bytes: usize,
    ) -> Admission {
        if header.link_epoch < self.link_epoch {
            return Admission::Stale;
        }
        if header.link_epoch > self.link_epoch {
            self.release_all(inbox);
            let (max_streams, link_epoch) = (self.max_streams, header.link_epoch);
            *self = Self::new(max_streams);
            self.link_epoch = link_epoch;
        }
        let now = inbox.now;
        if let Some(last) = self.last_sample
            && !self.untold
        {
            self.active += now.saturating_duration_since(last).min(ACTIVE_GAP);
        }
        self.last_sample = Some(now);
        if header.records == 0 {
            self.feedback_due = true;
        }
        // Floors only rise, so those of a sample that came before are as good, and so are those of
        // one that is refused: where too much is missing, they alone make room again.
        self.give_up_below(inbox, u64::from(header.message_floor));
        if self.given_up.first().is_some_and(|first| *first < header.message_floor) {
            self.given_up = self.given_up.split_off(&header.message_floor);
        }
        let sequence = header.link_sequence;
        let floor = sequence.saturating_sub(u64::from(header.unsettled));
        if floor > self.sequence_floor {
            self.sequence_floor = floor;
            self.sequences.remove_through(floor);
        }
        if sequence <= self.sequence_floor || self.sequences.contains(sequence) {
            return Admission::Repeated;
        }
        if self.sequences.len() >= MAX_SEQUENCE_RANGES {
            return Admission::Overrun;
        }
        self.sequences.insert(sequence, sequence);
        self.received_bytes += bytes as u64;
        self.echo = Some((header.send_ns, now));
        if header.records > 0 {
            self.samples += 1;
        }
        if self.samples >= FEEDBACK_SAMPLES {
            self.feedback_due = true;
        } else if self.feedback_at.is_none() {
            self.feedback_at =
                Some(self.last_feedback.map_or(now, |last| (last + FEEDBACK_EVERY).max(now)));
        }
        Admission::New
    }

    fn is_settled(&self, message: u32) -> bool {
        u64::from(message) < self.message_floor || self.settled.contains(u64::from(message))
    }

    /// Memory that a record would newly hold, at most.
    pub(crate) fn needs(&self, record: &Record, datagram_bytes: usize) -> usize {
        if record.is_whole() {
            let waits =
                record.behind != 0 && !self.is_settled(record.message - u32::from(record.behind));
            return if waits { datagram_bytes + MESSAGE_OVERHEAD } else { 0 };
        }
        if self.assemblies.contains_key(&record.message) || self.is_settled(record.message) {
            return 0;
        }
        Assembly::memory(record.total as usize)
    }

    /// Takes a record of a new sample.
    pub(crate) fn record(
        &mut self,
        inbox: &mut Inbox<'_>,
        record: &Record,
        bytes: Bytes,
        datagram_bytes: usize,
    ) {
        let number = record.message;
        if self.is_settled(number) || self.held.contains_key(&number) {
            inbox.counters.duplicates += 1;
            return;
        }
        if record.is_whole() {
            let message = Frame::parse(bytes).map(|frame| Complete {
                frame,
                hops: record.hops,
                age_us: record.age_us,
                first_part: inbox.now,
                lag: inbox.half_round_trip,
            });
            self.remove_assembly(number);
            self.complete(
                inbox,
                number,
                record.behind,
                message.ok(),
                datagram_bytes + MESSAGE_OVERHEAD,
            );
            return;
        }
        if self.assemblies.len() >= MAX_UNFINISHED && !self.assemblies.contains_key(&number) {
            self.evict(inbox);
        }
        let active = self.active;
        let assembly = self.assemblies.entry(number).or_insert_with(|| {
            self.reserved += Assembly::memory(record.total as usize);
            Assembly::new(record, inbox.now, inbox.half_round_trip, active)
        });
        if !assembly.take(record, &bytes, inbox.now, active) {
            inbox.counters.decode_errors += 1;
            return;
        }
        self.sweep_at.get_or_insert(inbox.now + SWEEP);
        if !assembly.is_complete() {
            return;
        }
        let Some(assembly) = self.remove_assembly(number) else {
            return;
        };
        let (behind, hops, age_us) = (assembly.behind, assembly.hops, assembly.age_us);
        let (first_part, lag) = (assembly.first_part, assembly.half_round_trip);
        let memory = Assembly::memory(assembly.total());
        let message =
            assembly.into_frame().map(|frame| Complete { frame, hops, age_us, first_part, lag });
        self.complete(inbox, number, behind, message, memory);
    }

    fn remove_assembly(&mut self, number: u32) -> Option<Assembly> {
        let assembly = self.assemblies.remove(&number)?;
        self.reserved = self.reserved.saturating_sub(Assembly::memory(assembly.total()));
        Some(assembly)
    }

    /// A message is complete: deliver it, or keep it until the one before it is settled.
    fn complete(
        &mut self,
        inbox: &mut Inbox<'_>,
        number: u32,
        behind: u16,
        message: Option<Complete>,
        memory: usize,
    ) {
        let Some(message) = message else {
            inbox.counters.decode_errors += 1;
            inbox.dropped("", DropReason::DecodeError);
            self.settle(inbox, number);
            return;
        };
        let before = number.saturating_sub(u32::from(behind));
        if behind == 0 || self.is_settled(before) {
            self.deliver(inbox, number, message);
            self.settle(inbox, number);
            return;
        }
        self.reserved += memory;
        self.waiters.entry(before).or_default().push(number);
        self.sweep_at.get_or_insert(inbox.now + SWEEP);
        let held = Held { message, before, since: inbox.now, active: self.active, bytes: memory };
        if let Some(at) = held.hand_out_at() {
            self.hand_out_at = Some(self.hand_out_at.map_or(at, |next| next.min(at)));
        }
        self.held.insert(number, held);
        if self.held.len() > MAX_HELD
            && let Some((&oldest, _)) = self.held.first_key_value()
        {
            self.give_up_before(inbox, oldest);
        }
    }

    /// Hands a message out, unless it is too old or a newer one of its stream was first.
    fn deliver(&mut self, inbox: &mut Inbox<'_>, number: u32, message: Complete) {
        let Complete { frame, hops, age_us, first_part, lag } = message;
        let here = inbox.now.saturating_duration_since(first_part) + lag;
        let age_us = u64::from(age_us).saturating_add(micros(here));
        if frame.lifespan_ms() != 0 && age_us > u64::from(frame.lifespan_ms()) * 1000 {
            inbox.dropped(frame.topic(), DropReason::Lifespan);
            return;
        }
        let stream = inbox.hasher.hash_one((frame.topic(), frame.writer()));
        match self.streams.get_mut(&stream) {
            Some(newest) if *newest > number => {
                inbox.dropped(frame.topic(), DropReason::Duplicate);
                return;
            }
            Some(newest) => *newest = number,
            None => {
                self.streams.put(stream, number);
                if self.streams.len() > self.max_streams {
                    self.streams.pop_lru();
                }
            }
        }
        inbox.events.push_back(LinkEvent::Deliver {
            from: inbox.from.clone(),
            frame: frame.with_hops_and_age(u32::from(hops), age_us),
            at: inbox.now,
        });
    }
}

impl Held {
    /// When it must not wait any longer.
    fn hand_out_at(&self) -> Option<Instant> {
        let lifespan = self.message.frame.lifespan_ms();
        if lifespan == 0 {
            return None;
        }
        let age = Duration::from_micros(u64::from(self.message.age_us)) + self.message.lag;
        let left =
            Duration::from_millis(u64::from(lifespan)).saturating_sub(age + LIFESPAN_RESERVE);
        self.message.first_part.checked_add(left)
    }
}
