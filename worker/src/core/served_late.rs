//! What an earlier life knew, and what becomes known only while places are served already: a later state, and what they were
//! told by others.

use std::sync::Arc;
use std::time::Instant;

use blaze_domain::config::state::State;

use super::{MAX_FAILED, Served, Source, Told, difference};
use crate::core::place::Place;

impl Served {
    /// Takes over what an earlier life knew, before anything is loaded: what places were told, so that nothing older is
    /// told now and what did not change is not told again, and which roll-outs failed. The places count as if they had
    /// asked now, because they may well be running.
    pub fn restore(
        &mut self,
        told: impl IntoIterator<Item = (Place, Told)>,
        failed: impl IntoIterator<Item = String>,
        now: Instant,
    ) {
        for (place, told) in told {
            self.floor = self.floor.max(told.revision);
            if told.hash.is_some() {
                self.note_asked(&place, now);
                self.places.insert(place, told);
            }
        }
        self.next.failed = Arc::new(failed.into_iter().take(MAX_FAILED).collect());
        self.shown.failed = Arc::clone(&self.next.failed);
    }

    /// Takes a later state of the store that is served: it replaces even what the main service told.
    pub fn take_later(&mut self, state: State) {
        self.pending.extend(difference(&self.next.state, &state));
        let rank = self.rank.map_or(Source::Copy, |rank| rank.max(Source::Copy));
        self.replace(state, rank);
    }

    /// Takes over what others told places, as [`Served::restore`] does at the start. A place that was told something else there
    /// than is known here may have either, so it hears how it is.
    pub fn restore_late(&mut self, told: impl IntoIterator<Item = (Place, Told)>, now: Instant) {
        for (place, told) in told {
            self.floor = self.floor.max(told.revision);
            match self.places.get(&place) {
                None if told.hash.is_none() => {}
                None => {
                    self.note_asked(&place, now);
                    self.places.insert(place.clone(), told);
                    self.late.insert(place, false);
                }
                Some(known) if known.revision >= told.revision => {}
                Some(known) if known.hash == told.hash => {
                    self.places.insert(place, told);
                }
                Some(_) => {
                    self.late.insert(place, true);
                }
            }
        }
    }
}
