//! Whether a history of one register can be explained: by an order of its operations in which each
//! answer is right, and no operation stands before one that had been answered when it began
//! (Herlihy, Wing). The search is that of Wing and Gong; what was tried in vain is remembered
//! (Lowe), and its length is bounded.

use std::collections::HashSet;

use super::register::{Content, Event, Outcome};

/// What the search found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// There is such an order.
    Linearizable,
    /// There is none.
    Impossible,
    /// The search was given up.
    TooLong,
}

/// Which operations have been placed, and the state after them: the future depends on nothing else.
type Position = (Vec<u64>, Option<Content>);

/// Searches an order, and looks at no more than `limit` positions. The register is absent at first.
pub(crate) fn check(history: &[Event], limit: usize) -> Verdict {
    let mut events = history.to_vec();
    events.sort_unstable_by_key(|event| event.begin);
    let start: Position = (vec![0; events.len().div_ceil(64)], None);
    let mut seen = HashSet::from([start.clone()]);
    let mut open = vec![start];
    while let Some((placed, state)) = open.pop() {
        // Nothing that began after this answer may stand before it.
        let Some(bound) = first_answer(&events, &placed) else {
            return Verdict::Linearizable;
        };
        // The last one pushed is looked at first: the one that began first.
        let candidates = events.iter().enumerate().take_while(|(_, event)| event.begin <= bound);
        let candidates: Vec<(usize, &Event)> =
            candidates.filter(|(index, _)| !has(&placed, *index)).collect();
        for (index, event) in candidates.into_iter().rev() {
            let Some(after) = event.on(state) else { continue };
            let mut next = placed.clone();
            next[index / 64] |= 1 << (index % 64);
            let position = (next, after);
            if seen.contains(&position) {
                continue;
            }
            if seen.len() >= limit {
                return Verdict::TooLong;
            }
            seen.insert(position.clone());
            open.push(position);
        }
    }
    Verdict::Impossible
}

/// When the first of the operations that must still be placed was answered; `None` when all are.
/// What is unknown need not be placed: then it never took effect.
fn first_answer(events: &[Event], placed: &[u64]) -> Option<u64> {
    let left = events
        .iter()
        .enumerate()
        .filter(|(index, event)| event.outcome != Outcome::Unknown && !has(placed, *index));
    left.map(|(_, event)| event.end).min()
}

fn has(placed: &[u64], index: usize) -> bool {
    placed[index / 64] & (1 << (index % 64)) != 0
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::register::Op;
    use super::*;

    const LIMIT: usize = 100_000;

    fn event(begin: u64, end: u64, op: Op, outcome: Outcome) -> Event {
        Event { op, outcome, begin, end }
    }

    fn unknown(begin: u64, op: Op) -> Event {
        event(begin, u64::MAX, op, Outcome::Unknown)
    }

    fn verdict(history: &[Event]) -> Verdict {
        check(history, LIMIT)
    }

    #[test]
    fn one_after_another_is_fine() {
        let history = [
            event(1, 2, Op::Get, Outcome::Found(None)),
            event(3, 4, Op::Create(1), Outcome::Done),
            event(5, 6, Op::Create(2), Outcome::Refused),
            event(7, 8, Op::Swap { seen: 1, new: 3 }, Outcome::Done),
            event(9, 10, Op::Swap { seen: 1, new: 4 }, Outcome::Refused),
            event(11, 12, Op::Get, Outcome::Found(Some(3))),
            event(13, 14, Op::Delete { seen: Some(3) }, Outcome::Done),
            event(15, 16, Op::Delete { seen: None }, Outcome::Refused),
            event(17, 18, Op::Get, Outcome::Found(None)),
        ];
        assert_eq!(verdict(&history), Verdict::Linearizable);
        assert_eq!(verdict(&[]), Verdict::Linearizable);
    }

    #[test]
    fn a_stale_read_is_rejected() {
        let history = [
            event(1, 2, Op::Create(1), Outcome::Done),
            event(3, 4, Op::Swap { seen: 1, new: 2 }, Outcome::Done),
            event(5, 6, Op::Get, Outcome::Found(Some(1))),
        ];
        assert_eq!(verdict(&history), Verdict::Impossible);
    }

    #[test]
    fn a_read_that_overlaps_may_see_either() {
        for found in [1, 2] {
            let history = [
                event(1, 2, Op::Create(1), Outcome::Done),
                event(3, 6, Op::Swap { seen: 1, new: 2 }, Outcome::Done),
                event(4, 5, Op::Get, Outcome::Found(Some(found))),
            ];
            assert_eq!(verdict(&history), Verdict::Linearizable, "{found}");
        }
    }

    #[test]
    fn two_swaps_of_the_same_cannot_both_be_done() {
        let history = [
            event(1, 2, Op::Create(1), Outcome::Done),
            event(3, 6, Op::Swap { seen: 1, new: 2 }, Outcome::Done),
            event(4, 5, Op::Swap { seen: 1, new: 3 }, Outcome::Done),
        ];
        assert_eq!(verdict(&history), Verdict::Impossible);
    }

    #[test]
    fn what_was_seen_does_not_go_back() {
        let history = [
            event(1, 2, Op::Create(1), Outcome::Done),
            event(3, 10, Op::Swap { seen: 1, new: 2 }, Outcome::Done),
            event(4, 5, Op::Get, Outcome::Found(Some(2))),
            event(6, 7, Op::Get, Outcome::Found(Some(1))),
        ];
        assert_eq!(verdict(&history), Verdict::Impossible);
    }

    #[test]
    fn a_lost_write_is_rejected() {
        let history =
            [event(1, 2, Op::Create(1), Outcome::Done), event(3, 4, Op::Get, Outcome::Found(None))];
        assert_eq!(verdict(&history), Verdict::Impossible);
    }

    #[test]
    fn unknown_is_yes_or_no_and_never_both() {
        let swap = unknown(3, Op::Swap { seen: 1, new: 2 });
        let create = event(1, 2, Op::Create(1), Outcome::Done);
        let found = |time, content| event(time, time + 1, Op::Get, Outcome::Found(Some(content)));
        assert_eq!(verdict(&[create, swap, found(5, 1), found(7, 1)]), Verdict::Linearizable);
        assert_eq!(verdict(&[create, swap, found(5, 2), found(7, 2)]), Verdict::Linearizable);
        // Late, but it did.
        assert_eq!(verdict(&[create, swap, found(5, 1), found(7, 2)]), Verdict::Linearizable);
        assert_eq!(verdict(&[create, swap, found(5, 2), found(7, 1)]), Verdict::Impossible);
        assert_eq!(verdict(&[create, unknown(9, Op::Create(7)), found(5, 7)]), Verdict::Impossible);
    }

    #[test]
    fn nothing_is_read_that_nobody_wrote() {
        let history = [event(1, 2, Op::Get, Outcome::Found(Some(9)))];
        assert_eq!(verdict(&history), Verdict::Impossible);
    }

    #[test]
    fn the_search_ends() {
        let create = event(0, 1, Op::Create(0), Outcome::Done);
        let reads = (0..100).map(|begin| event(2 + begin, 1000, Op::Get, Outcome::Found(Some(0))));
        let history: Vec<Event> = std::iter::once(create)
            .chain(reads)
            .chain([event(1001, 1002, Op::Get, Outcome::Found(Some(1)))])
            .collect();
        assert_eq!(check(&history, 1000), Verdict::TooLong);
    }

    /// A history of a real register: operations take effect in order at points within their times.
    fn real() -> impl Strategy<Value = Vec<Event>> {
        let one = (0_u8..4, 0_u32..4, 0_u64..30, 0_u64..30, any::<bool>());
        proptest::collection::vec(one, 1..40).prop_map(|steps| {
            let mut state = None;
            let mut events = Vec::new();
            for (index, (kind, guess, before, after, lost)) in steps.into_iter().enumerate() {
                let point = 100 + index as u64 * 10;
                let new = 10 + index as u32;
                let seen = if guess == 0 { state.unwrap_or(1) } else { guess };
                let op = match kind {
                    0 => Op::Create(new),
                    1 => Op::Get,
                    2 => Op::Swap { seen, new },
                    _ => Op::Delete { seen: (guess > 1).then_some(seen) },
                };
                let done =
                    Event { op, outcome: Outcome::Done, begin: point - before, end: point + after };
                let event = match op {
                    Op::Get => Event { outcome: Outcome::Found(state), ..done },
                    Op::Create(_) | Op::Swap { .. } | Op::Delete { .. } => match done.on(state) {
                        Some(next) => {
                            state = next;
                            let unknown =
                                Event { outcome: Outcome::Unknown, end: u64::MAX, ..done };
                            if lost && guess == 3 { unknown } else { done }
                        }
                        None => Event { outcome: Outcome::Refused, ..done },
                    },
                };
                events.push(event);
            }
            events
        })
    }

    proptest! {
        #[test]
        fn a_real_register_is_accepted(history in real()) {
            prop_assert_eq!(verdict(&history), Verdict::Linearizable);
        }

        #[test]
        fn a_read_of_what_was_overwritten_before_is_rejected(mut history in real()) {
            let latest = history.iter().map(|event| event.begin).max().unwrap_or(0) + 100;
            let end = if latest < 10_000 { 10_000 } else { latest };
            history.push(event(end, end + 1, Op::Create(1_000_000), Outcome::Refused));
            history.push(event(end + 2, end + 3, Op::Delete { seen: None }, Outcome::Done));
            history.push(event(end + 4, end + 5, Op::Get, Outcome::Found(Some(1_000_000))));
            prop_assert_eq!(verdict(&history), Verdict::Impossible);
        }
    }
}
