//! Whether this worker tells services anything, and what it tells when it begins to.
//!
//! ```text
//! leads, and is not behind what was told already ──▶ tells: notices and keys go out, the mark beside the lease moves on
//! else                                           ──▶ what is to be told is kept (module `missed`)
//! ```

use std::collections::BTreeSet;
use std::time::Duration;

use tokio::time::Instant;

use super::missed::{Left, Since};
use super::{Engine, SETTLE, WAIT_FOR_OTHERS};
use crate::core::Notice;
use crate::lease::Mark;
use crate::serve::Told;

/// The main service says every 15 s what its newest is, and a link that is dead is noticed before.
const TRUST_AFTER: Duration = Duration::from_secs(20);

impl Engine {
    /// Whether this worker may act for its layer at this instant.
    pub(super) fn is_leader(&self) -> bool {
        self.leads.is_some() && self.outputs.term.is_on()
    }

    /// This worker answers and notifies from now on, or does not any more. Of two terms one ends before the other begins,
    /// also if nobody looked in between: others may have told something newer.
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
            tracing::info!("others have told more than is known here; services are told again once it is");
        }
    }

    /// Services were told so far, whoever did it.
    pub(super) fn note_told(&mut self, mark: Option<Mark>) {
        self.noted = mark;
        self.follow_rollouts();
        self.settle_soon();
    }

    /// The state that is shown, as far as it is one of a main service.
    pub(super) fn mark(&self) -> Option<Mark> {
        Some(Mark {
            store_id: self.replica.store_id()?.to_owned(),
            revision: self.replica.state().revision(),
        })
    }

    /// Whether others have told more than is known here. What the main service calls the newest some time after this worker
    /// began to lead is not behind, whatever the mark says; before, its word may be one from before the process was stopped.
    fn is_behind(&self) -> bool {
        match (&self.noted, &self.shown) {
            (None, _) => false,
            (Some(_), None) => true,
            (Some(noted), Some(shown)) => {
                let is_newest = self.replica.is_in_sync() && self.led_at.elapsed() > TRUST_AFTER;
                noted.store_id == shown.store_id && !shown.covers(noted) && !is_newest
            }
        }
    }

    /// Tells what others may have left, and from now on what changes; if it leads and knows enough.
    pub(super) fn begin_telling(&mut self) {
        if self.tells || self.leads.is_none() || self.is_behind() {
            return;
        }
        self.tells = true;
        self.keyed.clear();
        self.confirm();
        let (gone, left): (Vec<Notice>, Vec<Notice>) = self
            .missed
            .take()
            .into_iter()
            .filter_map(|left| self.as_it_is(left))
            .partition(|notice| notice.hash.is_none());
        for notice in &gone {
            self.fade_anew(&notice.place);
        }
        let mut told: Vec<Told> = Vec::with_capacity(gone.len() + left.len());
        // First what goes: an instance that moves has the same key there.
        for notice in gone.iter().chain(&left) {
            // Nobody knows since when they have not heard: no window of a roll-out opens before they have.
            told.extend(self.of_notice(notice).map(|told| Told { revision: 0, ..told }));
        }
        for place in &self.places() {
            if let Some(standing) = self.served.standing_of(place) {
                // Keys may be those of an older state.
                told.extend(self.of_standing(place, &standing));
            }
        }
        self.outputs.speaker.tell(told);
        if self.served.is_ready() {
            self.outputs.speaker.sweep_keys();
        }
        self.settle_soon();
    }

    /// What a place is to hear by now; `None`: nothing, because it is not told of changes any more.
    fn as_it_is(&self, left: Left) -> Option<Notice> {
        let Left {
            place,
            difference,
            gone,
        } = left;
        let Some(mut notice) = self.served.notice_of(&place, difference.previous_hash) else {
            return gone;
        };
        if let Some(paths) = difference.paths {
            notice.paths = paths.into_iter().collect();
            notice.scopes = difference.scopes.into_iter().collect();
        }
        Some(notice)
    }

    /// What waits is for others to tell, and may be old by the time the broker takes it; if there are none, it is told later.
    fn stop_telling(&mut self) {
        if !std::mem::replace(&mut self.tells, false) {
            return;
        }
        let now = Instant::now();
        let is_all = |mark: &Option<Mark>| {
            mark.as_ref()
                .zip(self.shown.as_ref())
                .is_some_and(|(mark, shown)| mark.covers(shown))
        };
        let since = Since {
            mark: self.shown.clone(),
            // What waits although all of this state was marked as told came without a commit, or is told once more.
            is_undone: is_all(&self.noted) || is_all(&self.outputs.told.borrow()),
        };
        let speaker = &self.outputs.speaker;
        for place in self
            .unnoted
            .keys()
            .filter(|place| speaker.is_waiting(&place.to_string()))
        {
            let before = self.notes.told(&place.at(&self.identity.site));
            let before = before.and_then(|before| before.hash.as_deref()).map(str::to_owned);
            self.missed.note_unknown(place, before, since.clone(), now);
        }
        for (place, notice) in std::mem::take(&mut self.farewells) {
            if speaker.is_waiting(&place.to_string()) {
                self.missed.note(&notice, since.clone(), now);
            }
        }
        speaker.clear();
        self.take_away_again();
        self.keyed.clear();
        self.outputs.told.send_replace(None);
        self.settle_soon();
    }

    /// Looks soon whether places have been told.
    pub(super) fn settle_soon(&mut self) {
        let pace = if self.tells { SETTLE } else { WAIT_FOR_OTHERS };
        self.settle_at.get_or_insert(Instant::now() + pace);
    }

    fn confirm(&mut self) {
        let now = Instant::now();
        match (&self.noted, &self.shown) {
            (Some(noted), shown) => {
                self.missed.confirm(noted, now);
                // Whoever told all of this state has told what followed from a file or another store before it.
                if shown.as_ref().is_some_and(|shown| noted.covers(shown)) {
                    self.missed.confirm_others(&noted.store_id, now);
                }
            }
            // Of a mounted file nobody leaves a mark.
            (None, None) => self.missed.confirm_others("", now),
            (None, Some(_)) => {}
        }
    }

    /// Looks what was told meanwhile: notes it for the next life, and leaves a mark for whoever leads next.
    pub(super) fn settle(&mut self) {
        self.settle_at = None;
        if !self.tells {
            self.confirm();
        }
        let speaker = &self.outputs.speaker;
        let is_told = |place: &crate::core::Place| match self.tells {
            true => !speaker.is_waiting(&place.to_string()),
            false => !self.missed.contains(place),
        };
        let told: BTreeSet<_> = self.unnoted.keys().filter(|place| is_told(place)).cloned().collect();
        self.farewells.retain(|place, _| speaker.is_waiting(&place.to_string()));
        let is_all_told = speaker.untold().is_none();
        self.note_all(told);
        if self.tells {
            self.leave_mark();
        }
        self.open_windows();
        let is_done = is_all_told && self.unnoted.is_empty() && self.farewells.is_empty() && self.missed.len() == 0;
        if !is_done {
            self.settle_soon();
        }
    }

    fn leave_mark(&mut self) {
        let Some(shown) = &self.shown else { return };
        let told = &self.outputs.told;
        let mark = match self.outputs.speaker.untold() {
            None => shown.clone(),
            Some(first) => {
                let left = told.borrow().clone();
                match left {
                    Some(left) if left.store_id == shown.store_id => Mark {
                        revision: left.revision.max(first.saturating_sub(1)),
                        ..left
                    },
                    Some(_) | None => return,
                }
            }
        };
        told.send_if_modified(|left| {
            let is_new = left.as_ref() != Some(&mark);
            *left = Some(mark);
            is_new
        });
    }
}
