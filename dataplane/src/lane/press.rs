//! Compression on the way of a message: after a lane has admitted it and before it is queued, and back after it came over the link.
//!
//! ```text
//! gate ─► press: a place in the topic's order ─► job ─► pool ─► pressed ─► in order ─► lanes
//! link ─► press: a place in the topic's order ─► job ─► pool ─► pressed ─► in order ─► bridges to brokers
//! ```
//!
//! A message is compressed once, whatever the number of its lanes. What needs no compression waits behind what does, so the order of a
//! topic is that of admission. Nothing here runs a job: who owns the data plane takes the [`PressJob`]s, and comes back with what became of them.

use std::time::Instant;

use blaze_domain::node_file::{Codec, Compression, TopicRule, TopicValues};
use blaze_domain::{DropReason, MAX_PAYLOAD_BYTES, TopicName, WriterId};
use blaze_proto::Frame;
use blaze_proto::frame::Compression as Compressed;
use bytes::Bytes;
use smallvec::SmallVec;

use super::admit::Admitted;
use super::core::{DataCore, LaneLink};
use super::path::{Phase, TopicId};
use super::succession::Waiting;
use crate::codec::effort::{Effort, shares};
use crate::codec::order::{Bounds, InOrder, Ticket};

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

/// A message on its way to lanes: which bridges, and what each of them gets.
pub(super) type ToLanes = SmallVec<[(usize, Waiting); 2]>;

/// What is to be done for a message.
#[derive(Debug)]
enum Item {
    Out(ToLanes),
    In(Box<Admitted>),
}

/// Work for the pool.
#[derive(Debug)]
pub struct PressJob {
    ticket: Ticket<TopicId>,
    item: Item,
    /// The payload.
    pub payload: Bytes,
    /// What is to be done with it.
    pub work: PressWork,
}

/// Which job.
#[derive(Debug, Clone, Copy)]
pub struct PressTicket {
    ticket: Ticket<TopicId>,
    outward: bool,
}

impl PressJob {
    /// To ask whether it is still wanted.
    #[must_use]
    pub fn ticket(&self) -> PressTicket {
        PressTicket {
            ticket: self.ticket,
            outward: matches!(self.item, Item::Out(_)),
        }
    }
}

/// What is to be done with a payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PressWork {
    /// Compress it at a level.
    Compress(u8),
    /// Decompress it; so large it says that it will be.
    Decompress(u64),
}

/// What became of a job.
#[derive(Debug)]
pub enum Pressed {
    /// It was compressed, or goes as it is.
    Compressed(crate::codec::Compressed),
    /// It was decompressed.
    Decompressed(Bytes),
    /// It cannot be.
    Refused,
    /// Nobody had the time.
    NotDone,
}

/// Bytes before and after, and what it cost.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PressStats {
    /// Messages that were compressed, or tried.
    pub messages: u64,
    /// Bytes of their payloads before.
    pub before: u64,
    /// And after.
    pub after: u64,
    /// Seconds of processor time.
    pub seconds: f64,
    /// Level of the last one.
    pub level: u8,
}

/// The stage in both directions.
pub(super) struct Press {
    /// Whether there is a pool.
    enabled: bool,
    rules: CompressionRules,
    out: InOrder<TopicId, WriterId, ToLanes>,
    into: InOrder<TopicId, WriterId, Box<Admitted>>,
    jobs: Vec<PressJob>,
}

impl Default for Press {
    fn default() -> Self {
        Self {
            enabled: false,
            rules: CompressionRules::default(),
            out: InOrder::new(Bounds::default()),
            into: InOrder::new(Bounds::default()),
            jobs: Vec::new(),
        }
    }
}

impl Press {
    pub(super) fn find(&self, topic: &TopicName) -> Compression {
        self.rules.find(topic)
    }

    /// Whether something of a topic that came over the link is not with its bridges yet.
    pub(super) fn delays(&self, topic: TopicId) -> bool {
        !self.into.is_clear(&topic)
    }

    pub(super) fn delays_any(&self) -> bool {
        self.into.waiting().items > 0
    }
}

impl DataCore {
    /// There is a pool: payloads are compressed from now on. Without this they go as they are, and what comes is decompressed at once.
    pub fn enable_compression(&mut self) {
        self.press.enabled = true;
    }

    /// Changes how payloads are compressed, from the next message on.
    pub fn set_compression(&mut self, rules: CompressionRules) {
        for path in &mut self.topics {
            path.compression = rules.find(&path.name);
        }
        self.press.rules = rules;
    }

    /// Work for the pool since the last call.
    pub fn take_press_jobs(&mut self) -> Vec<PressJob> {
        std::mem::take(&mut self.press.jobs)
    }

    /// Whether there is work for the pool.
    #[must_use]
    pub fn has_press_jobs(&self) -> bool {
        !self.press.jobs.is_empty()
    }

    /// Somebody begins with a job. `false`: it is not wanted any more; it is to be given back as [`Pressed::NotDone`].
    pub fn begins(&mut self, job: PressTicket) -> bool {
        match job.outward {
            true => self.press.out.begin(&job.ticket),
            false => self.press.into.begin(&job.ticket),
        }
    }

    /// Divides the pool among topics by what they need; to be called about twice a second.
    pub fn share_pool(&mut self, now: Instant, threads: usize) {
        let mut topics = Vec::new();
        let mut wanted = Vec::new();
        for (at, path) in self.topics.iter_mut().enumerate().filter(|(_, path)| !path.vacant) {
            let Some((_, _, effort)) = &mut path.effort.0 else { continue };
            let published = path.in_rate.rate(now).0;
            let lanes = path.bridges.iter().filter(|bridge| bridge.lane_id().is_some());
            let admitted = lanes.map(|bridge| bridge.allocated_hz.unwrap_or(published).min(published));
            topics.push((at, admitted.fold(0.0, f64::max)));
            wanted.push(effort.wanted());
        }
        // First what a topic may use, then what it is to do with it.
        for ((at, admitted), share) in topics.into_iter().zip(shares(threads as f64, &wanted)) {
            if let Some((_, _, effort)) = &mut self.topics[at].effort.0 {
                effort.set_threads(share);
                effort.demand(now, admitted);
            }
        }
    }

    /// Takes a message that lanes have admitted.
    pub(super) fn press_out(&mut self, now: Instant, topic: TopicId, frame: &Frame, lanes: ToLanes, link: &mut dyn LaneLink) {
        let path = &mut self.topics[topic.0 as usize];
        let payload = frame.payload();
        let compression = path.compression;
        let is_worth = self.press.enabled
            && compression.codec == Codec::Lz4
            && payload.len() >= compression.min_bytes as usize
            && !payload.is_empty();
        let level = if is_worth {
            path.effort.level(now, compression.level, compression.adaptive)
        } else {
            None
        };
        if level.is_none() && self.press.out.is_clear(&topic) {
            self.to_lanes(now, topic, lanes, link);
            return;
        }
        for (at, _) in &lanes {
            path.bridges[*at].pressing += 1;
        }
        let Some(level) = level else {
            if let Err((lanes, _)) = self.press.out.push_ready(topic, lanes, payload.len()) {
                self.not_pressed(topic, &lanes, DropReason::QueueFull);
            }
            return;
        };
        let keep = lanes.iter().map(|(at, _)| path.bridges[*at].keep_newest()).max().unwrap_or(0);
        if keep > 0 {
            // Those that give way are counted when their jobs come back.
            self.press.out.keep_newest(&topic, &frame.writer(), keep.saturating_sub(1));
        }
        match self.press.out.push_pending(topic, frame.writer(), payload.len()) {
            Ok(ticket) => self.press.jobs.push(PressJob {
                ticket,
                item: Item::Out(lanes),
                payload: payload.clone(),
                work: PressWork::Compress(level),
            }),
            Err(_) => self.not_pressed(topic, &lanes, DropReason::QueueFull),
        }
        self.flush_out(now, topic, link);
    }

    /// Takes a message that came over the link and was not seen before.
    pub(super) fn press_in(&mut self, now: Instant, topic: TopicId, message: Admitted, link: &mut dyn LaneLink) {
        let (announced, payload) = (message.frame.uncompressed_bytes(), message.frame.payload().clone());
        match message.frame.compression() {
            Compressed::None if self.press.into.is_clear(&topic) => self.deliver_pressed(now, topic, &message, link),
            Compressed::None => {
                if self.press.into.push_ready(topic, Box::new(message), payload.len()).is_err() {
                    self.refuse_pressed(topic, DropReason::QueueFull);
                }
            }
            Compressed::Unknown(_) => self.refuse_pressed(topic, DropReason::DecompressError),
            Compressed::Lz4Block if !self.press.enabled => {
                match crate::codec::lz4::decompress(&payload, announced, MAX_PAYLOAD_BYTES) {
                    Ok(payload) => self.decompressed(now, topic, message, payload, link),
                    Err(_) => self.refuse_pressed(topic, DropReason::DecompressError),
                }
            }
            Compressed::Lz4Block => {
                let bytes = usize::try_from(announced).unwrap_or(usize::MAX).min(MAX_PAYLOAD_BYTES);
                match self.press.into.push_pending(topic, message.frame.writer(), payload.len() + bytes) {
                    Ok(ticket) => self.press.jobs.push(PressJob {
                        ticket,
                        item: Item::In(Box::new(message)),
                        payload,
                        work: PressWork::Decompress(announced),
                    }),
                    Err(_) => self.refuse_pressed(topic, DropReason::QueueFull),
                }
            }
        }
    }

    /// Notes the size of a message that a lane could send: of one that is compressed that is known when it has been.
    pub(super) fn note_size(&mut self, now: Instant, topic: TopicId, bytes: usize) {
        let path = &mut self.topics[topic.0 as usize];
        let is_pressed = self.press.enabled
            && path.compression.codec == Codec::Lz4
            && bytes >= path.compression.min_bytes as usize
            && !path.effort.goes_as_it_is();
        if !is_pressed {
            self.allocation_due |= path.sent_size.note(now, bytes as u64);
        }
    }

    fn decompressed(&mut self, now: Instant, topic: TopicId, message: Admitted, payload: Bytes, link: &mut dyn LaneLink) {
        match message.frame.decompressed(payload) {
            Ok(frame) => self.deliver_pressed(now, topic, &Admitted { frame, ..message }, link),
            Err(_) => self.refuse_pressed(topic, DropReason::DecompressError),
        }
    }

    /// Takes what became of a job.
    pub fn pressed(&mut self, now: Instant, job: PressJob, pressed: Pressed, link: &mut dyn LaneLink) {
        let PressJob { ticket, item, .. } = job;
        let topic = *ticket.key();
        match item {
            Item::Out(lanes) => self.pressed_out(now, &ticket, lanes, pressed),
            Item::In(message) => self.pressed_in(&ticket, message, pressed),
        }
        self.flush_out(now, topic, link);
        self.flush_in(now, topic, link);
        self.stir();
    }

    fn pressed_out(&mut self, now: Instant, ticket: &Ticket<TopicId>, mut lanes: ToLanes, pressed: Pressed) {
        let topic = *ticket.key();
        if let Pressed::Compressed(done) = pressed {
            let path = &mut self.topics[topic.0 as usize];
            path.effort.compressed(now, &done);
            path.press.note(&done);
            let bytes = done.after();
            self.allocation_due |= path.sent_size.note(now, bytes as u64);
            if let Some(block) = done.block {
                for (_, waiting) in &mut lanes {
                    // Only a header without room for the new fields cannot take it: then it goes as it is.
                    if let Ok(frame) = waiting.frame.compressed(block.clone(), done.before as u64) {
                        waiting.frame = frame;
                    }
                }
            }
            if let Err(lanes) = self.press.out.finish(ticket, lanes, bytes) {
                self.not_pressed(topic, &lanes, DropReason::QueueFull);
            }
        } else {
            self.press.out.give_up(ticket);
            self.not_pressed(topic, &lanes, DropReason::QueueFull);
        }
    }

    fn pressed_in(&mut self, ticket: &Ticket<TopicId>, message: Box<Admitted>, pressed: Pressed) {
        let topic = *ticket.key();
        let frame = match pressed {
            Pressed::Decompressed(payload) => message.frame.decompressed(payload).map_err(|_| DropReason::DecompressError),
            Pressed::NotDone => Err(DropReason::QueueFull),
            Pressed::Compressed(_) | Pressed::Refused => Err(DropReason::DecompressError),
        };
        match frame {
            Ok(frame) => {
                let bytes = frame.payload().len();
                let message = Box::new(Admitted { frame, ..*message });
                if self.press.into.finish(ticket, message, bytes).is_err() {
                    self.refuse_pressed(topic, DropReason::QueueFull);
                }
            }
            Err(reason) => {
                self.press.into.give_up(ticket);
                self.refuse_pressed(topic, reason);
            }
        }
    }

    /// Hands on what is next in the order of a topic.
    fn flush_out(&mut self, now: Instant, topic: TopicId, link: &mut dyn LaneLink) {
        while let Some(lanes) = self.press.out.pop_ready(&topic) {
            for (at, _) in &lanes {
                let bridge = &mut self.topics[topic.0 as usize].bridges[*at];
                bridge.pressing = bridge.pressing.saturating_sub(1);
            }
            self.to_lanes(now, topic, lanes, link);
        }
    }

    fn flush_in(&mut self, now: Instant, topic: TopicId, link: &mut dyn LaneLink) {
        while let Some(message) = self.press.into.pop_ready(&topic) {
            self.deliver_pressed(now, topic, &message, link);
        }
    }

    /// To the queues of the lanes. One that has ended meanwhile has nobody to send to.
    fn to_lanes(&mut self, now: Instant, topic: TopicId, lanes: ToLanes, link: &mut dyn LaneLink) {
        for (at, waiting) in lanes {
            let bridge = &mut self.topics[topic.0 as usize].bridges[at];
            if matches!(bridge.phase, Phase::Up { .. } | Phase::Draining { .. }) {
                bridge.queue(now, topic, waiting, &mut self.succession, link);
            } else {
                bridge.stats.dropped.add(DropReason::NoDestination, 1);
            }
        }
    }

    fn deliver_pressed(&mut self, now: Instant, topic: TopicId, message: &Admitted, link: &mut dyn LaneLink) {
        // It is older by what the pool took.
        let waited = super::measure::micros(now.saturating_duration_since(message.came));
        if waited == 0 {
            self.fan_out(now, topic, blaze_domain::Scope::Inter, message, link);
        } else {
            self.fan_out(now, topic, blaze_domain::Scope::Inter, &message.older(waited), link);
        }
    }

    fn not_pressed(&mut self, topic: TopicId, lanes: &ToLanes, reason: DropReason) {
        for (at, _) in lanes {
            let bridge = &mut self.topics[topic.0 as usize].bridges[*at];
            bridge.pressing = bridge.pressing.saturating_sub(1);
            bridge.stats.dropped.add(reason, 1);
        }
    }

    fn refuse_pressed(&mut self, topic: TopicId, reason: DropReason) {
        self.topics[topic.0 as usize].ingress_drops.add(reason, 1);
    }
}

impl PressStats {
    fn note(&mut self, done: &crate::codec::Compressed) {
        self.messages += 1;
        self.before += done.before as u64;
        self.after += done.after() as u64;
        self.seconds += done.processor.as_secs_f64();
        self.level = done.level;
    }
}

/// The level of one topic over time.
#[derive(Debug, Default)]
pub struct TopicEffort(Option<(u8, bool, Effort)>);

impl TopicEffort {
    /// The level for the next message; `None`: it goes as it is.
    fn level(&mut self, now: Instant, configured: u8, adaptive: bool) -> Option<u8> {
        if !adaptive {
            self.0 = None;
            return Some(configured);
        }
        let fits = self.0.as_ref().is_some_and(|(level, ..)| *level == configured);
        if !fits {
            self.0 = Some((configured, adaptive, Effort::new(configured, now)));
        }
        let (_, _, effort) = self.0.as_mut()?;
        effort.next(now)
    }

    /// Whether payloads are not compressed for now.
    #[must_use]
    pub fn goes_as_it_is(&self) -> bool {
        self.0.as_ref().is_some_and(|(_, _, effort)| effort.goes_as_it_is())
    }

    fn compressed(&mut self, now: Instant, done: &crate::codec::Compressed) {
        if let Some((_, _, effort)) = &mut self.0 {
            effort.compressed(now, done.level, done.taken.as_secs_f64(), done.before, done.after());
        }
    }
}
