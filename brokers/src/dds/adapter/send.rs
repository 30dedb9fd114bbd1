//! The thread that hands messages to DDS writers.

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
        let mut sender =
            Sender { shared, held: HashMap::new(), taken: Vec::with_capacity(TURN_MESSAGES) };
        while !stop.load(Ordering::Relaxed) && !sender.shared.stop.load(Ordering::Acquire) {
            sender.turn();
        }
        sender.held.clear();
        sender.shared.held.store(0, Ordering::Release);
        sender.shared.outbox.clear(DropReason::BrokerError);
    })
}

struct Sender {
    shared: Arc<Shared>,
    /// By target: what its writer could not take, in order.
    held: HashMap<u64, VecDeque<Waiting<Target>>>,
    taken: Vec<Waiting<Target>>,
}

impl Sender {
    fn turn(&mut self) {
        let begin = Instant::now();
        let retried = self.retry(begin);
        let bytes = self.shared.outbox.take_ready(
            begin,
            TURN_MESSAGES,
            TURN_BYTES,
            true,
            |target| {
                let is_free = !self.held.contains_key(&target.id) && target.may_write();
                is_free.then_some(usize::MAX)
            },
            &mut self.taken,
        );
        // Until they are written they are nowhere else.
        self.shared.held.fetch_add(self.taken.len(), Ordering::AcqRel);
        let count = self.taken.len();
        let of_large = self.taken.iter().filter(|waiting| waiting.to.key.large).count();
        let bytes = bytes.max(of_large * LARGE_COST);
        for waiting in std::mem::take(&mut self.taken) {
            self.write(waiting, begin);
        }
        self.note_held();
        if count + retried >= TURN_MESSAGES / 2 || bytes >= TURN_BYTES / 2 {
            let turns = u32::try_from(bytes.div_ceil(TURN_BYTES)).unwrap_or(u32::MAX).max(1);
            if let Some(rest) = (TURN * turns).checked_sub(begin.elapsed()) {
                thread::sleep(rest);
            }
        } else if count == 0 {
            self.rest();
        }
    }

    fn note_held(&self) {
        let held = self.held.values().map(VecDeque::len).sum();
        self.shared.held.store(held, Ordering::Release);
    }

    /// Waits for something to do.
    fn rest(&self) {
        if self.held.is_empty() {
            wait(self.shared.outbox.filled(), IDLE);
            return;
        }
        let is_large = |queue: &VecDeque<Waiting<Target>>| {
            queue.front().is_some_and(|it| it.size() > LARGE_BYTES)
        };
        let pause = if self.held.values().all(is_large) { LARGE_AGAIN } else { AGAIN };
        // What is published meanwhile may go to another writer.
        wait(self.shared.outbox.filled(), pause);
    }

    /// Writes what was held. Returns how many messages went.
    fn retry(&mut self, now: Instant) -> usize {
        let mut gone = 0;
        let shared = &self.shared;
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

    fn write(&mut self, waiting: Waiting<Target>, now: Instant) {
        let id = waiting.to.id;
        if let Some(queue) = self.held.get_mut(&id) {
            queue.push_back(waiting);
            return;
        }
        match attempt(&self.shared, &waiting, now) {
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
