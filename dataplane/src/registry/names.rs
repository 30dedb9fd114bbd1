//! What the layer broker makes of topic names: which it cannot express, and which two are one to
//! it.

use std::collections::HashMap;

use blaze_domain::names::ChannelName;
use blaze_domain::{TopicName, WhyCode};

/// Longest name of a topic on Kafka, in bytes.
const MAX_KAFKA_NAME: usize = 249;
/// Names that are remembered before those of topics that nobody uses are forgotten.
const FIRST_SWEEP: usize = 1024;

/// Topics that somebody else's on the broker stands in the way of, at most; as many as a flow has
/// leases.
const MAX_FOREIGN: usize = 10_000;

/// How the layer broker names topics.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum LayerNames {
    /// As they are.
    #[default]
    Any,
    /// Kafka: `/` becomes `.`, two names that differ only in `.` and `_` collide, and those that
    /// begin with `__` are its own.
    Kafka {
        /// What stands before every name.
        prefix: String,
    },
}

/// Why a topic cannot be on the layer broker.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NameFault {
    /// The broker has no such names.
    #[error(
        "has {bytes} bytes with the broker's prefix, at most {MAX_KAFKA_NAME} are possible on Kafka"
    )]
    TooLong {
        /// Bytes that it would have.
        bytes: usize,
    },
    /// The broker keeps such names for itself.
    #[error("would be {name} on Kafka, which keeps names that begin with __ for itself")]
    Kept {
        /// The name that it would have.
        name: String,
    },
    /// Another one has this name there.
    #[error("is one name with {other} on Kafka, where . and _ are the same")]
    Collision {
        /// The other topic or reserved channel.
        other: String,
    },
}

impl NameFault {
    /// The code of `why`; that of a refused control message has the same word.
    #[must_use]
    pub fn code(&self) -> WhyCode {
        match self {
            Self::TooLong { .. } | Self::Kept { .. } => WhyCode::NameNotExpressible,
            Self::Collision { .. } => WhyCode::NameCollision,
        }
    }
}

/// Which topic holds which name of the layer broker.
pub(super) struct NameBook {
    names: LayerNames,
    holders: HashMap<String, TopicName>,
    /// Topics whose name somebody else's on the broker has, and that name.
    foreign: HashMap<TopicName, String>,
    sweep_at: usize,
}

impl NameBook {
    pub(super) fn new(names: LayerNames) -> Self {
        Self { names, holders: HashMap::new(), foreign: HashMap::new(), sweep_at: FIRST_SWEEP }
    }

    /// Takes the topic's name on the broker, unless a topic that is in use has it.
    pub(super) fn claim(
        &mut self,
        topic: &TopicName,
        in_use: impl Fn(&TopicName) -> bool,
    ) -> Result<(), NameFault> {
        let LayerNames::Kafka { prefix } = &self.names else {
            return Ok(());
        };
        let bytes = prefix.len() + topic.as_str().len();
        if bytes > MAX_KAFKA_NAME {
            return Err(NameFault::TooLong { bytes });
        }
        let name = format!("{prefix}{topic}").replace('/', ".");
        if name.starts_with("__") {
            return Err(NameFault::Kept { name });
        }
        if let Some(other) = self.foreign.get(topic) {
            return Err(NameFault::Collision { other: other.clone() });
        }
        let key = kafka_key(topic.as_str());
        if let Some(reserved) = reserved().into_iter().find(|name| kafka_key(name) == key) {
            return Err(NameFault::Collision { other: reserved.to_owned() });
        }
        match self.holders.get(&key) {
            Some(holder) if holder == topic => return Ok(()),
            Some(holder) if in_use(holder) => {
                return Err(NameFault::Collision { other: holder.to_string() });
            }
            _ => {}
        }
        if self.holders.len() >= self.sweep_at {
            self.holders.retain(|_, holder| in_use(holder));
            self.sweep_at = FIRST_SWEEP.max(self.holders.len() * 2);
        }
        self.holders.insert(key, topic.clone());
        Ok(())
    }
}

impl NameBook {
    /// The broker has a topic, made by somebody else, that it would not tell apart from this one.
    pub(super) fn note_foreign(&mut self, topic: &TopicName, other: String) {
        if self.foreign.len() < MAX_FOREIGN {
            self.foreign.insert(topic.clone(), other);
        }
    }

    /// Nobody leases the topic any more: when somebody does again, the broker is asked anew.
    pub(super) fn forget_foreign(&mut self, topic: &TopicName) {
        self.foreign.remove(topic);
    }
}

/// Equal for two names that Kafka does not tell apart. A topic holds no `.` itself.
fn kafka_key(name: &str) -> String {
    name.replace(['/', '.'], "_")
}

/// Channels of BlazeAIoT itself on a Kafka broker.
fn reserved() -> [&'static str; 5] {
    [
        "blaze/flow/control",
        "blaze/flow/events",
        "blaze/flow/leases",
        "blaze/flow/peers",
        "blaze/reply",
    ]
}

/// Where flows with one Kafka broker tell one another that they live.
#[must_use]
pub fn peers_channel() -> Option<ChannelName> {
    "blaze/flow/peers".parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topic(text: &str) -> TopicName {
        text.parse().unwrap()
    }

    fn kafka(prefix_bytes: usize) -> NameBook {
        NameBook::new(LayerNames::Kafka { prefix: "p".repeat(prefix_bytes) })
    }

    #[test]
    fn names_that_kafka_does_not_tell_apart_collide() {
        let mut book = kafka(0);
        book.claim(&topic("imu/data"), |_| true).unwrap();
        book.claim(&topic("imu/data"), |_| true).unwrap();
        let fault = book.claim(&topic("imu_data"), |_| true).unwrap_err();
        assert_eq!(fault.code(), WhyCode::NameCollision);
        assert!(fault.to_string().contains("imu/data"), "{fault}");
        for other in ["imu-data", "imu/Data", "imu/data/x"] {
            book.claim(&topic(other), |_| true).unwrap();
        }
        book.claim(&topic("imu_data"), |_| false).expect("the other is not in use any more");
        assert!(book.claim(&topic("imu/data"), |_| true).is_err());
    }

    #[test]
    fn reserved_names_are_taken() {
        for name in ["blaze_flow/control", "blaze_reply", "blaze_flow_leases"] {
            let fault = kafka(0).claim(&topic(name), |_| false).unwrap_err();
            assert_eq!(fault.code(), WhyCode::NameCollision, "{name}");
        }
    }

    #[test]
    fn names_too_long_for_kafka_are_told() {
        let longest = topic(&"t".repeat(200));
        kafka(49).claim(&longest, |_| false).unwrap();
        let fault = kafka(50).claim(&longest, |_| false).unwrap_err();
        assert_eq!(fault, NameFault::TooLong { bytes: 250 });
        assert_eq!(fault.code(), WhyCode::NameNotExpressible);
        NameBook::new(LayerNames::Any).claim(&longest, |_| false).unwrap();
    }

    #[test]
    fn names_that_kafka_keeps_for_itself_are_told() {
        for (prefix, name) in [("", "__transaction_state"), ("", "__consumer_offsets"), ("_", "_x")]
        {
            let mut book = NameBook::new(LayerNames::Kafka { prefix: prefix.to_owned() });
            let fault = book.claim(&topic(name), |_| false).unwrap_err();
            assert_eq!(fault.code(), WhyCode::NameNotExpressible, "{prefix}{name}");
        }
        kafka(1).claim(&topic("__transaction_state"), |_| false).unwrap();
        kafka(0).claim(&topic("_x/__y"), |_| false).unwrap();
    }

    #[test]
    fn what_nobody_uses_is_forgotten() {
        let mut book = kafka(0);
        for n in 0..10 * FIRST_SWEEP {
            book.claim(&topic(&format!("t{n}")), |_| false).unwrap();
        }
        assert!(book.holders.len() <= FIRST_SWEEP, "{}", book.holders.len());
    }
}
