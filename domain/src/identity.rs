//! Who a message, a lease or a flow is.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::names::{LayerName, NameError, NodeName};

/// Identity of one publisher: 16 bytes, random per publisher of an SDK, given by the flow for bare
/// messages.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct WriterId(pub [u8; 16]);

impl fmt::Display for WriterId {
    /// 32 lower-case hexadecimal digits.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for WriterId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for WriterId {
    type Err = WriterIdError;
    fn from_str(text: &str) -> Result<Self, WriterIdError> {
        let bytes = text.as_bytes();
        if bytes.len() != 32 {
            return Err(WriterIdError);
        }
        let mut id = [0; 16];
        for (slot, pair) in id.iter_mut().zip(bytes.chunks_exact(2)) {
            let digit = |b: u8| (b as char).to_digit(16).ok_or(WriterIdError);
            let value = digit(pair[0])? * 16 + digit(pair[1])?;
            *slot = u8::try_from(value).map_err(|_| WriterIdError)?;
        }
        Ok(Self(id))
    }
}

/// A text is not a writer identity.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("a writer is 32 hexadecimal digits")]
pub struct WriterIdError;

/// Where a message was born. Parts that are not known are empty, so these are plain texts.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
pub struct Origin {
    /// Layer of the publisher.
    pub layer: String,
    /// Node of the publisher; empty for a service of a layer that names none.
    pub node: String,
    /// Service of the publisher; empty where several could have been it.
    pub service: String,
    /// Instance of the service.
    pub instance: String,
    /// Opaque, larger is newer; the SDK gives milliseconds since 1970 at its start.
    pub epoch: u64,
}

/// One BlazeFlow process: its layer and node, written `layer/node`.
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct FlowId {
    /// Layer of the flow.
    pub layer: LayerName,
    /// Node of the flow.
    pub node: NodeName,
}

impl FlowId {
    /// The flow of a node.
    #[must_use]
    pub fn new(layer: LayerName, node: NodeName) -> Self {
        Self { layer, node }
    }

    /// Whether a text is this flow's name.
    #[must_use]
    pub fn is_written(&self, text: &str) -> bool {
        text.split_once('/') == Some((self.layer.as_str(), self.node.as_str()))
    }

    /// Full name of its own node on a ROS 2 network, where names have no `-`:
    /// `/blaze/edge_robot_1` of `edge/robot-1`.
    #[must_use]
    pub fn ros2_node(&self) -> String {
        format!("/blaze/{}_{}", self.layer, self.node).replace('-', "_")
    }
}

impl fmt::Display for FlowId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.layer, self.node)
    }
}

impl fmt::Debug for FlowId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for FlowId {
    type Err = NameError;
    fn from_str(text: &str) -> Result<Self, NameError> {
        let (layer, node) = text.split_once('/').ok_or(NameError::EmptySegment)?;
        Ok(Self { layer: layer.parse()?, node: node.parse()? })
    }
}

impl Serialize for FlowId {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> serde::Deserialize<'de> for FlowId {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = std::borrow::Cow::<'de, str>::deserialize(deserializer)?;
        text.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_writer_survives_its_text() {
        let writer = WriterId(*b"0123456789abcdef");
        assert_eq!(writer.to_string().parse::<WriterId>().unwrap(), writer);
        assert!("xyz".parse::<WriterId>().is_err());
        assert!("g".repeat(32).parse::<WriterId>().is_err());
        assert!("ä".repeat(16).parse::<WriterId>().is_err());
    }

    #[test]
    fn a_flow_survives_its_text() {
        let flow: FlowId = "edge/robot-1".parse().unwrap();
        assert_eq!(flow.to_string(), "edge/robot-1");
        assert!(flow.is_written("edge/robot-1") && !flow.is_written("edge/robot-12"));
        assert!("edge".parse::<FlowId>().is_err());
    }
}
