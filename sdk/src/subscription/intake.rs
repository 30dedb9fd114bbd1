//! Which of the messages that arrive are for the callback.
//!
//! ```text
//! message ─► repeat? loss? (per writer) ─► too old? ─► too fast? ─► queue
//! ```

use std::time::{Duration, Instant};

use blaze_domain::WriterId;
use lru::LruCache;

use super::stats::Counters;

/// Writers that a subscription remembers; the least recently heard goes first.
const MAX_WRITERS: usize = 65_536;
/// Sequences below the highest that are remembered one by one.
const WINDOW: u64 = 1_024;

/// What the intake needs to know of a message.
#[derive(Debug, Clone, Copy)]
pub(super) struct Arrival {
    /// Writer and sequence, where they are known.
    pub(super) identity: Option<(WriterId, u64)>,
    /// Whether a gap in the sequence is a loss.
    pub(super) gaps_are_loss: bool,
    /// Time since it was published.
    pub(super) age: Duration,
    /// How long it is of use, as its publisher says; zero = for ever.
    pub(super) lifespan: Duration,
}

/// Judges messages in the order of their arrival.
pub(super) struct Intake {
    /// Never delivers faster than this, if given.
    spacing: Option<Spacing>,
    /// The subscription's own lifespan; zero = none.
    lifespan: Duration,
    writers: LruCache<WriterId, Window>,
}

impl Intake {
    /// `max_rate_hz` must be a positive number, if given.
    pub(super) fn new(max_rate_hz: Option<f64>, lifespan: Duration) -> Self {
        Self { spacing: max_rate_hz.map(Spacing::new), lifespan, writers: LruCache::unbounded() }
    }

    /// Whether the message is for the callback; counts why not.
    pub(super) fn accept(&mut self, arrival: &Arrival, now: Instant, counters: &Counters) -> bool {
        if !self.is_new(arrival, counters) {
            return false;
        }
        if is_expired(arrival.age, arrival.lifespan, self.lifespan) {
            counters.expired.add(1);
            return false;
        }
        if self.spacing.as_mut().is_some_and(|spacing| !spacing.admits(now)) {
            counters.skipped.add(1);
            return false;
        }
        true
    }

    fn is_new(&mut self, arrival: &Arrival, counters: &Counters) -> bool {
        let Some((writer, sequence)) = arrival.identity else {
            return true;
        };
        let Some(window) = self.writers.get_mut(&writer) else {
            self.writers.put(writer, Window::starting_with(sequence));
            if self.writers.len() > MAX_WRITERS {
                self.writers.pop_lru();
            }
            return true;
        };
        let seen = window.note(sequence);
        match seen {
            Seen::Next { missing } if arrival.gaps_are_loss => counters.lost.add(missing),
            Seen::Next { .. } => {}
            Seen::Late { was_missing } => {
                counters.reordered.add(1);
                if was_missing && arrival.gaps_are_loss {
                    counters.lost.take_back(1);
                }
            }
            Seen::Before => counters.duplicated.add(1),
        }
        seen != Seen::Before
    }
}

/// Whether a message is older than the publisher's or the subscription's lifespan; zero = none.
pub(super) fn is_expired(age: Duration, of_publisher: Duration, of_subscription: Duration) -> bool {
    [of_publisher, of_subscription].iter().any(|lifespan| !lifespan.is_zero() && age > *lifespan)
}

/// Lets messages through at a rate at most, evenly; half a period early is early enough, so that a
/// stream of just that rate is not thinned because it jitters.
struct Spacing {
    period: Duration,
    next: Option<Instant>,
}

impl Spacing {
    fn new(max_rate_hz: f64) -> Self {
        let period = Duration::try_from_secs_f64(1.0 / max_rate_hz).unwrap_or(Duration::MAX);
        Self { period, next: None }
    }

    fn admits(&mut self, now: Instant) -> bool {
        if let Some(next) = self.next
            && now + self.period / 2 < next
        {
            return false;
        }
        let base = self.next.map_or(now, |next| next.max(now));
        // A period beyond what the clock can tell: one message is all there will be.
        self.next = base.checked_add(self.period).or(self.next);
        true
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Seen {
    /// Above all so far; so many are missing between.
    Next { missing: u64 },
    /// Below the highest, for the first time.
    Late { was_missing: bool },
    /// Seen before, or too far below to know.
    Before,
}

/// Which sequences of one writer were seen.
struct Window {
    first: u64,
    highest: u64,
    /// One bit for each of the last [`WINDOW`] sequences, at its remainder.
    bits: [u64; (WINDOW / 64) as usize],
}

impl Window {
    fn starting_with(sequence: u64) -> Self {
        let mut window =
            Self { first: sequence, highest: sequence, bits: [0; (WINDOW / 64) as usize] };
        window.set(sequence);
        window
    }

    fn note(&mut self, sequence: u64) -> Seen {
        if sequence > self.highest {
            let missing = sequence - self.highest - 1;
            if missing >= WINDOW {
                self.bits.fill(0);
            } else {
                (self.highest + 1..sequence).for_each(|between| self.clear(between));
            }
            self.highest = sequence;
            self.set(sequence);
            return Seen::Next { missing };
        }
        if self.highest - sequence >= WINDOW || self.has(sequence) {
            return Seen::Before;
        }
        self.set(sequence);
        Seen::Late { was_missing: sequence > self.first }
    }

    fn place(sequence: u64) -> (usize, u64) {
        let bit = sequence % WINDOW;
        ((bit / 64) as usize, 1 << (bit % 64))
    }

    fn has(&self, sequence: u64) -> bool {
        let (word, mask) = Self::place(sequence);
        self.bits[word] & mask != 0
    }

    fn set(&mut self, sequence: u64) {
        let (word, mask) = Self::place(sequence);
        self.bits[word] |= mask;
    }

    fn clear(&mut self, sequence: u64) {
        let (word, mask) = Self::place(sequence);
        self.bits[word] &= !mask;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arrival(sequence: u64) -> Arrival {
        Arrival {
            identity: Some((WriterId([1; 16]), sequence)),
            gaps_are_loss: true,
            age: Duration::ZERO,
            lifespan: Duration::ZERO,
        }
    }

    fn plain() -> Intake {
        Intake::new(None, Duration::ZERO)
    }

    #[test]
    fn repeats_are_left_out_and_gaps_counted() {
        let (mut intake, counters, now) = (plain(), Counters::default(), Instant::now());
        let accepted: Vec<u64> = [10, 11, 11, 14, 12, 12, 9, 9, 15]
            .into_iter()
            .filter(|sequence| intake.accept(&arrival(*sequence), now, &counters))
            .collect();
        assert_eq!(accepted, [10, 11, 14, 12, 9, 15]);
        let stats = counters.read();
        // Missing is 13 alone: 12 came late, 9 is before the first.
        assert_eq!((stats.lost, stats.duplicated, stats.reordered), (1, 3, 2));
    }

    #[test]
    fn the_window_forgets_what_is_far_below() {
        let (mut intake, counters, now) = (plain(), Counters::default(), Instant::now());
        assert!(intake.accept(&arrival(1), now, &counters));
        assert!(intake.accept(&arrival(5_000), now, &counters));
        assert!(!intake.accept(&arrival(5_000 - WINDOW), now, &counters), "too far below");
        assert!(intake.accept(&arrival(5_000 - WINDOW + 1), now, &counters));
        assert!(intake.accept(&arrival(5_000 + WINDOW - 1), now, &counters));
        assert!(!intake.accept(&arrival(5_000), now, &counters), "still in the window");
        let stats = counters.read();
        assert_eq!(stats.lost, 4_998 - 1 + WINDOW - 2);
        assert!(intake.accept(&arrival(u64::MAX), now, &counters));
    }

    #[test]
    fn gaps_of_positions_on_a_server_are_no_loss() {
        let (mut intake, counters, now) = (plain(), Counters::default(), Instant::now());
        for sequence in [1, 100, 50] {
            let arrival = Arrival { gaps_are_loss: false, ..arrival(sequence) };
            assert!(intake.accept(&arrival, now, &counters));
        }
        assert_eq!(counters.read().lost, 0);
    }

    fn admitted(max_rate_hz: f64, arrivals_ms: impl Iterator<Item = u64>) -> Vec<u64> {
        let (mut intake, counters, start) =
            (Intake::new(Some(max_rate_hz), Duration::ZERO), Counters::default(), Instant::now());
        let arrival = Arrival { identity: None, ..arrival(1) };
        arrivals_ms
            .filter(|ms| intake.accept(&arrival, start + Duration::from_millis(*ms), &counters))
            .collect()
    }

    #[test]
    fn thins_to_the_rate_asked_for() {
        let through = admitted(10.0, (0..10_000).step_by(20));
        assert!((99..=101).contains(&through.len()), "{}", through.len());
        assert!(through.windows(2).skip(1).all(|pair| pair[1] - pair[0] == 100), "{through:?}");
        // 30 Hz to 20 Hz: the average is kept though the periods do not fit.
        let through = admitted(20.0, (0..300).map(|n| n * 1_000 / 30));
        assert!((199..=202).contains(&through.len()), "{}", through.len());
        // A burst does not use up the future.
        let through = admitted(10.0, (0..50).chain([1_000, 1_100, 1_200]));
        assert_eq!(through.len(), 4 + usize::from(through.contains(&49)), "{through:?}");
    }

    #[test]
    fn a_jittering_stream_of_just_that_rate_is_not_thinned() {
        let jitter = [0, 30, 10, 40, 5, 25];
        let arrivals = (0..600).map(|n| n * 100 + jitter[usize::try_from(n % 6).unwrap()]);
        assert_eq!(admitted(10.0, arrivals).len(), 600);
    }

    #[test]
    fn old_messages_are_left_out_but_are_no_loss() {
        let (counters, now) = (Counters::default(), Instant::now());
        let mut intake = Intake::new(None, Duration::from_millis(100));
        let with = |sequence, age_ms, lifespan_ms| Arrival {
            age: Duration::from_millis(age_ms),
            lifespan: Duration::from_millis(lifespan_ms),
            ..arrival(sequence)
        };
        assert!(intake.accept(&with(1, 100, 0), now, &counters));
        assert!(!intake.accept(&with(2, 101, 0), now, &counters), "the subscription's lifespan");
        assert!(!intake.accept(&with(3, 51, 50), now, &counters), "the publisher's lifespan");
        assert!(intake.accept(&with(4, 50, 50), now, &counters));
        let stats = counters.read();
        assert_eq!((stats.expired, stats.lost), (2, 0));
    }

    #[test]
    fn many_writers_stay_bounded() {
        let (mut intake, counters, now) = (plain(), Counters::default(), Instant::now());
        for number in 0..MAX_WRITERS + 10 {
            let mut writer = [0; 16];
            writer[..8].copy_from_slice(&number.to_le_bytes());
            let arrival = Arrival { identity: Some((WriterId(writer), 1)), ..arrival(1) };
            assert!(intake.accept(&arrival, now, &counters));
        }
        assert_eq!(intake.writers.len(), MAX_WRITERS);
    }
}
