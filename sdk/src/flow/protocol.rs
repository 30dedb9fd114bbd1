//! The control protocol as JSON: what the SDK sends, and what it understands of answers and events.

use std::fmt;
use std::str::FromStr;

use blaze_domain::{Durability, LayerName, NodeName, Priority, Reliability, ServiceName, TopicName};
use serde::{Deserialize, Serialize};

/// Largest control payload, in bytes.
pub(super) const MAX_CONTROL_BYTES: usize = 64 * 1024;
/// Most objects in one control payload.
pub(super) const MAX_CONTROL_OBJECTS: usize = 200;

/// What a lease is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum LeaseKind {
    Advertise,
    Request,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Op {
    Advertise,
    Request,
    Withdraw,
}

/// Which origins a request is for; absent parts = any.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct OriginFilter {
    /// Only of this layer.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub layer: Option<LayerName>,
    /// Only of this node.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub node: Option<NodeName>,
    /// Only of this service.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub service: Option<ServiceName>,
}

/// What an advertise or request says beside who and what.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub(super) struct Terms {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) ttl_s: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) rate_hz: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) max_bytes: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) max_rate_hz: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) encoding: Option<String>,
    #[serde(rename = "type", skip_serializing_if = "Option::is_none")]
    pub(super) type_name: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) type_hash: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) reliability: Option<Reliability>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) durability: Option<Durability>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) depth: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) priority: Option<Priority>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) lifespan_ms: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) bare: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) from: Option<OriginFilter>,
}

/// One control message.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct ControlObject<'a> {
    pub(super) op: Op,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) kind: Option<LeaseKind>,
    pub(super) topic: &'a TopicName,
    pub(super) service: &'a str,
    pub(super) instance: &'a str,
    pub(super) layer: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) node: Option<&'a str>,
    pub(super) epoch: u64,
    pub(super) id: &'a str,
    pub(super) reply_to: &'a str,
    #[serde(flatten)]
    pub(super) terms: Option<&'a Terms>,
}

/// What a flow answers.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub(super) struct Answer {
    pub(super) id: Option<String>,
    pub(super) ok: bool,
    pub(super) flow: Option<String>,
    pub(super) lease_s: Option<u64>,
    pub(super) error: Option<AnswerError>,
}

#[derive(Debug, Clone, PartialEq, Eq, Default, Deserialize)]
#[serde(default)]
pub(super) struct AnswerError {
    pub(super) code: String,
    pub(super) pointer: String,
    pub(super) detail: String,
}

/// A payload is one object or an array of them. What is not understood is left out.
pub(super) fn each<T: for<'de> Deserialize<'de>>(payload: &[u8]) -> Vec<T> {
    let values = match serde_json::from_slice(payload) {
        Ok(serde_json::Value::Array(values)) => values,
        Ok(value) => vec![value],
        Err(_) => return Vec::new(),
    };
    let parsed = values.into_iter().map(T::deserialize);
    parsed.filter_map(Result::ok).collect()
}

/// Joins encoded objects to payloads within the bounds of the protocol.
pub(super) fn payloads(objects: &[String]) -> Vec<String> {
    let mut payloads = Vec::new();
    let mut from = 0;
    while from < objects.len() {
        let mut bytes = 2;
        let count = objects[from..]
            .iter()
            .take(MAX_CONTROL_OBJECTS)
            .take_while(|object| {
                bytes += object.len() + 1;
                bytes <= MAX_CONTROL_BYTES
            })
            .count()
            .max(1);
        let chosen = &objects[from..from + count];
        payloads.push(match chosen {
            [one] => one.clone(),
            several => format!("[{}]", several.join(",")),
        });
        from += count;
    }
    payloads
}

/// Error pointers of an array begin with the place of the object in it, which the caller does not know.
pub(super) fn pointer_in_object(pointer: &str) -> &str {
    let Some(rest) = pointer.strip_prefix('/') else {
        return pointer;
    };
    let (first, after) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
    let is_place = !first.is_empty() && first.bytes().all(|byte| byte.is_ascii_digit());
    if is_place { after } else { pointer }
}

macro_rules! words {
    ($(#[$doc:meta])* $type:ident { $($(#[$variant_doc:meta])* $variant:ident = $text:literal),+ $(,)? }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Eq, Hash)]
        #[non_exhaustive]
        pub enum $type {
            $($(#[$variant_doc])* $variant,)+
            /// A word that this version does not know.
            Other(String),
        }

        impl fmt::Display for $type {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(match self {
                    $(Self::$variant => $text,)+
                    Self::Other(text) => text,
                })
            }
        }

        impl FromStr for $type {
            type Err = std::convert::Infallible;
            fn from_str(text: &str) -> Result<Self, Self::Err> {
                Ok(match text {
                    $($text => Self::$variant,)+
                    other => Self::Other(other.to_owned()),
                })
            }
        }

        impl From<&str> for $type {
            fn from(text: &str) -> Self {
                let Ok(word) = text.parse();
                word
            }
        }
    };
}

words!(
    /// Why a flow refused an advertise, request or withdraw.
    RefusalCode {
        /// The control message was not JSON.
        InvalidJson = "invalid_json",
        /// The flow does not know the operation.
        UnknownOp = "unknown_op",
        /// Not the name of a topic.
        InvalidTopic = "invalid_topic",
        /// The topic is one of BlazeAIoT's own.
        ReservedTopic = "reserved_topic",
        /// A field has a value that it may not have.
        InvalidValue = "invalid_value",
        /// The layer or node named is not the one where the flow received it.
        SourceMismatch = "source_mismatch",
        /// A newer process of the same identity holds the lease.
        StaleEpoch = "stale_epoch",
        /// The flow holds as many leases as it can.
        TooManyLeases = "too_many_leases",
        /// The broker cannot express the topic's name.
        NameNotExpressible = "name_not_expressible",
        /// Another topic has the same name on the broker.
        NameCollision = "name_collision",
        /// Not allowed.
        AccessDenied = "access_denied",
    }
);

words!(
    /// What a flow told to all.
    FlowEventKind {
        /// It started; leases are sent again by themselves.
        FlowStarted = "flow_started",
        /// It refused a lease.
        LeaseRefused = "lease_refused",
        /// A lease ran out.
        LeaseExpired = "lease_expired",
        /// A topic flows to a destination.
        RouteUp = "route_up",
        /// A topic does not flow to a destination any more.
        RouteDown = "route_down",
    }
);

/// Something that a flow told to all services.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FlowEvent {
    /// What happened.
    pub kind: FlowEventKind,
    /// The flow, `layer/node`.
    pub flow: String,
    /// The topic, where it is about one.
    pub topic: String,
    /// Why, where there is a reason.
    pub code: String,
    /// When, as the flow wrote it.
    pub time: String,
}

#[derive(Deserialize)]
struct EventObject {
    event: String,
    #[serde(default)]
    flow: Option<String>,
    #[serde(default)]
    topic: Option<String>,
    #[serde(default)]
    code: Option<String>,
    #[serde(default)]
    time: serde_json::Value,
}

/// The events of a payload.
pub(super) fn events(payload: &[u8]) -> Vec<FlowEvent> {
    let objects: Vec<EventObject> = each(payload);
    let event = |object: EventObject| FlowEvent {
        kind: FlowEventKind::from(object.event.as_str()),
        flow: object.flow.unwrap_or_default(),
        topic: object.topic.unwrap_or_default(),
        code: object.code.unwrap_or_default(),
        time: match object.time {
            serde_json::Value::String(text) => text,
            serde_json::Value::Null => String::new(),
            other => other.to_string(),
        },
    };
    objects.into_iter().map(event).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_object_has_the_fields_of_the_contract_and_no_empty_ones() {
        let topic: TopicName = "imu/data".parse().unwrap();
        let terms = Terms {
            ttl_s: Some(15),
            rate_hz: Some(50.0),
            type_name: Some("sensor_msgs/msg/Imu".to_owned()),
            reliability: Some(Reliability::BestEffort),
            priority: Some(Priority::State),
            ..Terms::default()
        };
        let object = ControlObject {
            op: Op::Advertise,
            kind: None,
            topic: &topic,
            service: "imu-driver",
            instance: "0",
            layer: "edge",
            node: Some("robot-1"),
            epoch: 7,
            id: "x-1",
            reply_to: "blaze/reply/x",
            terms: Some(&terms),
        };
        assert_eq!(
            serde_json::to_string(&object).unwrap(),
            concat!(
                r#"{"op":"advertise","topic":"imu/data","service":"imu-driver","instance":"0","layer":"edge","#,
                r#""node":"robot-1","epoch":7,"id":"x-1","reply_to":"blaze/reply/x","ttl_s":15,"rate_hz":50.0,"#,
                r#""type":"sensor_msgs/msg/Imu","reliability":"best_effort","priority":"state"}"#
            )
        );
        let withdraw = ControlObject {
            op: Op::Withdraw,
            kind: Some(LeaseKind::Request),
            node: None,
            terms: None,
            ..object
        };
        let json = serde_json::to_value(&withdraw).unwrap();
        assert_eq!(json["kind"], "request");
        assert!(json.get("node").is_none() && json.get("ttl_s").is_none(), "{json}");
    }

    #[test]
    fn payloads_keep_the_bounds() {
        let objects: Vec<String> = (0..450).map(|number| format!("{{\"n\":{number}}}")).collect();
        let sizes: Vec<usize> = payloads(&objects)
            .iter()
            .map(|payload| each::<serde_json::Value>(payload.as_bytes()).len())
            .collect();
        assert_eq!(sizes, [200, 200, 50]);
        let large = vec![format!("{{\"t\":\"{}\"}}", "x".repeat(1_000)); 100];
        let split = payloads(&large);
        assert!(split.len() > 1 && split.iter().all(|payload| payload.len() <= MAX_CONTROL_BYTES));
        assert_eq!(payloads(&objects[..1]), ["{\"n\":0}"]);
    }

    #[test]
    fn answers_and_events_are_read_leniently() {
        let answers: Vec<Answer> = each(br#"[{"id":"7","ok":true,"flow":"edge/r","lease_s":15,"new":1}, 3, {"x":1}]"#);
        assert_eq!(answers.len(), 1);
        assert_eq!(answers[0].lease_s, Some(15));
        assert!(each::<Answer>(b"no json").is_empty());
        let events = events(br#"{"event":"flow_started","flow":"edge/r","topic":null,"time":12}"#);
        assert_eq!(events[0].kind, FlowEventKind::FlowStarted);
        assert_eq!((events[0].topic.as_str(), events[0].time.as_str()), ("", "12"));
        assert_eq!(RefusalCode::from("new_code"), RefusalCode::Other("new_code".to_owned()));
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
            assert_eq!(pointer_in_object(pointer), expected, "{pointer}");
        }
    }
}
