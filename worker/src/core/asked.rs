//! Who asked lately: those are told of changes although no document names them.

use std::collections::{BTreeMap, HashMap};
use std::time::{Duration, Instant};

use super::place::Place;

/// How long who asked is told of changes. A service asks again every 60 s.
pub const ASKED_FOR: Duration = Duration::from_secs(180);
/// Places that are remembered because they asked, at most; who asked longest ago goes first.
pub const MAX_ASKED: usize = 10_000;

/// Places in the order in which they asked last.
#[derive(Debug, Default)]
pub(super) struct Asked {
    /// The number of its last request, by place.
    numbers: HashMap<Place, u64>,
    /// The other way round, with the time.
    order: BTreeMap<u64, (Place, Instant)>,
    next: u64,
    /// Places that had to go although their time was not over.
    evicted: u64,
}

impl Asked {
    pub(super) fn contains(&self, place: &Place) -> bool {
        self.numbers.contains_key(place)
    }

    pub(super) fn evicted(&self) -> u64 {
        self.evicted
    }

    /// Notes that a place asked. Gives the one that had to go for it.
    pub(super) fn touch(&mut self, place: &Place, now: Instant) -> Option<Place> {
        let number = self.next;
        self.next += 1;
        if let Some(before) = self.numbers.insert(place.clone(), number) {
            self.order.remove(&before);
        }
        self.order.insert(number, (place.clone(), now));
        if self.numbers.len() <= MAX_ASKED {
            return None;
        }
        let (_, (oldest, _)) = self.order.pop_first()?;
        self.numbers.remove(&oldest);
        self.evicted += 1;
        Some(oldest)
    }

    /// Takes out those whose time is over.
    pub(super) fn expire(&mut self, now: Instant) -> Vec<Place> {
        let mut out = Vec::new();
        while let Some(entry) = self.order.first_entry() {
            if now.saturating_duration_since(entry.get().1) <= ASKED_FOR {
                break;
            }
            let (place, _) = entry.remove();
            self.numbers.remove(&place);
            out.push(place);
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(instance: usize) -> Place {
        Place {
            service: "slam".parse().unwrap(),
            instance: Some(instance.to_string().parse().unwrap()),
            node: None,
        }
    }

    #[test]
    fn who_asks_again_stays_and_the_others_go_when_their_time_is_over() {
        let start = Instant::now();
        let mut asked = Asked::default();
        assert_eq!(asked.touch(&place(0), start), None);
        assert_eq!(asked.touch(&place(1), start), None);
        assert_eq!(asked.touch(&place(0), start + Duration::from_secs(60)), None);
        assert!(asked.expire(start + ASKED_FOR).is_empty());
        assert_eq!(asked.expire(start + Duration::from_secs(181)), [place(1)]);
        assert!(asked.contains(&place(0)) && !asked.contains(&place(1)));
        assert_eq!(asked.expire(start + Duration::from_secs(241)), [place(0)]);
        assert_eq!((asked.evicted(), asked.numbers.len(), asked.order.len()), (0, 0, 0));
    }

    #[test]
    fn too_many_push_out_who_asked_longest_ago() {
        let now = Instant::now();
        let mut asked = Asked::default();
        for number in 0..MAX_ASKED {
            assert_eq!(asked.touch(&place(number), now), None);
        }
        // The first asks again, so that the second is the oldest.
        assert_eq!(asked.touch(&place(0), now), None);
        assert_eq!(asked.touch(&place(MAX_ASKED), now), Some(place(1)));
        assert_eq!(asked.evicted(), 1);
        assert!(asked.contains(&place(0)) && asked.contains(&place(MAX_ASKED)));
    }
}
