//! What goes into the registry and comes out of it.

use std::collections::BTreeSet;
use std::time::Instant;

use blaze_domain::control::{CallMessage, ControlError, ErrorCode, Event, EventKind};
use blaze_domain::names::{ChannelName, NameError};
use blaze_domain::node_file::AccessRules;
use blaze_domain::{FlowId, LayerKind, Scope, TopicName};
use serde_json::Value;

use super::leases::LapsedLease;
use super::names::LayerNames;
use crate::world::{Advertise, LayerScopeId, Request};

/// What a registry is told once.
#[derive(Debug, Clone)]
pub struct RegistryConfig {
    /// The own flow.
    pub me: FlowId,
    /// Kind of its layer.
    pub kind: LayerKind,
    /// Its life.
    pub epoch: u64,
    /// Whether it has a node scope.
    pub node_scope: bool,
    /// The layer broker that it uses, if any.
    pub layer_scope: Option<LayerScopeId>,
    /// Most leases, at most 10,000.
    pub max_leases: usize,
    /// Answers on the layer scope share one channel (Kafka, DDS): a message that wants one must
    /// have an `id`.
    pub layer_answers_need_id: bool,
    /// What the layer broker makes of topic names.
    pub layer_names: LayerNames,
    /// Scopes whose broker keeps leases; they are to be read.
    pub lease_stores: BTreeSet<Scope>,
    /// Who may advertise and request what, until it is changed.
    pub access: AccessRules,
    /// When the flow started.
    pub started: Instant,
}

/// An event without its flow and time.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EventDraft {
    /// What happened.
    pub event: EventKind,
    /// The topic, if one is meant.
    pub topic: Option<TopicName>,
    /// Error code or verdict; empty where there is none.
    pub code: &'static str,
    /// For the log.
    pub detail: String,
}

impl EventDraft {
    /// The event as it is published, at a wall-clock time in milliseconds since 1970.
    #[must_use]
    pub fn stamp(&self, flow: &FlowId, unix_ms: u64) -> Event {
        let event = Event::new(self.event, flow, self.topic.as_ref(), self.code, unix_ms);
        let told = self.event == EventKind::ConvertFailed;
        Event { detail: if told { self.detail.clone() } else { String::new() }, ..event }
    }
}

/// An answer to a control message that named a `reply_to`.
#[derive(Debug, Clone, PartialEq)]
pub struct AnswerOut {
    /// Where it goes, as the message said; brokers where answers share a channel send it there.
    pub reply_to: ChannelName,
    /// The `id` of the message.
    pub id: Option<String>,
    /// The answer.
    pub body: Value,
    /// Of several flows that received the message, this one is to answer.
    pub designated: bool,
}

/// A call of a service that this flow is to answer.
#[derive(Debug, Clone, PartialEq)]
pub struct CallIn {
    /// Where it was received.
    pub scope: Scope,
    /// Begins the pointers of its faults.
    pub pointer: String,
    /// The call.
    pub call: CallMessage,
    /// Why it is refused.
    pub fault: Option<ControlError>,
}

/// The topics of a called service.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CalledTopics {
    /// Its requests.
    pub request: TopicName,
    /// Its replies.
    pub reply: TopicName,
}

impl CalledTopics {
    /// Those of a service.
    ///
    /// # Errors
    /// The name is too long for them.
    pub fn of(service: &TopicName, pointer: &str) -> Result<Self, ControlError> {
        let of = |last: &str| {
            format!("{service}/{last}").parse().map_err(|error: NameError| {
                let detail = format!("of its requests and replies: {error}");
                ControlError::new(ErrorCode::InvalidTopic, format!("{pointer}/topic"), detail)
            })
        };
        Ok(Self { request: of("_request")?, reply: of("_reply")? })
    }
}

/// What a control payload did.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ControlOutcome {
    /// One for each object that wants one.
    pub answers: Vec<AnswerOut>,
    /// Calls of services.
    pub calls: Vec<CallIn>,
    /// Refusals.
    pub events: Vec<EventDraft>,
    /// Topics whose own entry in the world changed.
    pub changed: BTreeSet<TopicName>,
    /// Topics with a lease that was granted, renewed or withdrawn: their channels are in use.
    pub touched: BTreeSet<TopicName>,
    /// Objects that were refused; 1 for a payload that is none.
    pub faults: u64,
}

/// What the passing of time did.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Changes {
    /// What happened.
    pub events: Vec<EventDraft>,
    /// Topics whose own entry in the world changed.
    pub changed: BTreeSet<TopicName>,
    /// The leases that lapsed.
    pub lapsed: Vec<LapsedLease>,
}

/// What another flow told of the services of one of its scopes.
#[derive(Debug, Clone, Copy)]
pub struct RemoteLease<'a> {
    /// The flow.
    pub flow: &'a FlowId,
    /// Its scope.
    pub scope: Scope,
    /// Merged advertisements, if any.
    pub advertise: Option<&'a Advertise>,
    /// Merged requests, if any.
    pub request: Option<&'a Request>,
}

impl ControlOutcome {
    pub(super) fn refuse(&mut self, topic: Option<TopicName>, error: &ControlError) {
        self.faults += 1;
        self.events.push(EventDraft {
            event: EventKind::LeaseRefused,
            topic,
            code: error.code.as_str(),
            detail: error.to_string(),
        });
    }
}

/// What was ignored of other flows' announcements, and why.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SyncFaults {
    /// Entries with an invalid topic or an overlong text.
    pub bad_entries: u64,
    /// Entries beyond what one flow may announce.
    pub too_many_entries: u64,
    /// Deltas and snapshot parts with absurd numbers.
    pub bad_parts: u64,
    /// Snapshot parts that nobody had asked for.
    pub unasked_parts: u64,
    /// Deltas that gave way to newer ones before they could be applied.
    pub evicted_deltas: u64,
    /// Hellos that contradict themselves or their sender.
    pub bad_hellos: u64,
    /// Hellos of a life that is over.
    pub old_epochs: u64,
    /// Hellos of flows beyond the number that is followed.
    pub too_many_flows: u64,
    /// Announcements of flows that never said Hello.
    pub unknown_flows: u64,
    /// Messages to others that were dropped, because too many were asked for at once.
    pub dropped_replies: u64,
    /// Own route states that were not announced, because there are too many.
    pub left_out_routes: u64,
    /// Topics that were not announced or no longer, because a flow announces no more than 12,000.
    pub left_out_topics: u64,
}
