//! What waits for a server: bounded queues, one per publisher, emptied in turns by the one writer
//! of a connection.
//!
//! ```text
//! publisher ─► lane (oldest give way) ─┐
//! publisher ─► lane                    ├─► Outbox::take, a piece of each lane in turn ─► server ─► Waiting::settle
//! publisher ─► lane                   ─┘        (what is over its deadline is dropped here)
//! ```
//!
//! A message counts as queued from [`Lane::push_unless`] until it is settled, so that nothing is ever
//! uncounted.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_domain::{DropReason, MAX_PAYLOAD_BYTES};
use blaze_proto::Frame;
use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::Notify;

use crate::port::{Later, PublishOutcome, Publisher};

/// Messages that one lane gives per turn.
const TURN: usize = 16;
/// Bookkeeping that a message costs beside its bytes, so that many empty messages are bounded, too.
const OVERHEAD_BYTES: usize = 128;

/// Bounds of one outbox.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OutboxLimits {
    /// Most messages that one lane holds.
    pub(crate) lane_messages: usize,
    /// Most bytes that one lane holds; one message always fits.
    pub(crate) lane_bytes: usize,
    /// Most bytes of all lanes together.
    pub(crate) total_bytes: usize,
}

/// What is to be written.
#[derive(Debug, Clone)]
pub(crate) enum Body {
    /// A message with its header.
    Frame(Frame),
    /// A payload as it is.
    Bare(Bytes),
}

impl Body {
    fn size(&self) -> usize {
        OVERHEAD_BYTES
            + match self {
                Self::Frame(frame) => frame.received_len(),
                Self::Bare(payload) => payload.len(),
            }
    }
}

/// Counters of one lane.
#[derive(Debug, Default)]
struct Counts(Mutex<Later>);

impl Counts {
    fn settle(&self, fate: Fate) {
        let mut later = self.0.lock();
        later.queued -= 1;
        match fate {
            Fate::Delivered => {}
            Fate::Dropped(DropReason::QueueFull) => later.queue_full += 1,
            Fate::Dropped(DropReason::Lifespan) => later.lifespan += 1,
            Fate::Dropped(DropReason::TooLarge) => later.too_large += 1,
            Fate::Dropped(_) => later.broker_error += 1,
        }
    }
}

/// How a message ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fate {
    /// The server has it.
    Delivered,
    /// It is lost; a reason that [`Later`] does not know counts as `broker_error`.
    Dropped(DropReason),
}

/// A message that was taken out of its lane, and the duty to settle it.
#[derive(Debug)]
pub(crate) struct Waiting<C> {
    /// What is to be written.
    pub(crate) body: Body,
    /// What its lane is for: the adapter's own data (channel, topic).
    pub(crate) to: Arc<C>,
    /// When it was handed over.
    pub(crate) since: Instant,
    /// When it is of no use any more, and what it then counts as.
    pub(crate) expires: Option<(Instant, DropReason)>,
    receipt: Receipt,
}

impl<C> Waiting<C> {
    /// The frame as it is to be written now: its age has grown by what it waited.
    pub(crate) fn aged(frame: &Frame, since: Instant, now: Instant) -> Frame {
        let waited =
            u64::try_from(now.saturating_duration_since(since).as_micros()).unwrap_or(u64::MAX);
        frame.clone().with_hops_and_age(frame.hops(), frame.age_us().saturating_add(waited))
    }

    /// Bytes that it holds.
    pub(crate) fn size(&self) -> usize {
        self.body.size()
    }

    /// Ends its story.
    pub(crate) fn settle(self, fate: Fate) {
        self.receipt.settle(fate);
    }

    /// Leaves the bytes and keeps the duty to settle.
    pub(crate) fn into_receipt(self) -> Receipt {
        self.receipt
    }
}

/// The duty to settle a message whose bytes may be with the server's client already. Dropped
/// unsettled it counts as `broker_error`.
#[derive(Debug)]
pub(crate) struct Receipt(Option<Arc<Counts>>);

impl Receipt {
    /// Ends the message's story.
    pub(crate) fn settle(mut self, fate: Fate) {
        self.end(fate);
    }

    fn end(&mut self, fate: Fate) {
        if let Some(counts) = self.0.take() {
            counts.settle(fate);
        }
    }
}

impl Drop for Receipt {
    fn drop(&mut self) {
        self.end(Fate::Dropped(DropReason::BrokerError));
    }
}

struct Entry {
    body: Body,
    since: Instant,
    /// When it is of no use any more, and what it then counts as.
    expires: Option<(Instant, DropReason)>,
}

struct Queue<C> {
    entries: VecDeque<Entry>,
    bytes: usize,
    to: Arc<C>,
    counts: Arc<Counts>,
    /// It stands in the list of turns.
    has_turn: bool,
    /// Its publisher has gone: it ends when it is empty.
    orphaned: bool,
}

impl<C> Queue<C> {
    fn drop_oldest(&mut self, reason: DropReason) -> usize {
        let Some(entry) = self.entries.pop_front() else {
            return 0;
        };
        let size = entry.body.size();
        self.bytes -= size;
        self.counts.settle(Fate::Dropped(reason));
        size
    }

    /// Drops the oldest as long as their time is over. Returns their bytes.
    fn drop_overdue(&mut self, now: Instant) -> usize {
        let mut bytes = 0;
        while let Some((at, reason)) = self.entries.front().and_then(|entry| entry.expires)
            && at <= now
        {
            bytes += self.drop_oldest(reason);
        }
        bytes
    }
}

struct State<C> {
    lanes: HashMap<u64, Queue<C>>,
    /// Lanes that hold something, in the order of their turns.
    turns: VecDeque<u64>,
    bytes: usize,
    next: u64,
    closed: bool,
}

impl<C> State<C> {
    /// A lane goes to the end of the list of turns, if it holds something.
    fn end_turn(&mut self, id: u64) {
        let Some(queue) = self.lanes.get_mut(&id) else { return };
        queue.has_turn = !queue.entries.is_empty();
        if queue.has_turn {
            self.turns.push_back(id);
        } else if queue.orphaned {
            self.lanes.remove(&id);
        }
    }
}

/// The queues of one connection.
pub(crate) struct Outbox<C> {
    state: Mutex<State<C>>,
    limits: OutboxLimits,
    filled: Notify,
}

/// Tells whether messages of a lane still wait.
pub(crate) struct Backlog(Arc<Counts>);

impl Backlog {
    pub(crate) fn is_empty(&self) -> bool {
        self.0.0.lock().queued == 0
    }
}

/// One publisher's queue.
pub(crate) struct Lane<C> {
    outbox: Arc<Outbox<C>>,
    id: u64,
    to: Arc<C>,
    counts: Arc<Counts>,
    /// How long a message may wait at most, whatever its deadline.
    longest_wait: Option<Duration>,
}

impl<C> Outbox<C> {
    pub(crate) fn new(limits: OutboxLimits) -> Arc<Self> {
        Arc::new(Self {
            state: Mutex::new(State {
                lanes: HashMap::new(),
                turns: VecDeque::new(),
                bytes: 0,
                next: 0,
                closed: false,
            }),
            limits,
            filled: Notify::new(),
        })
    }

    /// A queue for a publisher. What waits longer than `longest_wait` is dropped as `broker_error`.
    pub(crate) fn lane(self: &Arc<Self>, to: C, longest_wait: Option<Duration>) -> Lane<C> {
        let counts = Arc::<Counts>::default();
        let to = Arc::new(to);
        let mut state = self.state.lock();
        let id = state.next;
        state.next += 1;
        let queue = Queue {
            entries: VecDeque::new(),
            bytes: 0,
            to: Arc::clone(&to),
            counts: Arc::clone(&counts),
            has_turn: false,
            orphaned: false,
        };
        state.lanes.insert(id, queue);
        drop(state);
        Lane { outbox: Arc::clone(self), id, to, counts, longest_wait }
    }

    /// Waits until there is a lane that held nothing when it was last looked at. Who leaves
    /// something in a lane knows himself when to come back. Cancelling it loses nothing.
    pub(crate) async fn filled(&self) {
        self.filled.notified().await;
    }

    /// Ends a wait for [`filled`](Self::filled): what was left in a lane may go now.
    pub(crate) fn ring(&self) {
        self.filled.notify_one();
    }

    /// Whether nothing waits.
    pub(crate) fn is_empty(&self) -> bool {
        self.state.lock().bytes == 0
    }

    /// Takes messages in turns of the lanes until `messages` or `bytes` are reached (one message is
    /// always taken), and drops those whose time is over. Returns the bytes taken.
    pub(crate) fn take(
        &self,
        now: Instant,
        messages: usize,
        bytes: usize,
        into: &mut Vec<Waiting<C>>,
    ) -> usize {
        self.take_ready(now, messages, bytes, true, |_| Some(usize::MAX), into)
    }

    /// As [`take`](Self::take), only from lanes whose `to` is ready, and of each at most the bytes
    /// that `allowance` gives for its turn, but always one message; what waits in the others is
    /// only dropped when its time is over. With `one_always`, one message is taken even if it is
    /// larger than `bytes`.
    pub(crate) fn take_ready(
        &self,
        now: Instant,
        messages: usize,
        bytes: usize,
        one_always: bool,
        mut allowance: impl FnMut(&C) -> Option<usize>,
        into: &mut Vec<Waiting<C>>,
    ) -> usize {
        let mut state = self.state.lock();
        let state = &mut *state;
        let mut taken = 0;
        let mut not_ready = Vec::new();
        let first = into.len();
        while into.len() - first < messages {
            let Some(id) = state.turns.pop_front() else { break };
            let Some(queue) = state.lanes.get_mut(&id) else {
                continue;
            };
            let Some(allowed) = allowance(&queue.to) else {
                state.bytes -= queue.drop_overdue(now);
                not_ready.push(id);
                continue;
            };
            let mut full = false;
            let mut of_lane = 0_usize;
            for _ in 0..TURN {
                state.bytes -= queue.drop_overdue(now);
                let Some(entry) = queue.entries.front() else { break };
                let size = entry.body.size();
                if of_lane > 0 && of_lane.saturating_add(size) > allowed {
                    break;
                }
                let is_first = into.len() == first && one_always;
                if !is_first && (taken + size > bytes || into.len() - first >= messages) {
                    full = true;
                    break;
                }
                let Some(entry) = queue.entries.pop_front() else { break };
                queue.bytes -= size;
                state.bytes -= size;
                taken += size;
                of_lane += size;
                into.push(Waiting {
                    body: entry.body,
                    to: Arc::clone(&queue.to),
                    since: entry.since,
                    expires: entry.expires,
                    receipt: Receipt(Some(Arc::clone(&queue.counts))),
                });
            }
            if full {
                // It keeps its place: one that is too large for what is left is the first of the
                // next take.
                state.turns.push_front(id);
                break;
            }
            state.end_turn(id);
        }
        for id in not_ready {
            state.end_turn(id);
        }
        taken
    }

    /// Drops what is over its deadline, in all lanes; for a server that takes nothing.
    pub(crate) fn expire(&self, now: Instant) {
        let mut state = self.state.lock();
        let state = &mut *state;
        for queue in state.lanes.values_mut() {
            state.bytes -= queue.drop_overdue(now);
            // What comes next is new to who takes.
            queue.has_turn &= !queue.entries.is_empty();
        }
        let lanes = &mut state.lanes;
        state.turns.retain(|id| lanes.get(id).is_some_and(|queue| queue.has_turn));
        lanes.retain(|_, queue| queue.has_turn || !queue.orphaned);
    }

    /// Drops all that waits.
    pub(crate) fn clear(&self, reason: DropReason) {
        let mut state = self.state.lock();
        let state = &mut *state;
        for queue in state.lanes.values_mut() {
            while !queue.entries.is_empty() {
                state.bytes -= queue.drop_oldest(reason);
            }
            queue.has_turn = false;
        }
        state.turns.clear();
        state.lanes.retain(|_, queue| !queue.orphaned);
    }

    /// Takes nothing more from publishers.
    pub(crate) fn close(&self) {
        self.state.lock().closed = true;
        self.filled.notify_one();
    }
}

impl<C> Lane<C> {
    /// Queues a message and wakes the writer of the connection.
    #[cfg(test)]
    pub(crate) fn push(&self, body: Body, deadline: Option<Instant>) -> PublishOutcome {
        self.push_unless(body, deadline, || false)
    }

    /// Queues a message; the oldest of the lane give way. If nothing of the lane waited, the writer
    /// of the connection is woken, unless `write_at_once` has left nothing to it.
    pub(crate) fn push_unless(
        &self,
        body: Body,
        deadline: Option<Instant>,
        write_at_once: impl FnOnce() -> bool,
    ) -> PublishOutcome {
        let since = Instant::now();
        let longest = self.longest_wait.map(|wait| (since + wait, DropReason::BrokerError));
        let expires = match (deadline.map(|at| (at, DropReason::Lifespan)), longest) {
            (Some(one), Some(other)) => Some(if one.0 <= other.0 { one } else { other }),
            (one, other) => one.or(other),
        };
        let size = body.size();
        let limits = self.outbox.limits;
        {
            let mut state = self.outbox.state.lock();
            let state = &mut *state;
            if state.closed {
                return PublishOutcome::Dropped;
            }
            let Some(queue) = state.lanes.get_mut(&self.id) else {
                return PublishOutcome::Dropped;
            };
            while !queue.entries.is_empty()
                && (queue.entries.len() >= limits.lane_messages
                    || queue.bytes + size > limits.lane_bytes
                    || state.bytes + size > limits.total_bytes)
            {
                state.bytes -= queue.drop_oldest(DropReason::QueueFull);
            }
            if state.bytes + size > limits.total_bytes && state.bytes > 0 {
                // Others hold the room, and this lane has nothing older to give.
                self.counts.0.lock().queue_full += 1;
                return PublishOutcome::Taken;
            }
            queue.bytes += size;
            state.bytes += size;
            queue.entries.push_back(Entry { body, since, expires });
            self.counts.0.lock().queued += 1;
            if std::mem::replace(&mut queue.has_turn, true) {
                // Who takes knows of the lane, and comes back when there is room.
                return PublishOutcome::Taken;
            }
            state.turns.push_back(self.id);
        }
        if !write_at_once() {
            self.outbox.filled.notify_one();
        }
        PublishOutcome::Taken
    }

    /// What the lane is for.
    pub(crate) fn to(&self) -> &C {
        &self.to
    }

    pub(crate) fn backlog(&self) -> Backlog {
        Backlog(Arc::clone(&self.counts))
    }

    /// What became of what was pushed.
    pub(crate) fn later(&self) -> Later {
        *self.counts.0.lock()
    }
}

/// What an adapter knows of its publishers beside their queues.
pub(crate) trait Admission: Send + Sync {
    /// Whether nothing is taken now.
    fn is_shut(&self) -> bool;

    /// A message has been queued; it may have been shut meanwhile.
    fn queued(&self) {}

    /// Writes in this thread what is queued. Returns whether nothing is left to another.
    fn write_at_once(&self) -> bool {
        false
    }

    /// Whether the server keeps headers beside the payload.
    fn has_headers(&self) -> bool {
        false
    }
}

/// Writes one channel through a lane.
pub(crate) struct LanePublisher<C, A> {
    pub(crate) lane: Lane<C>,
    pub(crate) admission: A,
}

impl<C, A: Admission> LanePublisher<C, A> {
    fn push(&self, body: Body, payload_bytes: usize, deadline: Option<Instant>) -> PublishOutcome {
        if self.admission.is_shut() {
            return PublishOutcome::Dropped;
        }
        if payload_bytes > MAX_PAYLOAD_BYTES {
            return PublishOutcome::TooLarge;
        }
        let outcome = self.lane.push_unless(body, deadline, || self.admission.write_at_once());
        self.admission.queued();
        outcome
    }
}

impl<C: Send + Sync, A: Admission> Publisher for LanePublisher<C, A> {
    fn publish(&self, frame: &Frame, deadline: Option<Instant>) -> PublishOutcome {
        self.push(Body::Frame(frame.clone()), frame.payload().len(), deadline)
    }

    /// As [`Publisher::publish_bare`]. A payload without a header has no writer, so it is not kept
    /// for late joiners.
    fn publish_bare(&self, payload: &Bytes, deadline: Option<Instant>) -> PublishOutcome {
        self.push(Body::Bare(payload.clone()), payload.len(), deadline)
    }

    fn publish_copy(&self, frame: &Frame, deadline: Option<Instant>) -> PublishOutcome {
        if self.admission.has_headers() {
            self.publish(frame, deadline)
        } else {
            self.publish_bare(frame.payload(), deadline)
        }
    }

    fn later(&self) -> Later {
        self.lane.later()
    }
}

impl<C> Drop for Lane<C> {
    fn drop(&mut self) {
        let mut state = self.outbox.state.lock();
        let gone = state.lanes.get_mut(&self.id).is_some_and(|queue| {
            queue.orphaned = true;
            !queue.has_turn
        });
        if gone {
            state.lanes.remove(&self.id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: OutboxLimits =
        OutboxLimits { lane_messages: 4, lane_bytes: 10_000, total_bytes: 20_000 };

    fn bare(number: u8, bytes: usize) -> Body {
        Body::Bare(Bytes::from(vec![number; bytes]))
    }

    fn number(waiting: &Waiting<&'static str>) -> (&'static str, u8) {
        match &waiting.body {
            Body::Bare(payload) => (*waiting.to, payload[0]),
            Body::Frame(_) => ("frame", 0),
        }
    }

    fn take_all(
        outbox: &Outbox<&'static str>,
        messages: usize,
        bytes: usize,
    ) -> Vec<(&'static str, u8)> {
        let mut into = Vec::new();
        outbox.take(Instant::now(), messages, bytes, &mut into);
        let seen = into.iter().map(number).collect();
        into.into_iter().for_each(|waiting| waiting.settle(Fate::Delivered));
        seen
    }

    #[test]
    fn a_full_lane_loses_its_oldest_and_keeps_order() {
        let outbox = Outbox::new(SMALL);
        let lane = outbox.lane("a", None);
        for count in 1..=6 {
            assert_eq!(lane.push(bare(count, 10), None), PublishOutcome::Taken);
        }
        assert_eq!(lane.later().queue_full, 2);
        assert_eq!(take_all(&outbox, 100, 10_000), [("a", 3), ("a", 4), ("a", 5), ("a", 6)]);
        let later = lane.later();
        assert_eq!((later.queued, later.dropped()), (0, 2));
        assert!(outbox.is_empty());
    }

    #[test]
    fn lanes_take_turns_and_limits_stop_a_take() {
        let outbox = Outbox::new(OutboxLimits { lane_messages: 100, ..SMALL });
        let (a, b) = (outbox.lane("a", None), outbox.lane("b", None));
        for count in 0..20 {
            a.push(bare(count, 10), None);
        }
        b.push(bare(7, 10), None);
        let seen = take_all(&outbox, 18, 10_000);
        assert_eq!(seen.len(), 18);
        assert_eq!(seen[16], ("b", 7), "b has its turn after {TURN} of a");
        assert_eq!(take_all(&outbox, 100, 1), [("a", 17)], "one message is always taken");
        assert_eq!(take_all(&outbox, 100, 10_000), [("a", 18), ("a", 19)]);
    }

    #[test]
    fn a_lane_gives_what_it_is_allowed_and_always_one() {
        let outbox = Outbox::new(OutboxLimits { lane_messages: 6, ..SMALL });
        let lane = outbox.lane("a", None);
        for count in 0..6 {
            lane.push(bare(count, 10), None);
        }
        let size = bare(0, 10).size();
        let take = |allowed| {
            let (mut into, mut turns) = (Vec::new(), 0);
            let once = |_: &&str| {
                turns += 1;
                (turns == 1).then_some(allowed)
            };
            outbox.take_ready(Instant::now(), 100, 10_000, true, once, &mut into);
            into.iter().map(number).collect::<Vec<_>>()
        };
        assert_eq!(take(0), [("a", 0)]);
        assert_eq!(take(3 * size), [("a", 1), ("a", 2), ("a", 3)]);
        assert_eq!(take(3 * size - 1), [("a", 4), ("a", 5)]);
    }

    #[test]
    fn lanes_that_are_not_ready_wait_and_expire() {
        let outbox = Outbox::new(SMALL);
        let (a, b) = (outbox.lane("a", Some(Duration::from_secs(5))), outbox.lane("b", None));
        let now = Instant::now();
        a.push(bare(1, 10), None);
        b.push(bare(2, 10), None);
        let take = |at, ready: &'static str, bytes, one_always| {
            let mut into = Vec::new();
            outbox.take_ready(
                at,
                100,
                bytes,
                one_always,
                |to| (*to == ready).then_some(usize::MAX),
                &mut into,
            );
            into.iter().map(number).collect::<Vec<_>>()
        };
        assert_eq!(take(now, "b", 1, false), [], "nothing that is larger than the room");
        assert_eq!(take(now, "b", 1, true), [("b", 2)]);
        assert_eq!(a.later().queued, 1);
        assert_eq!(take(now + Duration::from_secs(6), "b", 10_000, true), []);
        assert_eq!((a.later().queued, a.later().broker_error), (0, 1));
        a.push(bare(3, 10), None);
        assert_eq!(take(now, "a", 10_000, true), [("a", 3)]);
    }

    #[test]
    fn what_is_over_its_time_is_dropped_with_its_reason() {
        let outbox = Outbox::new(SMALL);
        let lane = outbox.lane("a", Some(Duration::ZERO));
        let other = outbox.lane("b", None);
        let now = Instant::now();
        lane.push(bare(1, 10), None);
        other.push(bare(2, 10), Some(now));
        other.push(bare(3, 10), Some(now + Duration::from_secs(60)));
        outbox.expire(now + Duration::from_secs(1));
        assert_eq!(take_all(&outbox, 100, 10_000), [("b", 3)]);
        assert_eq!((lane.later().broker_error, lane.later().lifespan), (1, 0));
        assert_eq!((other.later().broker_error, other.later().lifespan), (0, 1));
    }

    #[test]
    fn the_total_is_bounded_over_all_lanes() {
        let outbox = Outbox::new(SMALL);
        let lanes: Vec<_> = (0..4).map(|_| outbox.lane("x", None)).collect();
        for lane in &lanes {
            lane.push(bare(1, 9_000), None);
        }
        assert_eq!(lanes.iter().map(|lane| lane.later().queued).sum::<u64>(), 2);
        assert_eq!(lanes.iter().map(|lane| lane.later().queue_full).sum::<u64>(), 2);
    }

    #[test]
    fn nothing_is_uncounted_when_it_is_forgotten() {
        let outbox = Outbox::new(SMALL);
        let lane = outbox.lane("a", None);
        lane.push(bare(1, 10), None);
        lane.push(bare(2, 10), None);
        lane.push(bare(3, 10), None);
        let mut into = Vec::new();
        outbox.take(Instant::now(), 2, 10_000, &mut into);
        drop(into.pop());
        drop(into.pop().map(Waiting::into_receipt));
        outbox.clear(DropReason::BrokerError);
        assert_eq!(lane.later(), Later { broker_error: 3, ..Later::default() });
        outbox.close();
        assert_eq!(lane.push(bare(4, 10), None), PublishOutcome::Dropped);
    }

    /// Who takes is woken by the first message of a lane, also after what it held was dropped.
    #[test]
    fn a_lane_that_held_nothing_rings() {
        let rings =
            |outbox: &Outbox<()>| futures::FutureExt::now_or_never(outbox.filled()).is_some();
        let outbox = Outbox::new(SMALL);
        let lane = outbox.lane((), None);
        let soon = Instant::now() + Duration::from_secs(60);
        lane.push(bare(1, 10), Some(soon));
        assert!(rings(&outbox));
        lane.push(bare(2, 10), Some(soon));
        assert!(!rings(&outbox), "it is known");
        outbox.expire(soon);
        assert!(outbox.is_empty());
        lane.push(bare(3, 10), None);
        assert!(rings(&outbox));
        let mut taken = Vec::new();
        outbox.take(Instant::now(), 1, 10_000, &mut taken);
        assert_eq!(taken.len(), 1);
        lane.push(bare(4, 10), None);
        assert!(rings(&outbox));
    }

    #[test]
    fn a_lane_can_wait_until_all_of_another_is_settled() {
        let outbox = Outbox::new(SMALL);
        let [new, old] = ["new", "old"].map(|to| outbox.lane(to, None));
        for (lane, number) in [(&new, 3), (&old, 1), (&old, 2)] {
            lane.push(bare(number, 1), None);
        }
        let backlog = old.backlog();
        let take = || {
            let mut into = Vec::new();
            let allowance = |to: &&str| (*to == "old" || backlog.is_empty()).then_some(usize::MAX);
            outbox.take_ready(Instant::now(), 9, 9_999, true, allowance, &mut into);
            into
        };
        let first = take();
        assert_eq!(first.iter().map(number).collect::<Vec<_>>(), [("old", 1), ("old", 2)]);
        assert!(take().is_empty(), "they are taken, but not written");
        first.into_iter().for_each(|waiting| waiting.settle(Fate::Delivered));
        assert_eq!(take().iter().map(number).collect::<Vec<_>>(), [("new", 3)]);
    }
}
