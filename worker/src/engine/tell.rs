//! From a change to what services are told.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::config::effective::At;
use blaze_domain::names::ChannelName;
use blaze_domain::{DocumentName, InstanceName};
use bytes::Bytes;
use tokio::time::Instant;

use super::{Engine, TOGETHER, now};
use crate::copy::{Notes, Position, Told as Noted, Update};
use crate::core::messages::{self, GetRequest};
use crate::core::{Flushed, Notice, Place, Site, Standing, Told as ServedTold};
use crate::serve::Told;

/// How long ago a notice may be that a new leader tells once more, because the one before may have died over it.
const RECENT: Duration = Duration::from_secs(15);
/// Notices that are remembered for that.
const MAX_RECENT: usize = 10_000;

/// What an earlier life told, from its notes.
pub(super) fn told_of(notes: &Notes) -> Vec<(Place, ServedTold)> {
    let place = |at: &At| {
        Some(Place {
            service: at.service.clone()?,
            instance: at.instance.as_ref().map(InstanceName::from),
            node: at.node.clone(),
        })
    };
    let told = |noted: &Noted| ServedTold {
        revision: noted.revision,
        hash: noted.hash.as_ref().map(ToString::to_string),
    };
    let all = notes.all_told().filter_map(|(at, noted)| Some((place(at)?, told(noted))));
    all.collect()
}

fn at(place: &Place, site: &Site) -> At {
    At {
        service: Some(place.service.clone()),
        instance: place.instance.as_ref().map(DocumentName::from),
        layer: Some(site.layer.clone()),
        node: place.node.clone(),
    }
}

fn channel(notice: &Notice) -> Option<ChannelName> {
    // A name of a service is always part of a good one.
    format!("blaze/config/changed/{}", notice.place.service).parse().ok()
}

impl Engine {
    /// Has changes told: at once after a quiet while, else together with what comes until then.
    pub(super) fn flush_soon(&mut self) {
        let next = self.flushed.map_or_else(Instant::now, |last| last + TOGETHER);
        self.flush_at.get_or_insert(next);
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
        let mut told: Vec<Told> = Vec::with_capacity(notices.len());
        // First what goes: an instance that moves has the same key there.
        for place in &untracked {
            self.notes.forget(&at(place, &self.identity.site));
            if self.keyed.remove(place) {
                told.push(self.without_key(place));
            }
        }
        let is_gone = |notice: &&Notice| notice.hash.is_none();
        for notice in notices.iter().filter(is_gone).chain(notices.iter().filter(|notice| !is_gone(notice))) {
            told.extend(self.of_notice(notice));
            if !untracked.contains(&notice.place) {
                self.note(&notice.place, notice.revision, notice.hash.as_deref());
            }
        }
        let noticed: BTreeSet<&Place> = notices.iter().map(|notice| &notice.place).collect();
        for place in &tracked {
            if let Some(standing) = self.served.standing_of(place) {
                self.note(place, standing.revision, Some(&standing.hash));
                if !noticed.contains(place) {
                    told.extend(self.of_standing(place, &standing));
                }
            }
        }
        if !notices.is_empty() || !tracked.is_empty() || !untracked.is_empty() {
            self.keep_notes();
        }
        self.tell(told, instant);
        // After the notices: only what was told can go well or badly.
        self.follow_rollouts();
        if self.served.has_pending() {
            self.flush_soon();
        }
    }

    fn tell(&mut self, told: Vec<Told>, at: Instant) {
        if self.is_leader {
            self.outputs.speaker.tell(told);
            return;
        }
        self.recent.extend(told.into_iter().map(|told| (at, told)));
        while self.recent.len() > MAX_RECENT || self.recent.front().is_some_and(|(then, _)| at - *then > RECENT) {
            self.recent.pop_front();
        }
    }

    /// This worker answers and notifies from now on, or does not any more.
    pub(super) fn lead(&mut self, is_leader: bool) {
        if self.is_leader == is_leader {
            return;
        }
        self.is_leader = is_leader;
        tracing::info!(is_leader, "the lease of the layer");
        if !is_leader {
            return;
        }
        let now = Instant::now();
        let recent = std::mem::take(&mut self.recent);
        let recent = recent.into_iter().filter(|(then, _)| now - *then <= RECENT);
        self.outputs.speaker.tell(recent.map(|(_, told)| told));
        // Keys may be those of an older state.
        let places: Vec<Place> = self.served.told().map(|(place, _)| place.clone()).collect();
        let all: Vec<Told> = places
            .iter()
            .filter_map(|place| self.of_standing(place, &self.served.standing_of(place)?))
            .collect();
        self.outputs.speaker.tell(all);
    }

    /// The key of a place that has asked for the first time.
    pub(super) fn key_of_asker(&mut self, request: &GetRequest) {
        let Some(service) = &request.service else { return };
        let place = Place {
            service: service.clone(),
            instance: request.instance.clone(),
            node: self.identity.site.node.clone().or_else(|| request.node.clone()),
        };
        if self.keyed.contains(&place) {
            return;
        }
        if let Some(standing) = self.served.standing_of(&place) {
            self.note(&place, standing.revision, Some(&standing.hash));
            self.keep_notes();
            let told = self.of_standing(&place, &standing);
            self.tell(told.into_iter().collect(), Instant::now());
        }
    }

    /// A notice, and the key with it.
    fn of_notice(&mut self, notice: &Notice) -> Option<Told> {
        let delivery = self.identity.delivery;
        let text = messages::notice(notice, delivery, now()).inspect_err(|error| {
            tracing::error!(place = %notice.place, %error, "nobody is told of a configuration that is too large");
        });
        let key = match notice.standing() {
            Some(standing) => self.key(&notice.place, &standing),
            None => self.keyed.remove(&notice.place).then(|| (self.key_name(&notice.place), None)),
        };
        Some(Told {
            place: notice.place.to_string(),
            key,
            notice: Some((channel(notice)?, Bytes::from(text.ok()?))),
        })
    }

    /// The key alone; `None` if the place has none.
    fn of_standing(&mut self, place: &Place, standing: &Standing) -> Option<Told> {
        Some(Told {
            place: place.to_string(),
            key: Some(self.key(place, standing)?),
            notice: None,
        })
    }

    fn without_key(&self, place: &Place) -> Told {
        Told {
            place: place.to_string(),
            key: Some((self.key_name(place), None)),
            notice: None,
        }
    }

    fn key(&mut self, place: &Place, standing: &Standing) -> Option<(String, Option<Bytes>)> {
        if !self.served.has_key(place) {
            return None;
        }
        let value = messages::state_value(standing, self.identity.delivery, self.freshness()).ok()?;
        self.keyed.insert(place.clone());
        Some((self.key_name(place), Some(Bytes::from(value))))
    }

    /// Without the prefix of the server.
    fn key_name(&self, place: &Place) -> String {
        messages::config_key("", &place.service, place.instance.as_ref())
    }

    fn note(&mut self, place: &Place, revision: u64, hash: Option<&str>) {
        let told = Noted {
            revision,
            hash: hash.map(Arc::from),
        };
        self.notes.tell(at(place, &self.identity.site), told);
    }

    /// Has the notes kept beside the newest state.
    pub(super) fn keep_notes(&mut self) {
        let Some(copies) = &self.outputs.copies else { return };
        let (Some(store_id), Some(as_of)) = (self.replica.store_id(), self.replica.as_of()) else {
            return;
        };
        copies.store(&Update {
            position: Position {
                store_id: store_id.to_owned(),
                layer: self.identity.site.layer.clone(),
                revision: self.replica.state().revision(),
                as_of,
            },
            state: self.replica.state().clone(),
            changed: crate::copy::Changed::Keys(Vec::new()),
            notes: Some(Arc::new(self.notes.clone())),
        });
    }
}
