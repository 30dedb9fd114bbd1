//! What the headers of a request say of documents: preconditions, keys of requests that come twice,
//! where a watch goes on. Pure: every function takes headers and gives a value or a refusal.

use axum::http::HeaderMap;
use axum::http::header::{HeaderName, IF_MATCH, IF_NONE_MATCH};
use blaze_domain::config::{Code, MAX_INTEGER, Problem};

use crate::api::request::single;
use crate::core::Precondition;

/// Name of the header with the store's revision.
pub(super) const BLAZE_REVISION: HeaderName = HeaderName::from_static("blaze-revision");
/// Name of the header with the request's id.
pub(super) const X_REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");
/// Name of the header of W3C Trace Context.
pub(super) const TRACEPARENT: HeaderName = HeaderName::from_static("traceparent");
/// Name of the header with the client's key of a request that may come twice.
pub(super) const IDEMPOTENCY_KEY: HeaderName = HeaderName::from_static("idempotency-key");
/// Name of the header that says that an answer is the first one again.
pub(super) const IDEMPOTENT_REPLAYED: HeaderName = HeaderName::from_static("idempotent-replayed");
const LAST_EVENT_ID: HeaderName = HeaderName::from_static("last-event-id");

/// Longest idempotency key, in characters.
const MAX_IDEMPOTENCY_KEY: usize = 128;

/// Entity tags of a precondition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Tags {
    /// `*`.
    Any,
    /// Revisions of the tags that are revisions; others match nothing.
    Revisions(Vec<u64>),
}

/// The strong entity tag of a revision.
pub(super) fn etag(revision: u64) -> String {
    format!("\"{revision}\"")
}

/// `If-Match`: weak tags match nothing (RFC 9110, 13.1.1).
///
/// # Errors
/// `invalid_header`.
pub(super) fn if_match(headers: &HeaderMap) -> Result<Option<Tags>, Problem> {
    tags(headers, &IF_MATCH, "If-Match", Weak::Ignored)
}

/// `If-None-Match`: weak tags match as strong ones do (RFC 9110, 13.1.2), as caches and proxies that
/// compress make them.
///
/// # Errors
/// `invalid_header`.
pub(super) fn if_none_match(headers: &HeaderMap) -> Result<Option<Tags>, Problem> {
    tags(headers, &IF_NONE_MATCH, "If-None-Match", Weak::Taken)
}

/// What a change of an existing document insists on.
///
/// # Errors
/// `invalid_header`.
pub(super) fn precondition(headers: &HeaderMap) -> Result<Precondition, Problem> {
    Ok(match if_match(headers)? {
        None => Precondition::None,
        Some(Tags::Any) => Precondition::Any,
        Some(Tags::Revisions(revisions)) => Precondition::Revisions(revisions),
    })
}

/// The same for PUT, which may create: `If-None-Match: *` insists on that.
///
/// # Errors
/// `invalid_header`.
pub(super) fn put_precondition(headers: &HeaderMap) -> Result<Precondition, Problem> {
    let given = precondition(headers)?;
    match (if_none_match(headers)?, given) {
        (None, given) => Ok(given),
        (Some(Tags::Any), Precondition::None) => Ok(Precondition::Absent),
        (Some(Tags::Any), _) => {
            Err(invalid("If-None-Match: * and If-Match contradict each other: send one of them"))
        }
        (Some(Tags::Revisions(_)), _) => Err(invalid("If-None-Match takes only * with PUT")),
    }
}

/// What becomes of weak tags.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Weak {
    Ignored,
    Taken,
}

fn tags(
    headers: &HeaderMap,
    name: &HeaderName,
    shown: &str,
    weak: Weak,
) -> Result<Option<Tags>, Problem> {
    let mut text = String::new();
    for value in headers.get_all(name) {
        let value = value
            .to_str()
            .map_err(|_| invalid(format!("{shown} holds characters other than visible ASCII")))?;
        if !text.is_empty() {
            text.push(',');
        }
        text.push_str(value);
    }
    if !headers.contains_key(name) {
        return Ok(None);
    }
    parse_tags(&text, weak).map(Some).map_err(|reason| {
        invalid(format!(
            "{shown} {reason}; it is *, or quoted revisions as they come in ETag: \"412\", \"413\""
        ))
    })
}

fn parse_tags(text: &str, weak: Weak) -> Result<Tags, &'static str> {
    let blank = |c: char| c == ' ' || c == '\t';
    let mut rest = text.trim_matches(blank);
    if rest == "*" {
        return Ok(Tags::Any);
    }
    let mut revisions = Vec::new();
    loop {
        let (is_weak, tag) = match rest.strip_prefix("W/") {
            Some(tag) => (true, tag),
            None => (false, rest),
        };
        let inner = tag.strip_prefix('"').ok_or("is not quoted")?;
        let (inner, after) = inner.split_once('"').ok_or("has no closing quote")?;
        if !inner.bytes().all(|byte| byte.is_ascii_graphic()) {
            return Err("holds a character that no tag has");
        }
        if !is_weak || weak == Weak::Taken {
            revisions.extend(revision(inner));
        }
        rest = after.trim_start_matches(blank);
        if rest.is_empty() {
            return Ok(Tags::Revisions(revisions));
        }
        rest = rest.strip_prefix(',').ok_or("has something other than a comma after a tag")?;
        rest = rest.trim_start_matches(blank);
    }
}

/// A revision as it stands in a tag: one spelling alone.
fn revision(text: &str) -> Option<u64> {
    let canonical = !text.is_empty()
        && text.bytes().all(|byte| byte.is_ascii_digit())
        && (text == "0" || !text.starts_with('0'));
    if canonical { text.parse().ok() } else { None }
}

/// `Idempotency-Key`, without quotes.
///
/// # Errors
/// `invalid_header`.
pub(super) fn idempotency_key(headers: &HeaderMap) -> Result<Option<String>, Problem> {
    if !headers.contains_key(&IDEMPOTENCY_KEY) {
        return Ok(None);
    }
    let refuse = || {
        invalid(
            "Idempotency-Key comes once and is 1 to 128 visible ASCII characters other than \
             quotes, in quotes or not",
        )
    };
    let text = single(headers, &IDEMPOTENCY_KEY)
        .and_then(|value| value.to_str().ok())
        .ok_or_else(refuse)?;
    let key = match text.strip_prefix('"') {
        Some(quoted) => quoted.strip_suffix('"').ok_or_else(refuse)?,
        None => text,
    };
    let fits = (1..=MAX_IDEMPOTENCY_KEY).contains(&key.len());
    if fits && key.bytes().all(|byte| byte.is_ascii_graphic() && byte != b'"') {
        Ok(Some(key.to_owned()))
    } else {
        Err(refuse())
    }
}

/// `Last-Event-ID`: where a watch goes on. An empty one is none, as browsers send it.
///
/// # Errors
/// `invalid_header`.
pub(super) fn last_event_id(headers: &HeaderMap) -> Result<Option<u64>, Problem> {
    let Some(value) = headers.get(&LAST_EVENT_ID) else {
        return Ok(None);
    };
    if value.is_empty() {
        return Ok(None);
    }
    let id = value.to_str().ok().and_then(revision).filter(|id| *id <= MAX_INTEGER.unsigned_abs());
    match id {
        Some(id) => Ok(Some(id)),
        None => Err(invalid("Last-Event-ID is the id of an event of this watch: a revision")),
    }
}

fn invalid(detail: impl Into<String>) -> Problem {
    Problem::new(Code::InvalidHeader, detail)
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;
    use proptest::prelude::*;

    use super::*;

    fn headers(pairs: &[(&str, &str)]) -> HeaderMap {
        let mut headers = HeaderMap::new();
        for (name, value) in pairs {
            headers.append(
                HeaderName::from_bytes(name.as_bytes()).unwrap(),
                HeaderValue::from_str(value).unwrap(),
            );
        }
        headers
    }

    #[test]
    fn tags_are_lists_of_revisions() {
        let read = |value: &str| {
            if_match(&headers(&[("if-match", value)]))
                .map(Option::unwrap)
                .map_err(|problem| problem.code)
        };
        assert_eq!(read("*"), Ok(Tags::Any));
        assert_eq!(read("\"412\""), Ok(Tags::Revisions(vec![412])));
        assert_eq!(read("\"1\",\"2\" , W/\"3\", \"x,y\", \"04\""), Ok(Tags::Revisions(vec![1, 2])));
        assert_eq!(read("W/\"412\""), Ok(Tags::Revisions(Vec::new())));
        assert_eq!(read("\"\""), Ok(Tags::Revisions(Vec::new())));
        for bad in [
            "412",
            "",
            "\"412",
            "412\"",
            "\"1\" \"2\"",
            "*, \"1\"",
            "\"1\",*",
            "\"1\",",
            ",\"1\"",
            "w/\"1\"",
            "\"a b\"",
        ] {
            assert_eq!(read(bad), Err(Code::InvalidHeader), "{bad}");
        }
        let two_lines = headers(&[("if-match", "\"1\""), ("if-match", "\"2\"")]);
        assert_eq!(if_match(&two_lines).unwrap(), Some(Tags::Revisions(vec![1, 2])));
        assert_eq!(if_match(&HeaderMap::new()).unwrap(), None);
    }

    #[test]
    fn weak_tags_tell_what_is_known_and_are_no_precondition() {
        let weak = |name| headers(&[(name, "W/\"412\", \"413\"")]);
        let of = |revisions: &[u64]| Ok(Some(Tags::Revisions(revisions.to_vec())));
        let code = |problem: Problem| problem.code;
        assert_eq!(if_none_match(&weak("if-none-match")).map_err(code), of(&[412, 413]));
        assert_eq!(if_match(&weak("if-match")).map_err(code), of(&[413]));
    }

    #[test]
    fn put_may_insist_on_absence() {
        let read = |pairs: &[(&str, &str)]| {
            put_precondition(&headers(pairs)).map_err(|problem| problem.code)
        };
        assert_eq!(read(&[]), Ok(Precondition::None));
        assert_eq!(read(&[("if-match", "*")]), Ok(Precondition::Any));
        assert_eq!(read(&[("if-none-match", "*")]), Ok(Precondition::Absent));
        assert_eq!(read(&[("if-none-match", "\"1\"")]), Err(Code::InvalidHeader));
        assert_eq!(
            read(&[("if-none-match", "*"), ("if-match", "\"1\"")]),
            Err(Code::InvalidHeader)
        );
    }

    #[test]
    fn idempotency_keys_are_visible_ascii() {
        let read = |value: &str| {
            idempotency_key(&headers(&[("idempotency-key", value)])).map_err(|problem| problem.code)
        };
        assert_eq!(read("a"), Ok(Some("a".to_owned())));
        assert_eq!(read("\"8e03978e-40d5\""), Ok(Some("8e03978e-40d5".to_owned())));
        assert_eq!(read(&"x".repeat(128)), Ok(Some("x".repeat(128))));
        for bad in ["", "\"\"", "\"", "a b", "\"a", "a\"b", "\"a\"b\"", &"x".repeat(129)] {
            assert_eq!(read(bad), Err(Code::InvalidHeader), "{bad}");
        }
        let twice = headers(&[("idempotency-key", "a"), ("idempotency-key", "a")]);
        assert!(idempotency_key(&twice).is_err());
    }

    #[test]
    fn a_watch_goes_on_after_an_event() {
        let read = |value: &str| {
            last_event_id(&headers(&[("last-event-id", value)])).map_err(|problem| problem.code)
        };
        assert_eq!(read("412"), Ok(Some(412)));
        assert_eq!(read("0"), Ok(Some(0)));
        assert_eq!(read(""), Ok(None));
        for bad in ["x", "-1", "01", "99999999999999999999"] {
            assert_eq!(read(bad), Err(Code::InvalidHeader), "{bad}");
        }
    }

    proptest! {
        #[test]
        fn tags_read_as_they_are_written(revisions in prop::collection::vec(0..=MAX_INTEGER
            .unsigned_abs(), 1..8)) {
            let text =
                revisions.iter().map(|revision| etag(*revision)).collect::<Vec<_>>().join(", ");
            prop_assert_eq!(parse_tags(&text, Weak::Ignored), Ok(Tags::Revisions(revisions)));
        }

        #[test]
        fn no_header_is_too_odd(bytes in prop::collection::vec(any::<u8>(), 0..64)) {
            if let Ok(value) = HeaderValue::from_bytes(&bytes) {
                let mut headers = HeaderMap::new();
                for name in [IF_MATCH, IF_NONE_MATCH, IDEMPOTENCY_KEY, LAST_EVENT_ID] {
                    headers.insert(name, value.clone());
                }
                let _ =
                    (if_match(&headers), put_precondition(&headers), idempotency_key(&headers),
                    last_event_id(&headers));
            }
        }
    }
}
