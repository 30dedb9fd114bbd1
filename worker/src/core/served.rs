//! Who is served with what, and who must be told of a change.
//!
//! ```text
//! load, apply, fail_rollout ──▶ next documents + keys that changed      (any number of times, at most 20 ms)
//!                                    │ flush
//!                                    ▼
//!   places that they can concern ──▶ another hash? ──▶ Notice
//!                                    │
//!                                    ▼
//!                              shown documents ──▶ answers
//! ```
//!
//! Answers come from the documents of the last [`Served::flush`], as notices do: so what a place
//! was told last is always what its configuration is in the shown documents, and no configuration
//! has to be kept beside them.

#[path = "served_trial.rs"]
mod trial;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Instant;

use blaze_domain::config::Key;
use blaze_domain::config::effective::{ConfigTarget, Sources};
use blaze_domain::config::state::State;
use blaze_domain::{InstanceName, ServiceName};
use serde_json::{Map, Value};

use super::asked::Asked;
use super::change::{Change, difference};
use super::notice::{Config, Notice, Standing, paths, scopes};
use super::reach::{Places, concerned};
use super::served_target::{ServedTarget, Site, Source};
use super::told::{Flushed, Told};
use super::world::World;

pub use trial::Trial;

/// Roll-outs that are remembered as failed here, at most.
pub const MAX_FAILED: usize = 1_000;

/// Who is served with what.
pub struct Served {
    site: Site,
    /// What is answered from.
    shown: World,
    /// What it will be after the next flush.
    next: World,
    /// Documents that differ between the two, and failed roll-outs.
    pending: BTreeSet<Key>,
    /// Of which store the next documents are.
    store: Option<Arc<str>>,
    /// Where the next documents come from.
    rank: Option<Source>,
    /// Whether the stream from the main service is there and everything was told.
    in_sync: bool,
    /// No place is told a lower revision from now on, whatever store follows.
    floor: u64,
    places: Places,
    asked: Asked,
    /// Places that went since the last flush.
    untracked: Vec<ServedTarget>,
    /// Places that asked and were forgotten for others.
    evicted: u64,
    /// Places of another life that were not looked at yet: nobody knows what they were told.
    restored: BTreeSet<ServedTarget>,
}

impl Served {
    /// Nobody yet.
    #[must_use]
    pub fn new(site: Site) -> Self {
        Self {
            site,
            shown: World::default(),
            next: World::default(),
            pending: BTreeSet::new(),
            store: None,
            rank: None,
            in_sync: false,
            floor: 0,
            places: Places::default(),
            asked: Asked::default(),
            untracked: Vec::new(),
            evicted: 0,
            restored: BTreeSet::new(),
        }
    }

    /// What is served.
    #[must_use]
    pub fn site(&self) -> &Site {
        &self.site
    }

    /// Where the documents come from: those that the main service told are a copy as soon as it is
    /// not certain any more that they are its newest.
    #[must_use]
    pub fn source(&self) -> Option<Source> {
        match self.rank? {
            Source::Main if !self.in_sync => Some(Source::Copy),
            rank => Some(rank),
        }
    }

    /// Whether anybody can be answered.
    #[must_use]
    pub fn is_ready(&self) -> bool {
        self.shown.is_loaded
    }

    /// The documents that answers come from.
    #[must_use]
    pub fn state(&self) -> &State {
        &self.shown.state
    }

    /// Every place that is told of changes, with what it was told last.
    pub fn told(&self) -> impl Iterator<Item = (&ServedTarget, &Told)> {
        self.places.all()
    }

    /// Whether an instance of a service, or the service without one, is told of changes anywhere.
    #[must_use]
    pub fn tells(&self, service: &ServiceName, instance: Option<&InstanceName>) -> bool {
        let mut places = self.places.of_service(service);
        places.any(|place| place.instance.as_ref() == instance)
    }

    /// Uids of the roll-outs that failed here, the oldest first.
    #[must_use]
    pub fn failed(&self) -> &[String] {
        &self.next.failed
    }

    /// Of which store the next documents are that are taken, unless they are of a file.
    pub fn set_store(&mut self, store_id: Option<&str>) {
        self.store = store_id.map(Arc::from);
    }

    /// Takes documents from a copy or a file, unless what is served comes from a stronger source.
    /// Gives whether it did.
    pub fn load(&mut self, state: State, source: Source) -> bool {
        let is_taken = self.rank.is_none_or(|held| held <= source);
        if is_taken {
            self.pending.extend(difference(&self.next.state, &state));
            self.replace(state, source);
        }
        is_taken
    }

    /// Takes a change that the main service told.
    pub fn apply(&mut self, change: &Change) {
        match self.rank {
            Some(Source::Main) => self.pending.extend(change.keys.iter().cloned()),
            // Whether it began from the same documents as are served is not certain.
            Some(Source::Copy | Source::File) | None => {
                self.pending.extend(difference(&self.next.state, &change.new));
            }
        }
        self.replace(change.new.clone(), Source::Main);
    }

    fn replace(&mut self, state: State, source: Source) {
        self.next.state = state;
        self.next.store = match source {
            Source::File => None,
            Source::Copy | Source::Main => self.store.clone(),
        };
        self.next.is_loaded = true;
        self.rank = Some(source);
    }

    /// Says whether the documents are known to be the main service's newest. If so, they count as
    /// coming from there, also if it had nothing to add to the copy.
    pub fn set_in_sync(&mut self, in_sync: bool) {
        self.in_sync = in_sync;
        if in_sync && self.rank.is_some() {
            self.rank = Some(Source::Main);
        }
    }

    /// Whether a place has a key of its own in Redis: there, a place is service and instance alone.
    /// On the broker of a layer one instance may ask from several nodes, so only the place of its
    /// document has it.
    #[must_use]
    pub fn has_key(&self, place: &ServedTarget) -> bool {
        self.site.node.is_some() || self.site.is_home(&self.shown.state, place)
    }

    /// Whether a flush would look at anything.
    #[must_use]
    pub fn has_pending(&self) -> bool {
        let has_documents = !self.pending.is_empty() || self.next.is_loaded != self.shown.is_loaded;
        has_documents
            || !self.untracked.is_empty()
            || (self.next.is_loaded && !self.restored.is_empty())
    }

    /// Shows the newest documents, and tells whose configuration is another one than the last that
    /// they were told.
    pub fn flush(&mut self, now: Instant) -> Flushed {
        let mut out =
            Flushed { untracked: std::mem::take(&mut self.untracked), ..Flushed::default() };
        for place in self.asked.expire(now) {
            if self.drop_unless_home(&place) {
                out.untracked.push(place);
            }
        }
        let keys = std::mem::take(&mut self.pending);
        self.floor = self.floor.max(self.next.state.revision());
        if self.next.is_loaded {
            let (old, new) = (&self.shown.state, &self.next.state);
            let mut looked = concerned(&self.site, &self.places, old, new, &keys);
            let restored = std::mem::take(&mut self.restored);
            looked.extend(restored.iter().cloned());
            for place in looked {
                let is_open = restored.contains(&place);
                self.look(place, is_open, &mut out);
            }
        }
        self.shown = self.next.clone();
        out
    }

    /// `is_open`: whether nobody knows what the place has, so that it hears how it is in any case.
    fn look(&mut self, place: ServedTarget, is_open: bool, out: &mut Flushed) {
        let told = self.places.get(&place);
        let old = self.shown.at(&self.site, &place);
        let new = self.next.at(&self.site, &place);
        let old_hash = old.as_ref().map(Sources::hash);
        let hash = new.as_ref().map(Sources::hash);
        // Who was not told anything yet could have asked: the configuration was there without its
        // document.
        let before = told.map_or_else(|| old_hash.clone(), |told| told.hash.clone());
        let is_tracked = told.is_some();
        let revision = match told {
            Some(told) if told.hash == hash && !is_open => told.revision,
            Some(_) | None => self.floor,
        };
        if before != hash || is_open {
            let known = old.filter(|_| old_hash == before);
            out.notices.push(self.notice(&place, revision, before, known, new.zip(hash.clone())));
        }
        let is_asked = self.asked.contains(&place);
        if is_asked || self.site.is_home(&self.next.state, &place) {
            if !is_tracked {
                out.tracked.push(place.clone());
            }
            self.places.insert(place, Told { revision, hash });
        } else if self.places.remove(&place) {
            out.untracked.push(place);
        }
    }

    /// A notice for each place, for a worker that begins to notify. They have the newest revision:
    /// other workers may have notified the same state with a later one than is known here.
    pub fn announce(&mut self) -> Vec<Notice> {
        let places: Vec<(ServedTarget, String)> = self
            .places
            .all()
            .filter_map(|(place, told)| Some((place.clone(), told.hash.clone()?)))
            .collect();
        let revision = self.floor;
        let mut notices = Vec::with_capacity(places.len());
        for (place, hash) in places {
            let Some(sources) = self.shown.at(&self.site, &place) else {
                continue;
            };
            notices.push(self.notice(&place, revision, None, None, Some((sources, hash.clone()))));
            let hash = Some(hash);
            self.places.insert(place, Told { revision, hash });
        }
        notices
    }

    /// Takes an instance that runs with a configuration of this layer and is not known here: it may
    /// have asked another life, or another worker, that was killed before it noted so. A notice, in
    /// any case: what the instance says of its configuration may be older than what it has.
    pub fn meet(&mut self, place: &ServedTarget, now: Instant) -> Option<Notice> {
        if !self.is_ready() {
            return None;
        }
        if self.places.get(place).is_some() {
            if self.asked.contains(place) {
                self.note_asked(place, now);
            }
            return None;
        }
        let standing = self.ask(place, now)?;
        let new = (self.shown.at(&self.site, place)?, standing.hash);
        Some(self.notice(place, standing.revision, None, None, Some(new)))
    }

    /// Takes over what another life, or another worker, knew: places that it notified, and the
    /// revision up to which it did. The places count as if they had asked now, because they may
    /// well be running.
    pub fn restore(
        &mut self,
        floor: u64,
        places: impl IntoIterator<Item = ServedTarget>,
        now: Instant,
    ) {
        self.floor = self.floor.max(floor);
        for place in places {
            self.note_asked(&place, now);
            if self.places.get(&place).is_none() {
                self.restored.insert(place);
            }
        }
    }

    /// Takes a later state of the store that is served: it replaces even what the main service
    /// told.
    pub fn take_later(&mut self, state: State) {
        self.pending.extend(difference(&self.next.state, &state));
        let rank = self.rank.map_or(Source::Copy, |rank| rank.max(Source::Copy));
        self.replace(state, rank);
    }

    /// Number of places that asked and were forgotten, because too many asked.
    #[must_use]
    pub fn evicted(&self) -> u64 {
        self.evicted
    }

    /// No place is notified with a lower revision.
    #[must_use]
    pub fn floor(&self) -> u64 {
        self.floor
    }

    /// Another number whenever a place has come or gone.
    #[must_use]
    pub fn places_version(&self) -> u64 {
        self.places.version()
    }

    /// `old` is what the place was told last, as far as it is known.
    fn notice(
        &self,
        place: &ServedTarget,
        revision: u64,
        previous_hash: Option<String>,
        old: Option<Sources>,
        new: Option<(Sources, String)>,
    ) -> Notice {
        let mut notice = Notice {
            place: place.clone(),
            layer: self.site.layer.clone(),
            revision,
            hash: None,
            previous_hash,
            paths: Vec::new(),
            scopes: Vec::new(),
            config: None,
            source: self.source().unwrap_or(Source::File),
            store: self.next.store.clone(),
            rollout: None,
        };
        if let Some((new, hash)) = new {
            let config = Config::of(&new);
            let before = old.as_ref().map_or_else(|| Value::Object(Map::new()), Sources::merged);
            notice.paths = paths(&before, config.value());
            notice.scopes = scopes(&old.unwrap_or_default(), &new, place.service.as_str());
            notice.config = Some(config);
            notice.hash = Some(hash);
            notice.rollout = new.rollout;
        }
        notice
    }

    /// Notes that a place asked, so that it is told of changes for a while.
    fn note_asked(&mut self, place: &ServedTarget, now: Instant) {
        let Some(evicted) = self.asked.touch(place, now) else {
            return;
        };
        if self.drop_unless_home(&evicted) {
            self.evicted += 1;
            self.untracked.push(evicted);
        }
    }

    /// Whether it is not told any more.
    fn drop_unless_home(&mut self, place: &ServedTarget) -> bool {
        !self.site.is_home(&self.next.state, place) && self.places.remove(place)
    }

    /// The configuration of a place that asks; `None` if there is no such service.
    pub(super) fn ask(&mut self, place: &ServedTarget, now: Instant) -> Option<Standing> {
        let sources = self.shown.at(&self.site, place)?;
        self.note_asked(place, now);
        if self.places.get(place).is_none() {
            let told = Told { revision: self.floor, hash: Some(sources.hash()) };
            self.places.insert(place.clone(), told);
        }
        self.standing_of(place)
    }

    /// The configuration of a place that is told of changes, as it was told last.
    #[must_use]
    pub fn standing_of(&self, place: &ServedTarget) -> Option<Standing> {
        let told = self.places.get(place)?;
        let hash = told.hash.clone()?;
        let sources = self.shown.at(&self.site, place)?;
        Some(self.standing(place.at(&self.site), told.revision, hash, sources))
    }

    /// The configuration of a place, without counting it as one that asked; `None`: nothing is
    /// there, or no such service.
    #[must_use]
    pub fn look_up(&self, place: &ServedTarget) -> Option<Standing> {
        let sources = self.shown.at(&self.site, place).filter(|_| self.is_ready())?;
        let hash = sources.hash();
        Some(self.standing(place.at(&self.site), self.floor, hash, sources))
    }

    /// The configuration of a layer, or of a node of it, without any service.
    pub(super) fn standing_at(&self, at: ConfigTarget) -> Standing {
        let sources = self.shown.sources(&at);
        let hash = sources.hash();
        self.standing(at, self.floor, hash, sources)
    }

    fn standing(
        &self,
        at: ConfigTarget,
        revision: u64,
        hash: String,
        sources: Sources,
    ) -> Standing {
        Standing {
            at,
            revision,
            hash,
            config: Config::of(&sources),
            source: self.source().unwrap_or(Source::File),
            store: self.shown.store.clone(),
            rollout: sources.rollout,
        }
    }
}

#[cfg(test)]
#[path = "random_tests.rs"]
mod random_tests;
#[cfg(test)]
#[path = "served_tests.rs"]
mod tests;
