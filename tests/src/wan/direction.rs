//! One direction of a link: what happens to a packet, and when. Sans-io.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};

use super::stats::{DirectionStats, Tally};
use super::wander::Wander;
use super::{Change, Shape};

/// The most that a direction holds, with what each packet costs besides: a gigabit for a second.
pub const MAX_HELD_BYTES: u64 = 128 << 20;
/// What a small packet costs besides its bytes, roughly.
const OVERHEAD: u64 = 128;

/// One direction of a link.
///
/// A packet waits in the queue until those before it have left at the rate; then it is lost by
/// chance or flies for the delay. A lost packet has used the rate like any other.
#[derive(Debug)]
pub struct Direction<P> {
    shape: Shape,
    cut: bool,
    /// When the last packet that has begun to leave has left.
    free_at: Option<Instant>,
    waiting: VecDeque<Waiting<P>>,
    flying: VecDeque<Flying<P>>,
    /// The latest moment at which a packet arrives at the other end.
    last_due: Option<Instant>,
    losses: StdRng,
    wander: Wander,
    counts: DirectionStats,
}

#[derive(Debug)]
struct Waiting<P> {
    came: Instant,
    bytes: u64,
    packet: P,
}

#[derive(Debug)]
struct Flying<P> {
    due: Instant,
    bytes: u64,
    packet: P,
}

impl<P> Direction<P> {
    /// A direction that loses and delays as its seed says: the same packets at the same times have
    /// the same fate.
    #[must_use]
    pub fn new(shape: Shape, seed: u64) -> Self {
        Self {
            shape,
            cut: false,
            free_at: None,
            waiting: VecDeque::new(),
            flying: VecDeque::new(),
            last_due: None,
            losses: StdRng::seed_from_u64(seed),
            // Other numbers than those of the losses: jitter must not follow loss.
            wander: Wander::new(seed ^ 0x9e37_79b9_7f4a_7c15),
            counts: DirectionStats::default(),
        }
    }

    /// Changes its quality from now on. What flies keeps its time.
    pub fn change(&mut self, now: Instant, changes: &[Change]) {
        self.advance(now);
        for change in changes {
            self.shape = self.shape.with(*change);
        }
        self.advance(now);
    }

    /// Cuts it: all that is on the way is lost, and all that comes until [`Direction::heal`].
    pub fn cut(&mut self) {
        self.cut = true;
        let waiting = self.waiting.drain(..).map(|packet| packet.bytes);
        for bytes in waiting.chain(self.flying.drain(..).map(|packet| packet.bytes)) {
            self.counts.dropped.cut.add(bytes);
        }
        self.counts.queue = Tally::default();
        self.counts.flying = Tally::default();
    }

    /// Ends a cut.
    pub fn heal(&mut self) {
        self.cut = false;
    }

    /// A packet of so many bytes comes in. Times never run backwards.
    pub fn offer(&mut self, now: Instant, bytes: u64, packet: P) {
        self.advance(now);
        self.counts.taken.add(bytes);
        let dropped = &mut self.counts.dropped;
        if self.cut {
            return dropped.cut.add(bytes);
        }
        if bytes > u64::from(self.shape.mtu) {
            return dropped.too_large.add(bytes);
        }
        let held = self.counts.queue + self.counts.flying;
        if held.bytes + held.packets * OVERHEAD + bytes > MAX_HELD_BYTES {
            return dropped.memory.add(bytes);
        }
        let idle = self.waiting.is_empty() && self.free_at.is_none_or(|free_at| free_at <= now);
        if !idle && self.counts.queue.bytes + bytes > self.shape.queue {
            return dropped.queue.add(bytes);
        }
        self.counts.queue.add(bytes);
        self.waiting.push_back(Waiting { came: now, bytes, packet });
        self.advance(now);
    }

    /// The next packet that has arrived at the other end.
    pub fn pop(&mut self, now: Instant) -> Option<P> {
        self.advance(now);
        if self.flying.front()?.due > now {
            return None;
        }
        let arrived = self.flying.pop_front()?;
        self.counts.flying.subtract(arrived.bytes);
        self.counts.out.add(arrived.bytes);
        Some(arrived.packet)
    }

    /// When to call [`Direction::pop`] again; `None` while nothing is on the way.
    #[must_use]
    pub fn next_due(&self) -> Option<Instant> {
        let flying = self.flying.front().map(|packet| packet.due);
        // The delay of a packet that waits is not drawn yet: this is the least it can be.
        let waiting = self.waiting.front().map(|packet| {
            let begin = self.free_at.map_or(packet.came, |free_at| free_at.max(packet.came));
            begin
                + self.transmission(packet.bytes)
                + self.shape.delay.saturating_sub(self.shape.jitter)
        });
        match (flying, waiting) {
            (Some(flying), Some(waiting)) => Some(flying.min(waiting)),
            (one, other) => one.or(other),
        }
    }

    /// What it counted so far, and what it holds now.
    #[must_use]
    pub fn stats(&self) -> DirectionStats {
        self.counts
    }

    /// Lets everything leave that has begun to by now.
    fn advance(&mut self, now: Instant) {
        while let Some(first) = self.waiting.front() {
            let begin = self.free_at.map_or(first.came, |free_at| free_at.max(first.came));
            if begin > now {
                break;
            }
            let Some(first) = self.waiting.pop_front() else { break };
            self.counts.queue.subtract(first.bytes);
            self.leave(begin, first);
        }
    }

    fn leave(&mut self, begin: Instant, packet: Waiting<P>) {
        let left = begin + self.transmission(packet.bytes);
        self.free_at = Some(left);
        if self.losses.random_bool(self.shape.loss) {
            self.counts.dropped.loss.add(packet.bytes);
            return;
        }
        let due = left + self.delay(left);
        // The order is kept, also where the delay gets shorter.
        let due = self.last_due.map_or(due, |last| due.max(last));
        self.last_due = Some(due);
        self.counts.flying.add(packet.bytes);
        self.flying.push_back(Flying { due, bytes: packet.bytes, packet: packet.packet });
    }

    fn delay(&mut self, at: Instant) -> Duration {
        let Shape { delay, jitter, .. } = self.shape;
        if jitter.is_zero() {
            return delay;
        }
        let value = self.wander.at(at, jitter);
        let offset = jitter.mul_f64(value.abs());
        if value < 0.0 { delay.saturating_sub(offset) } else { delay + offset }
    }

    /// Rounded up, so that the rate is never exceeded.
    fn transmission(&self, bytes: u64) -> Duration {
        let Some(rate) = self.shape.rate else {
            return Duration::ZERO;
        };
        let nanos = (u128::from(bytes) * 8_000_000_000).div_ceil(u128::from(rate.max(1)));
        Duration::from_nanos(u64::try_from(nanos).unwrap_or(u64::MAX))
    }
}

#[cfg(test)]
#[path = "direction_tests.rs"]
mod tests;
