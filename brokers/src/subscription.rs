//! A subscription: a bounded ring between an adapter and its reader.
//!
//! ```text
//! server ──► adapter ──► SubscriptionSender ──► bounded ring ──► Subscription::receive (batches)
//!                                                          └──► or a sink, Subscription::forward
//! ```
//!
//! The ring drops its oldest when its reader is slow; the reader learns how many it missed.

use std::any::Any;
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use parking_lot::Mutex;
use tokio::sync::Notify;

use crate::port::{Received, SubscribeOptions};

/// Takes messages of a subscription, and how many were dropped before them because nobody took
/// them in time.
pub type MessageSink = Box<dyn Fn(&mut Vec<Received>, u64) + Send + Sync>;

/// Most waiting messages with which the sending thread calls the sink itself. Where more wait, the
/// reader's task calls it, and the sending thread goes on reading from the server.
const MAX_INLINE: usize = 64;

struct Ring {
    queue: Mutex<RingState>,
    readable: Notify,
    dropped: AtomicU64,
    options: SubscribeOptions,
    /// Of a reader with a sink. Only the thread that holds the lock calls the sink, so that messages
    /// stay in order.
    forwarder: Mutex<Option<Forwarder>>,
}

/// Calls the sink of [`Subscription::forward`].
struct Forwarder {
    sink: MessageSink,
    /// Most messages per call.
    limit: usize,
    batch: Vec<Received>,
    /// Panic of the sink, which goes on in the reader's task.
    panic: Option<Box<dyn Any + Send>>,
}

impl Ring {
    /// Gives the sink what waits. Where another thread does so, that one takes this, too. Returns
    /// whether the reader's task has nothing to do.
    fn drain(&self) -> bool {
        while !self.queue.lock().messages.is_empty() {
            let Some(mut forwarder) = self.forwarder.try_lock() else { break };
            let Some(forwarder) = &mut *forwarder else { return false };
            forwarder.drain(self);
            if forwarder.panic.is_some() {
                return false;
            }
        }
        true
    }
}

impl Forwarder {
    fn drain(&mut self, ring: &Ring) {
        let Self { sink, limit, batch, panic } = self;
        while panic.is_none() && ring.queue.lock().take(batch, *limit) > 0 {
            let lost = ring.dropped.swap(0, Ordering::Relaxed);
            let call = AssertUnwindSafe(|| sink(batch, lost));
            *panic = catch_unwind(call).err();
            batch.clear();
        }
    }
}

#[derive(Default)]
struct RingState {
    messages: VecDeque<Received>,
    bytes: usize,
    /// What the bounds are raised by.
    more: More,
    closed: bool,
}

/// Room for what is kept for late joiners, beside the bounds of a subscription, until the reader
/// has taken as much.
#[derive(Default)]
struct More {
    messages: usize,
    bytes: usize,
}

impl More {
    fn raise(&mut self, bytes: usize) {
        self.messages = self.messages.saturating_add(1).min(MAX_KEPT_MESSAGES);
        self.bytes = self.bytes.saturating_add(bytes).min(MAX_KEPT_BYTES);
    }
}

impl RingState {
    /// Takes a message in. Returns how many gave way.
    fn push(&mut self, message: Received, options: &SubscribeOptions) -> u64 {
        let size = message.content.size();
        let max_messages = options.max_messages.saturating_add(self.more.messages);
        let max_bytes = options.max_bytes.saturating_add(self.more.bytes);
        let mut lost = 0;
        while !self.messages.is_empty()
            && (self.messages.len() >= max_messages || self.bytes + size > max_bytes)
        {
            if let Some(oldest) = self.messages.pop_front() {
                self.bytes -= oldest.content.size();
                lost += 1;
            }
        }
        self.bytes += size;
        self.messages.push_back(message);
        lost
    }

    /// Takes up to `limit` messages out. Returns how many.
    fn take(&mut self, batch: &mut Vec<Received>, limit: usize) -> usize {
        let count = self.messages.len().min(limit);
        let mut bytes = 0;
        let taken = self.messages.drain(..count);
        batch.extend(taken.inspect(|message| bytes += message.content.size()));
        self.bytes -= bytes;
        self.more.messages = self.more.messages.saturating_sub(count);
        self.more.bytes = self.more.bytes.saturating_sub(bytes);
        count
    }
}

/// The adapter's end of a subscription.
#[derive(Clone)]
pub struct SubscriptionSender {
    ring: Arc<Ring>,
}

/// The reader's end of a subscription. Dropping it unsubscribes.
pub struct Subscription {
    ring: Arc<Ring>,
    /// Offsets that it begins at, by partition.
    starts: Vec<i64>,
}

/// Messages that are kept for late joiners and handed over beyond the bounds of a subscription, at
/// most: as many as a store holds of the smallest ones.
pub const MAX_KEPT_MESSAGES: usize = 262_144;
/// Their bytes at most (256 MiB), which is what a reader takes of a topic of Kafka.
pub const MAX_KEPT_BYTES: usize = 256 * 1024 * 1024;

/// Both ends of a subscription.
#[must_use]
pub fn subscription(options: SubscribeOptions) -> (SubscriptionSender, Subscription) {
    let ring = Arc::new(Ring {
        queue: Mutex::default(),
        readable: Notify::new(),
        dropped: AtomicU64::new(0),
        options,
        forwarder: Mutex::default(),
    });
    (SubscriptionSender { ring: Arc::clone(&ring) }, Subscription { ring, starts: Vec::new() })
}

impl SubscriptionSender {
    /// Hands a message to the reader. Returns whether the subscription still lives.
    pub fn send(&self, message: Received) -> bool {
        self.hand_over([message], false)
    }

    /// Hands messages to the reader that were kept for late joiners, at once. They raise the bounds
    /// until it has taken as many, because it cannot read while they are collected: at most by
    /// [`MAX_KEPT_MESSAGES`] and [`MAX_KEPT_BYTES`]. Returns whether the subscription still lives.
    pub fn send_kept(&self, kept: impl IntoIterator<Item = Received>) -> bool {
        self.hand_over(kept, true)
    }

    /// As [`send`](Self::send), for one who calls [`flush`](Self::flush) soon.
    pub(crate) fn put(&self, message: Received) -> bool {
        self.push([message], false)
    }

    /// Hands over what was put: in this thread, where the reader has a sink and little waits. Called
    /// without any lock that a sink might want.
    pub(crate) fn flush(&self) {
        let is_little = self.ring.queue.lock().messages.len() <= MAX_INLINE;
        if !(is_little && self.ring.drain()) {
            self.wake();
        }
    }

    /// Lets the reader look at what waits.
    pub(crate) fn wake(&self) {
        self.ring.readable.notify_one();
    }

    fn hand_over(&self, messages: impl IntoIterator<Item = Received>, raise_bounds: bool) -> bool {
        let lives = self.push(messages, raise_bounds);
        self.wake();
        lives
    }

    fn push(&self, messages: impl IntoIterator<Item = Received>, raise_bounds: bool) -> bool {
        let mut lost = 0;
        {
            let mut state = self.ring.queue.lock();
            if state.closed {
                return false;
            }
            for message in messages {
                if raise_bounds {
                    state.more.raise(message.content.size());
                }
                lost += state.push(message, &self.ring.options);
            }
        }
        self.note_lost(lost);
        true
    }

    /// Counts messages that the reader will never get because it, or whoever reads for it, was too
    /// slow.
    pub fn note_lost(&self, messages: u64) {
        if messages > 0 {
            self.ring.dropped.fetch_add(messages, Ordering::Relaxed);
        }
    }

    /// Whether the reader has gone.
    #[must_use]
    pub fn is_closed(&self) -> bool {
        self.ring.queue.lock().closed
    }

    /// Whether both hand messages to the same reader.
    pub(crate) fn is_same(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.ring, &other.ring)
    }

    /// Ends the subscription; the reader still gets what waits.
    pub fn close(&self) {
        self.ring.queue.lock().closed = true;
        self.ring.readable.notify_one();
    }
}

impl Subscription {
    /// The same, said to begin at these offsets.
    #[must_use]
    pub fn starting_at(mut self, starts: Vec<i64>) -> Self {
        self.starts = starts;
        self
    }

    /// Offset of the first message that it can get, by partition; empty where the server has no
    /// places. What is kept for late joiners may lie before; partitions that the topic gets later
    /// are read from their beginning.
    #[must_use]
    pub fn starts(&self) -> &[i64] {
        &self.starts
    }

    /// Waits for messages and takes up to `limit` of them into `batch`. Returns how many; 0 = the
    /// subscription ended. Cancelling it loses nothing.
    pub async fn receive(&mut self, batch: &mut Vec<Received>, limit: usize) -> usize {
        loop {
            {
                let mut state = self.ring.queue.lock();
                let count = state.take(batch, limit);
                if count > 0 {
                    return count;
                }
                if state.closed {
                    return 0;
                }
            }
            self.ring.readable.notified().await;
        }
    }

    /// Gives messages to a sink until the subscription ends, up to `limit` at once. Some adapters
    /// call it in the thread that reads, so that nobody has to be woken; it must not wait for a
    /// peer, nor drop the subscription. After that is dropped, it is not called any more.
    ///
    /// # Panics
    /// Where the sink panics, in whichever thread.
    pub async fn forward(&mut self, limit: usize, sink: MessageSink) {
        let forwarder = Forwarder { sink, limit, batch: Vec::with_capacity(limit), panic: None };
        *self.ring.forwarder.lock() = Some(forwarder);
        loop {
            self.ring.drain();
            let is_closed = self.ring.queue.lock().closed;
            // Another thread may have taken something, and is waited for before the end.
            let panic = self.ring.forwarder.lock().as_mut().and_then(|it| it.panic.take());
            if let Some(panic) = panic {
                resume_unwind(panic);
            }
            if is_closed {
                self.ring.drain();
                return;
            }
            self.ring.readable.notified().await;
        }
    }

    /// Messages dropped because this reader, or whoever reads for it, was slow, since the last
    /// call.
    #[must_use]
    pub fn take_dropped(&self) -> u64 {
        self.ring.dropped.swap(0, Ordering::Relaxed)
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        let mut state = self.ring.queue.lock();
        state.closed = true;
        state.messages.clear();
        state.bytes = 0;
        drop(state);
        // Until its sink has returned, which may be called now.
        let forwarder = self.ring.forwarder.lock().take();
        drop(forwarder);
    }
}

#[cfg(test)]
mod tests {
    use std::thread;
    use std::time::Instant;

    use bytes::Bytes;
    use futures::FutureExt as _;

    use super::*;
    use crate::port::Content;

    const SIZE: usize = 10;

    fn message(number: usize) -> Received {
        let payload = Bytes::from(vec![u8::try_from(number % 256).unwrap(); SIZE]);
        Received::live(Content::Bare { payload, identity: None }, Instant::now())
    }

    fn bounded(max_messages: usize, max_bytes: usize) -> (SubscriptionSender, Subscription) {
        subscription(SubscribeOptions { max_messages, max_bytes, ..SubscribeOptions::default() })
    }

    /// The first bytes of what waits, up to a limit.
    fn take(subscription: &mut Subscription, limit: usize) -> Vec<u8> {
        let mut batch = Vec::new();
        let _ = subscription.receive(&mut batch, limit).now_or_never();
        let first = |received: Received| match received.content {
            Content::Bare { payload, .. } => payload[0],
            other => panic!("{other:?}"),
        };
        batch.into_iter().map(first).collect()
    }

    #[test]
    fn what_is_kept_raises_the_bounds_until_it_is_read() {
        for (max_messages, max_bytes) in [(3, usize::MAX), (usize::MAX, 3 * SIZE)] {
            let (sender, mut subscription) = bounded(max_messages, max_bytes);
            assert!(sender.send_kept((0..10).map(message)));
            for number in 10..13 {
                sender.send(message(number));
            }
            assert_eq!(subscription.take_dropped(), 0);
            assert_eq!(take(&mut subscription, 6), [0, 1, 2, 3, 4, 5]);
            // Seven wait, and of what was kept four more may.
            sender.send(message(13));
            assert_eq!(subscription.take_dropped(), 1);
            assert_eq!(take(&mut subscription, 100), [7, 8, 9, 10, 11, 12, 13]);
            for number in 14..18 {
                sender.send(message(number));
            }
            assert_eq!(subscription.take_dropped(), 1, "the bounds are those of before");
            assert_eq!(take(&mut subscription, 100), [15, 16, 17]);
        }
    }

    #[test]
    fn what_others_lost_for_a_reader_counts() {
        let (sender, subscription) = bounded(3, usize::MAX);
        sender.note_lost(5);
        assert_eq!((subscription.take_dropped(), subscription.take_dropped()), (5, 0));
        drop(subscription);
        assert!(!sender.send_kept([message(1)]));
    }

    #[test]
    fn what_is_kept_is_bounded() {
        let (sender, mut subscription) = bounded(1, usize::MAX);
        sender.send_kept((0..MAX_KEPT_MESSAGES + 3).map(message));
        assert_eq!(subscription.take_dropped(), 2);
        assert_eq!(take(&mut subscription, usize::MAX).len(), MAX_KEPT_MESSAGES + 1);
    }

    /// A subscription with a sink, which notes the first bytes, what was lost, and its thread.
    type Noted = Arc<Mutex<Vec<(Vec<u8>, u64, thread::ThreadId)>>>;

    fn forwarding(
        max_messages: usize,
    ) -> (SubscriptionSender, impl Future<Output = ()> + Send, Noted) {
        let (sender, mut subscription) = bounded(max_messages, usize::MAX);
        let noted = Noted::default();
        let notes = Arc::clone(&noted);
        let sink = move |batch: &mut Vec<Received>, lost| {
            let first = batch.iter().map(|received| match &received.content {
                Content::Bare { payload, .. } => payload[0],
                other => panic!("{other:?}"),
            });
            notes.lock().push((first.collect(), lost, thread::current().id()));
        };
        (sender, async move { subscription.forward(2, Box::new(sink)).await }, noted)
    }

    #[test]
    fn a_sink_is_called_where_messages_are_put() {
        let (sender, forward, noted) = forwarding(3);
        let mut forward = Box::pin(forward);
        assert!((&mut forward).now_or_never().is_none());
        for number in 0..4 {
            assert!(sender.send(message(number)));
        }
        assert!((&mut forward).now_or_never().is_none());
        let other = thread::scope(|scope| {
            let flush = || {
                sender.put(message(4));
                sender.flush();
                thread::current().id()
            };
            scope.spawn(flush).join().unwrap()
        });
        let here = thread::current().id();
        let expected = [(vec![1, 2], 1, here), (vec![3], 0, here), (vec![4], 0, other)];
        assert_eq!(*noted.lock(), expected);
        sender.send(message(5));
        sender.close();
        assert!(forward.now_or_never().is_some());
        assert_eq!(noted.lock()[3], (vec![5], 0, here));
    }

    #[test]
    fn without_a_reader_a_sink_gets_nothing() {
        let (sender, forward, noted) = forwarding(3);
        let mut forward = Box::pin(forward);
        assert!((&mut forward).now_or_never().is_none());
        sender.put(message(1));
        drop(forward);
        sender.flush();
        assert!(noted.lock().is_empty() && !sender.put(message(2)));
    }

    #[test]
    fn a_sink_gets_messages_of_each_thread_in_order() {
        const EACH: u8 = 200;
        let (sender, forward, noted) = forwarding(10_000);
        let mut forward = Box::pin(forward);
        assert!((&mut forward).now_or_never().is_none());
        thread::scope(|scope| {
            for offset in [0_u8, 1] {
                let sender = &sender;
                scope.spawn(move || {
                    for number in 0..EACH / 2 {
                        sender.put(message(usize::from(2 * number + offset)));
                        sender.flush();
                    }
                });
            }
        });
        let noted = noted.lock();
        let all: Vec<u8> = noted.iter().flat_map(|(numbers, ..)| numbers.iter().copied()).collect();
        for offset in [0, 1] {
            let of_thread: Vec<u8> = all.iter().copied().filter(|it| it % 2 == offset).collect();
            assert_eq!(of_thread, (0..EACH).filter(|it| it % 2 == offset).collect::<Vec<u8>>());
        }
    }

    #[test]
    fn a_panic_of_a_sink_ends_in_the_task_of_the_reader() {
        let (sender, mut subscription) = bounded(10, usize::MAX);
        let sink = |batch: &mut Vec<Received>, _| assert!(batch.is_empty(), "as it is meant to");
        let mut forward = Box::pin(subscription.forward(2, Box::new(sink)));
        assert!((&mut forward).now_or_never().is_none());
        sender.put(message(1));
        sender.flush();
        assert!(catch_unwind(AssertUnwindSafe(|| forward.now_or_never())).is_err());
    }

    #[test]
    fn where_much_waits_the_thread_that_brings_it_goes_on() {
        let (sender, forward, noted) = forwarding(10_000);
        let mut forward = Box::pin(forward);
        assert!((&mut forward).now_or_never().is_none());
        for number in 0..=MAX_INLINE {
            sender.put(message(number));
        }
        sender.flush();
        assert!(noted.lock().is_empty());
        assert!((&mut forward).now_or_never().is_none());
        let count = noted.lock().iter().map(|(batch, ..)| batch.len()).sum::<usize>();
        assert_eq!(count, MAX_INLINE + 1);
    }
}
