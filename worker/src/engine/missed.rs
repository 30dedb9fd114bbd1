//! What places may not have been told because another worker of the layer leads, or none does.
//!
//! ```text
//! notices of a worker that does not tell ─▶ Missed ─ confirmed by the mark beside the lease, and 15 s old ─▶ forgotten
//!                                             └───── this worker begins to tell ─▶ one notice each, of how it is by then
//! ```
//!
//! A roll-out is undone without any commit: a mark of the very state may have been left before, so that only a later one says
//! that it was told ([`Since`]).
//!
//! Of each place only what differs is kept, no configuration: it is the one that counts when it is told.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use tokio::time::Instant;

use crate::core::{Notice, Place, Scope};
use crate::lease::Mark;

/// How long ago a notice may be that a new leader tells once more although it is marked as told: the one before may have
/// died while its broker still had it.
const RECENT: Duration = Duration::from_secs(15);
/// Places that are kept at most; what is beyond is counted and left out, the ones first that were noted the longest ago.
const MAX_PLACES: usize = 20_000;
/// Paths that are kept of one place; beyond, all of its configuration counts as changed.
const MAX_PATHS: usize = 1_000;

/// What a place is to hear follows from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Since {
    /// The state; `None`: none of a main service.
    pub(super) mark: Option<Mark>,
    /// Something was undone in this state, after it may have been marked as told.
    pub(super) is_undone: bool,
}

impl Since {
    fn is_covered_by(&self, told: &Mark) -> bool {
        self.mark.as_ref().is_some_and(|mark| match self.is_undone {
            true => told.covers(mark) && told.revision > mark.revision,
            false => told.covers(mark),
        })
    }
}

/// How a place's configuration differs from what it was told last, as far as this worker knows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Difference {
    pub(super) previous_hash: Option<String>,
    /// `None`: nobody knows.
    pub(super) paths: Option<BTreeSet<String>>,
    pub(super) scopes: BTreeSet<Scope>,
}

impl Difference {
    fn of(notice: &Notice) -> Self {
        Self {
            previous_hash: notice.previous_hash.clone(),
            paths: Some(notice.paths.iter().cloned().collect()),
            scopes: notice.scopes.iter().copied().collect(),
        }
    }

    fn and(&mut self, later: Self) {
        self.paths = match (self.paths.take(), later.paths) {
            (Some(mut paths), Some(more)) => {
                paths.extend(more);
                (paths.len() <= MAX_PATHS).then_some(paths)
            }
            (None, _) | (_, None) => None,
        };
        self.scopes.extend(later.scopes);
    }
}

struct Entry {
    /// In which order it was noted.
    number: u64,
    at: Instant,
    since: Since,
    difference: Difference,
    /// That its service is deleted.
    gone: Option<Notice>,
}

/// What is to be told of one place.
pub(super) struct Left {
    pub(super) place: Place,
    pub(super) difference: Difference,
    pub(super) gone: Option<Notice>,
}

/// Places that may have something to hear.
#[derive(Default)]
pub(super) struct Missed {
    places: BTreeMap<Place, Entry>,
    order: BTreeMap<u64, Place>,
    numbers: u64,
    dropped: u64,
}

impl Missed {
    /// Notes that a place should hear of this.
    pub(super) fn note(&mut self, notice: &Notice, mut since: Since, now: Instant) {
        let mut difference = Difference::of(notice);
        let place = notice.place.clone();
        if let Some(before) = self.remove(&place) {
            let mut whole = before.difference;
            whole.and(difference);
            difference = whole;
            // Whoever leads may have told of the change before it undid the other.
            since.is_undone |= before.since.is_undone;
        }
        let gone = notice.hash.is_none().then(|| notice.clone());
        self.insert(place, now, since, difference, gone);
    }

    /// Notes that a place should hear how it is, because nobody knows what it has heard since.
    pub(super) fn note_unknown(&mut self, place: &Place, previous_hash: Option<String>, since: Since, now: Instant) {
        self.remove(place);
        let difference = Difference {
            previous_hash,
            paths: None,
            scopes: BTreeSet::new(),
        };
        self.insert(place.clone(), now, since, difference, None);
    }

    fn insert(&mut self, place: Place, at: Instant, since: Since, difference: Difference, gone: Option<Notice>) {
        self.numbers += 1;
        self.order.insert(self.numbers, place.clone());
        let entry = Entry {
            number: self.numbers,
            at,
            since,
            difference,
            gone,
        };
        self.places.insert(place, entry);
        if self.places.len() > MAX_PLACES
            && let Some((_, oldest)) = self.order.pop_first()
        {
            self.places.remove(&oldest);
            self.dropped += 1;
        }
    }

    fn remove(&mut self, place: &Place) -> Option<Entry> {
        let entry = self.places.remove(place)?;
        self.order.remove(&entry.number);
        Some(entry)
    }

    /// A place that is not told of changes any more; that its service is deleted it is to hear nevertheless.
    pub(super) fn forget(&mut self, place: &Place) {
        if self.places.get(place).is_some_and(|entry| entry.gone.is_none()) {
            self.remove(place);
        }
    }

    /// Services were told so far, whoever did it.
    pub(super) fn confirm(&mut self, told: &Mark, now: Instant) {
        self.forget_old(now, |entry| entry.since.is_covered_by(told));
    }

    /// What followed from no store, or another one than this, is over.
    pub(super) fn confirm_others(&mut self, store_id: &str, now: Instant) {
        self.forget_old(now, |entry| {
            let mark = entry.since.mark.as_ref();
            mark.is_none_or(|mark| mark.store_id != store_id)
        });
    }

    fn forget_old(&mut self, now: Instant, is_over: impl Fn(&Entry) -> bool) {
        let is_told = |entry: &Entry| is_over(entry) && now.duration_since(entry.at) > RECENT;
        let order = &mut self.order;
        self.places.retain(|_, entry| {
            let stays = !is_told(entry);
            if !stays {
                order.remove(&entry.number);
            }
            stays
        });
    }

    pub(super) fn contains(&self, place: &Place) -> bool {
        self.places.contains_key(place)
    }

    pub(super) fn len(&self) -> usize {
        self.places.len()
    }

    /// How many were left out for want of room.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Everything, in the order in which it was noted: it is told from now on.
    pub(super) fn take(&mut self) -> Vec<Left> {
        let mut places = std::mem::take(&mut self.places);
        let order = std::mem::take(&mut self.order);
        let left = order.into_values().filter_map(|place| {
            let entry = places.remove(&place)?;
            Some(Left {
                place,
                difference: entry.difference,
                gone: entry.gone,
            })
        });
        left.collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::Source;

    fn place(service: &str) -> Place {
        Place {
            service: service.parse().unwrap(),
            instance: None,
            node: None,
        }
    }

    fn notice(service: &str, previous: &str, paths: &[&str], hash: Option<&str>) -> Notice {
        Notice {
            place: place(service),
            layer: "fog".parse().unwrap(),
            revision: 1,
            hash: hash.map(str::to_owned),
            previous_hash: Some(previous.to_owned()),
            paths: paths.iter().map(|path| (*path).to_owned()).collect(),
            scopes: vec![Scope::Service],
            config: None,
            source: Source::Main,
            rollout: None,
        }
    }

    fn since(revision: u64) -> Since {
        Since {
            mark: Some(mark(revision)),
            is_undone: false,
        }
    }

    fn since_nothing() -> Since {
        Since {
            mark: None,
            is_undone: false,
        }
    }

    fn mark(revision: u64) -> Mark {
        Mark {
            store_id: "s".to_owned(),
            revision,
        }
    }

    #[test]
    fn several_changes_of_a_place_become_one_from_the_first_to_the_last() {
        let (mut missed, now) = (Missed::default(), Instant::now());
        missed.note(&notice("slam", "a", &["/x"], Some("b")), since(1), now);
        missed.note(&notice("nav", "p", &["/n"], Some("q")), since(1), now);
        missed.note(&notice("slam", "b", &["/y"], Some("c")), since(2), now);
        let left = missed.take();
        let names: Vec<&str> = left.iter().map(|left| left.place.service.as_str()).collect();
        assert_eq!(names, ["nav", "slam"], "in the order of the last changes");
        let slam = &left[1].difference;
        assert_eq!(slam.previous_hash.as_deref(), Some("a"));
        assert_eq!(
            slam.paths.clone().unwrap().into_iter().collect::<Vec<_>>(),
            ["/x", "/y"]
        );
        assert_eq!(missed.len(), 0);
    }

    #[test]
    fn what_is_marked_as_told_is_forgotten_once_it_is_old() {
        let (mut missed, now) = (Missed::default(), Instant::now());
        missed.note(&notice("slam", "a", &[], Some("b")), since(5), now);
        missed.note(&notice("nav", "a", &[], Some("b")), since(6), now);
        missed.note(&notice("file", "a", &[], Some("b")), since_nothing(), now);
        missed.confirm(&mark(5), now);
        assert_eq!(missed.len(), 3, "the broker may have lost it");
        let later = now + RECENT + Duration::from_millis(1);
        missed.confirm(&mark(5), later);
        assert!(!missed.contains(&place("slam")) && missed.contains(&place("nav")));
        let other = Mark {
            store_id: "other".to_owned(),
            revision: 99,
        };
        missed.confirm(&other, later);
        missed.confirm(&mark(99), later);
        assert!(missed.contains(&place("file")) && missed.len() == 1);
        missed.note(&notice("own", "a", &[], Some("b")), since(100), now);
        missed.confirm_others("s", now);
        assert_eq!(missed.len(), 2, "whoever told it may have died over it");
        missed.confirm_others("s", later);
        assert!(missed.contains(&place("own")) && missed.len() == 1);
    }

    #[test]
    fn what_was_undone_is_told_only_by_a_mark_of_a_later_state() {
        let (mut missed, now) = (Missed::default(), Instant::now());
        let undone = Since {
            is_undone: true,
            ..since(5)
        };
        missed.note(&notice("slam", "a", &[], Some("b")), undone, now);
        missed.note(&notice("nav", "a", &[], Some("b")), since(5), now);
        let later = now + RECENT + Duration::from_millis(1);
        missed.confirm(&mark(5), later);
        assert!(missed.contains(&place("slam")) && !missed.contains(&place("nav")));
        // A change that comes on top may have been told before that.
        missed.note(&notice("slam", "b", &[], Some("c")), since(6), now);
        missed.confirm(&mark(6), later);
        assert!(missed.contains(&place("slam")));
        missed.confirm(&mark(7), later);
        assert!(!missed.contains(&place("slam")));
    }

    #[test]
    fn a_deletion_is_told_also_where_nobody_is_told_of_changes_any_more() {
        let (mut missed, now) = (Missed::default(), Instant::now());
        missed.note(&notice("gone", "a", &[], None), since(1), now);
        missed.note(&notice("slam", "a", &[], Some("b")), since(1), now);
        missed.forget(&place("gone"));
        missed.forget(&place("slam"));
        let left = missed.take();
        assert_eq!(left.len(), 1);
        assert!(left[0].gone.is_some());
    }

    #[test]
    fn the_places_are_bounded_and_what_is_left_out_is_counted() {
        let (mut missed, now) = (Missed::default(), Instant::now());
        for number in 0..=MAX_PLACES {
            missed.note(
                &notice(&format!("s{number}"), "a", &[], Some("b")),
                since_nothing(),
                now,
            );
        }
        assert_eq!(
            (missed.len(), missed.dropped(), missed.order.len()),
            (MAX_PLACES, 1, MAX_PLACES)
        );
        assert!(!missed.contains(&place("s0")));
    }

    #[test]
    fn too_many_paths_are_all_of_them() {
        let (mut missed, now) = (Missed::default(), Instant::now());
        let many: Vec<String> = (0..=MAX_PATHS).map(|number| format!("/p{number}")).collect();
        let many: Vec<&str> = many.iter().map(String::as_str).collect();
        missed.note(&notice("slam", "a", &many, Some("b")), since_nothing(), now);
        missed.note(&notice("slam", "b", &["/x"], Some("c")), since_nothing(), now);
        assert_eq!(missed.take()[0].difference.paths, None);
    }
}
