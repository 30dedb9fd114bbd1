//! A topic goes from one receiver of a layer to another: what comes after is not written before
//! what came first.
//!
//! ```text
//! plan: A ─► B    A: takes nothing more, empties its lane ─► asks A "written?" ─► A: yes ─► ended
//!                 B: holds what comes, in order                                             └─► B sends it, and goes on
//! ```
//!
//! What has not been given to the lane of A yet, because A held it or it is with the codec, goes to
//! B.
//!
//! An acknowledgement says that A has a message, not that A's broker has it: where that stands
//! still, messages wait with A, and those that B gets meanwhile would be written at the same time.
//! So A is asked, and says yes when all that it had is with its brokers. It is not waited for when
//! it is gone, and not for ever; and a flow that goes away itself waits for nobody.
//!
//! A and B write to one broker: only bridges to flows that share theirs follow one another.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use blaze_domain::{DropReason, FlowId, Scope};
use blaze_proto::Frame;
use blaze_proto::link::link_control::{Body, Written, WrittenRequest};

use super::core::{DRAIN, DataCore, LaneLink};
use super::path::{BridgeState, Phase, Sink, TopicId};
use super::places::topic_id;
use super::writer::NewWriter;
use crate::plan::{LaneSpec, Target, TopicPlan};

/// After which a flow is asked again, because question or answer may have been lost; doubled each
/// time …
const ASK_AGAIN: Duration = Duration::from_millis(100);
/// … up to this.
const ASK_LATER: Duration = Duration::from_secs(1);
/// Questions that are asked at once; the others follow …
pub(super) const MAX_ASKS: usize = 32;
/// … after this, so that they leave the link to the messages.
const ASK_NEXT: Duration = Duration::from_millis(20);
/// How long the one before is waited for at most.
pub(super) const LONGEST_WAIT: Duration = Duration::from_secs(10);
/// A message that has waited for this long goes on even where the queue to the next receiver has no
/// room for all of it.
pub(super) const LONGEST_PATIENCE: Duration = Duration::from_secs(20);
/// Bytes that are held at most, of all topics (32 MiB); one message always fits.
const MAX_HELD_BYTES: usize = 32 * 1024 * 1024;
/// What a message that is held costs besides its bytes.
const OVERHEAD: usize = 256;
/// Questions of others that wait for their answer; those beyond are asked again.
const MAX_QUESTIONS: usize = 1_024;
/// … of one flow …
const MAX_QUESTIONS_OF_ONE: usize = 256;
/// … and for one topic, of which a flow may have several lanes.
const MAX_QUESTIONS_OF_TOPIC: usize = 4;
/// How often it is looked whether a question can be answered. Brokers do not tell when they have
/// taken a message.
const LOOK: Duration = Duration::from_millis(5);
/// … and that of one who has waited for a second.
const LOOK_LATER: Duration = Duration::from_millis(50);

/// A message on its way to the link.
#[derive(Debug)]
pub(super) struct Waiting {
    /// Its topic is.
    pub large: bool,
    /// Of its payload as it was published.
    pub bytes: u64,
    pub frame: Frame,
    /// When the flow took it in.
    pub arrived: Instant,
    pub lifespan: Option<Duration>,
}

impl Waiting {
    /// Whether it is of no use any more.
    pub(super) fn is_too_old(&self, now: Instant) -> bool {
        let here = now.saturating_duration_since(self.arrived);
        let age = Duration::from_micros(self.frame.age_us()).saturating_add(here);
        self.lifespan.is_some_and(|lifespan| age >= lifespan)
    }

    fn cost(&self) -> usize {
        self.frame.received_len() + OVERHEAD
    }
}

/// Messages of one bridge that are held, oldest first.
#[derive(Debug, Default)]
pub(super) struct Held(VecDeque<Waiting>);

impl Held {
    /// Oldest first.
    pub(super) fn frames(&self) -> impl Iterator<Item = &Frame> {
        self.0.iter().map(|message| &message.frame)
    }

    /// Adds what comes after it.
    pub(super) fn append(&mut self, later: Option<Self>) {
        self.0.extend(later.unwrap_or_default().0);
    }
}

/// What the receiver of a bridge that drains has got may not be written yet.
#[derive(Debug)]
pub(super) struct Unwritten {
    token: u64,
    ask_at: Option<Instant>,
    pause: Duration,
    until: Instant,
    answered: bool,
}

/// A question of another flow.
struct Question {
    from: FlowId,
    topic: String,
    token: u64,
    since: Instant,
    /// Bridges that wrote what had come by then, by place. Unknown while messages of the topic wait
    /// for their bridge.
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
    /// Questions that may still be asked, and when more may be.
    asks: usize,
    more_asks_at: Option<Instant>,
    /// The flow goes away.
    leaving: bool,
}

impl Succession {
    /// What the receiver of a bridge that drains has got is to be written before another one goes
    /// on.
    pub(super) fn await_written(&mut self, now: Instant, topic: TopicId, bridge: &mut BridgeState) {
        // What is with the codec will be given to its lane; where a bridge here goes on it has that
        // (`pass_on`), and this is taken back.
        let was_used = bridge.submitted || bridge.in_codec > 0;
        if self.leaving || !was_used || bridge.unwritten.is_some() {
            return;
        }
        self.tokens = self.tokens.wrapping_add(1);
        bridge.unwritten = Some(Unwritten {
            token: u64::from(topic.0) << 32 | u64::from(self.tokens),
            ask_at: None,
            pause: ASK_AGAIN,
            until: now + LONGEST_WAIT,
            answered: false,
        });
    }

    /// Whether a question may be asked now; else when.
    fn may_ask(&mut self, now: Instant) -> Result<(), Instant> {
        match self.more_asks_at {
            Some(at) if now < at => {}
            _ => (self.asks, self.more_asks_at) = (MAX_ASKS, Some(now + ASK_NEXT)),
        }
        if self.asks == 0 {
            return Err(self.more_asks_at.unwrap_or(now + ASK_NEXT));
        }
        self.asks -= 1;
        Ok(())
    }
}

/// Whether two receivers write to one broker.
fn are_replicas(one: (&Target, &LaneSpec), other: (&Target, &LaneSpec)) -> bool {
    let layer = |target: &Target| target.receiver().map(|receiver| receiver.layer.clone());
    one.1.shared.is_some() && one.1.shared == other.1.shared && layer(one.0) == layer(other.0)
}

impl BridgeState {
    fn is_draining(&self) -> bool {
        matches!(self.phase, Phase::Draining { .. })
    }

    /// Whether another bridge goes on with what this one has sent: to a replica of its receiver, or
    /// that of another flow out of this layer.
    pub(super) fn has_successor(&self, plan: &TopicPlan) -> bool {
        let here = plan.bridges.iter().any(|planned| {
            planned.from == self.from
                && planned.to != self.target
                && are_replicas((&self.target, &self.lane), (&planned.to, &planned.lane))
        });
        here || (self.carries_out() && plan.carrier.is_some())
    }

    /// Whether the two carry the same messages to replicas.
    fn is_beside(&self, other: &Self) -> bool {
        self.from == other.from
            && self.target != other.target
            && are_replicas((&self.target, &self.lane), (&other.target, &other.lane))
    }

    /// Whether the other one has to wait for it.
    fn comes_before(&self, other: &Self) -> bool {
        self.is_draining() && self.unwritten.is_some() && self.is_beside(other)
    }

    /// Holds a message. Of large ones of a writer only the newest stay, as in a lane.
    pub(super) fn hold(&mut self, message: Waiting, succession: &mut Succession) {
        let keep = self.keep_newest();
        let Some(Held(held)) = &mut self.held else { return };
        let stats = &mut self.stats;
        let mut drop_one = |message: &Waiting| {
            stats.taken.add(message.bytes);
            stats.dropped.add(DropReason::QueueFull, 1);
        };
        if message.large && keep > 0 {
            let writer = message.frame.writer();
            let is_older = |other: &Waiting| other.large && other.frame.writer() == writer;
            let mut surplus =
                (held.iter().filter(|other| is_older(other)).count() + 1).saturating_sub(keep);
            held.retain(|other| {
                let goes = surplus > 0 && is_older(other);
                if goes {
                    surplus -= 1;
                    succession.held_bytes -= other.cost();
                    drop_one(other);
                }
                !goes
            });
        }
        if succession.held_bytes + message.cost() <= MAX_HELD_BYTES || succession.held_bytes == 0 {
            succession.held_bytes += message.cost();
            held.push_back(message);
        } else {
            drop_one(&message);
        }
    }

    /// Empties a bridge that drains, and ends it when nothing of it is left. Returns when it is to
    /// be looked at again.
    pub(super) fn empty(
        &mut self,
        now: Instant,
        topic: &str,
        succession: &mut Succession,
        link: &mut dyn LaneLink,
    ) -> Option<Instant> {
        let Phase::Draining { until, .. } = self.phase else {
            return None;
        };
        // Where the next one holds what comes there is time.
        let until = self.waits_for_answer(now, link).unwrap_or(until);
        let lane = self.lane_id();
        let queued = match lane {
            Some(lane) => link.queued(lane) + self.in_codec,
            None => self.settle() + self.in_codec,
        };
        // What a bridge from the inter scope has to empty is on its way to it: it stays until the
        // end.
        let empty = self.from != Scope::Inter && queued == 0 && self.held.is_none();
        if !empty && now < until {
            // Brokers do not tell when they have taken a message.
            let polls = lane.is_none() && self.from != Scope::Inter;
            return Some(if polls { until.min(now + LOOK) } else { until });
        }
        if let Some(lane) = lane.filter(|_| !empty) {
            let mut dropped = link.drop_lane(lane);
            for message in self.held.take().unwrap_or_default().0 {
                succession.held_bytes -= message.cost();
                self.stats.taken.add(message.bytes);
                dropped += 1;
            }
            self.stats.dropped.add(DropReason::NoDestination, dropped);
        }
        let again = self.ask(now, topic, succession, link);
        if again.is_none() {
            // One that has not answered may have to be asked again, if another goes on soon.
            self.submitted &= !self.unwritten.take().is_some_and(|unwritten| unwritten.answered);
            self.end(now);
        }
        again
    }

    /// Until when the receiver's answer is waited for, if it is.
    fn waits_for_answer(&self, now: Instant, link: &dyn LaneLink) -> Option<Instant> {
        let unwritten = self.unwritten.as_ref()?;
        let (_, receiver) = self.receiver()?;
        let waits = !unwritten.answered && now < unwritten.until && link.answers(receiver);
        waits.then_some(unwritten.until)
    }

    /// Asks the receiver, if it is to be asked. Returns when to look again.
    fn ask(
        &mut self,
        now: Instant,
        topic: &str,
        succession: &mut Succession,
        link: &mut dyn LaneLink,
    ) -> Option<Instant> {
        let until = self.waits_for_answer(now, link)?;
        let (Target::Inter { receiver, .. }, Some(unwritten)) = (&self.target, &mut self.unwritten)
        else {
            return None;
        };
        if unwritten.ask_at.is_none_or(|at| at <= now) {
            if let Err(later) = succession.may_ask(now) {
                return Some(until.min(later));
            }
            let (topic, token) = (topic.to_owned(), unwritten.token);
            if link.tell(receiver, Body::WrittenRequest(WrittenRequest { topic, token })) {
                unwritten.ask_at = Some(now + unwritten.pause);
                unwritten.pause = (unwritten.pause * 2).min(ASK_LATER);
            } else {
                unwritten.ask_at = Some(now + ASK_NEXT);
            }
        }
        unwritten.ask_at.map(|at| at.min(until))
    }

    /// Its writer, and how many messages that has taken.
    fn mark(&self) -> Mark {
        match &self.sink {
            Sink::Publish { writer, .. } => {
                writer.as_ref().map(|writer| (writer.made().clone(), writer.taken()))
            }
            Sink::Lane { .. } => None,
        }
    }

    /// Whether the link takes it without dropping what waits there.
    fn has_room(&self, message: &Waiting, link: &dyn LaneLink) -> bool {
        match (&self.sink, &self.target) {
            (Sink::Lane { class, .. }, Target::Inter { receiver, .. }) => {
                link.has_room(receiver, *class, message.frame.received_len())
            }
            _ => true,
        }
    }

    /// Whether nothing waits any more of what its writers had taken at the mark.
    fn has_written(&mut self, mark: Option<&(NewWriter, u64)>) -> bool {
        if self.settle() == 0 {
            return true;
        }
        match (&self.sink, mark) {
            (Sink::Publish { past, .. }, _) if !past.is_empty() => false,
            (Sink::Publish { writer: Some(writer), .. }, Some((made, taken)))
                if writer.is(made) =>
            {
                writer.taken() - writer.queued().min(writer.taken()) >= *taken
            }
            // What it had then has been replaced, and has delivered all.
            _ => true,
        }
    }
}

impl DataCore {
    /// A bridge that begins waits for those before it.
    pub(super) fn hold_back(&mut self, now: Instant, topic: TopicId, at: usize) {
        let bridges = &mut self.topics[topic.0 as usize].bridges;
        let (before, rest) = bridges.split_at_mut(at);
        let Some((own, after)) = rest.split_first_mut() else {
            return;
        };
        let mut waits = false;
        for other in before.iter_mut().chain(after) {
            // The plan that ended it may have come a moment before the one that says who goes on.
            let just_ended =
                other.ended.is_some_and(|at| now.saturating_duration_since(at) < DRAIN);
            if !(other.is_draining() || just_ended) || !other.is_beside(own) {
                continue;
            }
            self.succession.await_written(now, topic, other);
            if other.unwritten.is_some() {
                waits = true;
                if just_ended {
                    (other.phase, other.ended) =
                        (Phase::Draining { until: now, latest: now }, None);
                    self.draining.insert(topic);
                }
            }
        }
        if waits {
            own.held.get_or_insert_default();
        }
    }

    /// What waits here for bridges that are not planned any more, held or with the codec, goes to
    /// those that go on: so all of a writer that has not been sent yet has one way, and stays in
    /// order. Where nobody goes on it stays with them, until they are planned again or have
    /// drained.
    pub(super) fn pass_on(&mut self, topic: TopicId) {
        let bridges = &mut self.topics[topic.0 as usize].bridges;
        for at in 0..bridges.len() {
            let waits = bridges[at].held.is_some() || bridges[at].in_codec > 0;
            if !waits || matches!(bridges[at].phase, Phase::Up { .. }) {
                continue;
            }
            let goes_on = |bridge: &BridgeState| {
                matches!(bridge.phase, Phase::Up { .. }) && bridge.is_beside(&bridges[at])
            };
            if let Some(heir) = bridges.iter().position(goes_on) {
                if let Some(mut held) = bridges[at].held.take() {
                    held.append(bridges[heir].held.take());
                    bridges[heir].held = Some(held);
                }
                // What of its messages is with the codec comes behind these.
                let moved = self.compress.hand_over(topic, at, heir);
                bridges[at].in_codec = bridges[at].in_codec.saturating_sub(moved);
                bridges[heir].in_codec += moved;
                if !bridges[at].submitted {
                    // Its receiver got nothing, and gets nothing any more.
                    bridges[at].unwritten = None;
                }
                self.draining.insert(topic);
            }
        }
    }

    /// Sends what bridges of a topic held for those before them, which have ended. Returns when to
    /// look again, if there was no room for all of it.
    pub(super) fn release(
        &mut self,
        now: Instant,
        topic: TopicId,
        link: &mut dyn LaneLink,
    ) -> Option<Instant> {
        let bridges = &mut self.topics[topic.0 as usize].bridges;
        let mut again = None;
        for at in 0..bridges.len() {
            let waits =
                bridges[at].lane.held && !bridges[at].is_draining() && !self.succession.leaving;
            if waits
                || bridges[at].held.is_none()
                || bridges.iter().any(|other| other.comes_before(&bridges[at]))
            {
                continue;
            }
            let bridge = &mut bridges[at];
            let Held(mut held) = bridge.held.take().unwrap_or_default();
            while let Some(message) = held.pop_front() {
                let patient = now.saturating_duration_since(message.arrived) < LONGEST_PATIENCE;
                if patient && !bridge.has_room(&message, link) {
                    held.push_front(message);
                    bridge.held = Some(Held(held));
                    again = Some(now + LOOK);
                    break;
                }
                self.succession.held_bytes -= message.cost();
                bridge.stats.taken.add(message.bytes);
                bridge.submit(now, topic, message, link);
            }
        }
        again
    }

    /// The flow goes away: nobody is waited for any more, so that what is held can leave.
    pub fn leave(&mut self, now: Instant) {
        self.succession.leaving = true;
        for (index, path) in self.topics.iter_mut().enumerate() {
            for bridge in &mut path.bridges {
                let waited = bridge.unwritten.take().is_some();
                if bridge.held.is_some() {
                    self.draining.insert(topic_id(index));
                }
                if let Phase::Draining { until, .. } = &mut bridge.phase
                    && (waited || bridge.held.is_some())
                {
                    *until = (*until).max(now + DRAIN);
                }
            }
        }
        self.stir();
    }

    /// Whether something that came over the link waits for a broker.
    pub fn has_unwritten(&mut self) -> bool {
        if self.compress.delays_any() {
            return true;
        }
        let bridges = self.topics.iter_mut().flat_map(|topic| &mut topic.bridges);
        bridges.filter(|bridge| bridge.from == Scope::Inter).any(|bridge| bridge.settle() > 0)
    }

    /// A flow asks whether all that it has sent of a topic is written. It is answered as soon as
    /// that is so.
    pub fn written_asked(
        &mut self,
        now: Instant,
        from: FlowId,
        topic: String,
        token: u64,
        link: &mut dyn LaneLink,
    ) {
        let questions = &mut self.succession.questions;
        let is_known =
            |other: &Question| other.token == token && other.from == from && other.topic == topic;
        if questions.iter().any(is_known) {
            return;
        }
        let mut of_topic = questions
            .iter()
            .enumerate()
            .filter(|(_, other)| other.from == from && other.topic == topic);
        let oldest = of_topic.next().map(|(at, _)| at);
        if of_topic.count() + 1 >= MAX_QUESTIONS_OF_TOPIC
            && let Some(oldest) = oldest
        {
            questions.remove(oldest);
        }
        let of_one = questions.iter().filter(|other| other.from == from).count();
        let mut question = Question { from, topic, token, since: now, marks: None };
        if self.is_written(&mut question) {
            link.tell(&question.from, Body::Written(Written { token }));
        } else if self.succession.questions.len() < MAX_QUESTIONS && of_one < MAX_QUESTIONS_OF_ONE {
            self.succession.questions.push(question);
            self.stirred = true;
        }
    }

    /// A flow says that it has written all that was asked for.
    pub fn written(&mut self, from: &FlowId, token: u64) {
        let topic = usize::try_from(token >> 32).ok().and_then(|index| self.topics.get_mut(index));
        for bridge in topic.into_iter().flat_map(|topic| &mut topic.bridges) {
            let asked = bridge.receiver().is_some_and(|(_, receiver)| receiver == from);
            if let Some(unwritten) =
                bridge.unwritten.as_mut().filter(|unwritten| asked && unwritten.token == token)
            {
                unwritten.answered = true;
                self.stirred = true;
            }
        }
    }

    /// Answers questions that can be. Returns when to look again.
    pub(super) fn answer(&mut self, now: Instant, link: &mut dyn LaneLink) -> Option<Instant> {
        let mut questions = std::mem::take(&mut self.succession.questions);
        questions.retain_mut(|question| {
            if now.saturating_duration_since(question.since) >= LONGEST_WAIT
                || !link.answers(&question.from)
            {
                return false;
            }
            let written = self.is_written(question);
            if written {
                link.tell(&question.from, Body::Written(Written { token: question.token }));
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
        if self.compress.delays(topic) {
            return false;
        }
        let bridges = &mut self.topics[topic.0 as usize].bridges;
        let marks = question.marks.get_or_insert_with(|| {
            let writes =
                bridges.iter().enumerate().filter(|(_, bridge)| bridge.from == Scope::Inter);
            writes.map(|(at, bridge)| (at, bridge.mark())).collect()
        });
        marks.retain(|(at, mark)| {
            bridges.get_mut(*at).is_some_and(|bridge| !bridge.has_written(mark.as_ref()))
        });
        marks.is_empty()
    }
}
