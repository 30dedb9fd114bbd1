//! From a change to what services are told.

use std::collections::BTreeSet;
use std::time::Duration;

use blaze_brokers::KeyedMessage;
use blaze_domain::config::secret;
use bytes::Bytes;
use tokio::time::Instant;

use super::ends::record_key;
use super::{Engine, TOGETHER, lacks_texts, now};
use crate::copy::lacks_text;
use crate::core::messages::{self, Delivery, GetRequest};
use crate::core::{Change, Flushed, Notice, ServedTarget, Standing};
use crate::serve::{Told, changed};

/// How long after the texts of secrets came everybody with secrets gets a whole answer: each asks
/// within this time.
const TEXTS: Duration = Duration::from_secs(180);

impl Engine {
    /// Has changes told: at once after a quiet while, else together with what comes until then.
    /// What was missed in an outage is told when it has all come.
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
        let Flushed { notices, tracked, untracked } = self.served.flush(instant.into_std());
        self.shown = self.mark();
        // Those that are announced now make up for earlier states as well.
        let state = self.shown.clone().filter(|_| self.has_announced);
        self.outputs.speaker.set_state(state);
        let is_first = self.served.is_ready()
            && !std::mem::replace(&mut self.has_swept, self.served.is_ready());
        let mut told: Vec<Told> = Vec::with_capacity(notices.len());
        // First what goes: an instance that moves has the same key there.
        for place in &untracked {
            self.ends.add(place, None);
            told.extend(self.without_key(place));
        }
        let (gone, mut changed): (Vec<Notice>, Vec<Notice>) =
            notices.into_iter().partition(|notice| notice.hash.is_none());
        for notice in &gone {
            self.ends.add(&notice.place, Some(notice));
        }
        self.serve_channels();
        if is_first {
            // Nobody knows what they were notified of before: see `announce`.
            changed.clear();
        }
        if self.tells {
            for notice in gone.iter().chain(&changed) {
                told.extend(self.of_notice(notice));
            }
        }
        let noticed: BTreeSet<ServedTarget> =
            changed.into_iter().chain(gone).map(|notice| notice.place).collect();
        // What an earlier life wrote may be gone, or of another form.
        let all = if is_first { self.places() } else { tracked };
        for place in all.iter().filter(|place| !noticed.contains(place)) {
            if let Some(standing) = self.served.standing_of(place) {
                told.extend(self.of_standing(place, &standing));
            }
        }
        self.tell(told);
        self.announce(&noticed);
        self.tell_texts();
        if is_first && self.tells {
            self.outputs.speaker.sweep_keys();
        }
        self.tell_own();
        self.keep_notes();
        self.begin_telling();
        self.settle_soon();
        // After the notices: only what was told can go well or badly.
        self.follow_rollouts();
        if self.served.has_pending() {
            self.flush_soon();
        }
    }

    pub(super) fn places(&self) -> Vec<ServedTarget> {
        self.served.told().map(|(place, _)| place.clone()).collect()
    }

    /// The texts of secrets have come, which were not there before: whoever has them redacted has
    /// the right hash, and yet not what it needs. They are told with the change that they came
    /// with.
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
        let lacked = std::mem::replace(&mut self.lacks_texts, lacks_texts(self.view.state()));
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
    pub(super) fn tell(&self, told: Vec<Told>) {
        if self.tells {
            self.outputs.speaker.tell(told);
        }
    }

    /// The key of a place that has asked for the first time.
    pub(super) fn key_of_asker(&mut self, request: &GetRequest) {
        let Some(service) = &request.service else { return };
        let place = ServedTarget {
            service: service.clone(),
            instance: request.instance.clone(),
            node: self.identity.site.node.clone().or_else(|| request.node.clone()),
        };
        if self.keyed.get(&self.key_name(&place)) == Some(&place) {
            return;
        }
        if let Some(standing) = self.served.standing_of(&place) {
            let told = self.of_standing(&place, &standing);
            self.tell(told.into_iter().collect());
        }
    }

    /// A notice, and the key with it.
    pub(super) fn of_notice(&mut self, notice: &Notice) -> Option<Told> {
        let delivery = self.identity.delivery;
        let text = messages::notice(notice, delivery, now()).inspect_err(|error| {
            tracing::error!(
                place = %notice.place,
                %error,
                "nobody is told of a configuration that is too large",
            );
        });
        let key = match notice.standing() {
            Some(standing) => self.key(&notice.place, &standing),
            None => self.key_to_go(&notice.place),
        };
        Some(Told {
            place: notice.place.to_string(),
            key,
            notice: Some(KeyedMessage {
                channel: changed(&notice.place.service)?,
                key: record_key(&notice.place),
                value: Some(Bytes::from(text.ok()?)),
            }),
        })
    }

    /// The key alone; `None` if the place has none.
    pub(super) fn of_standing(
        &mut self,
        place: &ServedTarget,
        standing: &Standing,
    ) -> Option<Told> {
        if !self.tells {
            return None;
        }
        Some(Told { place: place.to_string(), key: Some(self.key(place, standing)?), notice: None })
    }

    /// That the key is to go, if it is this place's.
    fn without_key(&mut self, place: &ServedTarget) -> Option<Told> {
        Some(Told { place: place.to_string(), key: Some(self.key_to_go(place)?), notice: None })
    }

    fn key_to_go(&mut self, place: &ServedTarget) -> Option<(String, Option<Bytes>)> {
        let name = self.key_name(place);
        if self.keyed.get(&name) != Some(place) {
            return None;
        }
        self.keyed.remove(&name);
        Some((name, None))
    }

    fn key(
        &mut self,
        place: &ServedTarget,
        standing: &Standing,
    ) -> Option<(String, Option<Bytes>)> {
        if !self.served.has_key(place) {
            // It had one while its document was there.
            return self.key_to_go(place);
        }
        let value =
            messages::state_value(standing, self.identity.delivery, self.freshness()).ok()?;
        let name = self.key_name(place);
        self.keyed.insert(name.clone(), place.clone());
        Some((name, Some(Bytes::from(value))))
    }

    /// Without the prefix of the server.
    fn key_name(&self, place: &ServedTarget) -> String {
        messages::config_key(&place.service, place.instance.as_ref())
    }
}
