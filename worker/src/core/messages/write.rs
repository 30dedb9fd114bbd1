//! What a worker writes: answers, notices, the values of Redis.

use std::sync::Arc;

use blaze_domain::config::secret::{self, Secret};
use blaze_domain::config::{Document, MAX_EFFECTIVE_BYTES, Timestamp};
use serde_json::{Map, Value, json};

use super::get::{ErrorCode, RequestError};
use crate::core::answer::{Freshness, Reply};
use crate::core::incoming::redact;
use crate::core::notice::{Notice, Scope, Standing};
use crate::core::place::Source;

/// How secrets reach a service.
///
/// The configuration that a service reads must be usable as it is: where a text is wanted, a text must stand. So a secret
/// is delivered as a plain text in place of the whole `{"$secret":…}` object. Where that must not be, or where the
/// text is not known (a copy that was kept without a key has none), the redacted object stands there instead, as for
/// a user: it is no text, so that no service takes it for the secret by mistake. The hash is the same in both forms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// As text.
    Text,
    /// As `{"$secret":{"redacted":true,"version":n}}`.
    Redacted,
}

impl Delivery {
    /// The document as it is kept in memory and in copies: without texts where nobody is told them.
    #[must_use]
    pub fn kept(self, document: Arc<Document>) -> Arc<Document> {
        let has_secrets = secret::contains(&document.spec) || document.status.as_ref().is_some_and(secret::contains);
        if self == Self::Text || !has_secrets {
            return document;
        }
        let mut document = Arc::unwrap_or_clone(document);
        redact(&mut document);
        Arc::new(document)
    }
}

/// A configuration that is too large to be sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the configuration has {bytes} bytes, at most {MAX_EFFECTIVE_BYTES} are sent")]
pub struct TooLargeMessage {
    /// Of its compact JSON.
    pub bytes: usize,
}

impl Delivery {
    /// A configuration with its secrets in this form.
    #[must_use]
    pub fn form(self, config: &Value) -> Value {
        let mut out = config.clone();
        secret::map(&mut out, &mut |_, value| {
            let known = Secret::of(value).and_then(Result::ok);
            let text = match (self, known) {
                (Self::Text, Some(Secret::Text(text) | Secret::Revealed { text, .. })) => Some(text),
                (Self::Text, Some(Secret::Redacted { .. } | Secret::Stored { .. }) | None) | (Self::Redacted, _) => {
                    None
                }
            };
            Some(text.map_or_else(|| secret::redact(value).into_owned(), Value::from))
        });
        out
    }

    fn sized(self, config: &Value) -> Result<Value, TooLargeMessage> {
        let value = self.form(config);
        let bytes = value.to_string().len();
        if bytes > MAX_EFFECTIVE_BYTES {
            return Err(TooLargeMessage { bytes });
        }
        Ok(value)
    }
}

/// An answer to a request with an id.
#[must_use]
pub fn reply(reply: &Reply, id: Option<&str>, delivery: Delivery, freshness: Freshness) -> String {
    let mut out = begin(id);
    match reply {
        Reply::Standing(standing) => {
            if let Err(error) = put_standing(&mut out, standing, delivery, freshness) {
                let error = RequestError::new(ErrorCode::TooLarge, error.to_string());
                return refusal(&error, id);
            }
        }
        Reply::Unchanged { revision, hash, source } => {
            out.insert("unchanged".to_owned(), true.into());
            out.insert("revision".to_owned(), (*revision).into());
            out.insert("hash".to_owned(), hash.as_str().into());
            put_freshness(&mut out, *source, freshness);
        }
        Reply::Error(error) => return refusal(error, id),
    }
    Value::Object(out).to_string()
}

/// The refusal of a request with an id.
#[must_use]
pub fn refusal(error: &RequestError, id: Option<&str>) -> String {
    let mut out = begin(id);
    let error = json!({ "code": error.code.as_str(), "detail": error.detail });
    out.insert("error".to_owned(), error);
    Value::Object(out).to_string()
}

/// What stands in Redis: an answer without id.
///
/// # Errors
/// The configuration is too large.
pub fn state_value(standing: &Standing, delivery: Delivery, freshness: Freshness) -> Result<String, TooLargeMessage> {
    let mut out = Map::new();
    put_standing(&mut out, standing, delivery, freshness)?;
    Ok(Value::Object(out).to_string())
}

/// A notice, written at a time.
///
/// # Errors
/// The configuration is too large.
pub fn notice(notice: &Notice, delivery: Delivery, time: Timestamp) -> Result<String, TooLargeMessage> {
    let config = notice
        .config
        .as_ref()
        .map(|config| delivery.sized(config.value()))
        .transpose()?;
    let mut out = Map::new();
    let mut put = |name: &str, value: Value| out.insert(name.to_owned(), value);
    put("service", notice.place.service.as_str().into());
    put("instance", text(notice.place.instance.as_ref()));
    put("layer", notice.layer.as_str().into());
    put("node", text(notice.place.node.as_ref()));
    put("revision", notice.revision.into());
    put("hash", text(notice.hash.as_ref()));
    put("previous_hash", text(notice.previous_hash.as_ref()));
    put("paths", notice.paths.as_slice().into());
    put("scopes", notice.scopes.iter().copied().map(Scope::as_str).collect());
    let is_deleted = config.is_none();
    put("config", config.unwrap_or(Value::Null));
    if is_deleted {
        put("deleted", true.into());
    }
    put("source", notice.source.as_str().into());
    put("time", time.to_string().into());
    Ok(Value::Object(out).to_string())
}

fn begin(id: Option<&str>) -> Map<String, Value> {
    let mut out = Map::new();
    if let Some(id) = id {
        out.insert("id".to_owned(), id.into());
    }
    out
}

fn put_standing(
    out: &mut Map<String, Value>,
    standing: &Standing,
    delivery: Delivery,
    freshness: Freshness,
) -> Result<(), TooLargeMessage> {
    let config = delivery.sized(standing.config.value())?;
    let at = &standing.at;
    out.insert("service".to_owned(), text(at.service.as_ref()));
    out.insert("instance".to_owned(), text(at.instance.as_ref()));
    out.insert("layer".to_owned(), text(at.layer.as_ref()));
    out.insert("node".to_owned(), text(at.node.as_ref()));
    out.insert("revision".to_owned(), standing.revision.into());
    out.insert("hash".to_owned(), standing.hash.as_str().into());
    out.insert("config".to_owned(), config);
    put_freshness(out, standing.source, freshness);
    out.insert("rollout".to_owned(), text(standing.rollout.as_ref()));
    Ok(())
}

fn put_freshness(out: &mut Map<String, Value>, source: Source, freshness: Freshness) {
    out.insert("source".to_owned(), source.as_str().into());
    let as_of = freshness.as_of.map(|time| time.to_string());
    out.insert("as_of".to_owned(), text(as_of.as_ref()));
    out.insert("age_s".to_owned(), freshness.age_s().map_or(Value::Null, Value::from));
}

impl Freshness {
    /// Seconds since the worker last knew itself in sync, to a tenth; a clock that was set back does not make it negative.
    #[must_use]
    pub fn age_s(&self) -> Option<f64> {
        let ms = self.now.as_millis() - self.as_of?.as_millis();
        // Beyond thirteen years nobody counts on.
        let tenths = u32::try_from((ms.max(0) + 50) / 100).unwrap_or(u32::MAX);
        Some(f64::from(tenths) / 10.0)
    }
}

fn text(value: Option<&impl AsRef<str>>) -> Value {
    value.map_or(Value::Null, |value| value.as_ref().into())
}

#[cfg(test)]
#[path = "write_tests.rs"]
mod tests;
