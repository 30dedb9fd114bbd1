//! Times, for people only: order is by revision.

use std::fmt;
use std::str::FromStr;

/// Milliseconds since 1970 in UTC, written as RFC 3339 with milliseconds and `Z`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct Timestamp(i64);

impl Timestamp {
    /// From milliseconds since 1970; what is outside the years 0000 to 9999 becomes the nearest
    /// that is not.
    #[must_use]
    pub fn from_millis(millis: i64) -> Self {
        Self(millis.clamp(-62_167_219_200_000, 253_402_207_200_000))
    }

    /// Milliseconds since 1970.
    #[must_use]
    pub fn as_millis(self) -> i64 {
        self.0
    }
}

/// The text is no time in RFC 3339.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no RFC 3339 time, as 2026-11-21T07:01:12.345Z")]
pub struct TimeError(String);

impl fmt::Display for Timestamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match jiff::Timestamp::from_millisecond(self.0) {
            Ok(time) => write!(f, "{time:.3}"),
            // `from_millis` keeps within what this type takes.
            Err(_) => f.write_str("0000-01-01T00:00:00.000Z"),
        }
    }
}

impl FromStr for Timestamp {
    type Err = TimeError;
    fn from_str(text: &str) -> Result<Self, TimeError> {
        let time: jiff::Timestamp = text.parse().map_err(|_| TimeError(text.to_owned()))?;
        Ok(Self::from_millis(time.as_millisecond()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_has_milliseconds_and_z() {
        let time = Timestamp::from_millis(1_795_244_472_345);
        assert_eq!(time.to_string(), "2026-11-21T07:01:12.345Z");
        assert_eq!("2026-11-21T07:01:12.345Z".parse(), Ok(time));
        assert_eq!("2026-11-21T08:01:12.345+01:00".parse(), Ok(time));
        for (ms, text) in [
            (0, "1970-01-01T00:00:00.000Z"),
            (951_782_400_000, "2000-02-29T00:00:00.000Z"),
            (1_709_251_199_999, "2024-02-29T23:59:59.999Z"),
        ] {
            assert_eq!(Timestamp::from_millis(ms).to_string(), text);
        }
        for edge in [i64::MIN, i64::MAX] {
            let text = Timestamp::from_millis(edge).to_string();
            assert_eq!(text.parse(), Ok(Timestamp::from_millis(edge)), "{text}");
        }
        assert!("yesterday".parse::<Timestamp>().is_err());
    }
}
