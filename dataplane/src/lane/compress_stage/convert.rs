//! From the gates of bridges to brokers, for payloads in another encoding than was published.
//!
//! A message is converted once for each encoding, whatever the number of its bridges: small ones at
//! once, large ones and those of a type that is yet to be found by the pool. What needs no
//! conversion waits behind what does of the same writer and encoding, so its order is that of
//! admission. While others are asked for the definition of a type its messages wait, for some
//! seconds at most.

use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_domain::media::{JSON, Media, cdr_of};
use blaze_domain::{DropReason, TopicName, WhyCode, WriterId};
use blaze_proto::Frame;
use smallvec::SmallVec;

use super::{CodecJob, CodecTicket, CompressStage, ConvertTicket, Place};
use crate::codec::pool::Urgency;
use crate::codec::{Done, Work, guarded};
use crate::lane::admit::Admitted;
use crate::lane::core::DataCore;
use crate::lane::measure::micros;
use crate::lane::path::{BridgeState, Phase, TopicId, TopicInfo};
use crate::plan::Target;
use crate::types::{Conversion, ConvertFailure, Converted, Encoding, MessageType, Wanted};

/// Smaller payloads are converted by the thread that brings them.
const INLINE_BELOW: usize = 16 * 1024;
/// Larger ones take their time.
const QUICK_BYTES: usize = 128 * 1024;
/// Time between two events about one topic.
const REPORT_EVERY: Duration = Duration::from_secs(1);
/// How long a message waits while others are asked for the definition of its type.
const LONGEST_SEARCH: Duration = Duration::from_secs(10);
/// Failures that wait to be reported at most.
const MAX_REPORTS: usize = 1_024;

/// A topic's bridges that get a message, and until when.
pub(in crate::lane) type ToBrokers = SmallVec<[(usize, Option<Instant>); 2]>;

/// Topic, writer and encoding: what stays in order.
pub(super) type ConvertLine = (TopicId, (WriterId, Encoding));

/// A message that is to be converted, or waits behind such a one.
pub(super) struct Converting {
    pub(super) frame: Frame,
    /// Its type; of one that is ready, none.
    ty: Option<MessageType>,
    /// When age and time in the flow were right.
    came: Instant,
    here_us: u64,
    pub(super) bridges: ToBrokers,
}

/// What became of messages of a topic.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ConvertStats {
    /// Messages that became JSON.
    pub json: u64,
    /// Messages that became CDR.
    pub cdr: u64,
    /// Seconds that conversions took.
    pub seconds: f64,
}

/// A message that could not be converted, for `why`.
#[derive(Debug, Clone)]
pub struct Unconverted {
    /// When.
    pub at: Instant,
    /// Why not.
    pub failure: ConvertFailure,
}

/// What is to be done with a message.
enum Step<'a> {
    Nothing,
    /// Only its header changes: it names its type.
    Name(String),
    Convert(MessageType<&'a str>),
    Fail(ConvertFailure),
}

fn step<'a>(info: &'a TopicInfo, frame: &'a Frame, to: Encoding) -> Step<'a> {
    let published = info.types.published.as_ref();
    match (to, Media::of(frame.encoding())) {
        (Encoding::Json, Media::Json) | (Encoding::Cdr, Media::Cdr { type_name: Some(_) }) => {
            Step::Nothing
        }
        (Encoding::Cdr, Media::Cdr { type_name: None }) => match published {
            Some(ty) => Step::Name(cdr_of(&ty.name)),
            None => Step::Fail(nameless()),
        },
        (Encoding::Json, Media::Cdr { type_name }) => {
            let Some(name) = type_name.or_else(|| Some(published?.name.as_str())) else {
                return Step::Fail(nameless());
            };
            let of_lease = || Some(published.filter(|ty| ty.name == name)?.hash.as_str());
            let own = Some(frame.type_hash()).filter(|hash| !hash.is_empty());
            let hash = own.or_else(of_lease).unwrap_or_default();
            Step::Convert(MessageType { name, hash })
        }
        (Encoding::Cdr, Media::Json) => match &info.types.wanted {
            Wanted::Type(ty) => Step::Convert(ty.borrowed()),
            Wanted::Nothing => {
                let detail = "no ROS 2 reader names its type";
                Step::Fail(ConvertFailure::new(WhyCode::TypeUnknown, detail))
            }
            Wanted::Mismatch(detail) => {
                Step::Fail(ConvertFailure::new(WhyCode::TypeMismatch, detail.as_str()))
            }
        },
        (to, Media::Other) => {
            let what = match frame.encoding() {
                "" => "a payload without an encoding",
                encoding => encoding,
            };
            let detail = format!("{what} is not converted to {to}");
            Step::Fail(ConvertFailure::new(WhyCode::ConvertError, detail))
        }
    }
}

fn urgency(bytes: usize) -> Urgency {
    if bytes > QUICK_BYTES { Urgency::Long } else { Urgency::Quick }
}

fn is_unknown(done: &Done) -> bool {
    matches!(done, Done::Converted(Err(failure)) if failure.code == WhyCode::TypeUnknown)
}

fn nameless() -> ConvertFailure {
    let detail = "neither the message nor its publisher names the type of the CDR";
    ConvertFailure::new(WhyCode::TypeUnknown, detail)
}

/// The message with its new payload.
fn recoded(frame: &Frame, to: Encoding, done: Converted) -> Result<Frame, ConvertFailure> {
    let frame = match to {
        Encoding::Json => frame.recoded(JSON, frame.type_hash(), done.payload),
        Encoding::Cdr => frame.recoded(&cdr_of(&done.name), &done.hash.to_string(), done.payload),
    };
    frame.map_err(|error| ConvertFailure::new(WhyCode::ConvertError, error.to_string()))
}

impl DataCore {
    /// Takes a message that bridges to brokers have admitted, for an encoding that they write.
    pub(in crate::lane) fn convert(
        &mut self,
        now: Instant,
        topic: TopicId,
        message: &Admitted,
        to: Encoding,
        bridges: ToBrokers,
    ) {
        let frame = &message.frame;
        let line = (topic, (frame.writer(), to));
        let bytes = frame.payload().len();
        let ready = match step(&self.topics[topic.0 as usize].info, frame, to) {
            Step::Nothing => Ok(frame.clone()),
            Step::Name(encoding) => frame
                .recoded(&encoding, frame.type_hash(), frame.payload().clone())
                .map_err(|error| ConvertFailure::new(WhyCode::ConvertError, error.to_string())),
            Step::Fail(failure) => Err(failure),
            Step::Convert(ty) => {
                let is_sought = || self.types.is_sought(&ty.owned());
                let known = self.types.known(now, ty).filter(|it| it.is_ok() || !is_sought());
                if self.compress.enabled && (known.is_none() || bytes >= INLINE_BELOW) {
                    let ty = Some(ty.owned());
                    let frame = frame.clone();
                    let waiting =
                        Converting { frame, ty, came: now, here_us: message.here_us, bridges };
                    self.wait_to_convert(now, line, waiting, bytes);
                    return;
                }
                let found = known.unwrap_or_else(|| self.types.get(now, ty));
                let run = || Done::Converted(found.and_then(|ty| ty.convert(to, frame.payload())));
                let done = guarded(run);
                self.noted(topic, to, done).and_then(|done| recoded(frame, to, done))
            }
        };
        match ready {
            Ok(frame) => {
                let here_us = message.here_us;
                self.go_on(now, line, Converting { frame, ty: None, came: now, here_us, bridges });
            }
            Err(failure) => {
                self.calls.note_failed(frame, &failure);
                self.cannot_convert(now, topic, &bridges, &failure);
            }
        }
    }

    /// What is ready goes on, behind what came before it.
    fn go_on(&mut self, now: Instant, line: ConvertLine, message: Converting) {
        if self.compress.convert.is_clear(&line) {
            self.write(now, line.0, &message);
            return;
        }
        let bytes = message.frame.payload().len();
        self.enter(line.0, &message);
        if let Err((message, _)) = self.compress.convert.push_ready(line, message, bytes) {
            self.refuse_to_convert(line.0, &message, DropReason::QueueFull);
        }
    }

    /// Keeps a place for a message until the pool has converted it. Where there is no room the
    /// oldest gives way.
    fn wait_to_convert(
        &mut self,
        now: Instant,
        line: ConvertLine,
        message: Converting,
        bytes: usize,
    ) {
        self.enter(line.0, &message);
        let urgency = urgency(bytes);
        let pushed = self.compress.convert.push_waiting(line, urgency, message, bytes, usize::MAX);
        let refused = pushed.refused.map(|(message, _)| message);
        for message in pushed.gave_way.iter().chain(&refused) {
            self.refuse_to_convert(line.0, message, DropReason::QueueFull);
        }
        self.flush_convert(now, line);
    }

    /// The message whose turn it is. Bridges for which it has become too old do not get it.
    pub(super) fn begin_convert(&mut self, now: Instant, urgency: Urgency) -> Option<CodecJob> {
        loop {
            let (place, message) = self.compress.convert.begin(urgency)?;
            let (topic, (_, to)) = *place.key();
            let bridges = &mut self.topics[topic.0 as usize].bridges;
            message.bridges.retain(|(at, deadline)| {
                let is_late = deadline.is_some_and(|deadline| deadline <= now);
                if is_late {
                    bridges[*at].in_codec = bridges[*at].in_codec.saturating_sub(1);
                    bridges[*at].stats.dropped.add(DropReason::Lifespan, 1);
                }
                !is_late
            });
            if let (false, Some(ty)) = (message.bridges.is_empty(), message.ty.clone()) {
                let types = Arc::clone(&self.types);
                return Some(CodecJob {
                    ticket: CodecTicket { place: Place::Convert(place) },
                    payload: message.frame.payload().clone(),
                    work: Work::Convert(Conversion { types, ty, to }),
                });
            }
            self.compress.convert.give_up(&place);
            self.flush_convert(now, *place.key());
            self.stir();
        }
    }

    /// Takes the result of a job.
    pub(super) fn finished_convert(&mut self, now: Instant, place: &ConvertTicket, done: Done) {
        if is_unknown(&done) && self.wait_for_type(now, place) {
            return;
        }
        let (topic, (_, to)) = *place.key();
        let done = self.noted(topic, to, done);
        let Some(message) = self.compress.convert.begun(place) else { return };
        match done.and_then(|done| recoded(&message.frame, to, done)) {
            Ok(frame) => {
                let bytes = frame.payload().len();
                message.frame = frame;
                self.compress.convert.finish(place, bytes);
            }
            Err(failure) => {
                if let Some(message) = self.compress.convert.give_up(place) {
                    self.calls.note_failed(&message.frame, &failure);
                    self.leave_codec(topic, &message);
                    self.cannot_convert(now, topic, &message.bridges, &failure);
                }
            }
        }
        self.flush_convert(now, *place.key());
    }

    /// Lets a message wait while its type is sought with others. `false`: it is not, or has waited
    /// for long enough.
    fn wait_for_type(&mut self, now: Instant, place: &ConvertTicket) -> bool {
        let Some(message) = self.compress.convert.begun(place) else { return false };
        let Some(ty) = &message.ty else { return false };
        if now.saturating_duration_since(message.came) >= LONGEST_SEARCH {
            return false;
        }
        if self.types.is_sought(ty) {
            self.compress.unknown.entry(ty.clone()).or_default().push(*place);
            return true;
        }
        // It may have come since the pool looked.
        let is_unknown = self.types.known(now, ty.borrowed()).is_some_and(|it| it.is_err());
        !is_unknown && self.convert_again(place)
    }

    /// Converts messages whose types are not sought any more, and those that have waited for long
    /// enough.
    pub fn look_for_types(&mut self, now: Instant) {
        let CompressStage { unknown, convert, .. } = &mut self.compress;
        let types = &self.types;
        let mut over = Vec::new();
        unknown.retain(|ty, places| {
            let is_sought = types.is_sought(ty);
            let waits = |place: &ConvertTicket| {
                let came = convert.begun(place).map(|message| message.came);
                let is_early = |came| now.saturating_duration_since(came) < LONGEST_SEARCH;
                is_sought && came.is_some_and(is_early)
            };
            let first = places.iter().position(waits).unwrap_or(places.len());
            over.extend(places.drain(..first));
            !places.is_empty()
        });
        for place in &over {
            self.convert_again(place);
        }
    }

    fn convert_again(&mut self, place: &ConvertTicket) -> bool {
        let convert = &mut self.compress.convert;
        let bytes = convert.begun(place).map_or(0, |message| message.frame.payload().len());
        convert.wait_again(place, urgency(bytes))
    }

    /// Drops what waits for its type.
    pub(super) fn give_up_unknown(&mut self, now: Instant) {
        for place in std::mem::take(&mut self.compress.unknown).into_values().flatten() {
            if let Some(message) = self.compress.convert.give_up(&place) {
                self.refuse_to_convert(place.key().0, &message, DropReason::Shutdown);
            }
            self.flush_convert(now, *place.key());
        }
    }

    /// Hands on what is next in a line.
    pub(super) fn flush_convert(&mut self, now: Instant, line: ConvertLine) {
        while let Some(message) = self.compress.convert.pop_ready(&line) {
            self.leave_codec(line.0, &message);
            self.write(now, line.0, &message);
        }
    }

    /// A message leaves the line and is not written.
    pub(super) fn refuse_to_convert(
        &mut self,
        topic: TopicId,
        message: &Converting,
        reason: DropReason,
    ) {
        self.leave_codec(topic, message);
        self.compress.refused += u64::from(reason == DropReason::QueueFull);
        for (at, _) in &message.bridges {
            self.topics[topic.0 as usize].bridges[*at].stats.dropped.add(reason, 1);
        }
    }

    /// Failures since the last call, at most one a second and topic.
    pub fn take_convert_failures(&mut self) -> Vec<(TopicName, ConvertFailure)> {
        std::mem::take(&mut self.convert_failures)
    }

    fn enter(&mut self, topic: TopicId, message: &Converting) {
        for (at, _) in &message.bridges {
            self.topics[topic.0 as usize].bridges[*at].in_codec += 1;
        }
    }

    fn leave_codec(&mut self, topic: TopicId, message: &Converting) {
        for (at, _) in &message.bridges {
            let bridge = &mut self.topics[topic.0 as usize].bridges[*at];
            bridge.in_codec = bridge.in_codec.saturating_sub(1);
        }
    }

    /// To the brokers. One whose bridge has ended meanwhile does not get it.
    fn write(&mut self, now: Instant, topic: TopicId, message: &Converting) {
        let waited = micros(now.saturating_duration_since(message.came));
        let frame = message.frame.clone();
        let (hops, age_us) = (frame.hops(), frame.age_us().saturating_add(waited));
        let frame = frame.with_hops_and_age(hops, age_us);
        for (at, deadline) in &message.bridges {
            let bridge = &mut self.topics[topic.0 as usize].bridges[*at];
            if matches!(bridge.phase, Phase::Up { .. } | Phase::Draining { .. }) {
                bridge.write(now, &frame, message.here_us.saturating_add(waited), *deadline);
            } else {
                bridge.stats.dropped.add(DropReason::NoDestination, 1);
            }
        }
    }

    /// Counts a conversion.
    fn noted(
        &mut self,
        topic: TopicId,
        to: Encoding,
        done: Done,
    ) -> Result<Converted, ConvertFailure> {
        let Done::Converted(result) = done else {
            return Err(ConvertFailure::new(WhyCode::ConvertError, "the converter failed"));
        };
        let stats = &mut self.topics[topic.0 as usize].convert_stats;
        if let Ok(converted) = &result {
            match to {
                Encoding::Json => stats.json += 1,
                Encoding::Cdr => stats.cdr += 1,
            }
            stats.seconds += converted.took.as_secs_f64();
        }
        result
    }

    /// Drops a message for these bridges, and reports it.
    fn cannot_convert(
        &mut self,
        now: Instant,
        topic: TopicId,
        bridges: &ToBrokers,
        failure: &ConvertFailure,
    ) {
        let path = &mut self.topics[topic.0 as usize];
        for (at, _) in bridges {
            let bridge = &mut path.bridges[*at];
            bridge.stats.dropped.add(failure.reason(), 1);
            bridge.unconverted = Some(Unconverted { at: now, failure: failure.clone() });
        }
        let is_due = |at: Instant| now.saturating_duration_since(at) >= REPORT_EVERY;
        if path.failure_reported.is_none_or(is_due) && self.convert_failures.len() < MAX_REPORTS {
            path.failure_reported = Some(now);
            self.convert_failures.push((path.name.clone(), failure.clone()));
        }
    }
}

impl BridgeState {
    /// The encoding that it writes, if that may be another one than was published.
    pub(in crate::lane) fn encoding(&self) -> Option<Encoding> {
        match &self.target {
            Target::Ros2 => Some(Encoding::Cdr),
            target if target.is_json() => Some(Encoding::Json),
            _ => None,
        }
    }
}
