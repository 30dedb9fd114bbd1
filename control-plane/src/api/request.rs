//! What REST and gRPC take from the head of a request in the same way.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use axum::extract::ConnectInfo;
use axum::http::header::{AUTHORIZATION, AsHeaderName, HOST, ORIGIN};
use axum::http::{Extensions, HeaderMap, HeaderValue, Uri};
use blaze_domain::config::{Code, Problem};
use uuid::Uuid;

use crate::auth::dev;

/// Longest request id that is taken over, in bytes.
const MAX_ID_BYTES: usize = 128;

/// The request's `x-request-id` if it fits `[A-Za-z0-9._-]{1,128}`, else a new UUIDv7.
#[must_use]
pub fn request_id(headers: &HeaderMap) -> String {
    let given = single(headers, "x-request-id").and_then(|value| value.to_str().ok());
    match given.filter(|text| is_request_id(text)) {
        Some(text) => text.to_owned(),
        None => Uuid::now_v7().to_string(),
    }
}

fn is_request_id(text: &str) -> bool {
    let allowed = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'.' | b'_' | b'-');
    (1..=MAX_ID_BYTES).contains(&text.len()) && text.bytes().all(allowed)
}

/// `traceparent`, if it is one: `00-<32 hex>-<16 hex>-<2 hex>`, neither id all zero.
#[must_use]
pub fn traceparent(headers: &HeaderMap) -> Option<&HeaderValue> {
    let value = single(headers, "traceparent")?;
    let mut parts = value.to_str().ok()?.split('-');
    let is_version_0 = parts.next() == Some("00");
    let mut hex = |length| {
        let is_hex = |byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f');
        parts.next().filter(|part| part.len() == length && part.bytes().all(is_hex))
    };
    let (trace, span, _flags) = (hex(32)?, hex(16)?, hex(2)?);
    let is_set = |id: &str| id.bytes().any(|byte| byte != b'0');
    (is_version_0 && is_set(trace) && is_set(span) && parts.next().is_none()).then_some(value)
}

/// The text of the token. `None`: there is no `authorization` at all. Empty: there is one that is
/// no `Bearer`, or more than one, so that none is a valid token.
#[must_use]
pub fn bearer(headers: &HeaderMap) -> Option<&str> {
    headers.get(AUTHORIZATION)?;
    let credentials = single(headers, AUTHORIZATION).and_then(|value| value.to_str().ok());
    match credentials.unwrap_or_default().split_once(' ') {
        Some((scheme, token)) if scheme.eq_ignore_ascii_case("bearer") => {
            Some(token.trim_matches(' '))
        }
        _ => Some(""),
    }
}

/// The value of a header that comes exactly once.
pub(super) fn single(headers: &HeaderMap, name: impl AsHeaderName) -> Option<&HeaderValue> {
    let mut values = headers.get_all(name).iter();
    let first = values.next();
    if values.next().is_some() { None } else { first }
}

/// Address of the client, as the listener left it in the request (`ConnectInfo<SocketAddr>`).
#[must_use]
pub fn client_address(extensions: &Extensions) -> IpAddr {
    let address = extensions.get::<ConnectInfo<SocketAddr>>();
    address.map_or(IpAddr::V4(Ipv4Addr::UNSPECIFIED), |info| info.0.ip().to_canonical())
}

/// The rules of `--dev`: no page of another site that a browser of this machine shows may reach a
/// service that asks for no token.
///
/// # Errors
/// `permission_denied`.
pub fn check_dev(uri: &Uri, headers: &HeaderMap) -> Result<(), Problem> {
    let header = || single(headers, HOST).and_then(|value| value.to_str().ok());
    let host =
        uri.authority().map(axum::http::uri::Authority::as_str).or_else(header).unwrap_or_default();
    let refuse = |detail: &str| Err(Problem::new(Code::PermissionDenied, detail));
    if !dev::host_is_loopback(host) {
        return refuse(
            "with --dev the service answers only under a loopback name, such as localhost",
        );
    }
    let mut origins = headers.get_all(ORIGIN).iter();
    if origins.any(|origin| dev::origin_is_foreign(origin.to_str().unwrap_or_default(), host)) {
        return refuse("with --dev the service does not answer pages of another origin");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn headers(name: &'static str, values: &[&'static str]) -> HeaderMap {
        let mut headers = HeaderMap::new();
        for value in values {
            headers.append(name, HeaderValue::from_bytes(value.as_bytes()).unwrap());
        }
        headers
    }

    #[test]
    fn a_good_request_id_is_taken_over() {
        assert_eq!(request_id(&headers("x-request-id", &["a.B_9-z"])), "a.B_9-z");
        let long = "a".repeat(MAX_ID_BYTES);
        assert!(is_request_id(&long) && !is_request_id(&format!("{long}a")));
        for bad in [&[""][..], &["a b"], &["a/b"], &["ä"], &["a\"b"], &["a", "b"], &[]] {
            let new: Uuid = request_id(&headers("x-request-id", bad)).parse().unwrap();
            assert_eq!(new.get_version_num(), 7);
        }
        assert_ne!(request_id(&HeaderMap::new()), request_id(&HeaderMap::new()));
    }

    #[test]
    fn only_a_whole_traceparent_is_one() {
        let good = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";
        assert_eq!(traceparent(&headers("traceparent", &[good])).unwrap(), good);
        for bad in [
            "",
            "00",
            "01-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01",
            "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01-",
            "00-4BF92F3577B34DA6A3CE929D0E0E4736-00f067aa0ba902b7-01",
            "00-00000000000000000000000000000000-00f067aa0ba902b7-01",
            "00-4bf92f3577b34da6a3ce929d0e0e4736-0000000000000000-01",
        ] {
            assert_eq!(traceparent(&headers("traceparent", &[bad])), None, "{bad}");
        }
        assert_eq!(traceparent(&headers("traceparent", &[good, good])), None);
    }

    #[test]
    fn only_one_bearer_is_a_token() {
        assert_eq!(bearer(&HeaderMap::new()), None);
        for (values, expected) in [
            (&["Bearer a.b.c"][..], "a.b.c"),
            (&["bearer  a.b.c "], "a.b.c"),
            (&["Basic YTpi"], ""),
            (&["Bearer"], ""),
            (&["Bearer "], ""),
            (&[""], ""),
            (&["Bearer a", "Bearer b"], ""),
        ] {
            assert_eq!(bearer(&headers("authorization", values)), Some(expected), "{values:?}");
        }
    }

    #[test]
    fn an_address_is_the_same_whatever_the_socket() {
        let mut extensions = Extensions::new();
        assert!(client_address(&extensions).is_unspecified());
        let both: SocketAddr = "[::ffff:10.0.0.1]:1".parse().unwrap();
        extensions.insert(ConnectInfo(both));
        assert_eq!(client_address(&extensions), IpAddr::from([10, 0, 0, 1]));
    }

    #[test]
    fn in_development_only_this_machine_may_come() {
        let of = |uri: &str, host: &[&'static str], origin: &[&'static str]| {
            let mut headers = headers("host", host);
            for origin in origin {
                headers.append(ORIGIN, HeaderValue::from_static(origin));
            }
            check_dev(&uri.parse().unwrap(), &headers).is_ok()
        };
        assert!(of("/a", &["127.0.0.1:8080"], &[]));
        assert!(of("http://localhost:8080/a", &[], &["http://localhost:8080"]));
        assert!(!of("/a", &[], &[]));
        assert!(!of("/a", &["evil.example"], &[]));
        assert!(!of("/a", &["localhost", "localhost"], &[]));
        assert!(!of("/a", &["localhost"], &["http://evil.example"]));
        assert!(!of("/a", &["localhost"], &["http://localhost", "http://evil.example"]));
    }

    proptest! {
        #[test]
        fn no_header_panics(bytes in proptest::collection::vec(any::<u8>(), 0..80)) {
            if let Ok(value) = HeaderValue::from_bytes(&bytes) {
                for name in ["x-request-id", "traceparent", "authorization", "host", "origin"] {
                    let mut headers = HeaderMap::new();
                    headers.insert(name, value.clone());
                    let _ = (request_id(&headers), traceparent(&headers), bearer(&headers));
                    let _ = check_dev(&Uri::from_static("/"), &headers);
                }
            }
        }
    }
}
