//! Places that ended: their service was deleted, or nobody asks for them any more.
//!
//! ```text
//! deleted, untracked ─▶ ended ─▶ after STAYS: the broker's last notice is taken away ─▶ forgotten
//! ```
//!
//! Meanwhile a worker that begins to notify repeats that a service was deleted: the one before may
//! have died over it. The places are in the notes of the copies, so that a restart begins the time
//! anew; the notices of deletions are not.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use blaze_brokers::KeyedMessage;
use blaze_domain::ServiceName;
use blaze_domain::config::Kind;
use blaze_domain::config::spec::PROGRAMS;
use tokio::time::Instant;

use super::Engine;
use crate::core::{Notice, ServedTarget};
use crate::serve::{Told, changed};

/// How long the last notice of a place stays with the broker.
const STAYS: Duration = Duration::from_secs(600);
/// How much longer a worker that does not notify remembers a place: the leader does the same,
/// unless there is none.
const IN_MIND: Duration = Duration::from_secs(3_600);
/// How long the channel stays after the last notice was taken away.
const CHANNEL_STAYS: Duration = Duration::from_secs(60);
/// Most places that are remembered; those beyond are counted.
const MAX_ENDED: usize = 20_000;

struct Ended {
    until: Instant,
    /// That its service was deleted.
    notice: Option<Notice>,
    is_taken_away: bool,
}

/// All of them.
pub(super) struct Ends {
    places: BTreeMap<ServedTarget, Ended>,
    /// Services may have come or gone since channels were last asked for.
    channels_differ: bool,
    /// Places that were not remembered, because there were too many.
    pub(super) forgotten: u64,
}

impl Default for Ends {
    fn default() -> Self {
        Self { places: BTreeMap::new(), channels_differ: true, forgotten: 0 }
    }
}

/// The record key of a place.
pub(super) fn record_key(place: &ServedTarget) -> String {
    place.instance.as_ref().map(ToString::to_string).unwrap_or_default()
}

impl Ends {
    /// A place is not notified of changes any more, or its service was deleted.
    pub(super) fn add(&mut self, place: &ServedTarget, notice: Option<&Notice>) {
        let until = Instant::now() + STAYS;
        if let Some(ended) = self.places.get_mut(place) {
            (ended.until, ended.is_taken_away) = (until, false);
            ended.notice = notice.cloned().or(ended.notice.take());
        } else if self.places.len() < MAX_ENDED {
            let ended = Ended { until, notice: notice.cloned(), is_taken_away: false };
            self.places.insert(place.clone(), ended);
        } else {
            self.forgotten += 1;
        }
    }

    /// All of them, in their order.
    pub(super) fn places(&self) -> impl Iterator<Item = &ServedTarget> {
        self.places.keys()
    }

    /// Deletions that are to be repeated; they stay for a while from now on.
    pub(super) fn repeat(&mut self) -> Vec<Notice> {
        let until = Instant::now() + STAYS;
        let deleted = self.places.values_mut().filter_map(|ended| {
            let notice = ended.notice.clone()?;
            ended.until = until;
            Some(notice)
        });
        deleted.collect()
    }

    /// What was being taken away may not have been.
    pub(super) fn take_away_again(&mut self) {
        self.places.values_mut().for_each(|ended| ended.is_taken_away = false);
    }
}

impl Engine {
    /// A service may have come or gone.
    pub(super) fn note_services(&mut self, kinds: impl IntoIterator<Item = Kind>) {
        self.ends.channels_differ |= kinds.into_iter().any(|kind| kind == Kind::Service);
    }

    /// Has the channels of all services that are notified, or were a while ago. What is not shown
    /// yet comes with the flush that shows it.
    pub(super) fn serve_channels(&mut self) {
        let Some(channels) = &self.outputs.channels else { return };
        if self.served.has_pending() || !std::mem::take(&mut self.ends.channels_differ) {
            return;
        }
        let of_documents = self.served.state().of_kind(Kind::Service, None);
        let mut services: BTreeSet<ServiceName> =
            of_documents.map(|(key, _)| ServiceName::from(key.name())).collect();
        // Programs are there also without a document.
        services.extend(PROGRAMS.iter().filter_map(|program| program.parse().ok()));
        services.extend(self.ends.places().map(|place| place.service.clone()));
        channels.serve(services);
    }

    /// Takes away what has stayed long enough.
    pub(super) fn look_at_ends(&mut self) {
        let now = Instant::now();
        let in_mind = if self.tells { Duration::ZERO } else { IN_MIND };
        let is_due = |ended: &Ended| ended.until + in_mind <= now;
        let due = self.ends.places.iter().filter(|(_, ended)| is_due(ended));
        let count = self.ends.places.len();
        let due: Vec<(ServedTarget, bool)> =
            due.map(|(place, ended)| (place.clone(), ended.is_taken_away)).collect();
        for (place, is_taken_away) in due {
            if self.outputs.speaker.is_waiting(&place.to_string()) {
                // A record without a value would replace the deletion, and be lost with the
                // channel.
                if let Some(ended) = self.ends.places.get_mut(&place) {
                    ended.until = now + STAYS;
                }
                continue;
            }
            // The same instance on another node has the same key.
            let is_notified = self.served.tells(&place.service, place.instance.as_ref());
            if self.tells && self.outputs.channels.is_some() && !is_taken_away && !is_notified {
                self.take_away(&place);
                if let Some(ended) = self.ends.places.get_mut(&place) {
                    (ended.is_taken_away, ended.until) = (true, now + CHANNEL_STAYS);
                }
            } else {
                self.ends.places.remove(&place);
                self.ends.channels_differ = true;
            }
        }
        if self.ends.places.len() < count {
            self.renew_notes();
            self.keep(true);
        }
        self.serve_channels();
    }

    fn take_away(&self, place: &ServedTarget) {
        let Some(channel) = changed(&place.service) else { return };
        self.tell(vec![Told {
            place: place.to_string(),
            key: None,
            notice: Some(KeyedMessage { channel, key: record_key(place), value: None }),
        }]);
    }
}
