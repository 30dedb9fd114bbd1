//! What a service says when it advertises or requests a topic.

use std::time::Duration;

use blaze_domain::{Durability, MAX_PAYLOAD_BYTES, Priority, Reliability, TopicName};

use super::FlowError;
use super::protocol::{OriginFilter, Terms};
use crate::publisher::{MAX_WORD_BYTES, lifespan_ms};

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
    /// Messages kept per writer for late joiners, 1 or more.
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
            encoding: "application/octet-stream".to_owned(),
            type_name: String::new(),
            type_hash: String::new(),
            reliability: Reliability::BestEffort,
            durability: Durability::Volatile,
            depth: 1,
            priority: None,
            lifespan: Duration::ZERO,
        }
    }

    pub(super) fn terms(&self) -> Result<Terms, FlowError> {
        if self.max_bytes.is_some_and(|bytes| bytes > MAX_PAYLOAD_BYTES as u64) {
            return Err(invalid("max_bytes", "is above 16 MiB"));
        }
        Ok(Terms {
            rate_hz: rate("rate_hz", self.rate_hz)?,
            max_bytes: self.max_bytes,
            encoding: word("encoding", &self.encoding)?,
            type_name: word("type", &self.type_name)?,
            type_hash: word("type_hash", &self.type_hash)?,
            reliability: Some(self.reliability),
            durability: Some(self.durability),
            depth: depth(self.depth)?,
            priority: self.priority,
            lifespan_ms: Some(lifespan_ms(self.lifespan)),
            ..Terms::default()
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
    /// Messages per writer to begin with, 1 or more.
    pub depth: u32,
    /// May lower the publisher's class on the inter scope, never raise it.
    pub priority: Option<Priority>,
    /// Only messages of this origin.
    pub from: OriginFilter,
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
            from: OriginFilter::default(),
            bare: false,
        }
    }

    pub(super) fn terms(&self) -> Result<Terms, FlowError> {
        Ok(Terms {
            max_rate_hz: rate("max_rate_hz", self.max_rate_hz)?,
            encoding: word("encoding", &self.encoding)?,
            type_name: word("type", &self.type_name)?,
            type_hash: word("type_hash", &self.type_hash)?,
            reliability: Some(self.reliability),
            durability: Some(self.durability),
            depth: depth(self.depth)?,
            priority: self.priority,
            lifespan_ms: Some(lifespan_ms(self.lifespan)),
            from: (self.from != OriginFilter::default()).then(|| self.from.clone()),
            bare: self.bare.then_some(true),
            ..Terms::default()
        })
    }
}

fn invalid(field: &'static str, reason: &'static str) -> FlowError {
    FlowError::Invalid { field, reason }
}

fn rate(field: &'static str, rate: Option<f64>) -> Result<Option<f64>, FlowError> {
    match rate {
        Some(rate) if !rate.is_finite() || rate <= 0.0 => Err(invalid(field, "must be above 0")),
        rate => Ok(rate),
    }
}

fn depth(depth: u32) -> Result<Option<u32>, FlowError> {
    match depth {
        0 => Err(invalid("depth", "must be 1 or more")),
        depth => Ok(Some(depth)),
    }
}

/// Absent when empty.
fn word(field: &'static str, text: &str) -> Result<Option<String>, FlowError> {
    if text.len() > MAX_WORD_BYTES {
        return Err(invalid(field, "is longer than 200 bytes"));
    }
    Ok((!text.is_empty()).then(|| text.to_owned()))
}
