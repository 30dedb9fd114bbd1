//! Who asked lately: those are told of changes although no document names them.

use std::time::{Duration, Instant};

use lru::LruCache;

use super::served_target::ServedTarget;

/// How long who asked is told of changes. A service asks again every 60 s.
pub const ASKED_FOR: Duration = Duration::from_secs(180);
/// Places that are remembered because they asked, at most; who asked longest ago goes first.
pub const MAX_ASKED: usize = 10_000;

/// Places in the order in which they asked last, with the time.
pub(super) struct Asked(LruCache<ServedTarget, Instant>);

impl Default for Asked {
    /// The bound is kept here: a cache with one reserves room for all.
    fn default() -> Self {
        Self(LruCache::unbounded())
    }
}

impl Asked {
    pub(super) fn contains(&self, place: &ServedTarget) -> bool {
        self.0.contains(place)
    }

    /// Notes that a place asked. Gives the one that had to go for it.
    pub(super) fn touch(&mut self, place: &ServedTarget, now: Instant) -> Option<ServedTarget> {
        self.0.put(place.clone(), now);
        if self.0.len() <= MAX_ASKED {
            return None;
        }
        self.0.pop_lru().map(|(oldest, _)| oldest)
    }

    /// Takes out those whose time is over.
    pub(super) fn expire(&mut self, now: Instant) -> Vec<ServedTarget> {
        let mut out = Vec::new();
        let is_over = |asked: &Instant| now.saturating_duration_since(*asked) > ASKED_FOR;
        while self.0.peek_lru().is_some_and(|(_, asked)| is_over(asked)) {
            out.extend(self.0.pop_lru().map(|(place, _)| place));
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(instance: usize) -> ServedTarget {
        ServedTarget {
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
        assert!(asked.0.is_empty());
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
        assert!(asked.contains(&place(0)) && asked.contains(&place(MAX_ASKED)));
    }
}
