//! The sign of life of an instance, as it stands in Redis or goes as a message.

use std::time::Duration;

use blaze_brokers::redis::Record;
use blaze_domain::NodeName;
use blaze_domain::config::ServiceState;
use serde_json::Value;

use crate::config::Held;
use crate::service::Identity;

/// Longest message that is read, in bytes.
const MAX_MESSAGE_BYTES: usize = 64 * 1024;
/// How long a message counts that does not say so itself, in ms.
const DEFAULT_TTL_MS: u64 = 15_000;
/// Longest that one may count, in ms (an hour).
const MAX_TTL_MS: u64 = 3_600_000;

/// Key of the records of a service, up to its node.
pub(super) fn beginning(service: &str) -> String {
    format!("blaze:watchdog:{service}:")
}

/// Key of the record of an instance; `None` where it has no node to be named by.
pub(super) fn key(identity: &Identity) -> Option<String> {
    let node = identity.node.as_ref()?;
    Some(format!("{}{node}:{}", beginning(identity.service.as_str()), identity.instance))
}

/// What is said of an instance.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Sign<'a> {
    pub(super) identity: &'a Identity,
    pub(super) state: ServiceState,
    /// Number of this life.
    pub(super) epoch: u64,
    /// Since when it is so, in ms since 1970.
    pub(super) since_ms: u64,
    pub(super) version: &'a str,
    /// Where its metrics are served, `host:port`; empty where they are not.
    pub(super) metrics: &'a str,
    /// Revision and hash of the configuration that it has.
    pub(super) config: Option<(u64, String)>,
}

impl Sign<'_> {
    fn members(&self) -> [(&'static str, Value); 11] {
        let identity = self.identity;
        let (revision, hash) = self.config.clone().unwrap_or_default();
        [
            ("layer", identity.layer.as_str().into()),
            ("node", identity.node.as_ref().map_or("", NodeName::as_str).into()),
            ("service", identity.service.as_str().into()),
            ("instance", identity.instance.as_str().into()),
            ("state", self.state.as_str().into()),
            ("version", self.version.into()),
            ("metrics", self.metrics.into()),
            ("epoch", self.epoch.into()),
            ("since_ms", self.since_ms.into()),
            ("config_revision", revision.into()),
            ("config_hash", hash.into()),
        ]
    }

    /// As it stands in Redis, where all are texts.
    pub(super) fn record(&self) -> Record {
        let text = |value: Value| match value {
            Value::String(text) => text,
            other => other.to_string(),
        };
        let members = self.members().into_iter();
        members.map(|(name, value)| (name.to_owned(), text(value))).collect()
    }

    /// As it goes as a message that counts for so long.
    pub(super) fn message(&self, ttl: Duration) -> String {
        let ttl_ms = u64::try_from(ttl.as_millis()).unwrap_or(MAX_TTL_MS).max(1);
        let members = self.members().into_iter().chain([("ttl_ms", ttl_ms.into())]);
        members.collect::<Value>().to_string()
    }
}

/// What a service has of its configuration, for its sign of life.
pub(super) fn of_config(held: Option<&Held>) -> Option<(u64, String)> {
    held.map(|held| (held.revision, held.hash.clone()))
}

/// The number of the life that a record is of; 0 for one that has none.
pub(super) fn epoch_of(record: &Record) -> u64 {
    record.get("epoch").and_then(|epoch| epoch.parse().ok()).unwrap_or(0)
}

/// What was heard of an instance.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Heard {
    pub(super) service: String,
    pub(super) node: String,
    pub(super) instance: String,
    pub(super) epoch: u64,
    pub(super) is_ready: bool,
    pub(super) ttl: Duration,
}

impl Heard {
    /// Reads a message; `None` if it is no sign of life.
    pub(super) fn parse(payload: &[u8]) -> Option<Self> {
        if payload.len() > MAX_MESSAGE_BYTES {
            return None;
        }
        let value: Value = serde_json::from_slice(payload).ok()?;
        let text = |name: &str| value.get(name).and_then(Value::as_str);
        let ttl_ms = value.get("ttl_ms").and_then(Value::as_u64).unwrap_or(DEFAULT_TTL_MS);
        Some(Self {
            service: text("service")?.to_owned(),
            node: text("node")?.to_owned(),
            instance: text("instance")?.to_owned(),
            epoch: value.get("epoch").and_then(Value::as_u64).unwrap_or(0),
            is_ready: text("state")? == ServiceState::Ready.as_str(),
            ttl: Duration::from_millis(ttl_ms.clamp(1, MAX_TTL_MS)),
        })
    }

    /// Whether it is of the same (service, node, instance).
    pub(super) fn is_of(&self, identity: &Identity) -> bool {
        self.service == identity.service.as_str()
            && self.instance == identity.instance.as_str()
            && identity.node.as_ref().is_some_and(|node| self.node == node.as_str())
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::service::slam;

    #[test]
    fn record_and_message_have_the_members_of_the_contract() {
        let identity = slam();
        let sign = Sign {
            identity: &identity,
            epoch: 17,
            state: ServiceState::Ready,
            since_ms: 5,
            version: "1.2.3",
            metrics: "127.0.0.1:9200",
            config: Some((431, "sha256:a".to_owned())),
        };
        let members = [
            "config_hash",
            "config_revision",
            "epoch",
            "instance",
            "layer",
            "metrics",
            "node",
            "service",
            "since_ms",
            "state",
            "version",
        ];
        let record = sign.record();
        assert_eq!(record.keys().collect::<Vec<_>>(), members);
        assert_eq!(
            (record["state"].as_str(), record["config_revision"].as_str()),
            ("ready", "431")
        );
        assert_eq!(epoch_of(&record), 17);
        let message: Value = serde_json::from_str(&sign.message(Duration::from_secs(15))).unwrap();
        assert_eq!(
            message,
            json!({"layer": "edge", "node": "robot-1", "service": "slam", "instance": "0",
                "epoch": 17, "state": "ready",
                "since_ms": 5, "version": "1.2.3", "metrics": "127.0.0.1:9200", "config_revision": 431,
                "config_hash": "sha256:a", "ttl_ms": 15000})
        );
        assert_eq!(key(&identity).unwrap(), "blaze:watchdog:slam:robot-1:0");
        let heard = Heard::parse(message.to_string().as_bytes()).unwrap();
        assert!(heard.is_ready && heard.is_of(&identity) && heard.epoch == 17);
    }

    #[test]
    fn what_is_no_sign_of_life_is_left_alone() {
        for bytes in [&b""[..], b"{}", b"[]", b"7", b"{\"service\":\"slam\"}", b"\xff"] {
            assert_eq!(Heard::parse(bytes), None);
        }
        let for_ever = json!({
            "service": "a",
            "node": "b",
            "instance": "0",
            "state": "ready",
            "ttl_ms": u64::MAX,
        });
        let heard = Heard::parse(for_ever.to_string().as_bytes()).unwrap();
        assert_eq!(heard.ttl, Duration::from_millis(MAX_TTL_MS));
    }
}
