//! What one bridge does with a message: filter, lifespan, rate, then broker or lane.

use std::time::{Duration, Instant};

use blaze_brokers::PublishOutcome;
use blaze_domain::{DropReason, FlowId, Priority, Scope};
use blaze_proto::Frame;

use super::admit::Admitted;
use super::allocation::LaneGates;
use super::compress_stage::plain;
use super::core::{DRAIN, LaneLink};
use super::load::LoadMeter;
use super::measure::RateMeter;
use super::path::{BridgeState, Phase, Sink, TopicId};
use super::reading::For;
use super::stats::BridgeStats;
use super::succession::{Succession, Waiting};
use super::writer::{NewWriter, Writer};
use crate::limit::gate::Gate;
use crate::link::{StreamKey, Submit};
use crate::plan::{Bridge, Target};
use crate::types::Encoding;

/// Replaced writers of a bridge that may still have something to deliver.
const MAX_PAST: usize = 4;

/// Time that large messages of a best-effort topic may wait, as long as they do so in turn: two
/// images at 16 Hz. Slower topics, whose images take longer than that, keep no more than the
/// newest.
const SLACK: Duration = Duration::from_millis(125);

/// What a bridge has admitted and not written.
#[expect(clippy::large_enum_variant, reason = "it is taken apart at once, and a box costs more")]
pub(super) enum Passed {
    /// For its lane.
    ToLane(Waiting),
    /// For its broker, in this encoding and until then.
    ToConvert { to: Encoding, deadline: Option<Instant> },
}

impl BridgeState {
    pub(super) fn new(now: Instant, planned: &Bridge, sink: Sink) -> Self {
        Self {
            from: planned.from,
            target: planned.to.clone(),
            lane: planned.lane.clone(),
            phase: Phase::Up { since: now },
            failure: None,
            ended: None,
            gate: Gate::new(planned.lane.max_rate_hz, now),
            allocated_hz: None,
            exceeds_advertised: false,
            sink,
            in_codec: 0,
            submitted: false,
            held: None,
            unwritten: None,
            unconverted: None,
            stats: BridgeStats::default(),
            out_rate: RateMeter::new(now),
            load: LoadMeter::new(now),
        }
    }

    /// Takes what is planned now. Returns whether it begins to take messages in.
    pub(super) fn renew(&mut self, now: Instant, planned: &Bridge) -> bool {
        let begins = matches!(self.phase, Phase::Draining { .. } | Phase::Ended);
        if begins {
            self.phase = Phase::Up { since: now };
            self.load = LoadMeter::new(now);
            self.unwritten = None;
        }
        let begins = begins || (planned.lane.durable && !self.lane.durable);
        self.ended = None;
        self.gate.set_max_rate(planned.lane.max_rate_hz, now);
        self.lane = planned.lane.clone();
        begins
    }

    /// Gives a bridge to a local broker its writer, or says why there is none. One that it had goes
    /// on delivering.
    pub(super) fn set_writer(&mut self, now: Instant, made: Result<NewWriter, String>) {
        let Sink::Publish { writer, past, .. } = &mut self.sink else {
            return;
        };
        match made {
            Ok(made) => {
                if let Phase::Failed { .. } = self.phase {
                    self.phase = Phase::Up { since: now };
                }
                self.failure = None;
                if writer.as_ref().is_some_and(|writer| writer.is(&made)) {
                    return;
                }
                past.extend(writer.replace(Writer::new(made)));
                if past.len() > MAX_PAST {
                    past.remove(0).close(&mut self.stats);
                }
            }
            // One that works is better than none.
            Err(_) if writer.is_some() => {}
            Err(reason) => {
                if !matches!(self.phase, Phase::Failed { .. }) {
                    self.phase = Phase::Failed { since: now };
                    tracing::warn!(
                        from = %self.from,
                        to = ?self.target,
                        reason,
                        "a bridge cannot write, trying on",
                    );
                }
                self.failure = Some(reason);
            }
        }
    }

    /// Brings the counters up to date with what the broker's adapter did, and lets go of writers
    /// that have nothing more to deliver. Returns how many messages wait there.
    pub fn settle(&mut self) -> u64 {
        let ended = self.phase == Phase::Ended;
        let Sink::Publish { writer, past, .. } = &mut self.sink else {
            return 0;
        };
        let stats = &mut self.stats;
        let mut waiting = 0;
        past.retain_mut(|writer| {
            let queued = writer.settle(stats);
            waiting += queued;
            queued > 0
        });
        if let Some(current) = writer {
            let queued = current.settle(stats);
            waiting += queued;
            if ended && queued == 0 {
                *writer = None;
            }
        }
        waiting
    }

    /// It takes nothing more and has nothing to empty.
    pub(super) fn end(&mut self, now: Instant) {
        (self.phase, self.ended, self.failure) = (Phase::Ended, Some(now), None);
        self.settle();
    }

    /// Whether the message is meant for this bridge at all; what is not is not counted as taken.
    pub(super) fn wants(&self, me: &FlowId, message: &Admitted) -> bool {
        if message.kept && !self.lane.durable || !self.is_way_of(me, message) {
            return false;
        }
        if self.lane.from.is_empty() {
            return true;
        }
        let frame = &message.frame;
        self.lane.carries(frame.origin_layer(), frame.origin_node(), frame.origin_service())
    }

    /// Whether the message goes where the bridge writes on no other way.
    fn is_way_of(&self, me: &FlowId, message: &Admitted) -> bool {
        let frame = &message.frame;
        match &self.target {
            // What a flow wrote stays in the layer: only what was born here leaves for another one,
            // and what a flow that is not on the inter scope wrote from its node.
            Target::Inter { layer, .. } => {
                let is_for = frame.to().is_empty()
                    || frame.to().split_once('/').is_some_and(|(to, _)| to == layer.as_str());
                is_for && (message.born_here || self.relays(message))
            }
            // What was born on a flow of the network that flow writes there.
            Target::Ros2 => {
                let is_for = frame.to().is_empty() || me.is_written(frame.to());
                let (layer, node) = (frame.origin_layer(), frame.origin_node());
                is_for && !self.lane.natives.write(self.from, message.hops, layer, node)
            }
            // The flow that wrote it to the layer made the copy.
            Target::Layer { json: true } => self.from != Scope::Layer || message.born_here,
            Target::Layer { json: false } | Target::Node(_) => true,
        }
    }

    fn relays(&self, message: &Admitted) -> bool {
        let frame = &message.frame;
        self.from == Scope::Layer
            && message.hops == 1
            && self.lane.relays(frame.origin_layer(), frame.origin_node())
    }

    /// Whether it is among those that a message is for.
    pub(super) fn is_meant(&self, meant: For) -> bool {
        match meant {
            For::All => true,
            For::Outside => self.receiver().is_some(),
            For::Inside => self.receiver().is_none(),
        }
    }

    /// Takes a message that it wants: filters, counts, and writes it to a broker. Returns what is
    /// to go to its lane, or to be written in another encoding.
    pub(super) fn pass(
        &mut self,
        now: Instant,
        message: &Admitted,
        large: bool,
        gates: &mut LaneGates,
    ) -> Option<Passed> {
        if let Phase::Draining { until, latest } = &mut self.phase {
            *until = (*until).max(now + DRAIN).min(*latest);
        }
        let frame = &message.frame;
        let bytes = frame.payload().len() as u64;
        self.stats.taken.add(bytes);
        let lifespan_ms = match (frame.lifespan_ms(), self.lane.lifespan_ms) {
            (0, other) | (other, 0) => other,
            (one, other) => one.min(other),
        };
        if lifespan_ms > 0 && message.age_us > u64::from(lifespan_ms) * 1000 {
            self.stats.dropped.add(DropReason::Lifespan, 1);
            return None;
        }
        let admitted = self.admit(now, message, gates);
        // What the budget skips is asked for, too: a flow that has to skip carries more than one
        // that does not.
        if matches!(admitted, Ok(()) | Err(DropReason::RateLimit)) {
            self.load.add(bytes);
        }
        if let Err(reason) = admitted {
            self.stats.dropped.add(reason, 1);
            return None;
        }
        match &self.sink {
            Sink::Publish { .. } => {
                let deadline = (lifespan_ms > 0).then(|| {
                    now + Duration::from_millis(lifespan_ms.into())
                        - Duration::from_micros(message.age_us)
                });
                if let Some(to) = self.encoding() {
                    return Some(Passed::ToConvert { to, deadline });
                }
                self.write(now, frame, message.here_us, deadline);
                None
            }
            Sink::Lane { .. } => Some(Passed::ToLane(Waiting {
                large,
                bytes,
                frame: frame.clone().with_hops_and_age(message.hops, message.age_us),
                arrived: now,
                lifespan: (lifespan_ms > 0).then(|| Duration::from_millis(lifespan_ms.into())),
            })),
        }
    }

    /// Hands a message to the broker. `here_us`: since it came to this flow.
    pub(super) fn write(
        &mut self,
        now: Instant,
        frame: &Frame,
        here_us: u64,
        deadline: Option<Instant>,
    ) {
        let Sink::Publish { writer, bare, .. } = &mut self.sink else { return };
        let Some(writer) = writer else {
            self.stats.dropped.add(DropReason::BrokerError, 1);
            return;
        };
        match writer.publish(frame, *bare, deadline) {
            PublishOutcome::Taken => {
                self.stats.latency.record(here_us);
                self.stats.ages.record(frame.origin_layer(), frame.age_us());
                self.out_rate.add(now, frame.payload().len() as u64);
            }
            PublishOutcome::Dropped => self.stats.dropped.add(DropReason::BrokerError, 1),
            PublishOutcome::TooLarge => self.stats.dropped.add(DropReason::TooLarge, 1),
        }
    }

    /// Whether a message may pass: first what is asked for, then what the budget gives the lane.
    /// What is kept for late joiners comes at once and is not repeated: each of them gets all of
    /// it, and the budget is the pacer's then.
    fn admit(
        &mut self,
        now: Instant,
        message: &Admitted,
        gates: &mut LaneGates,
    ) -> Result<(), DropReason> {
        if message.kept {
            return Ok(());
        }
        if !self.gate.admit(now) {
            return Err(DropReason::MaxRate);
        }
        match self.receiver() {
            Some((_, receiver)) => gates.admit(now, receiver),
            None => Ok(()),
        }
    }

    /// To the lane's queue, or behind what is held before it.
    pub(super) fn queue(
        &mut self,
        now: Instant,
        topic: TopicId,
        waiting: Waiting,
        succession: &mut Succession,
        link: &mut dyn LaneLink,
    ) {
        if self.held.is_some() {
            // It is counted when it leaves here: it may go to another bridge.
            self.stats.taken.remove(waiting.bytes);
            self.hold(waiting, succession);
        } else {
            self.submit(now, topic, waiting, link);
        }
    }

    /// Gives a message to the link.
    pub(super) fn submit(
        &mut self,
        now: Instant,
        topic: TopicId,
        mut message: Waiting,
        link: &mut dyn LaneLink,
    ) {
        let keep_newest = self.keep_newest();
        let (Sink::Lane { lane, class }, Target::Inter { receiver, .. }) =
            (&mut self.sink, &self.target)
        else {
            return;
        };
        // It was compressed for a receiver before this one.
        if message.frame.is_compressed() && !link.takes_lz4(receiver) {
            let Some(frame) = plain(&message.frame) else {
                self.stats.dropped.add(DropReason::DecompressError, 1);
                return;
            };
            message.frame = frame;
        }
        let wanted = if message.large {
            Priority::Bulk
        } else {
            self.lane.priority.unwrap_or(Priority::State)
        };
        // A small message of the new class must not overtake a large one of the old.
        if wanted != *class && link.queued(*lane) == 0 {
            *class = wanted;
        }
        let submit = Submit {
            to: receiver,
            class: *class,
            lane: *lane,
            stream: StreamKey { topic: topic.0, writer: message.frame.writer() },
            // The link adds its own hop.
            frame: message.frame,
            arrived: message.arrived,
            reliable: self.lane.reliable,
            lifespan: message.lifespan,
            keep_newest: if *class == Priority::Bulk { keep_newest } else { 0 },
        };
        self.submitted = true;
        if let Err(reason) = link.submit(now, submit) {
            self.stats.dropped.add(reason, 1);
        }
    }

    /// So many large messages of a writer wait at most; 0: only bytes count. Of a fast topic these
    /// are as many as leave within [`SLACK`]: what is admitted comes as unevenly as it is
    /// published, and each that gives way while the link has room for it is missing.
    pub(super) fn keep_newest(&self) -> usize {
        if self.lane.reliable {
            return 0;
        }
        let within_slack = (self.allocated_hz.unwrap_or(0.0) * SLACK.as_secs_f64()) as usize;
        within_slack.max(self.lane.depth as usize).max(1)
    }
}
