//! A topic goes from one receiver of a layer to another: what comes after is not written before what came first.
//!
//! ```text
//! plan: A ─► B    A: takes nothing more, empties its lane ─► asks A "written?" ─► A: yes ─► ended
//!                 B: holds what comes, in order                                             └─► B sends it, and goes on
//! ```
//!
//! An acknowledgement says that A has a message, not that A's broker has it: where that stands still, messages wait with A, and
//! those that B gets meanwhile would be written at the same time. So A is asked, and says yes when all that it had is with its
//! brokers. It is not waited for when it is gone, and not for ever.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use blaze_domain::{DropReason, FlowId, Scope};
use blaze_proto::Frame;
use blaze_proto::link::link_control::{Body, Written, WrittenRequest};

use super::core::{DataCore, LaneLink};
use super::path::{BridgeState, Phase, Sink, TopicId};
use super::writer::NewWriter;
use crate::plan::{Target, TopicPlan};

/// How often a flow is asked.
const ASK_AGAIN: Duration = Duration::from_millis(100);
/// How long the one before is waited for at most.
pub(super) const LONGEST_WAIT: Duration = Duration::from_secs(10);
/// Bytes that are held at most, of all topics (32 MiB); one message always fits.
const MAX_HELD_BYTES: usize = 32 * 1024 * 1024;
/// What a message that is held costs besides its bytes.
const OVERHEAD: usize = 256;
/// Questions of others that wait for their answer; those beyond are asked again.
const MAX_QUESTIONS: usize = 1_024;
/// How often it is looked whether a question can be answered. Brokers do not tell when they have taken a message.
const LOOK: Duration = Duration::from_millis(5);
/// … and that of one who has waited for a second.
const LOOK_LATER: Duration = Duration::from_millis(50);

/// A message on its way to the link.
#[derive(Debug)]
pub(super) struct Waiting {
    pub frame: Frame,
    /// When the flow took it in.
    pub arrived: Instant,
    pub lifespan: Option<Duration>,
}

impl Waiting {
    fn cost(&self) -> usize {
        self.frame.wire_len() + OVERHEAD
    }
}

/// Messages of one bridge that are held, oldest first.
#[derive(Debug, Default)]
pub(super) struct Held(VecDeque<Waiting>);

/// What the receiver of a bridge that drains has got may not be written yet.
#[derive(Debug)]
pub(super) struct Unwritten {
    token: u64,
    asked: Option<Instant>,
    until: Instant,
    answered: bool,
}

/// A question of another flow.
struct Question {
    from: FlowId,
    topic: String,
    token: u64,
    since: Instant,
    /// Bridges that wrote what had come by then, by place. Unknown while messages of the topic wait for their bridge.
    marks: Option<Vec<(usize, Mark)>>,
}

/// A bridge's writer, and how many messages it has taken.
type Mark = Option<(NewWriter, u64)>;

/// What a data plane holds, and is asked.
#[derive(Default)]
pub(super) struct Succession {
    held_bytes: usize,
    tokens: u32,
    questions: Vec<Question>,
}

impl Succession {
    pub(super) fn unwritten(&mut self, now: Instant, topic: TopicId) -> Unwritten {
        self.tokens = self.tokens.wrapping_add(1);
        Unwritten {
            token: u64::from(topic.0) << 32 | u64::from(self.tokens),
            asked: None,
            until: now + LONGEST_WAIT,
            answered: false,
        }
    }
}

impl BridgeState {
    /// Whether another bridge goes on with what this one has sent: to the same layer, or that of another flow out of this layer.
    pub(super) fn has_successor(&self, plan: &TopicPlan) -> bool {
        let Some((layer, _)) = self.receiver() else {
            return false;
        };
        let here = plan.bridges.iter().any(|planned| {
            let to = match &planned.to {
                Target::Inter { layer, .. } => Some(layer),
                Target::Node { .. } | Target::Layer => None,
            };
            planned.from == self.from && to == Some(layer)
        });
        here || (self.carries_out() && plan.carrier.is_some())
    }

    /// Whether it is to be waited for by one from that scope to that layer.
    fn comes_before(&self, from: Scope, target: &Target) -> bool {
        let layer = match target {
            Target::Inter { layer, .. } => Some(layer),
            Target::Node { .. } | Target::Layer => None,
        };
        matches!(self.phase, Phase::Draining { .. })
            && self.unwritten.is_some()
            && self.from == from
            && self.target != *target
            && self.receiver().map(|(layer, _)| layer) == layer
    }

    /// Holds a message. Of large ones of a writer only the newest stay, as in a lane.
    pub(super) fn hold(&mut self, message: Waiting, large: bool, succession: &mut Succession) {
        let keep = self.keep_newest();
        let Some(Held(held)) = &mut self.held else { return };
        let mut gone = 0;
        if large && keep > 0 {
            let writer = message.frame.writer();
            while held.iter().filter(|other| other.frame.writer() == writer).count() >= keep {
                let Some(oldest) = held.iter().position(|other| other.frame.writer() == writer) else {
                    break;
                };
                succession.held_bytes -= held.remove(oldest).map_or(0, |other| other.cost());
                gone += 1;
            }
        }
        if succession.held_bytes + message.cost() <= MAX_HELD_BYTES || succession.held_bytes == 0 {
            succession.held_bytes += message.cost();
            held.push_back(message);
        } else {
            gone += 1;
        }
        self.stats.dropped.add(DropReason::QueueFull, gone);
    }

    /// Empties a bridge that drains, and ends it when nothing of it is left. Returns when it is to be looked at again.
    pub(super) fn empty(&mut self, now: Instant, topic: &str, link: &mut dyn LaneLink) -> Option<Instant> {
        let Phase::Draining { mut until } = self.phase else {
            return None;
        };
        if let (Some(unwritten), Some((_, receiver))) = (&self.unwritten, self.receiver())
            && link.is_there(receiver)
        {
            // The next one holds what comes: there is time.
            until = unwritten.until;
        }
        let lane = self.lane_id();
        let queued = match lane {
            Some(lane) => link.queued(lane),
            None => self.settle(),
        };
        // What a bridge from the inter scope has to empty is on its way to it: it stays until the end.
        let empty = self.from != Scope::Inter && queued == 0;
        if !empty && now < until {
            return Some(until);
        }
        if let Some(lane) = lane.filter(|_| !empty) {
            let dropped = link.drop_lane(lane);
            self.stats.dropped.add(DropReason::NoDestination, dropped);
        }
        let waits_until = self.ask(now, topic, link);
        if waits_until.is_none() {
            self.unwritten = None;
            self.end(now);
        }
        waits_until
    }

    /// Asks the receiver, if it is to be asked and there. Returns when to look again.
    fn ask(&mut self, now: Instant, topic: &str, link: &mut dyn LaneLink) -> Option<Instant> {
        let Target::Inter { receiver, .. } = &self.target else {
            return None;
        };
        let unwritten = self.unwritten.as_mut()?;
        if unwritten.answered || now >= unwritten.until || !link.is_there(receiver) {
            return None;
        }
        let mut due = unwritten.asked.map_or(now, |asked| asked + ASK_AGAIN);
        if due <= now {
            let (topic, token) = (topic.to_owned(), unwritten.token);
            link.tell(now, receiver, Body::WrittenRequest(WrittenRequest { topic, token }));
            unwritten.asked = Some(now);
            due = now + ASK_AGAIN;
        }
        Some(due.min(unwritten.until))
    }

    fn mark(&self) -> Mark {
        match &self.sink {
            Sink::Publish { writer, .. } => writer.as_ref().map(|writer| (writer.made().clone(), writer.taken())),
            Sink::Lane { .. } => None,
        }
    }

    /// Whether nothing waits any more of what its writers had taken at the mark.
    fn has_written(&mut self, mark: Option<&(NewWriter, u64)>) -> bool {
        if self.settle() == 0 {
            return true;
        }
        match (&self.sink, mark) {
            (Sink::Publish { past, .. }, _) if !past.is_empty() => false,
            (
                Sink::Publish {
                    writer: Some(writer), ..
                },
                Some((made, taken)),
            ) if writer.is(made) => writer.taken() - writer.queued().min(writer.taken()) >= *taken,
            // What it had then has been replaced, and has delivered all.
            _ => true,
        }
    }
}

impl DataCore {
    /// A bridge that begins waits for those before it.
    pub(super) fn hold_back(&mut self, topic: TopicId, at: usize) {
        let bridges = &mut self.topics[topic.0 as usize].bridges;
        let (from, target) = (bridges[at].from, bridges[at].target.clone());
        if bridges.iter().any(|other| other.comes_before(from, &target)) {
            bridges[at].held.get_or_insert_default();
        }
    }

    /// Gives what a bridge held that is not planned any more to the one that goes on.
    pub(super) fn adopt(&mut self, topic: TopicId, from: Scope, target: &Target, Held(mut held): Held) {
        let Target::Inter { layer, .. } = target else { return };
        let bridges = &mut self.topics[topic.0 as usize].bridges;
        let goes_on = |bridge: &&mut BridgeState| {
            bridge.from == from
                && matches!(bridge.phase, Phase::Up { .. })
                && bridge.receiver().is_some_and(|(other, _)| other == layer)
        };
        if let Some(heir) = bridges.iter_mut().find(goes_on) {
            held.extend(heir.held.take().unwrap_or_default().0);
            heir.held = Some(Held(held));
            self.draining = true;
            return;
        }
        let dropped = held.len() as u64;
        self.succession.held_bytes -= held.iter().map(Waiting::cost).sum::<usize>();
        if let Some(own) = bridges.iter_mut().find(|own| own.from == from && own.target == *target) {
            own.stats.dropped.add(DropReason::NoDestination, dropped);
        }
    }

    /// Sends what bridges of a topic held for those before them, which have ended.
    pub(super) fn release(&mut self, now: Instant, topic: TopicId, link: &mut dyn LaneLink) {
        let path = &mut self.topics[topic.0 as usize];
        if path.bridges.iter().all(|bridge| bridge.held.is_none()) {
            return;
        }
        let large = path.is_large(self.config.large_bytes);
        for at in 0..path.bridges.len() {
            let (from, target) = (path.bridges[at].from, path.bridges[at].target.clone());
            if path.bridges.iter().any(|other| other.comes_before(from, &target)) {
                continue;
            }
            let bridge = &mut path.bridges[at];
            for message in bridge.held.take().unwrap_or_default().0 {
                self.succession.held_bytes -= message.cost();
                bridge.submit(now, topic, message, large, link);
            }
        }
    }

    /// A flow asks whether all that it has sent of a topic is written. It is answered as soon as that is so.
    pub fn written_asked(&mut self, now: Instant, from: FlowId, topic: String, token: u64, link: &mut dyn LaneLink) {
        let questions = &mut self.succession.questions;
        if questions.iter().any(|other| other.token == token && other.from == from) {
            return;
        }
        questions.retain(|other| other.from != from || other.topic != topic);
        let mut question = Question {
            from,
            topic,
            token,
            since: now,
            marks: None,
        };
        if self.is_written(&mut question) {
            link.tell(now, &question.from, Body::Written(Written { token }));
        } else if self.succession.questions.len() < MAX_QUESTIONS {
            self.succession.questions.push(question);
        }
    }

    /// A flow says that it has written all that was asked for.
    pub fn written(&mut self, from: &FlowId, token: u64) {
        let topic = usize::try_from(token >> 32)
            .ok()
            .and_then(|index| self.topics.get_mut(index));
        for bridge in topic.into_iter().flat_map(|topic| &mut topic.bridges) {
            let asked = bridge.receiver().is_some_and(|(_, receiver)| receiver == from);
            if let Some(unwritten) = bridge
                .unwritten
                .as_mut()
                .filter(|unwritten| asked && unwritten.token == token)
            {
                unwritten.answered = true;
            }
        }
    }

    /// Answers questions that can be. Returns when to look again.
    pub(super) fn answer(&mut self, now: Instant, link: &mut dyn LaneLink) -> Option<Instant> {
        let mut questions = std::mem::take(&mut self.succession.questions);
        questions.retain_mut(|question| {
            if now.saturating_duration_since(question.since) >= LONGEST_WAIT || !link.is_there(&question.from) {
                return false;
            }
            let written = self.is_written(question);
            if written {
                link.tell(now, &question.from, Body::Written(Written { token: question.token }));
            }
            !written
        });
        self.succession.questions = questions;
        let look = |question: &Question| {
            let old = now.saturating_duration_since(question.since) >= Duration::from_secs(1);
            now + if old { LOOK_LATER } else { LOOK }
        };
        self.succession.questions.iter().map(look).min()
    }

    fn is_written(&mut self, question: &mut Question) -> bool {
        if self.early.holds(&question.topic) {
            return false;
        }
        let Some(topic) = self.find(&question.topic) else {
            return true;
        };
        let bridges = &mut self.topics[topic.0 as usize].bridges;
        let marks = question.marks.get_or_insert_with(|| {
            let writes = bridges
                .iter()
                .enumerate()
                .filter(|(_, bridge)| bridge.from == Scope::Inter);
            writes.map(|(at, bridge)| (at, bridge.mark())).collect()
        });
        marks.retain(|(at, mark)| {
            bridges
                .get_mut(*at)
                .is_some_and(|bridge| !bridge.has_written(mark.as_ref()))
        });
        marks.is_empty()
    }
}
