//! What a service says when it advertises or requests a topic.

use std::time::Duration;

use blaze_domain::control::{
    AdvertiseMessage, DEFAULT_ENCODING, MAX_DEPTH, MAX_ENCODING_BYTES, MAX_TYPE_BYTES,
    OriginSelector, Quality, RequestMessage,
};
use blaze_domain::{Durability, MAX_PAYLOAD_BYTES, Priority, Reliability, TopicName};

use super::FlowError;
use crate::publisher::lifespan_ms;
use crate::service::Identity;

/// What a service publishes.
#[derive(Debug, Clone, PartialEq)]
pub struct Advertise {
    /// The topic.
    pub topic: TopicName,
    /// Messages per second; absent = measured by the flow.
    pub rate_hz: Option<f64>,
    /// Size of the largest message in bytes; absent = measured by the flow.
    pub max_bytes: Option<u64>,
    /// Media type of the payloads, at most 200 bytes.
    pub encoding: String,
    /// ROS type, or empty.
    pub type_name: String,
    /// RIHS01 hash of the ROS type, or empty.
    pub type_hash: String,
    /// Whether lost messages are sent again.
    pub reliability: Reliability,
    /// Whether late joiners get what was published before.
    pub durability: Durability,
    /// Messages kept per writer for late joiners, 1 to 65,535.
    pub depth: u32,
    /// Class on the inter scope; absent = by size.
    pub priority: Option<Priority>,
    /// How long a message is of use; zero = for ever.
    pub lifespan: Duration,
}

impl Advertise {
    /// Best effort, volatile, everything else measured by the flow.
    #[must_use]
    pub fn new(topic: TopicName) -> Self {
        Self {
            topic,
            rate_hz: None,
            max_bytes: None,
            encoding: DEFAULT_ENCODING.to_owned(),
            type_name: String::new(),
            type_hash: String::new(),
            reliability: Reliability::BestEffort,
            durability: Durability::Volatile,
            depth: 1,
            priority: None,
            lifespan: Duration::ZERO,
        }
    }

    /// The message of a service that says so.
    pub(super) fn message(self, identity: &Identity) -> Result<AdvertiseMessage, FlowError> {
        if self.max_bytes.is_some_and(|bytes| bytes > MAX_PAYLOAD_BYTES as u64) {
            return Err(invalid("max_bytes", "is above 16 MiB"));
        }
        check_rate("rate_hz", self.rate_hz)?;
        let quality = Quality {
            encoding: Some(self.encoding).filter(|text| !text.is_empty()),
            type_name: self.type_name,
            type_hash: self.type_hash,
            reliability: self.reliability,
            durability: self.durability,
            depth: self.depth,
            priority: self.priority,
            lifespan_ms: lifespan_ms(self.lifespan),
        };
        check_quality(&quality)?;
        let message = AdvertiseMessage::new(self.topic, identity.service.clone());
        Ok(AdvertiseMessage {
            common: identity.sign(message.common),
            rate_hz: self.rate_hz,
            max_bytes: self.max_bytes,
            quality,
            ..message
        })
    }
}

/// What a service wants to receive.
#[derive(Debug, Clone, PartialEq)]
pub struct Request {
    /// The topic.
    pub topic: TopicName,
    /// Messages per second at most; absent = as published.
    pub max_rate_hz: Option<f64>,
    /// Leave out messages that are older; zero = none.
    pub lifespan: Duration,
    /// Media type of the payloads, at most 200 bytes, or empty.
    pub encoding: String,
    /// ROS type, or empty.
    pub type_name: String,
    /// RIHS01 hash of the ROS type, or empty.
    pub type_hash: String,
    /// Whether lost messages are to be sent again.
    pub reliability: Reliability,
    /// Whether to begin with what was published before.
    pub durability: Durability,
    /// Messages per writer to begin with, 1 to 65,535.
    pub depth: u32,
    /// May lower the publisher's class on the inter scope, never raise it.
    pub priority: Option<Priority>,
    /// Only messages of this origin.
    pub from: OriginSelector,
    /// Serve payloads without a header on `blaze/bare/<topic>`, for clients that do not use an SDK.
    pub bare: bool,
}

impl Request {
    /// Best effort, volatile, as fast as published, from anywhere.
    #[must_use]
    pub fn new(topic: TopicName) -> Self {
        Self {
            topic,
            max_rate_hz: None,
            lifespan: Duration::ZERO,
            encoding: String::new(),
            type_name: String::new(),
            type_hash: String::new(),
            reliability: Reliability::BestEffort,
            durability: Durability::Volatile,
            depth: 1,
            priority: None,
            from: OriginSelector::default(),
            bare: false,
        }
    }

    /// The message of a service that says so.
    pub(super) fn message(self, identity: &Identity) -> Result<RequestMessage, FlowError> {
        check_rate("max_rate_hz", self.max_rate_hz)?;
        let quality = Quality {
            encoding: Some(self.encoding).filter(|text| !text.is_empty()),
            type_name: self.type_name,
            type_hash: self.type_hash,
            reliability: self.reliability,
            durability: self.durability,
            depth: self.depth,
            priority: self.priority,
            lifespan_ms: lifespan_ms(self.lifespan),
        };
        check_quality(&quality)?;
        let message = RequestMessage::new(self.topic, identity.service.clone());
        Ok(RequestMessage {
            common: identity.sign(message.common),
            max_rate_hz: self.max_rate_hz,
            bare: self.bare,
            from: self.from,
            quality,
            ..message
        })
    }
}

fn invalid(field: &'static str, reason: &'static str) -> FlowError {
    FlowError::Invalid { field, reason }
}

fn check_rate(field: &'static str, rate: Option<f64>) -> Result<(), FlowError> {
    match rate {
        Some(rate) if !rate.is_finite() || rate <= 0.0 => Err(invalid(field, "must be above 0")),
        _ => Ok(()),
    }
}

fn check_quality(quality: &Quality) -> Result<(), FlowError> {
    if !(1..=MAX_DEPTH).contains(&quality.depth) {
        return Err(invalid("depth", "must be 1 to 65,535"));
    }
    let encoding = quality.encoding.as_deref().unwrap_or_default();
    for (field, text, most) in [
        ("encoding", encoding, MAX_ENCODING_BYTES),
        ("type", &quality.type_name, MAX_TYPE_BYTES),
        ("type_hash", &quality.type_hash, MAX_TYPE_BYTES),
    ] {
        if text.len() > most {
            return Err(invalid(field, "is longer than 200 bytes"));
        }
        if text.chars().any(char::is_control) {
            return Err(invalid(field, "holds a control character"));
        }
    }
    Ok(())
}
