//! Samples of a ROS 2 network: CDR of any type, identified as RTPS does.

use std::net::Ipv4Addr;
use std::sync::{Arc, OnceLock, Weak};
use std::time::{Duration, Instant};

use blaze_domain::media::cdr_of;
use blaze_domain::{DropReason, FlowId, MAX_PAYLOAD_BYTES, Origin, ServiceName, WriterId};
use blaze_proto::{Frame, Header};
use bytes::Bytes;
use rustdds::{Timestamp, WriteOptionsBuilder};

use super::Inner;
use super::endpoint::{RosEndpoint, Vendor};
use super::graph::{GRAPH_TOPIC, GidLength, Node, ParticipantNodes};
use super::names::{Carries, RosName};
use super::network::Knowledge;
use super::services::{self, Forwarded, OnWire, Services, carries};
use crate::dds::adapter::{
    Admission, Companion, Decoded, Dialect, Encoded, NoMessage, Others, Topic, nanos,
};
use crate::dds::participant::{RawReader, prefix_of};
use crate::dds::{
    Cdr, DdsError, EndpointId, Endpoints, GuidPrefix, Participant, ParticipantConfig, Profile,
    Relay, Sample, TimingQos, Writer, Written, endpoint_of, take_up_to,
};
use crate::outbox::Body;
use crate::port::Content;

/// Samples that a transient_local writer of ROS 2 keeps, as far as we know: discovery tells none.
pub const KEPT_SAMPLES: u32 = 10;
/// Room for what RustDDS sends at once; the system caps it (`net.core.wmem_max`).
const SEND_BUFFER: usize = 8 * 1024 * 1024;
/// Encapsulation and padding around the largest payload.
const AROUND_PAYLOAD: usize = 16;
/// Samples of the graph that wait to be read: each participant keeps one.
const GRAPHS: u16 = 1024;
/// How long a reply waits until its client's reader is found.
const MEET_CLIENT: Duration = Duration::from_secs(1);
/// RTPS: the entity that stands for the participant itself.
const PARTICIPANT: [u8; 4] = [0x00, 0x00, 0x01, 0xc1];

/// The dialect of ROS 2.
pub(super) struct Ros {
    pub(super) flow: FlowId,
    pub(super) interface: Ipv4Addr,
    pub(super) gid: GidLength,
    pub(super) knowledge: Arc<Knowledge>,
    pub(super) services: Arc<Services>,
    /// Announces the participant to peers, and to those of this host that RustDDS leaves out.
    pub(super) relay: Relay,
    /// Who reads and writes topics; none while it is opened.
    pub(super) user: Arc<OnceLock<Weak<Inner>>>,
}

impl Dialect for Ros {
    fn participant(&self, domain: u16, address: Ipv4Addr) -> ParticipantConfig {
        let largest = MAX_PAYLOAD_BYTES + AROUND_PAYLOAD;
        ParticipantConfig {
            send_buffer_bytes: SEND_BUFFER,
            largest_sample: u32::try_from(largest).unwrap_or(u32::MAX),
            repairs_fragments: true,
            any_vendor: true,
            ..ParticipantConfig::new(domain, address)
        }
    }

    fn companion(
        &self,
        participant: &Participant,
        _: Instant,
    ) -> Result<Box<dyn Companion>, DdsError> {
        self.relay.set_participant(participant.prefix());
        self.knowledge.set_own(participant.prefix());
        self.services.lock().forget_readers();
        let keep = |depth| Profile {
            reliable: true,
            transient_local: true,
            window: 64,
            timing: TimingQos::MARKED,
            ..Profile::best_effort(depth)
        };
        Ok(Box::new(Graph {
            reader: participant.raw_reader(GRAPH_TOPIC, keep(GRAPHS))?,
            writer: participant.typed_writer(GRAPH_TOPIC, keep(1))?,
            gid: self.gid,
            node: self.flow.ros2_node(),
            knowledge: Arc::clone(&self.knowledge),
            user: Arc::clone(&self.user),
            told: None,
        }))
    }

    fn note_endpoints(&self, endpoints: &Endpoints) {
        let changed = self.knowledge.note_endpoints(Instant::now(), endpoints);
        if changed.is_empty() {
            return;
        }
        self.knowledge.forget_requests(&mut self.services.lock());
        if let Some(user) = self.user.get().and_then(Weak::upgrade) {
            user.follow(&changed);
        }
    }

    fn note_reader(&self, topic: &Topic, reader: EndpointId, stands: bool) {
        if carries(&topic.name) == Carries::Replies {
            self.services.lock().note_reader(Instant::now(), &topic.name, reader, stands);
        }
    }

    fn admission(&self, topic: &Topic, writer: &EndpointId) -> Admission {
        let admission = self.knowledge.admission(writer, &topic.type_name);
        let is_request = || carries(&topic.name) == Carries::Requests;
        if admission == Admission::Yes && is_request() && !self.services.lock().is_read(&topic.name)
        {
            return Admission::Later;
        }
        admission
    }

    fn decode(&self, topic: &Topic, sample: &Sample) -> Result<Decoded, NoMessage> {
        let id = sample.writer_guid.to_bytes();
        let writer = self.knowledge.writer(&id).ok_or(NoMessage::Malformed)?;
        let type_name = writer.type_name.as_ref().ok_or(NoMessage::Malformed)?;
        let sequence =
            u64::try_from(i64::from(sample.sequence_number)).map_err(|_| NoMessage::Malformed)?;
        let written = sample.source_timestamp().map_or(0, nanos);
        let service = ServiceName::of_ros2_node(writer.node.as_deref().unwrap_or_default());
        let origin = Origin {
            layer: self.flow.layer.to_string(),
            node: self.flow.node.to_string(),
            service: service.to_string(),
            instance: "0".to_owned(),
            epoch: 0,
        };
        let (payload, answers) = self.of_service(topic, &writer, sample, sequence)?;
        let (related, to) = answers.map_or((None, String::new()), |of| (Some(of.request), of.flow));
        let header = Header {
            related,
            to,
            encoding: cdr_of(type_name),
            type_hash: writer.type_hash.clone().unwrap_or_default(),
            lifespan_ms: writer.lifespan_ms(),
            reliable: writer.reliable,
            depth: if writer.durable { KEPT_SAMPLES } else { 0 },
            ..Header::new(
                &topic.user,
                origin,
                WriterId(id),
                sequence,
                u64::try_from(written).unwrap_or(0),
            )
        };
        let frame = Frame::new(&header, payload).map_err(|_| NoMessage::Malformed)?;
        let written = Some(written).filter(|_| is_of_host(self.interface, &writer.addresses));
        let age_us = age_us(written, nanos(sample.receive_instant), nanos(Timestamp::now()));
        Ok(Decoded { content: Content::Frame(frame), age_us })
    }

    fn encode(&self, _: &Topic, message: &Body, _: bool) -> Result<Encoded, DropReason> {
        let Body::Frame(frame) = message else { return Err(DropReason::BrokerError) };
        let cdr = Cdr::little(frame.payload().clone()).ok_or(DropReason::BrokerError)?;
        let mut options = WriteOptionsBuilder::new();
        if let Some(written) = timestamp(frame.publish_time_ns()) {
            options = options.source_timestamp(written);
        }
        Ok(Encoded { cdr, options })
    }

    /// Requests and replies bear what their server or client knows them by.
    fn write(
        &self,
        topic: &Topic,
        message: &Body,
        durable: bool,
        writer: &Writer,
    ) -> Result<Written, DropReason> {
        let Encoded { cdr, options } = self.encode(topic, message, durable)?;
        let Body::Frame(frame) = message else { return Err(DropReason::BrokerError) };
        match carries(&topic.name) {
            Carries::Messages => Ok(writer.write_cdr(cdr, options)),
            Carries::Requests => self.write_request(topic, frame, (cdr, options), writer),
            Carries::Replies => self.write_reply(frame, (cdr, options), writer),
        }
    }

    /// What a flow writes to the network it does not read from there.
    fn own(&self, _: &Topic, _: &Body) -> Option<Content> {
        None
    }
}

impl Ros {
    /// Writes a request when its reply can be read: a server may answer at once, and keeps nothing.
    fn write_request(
        &self,
        topic: &Topic,
        frame: &Frame,
        (cdr, options): (Cdr, WriteOptionsBuilder),
        writer: &Writer,
    ) -> Result<Written, DropReason> {
        let requests = RosName::of_dds(&topic.name).ok_or(DropReason::BrokerError)?;
        let replies = RosName { carries: Carries::Replies, ..requests.clone() };
        let (now, dds_replies) = (Instant::now(), replies.to_dds());
        let known_for = self.knowledge.replies_for(now, &replies);
        // Held until it is noted whose request it is: its reply may be read by then.
        let mut services = self.services.lock();
        if !services.may_ask(now, &topic.name, &dds_replies, known_for)
            || !services.has_room(now, &topic.name)
        {
            return Ok(Written::Full);
        }
        let server = self.knowledge.server(&requests);
        let (header, named) = match server {
            Some(Vendor::CycloneDds) => (Some(services.next_header(&writer.id())), None),
            Some(Vendor::FastDds) => (None, services.reader_to_name(&dds_replies, writer.id())),
            _ => (None, None),
        };
        let (payload, _) =
            header.map_or((cdr.payload().clone(), None), |header| header.put_on(cdr.payload()));
        let cdr = Cdr::little(payload).ok_or(DropReason::BrokerError)?;
        let options = options.related_sample_identity_opt(named.map(services::named));
        let written = writer.write_cdr(cdr, options);
        if let Written::Taken(number) = written {
            let on_wire = || OnWire::Related(named.unwrap_or_else(|| writer.id()), number);
            let request = (frame.writer(), frame.sequence());
            let flow = format!("{}/{}", frame.origin_layer(), frame.origin_node());
            let forwarded = Forwarded { request, flow };
            services.note_forwarded(now, &topic.name, header.unwrap_or_else(on_wire), forwarded);
        }
        Ok(written)
    }

    /// Writes a reply as its client knows it.
    fn write_reply(
        &self,
        frame: &Frame,
        (cdr, options): (Cdr, WriteOptionsBuilder),
        writer: &Writer,
    ) -> Result<Written, DropReason> {
        let request = frame.related().ok_or(DropReason::NoDestination)?;
        let mut services = self.services.lock();
        // Its client has gone, or has its reply.
        let (known_as, asked) = services.asked(&request).ok_or(DropReason::NoDestination)?;
        // A reader that RustDDS has just found may not be served yet.
        if let OnWire::Related(reader, _) = known_as
            && asked.elapsed() < MEET_CLIENT
            && !self.knowledge.has_met(Instant::now(), &reader)
        {
            return Ok(Written::Full);
        }
        let (payload, related) = known_as.put_on(cdr.payload());
        let cdr = Cdr::little(payload).ok_or(DropReason::BrokerError)?;
        let written = writer.write_cdr(cdr, options.related_sample_identity_opt(related));
        if matches!(written, Written::Taken(_)) {
            services.note_answered(&request);
        }
        Ok(written)
    }

    /// The payload of a sample as others send it, and which request it answers.
    fn of_service(
        &self,
        topic: &Topic,
        writer: &RosEndpoint,
        sample: &Sample,
        sequence: u64,
    ) -> Result<(Bytes, Option<Forwarded>), NoMessage> {
        match carries(&topic.name) {
            Carries::Messages => Ok((sample.sample.payload().clone(), None)),
            Carries::Requests => {
                let (known_as, payload) =
                    OnWire::of_request(writer.vendor, sample).ok_or(NoMessage::Malformed)?;
                let request = (WriterId(writer.id), sequence);
                self.services.lock().note_asked(Instant::now(), request, known_as);
                Ok((payload, None))
            }
            Carries::Replies => {
                let (known_as, payload) =
                    OnWire::of_reply(writer.vendor, sample).ok_or(NoMessage::Malformed)?;
                // Others answer to clients of this network.
                let answers = self.services.lock().take_forwarded(&known_as);
                Ok((payload, Some(answers.ok_or(NoMessage::NotForUs)?)))
            }
        }
    }
}

/// Whether a participant is on the host that has an interface, and so has its clock.
fn is_of_host(interface: Ipv4Addr, addresses: &[Ipv4Addr]) -> bool {
    let on_loopback = interface.is_loopback();
    addresses.iter().any(|it| *it == interface || (on_loopback && it.is_loopback()))
}

/// Age of a sample: since it was received, and since it was written where a clock of this host says
/// when.
fn age_us(written_ns: Option<i128>, received_ns: i128, now_ns: i128) -> u64 {
    let written_ns = written_ns.filter(|written| *written > 0).unwrap_or(received_ns);
    u64::try_from((now_ns - written_ns.min(received_ns)).max(0) / 1_000).unwrap_or(u64::MAX)
}

/// A time of day as RTPS has it; `None` where it is not known.
fn timestamp(ns: u64) -> Option<Timestamp> {
    let ticks = (u128::from(ns) << 32) / 1_000_000_000;
    u64::try_from(ticks).ok().filter(|ticks| *ticks > 0).map(Timestamp::from_ticks)
}

/// Tells others which endpoints the flow's node has, and reads which nodes have which.
struct Graph {
    reader: RawReader,
    writer: Writer,
    gid: GidLength,
    /// Full name of the own node.
    node: String,
    knowledge: Arc<Knowledge>,
    user: Arc<OnceLock<Weak<Inner>>>,
    /// How often endpoints had changed when they were told last.
    told: Option<u64>,
}

impl Companion for Graph {
    fn tick(&mut self, now: Instant, own: GuidPrefix, others: &Others<'_>) -> bool {
        self.tell(own, others);
        take_up_to(&self.reader, GRAPHS.into(), |taken| {
            let Ok(sample) = taken else { return others.note_malformed() };
            let from = prefix_of(sample.writer_guid);
            match ParticipantNodes::read(&sample.sample) {
                Some(told) if from != own && told.participant[..12] == from.0 => {
                    self.knowledge.note_nodes(now, from, told.owners(from));
                }
                Some(_) => {}
                None => others.note_malformed(),
            }
        });
        self.knowledge.tick(now);
        if let Some(user) = self.user.get().and_then(Weak::upgrade) {
            user.tick(now);
        }
        false
    }
}

impl Graph {
    /// Tells the own endpoints, if they are others than before.
    fn tell(&mut self, own: GuidPrefix, others: &Others<'_>) {
        let changes = others.changes();
        if self.told == Some(changes) {
            return;
        }
        let (mut readers, mut writers) = others.own_endpoints();
        // Other flows know it by these, also when it has nothing else there.
        readers.push(endpoint_of(self.reader.guid()));
        writers.push(self.writer.id());
        let Some((namespace, name)) = self.node.rsplit_once('/') else { return };
        let (namespace, name) = (namespace.to_owned(), name.to_owned());
        let node = Node { namespace, name, readers, writers };
        let mut participant = [0; 16];
        participant[..12].copy_from_slice(&own.0);
        participant[12..].copy_from_slice(&PARTICIPANT);
        let nodes = ParticipantNodes { participant, nodes: vec![node] };
        let Some(cdr) = nodes.write(self.gid) else { return };
        let written = self.writer.write_cdr(cdr, WriteOptionsBuilder::new());
        if matches!(written, Written::Taken(_) | Written::NoReader) {
            self.told = Some(changes);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ages_begin_with_writing_where_its_clock_is_ours_else_with_arrival() {
        let ms = |written: Option<i128>, received: i128, now: i128| {
            age_us(written.map(|ms| ms * 1_000_000), received * 1_000_000, now * 1_000_000) / 1_000
        };
        assert_eq!(ms(Some(5), 8, 9), 4);
        assert_eq!(ms(None, 8, 9), 1, "it lay here");
        assert_eq!(ms(Some(0), 8, 9), 1, "not told");
        assert_eq!(ms(Some(20), 8, 9), 1, "a clock may be set back");
        assert_eq!(ms(Some(20), 10, 9), 0);
    }

    #[test]
    fn a_host_is_known_by_the_address_of_its_interface() {
        let [mine, other] = [Ipv4Addr::new(10, 0, 0, 1), Ipv4Addr::new(10, 0, 0, 2)];
        let local = Ipv4Addr::LOCALHOST;
        assert!(is_of_host(mine, &[local, mine]));
        assert!(!is_of_host(mine, &[local, other]), "each host has that one");
        assert!(is_of_host(local, &[other, local]));
    }

    #[test]
    fn times_of_day_survive() {
        for ns in [1_000_000_000, 1_764_000_000_123_456_789] {
            let back = nanos(timestamp(ns).unwrap());
            assert!((i128::from(ns) - back).abs() <= 1, "{ns} {back}");
        }
        assert_eq!(timestamp(0), None);
        assert_eq!(timestamp(u64::MAX), None, "beyond 2106");
    }
}
