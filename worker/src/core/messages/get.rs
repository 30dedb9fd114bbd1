//! Requests for a configuration.

use blaze_domain::control::{MAX_ID_BYTES, REPLY_PREFIX};
use blaze_domain::names::ChannelName;
use blaze_domain::{InstanceName, NodeName, ServiceName};
use serde_json::{Map, Value};

use super::fields::{check_depth, object, parsed, text};

/// Longest hash that a caller may name, in bytes; ours have 71.
const MAX_HASH_BYTES: usize = 128;
/// Where an answer goes when the request does not say.
const DEFAULT_REPLY: &str = "config";

/// Why a request gets no configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ErrorCode {
    /// The request is faulty.
    InvalidRequest,
    /// There is no such service.
    NotFound,
    /// Nothing is loaded yet.
    NotReady,
    /// The configuration is larger than what is sent.
    TooLarge,
}

impl ErrorCode {
    /// The word in messages.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::InvalidRequest => "invalid_request",
            Self::NotFound => "not_found",
            Self::NotReady => "not_ready",
            Self::TooLarge => "too_large",
        }
    }
}

/// Why a request gets no configuration, for the caller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RequestError {
    /// For programs.
    pub code: ErrorCode,
    /// For people; names the member that is wrong.
    pub detail: String,
}

impl RequestError {
    /// An error.
    pub(crate) fn new(code: ErrorCode, detail: impl Into<String>) -> Self {
        Self { code, detail: detail.into() }
    }
}

/// A request for a configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GetRequest {
    /// Is echoed.
    pub id: Option<String>,
    /// Whose; `None`: that of the node or layer itself.
    pub service: Option<ServiceName>,
    /// Which instance; `None`: the service without instance.
    pub instance: Option<InstanceName>,
    /// Where the caller runs.
    pub node: Option<NodeName>,
    /// Where the answer goes.
    pub reply_to: ChannelName,
    /// Over what the caller has.
    pub hash: Option<String>,
}

/// A request that is faulty.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RefusedRequest {
    /// Is echoed, if it could be read.
    pub id: Option<String>,
    /// Where the refusal is to go; `None`: the request cannot be read, or names a place where
    /// answers must not go: whoever can send requests could otherwise write to any topic.
    pub reply_to: Option<ChannelName>,
    /// What is wrong.
    pub error: RequestError,
}

impl GetRequest {
    /// Reads a request.
    ///
    /// # Errors
    /// What is wrong, and where to say so.
    pub fn parse(bytes: &[u8]) -> Result<Self, RefusedRequest> {
        let refused =
            |id: Option<&str>, reply_to: Option<ChannelName>, detail: String| RefusedRequest {
                id: id.map(str::to_owned),
                reply_to,
                error: RequestError::new(ErrorCode::InvalidRequest, detail),
            };
        let members =
            object(bytes).map_err(|detail| refused(None, None, format!("the request {detail}")))?;
        // First what an answer needs, so that every later fault can be answered.
        let id = text(&members, "id", MAX_ID_BYTES);
        let known_id = id.as_ref().ok().copied().flatten();
        let reply_to = reply_to(&members).map_err(|detail| refused(known_id, None, detail))?;
        let read = || -> Result<Self, String> {
            check_depth(&members)?;
            let request = Self {
                id: id.clone()?.map(str::to_owned),
                service: parsed(&members, "service")?,
                instance: parsed(&members, "instance")?,
                node: parsed(&members, "node")?,
                reply_to: reply_to.clone(),
                hash: text(&members, "hash", MAX_HASH_BYTES)?.map(str::to_owned),
            };
            match (&request.service, &request.instance) {
                (None, Some(_)) => Err("instance: needs its service".to_owned()),
                (Some(_), _) | (None, None) => Ok(request),
            }
        };
        read().map_err(|detail| refused(known_id, Some(reply_to.clone()), detail))
    }
}

/// Where answers go when nobody says so; always there, as it is a good name.
#[must_use]
pub fn default_reply() -> Option<ChannelName> {
    format!("{REPLY_PREFIX}{DEFAULT_REPLY}").parse().ok()
}

fn reply_to(members: &Map<String, Value>) -> Result<ChannelName, String> {
    let default = format!("{REPLY_PREFIX}{DEFAULT_REPLY}");
    let text = text(members, "reply_to", MAX_REPLY_BYTES)?.unwrap_or(&default);
    if !text.starts_with(REPLY_PREFIX) {
        return Err(format!("reply_to: must be a topic under {REPLY_PREFIX}"));
    }
    text.parse().map_err(|error| format!("reply_to: {error}"))
}

/// Longer than any channel; the channel's own rule gives the exact limit.
const MAX_REPLY_BYTES: usize = 1024;

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::fields::MAX_MESSAGE_BYTES;
    use super::*;

    fn parse(value: &Value) -> Result<GetRequest, RefusedRequest> {
        GetRequest::parse(value.to_string().as_bytes())
    }

    #[test]
    fn the_request_of_the_contract_is_read() {
        let text = r#"{"id":"7f1c","service":"slam","instance":"0","node":"robot-1","reply_to":"blaze/reply/slam-0","hash":"sha256:ab"}"#;
        let expected = GetRequest {
            id: Some("7f1c".to_owned()),
            service: Some("slam".parse().unwrap()),
            instance: Some("0".parse().unwrap()),
            node: Some("robot-1".parse().unwrap()),
            reply_to: "blaze/reply/slam-0".parse().unwrap(),
            hash: Some("sha256:ab".to_owned()),
        };
        assert_eq!(GetRequest::parse(text.as_bytes()), Ok(expected));
    }

    #[test]
    fn everything_may_be_absent_and_the_unknown_is_ignored() {
        for value in [json!({}), json!({"id": null, "service": null, "later": [{"a": 1}]})] {
            let request = parse(&value).unwrap();
            assert_eq!((request.id, request.service, request.hash), (None, None, None));
            assert_eq!(request.reply_to.as_str(), "blaze/reply/config");
        }
    }

    #[test]
    fn a_wrong_member_is_named_where_the_answer_is_waited_for() {
        for (member, value) in [
            ("id", json!(7)),
            ("id", json!("a\nb")),
            ("id", json!("x".repeat(MAX_ID_BYTES + 1))),
            ("service", json!(["slam"])),
            ("service", json!("Slam")),
            ("instance", json!(0)),
            ("node", json!("-")),
            ("hash", json!(false)),
            ("hash", json!("x".repeat(MAX_HASH_BYTES + 1))),
        ] {
            let mut request =
                json!({"id": "7f1c", "service": "slam", "reply_to": "blaze/reply/me"});
            request[member] = value;
            let refused = parse(&request).unwrap_err();
            assert_eq!(refused.reply_to.as_ref().map(ChannelName::as_str), Some("blaze/reply/me"));
            assert_eq!(refused.id.as_deref(), (member != "id").then_some("7f1c"));
            assert_eq!(refused.error.code, ErrorCode::InvalidRequest);
            assert!(refused.error.detail.starts_with(&format!("{member}: ")), "{refused:?}");
        }
        let refused = parse(&json!({"instance": "0"})).unwrap_err();
        assert_eq!(refused.error.detail, "instance: needs its service");
    }

    #[test]
    fn an_answer_goes_nowhere_but_below_the_replies() {
        for reply_to in [
            json!("blaze/config/get"),
            json!("imu/data"),
            json!("blaze/reply"),
            json!("blaze/reply/"),
            json!("blaze/reply//a"),
            json!("blaze/reply/a b"),
            json!(format!("blaze/reply/{}", "a".repeat(300))),
            json!(5),
        ] {
            let refused = parse(&json!({"id": "7f1c", "reply_to": reply_to})).unwrap_err();
            assert_eq!(refused.reply_to, None, "{reply_to}");
            assert!(refused.error.detail.starts_with("reply_to: "), "{refused:?}");
        }
    }

    #[test]
    fn what_is_no_object_does_not_say_where_its_answer_goes() {
        let long = format!("{{\"id\":\"{}\"}}", "x".repeat(MAX_MESSAGE_BYTES));
        for bytes in [&b""[..], b"{", b"[]", b"7", b"\xff", b"{} {}", long.as_bytes()] {
            let refused = GetRequest::parse(bytes).unwrap_err();
            assert_eq!((refused.id, refused.reply_to), (None, None));
        }
        let deep = format!("{}{}", "[".repeat(5000), "]".repeat(5000));
        assert!(GetRequest::parse(deep.as_bytes()).is_err());
        let nested = format!("{{\"x\":{}{}}}", "[".repeat(40), "]".repeat(40));
        assert!(GetRequest::parse(nested.as_bytes()).unwrap_err().reply_to.is_some());
    }
}
