//! What is spoken with a worker: requests, answers, notices, acknowledgements.

use std::sync::Arc;

use blaze_domain::config::{AckStatus, MAX_EFFECTIVE_BYTES};
use serde::Deserialize;
use serde_json::{Value, json};

use super::change::{ConfigScope, ConfigSource, Held};
use crate::service::Identity;

/// Longest message that is read, in bytes: a configuration and what stands around it.
const MAX_MESSAGE_BYTES: usize = MAX_EFFECTIVE_BYTES + 256 * 1024;
/// Longest detail of an acknowledgement that a worker reads, in bytes.
const MAX_DETAIL_BYTES: usize = 4 * 1024;

/// Why a worker gave no configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Refusal {
    pub(super) code: String,
    pub(super) detail: String,
}

/// What a worker answers.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Answer {
    Given { held: Held, node: Option<String> },
    Unchanged { revision: u64, hash: String, source: ConfigSource, store: Option<String> },
    Refused(Refusal),
}

/// What a worker tells of a change.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Notice {
    pub(super) service: String,
    pub(super) instance: Option<String>,
    pub(super) node: Option<String>,
    pub(super) revision: u64,
    /// `None`: the service was deleted.
    pub(super) held: Option<Held>,
    pub(super) store: Option<String>,
    pub(super) source: ConfigSource,
    pub(super) paths: Vec<String>,
    pub(super) scopes: Vec<ConfigScope>,
}

/// All members of answers and notices; which of them are there says what it is. Further ones are
/// ignored.
#[derive(Deserialize)]
struct Members {
    id: Option<String>,
    service: Option<String>,
    instance: Option<String>,
    node: Option<String>,
    revision: Option<u64>,
    hash: Option<String>,
    config: Option<Value>,
    source: Option<String>,
    store_id: Option<String>,
    #[serde(default)]
    unchanged: bool,
    #[serde(default)]
    deleted: bool,
    #[serde(default)]
    paths: Vec<String>,
    #[serde(default)]
    scopes: Vec<String>,
    error: Option<ErrorMembers>,
}

#[derive(Deserialize)]
struct ErrorMembers {
    code: String,
    #[serde(default)]
    detail: String,
}

impl Members {
    fn read(payload: &[u8]) -> Option<Self> {
        (payload.len() <= MAX_MESSAGE_BYTES).then(|| serde_json::from_slice(payload).ok()).flatten()
    }

    /// The source; one of a later version counts as the best, which changes nothing but what is
    /// shown.
    fn source(&self) -> ConfigSource {
        let word = self.source.as_deref().unwrap_or_default();
        word.parse().unwrap_or(ConfigSource::Main)
    }

    fn held(&mut self) -> Option<Held> {
        Some(Held {
            revision: self.revision?,
            source: self.source(),
            config: Arc::new(self.config.take().filter(Value::is_object)?),
            hash: self.hash.take()?,
            store: self.store_id.clone(),
        })
    }
}

/// Reads an answer and its id; `None` if it is none, or not for one of ours.
pub(super) fn answer(payload: &[u8], id_prefix: &str) -> Option<Answer> {
    let mut members = Members::read(payload)?;
    if !members.id.as_ref()?.starts_with(id_prefix) {
        return None;
    }
    if let Some(error) = members.error {
        return Some(Answer::Refused(Refusal { code: error.code, detail: error.detail }));
    }
    if members.unchanged {
        return Some(Answer::Unchanged {
            revision: members.revision?,
            source: members.source(),
            hash: members.hash?,
            store: members.store_id,
        });
    }
    let held = members.held()?;
    Some(Answer::Given { held, node: members.node })
}

/// Reads a notice; `None` if it is none.
pub(super) fn notice(payload: &[u8]) -> Option<Notice> {
    let mut members = Members::read(payload)?;
    let source = members.source();
    let held = match members.deleted {
        true => None,
        false => Some(members.held()?),
    };
    Some(Notice {
        service: members.service?,
        instance: members.instance,
        node: members.node,
        revision: members.revision?,
        held,
        store: members.store_id,
        source,
        paths: members.paths,
        scopes: members.scopes.iter().filter_map(|word| word.parse().ok()).collect(),
    })
}

/// A request; `hash` is that of what the service has.
pub(super) fn request(identity: &Identity, id: &str, reply_to: &str, hash: Option<&str>) -> String {
    let members = [("id", json!(id)), ("reply_to", json!(reply_to)), ("hash", json!(hash))];
    spoken(identity, members)
}

/// An acknowledgement of a revision and its hash. A detail that is too long is cut, and control
/// characters become spaces: a worker reads neither.
pub(super) fn ack(
    identity: &Identity,
    of: Option<(u64, &str)>,
    status: AckStatus,
    detail: &str,
) -> String {
    let mut end = detail.len().min(MAX_DETAIL_BYTES);
    while !detail.is_char_boundary(end) {
        end -= 1;
    }
    let plain = |letter: char| if letter.is_control() { ' ' } else { letter };
    // A control character may be longer than the space that replaces it, never shorter.
    let detail: String = detail[..end].chars().map(plain).collect();
    let (revision, hash) = of.unzip();
    let members = [
        ("revision", json!(revision)),
        ("hash", json!(hash)),
        ("status", json!(status)),
        ("detail", json!(detail)),
    ];
    spoken(identity, members)
}

/// A message of the service; members that are null are left out.
fn spoken(identity: &Identity, members: impl IntoIterator<Item = (&'static str, Value)>) -> String {
    let who = [
        ("service", json!(identity.service)),
        ("instance", json!(identity.instance)),
        ("node", json!(identity.node)),
    ];
    let all = who.into_iter().chain(members);
    all.filter(|(_, value)| !value.is_null()).collect::<Value>().to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::slam;

    fn read(value: &Value) -> Option<Answer> {
        answer(value.to_string().as_bytes(), "7f-")
    }

    #[test]
    fn the_answers_of_the_contract_are_read() {
        let given = json!({"id": "7f-1", "service": "slam", "instance": "0", "layer": "edge",
            "node": "robot-1", "revision": 431,
            "hash": "sha256:a", "config": {"a": 1}, "source": "copy",
            "as_of": "2026-11-21T07:01:12.345Z", "age_s": 3.1,
            "rollout": null, "store_id": "0197"});
        let held = Held {
            revision: 431,
            hash: "sha256:a".to_owned(),
            config: Arc::new(json!({"a": 1})),
            source: ConfigSource::Copy,
            store: Some("0197".to_owned()),
        };
        let node = Some("robot-1".to_owned());
        assert_eq!(read(&given), Some(Answer::Given { held, node }));
        let unchanged = json!({
            "id": "7f-2",
            "unchanged": true,
            "revision": 431,
            "hash": "sha256:a",
            "source": "main",
        });
        let (hash, source) = ("sha256:a".to_owned(), ConfigSource::Main);
        let (revision, store) = (431, None);
        assert_eq!(read(&unchanged), Some(Answer::Unchanged { revision, hash, source, store }));
        let refused =
            json!({"id": "7f-3", "error": {"code": "not_found", "detail": "no service slamm"}});
        let (code, detail) = ("not_found".to_owned(), "no service slamm".to_owned());
        assert_eq!(read(&refused), Some(Answer::Refused(Refusal { code, detail })));
    }

    #[test]
    fn answers_to_others_and_what_is_no_answer_are_left_alone() {
        for other in [
            json!({
                "id": "8e-1",
                "unchanged": true,
                "revision": 1,
                "hash": "sha256:a",
                "source": "main",
            }),
            json!({"unchanged": true, "revision": 1, "hash": "sha256:a", "source": "main"}),
            json!({"id": "7f-1", "revision": 1, "hash": "sha256:a", "source": "main", "config": 7}),
            json!({
                "id": "7f-1",
                "revision": -1,
                "hash": "sha256:a",
                "source": "main",
                "config": {},
            }),
            json!({"id": 7}),
            json!([]),
        ] {
            assert_eq!(read(&other), None, "{other}");
        }
        for bytes in [&b""[..], b"{", b"\xff\xfe", b"BLZ1", "[".repeat(100_000).as_bytes()] {
            assert_eq!(answer(bytes, "7f-"), None);
            assert_eq!(notice(bytes), None);
        }
    }

    #[test]
    fn a_detail_is_made_such_that_a_worker_reads_it() {
        let long = format!("a\nb{}", "ä".repeat(MAX_DETAIL_BYTES));
        let text = ack(&slam(), None, AckStatus::Rejected, &long);
        let value: Value = serde_json::from_str(&text).unwrap();
        let detail = value["detail"].as_str().unwrap();
        assert!(detail.starts_with("a bä") && detail.len() <= MAX_DETAIL_BYTES);
        assert_eq!((&value["status"], value.get("revision")), (&json!("rejected"), None));
    }
}
