//! One life of the participant, and the writers and readers that are made on it.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use rustdds::Timestamp;

use super::Companion;
use super::channel::{Channel, Readers};
use super::deliver::Kind;
use super::doubtful::LONGEST_DOUBT;
use super::near::Near;
use super::presence::Presence;
use super::probe::Probe;
use super::shared::{Shared, WriterFacts};
use super::slot::Slot;
use crate::dds::farewell::Farewell;
use crate::dds::writer::endpoint_of;
use crate::dds::{
    DdsError, EndpointId, EndpointWatch, Endpoints, FoundEndpoint, GuidPrefix, Illness,
    Participant, Pulse, create_error,
};

/// Between two questions to the hosts of other participants.
const PROBE: Duration = Duration::from_millis(100);
/// How long it is known what a writer offered, after it was found last. They are looked for once a
/// second.
const KNOWN_FOR: Duration = LONGEST_DOUBT.saturating_add(Duration::from_secs(1));

/// Fields drop in this order: users first, the participant last.
pub(super) struct Generation {
    watch: EndpointWatch,
    pulse: Pulse,
    companion: Box<dyn Companion>,
    probes: HashMap<GuidPrefix, (SocketAddr, Probe)>,
    next_probe: Instant,
    farewell: Farewell,
    /// Those of topics.
    readers: BTreeSet<EndpointId>,
    /// How often they and the writers came and went.
    changes: u64,
    pub(super) presence: Arc<Mutex<Presence>>,
    pub(super) participant: Participant,
}

impl Generation {
    pub(super) fn start(shared: &Arc<Shared>, now: Instant) -> Result<Self, DdsError> {
        let config = shared.dialect.participant(shared.domain, shared.address);
        let participant = Participant::start(config)?;
        let pulse = Pulse::start(&participant)?;
        let farewell =
            Farewell::new(shared.address, participant.port()).map_err(create_error("socket"))?;
        let near = Near::of_interface(shared.address);
        let presence =
            Arc::new(Mutex::new(Presence::new(near, shared.dialect.sign_topic().is_some())));
        let (told, found) = (Arc::clone(shared), Arc::clone(&presence));
        Ok(Self {
            watch: participant.watch_endpoints(
                "",
                Box::new(move |endpoints| {
                    note_endpoints(&told, &found, &endpoints);
                }),
            )?,
            pulse,
            companion: shared.dialect.companion(&participant, now)?,
            probes: HashMap::new(),
            next_probe: now,
            farewell,
            readers: BTreeSet::new(),
            changes: 0,
            presence,
            participant,
        })
    }

    /// Why it must be replaced, if so.
    pub(super) fn illness(&mut self) -> Option<Illness> {
        self.pulse.feel(&self.participant).err()
    }

    /// Whether a participant came back that RustDDS cannot meet again in this life.
    pub(super) fn has_missed_one(&self) -> bool {
        self.watch.has_returned()
    }

    /// How often readers and writers of topics came and went.
    pub(super) fn changes(&self) -> u64 {
        self.changes
    }

    /// Makes a writer.
    pub(super) fn fill(&mut self, shared: &Shared, slot: &Slot) -> Result<(), DdsError> {
        let profile = slot.key.profile();
        let topic = &slot.key.topic;
        let writer = self.participant.typed_writer((&topic.name, &topic.type_name), profile)?;
        let now = Instant::now();
        let facts = WriterFacts {
            reliable: profile.reliable,
            durable: profile.transient_local,
            own: true,
            signs: true,
            found: now,
        };
        shared.writers.write().insert(writer.id(), facts);
        self.changes += 1;
        slot.put(writer, now);
        Ok(())
    }

    /// A writer has gone.
    pub(super) fn forget_writer(&mut self, shared: &Shared, writer: EndpointId) {
        shared.writers.write().remove(&writer);
        self.changes += 1;
    }

    /// Makes the readers of a channel that are missing, as far as RustDDS makes them.
    pub(super) fn open(
        &mut self,
        shared: &Shared,
        channel: &Arc<Channel>,
        wanted: [bool; 3],
    ) -> Result<(), DdsError> {
        let topic = (&*channel.topic.name, &*channel.topic.type_name);
        let mut readers = channel.readers.lock();
        let Readers { by_kind, opened, .. } = &mut *readers;
        let mut result = Ok(());
        let before = self.changes;
        for ((reader, kind), wanted) in by_kind.iter_mut().zip(Kind::ALL).zip(wanted) {
            if !wanted || reader.is_some() {
                continue;
            }
            // What is taken from now on is new, however long making the reader takes.
            let begin = Timestamp::now();
            match self.participant.raw_reader(topic, channel.profile(kind)) {
                Ok(made) => {
                    let id = endpoint_of(made.guid());
                    self.readers.insert(id);
                    self.changes += 1;
                    if kind == Kind::Reliable {
                        shared.dialect.note_reader(&channel.topic, id, true);
                    }
                    *reader = Some(made);
                    opened.get_or_insert(begin);
                }
                Err(error) => result = Err(error),
            }
        }
        drop(readers);
        if self.changes != before {
            channel.opened();
        }
        result
    }

    /// A channel has gone.
    pub(super) fn forget_channel(&mut self, shared: &Shared, channel: &Channel) {
        for reader in channel.readers.lock().by_kind.iter().flatten() {
            let id = endpoint_of(reader.guid());
            shared.dialect.note_reader(&channel.topic, id, false);
            self.readers.remove(&id);
            self.changes += 1;
        }
    }

    /// What belongs to this life has its turn. Returns whether another participant has given this
    /// one up.
    pub(super) fn tick(&mut self, shared: &Shared, now: Instant) -> bool {
        let Self { presence, readers, changes, .. } = self;
        let others = Others { presence, shared, readers, changes: *changes };
        self.companion.tick(now, self.participant.prefix(), &others)
    }

    /// Says good-bye for those that are gone without having said so.
    pub(super) fn expel(&mut self, shared: &Shared, now: Instant, full: &[(&str, Instant)]) {
        let mut dead: HashSet<GuidPrefix> = HashSet::new();
        if now >= self.next_probe {
            self.next_probe = now + PROBE;
            dead.extend(self.refused(shared));
            dead.extend(self.presence.lock().superseded());
        }
        let given_up: Vec<GuidPrefix> = self.presence.lock().given_up(now, full);
        for prefix in &given_up {
            self.presence.lock().note_gone(now, *prefix);
        }
        dead.extend(given_up);
        for prefix in dead {
            tracing::warn!(
                participant = %prefix,
                domain = shared.domain,
                "a DDS participant is gone without a good-bye",
            );
            shared.counts.lock().expelled += 1;
            if let Err(error) = self.farewell.say(prefix) {
                tracing::warn!(%error, "RustDDS cannot be told");
            }
        }
    }

    /// Those on whose port nothing listens.
    fn refused(&mut self, shared: &Shared) -> Vec<GuidPrefix> {
        let known: HashMap<GuidPrefix, SocketAddr> = self.presence.lock().sockets().collect();
        // Whoever takes its data elsewhere now is asked there.
        self.probes.retain(|prefix, (socket, _)| known.get(prefix) == Some(&*socket));
        for (prefix, socket) in known {
            if self.probes.contains_key(&prefix) {
                continue;
            }
            if let Ok(probe) = Probe::new(shared.address, socket) {
                self.probes.insert(prefix, (socket, probe));
            }
        }
        let refused = self.probes.iter().filter(|(_, (_, probe))| probe.is_refused());
        refused.map(|(prefix, _)| *prefix).collect()
    }
}

/// Takes over what other participants have.
fn note_endpoints(shared: &Shared, presence: &Mutex<Presence>, endpoints: &Endpoints) {
    presence.lock().set_readers(&endpoints.readers);
    let mut offered: HashMap<String, [bool; 3]> = HashMap::new();
    let signs = shared.dialect.sign_topic();
    let sign =
        |writer: &FoundEndpoint| (Some(&*writer.topic) == signs).then(|| writer.participant());
    let now = Instant::now();
    let alive: HashSet<GuidPrefix> = endpoints.writers.iter().filter_map(sign).collect();
    {
        let mut writers = shared.writers.write();
        // Samples of those that have left may still wait.
        let is_recent =
            |facts: &WriterFacts| now.saturating_duration_since(facts.found) < KNOWN_FOR;
        writers.retain(|_, facts| facts.own || is_recent(facts));
        for writer in &endpoints.writers {
            let facts = WriterFacts {
                reliable: writer.is_reliable(),
                durable: writer.is_durable(),
                own: false,
                signs: alive.contains(&writer.participant()),
                found: now,
            };
            writers.insert(writer.id, facts);
            offered.entry(writer.topic.clone()).or_default()[Kind::of(facts, true) as usize] = true;
        }
    }
    let changed = *shared.offered.read() != offered;
    if changed {
        *shared.offered.write() = offered;
    }
    // Last: readers that are wanted because of it are made for what is offered now.
    shared.dialect.note_endpoints(endpoints);
    if changed {
        shared.wake_lifecycle();
    }
}

/// What a companion knows of other participants, and tells of them.
pub(crate) struct Others<'a> {
    presence: &'a Mutex<Presence>,
    shared: &'a Shared,
    readers: &'a BTreeSet<EndpointId>,
    changes: u64,
}

impl Others<'_> {
    /// Those that were given up not long ago.
    pub(crate) fn gone(&self, now: Instant) -> Vec<String> {
        self.presence.lock().gone(now).map(|prefix| prefix.to_string()).collect()
    }

    /// One has told that it lives.
    pub(crate) fn note_sign(&self, now: Instant, from: GuidPrefix) {
        self.presence.lock().sign(now, from);
    }

    /// Readers and writers of topics that this participant has.
    pub(crate) fn own_endpoints(&self) -> (Vec<EndpointId>, Vec<EndpointId>) {
        let writers = self.shared.writers.read();
        let own = writers.iter().filter(|(_, facts)| facts.own);
        let mut writers: Vec<EndpointId> = own.map(|(id, _)| *id).collect();
        writers.sort_unstable();
        (self.readers.iter().copied().collect(), writers)
    }

    /// How often they came and went.
    pub(crate) fn changes(&self) -> u64 {
        self.changes
    }

    /// A sample was malformed.
    pub(crate) fn note_malformed(&self) {
        self.shared.counts.lock().malformed += 1;
    }

    /// One has told its time of day; both times in nanoseconds since 1970.
    pub(crate) fn compare(&self, now: Instant, from: GuidPrefix, sent_ns: i128, received_ns: i128) {
        self.shared.clocks.write().compare(now, from, sent_ns, received_ns);
    }
}
