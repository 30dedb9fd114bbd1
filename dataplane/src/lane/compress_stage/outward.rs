//! From the gates of the lanes to their queues.

use std::time::Instant;

use blaze_domain::{DropReason, WriterId};
use blaze_proto::Frame;
use smallvec::SmallVec;

use super::{Arrival, CodecJob, CodecTicket, Line, Place};
use crate::codec::order::Ticket;
use crate::codec::pool::Urgency;
use crate::codec::{Done, Work};
use crate::lane::core::{DataCore, LaneLink};
use crate::lane::path::{BridgeState, Phase, TopicId, TopicPath};
use crate::lane::succession::Waiting;

/// Larger payloads take their time, whatever counts as large.
const QUICK_BYTES: usize = 128 * 1024;

/// A message on its way to lanes: which bridges, and what each of them gets.
pub(in crate::lane) type ToLanes = SmallVec<[(usize, Waiting); 2]>;

/// A message that waits for the codec, or behind such a one.
#[derive(Debug)]
pub(super) struct Outward {
    /// At which it is to be compressed.
    level: u8,
    pub(super) lanes: ToLanes,
}

impl BridgeState {
    /// A message of it goes to the codec. It is counted as taken when it leaves there: it may go to
    /// another bridge.
    fn enters_codec(&mut self, bytes: u64) {
        self.in_codec += 1;
        self.stats.taken.remove(bytes);
    }

    /// It comes back.
    fn leaves_codec(&mut self, bytes: u64) {
        self.in_codec = self.in_codec.saturating_sub(1);
        self.stats.taken.add(bytes);
    }

    /// Whether its receiver decompresses.
    fn takes_lz4(&self, link: &dyn LaneLink) -> bool {
        self.receiver().is_some_and(|(_, flow)| link.takes_lz4(flow))
    }
}

impl TopicPath {
    /// So many large messages of a writer wait for the codec at most; 0: only bytes count. A
    /// message is compressed for all lanes at once, so none gives way as long as one lane keeps
    /// all.
    fn keep_newest(&self) -> usize {
        let lanes = self.bridges.iter().filter(|bridge| {
            bridge.lane_id().is_some()
                && matches!(bridge.phase, Phase::Up { .. } | Phase::Draining { .. })
        });
        let keeps = lanes.map(BridgeState::keep_newest);
        keeps
            .reduce(|one, other| if one == 0 || other == 0 { 0 } else { one.max(other) })
            .unwrap_or(0)
    }
}

impl DataCore {
    /// Takes a message that lanes have admitted.
    pub(in crate::lane) fn compress_out(
        &mut self,
        now: Instant,
        topic: TopicId,
        frame: &Frame,
        lanes: ToLanes,
        arrival: Arrival,
        link: &mut dyn LaneLink,
    ) {
        let line = (topic, frame.writer());
        let bytes = frame.payload().len();
        let level = self.level_for(now, topic, bytes, &lanes, link);
        if level.is_none() && self.compress.out.is_clear(&line) {
            self.put_to_lanes(now, topic, lanes, link);
            return;
        }
        let path = &mut self.topics[topic.0 as usize];
        for (at, waiting) in &lanes {
            path.bridges[*at].enters_codec(waiting.bytes);
        }
        let is_large = lanes.iter().any(|(_, waiting)| waiting.large);
        let keep = if is_large { path.keep_newest() } else { 0 };
        let urgency = if is_large || bytes > QUICK_BYTES { Urgency::Long } else { Urgency::Quick };
        let refused = if let Some(level) = level {
            let pushed = self.compress.out.push_waiting(
                line,
                urgency,
                Outward { level, lanes },
                bytes,
                keep,
            );
            for out in &pushed.gave_way {
                self.lose(topic, out, DropReason::QueueFull);
            }
            match pushed.refused {
                Some((out, _)) if arrival == Arrival::Kept => {
                    let as_it_is = Outward { level: 0, ..out };
                    self.compress.out.push_ready(line, as_it_is, bytes).err()
                }
                refused => refused,
            }
        } else {
            let out = Outward { level: 0, lanes };
            self.compress.out.push_ready(line, out, bytes).err()
        };
        if let Some((out, _)) = refused {
            self.compress.refused += 1;
            self.lose(topic, &out, DropReason::QueueFull);
        }
        self.flush_out(now, line, link);
    }

    /// The level for a message; `None`: it goes as it is.
    fn level_for(
        &mut self,
        now: Instant,
        topic: TopicId,
        bytes: usize,
        lanes: &ToLanes,
        link: &dyn LaneLink,
    ) -> Option<u8> {
        let path = &mut self.topics[topic.0 as usize];
        let takes =
            |path: &TopicPath| lanes.iter().any(|(at, _)| path.bridges[*at].takes_lz4(link));
        if !self.compress.enabled || !path.is_worth(bytes) || !takes(path) {
            return None;
        }
        path.worth_rate.add(now, bytes as u64);
        path.effort.next(now, path.compression)
    }

    /// Notes the size of a message that a lane could send: of one that is compressed that is known
    /// when it has been.
    pub(in crate::lane) fn note_size(
        &mut self,
        now: Instant,
        topic: TopicId,
        bytes: usize,
        link: &dyn LaneLink,
    ) {
        let path = &mut self.topics[topic.0 as usize];
        if !self.compress.enabled || !path.is_worth(bytes) {
            self.allocation_due |= path.sent_size.note(now, bytes as u64);
            return;
        }
        let takes = |bridge: &BridgeState| bridge.takes() && bridge.takes_lz4(link);
        if path.level() == 0 || !path.bridges.iter().any(takes) {
            self.allocation_due |= path.note_sent(now, bytes, 0);
        }
    }

    /// The message whose turn it is. Lanes for which it has become too old do not get it.
    pub(super) fn begin_outward(
        &mut self,
        now: Instant,
        urgency: Urgency,
        link: &mut dyn LaneLink,
    ) -> Option<CodecJob> {
        loop {
            let (place, out) = self.compress.out.begin(urgency)?;
            let bridges = &mut self.topics[place.key().0.0 as usize].bridges;
            out.lanes.retain(|(at, waiting)| {
                let is_late = waiting.is_too_old(now);
                if is_late {
                    let bridge = &mut bridges[*at];
                    bridge.leaves_codec(waiting.bytes);
                    bridge.stats.dropped.add(DropReason::Lifespan, 1);
                }
                !is_late
            });
            if let Some((_, waiting)) = out.lanes.first() {
                return Some(CodecJob {
                    ticket: CodecTicket { place: Place::Out(place) },
                    payload: waiting.frame.payload().clone(),
                    work: Work::Compress(out.level),
                });
            }
            self.compress.out.give_up(&place);
            self.flush_out(now, *place.key(), link);
            self.stir();
        }
    }

    /// Takes the result of a job. Whatever it is, the message leaves.
    pub(super) fn finished_out(
        &mut self,
        now: Instant,
        place: &Ticket<TopicId, WriterId>,
        done: Done,
        link: &mut dyn LaneLink,
    ) {
        let Some(out) = self.compress.out.begun(place) else { return };
        let path = &mut self.topics[place.key().0.0 as usize];
        let mut level = 0;
        if let Done::Compressed(done) = done {
            path.effort.compressed(now, &done);
            path.compress_stats.note(&done);
            level = done.level;
            for (at, waiting) in &mut out.lanes {
                if !path.bridges[*at].takes_lz4(link) {
                    level = 0;
                } else if let Some(block) = &done.block
                    // Only a header without room for the new fields cannot take it: then it goes as
                    // it is.
                    && let Ok(frame) = waiting.frame.compressed(block.clone(), done.before as u64)
                {
                    waiting.frame = frame;
                }
            }
        }
        let sizes = out.lanes.iter().map(|(_, waiting)| waiting.frame.payload().len());
        let bytes = sizes.max().unwrap_or(0);
        // What was tried at another level, or begun before it changed, says nothing of the others.
        self.allocation_due |= if level == 0 || level == path.level() {
            path.note_sent(now, bytes, level)
        } else {
            path.sent_size.note(now, bytes as u64)
        };
        self.compress.out.finish(place, bytes);
        self.flush_out(now, *place.key(), link);
    }

    /// Hands on what is next in a line.
    pub(super) fn flush_out(&mut self, now: Instant, line: Line, link: &mut dyn LaneLink) {
        let topic = line.0;
        while let Some(Outward { lanes, .. }) = self.compress.out.pop_ready(&line) {
            for (at, waiting) in &lanes {
                self.topics[topic.0 as usize].bridges[*at].leaves_codec(waiting.bytes);
            }
            self.put_to_lanes(now, topic, lanes, link);
        }
    }

    /// To the queues of the lanes. One that has ended meanwhile has nobody to send to.
    pub(in crate::lane) fn put_to_lanes(
        &mut self,
        now: Instant,
        topic: TopicId,
        lanes: ToLanes,
        link: &mut dyn LaneLink,
    ) {
        for (at, waiting) in lanes {
            let bridge = &mut self.topics[topic.0 as usize].bridges[at];
            if matches!(bridge.phase, Phase::Up { .. } | Phase::Draining { .. }) {
                bridge.queue(now, topic, waiting, &mut self.succession, link);
            } else {
                bridge.stats.dropped.add(DropReason::NoDestination, 1);
            }
        }
    }

    /// A message leaves the line and goes nowhere.
    pub(super) fn lose(&mut self, topic: TopicId, out: &Outward, reason: DropReason) {
        for (at, waiting) in &out.lanes {
            let bridge = &mut self.topics[topic.0 as usize].bridges[*at];
            bridge.leaves_codec(waiting.bytes);
            bridge.stats.dropped.add(reason, 1);
        }
    }
}
