//! What the broker keeps of places that nobody tells of anything any more: channels and, of each key, the last notice. Both stay
//! for a while, so that whoever comes late still hears of an end, and go then.
//!
//! ```text
//! told ── untracked ──▶ fading ── after FADE ──▶ taken away ── the broker has taken it ──▶ forgotten
//!   ▲                     │ told again: stays
//!   └─────────────────────┘
//! ```
//!
//! A place that fades is noted as gone, so that a worker that is restarted takes it away as well.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::KeyedMessage;
use blaze_domain::config::Kind;
use blaze_domain::config::effective::At;
use blaze_domain::config::spec::PROGRAMS;
use blaze_domain::{InstanceName, ServiceName};
use tokio::time::Instant;

use super::{Engine, tell};
use crate::copy::MAX_TOLD;
use crate::core::Place;
use crate::serve::{Told, changed};

/// How long the last notice of a place stays.
const FADE: Duration = Duration::from_secs(600);
/// How long a worker that does not tell keeps in mind what it would take away if it were to lead: whoever leads has done it, unless
/// nobody did.
const IN_MIND: Duration = Duration::from_secs(24 * 3600);

/// A place that nobody tells of anything any more.
#[derive(Debug, Clone, Copy)]
struct Fading {
    since: Instant,
    /// The broker is being told to take it away.
    taken_away: bool,
}

/// All of them, where the broker keeps anything.
#[derive(Debug)]
pub(super) struct Fades {
    places: BTreeMap<Place, Fading>,
    /// Services may have come or gone since channels were last asked for.
    channels_differ: bool,
}

impl Default for Fades {
    fn default() -> Self {
        Self {
            places: BTreeMap::new(),
            channels_differ: true,
        }
    }
}

/// The record key of a place.
pub(super) fn record_key(place: &Place) -> String {
    place.instance.as_ref().map(ToString::to_string).unwrap_or_default()
}

impl Engine {
    /// Places that an earlier life noted as gone.
    pub(super) fn fade_from_notes(&mut self) {
        if self.outputs.channels.is_none() {
            return;
        }
        let gone = self.notes.all_told().filter(|(_, told)| told.hash.is_none());
        let gone = gone.filter_map(|(at, _)| tell::place_of(at));
        let gone: Vec<Place> = gone.filter(|place| !self.fades.places.contains_key(place)).collect();
        for place in gone {
            self.fades.channels_differ = true;
            self.begin_to_fade(place);
        }
    }

    fn begin_to_fade(&mut self, place: Place) {
        let fading = Fading {
            since: Instant::now(),
            taken_away: false,
        };
        // As many as are noted at all: the others would be forgotten by a restart.
        if self.fades.places.len() < MAX_TOLD {
            self.fades.places.insert(place, fading);
        }
    }

    /// Nobody tells a place of anything any more. Returns whether its end is still to come.
    pub(super) fn fade(&mut self, place: &Place, at: &At) -> bool {
        if self.outputs.channels.is_none() {
            return false;
        }
        let known = self.notes.told(at).map(|told| told.revision);
        let revision = known.unwrap_or_else(|| self.served.state().revision());
        self.begin_to_fade(place.clone());
        self.note(place, revision, None);
        true
    }

    /// A service may have come or gone.
    pub(super) fn note_services(&mut self, kinds: impl IntoIterator<Item = Kind>) {
        self.fades.channels_differ |= kinds.into_iter().any(|kind| kind == Kind::Service);
    }

    /// Has the channels of all services that are told of anything, or were a while ago. What is not shown yet comes with the flush
    /// that shows it.
    pub(super) fn serve_channels(&mut self) {
        let Some(channels) = &self.outputs.channels else { return };
        if self.served.has_pending() || !std::mem::take(&mut self.fades.channels_differ) {
            return;
        }
        let of_documents = self.served.state().of_kind(Kind::Service, None);
        let mut services: BTreeSet<ServiceName> = of_documents.map(|(key, _)| ServiceName::from(key.name())).collect();
        // Programs are there also without a document.
        services.extend(PROGRAMS.iter().filter_map(|program| program.parse().ok()));
        services.extend(self.fades.places.keys().map(|place| place.service.clone()));
        channels.serve(services);
    }

    /// Takes away what has faded.
    pub(super) fn look_at_fading(&mut self) {
        let now = Instant::now();
        let due = |fading: &Fading| now.saturating_duration_since(fading.since) >= FADE;
        let due: Vec<(Place, Fading)> = self
            .fades
            .places
            .iter()
            .filter(|(_, fading)| due(fading))
            .map(|(place, fading)| (place.clone(), *fading))
            .collect();
        let mut is_noted = false;
        for (place, fading) in due {
            let instance: Option<&InstanceName> = place.instance.as_ref();
            // The same instance on another node has the same key.
            let is_told = self.served.tells(&place.service, instance);
            let is_waiting = self.outputs.speaker.is_waiting(&place.to_string());
            let is_over = match self.tells {
                true => fading.taken_away && !is_waiting,
                false => now.saturating_duration_since(fading.since) >= IN_MIND,
            };
            if is_told || is_over {
                self.fades.places.remove(&place);
                self.fades.channels_differ = true;
                if self.served.told_at(&place).is_none() {
                    self.unnoted.remove(&place);
                    Arc::make_mut(&mut self.notes).forget(&tell::at(&place, &self.identity.site));
                    is_noted = true;
                }
            } else if self.tells && !fading.taken_away {
                let is_unheard = is_waiting || self.missed.contains(&place);
                if !is_unheard {
                    self.tell_end(&place);
                }
                if let Some(fading) = self.fades.places.get_mut(&place) {
                    match is_unheard {
                        // Its end has not been told yet, and is to stay for a while then.
                        true => fading.since = now,
                        false => fading.taken_away = true,
                    }
                }
            }
        }
        if is_noted {
            self.keep(true);
        }
        self.serve_channels();
    }

    /// A place hears of its end only now, so that it stays for a while from now on.
    pub(super) fn fade_anew(&mut self, place: &Place) {
        if let Some(fading) = self.fades.places.get_mut(place) {
            fading.since = Instant::now();
        }
    }

    /// What was being taken away may not have been: whoever tells next does it.
    pub(super) fn take_away_again(&mut self) {
        for fading in self.fades.places.values_mut() {
            fading.taken_away = false;
        }
    }

    fn tell_end(&mut self, place: &Place) {
        let Some(channel) = changed(&place.service) else { return };
        let told = Told {
            place: place.to_string(),
            key: None,
            notice: Some(KeyedMessage {
                channel,
                key: record_key(place),
                value: None,
            }),
            revision: self.served.state().revision(),
        };
        self.tell(vec![told]);
    }
}
