//! Bodies of requests: their size, type and form.

use axum::body::Body;
use axum::http::HeaderMap;
use axum::http::header::{CONTENT_ENCODING, CONTENT_LENGTH, CONTENT_TYPE};
use blaze_domain::config::{Code, Problem};
use bytes::Bytes;
use http_body_util::{BodyExt, LengthLimitError, Limited};
use serde_json::Value;

use super::routes::Payload;
use crate::api::limits::refusal;

/// Largest body (1 MiB).
const MAX_BODY: usize = 1024 * 1024;
/// Largest body of `/apply` (8 MiB).
const MAX_APPLY_BODY: usize = 8 * 1024 * 1024;

/// Form of a body.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Media {
    Json,
    MergePatch,
    Yaml,
}

impl Media {
    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::Json => "application/json",
            Self::MergePatch => "application/merge-patch+json",
            Self::Yaml => "application/yaml",
        }
    }
}

impl Payload {
    /// The types that are taken, the usual one first.
    pub(super) fn media(self) -> &'static [Media] {
        match self {
            Self::None => &[],
            Self::MergePatch => &[Media::MergePatch, Media::Json],
            Self::Documents => &[Media::Yaml, Media::Json],
            Self::Document(_)
            | Self::Rollback
            | Self::Revert
            | Self::Trim
            | Self::Token
            | Self::Abort => &[Media::Json],
        }
    }

    fn limit(self) -> usize {
        match self {
            Self::Documents => MAX_APPLY_BODY,
            _ => MAX_BODY,
        }
    }
}

/// Reads a body: `None` where the route has none.
///
/// # Errors
/// `payload_too_large`, `unsupported_media_type`, `invalid_request` if it breaks off, and what the
/// limits of bodies refuse.
pub(super) async fn read(
    payload: Payload,
    headers: &HeaderMap,
    body: Body,
) -> Result<Option<(Media, Bytes)>, Problem> {
    if payload == Payload::None {
        return Ok(None);
    }
    let limit = payload.limit();
    let announced =
        headers.get(CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse::<usize>().ok());
    if announced.is_some_and(|length| length > limit) {
        return Err(too_large(limit));
    }
    let media = media_type(payload, headers)?;
    match Limited::new(body, limit).collect().await {
        Ok(collected) => Ok(Some((media, collected.to_bytes()))),
        Err(error) if error.is::<LengthLimitError>() => Err(too_large(limit)),
        Err(error) => {
            let broke_off = || Problem::new(Code::InvalidRequest, "the body broke off");
            Err(refusal(&*error).cloned().unwrap_or_else(broke_off))
        }
    }
}

fn too_large(limit: usize) -> Problem {
    Problem::new(Code::PayloadTooLarge, format!("the body has more than {limit} bytes"))
}

fn media_type(payload: Payload, headers: &HeaderMap) -> Result<Media, Problem> {
    let taken = payload.media();
    let refuse = |what: &str| {
        let names: Vec<&str> = taken.iter().map(|media| media.as_str()).collect();
        Problem::new(
            Code::UnsupportedMediaType,
            format!("{what}; {} is taken here", names.join(" or ")),
        )
    };
    if headers
        .get(CONTENT_ENCODING)
        .is_some_and(|coding| !coding.as_bytes().eq_ignore_ascii_case(b"identity"))
    {
        return Err(refuse("the body has a Content-Encoding, and none is taken"));
    }
    let mut values = headers.get_all(CONTENT_TYPE).iter();
    let (Some(value), None) = (values.next(), values.next()) else {
        return Err(refuse("the body has no Content-Type, or several"));
    };
    let text = value.to_str().map_err(|_| refuse("the Content-Type cannot be read"))?;
    let mut parts = text.split(';').map(str::trim);
    let name = parts.next().unwrap_or_default();
    let Some(media) = taken.iter().copied().find(|media| media.as_str().eq_ignore_ascii_case(name))
    else {
        return Err(refuse("the body has another Content-Type"));
    };
    let utf8 = parts.filter(|part| !part.is_empty()).all(|part| {
        let (name, value) = part.split_once('=').unwrap_or((part, ""));
        !name.trim().eq_ignore_ascii_case("charset")
            || value.trim().trim_matches('"').eq_ignore_ascii_case("utf-8")
    });
    if utf8 { Ok(media) } else { Err(refuse("the charset is not utf-8")) }
}

/// Reads strict JSON.
///
/// # Errors
/// `invalid_request`.
pub(super) fn json(bytes: &[u8]) -> Result<Value, Problem> {
    blaze_domain::config::json::parse(bytes).map_err(|error| {
        Problem::new(
            Code::InvalidRequest,
            format!("the body is no JSON as it is taken here: {error}"),
        )
    })
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;
    use blaze_domain::config::Kind;

    use super::*;

    fn headers(pairs: &[(axum::http::HeaderName, &str)]) -> HeaderMap {
        let mut headers = HeaderMap::new();
        for (name, value) in pairs {
            headers.append(name, HeaderValue::from_str(value).unwrap());
        }
        headers
    }

    fn code(payload: Payload, content_type: &str) -> Result<Media, Code> {
        media_type(payload, &headers(&[(CONTENT_TYPE, content_type)]))
            .map_err(|problem| problem.code)
    }

    #[test]
    fn each_route_takes_its_types() {
        let document = Payload::Document(Kind::Node);
        for good in [
            "application/json",
            "Application/JSON",
            "application/json; charset=utf-8",
            "application/json;charset=\"UTF-8\"",
        ] {
            assert_eq!(code(document, good), Ok(Media::Json), "{good}");
        }
        assert_eq!(
            code(Payload::MergePatch, "application/merge-patch+json"),
            Ok(Media::MergePatch)
        );
        assert_eq!(code(Payload::MergePatch, "application/json"), Ok(Media::Json));
        assert_eq!(code(Payload::Documents, "application/yaml"), Ok(Media::Yaml));
        for bad in [
            "",
            "text/plain",
            "application/json; charset=latin1",
            "application/yaml",
            "application/merge-patch+json",
        ] {
            assert_eq!(code(document, bad), Err(Code::UnsupportedMediaType), "{bad}");
        }
        assert!(media_type(document, &HeaderMap::new()).is_err());
        let twice =
            headers(&[(CONTENT_TYPE, "application/json"), (CONTENT_TYPE, "application/json")]);
        assert!(media_type(document, &twice).is_err());
        let packed = headers(&[(CONTENT_TYPE, "application/json"), (CONTENT_ENCODING, "gzip")]);
        assert!(media_type(document, &packed).is_err());
    }

    #[tokio::test]
    async fn a_body_has_a_size() {
        let json = headers(&[(CONTENT_TYPE, "application/json")]);
        let read_bytes = |payload, size: usize| {
            let json = json.clone();
            async move {
                read(payload, &json, Body::from(vec![b' '; size]))
                    .await
                    .map_err(|problem| problem.code)
            }
        };
        assert_eq!(read_bytes(Payload::Trim, MAX_BODY).await.unwrap().unwrap().1.len(), MAX_BODY);
        assert_eq!(read_bytes(Payload::Trim, MAX_BODY + 1).await, Err(Code::PayloadTooLarge));
        assert!(read_bytes(Payload::Documents, MAX_BODY + 1).await.is_ok());
        assert_eq!(read_bytes(Payload::None, MAX_BODY + 1).await, Ok(None));
        let announced = headers(&[(CONTENT_TYPE, "text/plain"), (CONTENT_LENGTH, "1048577")]);
        let problem = read(Payload::Trim, &announced, Body::empty()).await.unwrap_err();
        assert_eq!(problem.code, Code::PayloadTooLarge);
    }
}
