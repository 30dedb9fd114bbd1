//! What the log is told of a store that cannot be reached.

use std::time::{Duration, Instant};

/// Between two lines that say that nothing has changed.
const STILL_WAITING: Duration = Duration::from_secs(60);

/// What the log is told of a store that cannot be reached: each reason once.
#[derive(Default)]
pub(crate) struct Waiting {
    /// The last reason without its numbers, and when something was told.
    told: Option<(String, Instant)>,
}

/// What there is to say.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum News {
    /// Another reason than before, with what to do about it if that is known.
    Other(Option<&'static str>),
    /// The same reason for long.
    Still,
    /// Nothing that was not said.
    None,
}

impl Waiting {
    pub(crate) fn news(&mut self, reason: &str, now: Instant) -> News {
        let shape = without_numbers(reason);
        match &mut self.told {
            Some((told, at)) if *told == shape => {
                if now.saturating_duration_since(*at) < STILL_WAITING {
                    return News::None;
                }
                *at = now;
                News::Still
            }
            told => {
                *told = Some((shape, now));
                News::Other(hint(reason))
            }
        }
    }
}

/// Times and counters differ from one try to the next: `1.5 ms` and `820 µs` are the same.
fn without_numbers(text: &str) -> String {
    let part = |c: char| c.is_alphanumeric() || matches!(c, '.' | 'µ');
    let mut out = String::new();
    for word in text.split_inclusive(|c: char| !part(c)) {
        if word.contains(|c: char| c.is_ascii_digit()) {
            out.push('#');
        } else if !matches!(word.trim_end_matches(|c: char| !part(c)), "ns" | "µs" | "ms" | "s") {
            out.push_str(word);
        }
    }
    out
}

/// MongoDB's driver tells the state of each member in words alone.
fn hint(reason: &str) -> Option<&'static str> {
    reason.contains("RsGhost").then_some(
        "a member says that its replica set was never initiated: run rs.initiate() \
            once, on one member",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reason_to_wait_is_told_once() {
        let ghost = |rtt: &str| {
            format!(
                "MongoDB: Server selection timeout: No available servers. Topology: {{ Type: \
                 ReplicaSetNoPrimary, Servers: \
                 [ {{ Address: 127.0.0.1:27017, Type: RsGhost, Average RTT: {rtt}, Last Update \
                 Time: 2026-11-23 9:12:33.5 }} ] }}"
            )
        };
        let (mut waiting, start) = (Waiting::default(), Instant::now());
        let News::Other(Some(hint)) = waiting.news(&ghost("1.2ms"), start) else {
            panic!("the first reason is news");
        };
        assert!(hint.contains("rs.initiate()"));
        assert_eq!(waiting.news(&ghost("820µs"), start + Duration::from_secs(2)), News::None);
        assert_eq!(waiting.news(&ghost("2.5 ms"), start + Duration::from_secs(59)), News::None);
        assert_eq!(waiting.news(&ghost("2 ms"), start + Duration::from_secs(61)), News::Still);
        assert_eq!(waiting.news(&ghost("2 ms"), start + Duration::from_secs(63)), News::None);
        let other = "MongoDB: connection refused";
        assert_eq!(waiting.news(other, start + Duration::from_secs(64)), News::Other(None));
        assert!(matches!(waiting.news(&ghost("1 s"), start), News::Other(Some(_))));
    }
}
