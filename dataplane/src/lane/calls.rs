//! Calls of ROS 2 services for clients that do not speak ROS 2.
//!
//! ```text
//! the client's flow                            the server's flow
//! send_call ─► bridges ──────────────────────► bridge to ROS 2: JSON → CDR ─► server
//! arrived   ◄─ bridges ◄─ answer_call ◄─ task: CDR → JSON ◄───────────────────┘
//! ```
//!
//! A call is a request with the encoding [`CALL`]: it is converted as any JSON for ROS 2 is, and its
//! reply goes back as JSON. A request that cannot be converted is answered with a fault.

use std::num::NonZeroUsize;
use std::time::Instant;

use blaze_brokers::{Content, Received};
use blaze_domain::{Scope, WriterId};
use blaze_proto::Frame;
use lru::LruCache;

use super::admit::Admitted;
use super::core::{DataCore, LaneLink};
use crate::types::ConvertFailure;
use blaze_domain::media::{CALL, Media};

/// Requests of this flow whose replies are waited for; more than the flow lets wait, since those
/// whose time is over are not taken out.
const MAX_AWAITED: usize = 1_024;
/// Calls that own servers have not answered; the oldest are given up.
const MAX_SERVED: usize = 4_096;
/// Answers that wait for the task that makes JSON of them; more are given up.
const MAX_ANSWERS: usize = 1_024;

/// Writer and number of a request.
type Request = (WriterId, u64);

/// What own servers answer to calls.
#[derive(Debug, Clone)]
pub enum CallAnswer {
    /// A reply, as CDR.
    Reply(Frame),
    /// The request did not reach the server.
    Failed {
        /// The request.
        request: Frame,
        /// Why not.
        failure: ConvertFailure,
    },
}

/// Calls of this flow, and of others to its servers.
pub(super) struct Calls {
    awaited: LruCache<Request, ()>,
    arrived: Vec<Frame>,
    served: LruCache<Request, ()>,
    answers: Vec<CallAnswer>,
}

impl Default for Calls {
    fn default() -> Self {
        let room = |most| NonZeroUsize::new(most).unwrap_or(NonZeroUsize::MIN);
        Self {
            awaited: LruCache::new(room(MAX_AWAITED)),
            arrived: Vec::new(),
            served: LruCache::new(room(MAX_SERVED)),
            answers: Vec::new(),
        }
    }
}

impl Calls {
    /// A call is converted for a server of the own network.
    pub(super) fn note_served(&mut self, request: &Frame) {
        if request.encoding() == CALL {
            self.served.put((request.writer(), request.sequence()), ());
        }
    }

    /// A request could not be converted. If it is a call, its client gets to know why.
    pub(super) fn note_failed(&mut self, request: &Frame, failure: &ConvertFailure) {
        if self.served.pop(&(request.writer(), request.sequence())).is_some() {
            let (request, failure) = (request.clone(), failure.clone());
            self.answer(CallAnswer::Failed { request, failure });
        }
    }

    fn answer(&mut self, answer: CallAnswer) {
        if self.answers.len() < MAX_ANSWERS {
            self.answers.push(answer);
        }
    }
}

impl DataCore {
    /// Sends a request of this flow to a service. Its topic has bridges.
    pub fn send_call(
        &mut self,
        now: Instant,
        wall_ns: u64,
        request: Frame,
        link: &mut dyn LaneLink,
    ) {
        let Some(topic) = self.find(request.topic()) else { return };
        self.calls.awaited.put((request.writer(), request.sequence()), ());
        let mut batch = vec![Received::live(Content::Frame(request), now)];
        self.ingest(now, wall_ns, topic, Scope::Node, &mut batch, link);
    }

    /// Replies to calls of this flow since the last time.
    pub fn take_arrived(&mut self) -> Vec<Frame> {
        std::mem::take(&mut self.calls.arrived)
    }

    /// What own servers answer to calls since the last time; what becomes of it goes to
    /// [`DataCore::answer_call`].
    pub fn take_call_answers(&mut self) -> Vec<CallAnswer> {
        std::mem::take(&mut self.calls.answers)
    }

    /// Whether replies to calls of this flow have arrived, and whether own servers have answered
    /// calls.
    #[must_use]
    pub fn call_news(&self) -> (bool, bool) {
        (!self.calls.arrived.is_empty(), !self.calls.answers.is_empty())
    }

    /// The reply to a call as JSON, or its fault, goes to the client's flow.
    pub fn answer_call(&mut self, now: Instant, reply: Frame, link: &mut dyn LaneLink) {
        let Some(topic) = self.find(reply.topic()) else { return };
        let age_us = reply.age_us();
        let message = Admitted::new(now, reply, true, age_us, 0);
        self.fan_out(now, topic, Scope::Ros2, &message, link);
    }

    /// Takes the reply to a call out of the path of messages.
    pub(super) fn take_reply(&mut self, from: Scope, message: &Admitted) -> bool {
        let frame = &message.frame;
        let Some(request) = frame.related() else { return false };
        let is_cdr = matches!(Media::of(frame.encoding()), Media::Cdr { .. });
        if from == Scope::Ros2 && is_cdr && self.calls.served.pop(&request).is_some() {
            self.calls.answer(CallAnswer::Reply(frame.clone()));
            return true;
        }
        let is_own = self.config.me.is_written(frame.to());
        if is_own && self.calls.awaited.pop(&request).is_some() {
            self.calls.arrived.push(frame.clone());
            return true;
        }
        false
    }
}
