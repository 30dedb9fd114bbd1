//! What a worker writes: answers, notices, the values of Redis.

use std::sync::Arc;

use blaze_domain::config::secret::{self, Secret};
use blaze_domain::config::{Document, MAX_EFFECTIVE_BYTES, Timestamp};
use serde_json::{Value, json};

use super::get::{ErrorCode, RequestError};
use crate::core::answer::{Freshness, Reply};
use crate::core::incoming::redact;
use crate::core::notice::{Notice, Scope, Standing};

/// How secrets reach a service.
///
/// The configuration that a service reads must be usable as it is: where a text is wanted, a text
/// must stand. So a secret is delivered as a plain text in place of the whole `{"$secret":…}`
/// object. Where that must not be, or where the text is not known (a copy that was kept without a
/// key has none), the redacted object stands there instead, as for a user: it is no text, so that
/// no service takes it for the secret by mistake. The hash is the same in both forms.
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
        let has_secrets = secret::contains(&document.spec)
            || document.status.as_ref().is_some_and(secret::contains);
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
                (Self::Text, Some(Secret::Text(text) | Secret::Revealed { text, .. })) => {
                    Some(text)
                }
                (Self::Text, Some(Secret::Redacted { .. } | Secret::Stored { .. }) | None)
                | (Self::Redacted, _) => None,
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
    let members = match reply {
        Reply::Standing(standing) => match members(standing, delivery, freshness) {
            Ok(members) => members,
            Err(error) => {
                let error = RequestError::new(ErrorCode::TooLarge, error.to_string());
                return refusal(&error, id);
            }
        },
        Reply::Unchanged { revision, hash, source, store } => of_store(
            json!({
                "unchanged": true, "revision": revision, "hash": hash,
                "source": source.as_str(), "as_of": freshness.as_of(), "age_s": freshness.age_s(),
            }),
            store.as_deref(),
        ),
        Reply::Error(error) => return refusal(error, id),
    };
    with_id(id, members)
}

/// The refusal of a request with an id.
#[must_use]
pub fn refusal(error: &RequestError, id: Option<&str>) -> String {
    with_id(id, json!({ "error": { "code": error.code.as_str(), "detail": error.detail } }))
}

/// Members behind the id, if there is one.
fn with_id(id: Option<&str>, members: Value) -> String {
    let Some(id) = id else { return members.to_string() };
    let mut out = json!({ "id": id });
    if let (Value::Object(out), Value::Object(members)) = (&mut out, members) {
        out.extend(members);
    }
    out.to_string()
}

/// What stands in Redis: an answer without id.
///
/// # Errors
/// The configuration is too large.
pub fn state_value(
    standing: &Standing,
    delivery: Delivery,
    freshness: Freshness,
) -> Result<String, TooLargeMessage> {
    members(standing, delivery, freshness).map(|members| members.to_string())
}

fn members(
    standing: &Standing,
    delivery: Delivery,
    freshness: Freshness,
) -> Result<Value, TooLargeMessage> {
    let at = &standing.at;
    let mut out = json!({
        "service": at.service, "instance": at.instance, "layer": at.layer, "node": at.node,
        "revision": standing.revision, "hash": standing.hash, "config": null,
        "source": standing.source.as_str(), "as_of": freshness.as_of(), "age_s": freshness.age_s(),
        "rollout": standing.rollout,
    });
    // Afterwards, for it may be large: what stands in the macro is copied.
    out["config"] = delivery.sized(standing.config.value())?;
    Ok(of_store(out, standing.store.as_deref()))
}

/// Members with the store that they are of, if there is one.
fn of_store(mut members: Value, store: Option<&str>) -> Value {
    if let Some(store) = store {
        members["store_id"] = store.into();
    }
    members
}

/// A notice, written at a time.
///
/// # Errors
/// The configuration is too large.
pub fn notice(
    notice: &Notice,
    delivery: Delivery,
    time: Timestamp,
) -> Result<String, TooLargeMessage> {
    let scopes = notice.scopes.iter().copied().map(Scope::as_str);
    let mut out = json!({
        "service": notice.place.service, "instance": notice.place.instance, "layer": notice.layer,
        "node": notice.place.node, "revision": notice.revision, "hash": notice.hash,
        "previous_hash": notice.previous_hash, "paths": notice.paths,
        "scopes": scopes.collect::<Vec<_>>(),
        "config": null, "deleted": true, "source": notice.source.as_str(), "time": time.to_string(),
    });
    if let (Value::Object(members), Some(config)) = (&mut out, &notice.config) {
        members.shift_remove("deleted");
        members.insert("config".to_owned(), delivery.sized(config.value())?);
    }
    Ok(of_store(out, notice.store.as_deref()).to_string())
}

impl Freshness {
    fn as_of(&self) -> Option<String> {
        self.as_of.map(|time| time.to_string())
    }

    /// Seconds since the worker last knew itself in sync, to a tenth; a clock that was set back
    /// does not make it negative.
    #[must_use]
    pub fn age_s(&self) -> Option<f64> {
        let ms = self.now.as_millis() - self.as_of?.as_millis();
        // Beyond thirteen years nobody counts on.
        let tenths = u32::try_from((ms.max(0) + 50) / 100).unwrap_or(u32::MAX);
        Some(f64::from(tenths) / 10.0)
    }
}

#[cfg(test)]
#[path = "write_tests.rs"]
mod tests;
