//! Page tokens: opaque, signed, and good for the query that they came from alone.

use aws_lc_rs::hmac;
use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use blaze_domain::config::{Code, Problem};
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};

/// Bytes of the signature that are kept.
const TAG_BYTES: usize = 16;
/// Longest token that is looked at.
const MAX_TOKEN: usize = 1024;

/// Where a list goes on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Position {
    /// The revision that all pages show.
    pub(crate) revision: u64,
    /// The last entry of the page before.
    pub(crate) after: String,
}

/// Signs and checks page tokens. Processes on one store take each other's.
pub(crate) struct Pages {
    key: hmac::Key,
}

impl Pages {
    pub(crate) fn new(store_id: &str) -> Self {
        let secret = Sha256::digest(format!("page tokens of {store_id}").as_bytes());
        Self { key: hmac::Key::new(hmac::HMAC_SHA256, &secret) }
    }

    /// The token for what comes after a position; `query` is everything that the next request must
    /// repeat.
    pub(crate) fn token(&self, query: &str, position: &Position) -> String {
        let body = json!([position.revision, position.after]).to_string();
        let tag = self.tag(query, &body);
        let mut bytes = tag.to_vec();
        bytes.extend_from_slice(body.as_bytes());
        URL_SAFE_NO_PAD.encode(bytes)
    }

    /// The position of a token.
    pub(crate) fn position(&self, query: &str, token: &str) -> Result<Position, Problem> {
        let refuse = || {
            Problem::new(
                Code::InvalidPageToken,
                "the page token is not one of this query: list again from the start",
            )
        };
        if token.len() > MAX_TOKEN {
            return Err(refuse());
        }
        let bytes = URL_SAFE_NO_PAD.decode(token).map_err(|_| refuse())?;
        let (tag, body) = bytes.split_at_checked(TAG_BYTES).ok_or_else(refuse)?;
        let body = std::str::from_utf8(body).map_err(|_| refuse())?;
        if aws_lc_rs::constant_time::verify_slices_are_equal(&self.tag(query, body), tag).is_err() {
            return Err(refuse());
        }
        let value: Value = serde_json::from_str(body).map_err(|_| refuse())?;
        match (value.get(0).and_then(Value::as_u64), value.get(1).and_then(Value::as_str)) {
            (Some(revision), Some(after)) => Ok(Position { revision, after: after.to_owned() }),
            _ => Err(refuse()),
        }
    }

    fn tag(&self, query: &str, body: &str) -> [u8; TAG_BYTES] {
        let text = format!("{}\n{query}\n{body}", query.len());
        let full = hmac::sign(&self.key, text.as_bytes());
        let mut out = [0; TAG_BYTES];
        out.copy_from_slice(&full.as_ref()[..TAG_BYTES]);
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_is_good_for_its_query_alone() {
        let pages = Pages::new("a");
        let position = Position { revision: 7, after: "Node/robot-1".to_owned() };
        let token = pages.token("nodes", &position);
        assert_eq!(pages.position("nodes", &token).unwrap(), position);
        assert!(pages.position("layers", &token).is_err());
        assert!(Pages::new("b").position("nodes", &token).is_err());
        for bad in ["", "x", "AAAA", &token[1..], &"A".repeat(5000)] {
            assert_eq!(pages.position("nodes", bad).unwrap_err().code, Code::InvalidPageToken);
        }
    }
}
