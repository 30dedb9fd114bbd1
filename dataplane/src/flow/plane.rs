//! The message path and the link of one flow behind one lock.
//!
//! Source tasks, the transport's reader threads and the pacer take the lock once per batch or datagram and never while
//! they wait. What the link has to say to the control core is put into a bounded inbox.

use std::collections::VecDeque;
use std::sync::{Arc, OnceLock, Weak};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use blaze_brokers::Received;
use blaze_domain::{DropReason, FlowId, MAX_PAYLOAD_BYTES, Priority, Scope};
use blaze_proto::link::link_control::Body;
use parking_lot::{Condvar, Mutex};
use tokio::sync::Notify;

use crate::codec::pool::{CodecPool, Completion, Job, Urgency};
use crate::codec::{Compressed, lz4, processor_time};
use crate::lane::core::{DataCore, LaneLink};
use crate::lane::load::Loads;
use crate::lane::press::{PressJob, PressWork, Pressed};
use crate::lane::path::TopicId;
use crate::link::transport::{Endpoint, TransportEvent};
use crate::link::{Engine, LaneId, LinkEvent, Submit, Transmit};

/// Link events that wait for the control core; Hellos and registry messages beyond it are dropped and repaired by the
/// next digest.
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

/// Message path and link, without a lock: what the simulated network drives too.
pub struct PlaneState {
    /// Topics, bridges, duplicate windows.
    pub core: DataCore,
    /// The inter scope; absent where the node has none.
    pub engine: Option<Engine>,
}

/// A flow without an inter scope: nothing can be sent.
struct NoLink;

impl LaneLink for NoLink {
    fn submit(&mut self, _now: Instant, _message: Submit<'_>) -> Result<(), DropReason> {
        Err(DropReason::LinkDown)
    }
    fn queued(&self, _lane: LaneId) -> u64 {
        0
    }
    fn drop_lane(&mut self, _lane: LaneId) -> u64 {
        0
    }
    fn is_suspect(&self, _to: &FlowId) -> bool {
        true
    }
    fn answers(&self, _to: &FlowId) -> bool {
        false
    }
    fn has_room(&self, _to: &FlowId, _class: Priority, _bytes: usize) -> bool {
        true
    }
    fn tell(&mut self, _now: Instant, _to: &FlowId, _body: Body) -> bool {
        false
    }
}

impl PlaneState {
    /// Takes a batch from a local scope.
    pub fn ingest(&mut self, now: Instant, wall_ns: u64, topic: TopicId, from: Scope, batch: &mut Vec<Received>) {
        match &mut self.engine {
            Some(engine) => self.core.ingest(now, wall_ns, topic, from, batch, engine),
            None => self.core.ingest(now, wall_ns, topic, from, batch, &mut NoLink),
        }
    }

    /// Takes what became of a job of the pool.
    pub fn pressed(&mut self, now: Instant, job: PressJob, pressed: Pressed) {
        match &mut self.engine {
            Some(engine) => self.core.pressed(now, job, pressed, engine),
            None => self.core.pressed(now, job, pressed, &mut NoLink),
        }
    }

    /// Takes a sample of what every bridge carries; to be called once a second.
    pub fn measure(&mut self, now: Instant) -> Loads {
        match &self.engine {
            Some(engine) => self.core.measure(now, engine),
            None => self.core.measure(now, &NoLink),
        }
    }

    /// Delivers what waited for the bridges of a topic.
    pub fn deliver_waiting(&mut self, now: Instant, topic: TopicId) {
        match &mut self.engine {
            Some(engine) => self.core.deliver_waiting(now, topic, engine),
            None => self.core.deliver_waiting(now, topic, &mut NoLink),
        }
    }

    /// Carries out what the link has decided; what concerns the control core goes to `news`.
    pub fn pump(&mut self, now: Instant, mut news: impl FnMut(LinkEvent)) {
        let Some(engine) = &mut self.engine else { return };
        while let Some(event) = engine.poll_event() {
            match event {
                LinkEvent::Deliver { frame, .. } => self.core.deliver(now, frame, engine),
                LinkEvent::LaneSent { lane, bytes, wait } => self.core.lane_sent(now, lane, bytes as u64, wait),
                LinkEvent::LaneOut {
                    lane, messages, bytes, ..
                } => self.core.lane_out(lane, messages, bytes as u64),
                LinkEvent::LaneDropped {
                    lane, reason, messages, ..
                } => self.core.lane_dropped(lane, reason, messages),
                LinkEvent::ReceiverDropped {
                    topic,
                    reason,
                    messages,
                } => {
                    self.core.receiver_dropped(&topic, reason, messages);
                }
                LinkEvent::WrittenAsked { from, topic, token } => {
                    self.core.written_asked(now, from, topic, token, engine);
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
        let Some(engine) = &mut self.engine else {
            return self.core.drain(now, &mut NoLink);
        };
        if engine.next_timeout().is_some_and(|due| due <= now) {
            engine.handle_timeout(now);
        }
        let drained = self.core.drain(now, engine);
        match (drained, engine.next_timeout()) {
            (Some(a), Some(b)) => Some(a.min(b)),
            (a, b) => a.or(b),
        }
    }
}

/// Message path and link of one flow.
pub struct Plane {
    /// Itself, for jobs of the pool.
    this: Weak<Self>,
    codec: OnceLock<CodecPool>,
    state: Mutex<PlaneState>,
    /// The pacer waits here while it has nothing to send.
    work: Condvar,
    news: Mutex<VecDeque<News>>,
    news_dropped: AtomicU64,
    news_waits: Notify,
}

impl Plane {
    /// Puts a message path and a link behind their lock.
    #[must_use]
    pub fn new(core: DataCore, engine: Option<Engine>) -> Arc<Self> {
        Arc::new_cyclic(|this| Self {
            this: Weak::clone(this),
            codec: OnceLock::new(),
            state: Mutex::new(PlaneState { core, engine }),
            work: Condvar::new(),
            news: Mutex::default(),
            news_dropped: AtomicU64::new(0),
            news_waits: Notify::new(),
        })
    }

    /// Does something under the lock, carries out what the link then wants, and wakes the pacer.
    pub fn with<R>(&self, action: impl FnOnce(&mut PlaneState) -> R) -> R {
        let (result, told, jobs) = {
            let mut state = self.state.lock();
            let result = action(&mut state);
            // Told under the lock: who is up and who is down must reach the control core in the order of its happening.
            let mut told = false;
            state.pump(Instant::now(), |event| {
                told = true;
                self.tell(event);
            });
            (result, told, state.core.take_press_jobs())
        };
        self.give_to_pool(jobs);
        self.work.notify_one();
        if told {
            self.news_waits.notify_one();
        }
        result
    }

    /// Payloads are compressed from now on, by this pool.
    pub fn compress_with(&self, pool: CodecPool) {
        if self.codec.set(pool).is_ok() {
            self.state.lock().core.enable_compression();
        }
    }

    /// The pool, if there is one.
    pub fn codec(&self) -> Option<&CodecPool> {
        self.codec.get()
    }

    /// Called without the lock: a job that is not taken comes back at once.
    fn give_to_pool(&self, jobs: Vec<PressJob>) {
        for job in jobs {
            let (ticket, work, payload) = (job.ticket(), job.work, job.payload.clone());
            let plane = Weak::clone(&self.this);
            let told = Weak::clone(&self.this);
            let done = Completion::new(move |pressed: Option<Pressed>| {
                if let Some(plane) = told.upgrade() {
                    plane.pressed(job, pressed.unwrap_or(Pressed::NotDone));
                }
            });
            let (urgency, bytes) = match work {
                PressWork::Compress(_) => (Urgency::Compress, payload.len()),
                PressWork::Decompress(announced) => {
                    let result = usize::try_from(announced).unwrap_or(usize::MAX).min(MAX_PAYLOAD_BYTES);
                    (Urgency::Decompress, payload.len() + result)
                }
            };
            let run = move || {
                let wanted = plane.upgrade().is_some_and(|plane| plane.read(|state| state.core.begins(ticket)));
                if wanted {
                    done.give(press(&payload, work));
                }
            };
            if let Some(pool) = self.codec.get()
                && let Err((job, _)) = pool.submit(Job::new(urgency, bytes, run))
            {
                drop(job);
            }
        }
    }

    fn pressed(&self, job: PressJob, pressed: Pressed) {
        self.with(|state| state.pressed(Instant::now(), job, pressed));
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

    /// The next datagram to send, or how long there is nothing to do (at most `idle`). Waits that long.
    pub fn next_transmit(&self, idle: Duration) -> Option<Transmit> {
        self.transmit(idle, Engine::poll_transmit)
    }

    /// The next datagram that carries no message; for a pacer in debt. Does not wait.
    pub fn next_control(&self) -> Option<Transmit> {
        self.transmit(Duration::ZERO, Engine::poll_control)
    }

    fn transmit(&self, idle: Duration, next: impl Fn(&mut Engine, Instant) -> Option<Transmit>) -> Option<Transmit> {
        let mut told = false;
        let (transmit, jobs) = {
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
            if transmit.is_none() && !told && !idle.is_zero() && !state.core.has_press_jobs() {
                let paced = state.engine.as_ref().and_then(Engine::paced_until);
                let until = [due, paced].into_iter().flatten().fold(now + idle, Instant::min);
                self.work.wait_until(&mut state, until);
            }
            (transmit, state.core.take_press_jobs())
        };
        self.give_to_pool(jobs);
        if told {
            self.news_waits.notify_one();
        }
        transmit
    }

    /// Wakes the pacer.
    pub fn wake(&self) {
        self.work.notify_all();
    }

    /// What the link has to say to the control core since the last call.
    pub fn take_news(&self) -> Vec<News> {
        self.news.lock().drain(..).collect()
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
        self.with(|state| {
            state
                .engine
                .as_mut()
                .map(|engine| engine.restart(Instant::now(), epoch))
        });
        self.push(News::Rebuilt(epoch));
    }

    /// The link knows nobody any more.
    pub fn drop_peers(&self) {
        self.with(|state| state.engine.as_mut().map(|engine| engine.leave(Instant::now())));
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

    /// Puts an event into the inbox. Called with the state locked; the inbox is never locked the other way round.
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

/// Does what is to be done with a payload.
fn press(payload: &bytes::Bytes, work: PressWork) -> Pressed {
    match work {
        PressWork::Compress(level) => {
            let (began, began_on_processor) = (Instant::now(), processor_time());
            let block = lz4::compress(payload, level);
            Pressed::Compressed(Compressed {
                block,
                level,
                before: payload.len(),
                processor: processor_time().saturating_sub(began_on_processor),
                taken: began.elapsed(),
            })
        }
        PressWork::Decompress(announced) => match lz4::decompress(payload, announced, MAX_PAYLOAD_BYTES) {
            Ok(payload) => Pressed::Decompressed(payload),
            Err(_) => Pressed::Refused,
        },
    }
}
