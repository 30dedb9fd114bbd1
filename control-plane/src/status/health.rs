//! States and their hysteresis.

use std::time::Duration;

use blaze_domain::config::Timestamp;
use tokio::time::Instant;

use super::limits::{BETTER, WORSE};

/// How something is; the worst is the largest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub enum Health {
    /// Nothing is wrong.
    Ok,
    /// Nobody has reported it.
    #[default]
    Unknown,
    /// It works in part.
    Degraded,
    /// It does not work.
    Down,
}

impl Health {
    /// All of them.
    pub const ALL: &'static [Self] = &[Self::Ok, Self::Unknown, Self::Degraded, Self::Down];
    /// As they are written.
    pub const WORDS: &'static [&'static str] = &["ok", "unknown", "degraded", "down"];

    /// As it is written.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Unknown => "unknown",
            Self::Degraded => "degraded",
            Self::Down => "down",
        }
    }

    /// The state of a word; one that is not known is [`Health::Unknown`].
    #[must_use]
    pub fn of_word(word: &str) -> Self {
        Self::ALL.iter().copied().find(|health| health.as_str() == word).unwrap_or_default()
    }
}

/// A moment: for durations, and for people.
#[derive(Debug, Clone, Copy)]
pub struct Now {
    /// For durations.
    pub at: Instant,
    /// For people.
    pub time: Timestamp,
}

/// A value that gets worse after [`WORSE`] and better after [`BETTER`] of steadily being so.
#[derive(Debug, Clone)]
pub struct Damped<T> {
    value: T,
    since: Timestamp,
    pending: Option<Pending<T>>,
}

#[derive(Debug, Clone)]
struct Pending<T> {
    worse: bool,
    since: Instant,
    /// The least change that was seen since: what certainly held all the time.
    least: T,
}

impl<T: Ord + Copy> Damped<T> {
    /// Begins with a value.
    pub fn new(value: T, now: Now) -> Self {
        Self { value, since: now.time, pending: None }
    }

    /// What counts.
    pub fn value(&self) -> T {
        self.value
    }

    /// Since when it counts.
    pub fn since(&self) -> Timestamp {
        self.since
    }

    /// Takes a value at once.
    pub fn set(&mut self, value: T, now: Now) {
        if value != self.value {
            (self.value, self.since) = (value, now.time);
        }
        self.pending = None;
    }

    /// Takes what was seen. Whether the value that counts has changed.
    pub fn update(&mut self, seen: T, now: Now) -> bool {
        if seen == self.value {
            self.pending = None;
            return false;
        }
        let worse = seen > self.value;
        let (since, least) = match &self.pending {
            Some(pending) if pending.worse == worse => {
                let least = if worse { pending.least.min(seen) } else { pending.least.max(seen) };
                (pending.since, least)
            }
            _ => (now.at, seen),
        };
        let wait = if worse { WORSE } else { BETTER };
        if now.at.saturating_duration_since(since) < wait {
            self.pending = Some(Pending { worse, since, least });
            return false;
        }
        self.set(least, now);
        // What is beyond that has to hold on its own.
        self.pending = (seen != least).then_some(Pending { worse, since: now.at, least: seen });
        true
    }
}

/// What was not heard of for `age` is late: the hysteresis makes it silent at the full time.
#[must_use]
pub fn is_late(age: Duration) -> bool {
    age >= super::limits::SILENT.saturating_sub(WORSE)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn at(start: Instant, seconds: u64) -> Now {
        let time = Timestamp::from_millis(i64::try_from(seconds * 1000).unwrap());
        Now { at: start + Duration::from_secs(seconds), time }
    }

    #[test]
    fn worse_counts_after_5_s_and_better_after_15_s() {
        let start = Instant::now();
        let mut state = Damped::new(Health::Ok, at(start, 0));
        let seen = [
            (1, Health::Down, Health::Ok),
            (4, Health::Down, Health::Ok),
            (5, Health::Ok, Health::Ok),
            (6, Health::Degraded, Health::Ok),
            (9, Health::Down, Health::Ok),
            // It was at least degraded for 5 s, and down only since 9.
            (11, Health::Down, Health::Degraded),
            (15, Health::Down, Health::Degraded),
            (16, Health::Down, Health::Down),
            (20, Health::Ok, Health::Down),
            (30, Health::Degraded, Health::Down),
            (35, Health::Ok, Health::Degraded),
            (36, Health::Ok, Health::Degraded),
            (51, Health::Ok, Health::Ok),
        ];
        for (second, raw, expected) in seen {
            state.update(raw, at(start, second));
            assert_eq!(state.value(), expected, "at {second} s");
        }
        assert_eq!(state.since(), Timestamp::from_millis(51_000));
    }

    #[test]
    fn words_are_those_of_the_contract() {
        let words: Vec<&str> = Health::ALL.iter().map(|health| health.as_str()).collect();
        assert_eq!(words, Health::WORDS);
        assert!(Health::ALL.iter().all(|health| Health::of_word(health.as_str()) == *health));
        assert_eq!(Health::of_word("fine"), Health::Unknown);
    }

    proptest! {
        /// It never changes more often than the hysteresis lets it, and never to something that was
        /// not seen.
        #[test]
        fn nothing_flaps(seen in proptest::collection::vec((0_u64..4, 0_usize..4), 1..200)) {
            let start = Instant::now();
            let mut state = Damped::new(Health::Ok, at(start, 0));
            let (mut second, mut changed) = (0, None::<u64>);
            for (step, index) in seen {
                second += step;
                let (raw, before) = (Health::ALL[index], state.value());
                if state.update(raw, at(start, second)) {
                    let wait = if state.value() > before { 5 } else { 15 };
                    prop_assert!(changed.is_none_or(|last| second - last >= wait), "{second}");
                    changed = Some(second);
                }
            }
        }
    }
}
