//! The queue between a subscription and the threads that run its callback.
//!
//! Messages wait per writer. A writer with messages and a free place is *ready*; a ticket in the
//! pool takes the next ready writer, runs its oldest message and looks again. So writers take
//! turns, each in its order.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use blaze_domain::{TopicName, WriterId};
use parking_lot::Mutex;
use tokio::sync::Notify;

use super::intake::is_expired;
use super::stats::Counters;
use crate::Message;
use crate::monitor::{Counted, Counts, Times};
use crate::pool::{Job, PoolHandle};

pub(crate) type Callback = Box<dyn Fn(Message) + Send + Sync>;

/// Bounds of a queue.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limits {
    pub(super) max_messages: usize,
    pub(super) max_bytes: usize,
    /// Callbacks for one writer at a time.
    pub(super) per_writer: usize,
    /// Callbacks at a time; less than the pool has threads, so that other subscriptions go on.
    pub(super) at_once: usize,
    pub(super) lifespan: Duration,
}

/// `None`: messages without an identity count as one writer.
type Writer = Option<WriterId>;

pub(super) struct Dispatch {
    topic: TopicName,
    callback: Callback,
    limits: Limits,
    counters: Arc<Counters>,
    state: Mutex<State>,
    /// No callback runs any more.
    idle: Notify,
}

#[derive(Default)]
struct State {
    writers: HashMap<Writer, Queue>,
    /// Who has the oldest message of all.
    by_age: BTreeMap<u64, Writer>,
    ready: VecDeque<Writer>,
    next_stamp: u64,
    bytes: usize,
    tickets: usize,
    running: usize,
    closed: bool,
    /// How long callbacks took.
    times: Times,
}

#[derive(Default)]
struct Queue {
    messages: VecDeque<(u64, Message)>,
    running: usize,
    /// How often it is in the list of the ready ones.
    listed: usize,
}

impl Dispatch {
    pub(super) fn new(
        topic: &TopicName,
        callback: Callback,
        limits: Limits,
        counters: Arc<Counters>,
    ) -> Self {
        Self {
            topic: topic.clone(),
            callback,
            limits,
            counters,
            state: Mutex::default(),
            idle: Notify::new(),
        }
    }

    /// Takes a message; the oldest give way when there is no room.
    pub(super) fn offer(self: &Arc<Self>, message: Message, pool: &PoolHandle) {
        let size = message.size();
        let mut dropped = Vec::new();
        let mut state = self.state.lock();
        if state.closed {
            return;
        }
        while !state.by_age.is_empty()
            && (state.by_age.len() >= self.limits.max_messages
                || state.bytes + size > self.limits.max_bytes)
        {
            dropped.extend(state.drop_oldest());
        }
        let needs_ticket = state.push(message, &self.limits);
        drop(state);
        self.counters.queue_dropped.add(dropped.len() as u64);
        if needs_ticket {
            pool.submit(Arc::clone(self) as Arc<dyn Job>);
        }
    }

    /// Forgets what waits and takes nothing more. A callback that runs goes on to its end.
    pub(super) fn close(&self) {
        let forgotten = {
            let mut state = self.state.lock();
            state.closed = true;
            state.by_age.clear();
            state.ready.clear();
            state.bytes = 0;
            std::mem::take(&mut state.writers)
        };
        drop(forgotten);
    }

    /// Waits until no callback runs any more, after [`Dispatch::close`].
    pub(super) async fn idle(&self) {
        loop {
            let notified = self.idle.notified();
            if self.state.lock().running == 0 {
                return;
            }
            notified.await;
        }
    }

    /// Returns how long the callback took; `None` for a message whose time was over.
    fn call(&self, message: Message) -> Option<Duration> {
        let begin = Instant::now();
        let age = message.age_at(begin, SystemTime::now());
        if is_expired(age, message.lifespan(), self.limits.lifespan) {
            self.counters.expired.add(1);
            return None;
        }
        self.counters.delivered.add(1);
        let sequence = message.sequence();
        if catch_unwind(AssertUnwindSafe(|| (self.callback)(message))).is_err() {
            self.counters.panicked.add(1);
            tracing::error!(
                topic = %self.topic,
                sequence,
                "the callback of a subscription panicked",
            );
        }
        Some(begin.elapsed())
    }
}

impl Job for Dispatch {
    fn run_one(&self) -> bool {
        let Some((writer, message)) = self.state.lock().take_next() else {
            return false;
        };
        let time = self.call(message);
        let mut state = self.state.lock();
        time.into_iter().for_each(|time| state.times.add(time));
        let more = state.finish(writer, &self.limits);
        let is_idle = state.running == 0;
        drop(state);
        if is_idle {
            self.idle.notify_waiters();
        }
        more
    }
}

impl Counted for Dispatch {
    fn counts(&self) -> Counts {
        let mut counts = self.counters.read().counts();
        counts.callbacks = Some(self.state.lock().times.clone());
        counts
    }
}

impl State {
    fn drop_oldest(&mut self) -> Option<Message> {
        let (_, writer) = self.by_age.pop_first()?;
        let (_, message) = self.writers.get_mut(&writer)?.messages.pop_front()?;
        self.bytes -= message.size();
        Some(message)
    }

    /// Returns whether one more ticket is needed.
    fn push(&mut self, message: Message, limits: &Limits) -> bool {
        let writer = message.writer();
        let stamp = self.next_stamp;
        self.next_stamp += 1;
        self.bytes += message.size();
        self.by_age.insert(stamp, writer);
        let queue = self.writers.entry(writer).or_default();
        queue.messages.push_back((stamp, message));
        if queue.running + queue.listed >= limits.per_writer {
            return false;
        }
        queue.listed += 1;
        self.ready.push_back(writer);
        if self.tickets >= limits.at_once {
            return false;
        }
        self.tickets += 1;
        true
    }

    /// The oldest message of the next ready writer. Without one, a ticket ends.
    fn take_next(&mut self) -> Option<(Writer, Message)> {
        while let Some(writer) = self.ready.pop_front() {
            let Some(queue) = self.writers.get_mut(&writer) else {
                continue;
            };
            queue.listed -= 1;
            if let Some((stamp, message)) = queue.messages.pop_front() {
                queue.running += 1;
                self.running += 1;
                self.by_age.remove(&stamp);
                self.bytes -= message.size();
                return Some((writer, message));
            }
            // Its messages gave way meanwhile.
            if queue.running == 0 && queue.listed == 0 {
                self.writers.remove(&writer);
            }
        }
        self.tickets -= 1;
        None
    }

    /// Returns whether the ticket goes on; otherwise it has ended.
    fn finish(&mut self, writer: Writer, limits: &Limits) -> bool {
        self.running -= 1;
        if let Some(queue) = self.writers.get_mut(&writer) {
            queue.running -= 1;
            if queue.messages.len() > queue.listed
                && queue.running + queue.listed < limits.per_writer
            {
                queue.listed += 1;
                self.ready.push_back(writer);
            } else if queue.messages.is_empty() && queue.running == 0 && queue.listed == 0 {
                self.writers.remove(&writer);
            }
        }
        if self.ready.is_empty() {
            self.tickets -= 1;
            return false;
        }
        true
    }
}
