//! Samples of a layer: frames, payloads without a header, and JSON on reserved topics.

use std::net::Ipv4Addr;
use std::time::Instant;

use blaze_domain::{DropReason, MAX_PAYLOAD_BYTES};
use rustdds::{Timestamp, WriteOptionsBuilder};

use super::names::{ALIVE, USER_PREFIX};
use super::signs::Signs;
use crate::dds::adapter::{Companion, Decoded, Dialect, Encoded, NoMessage, Topic};
use crate::dds::{DdsError, Endpoints, Participant, ParticipantConfig, Sample, octet_sequence};
use crate::outbox::Body;
use crate::port::Content;

/// Bytes of the largest sample: the largest payload with the largest header.
const LARGEST_SAMPLE: usize = MAX_PAYLOAD_BYTES + 8 * 1024;
/// Room for what RustDDS sends at once; the system caps it (`net.core.wmem_max`).
const SEND_BUFFER: usize = 8 * 1024 * 1024;

/// The dialect of a layer.
pub(super) struct Frames;

fn is_reserved(topic: &Topic) -> bool {
    !topic.name.starts_with(USER_PREFIX)
}

impl Dialect for Frames {
    fn participant(&self, domain: u16, address: Ipv4Addr) -> ParticipantConfig {
        ParticipantConfig {
            send_buffer_bytes: SEND_BUFFER,
            largest_sample: u32::try_from(LARGEST_SAMPLE).unwrap_or(u32::MAX),
            repairs_fragments: true,
            ..ParticipantConfig::new(domain, address)
        }
    }

    fn companion(
        &self,
        participant: &Participant,
        now: Instant,
    ) -> Result<Box<dyn Companion>, DdsError> {
        Ok(Box::new(Signs::start(participant, now)?))
    }

    fn sign_topic(&self) -> Option<&'static str> {
        Some(ALIVE)
    }

    fn note_endpoints(&self, _: &Endpoints) {}

    fn decode(&self, topic: &Topic, sample: &Sample) -> Result<Decoded, NoMessage> {
        let octets = sample.sample.octets().ok_or(NoMessage::Malformed)?;
        Ok(Decoded { content: Content::of(is_reserved(topic), octets), age_us: 0 })
    }

    fn encode(&self, _: &Topic, message: &Body, durable: bool) -> Result<Encoded, DropReason> {
        let sequence = match message {
            Body::Bare(payload) => octet_sequence(&[payload]),
            Body::Frame(frame) => octet_sequence(&[&frame.head_to_write(), frame.payload()]),
        };
        let cdr = sequence.map_err(|_| DropReason::TooLarge)?;
        let mut options = WriteOptionsBuilder::new();
        if durable {
            // It tells late joiners the age.
            options = options.source_timestamp(Timestamp::now());
        }
        Ok(Encoded { cdr, options })
    }

    fn own(&self, topic: &Topic, message: &Body) -> Option<Content> {
        Some(match message {
            Body::Frame(frame) => Content::Frame(frame.clone()),
            Body::Bare(payload) => Content::of(is_reserved(topic), payload.clone()),
        })
    }
}
