//! How instances are: what they keep in Redis, or send where there is none.

pub use blaze_domain::config::ServiceState as Health;
use blaze_domain::{InstanceName, LayerName, NodeName, ServiceName};
use serde_json::{Map, Value};

use super::fields::{check_depth, need, object, parsed, text, whole};

/// How long a sign of life counts if it does not say so itself, in ms.
pub const DEFAULT_TTL_MS: u64 = 15_000;
/// Longest that one may count, in ms (an hour).
const MAX_TTL_MS: u64 = 3_600_000;
const MAX_WORD_BYTES: usize = 32;
const MAX_HASH_BYTES: usize = 128;

/// Who says that it is alive: the parts of a Redis key.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct WatchdogKey {
    /// Which service.
    pub service: ServiceName,
    /// Where it runs.
    pub node: NodeName,
    /// Which instance of it.
    pub instance: InstanceName,
}

impl WatchdogKey {
    /// Reads a key of Redis, without its prefix; `None` if it is no watchdog's.
    #[must_use]
    pub fn parse(key: &str) -> Option<Self> {
        let mut parts = key.strip_prefix("blaze:watchdog:")?.split(':');
        let out = Self {
            service: parts.next()?.parse().ok()?,
            node: parts.next()?.parse().ok()?,
            instance: parts.next()?.parse().ok()?,
        };
        parts.next().is_none().then_some(out)
    }
}

/// How one instance is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServiceState {
    /// Which one.
    pub key: WatchdogKey,
    /// Its layer.
    pub layer: Option<LayerName>,
    /// Number of its life; of two processes with the same key the one with the higher number
    /// counts.
    pub epoch: u64,
    /// How it is.
    pub health: Health,
    /// Revision of the configuration that it runs with; 0: none.
    pub config_revision: u64,
    /// Hash of the configuration that it runs with; empty: none.
    pub config_hash: String,
    /// How long this counts, in ms; of a message only, in Redis the key itself expires.
    pub ttl_ms: u64,
}

impl ServiceState {
    /// Reads a message of `blaze/watchdog`.
    ///
    /// # Errors
    /// What is wrong, in words that name the member.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        let members = object(bytes).map_err(|detail| format!("the message: {detail}"))?;
        check_depth(&members)?;
        Self::of_members(&members)
    }

    /// Reads the fields of a hash in Redis.
    ///
    /// # Errors
    /// What is wrong, in words that name the field.
    pub fn of_fields<'f>(
        fields: impl IntoIterator<Item = (&'f str, &'f str)>,
    ) -> Result<Self, String> {
        let members = fields.into_iter().map(|(name, value)| (name.to_owned(), value.into()));
        Self::of_members(&members.collect())
    }

    fn of_members(members: &Map<String, Value>) -> Result<Self, String> {
        let word = need(text(members, "state", MAX_WORD_BYTES)?, "state")?;
        let health =
            word.parse().map_err(|_| "state: must be starting, ready, unhealthy or stopping")?;
        let number = |name: &str| -> Result<u64, String> { Ok(whole(members, name)?.unwrap_or(0)) };
        // Redis has no null: an empty text is none.
        let layer = match members.get("layer").and_then(Value::as_str) {
            Some("") => None,
            Some(_) | None => parsed(members, "layer")?,
        };
        Ok(Self {
            key: WatchdogKey {
                service: need(parsed(members, "service")?, "service")?,
                node: need(parsed(members, "node")?, "node")?,
                instance: need(parsed(members, "instance")?, "instance")?,
            },
            layer,
            epoch: number("epoch")?,
            health,
            config_revision: number("config_revision")?,
            config_hash: text(members, "config_hash", MAX_HASH_BYTES)?
                .unwrap_or_default()
                .to_owned(),
            ttl_ms: whole(members, "ttl_ms")?.unwrap_or(DEFAULT_TTL_MS).clamp(1, MAX_TTL_MS),
        })
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    const FIELDS: [(&str, &str); 10] = [
        ("layer", "edge"),
        ("node", "robot-1"),
        ("service", "slam"),
        ("instance", "0"),
        ("epoch", "17"),
        ("state", "ready"),
        ("since_ms", "1795244472345"),
        ("version", "1.2.3"),
        ("config_revision", "431"),
        ("config_hash", "sha256:ab"),
    ];

    #[test]
    fn a_hash_and_a_message_say_the_same() {
        let of_hash = ServiceState::of_fields(FIELDS).unwrap();
        let message = json!({"layer": "edge", "node": "robot-1", "service": "slam", "instance": "0",
            "epoch": 17,
            "state": "ready", "since_ms": 1_795_244_472_345_u64, "version": "1.2.3",
            "config_revision": 431,
            "config_hash": "sha256:ab", "ttl_ms": 15000});
        assert_eq!(ServiceState::parse(message.to_string().as_bytes()), Ok(of_hash.clone()));
        assert_eq!(
            (of_hash.epoch, of_hash.health, of_hash.config_revision),
            (17, Health::Ready, 431)
        );
        assert_eq!(WatchdogKey::parse("blaze:watchdog:slam:robot-1:0"), Some(of_hash.key));
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (field, value) in [
            ("state", "fine"),
            ("node", "Robot"),
            ("service", ""),
            ("epoch", "-1"),
            ("config_revision", "many"),
        ] {
            let fields = FIELDS.map(|(name, old)| (name, if name == field { value } else { old }));
            let error = ServiceState::of_fields(fields).unwrap_err();
            assert!(error.starts_with(&format!("{field}: ")), "{error}");
        }
        for missing in ["node", "service", "instance", "state"] {
            let fields = FIELDS.into_iter().filter(|(name, _)| *name != missing);
            let error = ServiceState::of_fields(fields).unwrap_err();
            assert_eq!(error, format!("{missing}: is missing"));
        }
        assert!(ServiceState::parse(b"[]").is_err());
    }

    #[test]
    fn only_keys_of_watchdogs_are_read() {
        for key in [
            "blaze:watchdog:slam:robot-1",
            "blaze:watchdog:slam:robot-1:0:1",
            "blaze:watchdog:slam:Robot:0",
            "blaze:config:slam:0",
            "",
        ] {
            assert_eq!(WatchdogKey::parse(key), None, "{key}");
        }
    }
}
