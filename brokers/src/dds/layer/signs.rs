//! Signs of life: each participant of a layer tells the others that it lives, what time it is, and
//! whom it has given up.

use std::time::{Duration, Instant};

use rustdds::Timestamp;
use serde_json::{Value, json};

use super::names::ALIVE;
use crate::dds::adapter::{Companion, Others, nanos};
use crate::dds::participant::{RawReader, prefix_of};

use crate::dds::{DdsError, FRAME_TYPE, GuidPrefix, Participant, Profile, Writer, take_up_to};

/// Between two signs of life.
const SIGN: Duration = Duration::from_millis(500);
/// Signs of life that wait to be read.
const SIGNS: u16 = 256;

pub(super) struct Signs {
    reader: RawReader,
    writer: Writer,
    next: Instant,
}

impl Signs {
    pub(super) fn start(participant: &Participant, now: Instant) -> Result<Self, DdsError> {
        let profile = Profile::best_effort(SIGNS);
        Ok(Self {
            reader: participant.raw_reader((ALIVE, FRAME_TYPE), profile)?,
            writer: participant.writer(ALIVE, profile)?,
            next: now,
        })
    }
}

impl Companion for Signs {
    /// Tells others that this one lives and reads who else does.
    fn tick(&mut self, now: Instant, own: GuidPrefix, others: &Others<'_>) -> bool {
        if now >= self.next {
            self.next = now + SIGN;
            let time_ns = u64::try_from(nanos(Timestamp::now())).unwrap_or(0);
            let sign = json!({ "time_ns": time_ns, "gone": others.gone(now) });
            self.writer.write(sign.to_string().as_bytes());
        }
        let mut given_up = false;
        take_up_to(&self.reader, SIGNS.into(), |taken| {
            let Ok(sample) = taken else { return };
            let from = prefix_of(sample.writer_guid());
            let octets = sample.sample.octets().unwrap_or_default();
            let Ok(sign) = serde_json::from_slice::<Value>(&octets) else { return };
            if from == own {
                return;
            }
            others.note_sign(now, from);
            if let Some(sent) = sign["time_ns"].as_u64() {
                others.compare(now, from, i128::from(sent), nanos(sample.receive_instant));
            }
            let name = own.to_string();
            let mut gone = sign["gone"].as_array().into_iter().flatten();
            given_up |= gone.any(|prefix| prefix.as_str() == Some(&name));
        });
        given_up
    }
}
