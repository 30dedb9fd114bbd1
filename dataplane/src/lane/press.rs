//! Compression on the way of a message: after a lane has admitted it and before it is queued, and
//! back after it came over the link.
//!
//! ```text
//! gate ─► outward: a place in the line of topic and writer ─► begin ─► LZ4 ─► pressed ─► in order ─► lanes
//! link ─► inward:  a place in the line of topic and writer ─► begin ─► LZ4 ─► pressed ─► in order ─► bridges to brokers
//! ```
//!
//! A message is compressed once, whatever the number of its lanes. What needs no compression waits
//! behind what does of the same writer, so its order is that of admission. Nothing here runs the
//! codec: whoever owns the data plane offers the [`Turns`] to a pool, and a thread that has one
//! asks what is to be done then, and comes back with what became of it. Until it asks the message
//! is here, and may give way to a newer one or become too old.

mod inward;
mod level;
mod outward;

use std::ops::AddAssign;
use std::time::Instant;

use blaze_domain::node_file::{Compression, TopicRule, TopicValues};
use blaze_domain::{DropReason, TopicName, WriterId};
use bytes::Bytes;

use super::admit::Admitted;
use super::core::{DataCore, LaneLink};
use super::path::TopicId;
use crate::codec::effort::shares;
use crate::codec::order::{Bounds, InOrder, Ticket};
use crate::codec::pool::{Urgency, threads_for_long};
use crate::codec::{Done, Work};
pub(super) use inward::plain;
pub use level::{PressStats, TopicEffort};
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

/// Turns at the codec that were not asked for before.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Turns {
    /// Of the pool, for what is done in a moment.
    pub quick: usize,
    /// Of the pool, for large payloads.
    pub long: usize,
    /// Of the calling thread, see [`DataCore::begin_own`]: the pool is behind.
    pub own: usize,
}

impl AddAssign for Turns {
    fn add_assign(&mut self, more: Self) {
        self.quick += more.quick;
        self.long += more.long;
        self.own += more.own;
    }
}

/// What is to be done for one message.
#[derive(Debug, Clone)]
pub struct PressJob {
    /// To be given back with the result.
    pub ticket: PressTicket,
    /// The payload.
    pub payload: Bytes,
    /// What is to be done with it.
    pub work: Work,
}

/// Which message that is.
#[derive(Debug, Clone, Copy)]
pub struct PressTicket {
    place: Ticket<TopicId, WriterId>,
    outward: bool,
}

/// What waits for the codec, and what did not get that far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PressCounters {
    /// Messages that wait for a turn.
    pub waiting: usize,
    /// Bytes of their payloads; of those that came over the link, as they are to become.
    pub waiting_bytes: usize,
    /// Messages for which there was no room, since the start.
    pub refused: u64,
    /// Payloads with which the codec panicked, since the start.
    pub failed: u64,
}

/// The stage in both directions.
pub(super) struct Press {
    /// Whether there is a pool.
    enabled: bool,
    rules: CompressionRules,
    out: InOrder<TopicId, WriterId, Outward>,
    into: InOrder<TopicId, WriterId, Box<Admitted>>,
    /// Turns that were asked for and have not begun, by urgency.
    asked: [usize; Urgency::ALL.len()],
    /// The last quick turn was for what came over the link.
    was_inward: bool,
    refused: u64,
    failed: u64,
}

impl Default for Press {
    fn default() -> Self {
        let bounds = Bounds::default();
        Self {
            enabled: false,
            rules: CompressionRules::default(),
            out: InOrder::new(bounds),
            // It was let in by its sender's pacer, and is quickly done.
            into: InOrder::new(Bounds { waiting_of_one: bounds.bytes_of_one, ..bounds }),
            asked: [0; Urgency::ALL.len()],
            was_inward: false,
            refused: 0,
            failed: 0,
        }
    }
}

impl Press {
    pub(super) fn find(&self, topic: &TopicName) -> Compression {
        self.rules.find(topic)
    }

    /// Whether something of a topic that came over the link is not with its bridges yet.
    pub(super) fn delays(&self, topic: TopicId) -> bool {
        self.into.holds(&topic)
    }

    pub(super) fn delays_any(&self) -> bool {
        self.into.held().items > 0
    }

    /// Whether it holds anything of a topic.
    pub(super) fn holds(&self, topic: TopicId) -> bool {
        self.out.holds(&topic) || self.into.holds(&topic)
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

    fn waiting(&self, urgency: Urgency) -> usize {
        self.out.waits(urgency).items + self.into.waits(urgency).items
    }

    /// Turns that are still to be asked for. One whose message gave way is left to the message that
    /// follows.
    fn missing(&self) -> [usize; Urgency::ALL.len()] {
        Urgency::ALL
            .map(|urgency| self.waiting(urgency).saturating_sub(self.asked[urgency as usize]))
    }

    fn turn_begins(&mut self, urgency: Urgency) {
        let asked = &mut self.asked[urgency as usize];
        *asked = asked.saturating_sub(1);
    }

    /// What came over the link, to be decompressed.
    fn begin_inward(&mut self) -> Option<PressJob> {
        let (place, message) = self.into.begin(Urgency::Quick)?;
        let job = PressJob {
            ticket: PressTicket { place, outward: false },
            payload: message.frame.payload().clone(),
            work: Work::Decompress(message.frame.uncompressed_bytes()),
        };
        self.was_inward = true;
        Some(job)
    }
}

impl DataCore {
    /// There is a pool: payloads are compressed from now on. Without this they go as they are, and
    /// what comes is decompressed at once.
    pub fn enable_compression(&mut self) {
        self.press.enabled = true;
    }

    /// There is no pool any more. What waits for it is dropped; what it is at comes back.
    pub fn stop_compression(&mut self, now: Instant, link: &mut dyn LaneLink) {
        self.press.enabled = false;
        self.press.asked = Default::default();
        for urgency in Urgency::ALL {
            while let Some(place) = self.press.out.begin(urgency).map(|(place, _)| place) {
                if let Some(out) = self.press.out.give_up(&place) {
                    self.lose(place.key().0, &out, DropReason::Shutdown);
                }
                self.flush_out(now, *place.key(), link);
            }
            while let Some(place) = self.press.into.begin(urgency).map(|(place, _)| place) {
                self.press.into.give_up(&place);
                self.refuse_pressed(place.key().0, DropReason::Shutdown);
                self.flush_in(now, *place.key(), link);
            }
        }
        self.stir();
    }

    /// Changes how payloads are compressed, from the next message on.
    pub fn set_compression(&mut self, rules: CompressionRules) {
        for path in &mut self.topics {
            path.set_compression(rules.find(&path.name));
        }
        self.press.rules = rules;
    }

    /// Turns to be offered since the last call. Of those of the caller each one is to be taken.
    pub fn take_turns(&mut self) -> Turns {
        let press = &mut self.press;
        let [quick, long] = press.missing();
        press.asked[Urgency::Quick as usize] += quick;
        press.asked[Urgency::Long as usize] += long;
        let is_behind = press.into.waits(Urgency::Quick).bytes > OWN_ABOVE;
        let own = if is_behind { quick } else { 0 };
        Turns { quick: quick - own, long, own }
    }

    /// Whether there are turns to be offered.
    #[must_use]
    pub fn has_turns(&self) -> bool {
        self.press.missing().iter().any(|turns| *turns > 0)
    }

    /// A thread of the pool has a turn. `None`: nothing is left to be done.
    pub fn begin(
        &mut self,
        now: Instant,
        urgency: Urgency,
        link: &mut dyn LaneLink,
    ) -> Option<PressJob> {
        self.press.turn_begins(urgency);
        if urgency == Urgency::Quick
            && !self.press.was_inward
            && let Some(job) = self.press.begin_inward()
        {
            return Some(job);
        }
        self.press.was_inward = false;
        self.begin_outward(now, urgency, link).or_else(|| match urgency {
            Urgency::Quick => self.press.begin_inward(),
            Urgency::Long => None,
        })
    }

    /// The calling thread has a turn of its own, for what came over the link. `None`: nothing is
    /// left to be done.
    pub fn begin_own(&mut self) -> Option<PressJob> {
        self.press.turn_begins(Urgency::Quick);
        self.press.begin_inward()
    }

    /// Takes what became of a message.
    pub fn pressed(
        &mut self,
        now: Instant,
        ticket: PressTicket,
        done: Done,
        link: &mut dyn LaneLink,
    ) {
        self.press.failed += u64::from(done == Done::Failed);
        if ticket.outward {
            self.pressed_out(now, &ticket.place, done, link);
        } else {
            self.pressed_in(now, &ticket.place, done, link);
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
    pub fn press_counters(&self) -> PressCounters {
        let press = &self.press;
        let waits = Urgency::ALL
            .map(|urgency| press.out.waits(urgency).bytes + press.into.waits(urgency).bytes);
        PressCounters {
            waiting: Urgency::ALL.iter().map(|urgency| press.waiting(*urgency)).sum(),
            waiting_bytes: waits.iter().sum(),
            refused: press.refused,
            failed: press.failed,
        }
    }
}
