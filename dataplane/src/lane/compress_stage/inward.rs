//! From the link to the bridges that write to brokers.

use std::time::Instant;

use blaze_domain::{DropReason, Scope, WriterId};
use blaze_proto::Frame;
use blaze_proto::frame::Compression;

use super::Line;
use crate::codec::order::Ticket;
use crate::codec::pool::Urgency;
use crate::codec::{Done, Work, guarded, lz4};
use crate::lane::admit::Admitted;
use crate::lane::core::{DataCore, LaneLink};
use crate::lane::measure::micros;
use crate::lane::path::TopicId;

impl DataCore {
    /// Takes a message that came over the link and was not seen before.
    pub(in crate::lane) fn compress_in(
        &mut self,
        now: Instant,
        topic: TopicId,
        message: Admitted,
        link: &mut dyn LaneLink,
    ) {
        let line = (topic, message.frame.writer());
        match message.frame.compression() {
            Compression::None => self.arrive(now, line, message, link),
            Compression::Unknown(_) => self.refuse_inward(topic, DropReason::DecompressError),
            Compression::Lz4Block if self.compress.enabled => self.wait_in(line, message),
            Compression::Lz4Block => match plain(&message.frame) {
                Some(frame) => self.arrive(now, line, Admitted { frame, ..message }, link),
                None => self.refuse_inward(topic, DropReason::DecompressError),
            },
        }
    }

    /// A message that is as it was published goes on, behind what came before it.
    fn arrive(&mut self, now: Instant, line: Line, message: Admitted, link: &mut dyn LaneLink) {
        if self.compress.into.is_clear(&line) {
            self.deliver_inward(now, line.0, &message, link);
            return;
        }
        let bytes = message.frame.payload().len();
        if self.compress.into.push_ready(line, Box::new(message), bytes).is_err() {
            self.compress.refused += 1;
            self.refuse_inward(line.0, DropReason::QueueFull);
        }
    }

    fn wait_in(&mut self, line: Line, message: Admitted) {
        let found = message.frame.payload().len();
        // One that lies about its size takes no room from others.
        let Ok(size) = lz4::announced_size(found, message.frame.uncompressed_bytes()) else {
            self.refuse_inward(line.0, DropReason::DecompressError);
            return;
        };
        // It holds the one, and then the other.
        let bytes = found.max(size);
        let pushed =
            self.compress.into.push_waiting(line, Urgency::Quick, Box::new(message), bytes, 0);
        if pushed.refused.is_some() {
            self.compress.refused += 1;
            self.refuse_inward(line.0, DropReason::QueueFull);
        }
    }

    /// Takes the result of a job.
    pub(super) fn finished_in(
        &mut self,
        now: Instant,
        place: &Ticket<TopicId, WriterId>,
        done: Done,
        link: &mut dyn LaneLink,
    ) {
        let Some(message) = self.compress.into.begun(place) else {
            return;
        };
        let frame = match done {
            Done::Decompressed(payload) => message.frame.decompressed(payload).ok(),
            _ => None,
        };
        if let Some(frame) = frame {
            let bytes = frame.payload().len();
            message.frame = frame;
            self.compress.into.finish(place, bytes);
        } else {
            self.compress.into.give_up(place);
            self.refuse_inward(place.key().0, DropReason::DecompressError);
        }
        self.flush_in(now, *place.key(), link);
    }

    /// Hands on what is next in a line.
    pub(super) fn flush_in(&mut self, now: Instant, line: Line, link: &mut dyn LaneLink) {
        while let Some(message) = self.compress.into.pop_ready(&line) {
            self.deliver_inward(now, line.0, &message, link);
        }
    }

    fn deliver_inward(
        &mut self,
        now: Instant,
        topic: TopicId,
        message: &Admitted,
        link: &mut dyn LaneLink,
    ) {
        if !self.topics[topic.0 as usize].delivers() {
            // Its bridges have ended while it was with the codec.
            self.refuse_inward(topic, DropReason::NoDestination);
            return;
        }
        // It is older by what that took.
        let waited = micros(now.saturating_duration_since(message.came));
        if waited == 0 {
            self.fan_out(now, topic, Scope::Inter, message, link);
        } else {
            self.fan_out(now, topic, Scope::Inter, &message.older(waited), link);
        }
    }

    pub(super) fn refuse_inward(&mut self, topic: TopicId, reason: DropReason) {
        self.topics[topic.0 as usize].ingress_drops.add(reason, 1);
    }
}

/// A compressed frame as it was, on the thread of the caller; `None` where that cannot be.
pub(in crate::lane) fn plain(frame: &Frame) -> Option<Frame> {
    let work = Work::Decompress(frame.uncompressed_bytes());
    match guarded(|| work.run(frame.payload())) {
        Done::Decompressed(payload) => frame.decompressed(payload).ok(),
        _ => None,
    }
}
