//! `Accept`: whether the client takes what a route gives.

use axum::http::HeaderMap;
use axum::http::header::ACCEPT;
use blaze_domain::config::{Code, Problem};

use super::reply::{JSON, PROBLEM};
use super::routes::Action;

/// Content type of a watch.
pub(super) const EVENT_STREAM: &str = "text/event-stream";

/// Types that a route gives; any of them is enough.
fn offered(action: Action) -> [&'static str; 2] {
    match action {
        Action::Watch | Action::Live => [EVENT_STREAM, PROBLEM],
        _ => [JSON, PROBLEM],
    }
}

/// Refuses a request that takes none of the route's types.
///
/// # Errors
/// `not_acceptable`.
pub(super) fn check(headers: &HeaderMap, action: Action) -> Result<(), Problem> {
    let mut ranges = Vec::new();
    for value in headers.get_all(ACCEPT) {
        // What cannot be read says nothing, as if it were not there.
        let Ok(text) = value.to_str() else { return Ok(()) };
        for range in text.split(',').map(str::trim).filter(|range| !range.is_empty()) {
            match Range::parse(range) {
                Some(range) => ranges.push(range),
                None => return Ok(()),
            }
        }
    }
    let offered = offered(action);
    if ranges.is_empty() || offered.iter().any(|media| accepted(&ranges, media)) {
        return Ok(());
    }
    let detail =
        format!("Accept takes none of the types that there are here: {}", offered.join(", "));
    Err(Problem::new(Code::NotAcceptable, detail))
}

/// The most specific range that names a type decides.
fn accepted(ranges: &[Range<'_>], media: &str) -> bool {
    let matching =
        ranges.iter().filter_map(|range| Some((range.specificity(media)?, range.wanted)));
    matching.max().is_some_and(|(_, wanted)| wanted)
}

/// One media range; parameters other than `q` are not looked at, since no type here has any that
/// matter.
struct Range<'a> {
    media: &'a str,
    /// Its `q` is above 0.
    wanted: bool,
}

impl<'a> Range<'a> {
    fn parse(text: &'a str) -> Option<Self> {
        let mut parts = text.split(';').map(str::trim);
        let media = parts.next()?;
        let (kind, subtype) = media.split_once('/')?;
        let token = |text: &str| {
            !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_graphic() && byte != b'/')
        };
        if !token(kind) || !token(subtype) || (kind == "*" && subtype != "*") {
            return None;
        }
        let mut wanted = true;
        for (name, value) in parts.filter_map(|part| part.split_once('=')) {
            if name.trim().eq_ignore_ascii_case("q") {
                let quality: f32 = value.trim().parse().ok()?;
                wanted = quality > 0.0;
            }
        }
        Some(Self { media, wanted })
    }

    fn specificity(&self, media: &str) -> Option<u8> {
        let (kind, _) = media.split_once('/')?;
        match self.media.split_once('/')? {
            ("*", "*") => Some(0),
            (own, "*") => own.eq_ignore_ascii_case(kind).then_some(1),
            _ => self.media.eq_ignore_ascii_case(media).then_some(2),
        }
    }
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    fn takes(accept: &str, action: Action) -> bool {
        let mut headers = HeaderMap::new();
        headers.insert(ACCEPT, HeaderValue::from_str(accept).unwrap());
        check(&headers, action).is_ok()
    }

    #[test]
    fn only_what_excludes_everything_is_refused() {
        assert!(check(&HeaderMap::new(), Action::Apply).is_ok());
        for accept in [
            "",
            "*/*",
            "application/*",
            "application/json",
            "Application/JSON; charset=utf-8",
            "text/html, */*;q=0.1",
            "application/problem+json",
            "nonsense",
            "text/html, nonsense",
            "application/json;q=0, application/*",
        ] {
            assert!(takes(accept, Action::Apply), "{accept}");
        }
        for accept in [
            "text/html",
            "text/*",
            "*/*;q=0",
            "application/json;q=0, application/problem+json;q=0, */*",
            "application/yaml",
        ] {
            assert!(!takes(accept, Action::Apply), "{accept}");
        }
    }

    #[test]
    fn a_watch_is_an_event_stream() {
        assert!(takes("text/event-stream", Action::Watch));
        assert!(takes("*/*", Action::Watch));
        assert!(!takes("application/json", Action::Watch));
    }
}
