//! Control messages as types, and as JSON.

use serde_json::{Map, Value};

use super::words::LeaseKind;
use super::{DEFAULT_TTL_S, MAX_CONTROL_OBJECTS};
use crate::names::{ChannelName, InstanceName, LayerName, NodeName, ServiceName, TopicName};
use crate::qos::{Durability, Priority, Reliability};

/// What a service tells its flow.
#[derive(Debug, Clone, PartialEq)]
pub enum ControlMessage {
    /// It publishes a topic.
    Advertise(AdvertiseMessage),
    /// It wants a topic.
    Request(RequestMessage),
    /// It no longer does.
    Withdraw(WithdrawMessage),
}

/// Fields of every control message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Common {
    /// The topic.
    pub topic: TopicName,
    /// The service that speaks.
    pub service: ServiceName,
    /// Its instance; `0` unless given.
    pub instance: InstanceName,
    /// Its layer; `None` = where the message is received.
    pub layer: Option<LayerName>,
    /// Its node; `None` = where the message is received, or none on a layer scope.
    pub node: Option<NodeName>,
    /// Its life: larger is newer; 0 unless given.
    pub epoch: u64,
    /// Comes back in the answer.
    pub id: Option<String>,
    /// Where the answer goes; `None` = no answer is wanted.
    pub reply_to: Option<ChannelName>,
}

/// Type and quality of service, common to advertisements and requests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Quality {
    /// Media type; `None` = not said.
    pub encoding: Option<String>,
    /// ROS type, or empty.
    pub type_name: String,
    /// RIHS01 hash of the type, or empty.
    pub type_hash: String,
    /// Whether losses are repaired.
    pub reliability: Reliability,
    /// Whether late joiners get what was published before.
    pub durability: Durability,
    /// Samples kept per writer, at least 1.
    pub depth: u32,
    /// Class; `None` = by size.
    pub priority: Option<Priority>,
    /// Milliseconds after which a message is worthless; 0 = never.
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
#[derive(Debug, Clone, PartialEq)]
pub struct AdvertiseMessage {
    /// Who and what.
    pub common: Common,
    /// Lifetime in seconds; 0 = until withdrawn.
    pub ttl_s: u32,
    /// Messages per second; `None` = to be measured.
    pub rate_hz: Option<f64>,
    /// Largest payload in bytes; `None` = to be measured.
    pub max_bytes: Option<u64>,
    /// Type and quality of service.
    pub quality: Quality,
}

/// A service wants a topic.
#[derive(Debug, Clone, PartialEq)]
pub struct RequestMessage {
    /// Who and what.
    pub common: Common,
    /// Lifetime in seconds; 0 = until withdrawn.
    pub ttl_s: u32,
    /// Most messages per second; `None` = all.
    pub max_rate_hz: Option<f64>,
    /// It wants payloads without a header.
    pub bare: bool,
    /// Only messages of that origin.
    pub from: OriginSelector,
    /// Expected type, and quality of service asked for.
    pub quality: Quality,
}

/// A service no longer publishes or wants a topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WithdrawMessage {
    /// Who and what.
    pub common: Common,
    /// Which lease; `None` = both.
    pub kind: Option<LeaseKind>,
}

/// Origin that a request asks for; an absent part matches everything.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct OriginSelector {
    /// Layer of the publisher.
    pub layer: Option<LayerName>,
    /// Node of the publisher.
    pub node: Option<NodeName>,
    /// Service of the publisher.
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

    fn write(&self, op: &str, json: &mut Map<String, Value>) {
        json.insert("op".into(), op.into());
        json.insert("topic".into(), self.topic.as_str().into());
        json.insert("service".into(), self.service.as_str().into());
        json.insert("instance".into(), self.instance.as_str().into());
        put_text(json, "layer", self.layer.as_ref().map(LayerName::as_str));
        put_text(json, "node", self.node.as_ref().map(NodeName::as_str));
        if self.epoch != 0 {
            json.insert("epoch".into(), self.epoch.into());
        }
        put_text(json, "id", self.id.as_deref());
        put_text(json, "reply_to", self.reply_to.as_ref().map(ChannelName::as_str));
    }
}

impl Quality {
    fn write(&self, json: &mut Map<String, Value>) {
        put_text(json, "encoding", self.encoding.as_deref());
        put_text(
            json,
            "type",
            Some(self.type_name.as_str()).filter(|text| !text.is_empty()),
        );
        put_text(
            json,
            "type_hash",
            Some(self.type_hash.as_str()).filter(|text| !text.is_empty()),
        );
        json.insert("reliability".into(), self.reliability.as_str().into());
        json.insert("durability".into(), self.durability.as_str().into());
        json.insert("depth".into(), self.depth.into());
        put_text(json, "priority", self.priority.map(Priority::as_str));
        if self.lifespan_ms != 0 {
            json.insert("lifespan_ms".into(), self.lifespan_ms.into());
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
            from: OriginSelector::default(),
            quality: Quality::default(),
        }
    }
}

impl WithdrawMessage {
    /// Withdraws both kinds.
    #[must_use]
    pub fn new(topic: TopicName, service: ServiceName) -> Self {
        Self {
            common: Common::new(topic, service),
            kind: None,
        }
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
        }
    }

    /// The fields that every kind has, to be filled.
    #[must_use]
    pub fn common_mut(&mut self) -> &mut Common {
        match self {
            Self::Advertise(message) => &mut message.common,
            Self::Request(message) => &mut message.common,
            Self::Withdraw(message) => &mut message.common,
        }
    }

    /// The JSON object that [`super::parse_payload`] reads back as the same message.
    #[must_use]
    pub fn to_json(&self) -> Value {
        let mut json = Map::new();
        match self {
            Self::Advertise(message) => {
                message.common.write("advertise", &mut json);
                json.insert("ttl_s".into(), message.ttl_s.into());
                put_number(&mut json, "rate_hz", message.rate_hz);
                if let Some(bytes) = message.max_bytes {
                    json.insert("max_bytes".into(), bytes.into());
                }
                message.quality.write(&mut json);
            }
            Self::Request(message) => {
                message.common.write("request", &mut json);
                json.insert("ttl_s".into(), message.ttl_s.into());
                put_number(&mut json, "max_rate_hz", message.max_rate_hz);
                if message.bare {
                    json.insert("bare".into(), true.into());
                }
                if !message.from.is_any() {
                    let mut from = Map::new();
                    put_text(&mut from, "layer", message.from.layer.as_ref().map(LayerName::as_str));
                    put_text(&mut from, "node", message.from.node.as_ref().map(NodeName::as_str));
                    put_text(
                        &mut from,
                        "service",
                        message.from.service.as_ref().map(ServiceName::as_str),
                    );
                    json.insert("from".into(), from.into());
                }
                message.quality.write(&mut json);
            }
            Self::Withdraw(message) => {
                message.common.write("withdraw", &mut json);
                put_text(&mut json, "kind", message.kind.map(LeaseKind::as_str));
            }
        }
        Value::Object(json)
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
                    if objects < MAX_CONTROL_OBJECTS && last.len() + text.len() + 2 <= super::MAX_CONTROL_BYTES =>
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

fn put_text(json: &mut Map<String, Value>, key: &str, value: Option<&str>) {
    if let Some(text) = value {
        json.insert(key.into(), text.into());
    }
}

fn put_number(json: &mut Map<String, Value>, key: &str, value: Option<f64>) {
    if let Some(number) = value {
        json.insert(key.into(), number.into());
    }
}
