//! Messages on their way out of one class of one peer, and where to find them.

use std::time::{Duration, Instant};

use blaze_proto::Frame;
use smallvec::{SmallVec, smallvec};

use super::event::{Begun, LaneId, StreamKey, Submit};
use super::wire::Record;
use crate::lane::measure::micros;

/// Where each part of a message is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Part {
    /// Never sent.
    Unsent,
    /// In the sample of that sequence, which carried it last.
    Carried(u64),
    /// That sample was lost.
    Lost,
    /// Received.
    Acknowledged,
}

/// A message, from submission until it is out or dropped.
#[derive(Debug)]
pub(crate) struct Outgoing {
    pub frame: Frame,
    pub lane: LaneId,
    pub stream: StreamKey,
    pub arrived: Instant,
    pub deadline: Option<Instant>,
    /// Repaired and kept in order: reliable, or of several parts.
    pub ordered: bool,
    /// 0 until it is started.
    pub number: u32,
    pub behind: u16,
    pub parts: SmallVec<[Part; 1]>,
    /// The first part that was never sent.
    pub next_part: usize,
    pub acknowledged: usize,
    /// Parts that are [`Part::Lost`].
    pub lost: usize,
}

impl Outgoing {
    pub(crate) fn new(submit: Submit<'_>, part_bytes: usize) -> Self {
        let count = submit.frame.received_len().div_ceil(part_bytes).max(1);
        let age = Duration::from_micros(submit.frame.age_us());
        let deadline = submit
            .lifespan
            .and_then(|lifespan| submit.arrived.checked_add(lifespan.saturating_sub(age)));
        Self {
            lane: submit.lane,
            stream: submit.stream,
            arrived: submit.arrived,
            deadline,
            ordered: submit.reliable || count > 1,
            number: 0,
            behind: 0,
            parts: smallvec![Part::Unsent; count],
            next_part: 0,
            acknowledged: 0,
            lost: 0,
            frame: submit.frame,
        }
    }

    /// Bytes of the frame, for queues and parts.
    pub(crate) fn bytes(&self) -> usize {
        self.frame.received_len()
    }

    /// Bytes of the payload, for whom it is counted.
    pub(crate) fn payload_bytes(&self) -> usize {
        self.frame.payload().len()
    }

    pub(crate) fn is_started(&self) -> bool {
        self.number != 0
    }

    pub(crate) fn is_sent(&self) -> bool {
        self.next_part >= self.parts.len()
    }

    /// What has left, if that is neither nothing nor all.
    pub(crate) fn begun(&self) -> Option<Begun> {
        let parts = self.parts.len();
        (1..parts).contains(&self.next_part).then(|| Begun {
            payload_bytes: self.payload_bytes(),
            parts_sent: self.next_part,
            parts,
        })
    }

    pub(crate) fn is_expired(&self, now: Instant) -> bool {
        self.deadline.is_some_and(|deadline| deadline <= now)
    }

    /// Whether there is anything left to send; otherwise its fate is on the way.
    pub(crate) fn is_to_be_sent(&self) -> bool {
        self.lost > 0 || !self.is_sent()
    }

    pub(crate) fn waited(&self, now: Instant) -> Duration {
        now.saturating_duration_since(self.arrived)
    }

    /// Length of a part.
    pub(crate) fn part_length(&self, part: usize, part_bytes: usize) -> usize {
        self.bytes().saturating_sub(part * part_bytes).min(part_bytes)
    }

    /// What stands before a part that is sent now.
    pub(crate) fn record(&self, now: Instant, part: usize, part_bytes: usize, flags: u8) -> Record {
        let narrow = |value: usize| u32::try_from(value).unwrap_or(u32::MAX);
        let age = self.frame.age_us().saturating_add(micros(self.waited(now)));
        Record {
            message: self.number,
            total: narrow(self.bytes()),
            offset: narrow(part * part_bytes),
            length: narrow(self.part_length(part, part_bytes)),
            hops: u8::try_from(self.frame.hops().saturating_add(1)).unwrap_or(u8::MAX),
            flags,
            behind: self.behind,
            age_us: u32::try_from(age).unwrap_or(u32::MAX),
        }
    }
}

/// Place of a message in [`Messages`]; an old key finds nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Key {
    at: u32,
    stamp: u32,
}

/// One part of one message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PartRef {
    pub key: Key,
    pub part: usize,
}

/// Messages at fixed places, so that samples on the way refer to them without a search.
#[derive(Debug, Default)]
pub(crate) struct Messages {
    slots: Vec<(u32, Option<Outgoing>)>,
    free: Vec<u32>,
    /// Stamp of new places: above that of any that were given back.
    first_stamp: u32,
}

impl Messages {
    pub(crate) fn insert(&mut self, message: Outgoing) -> Key {
        if let Some(at) = self.free.pop() {
            let slot = &mut self.slots[at as usize];
            slot.1 = Some(message);
            return Key { at, stamp: slot.0 };
        }
        let at = u32::try_from(self.slots.len()).unwrap_or(u32::MAX);
        let stamp = self.first_stamp;
        self.slots.push((stamp, Some(message)));
        Key { at, stamp }
    }

    pub(crate) fn get(&self, key: Key) -> Option<&Outgoing> {
        let slot = self.slots.get(key.at as usize)?;
        if slot.0 == key.stamp { slot.1.as_ref() } else { None }
    }

    pub(crate) fn get_mut(&mut self, key: Key) -> Option<&mut Outgoing> {
        let slot = self.slots.get_mut(key.at as usize)?;
        if slot.0 == key.stamp { slot.1.as_mut() } else { None }
    }

    pub(crate) fn remove(&mut self, key: Key) -> Option<Outgoing> {
        let slot = self.slots.get_mut(key.at as usize)?;
        if slot.0 != key.stamp {
            return None;
        }
        let message = slot.1.take()?;
        slot.0 = slot.0.wrapping_add(1);
        self.free.push(key.at);
        Some(message)
    }

    /// Keys of the messages for which `wanted` holds.
    pub(crate) fn keys(&self, mut wanted: impl FnMut(&Outgoing) -> bool) -> Vec<Key> {
        let mut keys = Vec::new();
        for (at, (stamp, message)) in self.slots.iter().enumerate() {
            if message.as_ref().is_some_and(&mut wanted) {
                keys.push(Key { at: u32::try_from(at).unwrap_or(u32::MAX), stamp: *stamp });
            }
        }
        keys
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = &Outgoing> {
        self.slots.iter().filter_map(|slot| slot.1.as_ref())
    }

    /// Gives memory back once nothing waits.
    pub(crate) fn shrink_if_empty(&mut self) {
        const KEPT: usize = 1024;
        if self.free.len() == self.slots.len() && self.slots.len() > KEPT {
            let cut = self.slots.iter().skip(KEPT).map(|slot| slot.0).max().unwrap_or(0);
            self.first_stamp = self.first_stamp.max(cut.wrapping_add(1));
            self.slots.truncate(KEPT);
            self.slots.shrink_to_fit();
            self.free = (0..u32::try_from(KEPT).unwrap_or(0)).collect();
        }
    }
}
