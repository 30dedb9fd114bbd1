//! One life of the participant, and the writers and readers that are made on it.

use std::collections::{HashMap, HashSet};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_domain::MAX_PAYLOAD_BYTES;
use rustdds::Timestamp;
use serde_json::{Value, json};

use super::channel::Channel;
use super::deliver::nanos;
use super::names::ALIVE;
use super::near::Near;
use super::presence::Presence;
use super::probe::Probe;
use super::shared::{Shared, WriterFacts};
use super::slot::Slot;
use crate::dds::farewell::Farewell;
use crate::dds::participant::{RawReader, prefix_of};
use crate::dds::{
    DdsError, EndpointWatch, Endpoints, FRAME_TYPE, FoundEndpoint, GuidPrefix, Illness,
    Participant, ParticipantConfig, Profile, Pulse, Writer, create_error,
};

/// Between two signs of life.
const SIGN: Duration = Duration::from_millis(500);
/// Between two questions to the hosts of other participants.
const PROBE: Duration = Duration::from_millis(100);
/// Bytes of the largest sample: the largest payload with the largest header.
const LARGEST_SAMPLE: usize = MAX_PAYLOAD_BYTES + 8 * 1024;
/// Room for what RustDDS sends at once; the system caps it (`net.core.wmem_max`).
const SEND_BUFFER: usize = 8 * 1024 * 1024;
/// Signs of life that wait to be read.
const SIGNS: u16 = 256;

/// Fields drop in this order: users first, the participant last.
pub(super) struct Generation {
    watch: EndpointWatch,
    pulse: Pulse,
    signs: RawReader,
    sign: Writer,
    next_sign: Instant,
    probes: HashMap<GuidPrefix, (SocketAddr, Probe)>,
    next_probe: Instant,
    farewell: Farewell,
    pub(super) presence: Arc<parking_lot::Mutex<Presence>>,
    pub(super) participant: Participant,
}

impl Generation {
    pub(super) fn start(shared: &Arc<Shared>, now: Instant) -> Result<Self, DdsError> {
        let participant = Participant::start(ParticipantConfig {
            send_buffer_bytes: SEND_BUFFER,
            largest_sample: u32::try_from(LARGEST_SAMPLE).unwrap_or(u32::MAX),
            repairs_fragments: true,
            ..ParticipantConfig::new(shared.domain, shared.address)
        })?;
        let pulse = Pulse::start(&participant)?;
        let profile = Profile::best_effort(SIGNS);
        let farewell =
            Farewell::new(shared.address, participant.port()).map_err(create_error("socket"))?;
        let near = Near::of_interface(shared.address);
        let presence = Arc::new(parking_lot::Mutex::new(Presence::new(near)));
        let (told, found) = (Arc::clone(shared), Arc::clone(&presence));
        Ok(Self {
            watch: participant.watch_endpoints(
                "",
                Box::new(move |endpoints| {
                    note_endpoints(&told, &found, &endpoints);
                }),
            )?,
            pulse,
            signs: participant.raw_reader((ALIVE, FRAME_TYPE), profile)?,
            sign: participant.writer(ALIVE, profile)?,
            next_sign: now,
            probes: HashMap::new(),
            next_probe: now,
            farewell,
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

    /// Makes a writer.
    pub(super) fn fill(&self, shared: &Shared, slot: &Slot, now: Instant) -> Result<(), DdsError> {
        let profile = slot.key.profile();
        let writer = self.participant.writer(&slot.key.topic, profile)?;
        let facts = WriterFacts {
            reliable: profile.reliable,
            durable: profile.transient_local,
            own: true,
            signs: true,
        };
        shared.writers.write().insert(writer.id(), facts);
        slot.put(writer, now);
        Ok(())
    }

    /// Makes the readers of a channel that are missing.
    pub(super) fn open(&self, channel: &Channel, best_effort: bool) -> Result<(), DdsError> {
        let topic = (&*channel.topic, FRAME_TYPE);
        let mut readers = channel.readers.lock();
        let is_new = readers.reliable.is_none();
        if is_new {
            // What is taken from now on is new, however long making the reader takes.
            readers.opened = Some(Timestamp::now());
            readers.reliable = Some(self.participant.raw_reader(topic, channel.profile(true))?);
        }
        if best_effort && readers.best_effort.is_none() {
            readers.best_effort = Some(self.participant.raw_reader(topic, channel.profile(false))?);
        } else if !is_new {
            return Ok(());
        }
        drop(readers);
        channel.opened();
        Ok(())
    }

    /// Tells others that this one lives and reads who else does. Returns whether another one has
    /// given this one up.
    pub(super) fn exchange_signs(&mut self, shared: &Shared, now: Instant) -> bool {
        if now >= self.next_sign {
            self.next_sign = now + SIGN;
            let gone: Vec<String> =
                self.presence.lock().gone(now).map(|prefix| prefix.to_string()).collect();
            let time_ns = u64::try_from(nanos(Timestamp::now())).unwrap_or(0);
            let sign = json!({ "time_ns": time_ns, "gone": gone });
            self.sign.write(sign.to_string().as_bytes());
        }
        let own = self.participant.prefix();
        let mut given_up = false;
        self.signs.drain_read_notifications();
        for _ in 0..SIGNS {
            let Ok(taken) = self.signs.try_take_one() else { continue };
            let Some(sample) = taken else { break };
            let from = prefix_of(sample.writer_guid());
            let received = nanos(sample.receive_instant);
            let octets = sample.sample.octets().unwrap_or_default();
            let Ok(sign) = serde_json::from_slice::<Value>(&octets) else { continue };
            if from == own {
                continue;
            }
            self.presence.lock().sign(now, from);
            if let Some(sent) = sign["time_ns"].as_u64() {
                shared.clocks.write().compare(now, from, i128::from(sent), received);
            }
            let name = own.to_string();
            let mut gone = sign["gone"].as_array().into_iter().flatten();
            given_up |= gone.any(|prefix| prefix.as_str() == Some(&name));
        }
        given_up
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
fn note_endpoints(shared: &Shared, presence: &parking_lot::Mutex<Presence>, endpoints: &Endpoints) {
    presence.lock().set_readers(&endpoints.readers);
    let mut best_effort = HashSet::new();
    let sign = |writer: &FoundEndpoint| (writer.topic == ALIVE).then(|| writer.participant());
    let alive: HashSet<GuidPrefix> = endpoints.writers.iter().filter_map(sign).collect();
    {
        let mut writers = shared.writers.write();
        writers.retain(|_, facts| facts.own);
        for writer in &endpoints.writers {
            let facts = WriterFacts {
                reliable: writer.is_reliable(),
                durable: writer.is_durable(),
                own: false,
                signs: alive.contains(&writer.participant()),
            };
            writers.insert(writer.id, facts);
            if !writer.is_reliable() {
                best_effort.insert(writer.topic.clone());
            }
        }
    }
    let changed = *shared.best_effort.read() != best_effort;
    if changed {
        *shared.best_effort.write() = best_effort;
        shared.wake_lifecycle();
    }
}
