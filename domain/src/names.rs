//! Names of layers, nodes, services, instances and topics.
//!
//! A value of one of these types has passed the rules of the contract, so that no later code checks
//! again.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::control::REPLY_PREFIX;
use crate::identity::FlowId;

/// Longest layer, node, service or instance name, in bytes.
pub const MAX_NAME_BYTES: usize = 63;
/// Longest topic name, in bytes.
pub const MAX_TOPIC_BYTES: usize = 200;
/// Before the topic, the channel of its payloads without a header.
const BARE_PREFIX: &str = "blaze/bare/";
/// Before the topic, the channel of its payloads as JSON.
const JSON_PREFIX: &str = "blaze/json/";
/// Where monitors ask those of a layer how far they are: `blaze/ping/<layer>`.
const PING_PREFIX: &str = "blaze/ping/";
/// Where a monitor answers: `blaze/pong/<layer>/<node>`.
const PONG_PREFIX: &str = "blaze/pong/";

/// Why a text is not a name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NameError {
    /// The text is empty.
    #[error("is empty")]
    Empty,
    /// The text is longer than the limit.
    #[error("has {bytes} bytes, at most {limit} are allowed")]
    TooLong {
        /// Bytes given.
        bytes: usize,
        /// Bytes allowed.
        limit: usize,
    },
    /// A character that the rules do not allow.
    #[error("holds {found:?}; allowed are {allowed}")]
    Character {
        /// The first character that is not allowed.
        found: char,
        /// What is allowed, in words.
        allowed: &'static str,
    },
    /// A name must start and end with a letter or digit.
    #[error("must start and end with a letter or digit")]
    Ends,
    /// A topic has an empty segment: a leading, trailing or double slash.
    #[error("has an empty segment: no leading, trailing or double slash")]
    EmptySegment,
    /// The topic belongs to BlazeAIoT itself.
    #[error("is reserved: names below blaze/ belong to BlazeAIoT")]
    Reserved,
}

fn check_name(text: &str) -> Result<(), NameError> {
    if text.is_empty() {
        return Err(NameError::Empty);
    }
    if text.len() > MAX_NAME_BYTES {
        return Err(NameError::TooLong { bytes: text.len(), limit: MAX_NAME_BYTES });
    }
    if let Some(found) = text.chars().find(|c| !matches!(c, 'a'..='z' | '0'..='9' | '-')) {
        return Err(NameError::Character { found, allowed: "a-z, 0-9 and -" });
    }
    if text.starts_with('-') || text.ends_with('-') {
        return Err(NameError::Ends);
    }
    Ok(())
}

fn check_topic_form(text: &str) -> Result<(), NameError> {
    if text.is_empty() {
        return Err(NameError::Empty);
    }
    if text.len() > MAX_TOPIC_BYTES {
        return Err(NameError::TooLong { bytes: text.len(), limit: MAX_TOPIC_BYTES });
    }
    if let Some(found) =
        text.chars().find(|c| !matches!(c, 'A'..='Z' | 'a'..='z' | '0'..='9' | '_' | '-' | '/'))
    {
        return Err(NameError::Character {
            found,
            allowed: "A-Z, a-z, 0-9, _, - and / between segments",
        });
    }
    if text.split('/').any(str::is_empty) {
        return Err(NameError::EmptySegment);
    }
    Ok(())
}

fn check_topic(text: &str) -> Result<(), NameError> {
    check_topic_form(text)?;
    if text == "blaze" || text.starts_with("blaze/") && !is_of_monitors(text) {
        return Err(NameError::Reserved);
    }
    Ok(())
}

/// Whether it is one of the two kinds of topic below `blaze/` that are bridged.
fn is_of_monitors(text: &str) -> bool {
    let one = |name: &str| check_name(name).is_ok();
    match (text.strip_prefix(PING_PREFIX), text.strip_prefix(PONG_PREFIX)) {
        (Some(layer), _) => one(layer),
        (_, Some(place)) => {
            place.split_once('/').is_some_and(|(layer, node)| one(layer) && one(node))
        }
        (None, None) => false,
    }
}

fn check_channel(text: &str) -> Result<(), NameError> {
    // Channels of copies may be longer than the topic that they carry.
    let of_copies = [BARE_PREFIX, JSON_PREFIX].iter().find_map(|prefix| text.strip_prefix(prefix));
    check_topic_form(of_copies.unwrap_or(text))
}

macro_rules! name {
    ($(#[$doc:meta])* $type:ident, $check:path) => {
        $(#[$doc])*
        #[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub struct $type(Arc<str>);

        impl $type {
            /// The name as text.
            #[must_use]
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl FromStr for $type {
            type Err = NameError;
            fn from_str(text: &str) -> Result<Self, NameError> {
                $check(text)?;
                Ok(Self(Arc::from(text)))
            }
        }

        impl fmt::Display for $type {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&self.0)
            }
        }

        impl fmt::Debug for $type {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                fmt::Debug::fmt(&self.0, f)
            }
        }

        impl AsRef<str> for $type {
            fn as_ref(&self) -> &str {
                &self.0
            }
        }

        impl std::borrow::Borrow<str> for $type {
            fn borrow(&self) -> &str {
                &self.0
            }
        }

        impl Serialize for $type {
            fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                serializer.serialize_str(&self.0)
            }
        }

        impl<'de> Deserialize<'de> for $type {
            fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                let text = std::borrow::Cow::<'de, str>::deserialize(deserializer)?;
                text.parse().map_err(|error| serde::de::Error::custom(format!("{text:?} {error}")))
            }
        }
    };
}

name!(
    /// Name of a layer: 1 to 63 of `a-z 0-9 -`, starting and ending with a letter or digit.
    LayerName, check_name
);
name!(
    /// Name of a node, unique in the whole system; form as [`LayerName`].
    NodeName, check_name
);
name!(
    /// Name of a service; form as [`LayerName`].
    ServiceName, check_name
);
name!(
    /// Name of an instance of a service; form as [`LayerName`]; the first one is `0`.
    InstanceName, check_name
);
name!(
    /// Name of a configuration document of any kind; form as [`LayerName`].
    DocumentName, check_name
);
name!(
    /// Name of a user topic: segments of `A-Z a-z 0-9 _ -` joined by `/`, no leading slash, at most
    /// 200 bytes, not below `blaze/`.
    TopicName, check_topic
);
name!(
    /// Name of a channel of a broker: a user topic, or one of BlazeAIoT's own below `blaze/`
    /// (control, events, replies).
    ChannelName, check_channel
);

macro_rules! document_name {
    ($($type:ident),+) => {
        $(impl From<&$type> for DocumentName {
            fn from(name: &$type) -> Self {
                Self(Arc::clone(&name.0))
            }
        }

        impl From<&DocumentName> for $type {
            fn from(name: &DocumentName) -> Self {
                Self(Arc::clone(&name.0))
            }
        })+
    };
}
// All of them follow the same rule, so that each is the name of a document and the other way round.
document_name!(LayerName, NodeName, ServiceName, InstanceName);

impl InstanceName {
    /// The instance that is meant when none is named: `0`.
    #[must_use]
    pub fn first() -> Self {
        Self(Arc::from("0"))
    }
}

impl ServiceName {
    /// The service that stands for a ROS 2 node: its full name in lower case, with `-` for all
    /// other characters; `ros2` while the name is not known.
    ///
    /// ```
    /// use blaze_domain::ServiceName;
    /// assert_eq!(ServiceName::of_ros2_node("/arm/Talker_1").as_str(), "arm-talker-1");
    /// assert_eq!(ServiceName::of_ros2_node("").as_str(), "ros2");
    /// ```
    #[must_use]
    pub fn of_ros2_node(full_name: &str) -> Self {
        let mut name = String::new();
        for c in full_name.chars() {
            let is_good = c.is_ascii_alphanumeric();
            if is_good {
                name.push(c.to_ascii_lowercase());
            } else if !name.is_empty() && !name.ends_with('-') {
                name.push('-');
            }
            if name.len() >= MAX_NAME_BYTES {
                break;
            }
        }
        let name = name.trim_end_matches('-');
        Self(Arc::from(if name.is_empty() { "ros2" } else { name }))
    }
}

impl From<&TopicName> for ChannelName {
    fn from(topic: &TopicName) -> Self {
        Self(Arc::clone(&topic.0))
    }
}

impl TopicName {
    /// Where the monitors of a layer are pinged.
    #[must_use]
    pub fn ping(layer: &LayerName) -> Self {
        Self(Arc::from(format!("{PING_PREFIX}{layer}")))
    }

    /// Where the monitor of a node answers pings.
    #[must_use]
    pub fn pong(node: &FlowId) -> Self {
        Self(Arc::from(format!("{PONG_PREFIX}{node}")))
    }

    /// Whether it carries pings or their answers, which only `blaze-monitor` may advertise and
    /// request.
    #[must_use]
    pub fn is_for_monitors_alone(&self) -> bool {
        is_of_monitors(&self.0)
    }
}

impl ChannelName {
    /// Where services send their control messages.
    #[must_use]
    pub fn control() -> Self {
        Self(Arc::from("blaze/flow/control"))
    }

    /// Where flows tell what happened: started, refused, expired, up, down.
    #[must_use]
    pub fn events() -> Self {
        Self(Arc::from("blaze/flow/events"))
    }

    /// Where a topic is served to clients that want payloads without a header.
    #[must_use]
    pub fn bare(topic: &TopicName) -> Self {
        Self(Arc::from(format!("{BARE_PREFIX}{topic}")))
    }

    /// Where a topic is served to clients that want payloads as JSON.
    #[must_use]
    pub fn json(topic: &TopicName) -> Self {
        Self(Arc::from(format!("{JSON_PREFIX}{topic}")))
    }

    /// Where one life of a service gets its answers, on brokers that make channels as they are
    /// named.
    #[must_use]
    pub fn reply(service: &ServiceName, instance: &InstanceName, life: u64) -> Self {
        Self(Arc::from(format!("{REPLY_PREFIX}{service}-{instance}-{life:016x}")))
    }

    /// Where all services get their answers, on brokers whose channels are set up beforehand.
    #[must_use]
    pub fn shared_reply() -> Self {
        Self(Arc::from(REPLY_PREFIX.trim_end_matches('/')))
    }

    /// Whether the channel is one of BlazeAIoT's own: its payloads are never framed and never
    /// bridged.
    #[must_use]
    pub fn is_reserved(&self) -> bool {
        self.0.starts_with("blaze/") && !is_of_monitors(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_follow_the_contract() {
        for good in ["edge", "robot-1", "0", &"a".repeat(63)] {
            assert!(good.parse::<NodeName>().is_ok(), "{good}");
        }
        for (bad, why) in [
            ("", NameError::Empty),
            ("-a", NameError::Ends),
            ("a-", NameError::Ends),
            ("Robot", NameError::Character { found: 'R', allowed: "a-z, 0-9 and -" }),
            (&"a".repeat(64), NameError::TooLong { bytes: 64, limit: 63 }),
        ] {
            assert_eq!(bad.parse::<NodeName>().unwrap_err(), why, "{bad}");
        }
    }

    #[test]
    fn every_ros2_node_has_a_service_name() {
        let long = format!("/{}_x", "a".repeat(62));
        for (node, service) in [
            ("/talker", "talker"),
            ("/arm//__Talker_1__", "arm-talker-1"),
            ("/ä/ö", "ros2"),
            ("/é_1", "1"),
            (long.as_str(), &"a".repeat(62)),
        ] {
            let name = ServiceName::of_ros2_node(node);
            assert_eq!(name.as_str(), service, "{node}");
            assert!(name.as_str().parse::<ServiceName>().is_ok());
        }
    }

    #[test]
    fn topics_follow_the_contract() {
        for good in ["imu/data", "A_b-9/x", &"t".repeat(200)] {
            assert!(good.parse::<TopicName>().is_ok(), "{good}");
        }
        for of_monitors in ["blaze/ping/edge", "blaze/pong/edge/robot-1"] {
            let topic = of_monitors.parse::<TopicName>().unwrap();
            assert!(topic.is_for_monitors_alone() && !ChannelName::from(&topic).is_reserved());
        }
        let node: FlowId = "edge/robot-1".parse().unwrap();
        assert_eq!(TopicName::ping(&node.layer).as_str(), "blaze/ping/edge");
        assert_eq!(TopicName::pong(&node).as_str(), "blaze/pong/edge/robot-1");
        for bad in ["blaze/ping", "blaze/ping/", "blaze/ping/a/b", "blaze/pong/a", "blaze/ping/A"] {
            assert!(bad.parse::<TopicName>().is_err(), "{bad}");
            assert!(
                bad.parse::<ChannelName>().is_ok_and(|channel| channel.is_reserved())
                    || bad.ends_with('/')
            );
        }
        for (bad, why) in [
            ("/imu", NameError::EmptySegment),
            ("imu/", NameError::EmptySegment),
            ("a//b", NameError::EmptySegment),
            ("blaze/flow/control", NameError::Reserved),
            ("blaze", NameError::Reserved),
            (&"t".repeat(201), NameError::TooLong { bytes: 201, limit: 200 }),
        ] {
            assert_eq!(bad.parse::<TopicName>().unwrap_err(), why, "{bad}");
        }
        assert!("a b".parse::<TopicName>().is_err());
    }

    #[test]
    fn channels_may_be_reserved() {
        let control: ChannelName = "blaze/flow/control".parse().unwrap();
        assert_eq!(control, ChannelName::control());
        assert!(control.is_reserved());
        let longest: TopicName = "t".repeat(200).parse().unwrap();
        let name = "a".repeat(63);
        let own = ChannelName::reply(&name.parse().unwrap(), &name.parse().unwrap(), u64::MAX);
        for reply in [own, ChannelName::shared_reply()] {
            assert_eq!(reply.as_str().parse::<ChannelName>().unwrap(), reply);
        }
        for copies in [ChannelName::bare(&longest), ChannelName::json(&longest)] {
            assert_eq!(copies.as_str().parse::<ChannelName>().unwrap(), copies);
        }
    }
}
