//! What a service says about the configuration that it got.

use blaze_domain::config::AckStatus;
use blaze_domain::{InstanceName, NodeName, ServiceName};

use super::fields::{check_depth, need, object, parsed, text, whole};

const MAX_DETAIL_BYTES: usize = 4 * 1024;
const MAX_HASH_BYTES: usize = 128;

/// An acknowledgement of a configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConfigAck {
    /// Whose configuration.
    pub service: ServiceName,
    /// Which instance of it.
    pub instance: Option<InstanceName>,
    /// Where it runs.
    pub node: Option<NodeName>,
    /// Revision of the configuration.
    pub revision: Option<u64>,
    /// Hash of the configuration.
    pub hash: Option<String>,
    /// How it gets on.
    pub status: AckStatus,
    /// For people.
    pub detail: String,
}

impl ConfigAck {
    /// Reads an acknowledgement.
    ///
    /// # Errors
    /// What is wrong, in words that name the member.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        let members = object(bytes).map_err(|detail| format!("the message: {detail}"))?;
        check_depth(&members)?;
        let word = need(text(&members, "status", MAX_HASH_BYTES)?, "status")?;
        let status = word
            .parse::<AckStatus>()
            .map_err(|_| "status: must be applied, rejected, unhealthy or healthy")?;
        let detail = text(&members, "detail", MAX_DETAIL_BYTES)?.unwrap_or_default();
        Ok(Self {
            service: need(parsed(&members, "service")?, "service")?,
            instance: parsed(&members, "instance")?,
            node: parsed(&members, "node")?,
            revision: whole(&members, "revision")?,
            hash: text(&members, "hash", MAX_HASH_BYTES)?.map(str::to_owned),
            status,
            detail: detail.to_owned(),
        })
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn every_status_is_read() {
        for status in AckStatus::ALL.iter().copied() {
            let message = json!({"service": "slam", "instance": "0", "node": "robot-1", "revision": 431,
                "hash": "sha256:ab", "status": status.as_str(), "detail": "", "later": true});
            let expected = ConfigAck {
                service: "slam".parse().unwrap(),
                instance: Some("0".parse().unwrap()),
                node: Some("robot-1".parse().unwrap()),
                revision: Some(431),
                hash: Some("sha256:ab".to_owned()),
                status,
                detail: String::new(),
            };
            assert_eq!(ConfigAck::parse(message.to_string().as_bytes()), Ok(expected));
        }
    }

    #[test]
    fn a_wrong_member_is_named() {
        for (message, member) in [
            (json!({"status": "applied"}), "service: "),
            (json!({"service": "slam"}), "status: "),
            (json!({"service": "slam", "status": "fine"}), "status: "),
            (json!({"service": "slam", "status": "applied", "revision": -1}), "revision: "),
            (json!({"service": "slam", "status": "applied", "revision": 1.5}), "revision: "),
            (json!({"service": "slam", "status": "applied", "node": "A"}), "node: "),
            (json!([]), "the message: "),
        ] {
            let error = ConfigAck::parse(message.to_string().as_bytes()).unwrap_err();
            assert!(error.starts_with(member), "{error}");
        }
    }
}
