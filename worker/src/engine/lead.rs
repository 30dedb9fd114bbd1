//! Whether this worker notifies services, and what it does when it begins to.
//!
//! ```text
//! leads, and is not behind the mark beside the lease ──▶ notifies: keys, one notice for every place, then each change
//! else                                               ──▶ follows: what changes is not kept, for the next leader notifies all
//! ```
//!
//! Receivers drop a notice with the hash that they have, so a repeat costs a message and no call of
//! a service.

use std::collections::BTreeSet;
use std::time::Duration;

use tokio::time::Instant;

use super::{Engine, SETTLE};
use crate::core::{ServedTarget, Source};
use crate::lease::Mark;
use crate::serve::Told;

/// The main service says every 15 s what its newest is, and a link that is dead is noticed before.
const TRUST_AFTER: Duration = Duration::from_secs(20);

impl Engine {
    /// Whether this worker may act for its layer at this instant.
    pub(super) fn is_leader(&self) -> bool {
        self.leads.is_some() && self.outputs.term.is_on()
    }

    /// This worker answers and notifies from now on, or does not any more. Of two terms one ends
    /// before the other begins, also if nobody looked in between: others may have notified
    /// something newer.
    pub(super) fn lead(&mut self, term: Option<u64>) {
        if self.leads == term {
            return;
        }
        tracing::info!(is_leader = term.is_some(), "the lease of the layer");
        if self.leads.is_some() {
            self.stop_telling();
        }
        self.leads = term;
        self.led_at = Instant::now();
        self.begin_telling();
        if self.leads.is_some() && !self.tells {
            tracing::info!(
                "services were notified of a later state than is known here; they are notified \
                 once it is"
            );
        }
    }

    /// Services were notified up to this state, by whomever.
    pub(super) fn note_told(&mut self, mark: Option<Mark>) {
        self.noted = mark;
        self.follow_rollouts();
        self.begin_telling();
    }

    /// The state that is shown, as far as it is one of a main service.
    pub(super) fn mark(&self) -> Option<Mark> {
        Some(Mark {
            store_id: self.view.store_id()?.to_owned(),
            revision: self.view.state().revision(),
        })
    }

    /// Whether services were notified of more than is known here. What the main service calls the
    /// newest some time after this worker began to lead is not behind, whatever the mark says;
    /// before, its word may be one from before the process was stopped.
    fn is_behind(&self) -> bool {
        match (&self.noted, &self.shown) {
            (None, _) => false,
            (Some(_), None) => true,
            (Some(noted), Some(shown)) => {
                let is_newest = self.view.is_in_sync() && self.led_at.elapsed() > TRUST_AFTER;
                noted.store_id == shown.store_id && !shown.covers(noted) && !is_newest
            }
        }
    }

    /// Notifies from now on, if it leads and knows enough: keys first, for they may be those of an
    /// older state.
    pub(super) fn begin_telling(&mut self) {
        if !self.tells && self.leads.is_some() && !self.is_behind() {
            self.tells = true;
            self.keyed.clear();
            let mut told: Vec<Told> = Vec::new();
            // First what goes: an instance that moves has the same key there.
            for notice in self.ends.repeat() {
                // The service may be there again.
                if self.served.look_up(&notice.place).is_none() {
                    told.extend(self.of_notice(&notice));
                }
            }
            for place in &self.places() {
                if let Some(standing) = self.served.standing_of(place) {
                    told.extend(self.of_standing(place, &standing));
                }
            }
            self.tell(told);
            if self.served.is_ready() {
                self.outputs.speaker.sweep_keys();
            }
            self.settle_soon();
        }
        if self.may_announce() {
            // With the changes that are still to be shown.
            self.flush_soon();
        }
    }

    /// Whether every place is to be notified once: other workers, or another life, may have died
    /// before they did. A copy may be older than what services were notified of, so it is announced
    /// only if a mark says that it is not.
    pub(super) fn may_announce(&self) -> bool {
        let is_newest = match self.served.source() {
            Some(Source::Main | Source::File) => true,
            Some(Source::Copy) => self.noted.is_some(),
            None => false,
        };
        self.tells && !self.has_announced && is_newest && self.catching_up.is_none()
    }

    /// Notifies every place but those that hear of a change anyway.
    pub(super) fn announce(&mut self, except: &BTreeSet<ServedTarget>) {
        if !self.may_announce() || !self.served.is_ready() {
            return;
        }
        self.has_announced = true;
        let notices = self.served.announce();
        let notices = notices.iter().filter(|notice| !except.contains(&notice.place));
        let told: Vec<Told> = notices.filter_map(|notice| self.of_notice(notice)).collect();
        self.tell(told);
    }

    /// What waits may be old by the time the broker takes it; whoever leads next notifies every
    /// place.
    fn stop_telling(&mut self) {
        if !std::mem::replace(&mut self.tells, false) {
            return;
        }
        self.has_announced = false;
        self.outputs.speaker.clear();
        self.ends.take_away_again();
        self.keyed.clear();
        self.outputs.told.send_replace(None);
    }

    /// Looks soon whether the broker has taken what waits.
    pub(super) fn settle_soon(&mut self) {
        self.settle_at.get_or_insert(Instant::now() + SETTLE);
    }

    /// Looks what the broker has taken meanwhile, leaves a mark for whoever leads next, and has new
    /// places kept.
    pub(super) fn settle(&mut self) {
        self.settle_at = None;
        if self.tells {
            self.leave_mark();
        }
        self.open_windows();
        self.keep_notes();
        let store_id = self.shown_store();
        if self.tells && self.outputs.speaker.waits_since(store_id, true).is_some() {
            self.settle_soon();
        }
    }

    /// Store of the state that is shown.
    fn shown_store(&self) -> &str {
        self.shown.as_ref().map_or("", |shown| &shown.store_id)
    }

    /// Revision up to which the broker has taken all notices. `aside`: also those whose channel
    /// cannot be made yet.
    pub(super) fn delivered(&self, aside: bool) -> Option<u64> {
        match self.outputs.speaker.waits_since(self.shown_store(), aside) {
            None => Some(self.served.state().revision()),
            Some(revision) => revision.checked_sub(1),
        }
    }

    fn leave_mark(&self) {
        let (Some(shown), Some(revision)) = (&self.shown, self.delivered(true)) else {
            return;
        };
        let mark = Mark { revision, ..shown.clone() };
        self.outputs.told.send_if_modified(|left| {
            // A repeated notice does not set the mark back.
            let mut known = left.iter().chain(&self.noted);
            let is_new = match mark == *shown {
                true => left.as_ref() != Some(shown),
                false => !known.any(|known| known.covers(&mark)),
            };
            if is_new {
                *left = Some(mark);
            }
            is_new
        });
    }
}
