//! Media types of payloads, as far as flows look at them.

/// What a payload is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Media<'a> {
    /// `application/json`
    Json,
    /// `application/cdr; type=sensor_msgs/msg/Imu`
    Cdr {
        /// Its type, if it is given.
        type_name: Option<&'a str>,
    },
    /// Anything else.
    Other,
}

impl<'a> Media<'a> {
    /// Reads the encoding of a message.
    #[must_use]
    pub fn of(encoding: &'a str) -> Self {
        let mut parts = encoding.split(';').map(str::trim);
        let essence = parts.next().unwrap_or_default();
        if essence.eq_ignore_ascii_case("application/json") {
            return Self::Json;
        }
        if !essence.eq_ignore_ascii_case("application/cdr") {
            return Self::Other;
        }
        let type_name = parts.find_map(|part| {
            let (key, value) = part.split_once('=')?;
            let value = value.trim().trim_matches('"');
            (key.trim().eq_ignore_ascii_case("type") && !value.is_empty()).then_some(value)
        });
        Self::Cdr { type_name }
    }
}

/// The media type of CDR of a type.
#[must_use]
pub fn cdr_of(type_name: &str) -> String {
    format!("application/cdr; type={type_name}")
}

/// The media type of JSON.
pub const JSON: &str = "application/json";

/// The media type of requests of a client that wants its reply as JSON.
pub const CALL: &str = "application/json; call=request";
/// The media type of their replies.
pub const CALL_REPLY: &str = "application/json; call=reply";
/// The media type of what comes instead of a reply, where the request cannot be converted, or the
/// reply: a `ControlError`.
pub const CALL_FAULT: &str = "application/json; call=fault";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn media_types_are_read_as_http_reads_them() {
        for json in
            ["application/json", "Application/JSON; charset=utf-8", " application/json ", CALL]
        {
            assert_eq!(Media::of(json), Media::Json, "{json}");
        }
        let typed = Media::Cdr { type_name: Some("a/msg/B") };
        for cdr in [
            &cdr_of("a/msg/B"),
            "application/cdr;type=a/msg/B",
            "application/CDR; x=1; TYPE=\"a/msg/B\"",
        ] {
            assert_eq!(Media::of(cdr), typed, "{cdr}");
        }
        for cdr in ["application/cdr", "application/cdr; type=", "application/cdr; types=a"] {
            assert_eq!(Media::of(cdr), Media::Cdr { type_name: None }, "{cdr}");
        }
        for other in ["", "application/octet-stream", "application/json5", "json"] {
            assert_eq!(Media::of(other), Media::Other, "{other}");
        }
    }
}
