//! From a change to what services are told.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::KeyedMessage;
use blaze_domain::config::effective::At;
use blaze_domain::config::secret;
use blaze_domain::{DocumentName, InstanceName};
use bytes::Bytes;
use tokio::time::Instant;

use super::fade::record_key;
use super::missed::Since;
use super::{Engine, TOGETHER, lacks_texts, now};
use crate::copy::{Notes, Told as Noted, lacks_text};
use crate::core::messages::{self, Delivery, GetRequest};
use crate::core::{Change, Flushed, Notice, Place, Site, Standing, Told as ServedTold};
use crate::serve::{Told, changed};

/// How long after the texts of secrets came everybody with secrets gets a whole answer: each asks within this time.
const TEXTS: Duration = Duration::from_secs(180);

/// What an earlier life told, from its notes.
pub(super) fn told_of(notes: &Notes) -> Vec<(Place, ServedTold)> {
    let told = |noted: &Noted| ServedTold {
        revision: noted.revision,
        hash: noted.hash.as_ref().map(ToString::to_string),
    };
    let all = notes
        .all_told()
        .filter_map(|(at, noted)| Some((place_of(at)?, told(noted))));
    all.collect()
}

/// The place of a note.
pub(super) fn place_of(at: &At) -> Option<Place> {
    Some(Place {
        service: at.service.clone()?,
        instance: at.instance.as_ref().map(InstanceName::from),
        node: at.node.clone(),
    })
}

pub(super) fn at(place: &Place, site: &Site) -> At {
    At {
        service: Some(place.service.clone()),
        instance: place.instance.as_ref().map(DocumentName::from),
        layer: Some(site.layer.clone()),
        node: place.node.clone(),
    }
}

impl Engine {
    /// Has changes told: at once after a quiet while, else together with what comes until then. What was missed in an outage
    /// is told when it has all come.
    pub(super) fn flush_soon(&mut self) {
        let next = self.flushed.map_or_else(Instant::now, |last| last + TOGETHER);
        let next = self.catching_up.map_or(next, |wait| wait.until.max(next));
        self.flush_at = Some(self.flush_at.map_or(next, |at| at.min(next)));
    }

    /// Tells what has changed.
    pub(super) fn flush(&mut self) {
        self.flush_at = None;
        let instant = Instant::now();
        self.flushed = Some(instant);
        let Flushed {
            notices,
            tracked,
            untracked,
        } = self.served.flush(instant.into_std());
        self.counts.notices += notices.len() as u64;
        self.shown = self.mark();
        let since = Since {
            mark: self.shown.clone(),
            is_undone: std::mem::take(&mut self.has_undone),
        };
        let mut told: Vec<Told> = Vec::with_capacity(notices.len());
        // First what goes: an instance that moves has the same key there.
        for place in &untracked {
            let noted = at(place, &self.identity.site);
            if !self.fade(place, &noted) {
                // Whether anything is still owed is seen when the rest settles.
                self.unnoted.remove(place);
                Arc::make_mut(&mut self.notes).forget(&noted);
            }
            self.missed.forget(place);
            told.extend(self.without_key(place));
        }
        self.serve_channels();
        let is_gone = |notice: &&Notice| notice.hash.is_none();
        for notice in notices
            .iter()
            .filter(is_gone)
            .chain(notices.iter().filter(|notice| !is_gone(notice)))
        {
            match self.tells {
                true => told.extend(self.of_notice(notice)),
                false => self.missed.note(notice, since.clone(), instant),
            }
            if !untracked.contains(&notice.place) {
                self.note(&notice.place, notice.revision, notice.hash.clone());
            }
        }
        let noticed: BTreeSet<&Place> = notices.iter().map(|notice| &notice.place).collect();
        let is_first = self.served.is_ready() && !std::mem::replace(&mut self.has_swept, self.served.is_ready());
        // What an earlier life wrote may be gone, or of another form.
        let all = if is_first { self.places() } else { tracked };
        for place in &all {
            if let Some(standing) = self.served.standing_of(place)
                && !noticed.contains(place)
            {
                self.note(place, standing.revision, Some(standing.hash.clone()));
                told.extend(self.of_standing(place, &standing));
            }
        }
        self.tell(told);
        self.tell_texts();
        if is_first && self.tells {
            self.outputs.speaker.sweep_keys();
        }
        self.tell_own();
        self.owe_notes();
        self.begin_telling();
        self.settle_soon();
        // After the notices: only what was told can go well or badly.
        self.follow_rollouts();
        if self.served.has_pending() {
            self.flush_soon();
        }
    }

    pub(super) fn places(&self) -> Vec<Place> {
        self.served.told().map(|(place, _)| place.clone()).collect()
    }

    /// The texts of secrets have come, which were not there before: whoever has them redacted has the right hash, and yet not
    /// what it needs. They are told with the change that they came with.
    pub(super) fn note_texts(&mut self, change: &Change) {
        // What is not changed is looked at only as long as something is missing.
        if self.lacks_texts {
            return self.note_texts_of_all();
        }
        let mut changed = change.keys.iter().filter_map(|key| change.new.get(key));
        self.lacks_texts = changed.any(|held| lacks_text(&held.document.spec));
    }

    /// The same, of a state that is another one as a whole.
    pub(super) fn note_texts_of_all(&mut self) {
        let lacked = std::mem::replace(&mut self.lacks_texts, lacks_texts(self.replica.state()));
        self.owes_texts |= self.identity.delivery == Delivery::Text && lacked && !self.lacks_texts;
    }

    /// Has them told, with what is shown now.
    fn tell_texts(&mut self) {
        if !std::mem::take(&mut self.owes_texts) {
            return;
        }
        self.texts_until = Some(Instant::now() + TEXTS);
        let told: Vec<Told> = self
            .places()
            .iter()
            .filter_map(|place| {
                let standing = self.served.standing_of(place)?;
                let has_secrets = secret::contains(standing.config.value());
                has_secrets.then(|| self.of_standing(place, &standing)).flatten()
            })
            .collect();
        self.tell(told);
    }

    /// Keys that nobody is told now are written when this worker begins to tell.
    pub(super) fn tell(&mut self, told: Vec<Told>) {
        if self.tells {
            self.outputs.speaker.tell(told);
        }
    }

    /// The key of a place that has asked for the first time.
    pub(super) fn key_of_asker(&mut self, request: &GetRequest) {
        let Some(service) = &request.service else { return };
        let place = Place {
            service: service.clone(),
            instance: request.instance.clone(),
            node: self.identity.site.node.clone().or_else(|| request.node.clone()),
        };
        if self.keyed.get(&self.key_name(&place)) == Some(&place) {
            return;
        }
        if let Some(standing) = self.served.standing_of(&place) {
            self.note(&place, standing.revision, Some(standing.hash.clone()));
            let told = self.of_standing(&place, &standing);
            self.tell(told.into_iter().collect());
        }
    }

    /// A notice, and the key with it.
    pub(super) fn of_notice(&mut self, notice: &Notice) -> Option<Told> {
        let delivery = self.identity.delivery;
        let text = messages::notice(notice, delivery, now()).inspect_err(|error| {
            tracing::error!(place = %notice.place, %error, "nobody is told of a configuration that is too large");
        });
        let key = match notice.standing() {
            Some(standing) => self.key(&notice.place, &standing),
            None => self.key_to_go(&notice.place),
        };
        if notice.hash.is_none() {
            self.farewells.insert(notice.place.clone(), notice.clone());
        }
        Some(Told {
            place: notice.place.to_string(),
            key,
            notice: Some(KeyedMessage {
                channel: changed(&notice.place.service)?,
                key: record_key(&notice.place),
                value: Some(Bytes::from(text.ok()?)),
            }),
            revision: self.shown.as_ref().map_or(0, |shown| shown.revision),
        })
    }

    /// The key alone; `None` if the place has none.
    pub(super) fn of_standing(&mut self, place: &Place, standing: &Standing) -> Option<Told> {
        if !self.tells {
            return None;
        }
        Some(Told {
            place: place.to_string(),
            key: Some(self.key(place, standing)?),
            notice: None,
            revision: 0,
        })
    }

    /// That the key is to go, if it is this place's.
    fn without_key(&mut self, place: &Place) -> Option<Told> {
        Some(Told {
            place: place.to_string(),
            key: Some(self.key_to_go(place)?),
            notice: None,
            revision: 0,
        })
    }

    fn key_to_go(&mut self, place: &Place) -> Option<(String, Option<Bytes>)> {
        let name = self.key_name(place);
        if self.keyed.get(&name) != Some(place) {
            return None;
        }
        self.keyed.remove(&name);
        Some((name, None))
    }

    fn key(&mut self, place: &Place, standing: &Standing) -> Option<(String, Option<Bytes>)> {
        if !self.served.has_key(place) {
            // It had one while its document was there.
            return self.key_to_go(place);
        }
        let value = messages::state_value(standing, self.identity.delivery, self.freshness()).ok()?;
        let name = self.key_name(place);
        self.keyed.insert(name.clone(), place.clone());
        Some((name, Some(Bytes::from(value))))
    }

    /// Without the prefix of the server.
    fn key_name(&self, place: &Place) -> String {
        messages::config_key("", &place.service, place.instance.as_ref())
    }

    /// Has it noted what a place is told, once the broker has taken it: whoever dies before tells it again in the next life.
    pub(super) fn note(&mut self, place: &Place, revision: u64, hash: Option<String>) {
        let known = self.notes.told(&at(place, &self.identity.site));
        let is_known =
            known.is_some_and(|known| known.revision == revision && known.hash.as_deref() == hash.as_deref());
        if is_known && !self.unnoted.contains_key(place) {
            return;
        }
        self.unnoted.insert(place.clone(), (revision, hash));
        self.settle_soon();
        self.owe_notes();
    }

    /// Notes what places were told.
    pub(super) fn note_all(&mut self, told: BTreeSet<Place>) {
        let has_some = !told.is_empty();
        for place in told {
            if let Some((revision, hash)) = self.unnoted.remove(&place) {
                let told = Noted {
                    revision,
                    hash: hash.map(Arc::from),
                };
                Arc::make_mut(&mut self.notes).tell(at(&place, &self.identity.site), told);
            }
        }
        if has_some {
            self.keep(true);
        }
        self.owe_notes();
    }

    /// Copies without the notes that are still to come do not count as current.
    pub(super) fn owe_notes(&self) {
        if let Some(copies) = &self.outputs.copies {
            copies.owe(self.served.has_pending() || !self.unnoted.is_empty());
        }
    }
}
