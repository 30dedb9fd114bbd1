//! The thread that owns the participant of a transport: it makes writers, watches over RustDDS and
//! builds it anew.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::net::{IpAddr, Ipv4Addr};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::Receiver;
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use blaze_brokers::dds::{
    DdsError, EndpointWatch, FoundEndpoint, GuidPrefix, Illness, Participant, ParticipantConfig,
    Pulse, Reader, Writer, lay_aside,
};
use blaze_domain::Priority;

use super::{CLASSES, MAX_HEARD, Shared, TOPIC_PREFIX, parse_topic, profile, topic};
use crate::link::namesakes::Life;
use crate::link::transport::{Endpoint, TransportEvent};

const TICK: Duration = Duration::from_millis(200);
/// Hello comes every 500 ms.
const LIVE: Duration = Duration::from_millis(1200);
const GOOD_BYE: Duration = Duration::from_secs(1);
const RETRY: Duration = Duration::from_secs(1);
/// How long a new writer is waited for at most; RustDDS matches it within some milliseconds.
const MATCH: Duration = Duration::from_millis(100);
/// How long writers are made until the rest is looked at again: health, and the end.
const MAKE: Duration = Duration::from_secs(1);
const COUNT: Duration = Duration::from_secs(1);

pub(super) fn start(shared: Arc<Shared>) -> Result<JoinHandle<()>, DdsError> {
    thread::Builder::new()
        .name("dds-lifecycle".into())
        .spawn(move || Lifecycle::new(shared).run())
        .map_err(|error| DdsError::Create { what: "thread", error: error.to_string() })
}

/// One life of the participant. Fields drop in this order: users first, the participant last.
struct Generation {
    watch: EndpointWatch,
    readers: Vec<Reader>,
    pulse: Pulse,
    participant: Participant,
}

struct Lifecycle {
    shared: Arc<Shared>,
    local: Endpoint,
    generation: Option<Generation>,
    next_attempt: Instant,
    /// When the last participant was built.
    built: Instant,
    /// Whether a participant ran before, so that the next one is a new life.
    had_life: bool,
    /// When the kernel's drops are counted next.
    next_count: Instant,
    /// What the kernel dropped at the sockets of earlier participants.
    dropped_before: u64,
}

impl Lifecycle {
    fn new(shared: Arc<Shared>) -> Self {
        let now = Instant::now();
        Self {
            local: shared.config.local.clone(),
            shared,
            generation: None,
            next_attempt: now,
            built: now,
            had_life: false,
            next_count: now,
            dropped_before: 0,
        }
    }

    fn run(mut self) {
        while !self.shared.stop.load(Ordering::Relaxed) {
            // A panic of RustDDS in this thread is one more way of its death.
            if catch_unwind(AssertUnwindSafe(|| self.tick())).is_err() {
                self.bury("RustDDS panicked in a call");
            }
            thread::park_timeout(TICK);
        }
        // Others are told of the end, unless RustDDS hangs.
        if let Some(done) = self.lay_aside() {
            let _ = done.recv_timeout(GOOD_BYE);
        }
    }

    fn tick(&mut self) {
        let now = Instant::now();
        if let Some(illness) = self.generation.as_mut().and_then(Generation::illness) {
            self.bury(&illness.to_string());
        } else if self.generation.as_ref().is_some_and(Generation::has_missed_one) {
            self.bury("a participant came back after it was lost");
        }
        if self.generation.is_none() && now >= self.next_attempt {
            self.give_birth(now);
        }
        self.shared.discarded.lock().clear();
        self.make_writers();
        self.tell_relay(now);
        if now >= self.next_count {
            self.next_count = now + COUNT;
            self.count_drops();
        }
        #[cfg(test)]
        if let Some(fault) = self.shared.fault.lock().take()
            && let Some(generation) = &self.generation
        {
            generation.participant.inject(fault).ok();
        }
    }

    /// Puts a dead participant aside.
    fn bury(&mut self, reason: &str) {
        tracing::error!(flow = %self.local, reason, "DDS participant ended, building a new one");
        // What came since the last look is not counted.
        self.dropped_before = self.shared.status.lock().dropped_by_kernel;
        self.lay_aside();
        self.shared.homes.lock().clear();
        self.shared.namesakes.lock().clear();
        self.shared.heard.lock().clear();
        {
            let mut status = self.shared.status.lock();
            status.ready = false;
            status.watched = false;
            status.endpoints = 0;
            reason.clone_into(&mut status.detail);
        }
        // One that dies at once is not built in a tight circle.
        self.next_attempt = self.built + RETRY;
    }

    /// Drops the participant and all that belongs to it.
    fn lay_aside(&mut self) -> Option<Receiver<()>> {
        let writers: Vec<_> = self.shared.writers.write().drain().collect();
        let discarded = std::mem::take(&mut *self.shared.discarded.lock());
        let shared = Arc::clone(&self.shared);
        shared.remains.fetch_add(1, Ordering::Relaxed);
        lay_aside((writers, discarded, self.generation.take()), move || {
            shared.remains.fetch_sub(1, Ordering::Relaxed);
        })
    }

    fn give_birth(&mut self, now: Instant) {
        if self.had_life {
            self.local.epoch = (self.shared.config.next_epoch)();
        }
        match Generation::start(&self.shared, &self.local) {
            Ok(generation) => {
                self.shared.own.lock().endpoint = self.local.clone();
                self.shared.relay.set_participant(generation.participant.prefix());
                tracing::info!(
                    flow = %self.local,
                    participant = ?generation.participant,
                    "DDS participant started",
                );
                let filter_weakness = generation.participant.filter_weakness();
                self.generation = Some(generation);
                self.built = now;
                let mut status = self.shared.status.lock();
                status.ready = true;
                status.detail = filter_weakness.unwrap_or_default();
                if self.had_life {
                    status.rebuilds += 1;
                }
                drop(status);
                if self.had_life {
                    (self.shared.config.sink)(TransportEvent::Rebuilt { epoch: self.local.epoch });
                }
                self.had_life = true;
            }
            Err(error) => {
                tracing::warn!(
                    flow = %self.local,
                    %error,
                    "DDS participant cannot start, trying again",
                );
                self.shared.status.lock().detail = error.to_string();
                self.next_attempt = now + RETRY;
            }
        }
    }

    fn count_drops(&self) {
        if let Some(generation) = &self.generation {
            let dropped = self.dropped_before + generation.participant.dropped_by_kernel();
            self.shared.status.lock().dropped_by_kernel = dropped;
        }
    }

    /// Makes the writers that are wanted and missing, as far as the time of one turn goes.
    fn make_writers(&mut self) {
        let Some(generation) = &self.generation else { return };
        let missing: Vec<(Endpoint, Priority)> = {
            let wanted = self.shared.wanted.lock();
            let writers = self.shared.writers.read();
            let is_missing = |endpoint: &Endpoint, class: Priority| {
                writers.get(endpoint).is_none_or(|slots| slots[class as usize].is_none())
            };
            let classes = |(endpoint, flags): (&Endpoint, &[bool; CLASSES])| {
                let missing = Priority::ALL
                    .iter()
                    .filter(|class| flags[**class as usize] && is_missing(endpoint, **class));
                missing.map(|class| (endpoint.clone(), *class)).collect::<Vec<_>>()
            };
            wanted.iter().flat_map(classes).collect()
        };
        let until = Instant::now() + MAKE;
        for (endpoint, class) in missing {
            if self.shared.stop.load(Ordering::Relaxed) || Instant::now() >= until {
                return;
            }
            let room = profile(class, self.shared.wire.max_datagram_bytes());
            match generation.participant.writer(&topic(&endpoint, class), room) {
                Ok(writer) => {
                    wait_matched(&writer);
                    // It may have been disconnected meanwhile.
                    let wanted = self.shared.wanted.lock();
                    if wanted.get(&endpoint).is_some_and(|flags| flags[class as usize]) {
                        let mut writers = self.shared.writers.write();
                        writers.entry(endpoint).or_default()[class as usize] =
                            Some(Arc::new(writer));
                    }
                }
                Err(error) => {
                    tracing::warn!(%endpoint, %class, %error, "no writer");
                    return;
                }
            }
        }
    }

    /// Tells the relay which hosts answer.
    fn tell_relay(&self, now: Instant) {
        let homes = self.shared.homes.lock();
        let heard = self.shared.heard.lock();
        let live: HashSet<Ipv4Addr> = heard
            .iter()
            .filter(|(_, at)| now.duration_since(**at) < LIVE)
            .filter_map(|(participant, _)| homes.get(participant))
            .flatten()
            .copied()
            .collect();
        drop((homes, heard));
        self.shared.relay.set_live(live);
        if let Some(generation) = &self.generation {
            let mut status = self.shared.status.lock();
            status.malformed = generation.readers.iter().map(Reader::malformed).sum();
            status.watched = generation.pulse.is_felt();
        }
    }
}

impl Generation {
    fn start(shared: &Arc<Shared>, local: &Endpoint) -> Result<Self, DdsError> {
        let participant = Participant::start(ParticipantConfig {
            largest_sample: shared.wire.largest_sample(),
            ..ParticipantConfig::new(shared.config.domain, shared.address)
        })?;
        let pulse = Pulse::start(&participant)?;
        let readers = Priority::ALL
            .iter()
            .map(|class| link_reader(&participant, shared, local, *class))
            .collect::<Result<_, _>>()?;
        let (watcher, own) = (Arc::clone(shared), local.clone());
        let known = parking_lot::Mutex::new(BTreeMap::new());
        let watch = participant.watch_endpoints(
            TOPIC_PREFIX,
            Box::new(move |endpoints| {
                note_readers(&watcher, &own, &mut known.lock(), &endpoints.readers);
            }),
        )?;
        Ok(Self { watch, readers, pulse, participant })
    }

    /// Whether another one came back that RustDDS cannot meet again in this life: after silence for
    /// longer than its lease (50 s), or after a good-bye that it did not say.
    fn has_missed_one(&self) -> bool {
        self.watch.has_returned()
    }

    /// Why it must be replaced, if so.
    fn illness(&mut self) -> Option<Illness> {
        if self.readers.iter().any(|reader| !reader.is_running()) {
            return Some(Illness::Stopped);
        }
        self.pulse.feel(&self.participant).err()
    }
}

/// Waits for the reader of the other endpoint, which is known by now: RustDDS may hang when it is
/// asked for the next writer while it still matches this one.
fn wait_matched(writer: &Writer) {
    let until = Instant::now() + MATCH;
    while !writer.is_matched() && Instant::now() < until {
        thread::sleep(Duration::from_millis(1));
    }
}

fn link_reader(
    participant: &Participant,
    shared: &Arc<Shared>,
    local: &Endpoint,
    class: Priority,
) -> Result<Reader, DdsError> {
    let room = profile(class, shared.wire.max_datagram_bytes());
    let shared = Arc::clone(shared);
    participant.reader(
        &topic(local, class),
        room,
        Box::new(move |writer, datagram| {
            note_heard(&shared, writer);
            (shared.config.sink)(TransportEvent::Received { class, datagram });
        }),
    )
}

fn note_heard(shared: &Shared, writer: GuidPrefix) {
    let now = Instant::now();
    let mut heard = shared.heard.lock();
    if heard.len() >= MAX_HEARD && !heard.contains_key(&writer) {
        heard.retain(|_, at| now.duration_since(*at) < LIVE);
        if heard.len() >= MAX_HEARD {
            return;
        }
    }
    heard.insert(writer, now);
}

/// What is known of an endpoint.
struct Found {
    participant: GuidPrefix,
    /// Which of its classes have a reader.
    classes: [bool; CLASSES],
    /// Since when.
    since: Instant,
}

type Known = BTreeMap<Endpoint, Found>;

/// Compares all remote readers with those known before and tells the differences.
fn note_readers(shared: &Shared, own: &Endpoint, known: &mut Known, readers: &[FoundEndpoint]) {
    let now = Instant::now();
    let mut homes: HashMap<GuidPrefix, Vec<Ipv4Addr>> = HashMap::new();
    let mut found = Known::new();
    for reader in readers {
        let Some((endpoint, class)) = parse_topic(&reader.topic) else {
            continue;
        };
        let addresses = homes.entry(reader.participant()).or_default();
        for socket in &reader.sockets {
            if let IpAddr::V4(address) = socket.ip()
                && !addresses.contains(&address)
            {
                addresses.push(address);
            }
        }
        if endpoint != *own {
            let since = known.get(&endpoint).map_or(now, |known| known.since);
            let entry = found.entry(endpoint).or_insert(Found {
                participant: reader.participant(),
                classes: [false; CLASSES],
                since,
            });
            entry.classes[class as usize] = true;
        }
    }
    // A datagram needs all three topics, so an endpoint counts when it is complete.
    found.retain(|_, found| found.classes == [true; CLASSES]);
    *shared.namesakes.lock() = namesakes(own, &found, &homes);
    *shared.homes.lock() = homes;
    shared.status.lock().endpoints = found.len();
    for endpoint in known.keys().filter(|endpoint| !found.contains_key(*endpoint)) {
        (shared.config.sink)(TransportEvent::Lost(endpoint.clone()));
    }
    for endpoint in found.keys().filter(|endpoint| !known.contains_key(*endpoint)) {
        (shared.config.sink)(TransportEvent::Discovered(endpoint.clone()));
    }
    *known = found;
}

/// Programs that have the name of this flow, or one name together.
fn namesakes(
    own: &Endpoint,
    found: &Known,
    homes: &HashMap<GuidPrefix, Vec<Ipv4Addr>>,
) -> Vec<Life> {
    let all: Vec<(&Endpoint, &Found)> = found.iter().collect();
    let of_one_name = all.chunk_by(|(one, _), (other, _)| one.flow == other.flow);
    let doubtful = of_one_name.filter(|lives| lives.len() > 1 || lives[0].0.flow == own.flow);
    let life = |(endpoint, found): &(&Endpoint, &Found)| Life {
        endpoint: (*endpoint).clone(),
        addresses: homes.get(&found.participant).cloned().unwrap_or_default(),
        since: found.since,
    };
    doubtful.flatten().map(life).collect()
}
