//! What a flow says of control messages: answers to their senders, events to everybody.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::words::{ErrorCode, EventKind};
use crate::config::Timestamp;
use crate::identity::FlowId;
use crate::names::TopicName;

/// Longest `detail` of an error, in characters; it may hold text of the sender.
const MAX_DETAIL_CHARS: usize = 200;

/// What is wrong with a control message, and where.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
#[serde(from = "ReadError")]
#[error("{code} at {pointer:?}: {detail}")]
pub struct ControlError {
    /// The fault.
    pub code: ErrorCode,
    /// JSON pointer (RFC 6901) to the faulty field; in an array it begins with the index. Empty:
    /// the whole payload.
    pub pointer: String,
    /// For people.
    pub detail: String,
}

impl ControlError {
    /// An error at a place; an overlong detail is cut.
    #[must_use]
    pub fn new(code: ErrorCode, pointer: impl Into<String>, detail: impl Into<String>) -> Self {
        let mut detail = detail.into();
        if let Some((cut, _)) = detail.char_indices().nth(MAX_DETAIL_CHARS) {
            detail.truncate(cut);
            detail.push('…');
        }
        Self { code, pointer: pointer.into(), detail }
    }

    /// The pointer without the place of the object in an array: a sender joins objects as it likes,
    /// so that place says nothing to whoever made the object.
    #[must_use]
    pub fn pointer_in_object(&self) -> &str {
        let Some(rest) = self.pointer.strip_prefix('/') else {
            return &self.pointer;
        };
        let (first, after) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
        let is_place = !first.is_empty() && first.bytes().all(|byte| byte.is_ascii_digit());
        if is_place { after } else { &self.pointer }
    }
}

/// An error as another version may write it.
#[derive(Deserialize, Default)]
#[serde(default)]
struct ReadError {
    code: String,
    pointer: String,
    detail: String,
}

impl From<ReadError> for ControlError {
    /// A refusal is one whatever its code: a word of a newer version becomes `invalid_value` and
    /// goes before the detail.
    fn from(read: ReadError) -> Self {
        match read.code.parse() {
            Ok(code) => Self::new(code, read.pointer, read.detail),
            Err(_) => Self::new(
                ErrorCode::InvalidValue,
                read.pointer,
                format!("{}: {}", read.code, read.detail),
            ),
        }
    }
}

/// The objects of a payload, which is one or an array of them. What is not understood is left out,
/// the others stay.
fn read_each<T: for<'de> Deserialize<'de>>(payload: &[u8]) -> Vec<T> {
    let values = match serde_json::from_slice(payload) {
        Ok(Value::Array(values)) => values,
        Ok(value) => vec![value],
        Err(_) => return Vec::new(),
    };
    let read = values.into_iter().map(T::deserialize);
    read.filter_map(Result::ok).collect()
}

/// The answer to one control message that named a `reply_to`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Answer {
    /// The `id` of the message, if it had one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub id: Option<String>,
    /// Whether it was accepted.
    pub ok: bool,
    /// The flow that accepted it, `layer/node`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flow: Option<String>,
    /// Seconds until the lease lapses; 0 = never, or withdrawn.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lease_s: Option<u32>,
    /// What the called service replied.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reply: Option<Value>,
    /// Why it was refused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<ControlError>,
}

impl Answer {
    /// The message was accepted by `flow` for `lease_s` seconds.
    #[must_use]
    pub fn granted(id: Option<String>, flow: &FlowId, lease_s: u32) -> Self {
        Self { lease_s: Some(lease_s), ..Self::accepted(id, flow.to_string()) }
    }

    /// The service that a call was for has replied; `flow`: that of its server, `layer/node`.
    #[must_use]
    pub fn replied(id: Option<String>, flow: String, reply: Value) -> Self {
        Self { reply: Some(reply), ..Self::accepted(id, flow) }
    }

    fn accepted(id: Option<String>, flow: String) -> Self {
        Self { id, ok: true, flow: Some(flow), lease_s: None, reply: None, error: None }
    }

    /// The message was refused.
    #[must_use]
    pub fn refused(id: Option<String>, error: ControlError) -> Self {
        Self { id, ok: false, flow: None, lease_s: None, reply: None, error: Some(error) }
    }

    /// The answers of a payload: one object or an array. What is no answer is left out.
    #[must_use]
    pub fn read_all(payload: &[u8]) -> Vec<Self> {
        read_each(payload)
    }

    /// The answer as a JSON object.
    #[must_use]
    pub fn to_json(&self) -> Value {
        serde_json::to_value(self).unwrap_or_default()
    }
}

/// What a flow tells everybody on `blaze/flow/events`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Event {
    /// What happened.
    #[serde(rename = "event")]
    pub kind: EventKind,
    /// The flow that says so, `layer/node`.
    pub flow: String,
    /// The topic; empty where none is meant.
    #[serde(default)]
    pub topic: String,
    /// Error code or verdict; empty where there is none.
    #[serde(default)]
    pub code: String,
    /// For people, with `convert_failed`; else empty.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub detail: String,
    /// When, RFC 3339 in UTC with milliseconds.
    pub time: String,
}

impl Event {
    /// An event at a wall-clock time in milliseconds since 1970.
    #[must_use]
    pub fn new(
        kind: EventKind,
        flow: &FlowId,
        topic: Option<&TopicName>,
        code: &str,
        unix_ms: u64,
    ) -> Self {
        Self {
            kind,
            flow: flow.to_string(),
            topic: topic.map(ToString::to_string).unwrap_or_default(),
            code: code.to_owned(),
            detail: String::new(),
            time: rfc3339_millis(unix_ms),
        }
    }

    /// The events of a payload: one object or an array. What is no event, or of a kind of a newer
    /// version, is left out.
    #[must_use]
    pub fn read_all(payload: &[u8]) -> Vec<Self> {
        read_each(payload)
    }

    /// The event as a JSON object.
    #[must_use]
    pub fn to_json(&self) -> Value {
        serde_json::to_value(self).unwrap_or_default()
    }
}

/// A time in milliseconds since 1970 as `2026-01-31T12:00:00.000Z`.
#[must_use]
pub fn rfc3339_millis(unix_ms: u64) -> String {
    Timestamp::from_millis(i64::try_from(unix_ms).unwrap_or(i64::MAX)).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_have_the_keys_of_the_contract_in_its_order() {
        let flow: FlowId = "edge/robot-1".parse().unwrap();
        let granted = Answer::granted(Some("7".into()), &flow, 15);
        assert_eq!(
            granted.to_json().to_string(),
            r#"{"id":"7","ok":true,"flow":"edge/robot-1","lease_s":15}"#
        );
        let refused = Answer::refused(
            Some("7".into()),
            ControlError::new(ErrorCode::InvalidTopic, "/topic", "is empty"),
        );
        assert_eq!(
            refused.to_json().to_string(),
            r#"{"id":"7","ok":false,"error":{"code":"invalid_topic","pointer":"/topic","detail":"is empty"}}"#
        );
        for answer in [granted, refused] {
            assert_eq!(serde_json::from_value::<Answer>(answer.to_json()).unwrap(), answer);
        }
    }

    #[test]
    fn events_have_the_keys_of_the_contract() {
        let flow: FlowId = "edge/robot-1".parse().unwrap();
        let topic: TopicName = "imu/data".parse().unwrap();
        let event = Event::new(
            EventKind::LeaseExpired,
            &flow,
            Some(&topic),
            "lease_expired",
            1_700_000_000_123,
        );
        let text = r#"{"event":"lease_expired","flow":"edge/robot-1","topic":"imu/data","code":"lease_expired","time":"2023-11-14T22:13:20.123Z"}"#;
        assert_eq!(event.to_json().to_string(), text);
        assert_eq!(serde_json::from_str::<Event>(text).unwrap(), event);
    }

    #[test]
    fn answers_and_events_of_other_versions_are_read() {
        let answers =
            Answer::read_all(br#"[{"id":"7","ok":true,"lease_s":15,"new":1}, 3, {"x":1}]"#);
        assert_eq!(answers.len(), 1);
        assert_eq!((answers[0].id.as_deref(), answers[0].lease_s), (Some("7"), Some(15)));
        assert!(Answer::read_all(b"no json").is_empty());
        for (error, expected) in [
            (r#"{"code":"tired","detail":"no"}"#, (ErrorCode::InvalidValue, "", "tired: no")),
            (r#"{"code":"stale_epoch","pointer":"/epoch"}"#, (ErrorCode::StaleEpoch, "/epoch", "")),
        ] {
            let answer = format!(r#"{{"id":"7","ok":false,"error":{error}}}"#);
            let read = Answer::read_all(answer.as_bytes()).remove(0).error.unwrap();
            assert_eq!((read.code, read.pointer.as_str(), read.detail.as_str()), expected);
        }
        let events =
            br#"[{"event":"flow_started","flow":"edge/r","time":"t"},{"event":"flow_sings","flow":"edge/r","time":"t"}]"#;
        let read = Event::read_all(events);
        assert_eq!(read.len(), 1);
        assert_eq!((read[0].kind, read[0].topic.as_str()), (EventKind::FlowStarted, ""));
    }

    #[test]
    fn pointers_lose_the_place_in_the_array() {
        for (pointer, expected) in [
            ("/topic", "/topic"),
            ("/3/topic", "/topic"),
            ("/3", ""),
            ("", ""),
            ("/from/layer", "/from/layer"),
        ] {
            let error = ControlError::new(ErrorCode::InvalidValue, pointer, "");
            assert_eq!(error.pointer_in_object(), expected, "{pointer}");
        }
    }

    #[test]
    fn details_are_bounded() {
        let error = ControlError::new(ErrorCode::InvalidValue, "/x", "ä".repeat(5000));
        assert_eq!(error.detail.chars().count(), MAX_DETAIL_CHARS + 1);
    }
}
