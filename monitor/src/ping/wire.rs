//! Messages of pings and their answers: JSON of at most 1,200 bytes.

use std::borrow::Cow;

use blaze_domain::FlowId;
use bytes::Bytes;
use serde::{Deserialize, Serialize};

use super::limits::MESSAGE_BYTES;

/// Name `layer/node`, borrowed from the message where it has no escapes.
#[derive(Debug, Serialize, Deserialize)]
#[serde(transparent)]
pub(super) struct Name<'a>(#[serde(borrow)] pub(super) Cow<'a, str>);

impl<'a> Name<'a> {
    pub(super) fn of(node: &FlowId) -> Self {
        Self(Cow::Owned(node.to_string()))
    }

    pub(super) fn is(&self, node: &FlowId) -> bool {
        node.is_written(&self.0)
    }
}

/// Question to the nodes of a layer.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Ping<'a> {
    /// Number of the ping, which its answers repeat.
    pub(super) id: u64,
    #[serde(borrow)]
    pub(super) from: Name<'a>,
    /// Nodes that are asked; absent: all nodes of the layer.
    #[serde(borrow, default, skip_serializing_if = "Option::is_none")]
    pub(super) to: Option<Vec<Name<'a>>>,
    /// Wall clock at sending, in nanoseconds since 1970.
    pub(super) t1: i64,
    /// One more after each step of the sender's wall clock; another one after a restart.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) clock: Option<i64>,
}

/// Answers of one node to one or several pings.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Pong<'a> {
    #[serde(borrow)]
    pub(super) from: Name<'a>,
    #[serde(borrow)]
    pub(super) answers: Vec<Answer<'a>>,
    /// As in [`Ping`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) clock: Option<i64>,
}

/// Answer to one ping.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Answer<'a> {
    #[serde(borrow)]
    pub(super) to: Name<'a>,
    pub(super) id: u64,
    /// Wall clock when the ping was received, in nanoseconds since 1970.
    pub(super) t2: i64,
    /// Wall clock when the answer was sent, in nanoseconds since 1970.
    pub(super) t3: i64,
    /// Time between the two by the monotonic clock, in nanoseconds.
    pub(super) hold_ns: u64,
    /// Whether the clock of the answering node is synchronised.
    pub(super) sync: bool,
}

/// A message as JSON; empty only if it cannot be written, which these types do not allow.
pub(super) fn written<T: Serialize>(message: &T) -> Vec<u8> {
    serde_json::to_vec(message).unwrap_or_default()
}

/// Splits entries over messages that are as long as is allowed: `write` makes a message of some of
/// them. An entry that is too long by itself gets a message of its own, which names cannot reach.
pub(super) fn split<T>(
    mut entries: Vec<T>,
    write: impl Fn(&[T]) -> Vec<u8>,
) -> Vec<(Vec<T>, Bytes)> {
    let mut messages = Vec::new();
    while !entries.is_empty() {
        let mut count = entries.len();
        let mut message = write(&entries);
        while message.len() > MESSAGE_BYTES && count > 1 {
            // Entries are of similar length, so the share that fits is nearly known.
            count = (count * MESSAGE_BYTES / message.len()).clamp(1, count - 1);
            message = write(&entries[..count]);
        }
        let rest = entries.split_off(count);
        messages.push((std::mem::replace(&mut entries, rest), Bytes::from(message)));
    }
    messages
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_those_of_the_contract() {
        let ping = r#"{"id":41,"from":"edge/robot-1","to":["fog/fog-1"],"t1":1767225600000000000}"#;
        let pong = r#"{"from":"fog/fog-1","answers":[{"to":"edge/robot-1","id":41,"t2":1767225600003000000,"t3":1767225600053000000,"hold_ns":50000000,"sync":true}]}"#;
        assert_eq!(written(&serde_json::from_str::<Ping<'_>>(ping).unwrap()), ping.as_bytes());
        assert_eq!(written(&serde_json::from_str::<Pong<'_>>(pong).unwrap()), pong.as_bytes());
    }

    #[test]
    fn a_long_list_is_split_without_loss() {
        let entries: Vec<String> = (0..300).map(|n| format!("{:0>1$}", n, 1 + n % 90)).collect();
        let messages = split(entries.clone(), |part| written(&part));
        assert!(messages.iter().all(|(_, bytes)| bytes.len() <= MESSAGE_BYTES));
        assert!(messages.len() < 20, "{} messages", messages.len());
        let joined: Vec<String> = messages.into_iter().flat_map(|(part, _)| part).collect();
        assert_eq!(joined, entries);
    }
}
