//! Calls of ROS 2 services that came as control messages: this flow is their client.
//!
//! ```text
//! call ─► a server is known? ─► its topics are bridged there and back ─► request ─► reply ─► answer
//!           └ no, for 1 s: no_server                                       └─ timeout_ms ─► timeout
//! ```
//!
//! Each caller of each service has a writer of its own, so that its calls go to one server, and in
//! order. A request is sent once, whatever becomes of it.

use std::collections::{BTreeMap, BTreeSet};
use std::num::NonZeroUsize;
use std::time::{Duration, Instant};

use blaze_domain::control::{
    Answer, CallMessage, Common, ControlError, ErrorCode, LeaseKind, MAX_CALL_TIMEOUT_MS,
};
use blaze_domain::media::{CALL, CALL_FAULT};
use blaze_domain::names::ChannelName;
use blaze_domain::{FlowId, Origin, Scope, ServiceName, TopicName, WriterId};
use blaze_proto::{Frame, Header};
use bytes::Bytes;
use lru::LruCache;
use serde_json::Value;
use sha2::{Digest, Sha256};

use super::{ControlCore, Output};
use crate::plan::network::{Servers, servers};
use crate::plan::{Survey, Target};
use crate::registry::{CallIn, CalledTopics};
use crate::world::FlowState;

/// Calls of a flow that wait for their replies.
const MAX_PENDING: usize = 256;
/// Services, and callers of one, that are remembered: the one that was used least recently gives
/// way, of services one without a call.
const MAX_SERVICES: usize = 256;
/// How long news of a server are waited for, by a flow that is ready.
const SERVER_WITHIN: Duration = Duration::from_secs(1);
/// How long a request waits at most until its way and that of the reply stand, after both are
/// planned: its time is short, and not every flow says so.
const WAY_WITHIN: Duration = Duration::from_secs(2);
/// How long the bridges of a service stay after its last call.
const KEEP: Duration = Duration::from_secs(60);

/// Calls and their services.
#[derive(Default)]
pub(super) struct Calls {
    /// By number, which is that of the request.
    pending: BTreeMap<u64, Pending>,
    last: u64,
    services: BTreeMap<TopicName, Service>,
    outcomes: BTreeMap<&'static str, u64>,
}

/// A call without an answer.
struct Pending {
    scope: Scope,
    pointer: String,
    call: CallMessage,
    writer: WriterId,
    /// Since when a server is sought.
    began: Instant,
    deadline: Instant,
    /// Where its request went.
    sent: Option<FlowId>,
}

/// A service that is called through this flow.
struct Service {
    topics: CalledTopics,
    /// The name of each caller, and the flow of its server.
    callers: LruCache<WriterId, (ServiceName, FlowId)>,
    used: Instant,
    /// Since when both topics are bridged here.
    planned: Option<Instant>,
}

impl Service {
    fn new(topics: CalledTopics, used: Instant) -> Self {
        let room = NonZeroUsize::new(MAX_SERVICES).unwrap_or(NonZeroUsize::MIN);
        Self { topics, callers: LruCache::new(room), used, planned: None }
    }

    fn names(&self) -> BTreeSet<ServiceName> {
        self.callers.iter().map(|(_, (name, _))| name.clone()).collect()
    }
}

impl ControlCore {
    /// Calls by what became of them.
    #[must_use]
    pub fn call_outcomes(&self) -> &BTreeMap<&'static str, u64> {
        &self.calls.outcomes
    }

    /// Calls that wait for their answers.
    #[must_use]
    pub fn pending_calls(&self) -> usize {
        self.calls.pending.len()
    }

    /// A service calls another one.
    pub(super) fn call(&mut self, now: Instant, received: CallIn) {
        let CallIn { scope, pointer, call, fault } = received;
        let fault = fault.or_else(|| {
            let detail = || format!("{MAX_PENDING} calls wait for their replies: try again later");
            let is_full = self.calls.pending.len() >= MAX_PENDING;
            is_full.then(|| ControlError::new(ErrorCode::TooManyCalls, &*pointer, detail()))
        });
        if let Some(fault) = fault {
            return self.answer_call(scope, &call.common, Err(fault));
        }
        self.calls.last += 1;
        let timeout = Duration::from_millis(call.timeout_ms.min(MAX_CALL_TIMEOUT_MS).into());
        let writer = writer_of(&self.config.me, self.config.epoch, &call.common);
        let (began, deadline) = (now, now + timeout);
        let pending = Pending { scope, pointer, call, writer, began, deadline, sent: None };
        self.calls.pending.insert(self.calls.last, pending);
        self.follow_calls(now);
    }

    /// Ends calls whose time is over or that nobody serves, and gets ways for the others.
    pub(super) fn follow_calls(&mut self, now: Instant) {
        self.forget_services(now);
        let over = self.calls.pending.iter().filter(|(_, pending)| pending.deadline <= now);
        for number in over.map(|(number, _)| *number).collect::<Vec<_>>() {
            self.end_call(number, |pending| Err(timeout(pending)));
        }
        let is_ready = self.state == FlowState::Ready;
        let waiting = self.calls.pending.iter_mut().filter(|(_, pending)| pending.sent.is_none());
        let mut sought: BTreeMap<TopicName, Vec<u64>> = BTreeMap::new();
        for (number, pending) in waiting {
            if !is_ready {
                // It does not know yet who is there.
                pending.began = now;
            }
            sought.entry(pending.call.common.topic.clone()).or_default().push(*number);
        }
        if sought.is_empty() {
            return;
        }
        let survey = Survey::of(self.registry.world(), sought.len());
        let found = sought.into_iter().filter_map(|(service, numbers)| {
            let topics = CalledTopics::of(&service, "").ok()?;
            let servers = servers(&survey, &topics.request);
            Some((service, topics, numbers, servers))
        });
        for (service, topics, numbers, servers) in found.collect::<Vec<_>>() {
            if servers.is_empty() {
                self.end_unserved(now, &numbers);
            } else {
                self.use_service(now, &service, topics, &numbers, &servers);
            }
        }
    }

    fn end_unserved(&mut self, now: Instant, numbers: &[u64]) {
        for number in numbers {
            let began = self.calls.pending.get(number).map(|pending| pending.began);
            if began.is_some_and(|began| now >= began + SERVER_WITHIN) {
                self.end_call(*number, |pending| Err(no_server(pending)));
            }
        }
    }

    /// Keeps the bridges of a service, with these calls' clients among its callers.
    fn use_service(
        &mut self,
        now: Instant,
        name: &TopicName,
        topics: CalledTopics,
        numbers: &[u64],
        servers: &Servers,
    ) {
        if !self.calls.services.contains_key(name) {
            self.make_room(now);
        }
        let calls = &mut self.calls;
        let service =
            calls.services.entry(name.clone()).or_insert_with(|| Service::new(topics, now));
        service.used = now;
        let before = service.names();
        for Pending { call, writer, .. } in numbers.iter().filter_map(|at| calls.pending.get(at)) {
            let chosen = service.callers.get(writer).map(|(_, flow)| flow);
            if let Some(flow) = servers.choose(*writer, chosen).cloned() {
                service.callers.put(*writer, (call.common.service.clone(), flow));
            }
        }
        let names = service.names();
        if names != before {
            let topics = service.topics.clone();
            self.announce_callers(now, &topics, &names);
        }
    }

    fn announce_callers(
        &mut self,
        now: Instant,
        topics: &CalledTopics,
        callers: &BTreeSet<ServiceName>,
    ) {
        let both = [(&topics.request, LeaseKind::Advertise), (&topics.reply, LeaseKind::Request)];
        for (topic, kind) in both {
            let changed = self.registry.set_callers(now, topic, kind, callers.clone());
            for topic in &changed {
                self.touch_urgent(now, topic);
            }
        }
    }

    /// Lets go of services that nobody has called for a while.
    fn forget_services(&mut self, now: Instant) {
        let unused = |service: &Service| now.saturating_duration_since(service.used) >= KEEP;
        let unused = self
            .calls
            .services
            .iter()
            .filter(|(name, service)| unused(service) && !self.calls.is_called(name));
        for name in unused.map(|(name, _)| name.clone()).collect::<Vec<_>>() {
            self.forget_service(now, &name);
        }
    }

    fn make_room(&mut self, now: Instant) {
        if self.calls.services.len() < MAX_SERVICES {
            return;
        }
        let free = self.calls.services.iter().filter(|(name, _)| !self.calls.is_called(name));
        let oldest = free.min_by_key(|(_, service)| service.used).map(|(name, _)| name.clone());
        if let Some(oldest) = oldest {
            self.forget_service(now, &oldest);
        }
    }

    fn forget_service(&mut self, now: Instant, name: &TopicName) {
        if let Some(service) = self.calls.services.remove(name) {
            self.announce_callers(now, &service.topics, &BTreeSet::new());
        }
    }

    /// Topics of replies that calls wait for before their requests are sent: see
    /// [`ControlCore::send_calls`].
    #[must_use]
    pub fn awaited_replies(&self) -> BTreeSet<TopicName> {
        let waiting = self.calls.pending.values().filter(|pending| pending.sent.is_none());
        let services =
            waiting.filter_map(|pending| self.calls.services.get(&pending.call.common.topic));
        services.map(|service| service.topics.reply.clone()).collect()
    }

    /// Sends the requests whose ways stand. `is_read`: whether this flow reads a topic wherever its
    /// bridges read it.
    pub fn send_calls(&mut self, now: Instant, wall_ns: u64, is_read: impl Fn(&TopicName) -> bool) {
        let waiting = self.calls.pending.iter().filter(|(_, pending)| pending.sent.is_none());
        for number in waiting.map(|(number, _)| *number).collect::<Vec<_>>() {
            if let Some(flow) = self.way_of(now, number, &is_read) {
                self.send_call(now, wall_ns, number, flow);
            }
        }
    }

    /// The flow of a call's server, if the ways to it and back stand.
    fn way_of(
        &mut self,
        now: Instant,
        number: u64,
        is_read: impl Fn(&TopicName) -> bool,
    ) -> Option<FlowId> {
        let pending = self.calls.pending.get(&number)?;
        let service = self.calls.services.get_mut(&pending.call.common.topic)?;
        let (_, flow) = service.callers.peek(&pending.writer)?;
        let CalledTopics { request, reply } = &service.topics;
        let plans = &self.plans;
        let has = |topic: &TopicName, is_such: fn(&crate::plan::Bridge) -> bool| {
            plans.get(topic).is_some_and(|plan| plan.bridges.iter().any(is_such))
        };
        let is_planned = has(request, |bridge| bridge.from == Scope::Node)
            && has(reply, |bridge| matches!(bridge.to, Target::Node(_)));
        if !is_planned {
            service.planned = None;
            return None;
        }
        let since = *service.planned.get_or_insert(now);
        let me = &self.config.me;
        let part = self.registry.world().flows.get(flow).and_then(|view| view.parts.get(reply));
        // A flow that sends replies here knows the way of requests, too.
        let answers = flow == me
            || part.is_some_and(|part| part.more_receivers || !part.receivers.is_empty());
        let stands = answers && is_read(reply);
        (stands || now >= since + WAY_WITHIN).then(|| flow.clone())
    }

    fn send_call(&mut self, now: Instant, wall_ns: u64, number: u64, flow: FlowId) {
        let Some(pending) = self.calls.pending.get_mut(&number) else { return };
        let Some(service) = self.calls.services.get(&pending.call.common.topic) else { return };
        let CallMessage { common, request, .. } = &pending.call;
        let left_ms = pending.deadline.saturating_duration_since(now).as_millis();
        let me = &self.config.me;
        let origin = Origin {
            layer: me.layer.to_string(),
            node: me.node.to_string(),
            service: common.service.to_string(),
            instance: common.instance.to_string(),
            epoch: common.epoch,
        };
        let topic = service.topics.request.as_str();
        let header = Header {
            encoding: CALL.to_owned(),
            // Nobody executes what its caller has given up.
            lifespan_ms: u32::try_from(left_ms).unwrap_or(u32::MAX).max(1),
            reliable: true,
            to: flow.to_string(),
            ..Header::new(topic, origin, pending.writer, number, wall_ns)
        };
        let payload = serde_json::to_vec(request).unwrap_or_default();
        match Frame::new(&header, payload.into()) {
            Ok(request) => {
                pending.sent = Some(flow);
                self.outputs.push_back(Output::Call { request });
            }
            Err(error) => {
                let fault = move |pending: &Pending| {
                    let pointer = format!("{}/request", pending.pointer);
                    Err(ControlError::new(ErrorCode::TooLarge, pointer, error.to_string()))
                };
                self.end_call(number, fault);
            }
        }
    }

    /// A reply to a request of this flow, or a fault instead of it.
    pub fn call_reply(&mut self, reply: &Frame) {
        let Some((writer, number)) = reply.related() else { return };
        if self.calls.pending.get(&number).is_none_or(|pending| pending.writer != writer) {
            // Its time is over.
            return;
        }
        let flow = format!("{}/{}", reply.origin_layer(), reply.origin_node());
        self.end_call(number, |pending| read_reply(pending, reply).map(|reply| (flow, reply)));
    }

    fn end_call(
        &mut self,
        number: u64,
        outcome: impl FnOnce(&Pending) -> Result<(String, Value), ControlError>,
    ) {
        let Some(pending) = self.calls.pending.remove(&number) else { return };
        let outcome = outcome(&pending);
        self.answer_call(pending.scope, &pending.call.common, outcome);
    }

    fn answer_call(
        &mut self,
        scope: Scope,
        caller: &Common,
        outcome: Result<(String, Value), ControlError>,
    ) {
        let Common { id, reply_to, .. } = caller.clone();
        let code = outcome.as_ref().map_or_else(|error| error.code.as_str(), |_| "ok");
        *self.calls.outcomes.entry(code).or_default() += 1;
        let answer = match outcome {
            Ok((flow, reply)) => Answer::replied(id, flow, reply),
            Err(error) => Answer::refused(id, error),
        };
        let Some(reply_to) = reply_to else { return };
        let body = Bytes::from(answer.to_json().to_string());
        let is_shared = scope == Scope::Layer && self.config.layer_answers_need_id;
        let channel = if is_shared { ChannelName::shared_reply() } else { reply_to };
        self.outputs.push_back(Output::Publish { scope, channel, body });
    }
}

impl Calls {
    fn is_called(&self, service: &TopicName) -> bool {
        self.pending.values().any(|pending| pending.call.common.topic == *service)
    }
}

fn read_reply(pending: &Pending, reply: &Frame) -> Result<Value, ControlError> {
    let fault = |detail: String| {
        let pointer = format!("{}/topic", pending.pointer);
        ControlError::new(ErrorCode::ConvertError, pointer, detail)
    };
    if reply.encoding() != CALL_FAULT {
        return serde_json::from_slice(reply.payload())
            .map_err(|error| fault(format!("the reply is no JSON: {error}")));
    }
    Err(match serde_json::from_slice::<ControlError>(reply.payload()) {
        Ok(error) => {
            ControlError { pointer: format!("{}{}", pending.pointer, error.pointer), ..error }
        }
        Err(error) => fault(format!("the fault is no JSON: {error}")),
    })
}

fn timeout(pending: &Pending) -> ControlError {
    let (name, ms) = (&pending.call.common.topic, pending.call.timeout_ms);
    let detail = match &pending.sent {
        Some(flow) => format!("the server of {name} at {flow} did not reply within {ms} ms"),
        None => format!(
            "no way to a server of {name} stood within {ms} ms: see `blaze why {name}/_request`"
        ),
    };
    ControlError::new(ErrorCode::Timeout, format!("{}/timeout_ms", pending.pointer), detail)
}

fn no_server(pending: &Pending) -> ControlError {
    let name = &pending.call.common.topic;
    let detail = format!("no flow knows a server of {name}");
    ControlError::new(ErrorCode::NoServer, format!("{}/topic", pending.pointer), detail)
}

/// The writer of a caller's requests to a service, another one in each life of the flow.
fn writer_of(me: &FlowId, epoch: u64, caller: &Common) -> WriterId {
    let node = caller.node.as_ref().map(ToString::to_string).unwrap_or_default();
    let Common { topic, service, instance, .. } = caller;
    let text = format!("call|{me}|{epoch}|{topic}|{node}|{service}|{instance}");
    let digest = Sha256::digest(text.as_bytes());
    let mut id = [0; 16];
    id.copy_from_slice(&digest[..16]);
    WriterId(id)
}
