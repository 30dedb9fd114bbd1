//! How far a channel has come with one writer: what it had, what is missing, and where that begins
//! which is written now.
//!
//! A plain DDS program sends no signs of life, so its clock is not known, and the time of writing
//! alone does not tell what it kept for late joiners from what it writes now. But what is kept
//! comes in one go: its times of writing run ahead of those of its arrival. Once both run alike, or
//! nothing came for a moment, it is written as it comes.

use std::time::Duration;

use super::kept::{LONGEST, QUIET};
use super::presence::Clock;

/// How much older than the subscription a sample may seem and count as live, since clocks are
/// compared over the network; and by how much samples must catch up to count as kept.
const SLACK: Duration = Duration::from_millis(20);

/// Nanoseconds.
fn ns(duration: Duration) -> i128 {
    i128::try_from(duration.as_nanos()).unwrap_or(i128::MAX)
}

/// When a sample that its writer keeps for late joiners was written, came, and was taken;
/// nanoseconds since 1970.
#[derive(Debug, Clone, Copy)]
pub(super) struct Moment {
    /// By the clock of its writer.
    pub(super) written_ns: i128,
    /// By ours, as the next: when RustDDS received it, for whichever reader of the topic.
    pub(super) received_ns: i128,
    pub(super) taken_ns: i128,
    pub(super) clock: Clock,
}

impl Moment {
    /// From writing to arrival, by two clocks.
    pub(super) fn lag_ns(self) -> i128 {
        self.received_ns - self.written_ns
    }

    /// Its age when it was taken, if its writer's clock is so far behind ours.
    pub(super) fn age_us(self, behind_ns: i128) -> u64 {
        let age_ns = self.taken_ns - self.written_ns - behind_ns;
        u64::try_from(age_ns.max(0) / 1_000).unwrap_or(u64::MAX)
    }

    /// Whether it was written before the channel was read. Where the clock is not known it is taken
    /// at its word when it says that it was not; else `seen` tells.
    pub(super) fn is_old(self, opened_ns: i128, own: bool, seen: &mut Seen) -> bool {
        let slack = if own { 0 } else { ns(SLACK) };
        if let Some(behind_ns) = self.clock.behind_ns() {
            return self.written_ns + behind_ns + slack < opened_ns;
        }
        let may_be_kept = seen.may_be_kept(self.received_ns, self.written_ns);
        let seems_new = self.written_ns + slack >= opened_ns && self.lag_ns() >= -slack;
        self.received_ns < opened_ns || (may_be_kept && !seems_new)
    }
}

/// What a channel has seen of a writer.
#[derive(Debug, Default)]
pub(super) struct Seen {
    last: Option<i64>,
    /// The last one came since the channel is read, so what is missing behind it is lost.
    since_opened: bool,
    phase: Phase,
}

#[derive(Debug, Default)]
enum Phase {
    #[default]
    New,
    /// It may still give what it keeps.
    Begins(Beginning),
    /// What comes is written now.
    Goes,
}

#[derive(Debug)]
struct Beginning {
    /// When its first and its newest sample came.
    first_ns: i128,
    newest_ns: i128,
    /// The least time from writing to arrival, by two clocks, and when it last became less.
    least_lag_ns: i128,
    fell_ns: i128,
}

impl Seen {
    /// Takes a sample. `None`: the channel had it. Else how many of this writer, between the last
    /// one and this, never came.
    pub(super) fn take(&mut self, sequence: i64, since_opened: bool) -> Option<u64> {
        let missing = match self.last {
            Some(last) if sequence <= last => return None,
            Some(last) if self.since_opened => sequence.saturating_sub(last).saturating_sub(1),
            // RustDDS may hold samples of readers before, and of a late joiner's writer what came
            // before is not known.
            _ => 0,
        };
        self.last = Some(sequence);
        self.since_opened = since_opened;
        Some(u64::try_from(missing).unwrap_or(0))
    }

    /// Takes the times of a sample whose writer's clock is not known. Returns whether it may be one
    /// that was kept.
    pub(super) fn may_be_kept(&mut self, received_ns: i128, written_ns: i128) -> bool {
        let lag_ns = received_ns - written_ns;
        let beginning = match &mut self.phase {
            Phase::Goes => return false,
            Phase::New => {
                self.phase = Phase::Begins(Beginning {
                    first_ns: received_ns,
                    newest_ns: received_ns,
                    least_lag_ns: lag_ns,
                    fell_ns: received_ns,
                });
                return true;
            }
            Phase::Begins(beginning) => beginning,
        };
        let passed = |since_ns: i128, time: Duration| received_ns - since_ns >= ns(time);
        if lag_ns + ns(SLACK) < beginning.least_lag_ns {
            beginning.least_lag_ns = lag_ns;
            beginning.fell_ns = received_ns;
        }
        // What is written now came in the shortest time of all; what was kept and had to be
        // repaired did not.
        let came_at_once = lag_ns <= beginning.least_lag_ns + ns(SLACK);
        let goes = passed(beginning.newest_ns, QUIET) || passed(beginning.fell_ns, QUIET);
        // Our own clock may be set back meanwhile.
        let is_over =
            passed(beginning.first_ns, LONGEST) || received_ns + ns(LONGEST) < beginning.first_ns;
        let ends = is_over || (came_at_once && goes);
        beginning.newest_ns = received_ns.max(beginning.newest_ns);
        if ends {
            self.phase = Phase::Goes;
        }
        !ends
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i128 = 1_000_000;
    const HOUR: i128 = 3_600_000 * MS;

    /// Which of the samples of a writer, whose clock is an hour behind, may have been kept: each is
    /// when it was received and really written, in milliseconds.
    fn may_be_kept(samples: impl IntoIterator<Item = (i128, i128)>) -> Vec<bool> {
        let mut seen = Seen::default();
        samples
            .into_iter()
            .map(|(received, written)| seen.may_be_kept(received * MS, written * MS - HOUR))
            .collect()
    }

    #[test]
    fn what_is_missing_is_counted_from_the_first_sample_since_the_channel_is_read() {
        let mut seen = Seen::default();
        assert_eq!(seen.take(500, false), Some(0));
        assert_eq!(seen.take(900, true), Some(0), "what a reader before has left does not count");
        assert_eq!(seen.take(901, true), Some(0));
        assert_eq!(seen.take(901, true), None);
        assert_eq!(seen.take(900, true), None);
        assert_eq!(seen.take(1_000, true), Some(98));
        assert_eq!(seen.take(i64::MAX, true), Some(i64::MAX as u64 - 1_001));
        let mut new = Seen::default();
        assert_eq!(new.take(7, true), Some(0));
        assert_eq!(new.take(9, true), Some(1));
    }

    #[test]
    fn what_comes_in_one_go_is_kept_and_what_comes_after_a_pause_is_not() {
        // Ten of the last seconds at once, then one that is written two seconds later.
        let kept = (0..10).map(|number| (10_000 + number, 1_000 * number));
        let found = may_be_kept(kept.chain([(12_000, 11_999), (12_010, 12_009)]));
        assert_eq!(found[..10], [true; 10]);
        assert_eq!(found[10..], [false, false]);
    }

    #[test]
    fn what_is_kept_may_take_longer_than_a_moment() {
        // A hundred of the last ten seconds come within one; what is written meanwhile follows at
        // 20 Hz.
        let kept = (0..100).map(|number| (10_000 + 10 * number, 100 * number));
        let live = (0..20).map(|number| (11_000 + 50 * number, 11_000 + 50 * number));
        let found = may_be_kept(kept.chain(live));
        assert!(found[..100].iter().all(|kept| *kept), "{found:?}");
        assert!(found[104..].iter().all(|kept| !*kept), "{found:?}");
    }

    #[test]
    fn what_is_kept_and_had_to_be_repaired_is_no_less_old() {
        // Ten of the last second at once, but one of them a second later. It is delivered in its
        // turn.
        let received = |number: i128| if number == 3 { 11_000 } else { 10_000 + number };
        let found = may_be_kept((0..10).map(|number| (received(number), 100 * number)));
        assert_eq!(found, [true; 10]);
    }

    #[test]
    fn it_ends_though_a_clock_runs_ahead_or_ours_is_set_back() {
        // The writer's clock is twice as fast.
        let found = may_be_kept((0..400).map(|number| (10 * number, 20 * number)));
        let longest = usize::try_from(LONGEST.as_millis() / 10).unwrap();
        assert_eq!(found.iter().filter(|kept| **kept).count(), longest);
        let back = may_be_kept([(7_200_000, 0), (7_200_010, 10), (0, 20), (10, 30)]);
        assert_eq!(back, [true, true, false, false]);
    }

    fn moment(written_ms: i128, received_ms: i128, clock: Clock) -> Moment {
        Moment {
            written_ns: written_ms * MS,
            received_ns: received_ms * MS,
            taken_ns: received_ms * MS,
            clock,
        }
    }

    /// Whether each is old for a channel that is read since the tenth second.
    fn are_old(moments: impl IntoIterator<Item = Moment>) -> Vec<bool> {
        let mut seen = Seen::default();
        let is_old = |moment: Moment| moment.is_old(10_000 * MS, false, &mut seen);
        moments.into_iter().map(is_old).collect()
    }

    #[test]
    fn a_known_clock_tells_what_was_written_before() {
        let clock = Clock::Behind(3_600_000 * MS);
        let found = are_old(
            [(9_900, 11_000), (10_000, 11_001), (10_990, 11_010)]
                .map(|(written, received)| moment(written - 3_600_000, received, clock)),
        );
        assert_eq!(found, [true, false, false]);
        let mut seen = Seen::default();
        let own = moment(9_999, 10_001, Clock::Behind(0));
        assert!(own.is_old(10_000 * MS, true, &mut seen));
        assert!(!own.is_old(10_000 * MS, false, &mut seen), "clocks are compared over the network");
    }

    #[test]
    fn a_plain_program_whose_clock_is_behind_is_not_old_for_ever() {
        let hour = 3_600_000;
        let stream = (0..100).map(|number| {
            moment(11_000 + 20 * number - hour, 11_000 + 20 * number, Clock::Unknown)
        });
        let found = are_old(stream);
        assert!(found[..8].iter().all(|old| *old), "it may be what was kept: {found:?}");
        assert!(found[8..].iter().all(|old| !*old), "{found:?}");
    }

    #[test]
    fn a_plain_program_whose_clock_is_right_is_live_at_once() {
        let kept = (0..10).map(|number| moment(1_000 * number, 11_000 + number, Clock::Unknown));
        let live = (0..10).map(|number| moment(11_010 + number, 11_010 + number, Clock::Awaited));
        let found = are_old(kept.chain(live));
        assert_eq!(found, [[true; 10], [false; 10]].concat());
    }

    #[test]
    fn a_clock_that_is_ahead_is_not_taken_at_its_word() {
        let hour = 3_600_000;
        let found = are_old([
            moment(9_000 + hour, 11_000, Clock::Unknown),
            moment(15_000 + hour, 15_000, Clock::Unknown),
        ]);
        assert_eq!(found, [true, false]);
    }

    #[test]
    fn what_rustdds_held_for_a_reader_before_is_old() {
        let hour = 3_600_000;
        // A stream that another reader got before this one came.
        let found = are_old((0..100).map(|number| {
            let received = 9_000 + 20 * number;
            moment(received + hour, received, Clock::Unknown)
        }));
        assert!(found[..50].iter().all(|old| *old), "{found:?}");
        assert!(found[50..].iter().all(|old| !*old), "{found:?}");
    }

    #[test]
    fn age_is_that_of_the_taking() {
        let late = Moment { taken_ns: 15_000 * MS, ..moment(9_000, 11_000, Clock::Unknown) };
        assert_eq!(late.age_us(0), 6_000_000);
        assert_eq!(late.age_us(late.lag_ns()), 4_000_000);
        assert_eq!(late.age_us(7_000 * MS), 0);
    }
}
