//! What a late joiner begins with: the last `depth` frames of each writer, as their headers say.
//!
//! RustDDS forgets what is beyond a writer's depth only every six seconds, so a late joiner may be
//! given more. What it is given is held until a live sample of the same writer comes, or nothing
//! more for a moment. Its age is told then: of a participant that sends signs of life one is waited
//! for, and of a plain DDS program, whose clock nobody knows, it is what it is at least, beside the
//! youngest.

use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use super::presence::Clock;
use super::seen::Moment;
use crate::dds::EndpointId;
use crate::port::{Content, Received};

/// After such a pause a writer has given all that it keeps.
pub(super) const QUIET: Duration = Duration::from_millis(150);
/// What a writer keeps is held no longer than this. Four signs of life come meanwhile.
pub(super) const LONGEST: Duration = Duration::from_secs(2);
/// Writers that are held at once, and frames of each; beyond that they are delivered as they come.
const MAX_WRITERS: usize = 1024;
const MAX_FRAMES: usize = 1024;

struct Held {
    frames: VecDeque<(Received, Moment)>,
    since: Instant,
    newest: Instant,
}

impl Held {
    /// Its frames with their ages. `behind_ns`: how far the writer's clock is behind, where that is
    /// known.
    fn aged(self, behind_ns: Option<i128>) -> impl Iterator<Item = Received> {
        let least_ns = self.frames.iter().map(|(_, moment)| moment.lag_ns()).min();
        let behind_ns = behind_ns.or(least_ns).unwrap_or(0);
        self.frames.into_iter().map(move |(mut received, moment)| {
            received.broker_age_us = received.broker_age_us.max(moment.age_us(behind_ns));
            received
        })
    }
}

/// History that a channel has received and not delivered yet.
#[derive(Default)]
pub(super) struct History {
    writers: HashMap<EndpointId, Held>,
}

impl History {
    pub(super) fn is_empty(&self) -> bool {
        self.writers.is_empty()
    }

    /// Takes a frame that was written before the channel was read. Returns those that are not held.
    pub(super) fn hold(
        &mut self,
        now: Instant,
        writer: EndpointId,
        mut received: Received,
        moment: Moment,
    ) -> Option<Received> {
        if self.writers.len() >= MAX_WRITERS && !self.writers.contains_key(&writer) {
            let behind_ns = moment.clock.behind_ns().unwrap_or(moment.lag_ns());
            received.broker_age_us = received.broker_age_us.max(moment.age_us(behind_ns));
            return Some(received);
        }
        let depth = match &received.content {
            Content::Frame(frame) if frame.depth() > 0 => {
                usize::try_from(frame.depth()).unwrap_or(MAX_FRAMES)
            }
            // It does not say how many: all that come.
            _ => MAX_FRAMES,
        };
        let held = self.writers.entry(writer).or_insert_with(|| Held {
            frames: VecDeque::new(),
            since: now,
            newest: now,
        });
        held.newest = now;
        held.frames.push_back((received, moment));
        while held.frames.len() > depth.min(MAX_FRAMES) {
            held.frames.pop_front();
        }
        None
    }

    /// What a writer gave, before a live sample of it. `behind_ns`: how far its clock is behind,
    /// where that is known.
    pub(super) fn of_writer(
        &mut self,
        writer: EndpointId,
        behind_ns: Option<i128>,
    ) -> Vec<Received> {
        let held = self.writers.remove(&writer);
        held.into_iter().flat_map(|held| held.aged(behind_ns)).collect()
    }

    /// What writers gave that give nothing more, or that have been giving for long.
    pub(super) fn quiet(
        &mut self,
        now: Instant,
        clock: impl Fn(EndpointId) -> Clock,
    ) -> Vec<Received> {
        let passed = |at: Instant| now.saturating_duration_since(at);
        let is_quiet = |writer: &EndpointId, held: &mut Held| {
            passed(held.since) >= LONGEST
                || (passed(held.newest) >= QUIET && clock(*writer) != Clock::Awaited)
        };
        let quiet = self.writers.extract_if(is_quiet);
        quiet.flat_map(|(writer, held)| held.aged(clock(writer).behind_ns())).collect()
    }
}

#[cfg(test)]
mod tests {
    use blaze_domain::{Origin, WriterId};
    use blaze_proto::{Frame, Header};
    use bytes::Bytes;

    use super::*;

    fn received(at: Instant, sequence: u64, depth: u32) -> Received {
        let header =
            Header { depth, ..Header::new("t", Origin::default(), WriterId([1; 16]), sequence, 0) };
        Received::live(Content::Frame(Frame::new(&header, Bytes::new()).unwrap()), at)
    }

    /// Written and received at these times in milliseconds, and taken as it was received.
    fn moment(written_ms: i128, received_ms: i128, clock: Clock) -> Moment {
        Moment {
            written_ns: written_ms * 1_000_000,
            received_ns: received_ms * 1_000_000,
            taken_ns: received_ms * 1_000_000,
            clock,
        }
    }

    const KNOWN: Clock = Clock::Behind(0);

    fn sequences(received: impl IntoIterator<Item = Received>) -> Vec<u64> {
        let sequence = |received: Received| match received.content {
            Content::Frame(frame) => frame.sequence(),
            other => panic!("{other:?}"),
        };
        received.into_iter().map(sequence).collect()
    }

    fn ages_ms(received: &[Received]) -> Vec<u64> {
        received.iter().map(|received| received.broker_age_us / 1_000).collect()
    }

    #[test]
    fn the_last_of_each_writer_stay_until_it_is_quiet_or_live() {
        let now = Instant::now();
        let at = moment(0, 0, KNOWN);
        let mut history = History::default();
        for sequence in 1..=5 {
            assert!(history.hold(now, [1; 16], received(now, sequence, 2), at).is_none());
            assert!(history.hold(now, [2; 16], received(now, sequence, 0), at).is_none());
        }
        assert_eq!(sequences(history.of_writer([1; 16], None)), [4, 5]);
        assert!(sequences(history.of_writer([1; 16], None)).is_empty());
        assert!(sequences(history.quiet(now, |_| KNOWN)).is_empty());
        assert_eq!(sequences(history.quiet(now + QUIET, |_| KNOWN)), [1, 2, 3, 4, 5]);
        assert!(history.is_empty());
    }

    #[test]
    fn a_writer_that_never_pauses_is_not_held_for_ever() {
        let now = Instant::now();
        let mut history = History::default();
        let mut found = Vec::new();
        let periods = u32::try_from(LONGEST.as_millis() / 50).unwrap();
        for number in 0..=periods {
            let at = now + Duration::from_millis(50) * number;
            let frame = received(at, u64::from(number) + 1, 0);
            assert!(history.hold(at, [1; 16], frame, moment(0, 0, Clock::Unknown)).is_none());
            assert!(found.is_empty(), "{number}");
            found = sequences(history.quiet(at, |_| Clock::Unknown));
        }
        assert_eq!(found.len() as u32, periods + 1);
    }

    #[test]
    fn ages_are_those_of_the_clocks_or_the_least_that_they_can_be() {
        const HOUR: i128 = 3_600_000;
        let now = Instant::now();
        let hold = |history: &mut History, clock| {
            for (sequence, written) in [(1, 1_000), (2, 4_000)] {
                let at = moment(written - HOUR, 9_000, clock);
                assert!(history.hold(now, [1; 16], received(now, sequence, 2), at).is_none());
            }
        };
        let mut history = History::default();
        hold(&mut history, Clock::Unknown);
        assert_eq!(ages_ms(&history.quiet(now + QUIET, |_| Clock::Unknown)), [3_000, 0]);
        hold(&mut history, Clock::Unknown);
        let live = moment(9_500 - HOUR, 9_501, Clock::Unknown);
        assert_eq!(ages_ms(&history.of_writer([1; 16], Some(live.lag_ns()))), [7_999, 4_999]);
        hold(&mut history, Clock::Awaited);
        assert!(history.quiet(now + QUIET, |_| Clock::Awaited).is_empty());
        let sign = Clock::Behind(HOUR * 1_000_000);
        assert_eq!(ages_ms(&history.quiet(now + QUIET, |_| sign)), [8_000, 5_000]);
        hold(&mut history, Clock::Awaited);
        assert_eq!(ages_ms(&history.quiet(now + LONGEST, |_| Clock::Awaited)), [3_000, 0]);
    }

    #[test]
    fn an_age_that_is_known_does_not_count_twice() {
        let now = Instant::now();
        let mut history = History::default();
        for (sequence, known_ms) in [(1, 2_000), (2, 9_000)] {
            let known = Received { broker_age_us: known_ms * 1_000, ..received(now, sequence, 2) };
            assert!(history.hold(now, [1; 16], known, moment(1_000, 6_000, KNOWN)).is_none());
        }
        assert_eq!(ages_ms(&history.quiet(now + QUIET, |_| KNOWN)), [5_000, 9_000]);
    }

    #[test]
    fn a_crowd_of_writers_is_not_held() {
        let now = Instant::now();
        let at = moment(0, 0, KNOWN);
        let mut history = History::default();
        for number in 0..MAX_WRITERS {
            let mut id = [0; 16];
            id[..8].copy_from_slice(&number.to_le_bytes());
            assert!(history.hold(now, id, received(now, 1, 1), at).is_none());
        }
        assert!(history.hold(now, [0xff; 16], received(now, 1, 1), at).is_some());
    }
}
