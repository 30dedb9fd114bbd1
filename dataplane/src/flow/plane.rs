//! The message path and the link of one flow behind one lock.
//!
//! Source tasks, the transport's reader threads and the pacer take the lock once per batch or
//! datagram and never while they wait. Who has brought something then lets out what may leave, so
//! that nobody else is woken for it. What the link has to say to the control core is put into a
//! bounded inbox. A thread of the compression pool takes it twice for each of its jobs, to see what
//! is to be done and to say what came of it, and not in between.

use std::collections::VecDeque;
use std::io;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock, Weak};
use std::thread::{self, Thread};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use blaze_brokers::Received;
use blaze_domain::Scope;
use blaze_proto::Frame;
use parking_lot::Mutex;
use tokio::sync::Notify;

use crate::codec::pool::{CodecPool, Spawner, Urgency};
use crate::codec::{Done, Work, guarded};
use crate::lane::compress_stage::{CodecJob, CodecTicket, PoolRequests};
use crate::lane::core::DataCore;
use crate::lane::load::Loads;
use crate::lane::path::TopicId;
use crate::link::transport::{Endpoint, TransportEvent};
use crate::link::{Engine, LinkEvent, Transmit};

#[cfg(test)]
mod tests;

/// Link events that wait for the control core; Hellos and registry messages beyond it are dropped
/// and repaired by the next digest.
const MAX_NEWS: usize = 10_000;

/// What the control task is told.
#[derive(Debug)]
pub enum News {
    /// Something happened on the link.
    Link(Box<LinkEvent>),
    /// An endpoint was found: writers to it are to be made.
    Discovered(Endpoint),
    /// The transport was built anew: the flow has this new epoch on the link.
    Rebuilt(u64),
    /// The inter scope was joined, and works.
    Joined,
    /// The inter scope has not worked for a while.
    Lost,
    /// The inter scope was left.
    Left,
}

/// Nanoseconds since 1970.
#[must_use]
pub fn wall_ns() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)
}

/// Milliseconds since 1970.
#[must_use]
pub fn wall_ms() -> u64 {
    wall_ns() / 1_000_000
}

/// What [`Plane::next_transmit`] has found.
#[derive(Debug)]
pub enum Next {
    /// A datagram to send.
    Datagram(Transmit),
    /// Nothing may be sent now.
    Nothing {
        /// When there is something to do again, as far as that is known.
        due: Option<Instant>,
        /// Something waits, but the budget of its link does not let it out yet.
        is_held_back: bool,
    },
}

/// Message path and link, without a lock: what the simulated network drives too.
pub struct PlaneState {
    /// Topics, bridges, duplicate windows.
    pub core: DataCore,
    /// The inter scope; absent where the node has none.
    pub engine: Option<Engine>,
}

impl PlaneState {
    /// Takes a batch from a local scope.
    pub fn ingest(
        &mut self,
        now: Instant,
        wall_ns: u64,
        topic: TopicId,
        from: Scope,
        batch: &mut Vec<Received>,
    ) {
        self.core.ingest(now, wall_ns, topic, from, batch, &mut self.engine);
    }

    /// Sends a request of this flow to a service.
    pub fn send_call(&mut self, now: Instant, wall_ns: u64, request: Frame) {
        self.core.send_call(now, wall_ns, request, &mut self.engine);
    }

    /// Sends the reply of an own server to the flow of the call.
    pub fn answer_call(&mut self, now: Instant, reply: Frame) {
        self.core.answer_call(now, reply, &mut self.engine);
    }

    /// A pool thread takes the next job.
    pub fn begin(&mut self, now: Instant, urgency: Urgency) -> Option<CodecJob> {
        self.core.begin(now, urgency, &mut self.engine)
    }

    /// Takes the result of a job.
    pub fn finished(&mut self, now: Instant, ticket: CodecTicket, done: Done) {
        self.core.finished(now, ticket, done, &mut self.engine);
    }

    /// There is no pool any more.
    pub fn stop_compression(&mut self, now: Instant) {
        self.core.stop_compression(now, &mut self.engine);
    }

    /// Takes a sample of what every bridge carries; to be called once a second.
    pub fn measure(&mut self, now: Instant) -> Loads {
        self.core.measure(now, &self.engine)
    }

    /// Delivers what waited for the bridges of a topic.
    pub fn deliver_waiting(&mut self, now: Instant, topic: TopicId) {
        self.core.deliver_waiting(now, topic, &mut self.engine);
    }

    /// Carries out what the link has decided; what concerns the control core goes to `news`.
    pub fn pump(&mut self, now: Instant, mut news: impl FnMut(LinkEvent)) {
        while let Some(event) = self.engine.as_mut().and_then(Engine::poll_event) {
            match event {
                LinkEvent::Deliver { frame, .. } => self.core.deliver(now, frame, &mut self.engine),
                LinkEvent::LaneSent { lane, bytes, wait } => {
                    self.core.lane_sent(now, lane, bytes as u64, wait);
                }
                LinkEvent::LaneOut { lane, bytes } => self.core.lane_out(lane, 1, bytes as u64),
                LinkEvent::LaneCut { lane, begun } => self.core.lane_cut(lane, begun),
                LinkEvent::LaneDropped { lane, reason } => self.core.lane_dropped(lane, reason, 1),
                LinkEvent::ReceiverDropped { topic, reason, messages } => {
                    self.core.receiver_dropped(&topic, reason, messages);
                }
                LinkEvent::WrittenAsked { from, topic, token } => {
                    self.core.written_asked(now, from, topic, token, &mut self.engine);
                }
                LinkEvent::Written { from, token } => self.core.written(&from, token),
                other => {
                    if !matches!(other, LinkEvent::Hello { .. } | LinkEvent::Control { .. }) {
                        self.core.stir();
                    }
                    news(other);
                }
            }
        }
    }

    /// Does what is due, and returns when it wants to be called again.
    pub fn run_timers(&mut self, now: Instant) -> Option<Instant> {
        if let Some(engine) = &mut self.engine
            && engine.next_timeout().is_some_and(|due| due <= now)
        {
            engine.handle_timeout(now);
        }
        self.core.look_for_types(now);
        let drained = self.core.drain(now, &mut self.engine);
        let timeout = self.engine.as_ref().and_then(Engine::next_timeout);
        drained.into_iter().chain(timeout).min()
    }
}

/// Sends what may leave now. Returns whether somebody must look at the rest before long.
pub type Outlet = Box<dyn Fn(&Plane) -> bool + Send + Sync>;

/// What a thread does with a payload.
type Run = fn(&Work, &[u8]) -> Done;

/// The threads that compress.
struct Codec {
    pool: CodecPool,
    run: Run,
}

/// Message path and link of one flow.
pub struct Plane {
    /// Itself, for the threads of the pool.
    this: Weak<Self>,
    codec: OnceLock<Codec>,
    state: Mutex<PlaneState>,
    outlet: OnceLock<Outlet>,
    /// The thread that sends what could not leave at once.
    pacer: OnceLock<Thread>,
    news: Mutex<VecDeque<News>>,
    news_dropped: AtomicU64,
    news_waits: Notify,
    /// The task that answers calls waits here.
    calls_wait: Notify,
}

impl Plane {
    /// Puts a message path and a link behind their lock.
    #[must_use]
    pub fn new(core: DataCore, engine: Option<Engine>) -> Arc<Self> {
        Arc::new_cyclic(|this| Self {
            this: Weak::clone(this),
            codec: OnceLock::new(),
            state: Mutex::new(PlaneState { core, engine }),
            outlet: OnceLock::new(),
            pacer: OnceLock::new(),
            news: Mutex::default(),
            news_dropped: AtomicU64::new(0),
            news_waits: Notify::new(),
            calls_wait: Notify::new(),
        })
    }

    /// Does something under the lock, carries out what the link then wants, and sends what may
    /// leave.
    pub fn with<R>(&self, action: impl FnOnce(&mut PlaneState) -> R) -> R {
        let (result, requests) = self.locked(action);
        self.hand_out(requests);
        self.let_out();
        result
    }

    /// What is to be sent leaves by this from now on.
    pub fn send_by(&self, outlet: Outlet) {
        let _ = self.outlet.set(outlet);
    }

    /// The calling thread sends what cannot leave at once, and what is due later: it is unparked
    /// for that.
    pub fn pace_by_this_thread(&self) {
        let _ = self.pacer.set(thread::current());
    }

    /// Sends what may leave now; the pacer sees to the rest.
    fn let_out(&self) {
        if self.outlet.get().is_some_and(|send| send(self)) {
            self.wake();
        }
    }

    /// The same for the link, where the flow has one.
    pub fn link<R>(&self, action: impl FnOnce(&mut Engine) -> R) -> Option<R> {
        self.with(|state| state.engine.as_mut().map(action))
    }

    /// As [`Plane::with`]; requests to the pool are left to the caller.
    fn locked<R>(&self, action: impl FnOnce(&mut PlaneState) -> R) -> (R, PoolRequests) {
        let (result, told, requests) = {
            let mut state = self.state.lock();
            let result = action(&mut state);
            // Told under the lock: who is up and who is down must reach the control core in the
            // order of its happening.
            let mut told = false;
            state.pump(Instant::now(), |event| {
                told = true;
                self.tell(event);
            });
            told |= self.tell_calls(&state);
            (result, told, state.core.take_pool_requests())
        };
        if told {
            self.news_waits.notify_one();
        }
        (result, requests)
    }

    /// Payloads are compressed from now on, by so many threads.
    ///
    /// # Errors
    /// That of the spawner.
    pub fn compress_with(&self, threads: usize, spawner: Spawner) -> io::Result<()> {
        self.compress_by(threads, spawner, Work::run)
    }

    fn compress_by(&self, threads: usize, spawner: Spawner, run: Run) -> io::Result<()> {
        let plane = Weak::clone(&self.this);
        let pool = CodecPool::start(threads, spawner, move |urgency| {
            if let Some(plane) = plane.upgrade() {
                let requests = plane.run_job(|state| state.begin(Instant::now(), urgency));
                plane.hand_out(requests);
                plane.let_out();
            }
        })?;
        if self.codec.set(Codec { pool, run }).is_ok() {
            self.state.lock().core.enable_compression();
        }
        Ok(())
    }

    /// The pool, if there is one.
    pub fn codec(&self) -> Option<&CodecPool> {
        self.codec.get().map(|codec| &codec.pool)
    }

    /// Ends the threads that compress, each after the payload that it is at. What waits for them is
    /// dropped; what comes after goes as it is.
    pub fn stop_compression(&self) {
        if let Some(codec) = self.codec.get() {
            codec.pool.stop();
            self.with(|state| state.stop_compression(Instant::now()));
        }
    }

    /// Runs one job; the codec works without the lock. A panic of the codec ends there; one of the
    /// message path ends the thread, and with it the process. Returns the requests that follow.
    fn run_job(&self, begin: impl FnOnce(&mut PlaneState) -> Option<CodecJob>) -> PoolRequests {
        let Some(codec) = self.codec.get() else {
            return PoolRequests::default();
        };
        let (job, mut requests) = self.locked(begin);
        if let Some(CodecJob { ticket, payload, work }) = job {
            let done = guarded(|| (codec.run)(&work, &payload));
            let ((), more) = self.locked(|state| state.finished(Instant::now(), ticket, done));
            requests += more;
        }
        requests
    }

    /// Passes requests to the pool, and runs those for the caller. Called without the lock.
    fn hand_out(&self, mut requests: PoolRequests) {
        while requests != PoolRequests::default() {
            if let Some(codec) = self.codec.get() {
                codec.pool.offer(requests.quick, requests.long);
            }
            let mut more = PoolRequests::default();
            for _ in 0..requests.by_caller {
                more += self.run_job(|state| state.core.begin_by_caller());
            }
            requests = more;
        }
    }

    /// Looks at the state without changing what the link does.
    pub fn read<R>(&self, look: impl FnOnce(&mut PlaneState) -> R) -> R {
        look(&mut self.state.lock())
    }

    /// Takes a batch from a local scope.
    pub fn ingest(&self, topic: TopicId, from: Scope, batch: &mut Vec<Received>) {
        self.with(|state| state.ingest(Instant::now(), wall_ns(), topic, from, batch));
    }

    /// Takes what the transport found.
    pub fn transport_event(&self, event: TransportEvent) {
        let told = self.with(|state| {
            let Some(engine) = &mut state.engine else { return false };
            let now = Instant::now();
            let news = match event {
                // One that is refused (an older life, no room) gets no writers.
                TransportEvent::Discovered(endpoint) => engine
                    .peer_discovered(now, endpoint.clone())
                    .then_some(News::Discovered(endpoint)),
                TransportEvent::Lost(endpoint) => {
                    engine.peer_lost(now, &endpoint);
                    None
                }
                TransportEvent::Received { class, datagram } => {
                    engine.receive(now, datagram, class);
                    None
                }
                TransportEvent::Rebuilt { epoch } => {
                    engine.restart(now, epoch);
                    Some(News::Rebuilt(epoch))
                }
            };
            let told = news.is_some();
            self.news.lock().extend(news);
            told
        });
        if told {
            self.news_waits.notify_one();
        }
    }

    /// The next datagram to send.
    pub fn next_transmit(&self) -> Next {
        self.transmit(Engine::poll_transmit)
    }

    /// The next datagram that carries no message; for a pacer in debt.
    pub fn next_control(&self) -> Next {
        self.transmit(Engine::poll_control)
    }

    fn transmit(&self, next: impl Fn(&mut Engine, Instant) -> Option<Transmit>) -> Next {
        loop {
            let mut told = false;
            let (next, requests) = {
                let mut state = self.state.lock();
                let now = Instant::now();
                let due = state.run_timers(now);
                let mut tell = |event| {
                    told = true;
                    self.tell(event);
                };
                state.pump(now, &mut tell);
                let transmit = state.engine.as_mut().and_then(|engine| next(engine, now));
                state.pump(now, &mut tell);
                told |= self.tell_calls(&state);
                let paced = state.engine.as_ref().and_then(Engine::paced_until);
                let next = transmit.map_or_else(
                    || Next::Nothing {
                        due: due.into_iter().chain(paced).min(),
                        is_held_back: paced.is_some(),
                    },
                    Next::Datagram,
                );
                (next, state.core.take_pool_requests())
            };
            if told {
                self.news_waits.notify_one();
            }
            let is_over = requests == PoolRequests::default();
            self.hand_out(requests);
            // What the caller did for the pool may be sent, too.
            if is_over || matches!(next, Next::Datagram(_)) {
                return next;
            }
        }
    }

    /// Wakes the pacer.
    pub fn wake(&self) {
        if let Some(pacer) = self.pacer.get() {
            pacer.unpark();
        }
    }

    /// What the link has to say to the control core since the last call.
    pub fn take_news(&self) -> Vec<News> {
        self.news.lock().drain(..).collect()
    }

    /// Whether replies to calls have arrived; answers of own servers go to their task.
    fn tell_calls(&self, state: &PlaneState) -> bool {
        let (has_arrived, has_answers) = state.core.call_news();
        if has_answers {
            self.calls_wait.notify_one();
        }
        has_arrived
    }

    /// Waits until own servers have answered calls.
    pub async fn call_answers(&self) {
        self.calls_wait.notified().await;
    }

    /// Waits until there is something for [`Plane::take_news`].
    pub async fn news(&self) {
        self.news_waits.notified().await;
    }

    /// Puts news behind what the link has told before.
    pub fn push(&self, news: News) {
        self.news.lock().push_back(news);
        self.news_waits.notify_one();
    }

    /// The flow has a new life on the link, without any peer.
    pub fn begin_life(&self, epoch: u64) {
        self.link(|engine| engine.restart(Instant::now(), epoch));
        self.push(News::Rebuilt(epoch));
    }

    /// The link knows nobody any more.
    pub fn drop_peers(&self) {
        self.link(|engine| engine.leave(Instant::now()));
    }

    /// The link says good-bye to everybody.
    pub fn say_goodbye(&self) {
        self.link(Engine::goodbye);
    }

    /// Whether bridges still empty their queues.
    pub fn is_draining(&self) -> bool {
        self.with(|state| {
            state.run_timers(Instant::now());
            state.core.is_draining()
        })
    }

    /// Whether something that came over the link still waits for a broker.
    pub fn has_unwritten(&self) -> bool {
        self.with(|state| {
            state.run_timers(Instant::now());
            state.core.has_unwritten()
        })
    }

    /// Something else has news for the control task.
    pub fn nudge(&self) {
        self.news_waits.notify_one();
    }

    /// Link events that were dropped because the control core was slow.
    #[must_use]
    pub fn news_dropped(&self) -> u64 {
        self.news_dropped.load(Ordering::Relaxed)
    }

    /// Puts an event into the inbox. Called with the state locked; the inbox is never locked the
    /// other way round.
    fn tell(&self, event: LinkEvent) {
        let mut news = self.news.lock();
        // Who is there and who is not must not be lost; what peers repeat may be.
        let repeated = matches!(event, LinkEvent::Hello { .. } | LinkEvent::Control { .. });
        if repeated && news.len() >= MAX_NEWS {
            self.news_dropped.fetch_add(1, Ordering::Relaxed);
            return;
        }
        news.push_back(News::Link(Box::new(event)));
    }
}
