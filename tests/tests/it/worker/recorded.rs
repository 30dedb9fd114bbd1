//! Recordings of `Sync`: one message a line, as JSON with its bytes in Base64.

use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use blaze_proto::v1;
use blaze_proto::v1::sync_request::Msg as Said;
use blaze_proto::v1::sync_response::Msg as Told;
use bytes::Bytes;
use prost::Message as _;
use serde_json::{Value, json};

/// One message of a recording.
#[derive(Debug, Clone)]
pub(crate) struct Recorded {
    /// Number of the stream, from 0.
    pub(crate) stream: usize,
    pub(crate) by_worker: bool,
    pub(crate) bytes: Bytes,
}

impl Recorded {
    pub(crate) fn kind(&self) -> &'static str {
        if self.by_worker {
            return match said(&self.bytes) {
                Said::Hello(_) => "Hello",
                Said::Ack(_) => "Ack",
            };
        }
        match told(&self.bytes) {
            Told::Welcome(_) => "Welcome",
            Told::Snapshot(_) => "Snapshot",
            Told::Commit(_) => "Commit",
            Told::Bookmark(_) => "Bookmark",
            Told::GoAway(_) => "GoAway",
        }
    }
}

pub(crate) fn said(bytes: &Bytes) -> Said {
    v1::SyncRequest::decode(bytes.clone()).unwrap().msg.unwrap()
}

pub(crate) fn told(bytes: &Bytes) -> Told {
    v1::SyncResponse::decode(bytes.clone()).unwrap().msg.unwrap()
}

pub(crate) fn fixture(protocol: u32) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("fixtures/sync/protocol-{protocol}.jsonl"))
}

pub(crate) fn read(path: &Path) -> Vec<Recorded> {
    let text = std::fs::read_to_string(path).unwrap();
    let lines = text.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    lines
        .map(|line| Recorded {
            stream: line["stream"].as_u64().unwrap() as usize,
            by_worker: line["by"] == "worker",
            bytes: STANDARD.decode(line["bytes"].as_str().unwrap()).unwrap().into(),
        })
        .collect()
}

pub(crate) fn write(path: &Path, recorded: &[Recorded]) {
    let lines = recorded.iter().map(|one| {
        let by = if one.by_worker { "worker" } else { "main" };
        let line = json!({
            "stream": one.stream,
            "by": by,
            "kind": one.kind(),
            "bytes": STANDARD.encode(&one.bytes),
        });
        format!("{line}\n")
    });
    std::fs::write(path, lines.collect::<String>()).unwrap();
}

/// The same message with members that nobody knows, beside the message and within it.
pub(crate) fn with_unknown(bytes: &Bytes) -> Bytes {
    const UNKNOWN: &[u8] = &[0xa0, 0x3f, 0x07, 0xaa, 0x3f, 0x03, b'n', b'e', b'w'];
    let (key, mut rest) = (bytes[0], bytes.slice(1..));
    let length = prost::decode_length_delimiter(&mut rest).unwrap();
    assert_eq!(length, rest.len(), "one message is all that there is");
    let mut out = vec![key];
    prost::encode_length_delimiter(length + UNKNOWN.len(), &mut out).unwrap();
    out.extend_from_slice(&rest);
    out.extend_from_slice(UNKNOWN);
    out.extend_from_slice(UNKNOWN);
    out.into()
}

pub(crate) fn count(recorded: &[Recorded], kind: &str) -> usize {
    recorded.iter().filter(|one| one.kind() == kind).count()
}

/// The last revision and digest that a recording tells.
pub(crate) fn last_digest(recorded: &[Recorded]) -> (u64, String) {
    let digests =
        recorded.iter().filter(|one| !one.by_worker).filter_map(|one| match told(&one.bytes) {
            Told::Bookmark(bookmark) if !bookmark.digest.is_empty() => {
                Some((bookmark.revision, bookmark.digest))
            }
            _ => None,
        });
    digests.last().unwrap()
}
