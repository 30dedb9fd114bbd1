//! Hands messages to DDS writers: in the thread that publishes while little is written, else in a
//! thread of its own.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use blaze_domain::{DropReason, WriterId};
use lru::LruCache;
use parking_lot::Mutex;

use super::Topic;
use super::shared::Shared;
use super::slot::{Attempt, Slot, SlotKey};
use crate::dds::DdsError;
use crate::dds::reader::StoppableThread;
use crate::outbox::{Backlog, Body, Fate, Waiting};
use crate::port::PublisherOptions;
use crate::wake::wait;

/// Messages and bytes of one turn; one message always fits.
const TURN_MESSAGES: usize = 64;
const TURN_BYTES: usize = 256 * 1024;
/// Messages that a publisher writes itself.
const AT_ONCE_MESSAGES: usize = 16;
/// A full turn takes at least this long: RustDDS neither paces nor tells when it is behind, and
/// what it sends at once must fit into the buffers of sockets and readers. So up to 32,000 messages
/// and 128 MB per second.
const TURN: Duration = Duration::from_millis(2);
/// Between attempts to write what a writer could not take.
const AGAIN: Duration = Duration::from_millis(2);
/// The same where an attempt copies much.
const LARGE_AGAIN: Duration = Duration::from_millis(20);
const LARGE_BYTES: usize = 64 * 1024;
/// What a message of a large topic counts at least, as its readers have room for few.
const LARGE_COST: usize = 64 * 1024;
/// How often what is over its time is looked for while nothing else happens.
const IDLE: Duration = Duration::from_millis(100);
/// Origins of one transient_local publisher that have a writer each; the one that wrote longest ago
/// gives way.
pub(crate) const MAX_ORIGINS: usize = 256;
/// Most samples that are kept per origin.
const MAX_DEPTH: u32 = 1024;

/// Where a publisher's messages go.
pub(crate) struct Target {
    id: u64,
    key: SlotKey,
    /// The writer of all origins; none where each has its own.
    slot: Option<Arc<Slot>>,
    origins: Mutex<LruCache<WriterId, Arc<Slot>>>,
    /// Messages that are written first.
    after: Mutex<Vec<Backlog>>,
}

impl Target {
    pub(super) fn new(shared: &Arc<Shared>, topic: Topic, options: PublisherOptions) -> Self {
        let depth = depth_of(options.depth);
        let reliable = options.reliable || depth > 0;
        let key = SlotKey { topic, reliable, large: options.large, depth, origin: None };
        let slot = (depth == 0).then(|| shared.slots.get(key.clone()));
        Self::of(shared, key, slot)
    }

    /// One writer for all that is published, which keeps the last `depth` for late joiners, whoever
    /// wrote them.
    pub(super) fn keeping(shared: &Arc<Shared>, topic: Topic, depth: u32) -> Self {
        let key =
            SlotKey { topic, reliable: true, large: false, depth: depth_of(depth), origin: None };
        let slot = shared.slots.get(key.clone());
        Self::of(shared, key, Some(slot))
    }

    fn of(shared: &Arc<Shared>, key: SlotKey, slot: Option<Arc<Slot>>) -> Self {
        static IDS: AtomicU64 = AtomicU64::new(0);
        shared.wake_lifecycle();
        Self {
            id: IDS.fetch_add(1, Ordering::Relaxed),
            key,
            slot,
            origins: Mutex::new(LruCache::unbounded()),
            after: Mutex::default(),
        }
    }

    /// Nothing is written before these messages are.
    pub(super) fn wait_for(&self, others: Backlog) {
        self.after.lock().push(others);
    }

    fn may_write(&self) -> bool {
        let mut after = self.after.lock();
        after.retain(|others| !others.is_empty());
        after.is_empty()
    }

    /// Whether its writers stand, and have met so many readers, where that takes less than `limit`.
    pub(super) fn has_met(&self, readers: usize, now: Instant, limit: Duration) -> bool {
        let met = |slot: &Arc<Slot>| slot.has_met(readers, now, limit);
        self.slot.iter().all(met) && self.origins.lock().iter().all(|(_, slot)| met(slot))
    }

    /// The writer of a message.
    fn slot_of(&self, shared: &Shared, body: &Body) -> Arc<Slot> {
        if let Some(slot) = &self.slot {
            return Arc::clone(slot);
        }
        let origin = match body {
            Body::Frame(frame) => Some(frame.writer()),
            Body::Bare(_) => None,
        };
        let Some(origin) = origin else {
            // Without an origin there is nothing to keep for late joiners.
            return shared.slots.get(SlotKey { depth: 0, ..self.key.clone() });
        };
        self.slot_of_origin(shared, origin)
    }

    /// The writer of an origin, where each has its own.
    pub(super) fn slot_of_origin(&self, shared: &Shared, origin: WriterId) -> Arc<Slot> {
        let mut origins = self.origins.lock();
        if let Some(slot) = origins.get(&origin) {
            return Arc::clone(slot);
        }
        if origins.len() >= MAX_ORIGINS {
            origins.pop_lru();
        }
        let slot = shared.slots.get(SlotKey { origin: Some(origin), ..self.key.clone() });
        origins.put(origin, Arc::clone(&slot));
        shared.wake_lifecycle();
        slot
    }
}

fn depth_of(depth: u32) -> u16 {
    u16::try_from(depth.min(MAX_DEPTH)).unwrap_or(u16::MAX)
}

pub(super) fn start(shared: &Arc<Shared>) -> Result<StoppableThread, DdsError> {
    let shared = Arc::clone(shared);
    let failed = Arc::<AtomicBool>::default();
    StoppableThread::start("dds-send", failed, move |stop| {
        while !stop.load(Ordering::Relaxed) && !shared.stop.load(Ordering::Acquire) {
            let rest = shared.sender.lock().turn(&shared, false);
            match rest {
                Rest::Pause(pause) => thread::sleep(pause),
                // What is published meanwhile may go to another writer.
                Rest::Filled(longest) => wait(shared.outbox.filled(), longest),
                Rest::None => {}
            }
        }
        shared.sender.lock().held.clear();
        shared.held.store(0, Ordering::Release);
        shared.outbox.clear(DropReason::BrokerError);
    })
}

/// Writes what waits in this thread, if it is little and nobody else writes. Returns whether nothing
/// is left to the sender's thread.
pub(super) fn write_at_once(shared: &Shared) -> bool {
    let Some(mut sender) = shared.sender.try_lock() else { return false };
    if !sender.has_room(Instant::now()) || shared.stop.load(Ordering::Acquire) {
        return false;
    }
    sender.turn(shared, true);
    sender.held.is_empty() && shared.outbox.is_empty()
}

/// What comes after a turn.
enum Rest {
    /// Nothing is written for so long.
    Pause(Duration),
    /// There is nothing to do until something is published, or for so long.
    Filled(Duration),
    /// The next turn.
    None,
}

/// Whoever holds it writes, so that messages stay in order.
pub(super) struct Sender {
    /// By target: what its writer could not take, in order.
    held: HashMap<u64, VecDeque<Waiting<Target>>>,
    taken: Vec<Waiting<Target>>,
    /// Since when these were written.
    since: Instant,
    messages: usize,
    bytes: usize,
}

impl Sender {
    pub(super) fn new() -> Self {
        let taken = Vec::with_capacity(TURN_MESSAGES);
        Self { held: HashMap::new(), taken, since: Instant::now(), messages: 0, bytes: 0 }
    }

    /// Whether a publisher may write itself: nothing waits, and little was written lately.
    fn has_room(&self, now: Instant) -> bool {
        self.held.is_empty() && self.pause(now).is_zero()
    }

    /// What was written takes so much time at least.
    fn takes(&self) -> Duration {
        let turns = self.bytes.div_ceil(TURN_BYTES).max(self.messages.div_ceil(TURN_MESSAGES));
        TURN * u32::try_from(turns).unwrap_or(u32::MAX)
    }

    /// How long nothing is written, since much was.
    fn pause(&self, now: Instant) -> Duration {
        let is_much = self.messages >= TURN_MESSAGES / 2 || self.bytes >= TURN_BYTES / 2;
        let passed = now.saturating_duration_since(self.since);
        if is_much { self.takes().saturating_sub(passed) } else { Duration::ZERO }
    }

    /// Writes what it holds, and what waits, as far as that goes now; `at_once`: only a little.
    fn turn(&mut self, shared: &Shared, at_once: bool) -> Rest {
        let begin = Instant::now();
        let pause = self.pause(begin);
        if !pause.is_zero() {
            return Rest::Pause(pause);
        }
        if begin.saturating_duration_since(self.since) >= self.takes().max(TURN) {
            (self.since, self.messages, self.bytes) = (begin, 0, 0);
        }
        let retried = self.retry(shared, begin);
        let (messages, bytes) =
            if at_once { (AT_ONCE_MESSAGES, LARGE_BYTES) } else { (TURN_MESSAGES, TURN_BYTES) };
        let bytes = shared.outbox.take_ready(
            begin,
            messages,
            bytes,
            !at_once,
            |target| {
                let is_free = !self.held.contains_key(&target.id) && target.may_write();
                is_free.then_some(usize::MAX)
            },
            &mut self.taken,
        );
        // Until they are written they are nowhere else.
        shared.held.fetch_add(self.taken.len(), Ordering::AcqRel);
        let count = self.taken.len();
        let of_large = self.taken.iter().filter(|waiting| waiting.to.key.large).count();
        let mut taken = std::mem::take(&mut self.taken);
        for waiting in taken.drain(..) {
            self.write(shared, waiting, begin);
        }
        self.taken = taken;
        shared.held.store(self.held.values().map(VecDeque::len).sum(), Ordering::Release);
        self.messages += count + retried;
        self.bytes += bytes.max(of_large * LARGE_COST);
        if count + retried == 0 { Rest::Filled(self.longest_wait()) } else { Rest::None }
    }

    /// How long it waits for something to do.
    fn longest_wait(&self) -> Duration {
        if self.held.is_empty() {
            return IDLE;
        }
        let is_large = |queue: &VecDeque<Waiting<Target>>| {
            queue.front().is_some_and(|it| it.size() > LARGE_BYTES)
        };
        if self.held.values().all(is_large) { LARGE_AGAIN } else { AGAIN }
    }

    /// Writes what was held. Returns how many messages went.
    fn retry(&mut self, shared: &Shared, now: Instant) -> usize {
        let mut gone = 0;
        self.held.retain(|_, queue| {
            while let Some(waiting) = queue.pop_front() {
                match attempt(shared, &waiting, now) {
                    Some(fate) => {
                        waiting.settle(fate);
                        gone += 1;
                    }
                    None => {
                        queue.push_front(waiting);
                        break;
                    }
                }
            }
            !queue.is_empty()
        });
        gone
    }

    fn write(&mut self, shared: &Shared, waiting: Waiting<Target>, now: Instant) {
        let id = waiting.to.id;
        if let Some(queue) = self.held.get_mut(&id) {
            queue.push_back(waiting);
            return;
        }
        match attempt(shared, &waiting, now) {
            Some(fate) => waiting.settle(fate),
            None => self.held.entry(id).or_default().push_back(waiting),
        }
    }
}

/// Writes a message. `None`: not now.
fn attempt(shared: &Shared, waiting: &Waiting<Target>, now: Instant) -> Option<Fate> {
    if let Some((at, reason)) = waiting.expires
        && at <= now
    {
        return Some(Fate::Dropped(reason));
    }
    let slot = waiting.to.slot_of(shared, &waiting.body);
    let topic = &slot.key.topic;
    let durable = slot.key.depth > 0;
    let body = aged(waiting, now);
    match slot.write(now, |writer| shared.dialect.write(topic, &body, durable, writer)) {
        Attempt::Done => {
            shared.channels.deliver_own(&topic.name, || shared.dialect.own(topic, &body));
            Some(Fate::Delivered)
        }
        Attempt::Dropped(reason) => Some(Fate::Dropped(reason)),
        Attempt::NotNow => None,
    }
}

/// The message with the age that it has when it is written.
fn aged(waiting: &Waiting<Target>, now: Instant) -> Body {
    match &waiting.body {
        Body::Frame(frame) => Body::Frame(Waiting::<Target>::aged(frame, waiting.since, now)),
        Body::Bare(payload) => Body::Bare(payload.clone()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn publishers_write_themselves_while_it_is_little() {
        let mut sender = Sender::new();
        let now = sender.since;
        assert!(sender.has_room(now));
        sender.messages = TURN_MESSAGES / 2;
        assert!(!sender.has_room(now) && sender.has_room(now + TURN));
        sender.messages = TURN_MESSAGES + 1;
        assert!(!sender.has_room(now + TURN) && sender.has_room(now + 2 * TURN));
        (sender.messages, sender.bytes) = (1, 3 * TURN_BYTES);
        assert!(!sender.has_room(now + 2 * TURN) && sender.has_room(now + 3 * TURN));
        sender.bytes = TURN_BYTES / 2 - 1;
        assert!(sender.has_room(now));
        sender.held.insert(1, VecDeque::new());
        assert!(!sender.has_room(now + TURN), "what waits goes first");
    }
}
