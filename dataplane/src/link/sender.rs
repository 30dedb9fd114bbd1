//! The sending half of one class of one peer.
//!
//! ```text
//! submit → waiting (unstarted, oldest gives way) → started: numbered, parts in samples → acknowledged: out
//!                                                        ▲                │ sample lost
//!                                                        └── repairs ◄────┘
//! ```
//!
//! A message gets its number when its first byte leaves, so what gives way before leaves no gap.
//! Best-effort messages of one part are out when they are sent; the others are kept until each part
//! is acknowledged.

mod acknowledge;
mod timing;

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use blaze_domain::{DropReason, Priority};
use lru::LruCache;
use smallvec::SmallVec;

use super::budget::PacketSize;
use super::clock::{LossMeter, RateMeter};
use super::event::{Begun, LaneId, Ledger, LinkCounters, StreamKey, Submit, Tally};
use super::outgoing::{Key, Messages, Outgoing, Part, PartRef};
use super::wire::{DatagramBuilder, FLAG_REPAIR, HEADER_BYTES, LinkHeader, RECORD_BYTES, SenderId};

/// Credit before the first Feedback.
pub(crate) const FIRST_WINDOW: u64 = 64 * 1024;
/// Samples on the way, at most.
const MAX_IN_FLIGHT: usize = 65_536;
/// A sample is lost once that many later ones are reported …
const REORDERING: u64 = 3;
/// How often expired messages are looked for.
const SWEEP: Duration = Duration::from_millis(20);
/// What a message costs in its queue besides its bytes.
const MESSAGE_OVERHEAD: usize = 64;
/// The last message number of a link epoch; a new epoch begins when nothing is on the way.
const LAST_NUMBER: u32 = u32::MAX - 1;

/// A sample on its way.
#[derive(Debug)]
struct Sample {
    sent: Instant,
    bytes: u32,
    /// The next message number when it was sent.
    next_number: u32,
    settled: bool,
    probe: bool,
    /// What it is the first to tell.
    announces: Option<u32>,
    parts: SmallVec<[PartRef; 1]>,
}

/// Bounds of one class of one peer.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SendLimits {
    pub queue_bytes: usize,
    pub streams: usize,
    pub max_datagram: usize,
}

/// What a Feedback says, checked for form.
#[derive(Debug, Clone)]
pub(crate) struct FeedbackView<'a> {
    pub link_epoch: u32,
    pub highest_sequence: u64,
    /// First and count, ascending.
    pub missing: &'a [u64],
    /// Messages that the receiver gave up before they were complete.
    pub given_up: &'a [u32],
    pub received_bytes: u64,
    pub window_bytes: u64,
    pub delivered_message: u32,
}

#[derive(Debug)]
pub(crate) struct SendClass {
    class: Priority,
    link_epoch: u32,
    limits: SendLimits,
    messages: Messages,
    waiting: VecDeque<Key>,
    current: Option<Key>,
    /// Started and ordered, by number; entries of settled ones are skipped.
    started: VecDeque<(u32, Key)>,
    repairs: VecDeque<PartRef>,
    /// Last ordered message of each stream.
    streams: LruCache<StreamKey, u32>,
    next_number: u32,
    /// Sequence of the first sample in `in_flight`.
    base: u64,
    in_flight: VecDeque<Sample>,
    outstanding: usize,
    outstanding_since: Option<Instant>,
    waiting_bytes: usize,
    started_bytes: usize,
    window: u64,
    last_user_sequence: u64,
    highest_reported: u64,
    probe_at: Option<Instant>,
    probe_due: bool,
    last_probe: Option<Instant>,
    /// The receiver must learn that this message was given up, or (0) that a link epoch began.
    announce: Option<u32>,
    /// Samples that the last Feedback misses and that may still come.
    recheck: Option<(Instant, u64)>,
    missing: SmallVec<[(u64, u64); 8]>,
    next_expiry: Option<Instant>,
    last_sweep: Option<Instant>,
    pub loss: LossMeter,
    pub rate: RateMeter,
    /// Wire bytes of samples that were found to be received and lost, since the last
    /// [`SendClass::take_settled`].
    settled: [u64; 2],
}

/// What [`SendClass::transmit`] needs of its peer and engine.
pub(crate) struct SendContext<'a> {
    pub now: Instant,
    pub send_ns: u64,
    pub sender: SenderId,
    pub round_trip: Duration,
    /// What datagrams become on the wire, where somebody wants to know.
    pub packets: Option<PacketSize>,
    pub ledger: &'a mut Ledger,
    pub counters: &'a mut LinkCounters,
}

impl SendClass {
    pub(crate) fn new(class: Priority, link_epoch: u32, limits: SendLimits) -> Self {
        Self {
            class,
            link_epoch,
            limits,
            messages: Messages::default(),
            waiting: VecDeque::new(),
            current: None,
            started: VecDeque::new(),
            repairs: VecDeque::new(),
            streams: LruCache::unbounded(),
            next_number: 1,
            base: 1,
            in_flight: VecDeque::new(),
            outstanding: 0,
            outstanding_since: None,
            waiting_bytes: 0,
            started_bytes: 0,
            window: FIRST_WINDOW,
            last_user_sequence: 0,
            highest_reported: 0,
            probe_at: None,
            probe_due: false,
            last_probe: None,
            announce: None,
            recheck: None,
            missing: SmallVec::new(),
            next_expiry: None,
            last_sweep: None,
            loss: LossMeter::default(),
            rate: RateMeter::default(),
            settled: [0; 2],
        }
    }

    fn part_bytes(&self) -> usize {
        self.limits.max_datagram - HEADER_BYTES - RECORD_BYTES
    }

    fn next_sequence(&self) -> u64 {
        self.base + self.in_flight.len() as u64
    }

    pub(crate) fn window(&self) -> u64 {
        self.window
    }

    pub(crate) fn outstanding(&self) -> usize {
        self.outstanding
    }

    pub(crate) fn outstanding_since(&self) -> Option<Instant> {
        self.outstanding_since
    }

    /// Leaves out numbers, as if that many messages had been sent.
    #[cfg(test)]
    pub(crate) fn skip_to_last_numbers(&mut self, left: u32) {
        self.next_number = LAST_NUMBER - left;
    }

    /// Whether there is anything to send, credit or not.
    pub(crate) fn has_work(&self) -> bool {
        !(self.repairs.is_empty() && self.current.is_none() && self.waiting.is_empty())
    }

    /// Wire bytes of samples that were received, and that were lost, since the last call.
    pub(crate) fn take_settled(&mut self) -> (u64, u64) {
        let [received, lost] = std::mem::take(&mut self.settled);
        (received, lost)
    }

    /// What has left of the message that is being sent.
    pub(crate) fn begun(&self) -> Option<(LaneId, Begun)> {
        let message = self.messages.get(self.current?)?;
        Some((message.lane, message.begun()?))
    }

    /// Bytes that wait or may have to be repaired.
    pub(crate) fn queue_bytes(&self) -> usize {
        self.waiting_bytes + self.started_bytes
    }

    fn cost(message: &Outgoing) -> usize {
        message.bytes() + MESSAGE_OVERHEAD
    }

    /// Whether nothing waits, or so many bytes more make half of what may.
    pub(crate) fn has_room(&self, bytes: usize) -> bool {
        self.waiting_bytes == 0 || self.waiting_bytes + bytes <= self.limits.queue_bytes / 2
    }

    /// Takes a message; the oldest that are not started give way.
    pub(crate) fn submit(&mut self, submit: Submit<'_>, ledger: &mut Ledger) {
        if submit.keep_newest > 0 {
            self.make_place(submit.lane, submit.stream, submit.keep_newest, ledger);
        }
        let message = Outgoing::new(submit, self.part_bytes());
        let cost = Self::cost(&message);
        // What waits for its acknowledgement has a bound of its own: a late Feedback must not cost
        // a message.
        while self.waiting_bytes > 0 && self.waiting_bytes + cost > self.limits.queue_bytes {
            let Some(oldest) = self.waiting.pop_front() else { break };
            self.drop_message(oldest, DropReason::QueueFull, ledger);
        }
        if let Some(deadline) = message.deadline {
            self.next_expiry = Some(self.next_expiry.map_or(deadline, |next| next.min(deadline)));
        }
        ledger.submitted(message.lane, message.payload_bytes());
        self.waiting_bytes += cost;
        let key = self.messages.insert(message);
        self.waiting.push_back(key);
    }

    /// Lets the oldest unstarted messages of a stream go, until there is place for one more among
    /// the newest `keep`.
    fn make_place(&mut self, lane: LaneId, stream: StreamKey, keep: usize, ledger: &mut Ledger) {
        let messages = &self.messages;
        let same =
            |key: &&Key| messages.get(**key).is_some_and(|m| m.lane == lane && m.stream == stream);
        let waiting: SmallVec<[Key; 4]> = self.waiting.iter().filter(same).copied().collect();
        for oldest in waiting.iter().take((waiting.len() + 1).saturating_sub(keep)) {
            self.drop_message(*oldest, DropReason::QueueFull, ledger);
        }
    }

    /// Takes a message away and counts it. A started one leaves its place in the order to the one
    /// before it.
    fn drop_message(&mut self, key: Key, reason: DropReason, ledger: &mut Ledger) {
        if let Some(message) = self.take(key) {
            count_dropped(&message, reason, ledger);
            if message.is_started() {
                let newest = self.streams.peek(&message.stream).copied();
                if newest == Some(message.number) {
                    if message.behind == 0 {
                        self.streams.pop(&message.stream);
                    } else {
                        let before = message.number - u32::from(message.behind);
                        self.streams.put(message.stream, before);
                    }
                }
                // The receiver may hold what follows it until it knows.
                self.probe_due = true;
                self.announce = self.announce.max(Some(message.number));
            }
        }
    }

    fn take(&mut self, key: Key) -> Option<Outgoing> {
        let message = self.messages.remove(key)?;
        let cost = Self::cost(&message);
        if message.is_started() {
            self.started_bytes = self.started_bytes.saturating_sub(cost);
        } else {
            self.waiting_bytes = self.waiting_bytes.saturating_sub(cost);
        }
        if self.current == Some(key) {
            self.current = None;
        }
        Some(message)
    }

    pub(crate) fn link_epoch(&self) -> u32 {
        self.link_epoch
    }

    /// Drops everything and begins a new link epoch, as when the peer went down.
    pub(crate) fn restart(&mut self, link_epoch: u32, reason: DropReason, ledger: &mut Ledger) {
        for message in self.messages.iter() {
            count_dropped(message, reason, ledger);
        }
        let untold = self.announce.is_some() || self.highest_reported < self.last_user_sequence;
        let used = self.next_number > 1 || untold;
        *self = Self::new(self.class, link_epoch, self.limits);
        // What the receiver still has of the old epoch is of no use.
        self.probe_due = used;
        self.announce = used.then_some(0);
    }

    /// Drops what a lane has waiting; what is started goes on.
    pub(crate) fn drop_lane(&mut self, lane: LaneId, dropped: &mut Tally, ledger: &mut Ledger) {
        for key in self.messages.keys(|m| m.lane == lane && !m.is_started()) {
            if let Some(message) = self.take(key) {
                dropped.add(message.payload_bytes());
                ledger.left(lane, message.payload_bytes());
            }
        }
        self.prune_waiting();
    }

    fn prune_waiting(&mut self) {
        let messages = &self.messages;
        self.waiting.retain(|key| messages.get(*key).is_some());
    }

    /// Lowest message that may still be sent, and how many samples are unsettled once one more is
    /// sent.
    fn floors(&mut self, next_number: u32) -> (u32, u32) {
        while let Some((_, key)) = self.started.front()
            && self.messages.get(*key).is_none()
        {
            self.started.pop_front();
        }
        let started = self.started.front().map_or(next_number, |front| front.0);
        let in_flight = self.in_flight.front().map_or(next_number, |front| front.next_number);
        let unsettled = u32::try_from(self.in_flight.len() + 1).unwrap_or(u32::MAX);
        (started.min(in_flight), unsettled)
    }

    fn header(&mut self, ctx: &SendContext<'_>, sequence: u64, next_number: u32) -> LinkHeader {
        let (message_floor, unsettled) = self.floors(next_number);
        LinkHeader {
            class: self.class,
            records: 0,
            link_epoch: self.link_epoch,
            sender: ctx.sender,
            link_sequence: sequence,
            send_ns: ctx.send_ns,
            unsettled,
            message_floor,
        }
    }

    /// The next datagram with messages, if there is anything to send and credit for it. Returns it
    /// with the bytes of messages in it.
    pub(crate) fn transmit(&mut self, ctx: &mut SendContext<'_>) -> Option<bytes::Bytes> {
        if !self.has_work() {
            return None;
        }
        let sequence = self.next_sequence();
        let next_number = self.next_number;
        let mut out = DatagramBuilder::new(self.limits.max_datagram);
        let mut parts = SmallVec::new();
        self.put_repairs(ctx, sequence, &mut out, &mut parts);
        if self.has_credit() {
            self.put_new(ctx, sequence, &mut out, &mut parts);
        }
        if out.is_empty() {
            return None;
        }
        let header = self.header(ctx, sequence, next_number);
        let announces = self.announcement(&header);
        let datagram = out.finish(&header);
        if self.outstanding == 0 {
            self.outstanding_since = Some(ctx.now);
        }
        self.outstanding += datagram.len();
        self.in_flight.push_back(Sample {
            sent: ctx.now,
            bytes: u32::try_from(datagram.len()).unwrap_or(u32::MAX),
            next_number,
            settled: false,
            probe: false,
            announces,
            parts,
        });
        self.last_user_sequence = sequence;
        self.probe_at = Some(ctx.now + (ctx.round_trip * 2).max(Duration::from_millis(100)));
        self.probe_due = false;
        Some(datagram)
    }

    /// What a header tells that the receiver must learn.
    fn announcement(&mut self, header: &LinkHeader) -> Option<u32> {
        self.announce.take_if(|number| *number < header.message_floor)
    }

    fn has_credit(&self) -> bool {
        let wanted = (self.outstanding + self.limits.max_datagram) as u64;
        (self.outstanding == 0 || wanted <= self.window) && self.in_flight.len() < MAX_IN_FLIGHT
    }

    fn put_repairs(
        &mut self,
        ctx: &mut SendContext<'_>,
        sequence: u64,
        out: &mut DatagramBuilder,
        parts: &mut SmallVec<[PartRef; 1]>,
    ) {
        let part_bytes = self.part_bytes();
        while let Some(&repair) = self.repairs.front() {
            let Some(message) = self.messages.get_mut(repair.key) else {
                self.repairs.pop_front();
                continue;
            };
            if message.parts[repair.part] != Part::Lost {
                self.repairs.pop_front();
                continue;
            }
            if message.is_expired(ctx.now) {
                self.drop_message(repair.key, DropReason::Lifespan, ctx.ledger);
                continue;
            }
            if !out.fits(message.part_length(repair.part, part_bytes)) {
                break;
            }
            let record = message.record(ctx.now, repair.part, part_bytes, FLAG_REPAIR);
            out.put_part(&record, &message.frame);
            message.parts[repair.part] = Part::Carried(sequence);
            message.lost -= 1;
            parts.push(repair);
            ctx.counters.repairs += 1;
            self.repairs.pop_front();
        }
    }

    fn put_new(
        &mut self,
        ctx: &mut SendContext<'_>,
        sequence: u64,
        out: &mut DatagramBuilder,
        parts: &mut SmallVec<[PartRef; 1]>,
    ) {
        let part_bytes = self.part_bytes();
        loop {
            let Some(key) = self.current.or_else(|| self.startable(ctx)) else {
                return;
            };
            let Some(message) = self.messages.get_mut(key) else {
                self.current = None;
                continue;
            };
            if message.is_expired(ctx.now) {
                self.drop_message(key, DropReason::Lifespan, ctx.ledger);
                continue;
            }
            let part = message.next_part;
            if !out.fits(message.part_length(part, part_bytes)) {
                return;
            }
            if !message.is_started() {
                self.start(key);
            }
            let Some(message) = self.messages.get_mut(key) else {
                return;
            };
            let record = message.record(ctx.now, part, part_bytes, 0);
            out.put_part(&record, &message.frame);
            message.next_part += 1;
            if message.ordered {
                message.parts[part] = Part::Carried(sequence);
                parts.push(PartRef { key, part });
            }
            if !message.is_sent() {
                self.current = Some(key);
                continue;
            }
            self.current = None;
            let (lane, bytes, wait) =
                (message.lane, message.payload_bytes(), message.waited(ctx.now));
            let is_out = !message.ordered;
            ctx.ledger.sent(lane, bytes, wait);
            if is_out {
                self.take(key);
                ctx.ledger.out(lane, bytes);
            }
        }
    }

    /// The oldest message that waits, if it may be started now. It stays at the head of the queue.
    fn startable(&mut self, ctx: &mut SendContext<'_>) -> Option<Key> {
        loop {
            let key = *self.waiting.front()?;
            let Some(message) = self.messages.get(key) else {
                self.waiting.pop_front();
                continue;
            };
            if message.is_expired(ctx.now) {
                self.waiting.pop_front();
                self.drop_message(key, DropReason::Lifespan, ctx.ledger);
                continue;
            }
            let cost = Self::cost(message);
            let room =
                self.started_bytes == 0 || self.started_bytes + cost <= self.limits.queue_bytes;
            return ((room || !message.ordered) && self.next_number < LAST_NUMBER).then_some(key);
        }
    }

    fn start(&mut self, key: Key) {
        self.waiting.pop_front();
        let Some(message) = self.messages.get_mut(key) else {
            return;
        };
        message.number = self.next_number;
        self.next_number += 1;
        let cost = Self::cost(message);
        self.waiting_bytes = self.waiting_bytes.saturating_sub(cost);
        self.started_bytes += cost;
        if !message.ordered {
            return;
        }
        self.started.push_back((message.number, key));
        let before = self.streams.put(message.stream, message.number).unwrap_or(0);
        if before != 0 {
            message.behind = u16::try_from(message.number - before).unwrap_or(0);
        }
        if self.streams.len() > self.limits.streams {
            self.streams.pop_lru();
        }
    }
}

fn count_dropped(message: &Outgoing, reason: DropReason, ledger: &mut Ledger) {
    if let Some(begun) = message.begun() {
        ledger.cut(message.lane, begun);
    }
    ledger.dropped(message.lane, message.payload_bytes(), reason);
}
