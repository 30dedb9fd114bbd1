//! From a payload to control messages, with the place of every fault.

use std::str::FromStr;

use serde_json::value::RawValue;
use serde_json::{Map, Value};

use super::answer::ControlError;
use super::message::{
    AdvertiseMessage, CallMessage, Common, ControlMessage, OriginSelector, Quality, RequestMessage,
    WithdrawMessage,
};
use super::words::ErrorCode;
use super::{
    DEFAULT_CALL_TIMEOUT_MS, DEFAULT_TTL_S, MAX_CALL_TIMEOUT_MS, MAX_CONTROL_BYTES,
    MAX_CONTROL_OBJECTS, MAX_DEPTH, MAX_ENCODING_BYTES, MAX_ID_BYTES, MAX_TTL_S, MAX_TYPE_BYTES,
    REPLY_PREFIX,
};
use crate::names::{ChannelName, InstanceName, NameError, TopicName};
use crate::qos::{Durability, Reliability};

/// The service that may ping.
const MONITOR: &str = "blaze-monitor";
/// Larger calls are not read, not even to answer them.
const MAX_LARGE_CALL_BYTES: usize = 1024 * 1024;

/// One object of a control payload.
#[derive(Debug, Clone, PartialEq)]
pub struct ParsedObject {
    /// Begins every pointer of this object: `/3` in an array, empty for a lone object.
    pub pointer: String,
    /// Its `id`, also when the rest is faulty.
    pub id: Option<String>,
    /// Its `reply_to`, also when the rest is faulty.
    pub reply_to: Option<ChannelName>,
    /// Its topic, also when the rest is faulty.
    pub topic: Option<TopicName>,
    /// The message, or its first fault.
    pub message: Result<ControlMessage, ControlError>,
}

/// Reads a control payload: one JSON object, or an array of at most 200, in at most 64 KiB.
///
/// # Errors
/// The payload as a whole is not JSON, too large, or neither an object nor an array. Faults of
/// single objects are in their [`ParsedObject`].
pub fn parse_payload(payload: &[u8]) -> Result<Vec<ParsedObject>, ControlError> {
    if payload.len() > MAX_CONTROL_BYTES {
        let detail =
            format!("has {} bytes, at most {MAX_CONTROL_BYTES} are allowed", payload.len());
        return match large_call(payload, &detail) {
            Some(call) => Ok(vec![call]),
            None => Err(ControlError::new(ErrorCode::InvalidValue, "", detail)),
        };
    }
    let not_json =
        |error: serde_json::Error| ControlError::new(ErrorCode::InvalidJson, "", error.to_string());
    if payload.iter().find(|byte| !byte.is_ascii_whitespace()) != Some(&b'[') {
        // A lone text keeps its faults to itself, so a value that is no JSON is a fault of the
        // payload.
        let value = serde_json::from_slice::<Value>(payload).map_err(not_json)?;
        return match value {
            Value::Object(object) => Ok(vec![parse_object(&object, String::new())]),
            _ => Err(ControlError::new(
                ErrorCode::InvalidValue,
                "",
                "is neither an object nor an array of objects",
            )),
        };
    }
    // Each object is parsed for itself: one that nests too deeply or holds an absurd number does
    // not spoil the others.
    let texts = serde_json::from_slice::<Vec<&RawValue>>(payload).map_err(not_json)?;
    if texts.len() > MAX_CONTROL_OBJECTS {
        return Err(ControlError::new(
            ErrorCode::InvalidValue,
            "",
            format!("holds {} objects, at most {MAX_CONTROL_OBJECTS} are allowed", texts.len()),
        ));
    }
    Ok(texts
        .iter()
        .enumerate()
        .map(|(index, text)| parse_element(text.get(), format!("/{index}")))
        .collect())
}

/// A call that is too large, so that its sender can be answered.
fn large_call(payload: &[u8], detail: &str) -> Option<ParsedObject> {
    if payload.len() > MAX_LARGE_CALL_BYTES {
        return None;
    }
    let value: Value = serde_json::from_slice(payload).ok()?;
    let object = value.as_object().filter(|object| object.get("op") == Some(&"call".into()))?;
    let error = ControlError::new(ErrorCode::TooLarge, "/request", detail);
    Some(ParsedObject { message: Err(error), ..parse_object(object, String::new()) })
}

fn parse_element(text: &str, pointer: String) -> ParsedObject {
    let error = match serde_json::from_str::<Value>(text) {
        Ok(Value::Object(object)) => return parse_object(&object, pointer),
        Ok(_) => ControlError::new(ErrorCode::InvalidValue, pointer.clone(), "is not an object"),
        Err(error) => ControlError::new(ErrorCode::InvalidJson, pointer.clone(), error.to_string()),
    };
    ParsedObject { pointer, id: None, reply_to: None, topic: None, message: Err(error) }
}

fn parse_object(object: &Map<String, Value>, pointer: String) -> ParsedObject {
    let fields = Fields { object, pointer: &pointer };
    // First what an answer needs, so that every later fault can be answered.
    let reply_to = fields.reply_to();
    let id = fields.text("id", MAX_ID_BYTES);
    let topic = fields.topic();
    let (known_id, known_reply, known_topic) =
        (id.clone().ok().flatten(), reply_to.clone().ok().flatten(), topic.clone().ok());
    let message = parse_message(&fields, reply_to, id, topic);
    ParsedObject { id: known_id, reply_to: known_reply, topic: known_topic, message, pointer }
}

fn parse_message(
    fields: &Fields<'_>,
    reply_to: Result<Option<ChannelName>, ControlError>,
    id: Result<Option<String>, ControlError>,
    topic: Result<TopicName, ControlError>,
) -> Result<ControlMessage, ControlError> {
    let reply_to = reply_to?;
    let id = id?;
    let op = fields.op()?;
    let common = Common {
        topic: topic?,
        service: fields
            .name("service")?
            .ok_or_else(|| fields.error(ErrorCode::InvalidValue, "service", "is missing"))?,
        instance: fields.name("instance")?.unwrap_or_else(InstanceName::first),
        layer: fields.name("layer")?,
        node: fields.name("node")?,
        epoch: fields.integer("epoch", 0, u64::MAX)?.unwrap_or(0),
        id,
        reply_to,
    };
    fields.check_monitor(&common)?;
    Ok(match op {
        Op::Advertise => ControlMessage::Advertise(AdvertiseMessage {
            common,
            ttl_s: fields.ttl()?,
            rate_hz: fields.positive("rate_hz")?,
            max_bytes: fields.integer("max_bytes", 0, u64::MAX)?,
            quality: fields.quality()?,
        }),
        Op::Request => ControlMessage::Request(RequestMessage {
            common,
            ttl_s: fields.ttl()?,
            max_rate_hz: fields.positive("max_rate_hz")?,
            bare: fields.boolean("bare")?.unwrap_or(false),
            json: fields.boolean("json")?.unwrap_or(false),
            from: fields.from()?,
            quality: fields.quality()?,
        }),
        Op::Withdraw => {
            ControlMessage::Withdraw(WithdrawMessage { common, kind: fields.word("kind")? })
        }
        Op::Call => fields.call(common)?,
    })
}

#[derive(Clone, Copy)]
enum Op {
    Advertise,
    Request,
    Withdraw,
    Call,
}

/// The fields of one object. `null` is as good as absent.
struct Fields<'a> {
    object: &'a Map<String, Value>,
    pointer: &'a str,
}

impl Fields<'_> {
    fn get(&self, key: &str) -> Option<&Value> {
        self.object.get(key).filter(|value| !value.is_null())
    }

    fn error(&self, code: ErrorCode, key: &str, detail: impl Into<String>) -> ControlError {
        ControlError::new(code, format!("{}/{key}", self.pointer), detail)
    }

    fn wrong(&self, key: &str, wanted: &str) -> ControlError {
        self.error(ErrorCode::InvalidValue, key, format!("must be {wanted}"))
    }

    fn op(&self) -> Result<Op, ControlError> {
        match self.get("op") {
            Some(Value::String(text)) => match text.as_str() {
                "advertise" => Ok(Op::Advertise),
                "request" => Ok(Op::Request),
                "withdraw" => Ok(Op::Withdraw),
                "call" => Ok(Op::Call),
                other => Err(format!("{other:?} is not one of advertise, request, withdraw, call")),
            },
            Some(_) => Err("must be a text".to_owned()),
            None => Err("is missing".to_owned()),
        }
        .map_err(|detail| self.error(ErrorCode::UnknownOp, "op", detail))
    }

    fn topic(&self) -> Result<TopicName, ControlError> {
        let text = match self.get("topic") {
            Some(Value::String(text)) => text,
            Some(_) => return Err(self.wrong("topic", "a text")),
            None => return Err(self.error(ErrorCode::InvalidTopic, "topic", "is missing")),
        };
        text.parse().map_err(|error| {
            let code = match error {
                NameError::Reserved => ErrorCode::ReservedTopic,
                _ => ErrorCode::InvalidTopic,
            };
            self.error(code, "topic", error.to_string())
        })
    }

    /// Pings and their answers are carried for monitors alone.
    fn check_monitor(&self, common: &Common) -> Result<(), ControlError> {
        if !common.topic.is_for_monitors_alone() || common.service.as_str() == MONITOR {
            return Ok(());
        }
        let detail = format!("is reserved for the service {MONITOR}");
        Err(self.error(ErrorCode::ReservedTopic, "topic", detail))
    }

    fn reply_to(&self) -> Result<Option<ChannelName>, ControlError> {
        let Some(text) = self.text("reply_to", usize::MAX)? else {
            return Ok(None);
        };
        if !text.starts_with(REPLY_PREFIX) {
            return Err(self.wrong("reply_to", &format!("a topic under {REPLY_PREFIX}")));
        }
        let channel = text.parse().map_err(|error: NameError| {
            self.error(ErrorCode::InvalidValue, "reply_to", error.to_string())
        });
        channel.map(Some)
    }

    /// A text without control characters and not longer than the limit.
    fn text(&self, key: &str, limit: usize) -> Result<Option<String>, ControlError> {
        match self.get(key) {
            None => Ok(None),
            Some(Value::String(text)) if text.len() > limit => {
                Err(self.wrong(key, &format!("at most {limit} bytes long, it has {}", text.len())))
            }
            Some(Value::String(text)) if text.chars().any(char::is_control) => {
                Err(self.wrong(key, "free of control characters"))
            }
            Some(Value::String(text)) => Ok(Some(text.clone())),
            Some(_) => Err(self.wrong(key, "a text")),
        }
    }

    fn parsed<T: FromStr<Err: std::fmt::Display>>(
        &self,
        key: &str,
    ) -> Result<Option<T>, ControlError> {
        match self.get(key) {
            None => Ok(None),
            Some(Value::String(text)) => match text.parse() {
                Ok(value) => Ok(Some(value)),
                Err(error) => Err(self.error(ErrorCode::InvalidValue, key, error.to_string())),
            },
            Some(_) => Err(self.wrong(key, "a text")),
        }
    }

    fn name<T: FromStr<Err = NameError>>(&self, key: &str) -> Result<Option<T>, ControlError> {
        self.parsed(key)
    }

    fn word<T: FromStr<Err: std::fmt::Display>>(
        &self,
        key: &str,
    ) -> Result<Option<T>, ControlError> {
        self.parsed(key)
    }

    fn integer(&self, key: &str, lowest: u64, highest: u64) -> Result<Option<u64>, ControlError> {
        let Some(value) = self.get(key) else {
            return Ok(None);
        };
        match whole_number(value) {
            Some(number) if (lowest..=highest).contains(&number) => Ok(Some(number)),
            _ => Err(self.wrong(key, &format!("a whole number from {lowest} to {highest}"))),
        }
    }

    fn small_integer(
        &self,
        key: &str,
        lowest: u32,
        highest: u32,
    ) -> Result<Option<u32>, ControlError> {
        let number = self.integer(key, lowest.into(), highest.into())?;
        Ok(number.and_then(|number| u32::try_from(number).ok()))
    }

    fn positive(&self, key: &str) -> Result<Option<f64>, ControlError> {
        let Some(value) = self.get(key) else {
            return Ok(None);
        };
        match value.as_f64() {
            Some(number) if number.is_finite() && number > 0.0 => Ok(Some(number)),
            _ => Err(self.wrong(key, "a number above 0")),
        }
    }

    fn boolean(&self, key: &str) -> Result<Option<bool>, ControlError> {
        match self.get(key) {
            None => Ok(None),
            Some(Value::Bool(value)) => Ok(Some(*value)),
            Some(_) => Err(self.wrong(key, "true or false")),
        }
    }

    fn ttl(&self) -> Result<u32, ControlError> {
        Ok(self.small_integer("ttl_s", 0, MAX_TTL_S)?.unwrap_or(DEFAULT_TTL_S))
    }

    fn from(&self) -> Result<OriginSelector, ControlError> {
        match self.get("from") {
            None => Ok(OriginSelector::default()),
            Some(Value::Object(object)) => {
                let pointer = format!("{}/from", self.pointer);
                let fields = Fields { object, pointer: &pointer };
                Ok(OriginSelector {
                    layer: fields.name("layer")?,
                    node: fields.name("node")?,
                    service: fields.name("service")?,
                })
            }
            Some(_) => Err(self.wrong("from", "an object")),
        }
    }

    /// A call; without `id` and `reply_to` nobody would get the reply.
    fn call(&self, common: Common) -> Result<ControlMessage, ControlError> {
        for (key, there) in [("id", common.id.is_some()), ("reply_to", common.reply_to.is_some())] {
            if !there {
                return Err(self.error(ErrorCode::InvalidValue, key, "is missing"));
            }
        }
        let timeout = self.small_integer("timeout_ms", 1, MAX_CALL_TIMEOUT_MS)?;
        let request = match self.get("request") {
            Some(Value::Object(request)) => request.clone(),
            Some(_) => return Err(self.wrong("request", "an object")),
            None => return Err(self.error(ErrorCode::InvalidValue, "request", "is missing")),
        };
        let timeout_ms = timeout.unwrap_or(DEFAULT_CALL_TIMEOUT_MS);
        Ok(ControlMessage::Call(CallMessage { common, timeout_ms, request }))
    }

    fn quality(&self) -> Result<Quality, ControlError> {
        Ok(Quality {
            encoding: self.text("encoding", MAX_ENCODING_BYTES)?.filter(|text| !text.is_empty()),
            type_name: self.text("type", MAX_TYPE_BYTES)?.unwrap_or_default(),
            type_hash: self.text("type_hash", MAX_TYPE_BYTES)?.unwrap_or_default(),
            reliability: self.word("reliability")?.unwrap_or(Reliability::BestEffort),
            durability: self.word("durability")?.unwrap_or(Durability::Volatile),
            depth: self.small_integer("depth", 1, MAX_DEPTH)?.unwrap_or(1),
            priority: self.word("priority")?,
            lifespan_ms: self.small_integer("lifespan_ms", 0, u32::MAX)?.unwrap_or(0),
        })
    }
}

/// A whole number, also where a client writes `15.0`.
fn whole_number(value: &Value) -> Option<u64> {
    /// Above it, neighbouring whole numbers share one f64.
    const EXACT: f64 = 9_007_199_254_740_992.0;
    value.as_u64().or_else(|| {
        let number = value.as_f64()?;
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "checked to be whole and in range"
        )]
        (number.fract() == 0.0 && (0.0..EXACT).contains(&number)).then_some(number as u64)
    })
}

#[cfg(test)]
#[path = "parse_tests.rs"]
mod tests;
