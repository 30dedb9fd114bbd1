//! Control messages as types, and as JSON.

use serde::Serialize;
use serde_json::{Map, Value};

use super::words::LeaseKind;
use super::{DEFAULT_TTL_S, MAX_CONTROL_OBJECTS};
use crate::names::{ChannelName, InstanceName, LayerName, NodeName, ServiceName, TopicName};
use crate::qos::{Durability, Priority, Reliability};

/// What a service tells its flow.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "op", rename_all = "snake_case")]
pub enum ControlMessage {
    /// It publishes a topic.
    Advertise(AdvertiseMessage),
    /// It wants a topic.
    Request(RequestMessage),
    /// It no longer does.
    Withdraw(WithdrawMessage),
    /// It calls a ROS 2 service.
    Call(CallMessage),
}

/// Fields of every control message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Common {
    /// The topic.
    pub topic: TopicName,
    /// The service that speaks.
    pub service: ServiceName,
    /// Its instance; `0` unless given.
    pub instance: InstanceName,
    /// Its layer; `None` = where the message is received.
    #[serde(skip_serializing_if = "is_default")]
    pub layer: Option<LayerName>,
    /// Its node; `None` = where the message is received, or none on a layer scope.
    #[serde(skip_serializing_if = "is_default")]
    pub node: Option<NodeName>,
    /// Its life: larger is newer; 0 unless given.
    #[serde(skip_serializing_if = "is_default")]
    pub epoch: u64,
    /// Comes back in the answer.
    #[serde(skip_serializing_if = "is_default")]
    pub id: Option<String>,
    /// Where the answer goes; `None` = no answer is wanted.
    #[serde(skip_serializing_if = "is_default")]
    pub reply_to: Option<ChannelName>,
}

/// Type and quality of service, common to advertisements and requests.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Quality {
    /// Media type; `None` = not said.
    #[serde(skip_serializing_if = "is_default")]
    pub encoding: Option<String>,
    /// ROS type, or empty.
    #[serde(rename = "type", skip_serializing_if = "is_default")]
    pub type_name: String,
    /// RIHS01 hash of the type, or empty.
    #[serde(skip_serializing_if = "is_default")]
    pub type_hash: String,
    /// Whether losses are repaired.
    pub reliability: Reliability,
    /// Whether late joiners get what was published before.
    pub durability: Durability,
    /// Samples kept per writer, at least 1.
    pub depth: u32,
    /// Class; `None` = by size.
    #[serde(skip_serializing_if = "is_default")]
    pub priority: Option<Priority>,
    /// Milliseconds after which a message is worthless; 0 = never.
    #[serde(skip_serializing_if = "is_default")]
    pub lifespan_ms: u32,
}

impl Default for Quality {
    fn default() -> Self {
        Self {
            encoding: None,
            type_name: String::new(),
            type_hash: String::new(),
            reliability: Reliability::BestEffort,
            durability: Durability::Volatile,
            depth: 1,
            priority: None,
            lifespan_ms: 0,
        }
    }
}

/// A service publishes a topic.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AdvertiseMessage {
    /// Who and what.
    #[serde(flatten)]
    pub common: Common,
    /// Lifetime in seconds; 0 = until withdrawn.
    pub ttl_s: u32,
    /// Messages per second; `None` = to be measured.
    #[serde(skip_serializing_if = "is_default")]
    pub rate_hz: Option<f64>,
    /// Largest payload in bytes; `None` = to be measured.
    #[serde(skip_serializing_if = "is_default")]
    pub max_bytes: Option<u64>,
    /// Type and quality of service.
    #[serde(flatten)]
    pub quality: Quality,
}

/// A service wants a topic.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RequestMessage {
    /// Who and what.
    #[serde(flatten)]
    pub common: Common,
    /// Lifetime in seconds; 0 = until withdrawn.
    pub ttl_s: u32,
    /// Most messages per second; `None` = all.
    #[serde(skip_serializing_if = "is_default")]
    pub max_rate_hz: Option<f64>,
    /// It wants payloads without a header.
    #[serde(skip_serializing_if = "is_default")]
    pub bare: bool,
    /// It wants payloads as JSON.
    #[serde(skip_serializing_if = "is_default")]
    pub json: bool,
    /// Only messages of that origin.
    #[serde(skip_serializing_if = "is_default")]
    pub from: OriginSelector,
    /// Expected type, and quality of service asked for.
    #[serde(flatten)]
    pub quality: Quality,
}

/// A service no longer publishes or wants a topic.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct WithdrawMessage {
    /// Who and what.
    #[serde(flatten)]
    pub common: Common,
    /// Which lease; `None` = both.
    #[serde(skip_serializing_if = "is_default")]
    pub kind: Option<LeaseKind>,
}

/// A service calls a ROS 2 service, whose name is the topic; the answer brings the reply.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CallMessage {
    /// Who and what; `id` and `reply_to` are given.
    #[serde(flatten)]
    pub common: Common,
    /// Milliseconds that the reply is waited for.
    pub timeout_ms: u32,
    /// The request as a JSON object.
    pub request: Map<String, Value>,
}

/// Origin that a request asks for; an absent part matches everything.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct OriginSelector {
    /// Layer of the publisher.
    #[serde(skip_serializing_if = "is_default")]
    pub layer: Option<LayerName>,
    /// Node of the publisher.
    #[serde(skip_serializing_if = "is_default")]
    pub node: Option<NodeName>,
    /// Service of the publisher.
    #[serde(skip_serializing_if = "is_default")]
    pub service: Option<ServiceName>,
}

impl OriginSelector {
    /// Whether it lets every origin pass.
    #[must_use]
    pub fn is_any(&self) -> bool {
        *self == Self::default()
    }
}

impl Common {
    /// The first instance of a service where it is received, with epoch 0 and no answer wanted.
    #[must_use]
    pub fn new(topic: TopicName, service: ServiceName) -> Self {
        Self {
            topic,
            service,
            instance: InstanceName::first(),
            layer: None,
            node: None,
            epoch: 0,
            id: None,
            reply_to: None,
        }
    }
}

impl AdvertiseMessage {
    /// An advertisement with every default.
    #[must_use]
    pub fn new(topic: TopicName, service: ServiceName) -> Self {
        Self {
            common: Common::new(topic, service),
            ttl_s: DEFAULT_TTL_S,
            rate_hz: None,
            max_bytes: None,
            quality: Quality::default(),
        }
    }
}

impl RequestMessage {
    /// A request with every default.
    #[must_use]
    pub fn new(topic: TopicName, service: ServiceName) -> Self {
        Self {
            common: Common::new(topic, service),
            ttl_s: DEFAULT_TTL_S,
            max_rate_hz: None,
            bare: false,
            json: false,
            from: OriginSelector::default(),
            quality: Quality::default(),
        }
    }
}

impl WithdrawMessage {
    /// Withdraws both kinds.
    #[must_use]
    pub fn new(topic: TopicName, service: ServiceName) -> Self {
        Self { common: Common::new(topic, service), kind: None }
    }
}

impl ControlMessage {
    /// The fields that every kind has.
    #[must_use]
    pub fn common(&self) -> &Common {
        match self {
            Self::Advertise(message) => &message.common,
            Self::Request(message) => &message.common,
            Self::Withdraw(message) => &message.common,
            Self::Call(message) => &message.common,
        }
    }

    /// The fields that every kind has, to be filled.
    #[must_use]
    pub fn common_mut(&mut self) -> &mut Common {
        match self {
            Self::Advertise(message) => &mut message.common,
            Self::Request(message) => &mut message.common,
            Self::Withdraw(message) => &mut message.common,
            Self::Call(message) => &mut message.common,
        }
    }

    /// The JSON object that [`super::parse_payload`] reads back as the same message.
    #[must_use]
    pub fn to_json(&self) -> Value {
        serde_json::to_value(self).unwrap_or_default()
    }

    /// Payloads that carry all these messages, each within the limits of one payload.
    #[must_use]
    pub fn to_payloads<'a>(messages: impl IntoIterator<Item = &'a Self>) -> Vec<Vec<u8>> {
        let mut payloads: Vec<Vec<u8>> = Vec::new();
        let mut objects = 0;
        for message in messages {
            let text = message.to_json().to_string();
            match payloads.last_mut() {
                // The closing bracket is still to come.
                Some(last)
                    if objects < MAX_CONTROL_OBJECTS
                        && last.len() + text.len() + 2 <= super::MAX_CONTROL_BYTES =>
                {
                    last.push(b',');
                    last.extend_from_slice(text.as_bytes());
                    objects += 1;
                }
                _ => {
                    let mut first = Vec::with_capacity(text.len() + 2);
                    first.push(b'[');
                    first.extend_from_slice(text.as_bytes());
                    payloads.push(first);
                    objects = 1;
                }
            }
        }
        payloads.iter_mut().for_each(|payload| payload.push(b']'));
        payloads
    }
}

/// Whether a field has the value that it has when it is absent.
fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}
