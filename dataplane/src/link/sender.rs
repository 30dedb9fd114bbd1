//! The sending half of one class of one peer.
//!
//! ```text
//! submit → waiting (unstarted, oldest gives way) → started: numbered, parts in samples → acknowledged: out
//!                                                        ▲                │ sample lost
//!                                                        └── repairs ◄────┘
//! ```
//!
//! A message gets its number when its first byte leaves, so what gives way before leaves no gap. Best-effort messages of
//! one part are out when they are sent; the others are kept until each part is acknowledged.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use blaze_domain::{DropReason, Priority};
use lru::LruCache;
use smallvec::SmallVec;

use super::clock::{LossMeter, RateMeter};
use super::event::{LaneId, Ledger, LinkCounters, StreamKey, Submit, Tally};
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
}

/// What [`SendClass::transmit`] needs of its peer and engine.
pub(crate) struct SendContext<'a> {
    pub now: Instant,
    pub send_ns: u64,
    pub sender: SenderId,
    pub round_trip: Duration,
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

    /// Bytes that wait or may have to be repaired.
    pub(crate) fn queue_bytes(&self) -> usize {
        self.waiting_bytes + self.started_bytes
    }

    fn cost(message: &Outgoing) -> usize {
        message.bytes() + MESSAGE_OVERHEAD
    }

    /// Takes a message; the oldest that are not started give way.
    pub(crate) fn submit(&mut self, submit: Submit<'_>, ledger: &mut Ledger) {
        let message = Outgoing::new(submit, self.part_bytes());
        let cost = Self::cost(&message);
        while self.waiting_bytes > 0 && self.queue_bytes() + cost > self.limits.queue_bytes {
            let Some(oldest) = self.waiting.pop_front() else { break };
            self.drop_message(oldest, DropReason::QueueFull, ledger);
        }
        if let Some(deadline) = message.deadline {
            self.next_expiry = Some(self.next_expiry.map_or(deadline, |next| next.min(deadline)));
        }
        ledger.submitted(message.lane, message.bytes());
        self.waiting_bytes += cost;
        let key = self.messages.insert(message);
        self.waiting.push_back(key);
    }

    /// Takes a message away and counts it. A started one leaves its place in the order to the one before it.
    fn drop_message(&mut self, key: Key, reason: DropReason, ledger: &mut Ledger) {
        if let Some(message) = self.take(key) {
            ledger.dropped(message.lane, message.bytes(), reason);
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
            ledger.dropped(message.lane, message.bytes(), reason);
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
                dropped.add(message.bytes());
                ledger.withdrawn(lane, message.bytes());
            }
        }
        self.prune_waiting();
    }

    fn prune_waiting(&mut self) {
        let messages = &self.messages;
        self.waiting.retain(|key| messages.get(*key).is_some());
    }

    /// Lowest message that may still be sent, and how many samples are unsettled once one more is sent.
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

    /// The next datagram with messages, if there is anything to send and credit for it. Returns it with the bytes of
    /// messages in it.
    pub(crate) fn transmit(&mut self, ctx: &mut SendContext<'_>) -> Option<(bytes::Bytes, usize)> {
        if self.repairs.is_empty() && self.current.is_none() && self.waiting.is_empty() {
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
        let user_bytes = out.content_bytes();
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
        Some((datagram, user_bytes))
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
            let (lane, bytes, wait) = (message.lane, message.bytes(), message.waited(ctx.now));
            let is_out = !message.ordered;
            ctx.ledger.sent(lane, bytes, wait);
            if is_out {
                self.take(key);
                ctx.ledger.out(lane, bytes, wait);
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
            let room = self.started_bytes == 0 || self.started_bytes + cost <= self.limits.queue_bytes;
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

    /// Takes what the receiver reports. Returns whether it is of this link epoch.
    pub(crate) fn feedback(&mut self, ctx: &mut SendContext<'_>, view: &FeedbackView<'_>) -> bool {
        if view.link_epoch != self.link_epoch || view.highest_sequence >= self.next_sequence() {
            return false;
        }
        if view.highest_sequence >= self.highest_reported {
            self.highest_reported = view.highest_sequence;
            self.window = view.window_bytes;
            self.missing.clear();
            for pair in view.missing.chunks_exact(2) {
                self.missing
                    .push((pair[0], pair[0].saturating_add(pair[1].saturating_sub(1))));
            }
            self.settle(ctx, view.highest_sequence);
            self.rate.total(ctx.now, view.received_bytes);
        }
        if self.highest_reported >= self.last_user_sequence && self.announce.is_none() {
            self.probe_at = None;
        }
        self.settle_delivered(ctx, view.delivered_message);
        self.renew_numbers();
        true
    }

    /// Goes through the samples up to `highest`: those not missing are received; of those missing, some are lost.
    fn settle(&mut self, ctx: &mut SendContext<'_>, highest: u64) {
        let late = ctx.round_trip + ctx.round_trip / 8 + Duration::from_millis(2);
        let (mut received, mut lost) = (0, 0);
        let mut range = 0;
        self.recheck = None;
        let count = usize::try_from((highest + 1).saturating_sub(self.base)).unwrap_or(usize::MAX);
        for at in 0..count.min(self.in_flight.len()) {
            let sequence = self.base + at as u64;
            while self.missing.get(range).is_some_and(|missing| missing.1 < sequence) {
                range += 1;
            }
            let is_missing = self.missing.get(range).is_some_and(|missing| missing.0 <= sequence);
            let sample = &mut self.in_flight[at];
            if sample.settled {
                continue;
            }
            let lost_at = sample.sent + late;
            if is_missing && highest - sequence < REORDERING && ctx.now < lost_at {
                let at = self.recheck.map_or(lost_at, |next| next.0.min(lost_at));
                self.recheck = Some((at, highest));
                continue;
            }
            sample.settled = true;
            self.outstanding = self.outstanding.saturating_sub(sample.bytes as usize);
            let parts = std::mem::take(&mut sample.parts);
            if is_missing && sample.announces.is_some() {
                self.announce = self.announce.max(sample.announces);
                self.probe_due = true;
            }
            if is_missing {
                lost += 1;
                self.lose(ctx, &parts, sequence);
            } else {
                received += 1;
                self.acknowledge(ctx, &parts);
            }
        }
        while self.in_flight.front().is_some_and(|sample| sample.settled) {
            self.in_flight.pop_front();
            self.base += 1;
        }
        if self.outstanding == 0 {
            self.outstanding_since = None;
        }
        if received + lost > 0 {
            self.loss.add(ctx.now, received, lost);
        }
    }

    fn lose(&mut self, ctx: &mut SendContext<'_>, parts: &[PartRef], sequence: u64) {
        for part in parts {
            let Some(message) = self.messages.get_mut(part.key) else {
                continue;
            };
            if message.parts[part.part] != Part::Carried(sequence) {
                continue;
            }
            message.parts[part.part] = Part::Lost;
            message.lost += 1;
            if message.is_expired(ctx.now) {
                self.drop_message(part.key, DropReason::Lifespan, ctx.ledger);
            } else {
                self.repairs.push_back(*part);
            }
        }
    }

    fn acknowledge(&mut self, ctx: &mut SendContext<'_>, parts: &[PartRef]) {
        for part in parts {
            let Some(message) = self.messages.get_mut(part.key) else {
                continue;
            };
            match message.parts[part.part] {
                Part::Acknowledged => continue,
                // It came after all, before it was repaired.
                Part::Lost => message.lost -= 1,
                Part::Unsent | Part::Carried(_) => {}
            }
            message.parts[part.part] = Part::Acknowledged;
            message.acknowledged += 1;
            if message.acknowledged == message.parts.len()
                && let Some(message) = self.take(part.key)
            {
                ctx.ledger.out(message.lane, message.bytes(), message.waited(ctx.now));
            }
        }
    }

    /// Settles what the receiver is through with: delivered, or given up there before it was complete.
    fn settle_delivered(&mut self, ctx: &mut SendContext<'_>, delivered: u32) {
        if delivered >= self.next_number {
            return;
        }
        while let Some(&(number, key)) = self.started.front()
            && number <= delivered
        {
            self.started.pop_front();
            let Some(message) = self.messages.get(key) else {
                continue;
            };
            if !message.is_sent() {
                self.drop_message(key, DropReason::ReassemblyTimeout, ctx.ledger);
            } else if let Some(message) = self.take(key) {
                ctx.ledger.out(message.lane, message.bytes(), message.waited(ctx.now));
            }
        }
    }

    /// Begins a new link epoch when the numbers are used up and nothing is on the way.
    fn renew_numbers(&mut self) {
        if self.next_number < LAST_NUMBER || self.started_bytes > 0 || !self.in_flight.is_empty() {
            return;
        }
        self.link_epoch = self.link_epoch.saturating_add(1);
        self.next_number = 1;
        self.base = 1;
        self.last_user_sequence = 0;
        self.highest_reported = 0;
        self.started.clear();
        self.streams.clear();
        self.missing.clear();
    }

    /// Does what time has made due.
    pub(crate) fn handle_timeout(&mut self, ctx: &mut SendContext<'_>) {
        if self.probe_at.is_some_and(|at| at <= ctx.now) {
            self.probe_due = true;
        }
        if let Some((at, highest)) = self.recheck
            && at <= ctx.now
        {
            self.settle(ctx, highest);
            self.renew_numbers();
        }
        if self.sweep_at().is_some_and(|at| at <= ctx.now) {
            self.sweep(ctx);
        }
        self.messages.shrink_if_empty();
    }

    fn sweep_at(&self) -> Option<Instant> {
        let next = self.next_expiry?;
        Some(self.last_sweep.map_or(next, |last| next.max(last + SWEEP)))
    }

    fn sweep(&mut self, ctx: &mut SendContext<'_>) {
        self.last_sweep = Some(ctx.now);
        // Of one that is wholly on the way it is not known whether it arrived in time.
        let expired = self
            .messages
            .keys(|message| message.is_expired(ctx.now) && message.is_to_be_sent());
        for key in &expired {
            self.drop_message(*key, DropReason::Lifespan, ctx.ledger);
        }
        if !expired.is_empty() {
            self.prune_waiting();
        }
        let deadlines = self.messages.iter().filter_map(|message| message.deadline);
        self.next_expiry = deadlines.filter(|deadline| *deadline > ctx.now).min();
    }

    /// When [`SendClass::handle_timeout`] has something to do.
    pub(crate) fn next_timeout(&self) -> Option<Instant> {
        let recheck = self.recheck.map(|recheck| recheck.0);
        let probe = if self.probe_due { None } else { self.probe_at };
        [probe, recheck, self.sweep_at()].into_iter().flatten().min()
    }

    /// A sample without records, if one is due: makes the receiver report at once.
    pub(crate) fn probe(&mut self, ctx: &mut SendContext<'_>) -> Option<bytes::Bytes> {
        let spacing = ctx.round_trip.max(Duration::from_millis(50));
        if !self.probe_due || self.last_probe.is_some_and(|last| ctx.now < last + spacing) {
            if self.probe_due {
                self.probe_at = self.last_probe.map(|last| last + spacing);
                self.probe_due = false;
            }
            return None;
        }
        self.probe_due = false;
        self.last_probe = Some(ctx.now);
        let next_number = self.next_number;
        // A probe repeats the number of the one before it if nothing came between, so that unanswered ones do not pile up.
        let unanswered = self.in_flight.back().is_some_and(|last| last.probe && !last.settled);
        let mut header = self.header(ctx, self.next_sequence(), next_number);
        let announces = self.announcement(&header);
        let repeats = unanswered && announces.is_none();
        if repeats {
            header.link_sequence -= 1;
            header.unsettled -= 1;
        } else {
            self.in_flight.push_back(Sample {
                sent: ctx.now,
                bytes: 0,
                next_number,
                settled: false,
                probe: true,
                announces,
                parts: SmallVec::new(),
            });
        }
        if announces.is_some() {
            self.last_user_sequence = header.link_sequence;
        }
        let unreported = self.highest_reported < self.last_user_sequence || self.announce.is_some();
        self.probe_at = unreported.then(|| ctx.now + spacing);
        ctx.counters.probes += 1;
        Some(DatagramBuilder::new(HEADER_BYTES).finish(&header))
    }
}
