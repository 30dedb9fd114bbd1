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
use blaze_domain::media::{CALL, CALL_FAULT, CALL_REPLY, Media};
use blaze_domain::{DropReason, Scope, WriterId};
use blaze_proto::Frame;
use lru::LruCache;

use super::admit::Admitted;
use super::core::{DataCore, LaneLink};
use crate::types::ConvertFailure;

/// Calls that own servers have not answered; the oldest are given up.
const MAX_SERVED: usize = 4_096;
/// Replies that wait for the control core, and answers that wait for the task that makes JSON of
/// them; more are given up.
const MAX_WAITING: usize = 1_024;

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
    arrived: Vec<Frame>,
    served: LruCache<Request, ()>,
    answers: Vec<CallAnswer>,
}

impl Default for Calls {
    fn default() -> Self {
        let room = NonZeroUsize::new(MAX_SERVED).unwrap_or(NonZeroUsize::MIN);
        Self { arrived: Vec::new(), served: LruCache::new(room), answers: Vec::new() }
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
            keep(&mut self.answers, CallAnswer::Failed { request, failure });
        }
    }
}

/// Returns whether there is room.
fn keep<T>(waiting: &mut Vec<T>, one: T) -> bool {
    let has_room = waiting.len() < MAX_WAITING;
    if has_room {
        waiting.push(one);
    }
    has_room
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
        let mut batch = vec![Received::live(Content::Frame(request), now)];
        self.ingest(now, wall_ns, topic, Scope::Node, &mut batch, link);
    }

    /// Replies to calls of this flow since the last time, whether it waits for them or not.
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
        let is_answer = matches!(frame.encoding(), CALL_REPLY | CALL_FAULT)
            && self.config.me.is_written(frame.to());
        let has_room = if from == Scope::Ros2 && is_cdr && self.calls.served.pop(&request).is_some()
        {
            keep(&mut self.calls.answers, CallAnswer::Reply(frame.clone()))
        } else if is_answer {
            keep(&mut self.calls.arrived, frame.clone())
        } else {
            return false;
        };
        if !has_room {
            self.unattributed.add(DropReason::QueueFull, 1);
        }
        true
    }
}
