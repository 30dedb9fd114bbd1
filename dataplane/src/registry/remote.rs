//! What another flow announced, as far as it came, and what is still to be asked for.
//!
//! ```text
//! Hello (version, digest) ─ equal ─► in step
//!                         └ else, still so 50 ms later ─► pull: SnapshotRequest ─► parts ─► complete ─► apply
//! Delta ─ follows the own version ─► apply        (deltas that come during a pull are kept and applied after it)
//!       └ leaves a gap ─► wait for the missing one, then pull
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use blaze_domain::TopicName;
use blaze_proto::link::link_control as wire;

use super::announce::MAX_ENTRIES;
use super::pieces::{entry_hash, join};
use super::pull::Pull;
use super::replicas::Ways;
use super::types::SyncFaults;
use super::wire::from_wire;
use crate::world::TopicEntry;

/// A gap may close by itself for this long: a Delta may come after the Hello that tells of it.
const GRACE: Duration = Duration::from_millis(50);
/// Parts that do not come are asked for again after this time, unless the round trip is known.
const DEFAULT_RETRY: Duration = Duration::from_millis(200);
/// Requests without any answer, after which a pull is given up for a while.
const MAX_TRIES: u32 = 10;
/// Pause after a pull that failed or did not help, doubled each time.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
/// Longest such pause.
const LONGEST_PAUSE: Duration = Duration::from_secs(5);
/// Most parts of a snapshot.
const MAX_SNAPSHOT_PARTS: u32 = 16_384;
/// Most parts of a Delta.
const MAX_DELTA_PARTS: u32 = 64;
/// Most deltas that wait, for their parts or for those before them.
const MAX_PENDING_DELTAS: usize = 32;
/// Most entries in one part.
const MAX_PART_ENTRIES: usize = 1_000;

struct RemoteEntry {
    hash: u64,
    routes: Vec<wire::RouteState>,
}

struct PartialDelta {
    parts: Vec<Option<Vec<wire::Entry>>>,
    missing: usize,
}

/// The announcements of one other flow.
#[derive(Default)]
pub(super) struct Remote {
    version: u64,
    digest: u64,
    entries: BTreeMap<TopicName, RemoteEntry>,
    heard: (u64, u64),
    /// Hellos in a row that told of an older version than the one that is held.
    older_hellos: u32,
    /// The held state is wrong: no Delta can repair it.
    doubt: bool,
    pull_at: Option<Instant>,
    pull: Option<Pull>,
    failures: u32,
    /// By `to_version`, then `from_version`.
    pending: BTreeMap<(u64, u64), PartialDelta>,
    /// After how long what did not come is asked for again, once the round trip is known.
    retry: Option<Duration>,
    /// How it is reached.
    pub(super) ways: Ways,
    /// Since when it has been ready, without a break.
    pub(super) ready_since: Option<Instant>,
    /// The life that its process began with, as it says on the channel of the layer broker.
    pub(super) began: Option<u64>,
    /// Since when it has been a gateway, if it was none while it carried topics before.
    pub(super) new_gateway: Option<Instant>,
    /// Since when it cannot be reached.
    pub(super) down_since: Option<Instant>,
    /// Flows of other groups that it reaches over the inter scope, as it says on the channel of the
    /// layer broker.
    pub(super) link_peers: u32,
}

/// The entries of a flow, as its view in the world has them.
pub(super) type Topics = BTreeMap<TopicName, TopicEntry>;

impl Remote {
    pub(super) fn set_round_trip(&mut self, round_trip: Duration) {
        self.retry =
            Some((round_trip * 2).clamp(Duration::from_millis(50), Duration::from_secs(2)));
    }

    pub(super) fn routes(&self, topic: &TopicName) -> &[wire::RouteState] {
        self.entries.get(topic).map_or(&[], |entry| &entry.routes)
    }

    pub(super) fn topics_with_routes(&self) -> impl Iterator<Item = &TopicName> {
        self.entries.iter().filter(|(_, entry)| !entry.routes.is_empty()).map(|(topic, _)| topic)
    }

    pub(super) fn is_in_step(&self) -> bool {
        (self.version, self.digest) == self.heard && !self.doubt
    }

    /// Until when it had read what is published on the layer broker, as its last sign of life says,
    /// by the server's clock.
    pub(super) fn last_read_ms(&self) -> Option<i64> {
        self.ways.layer?.read_ms
    }

    pub(super) fn is_pulling(&self) -> bool {
        self.pull.is_some()
    }

    /// Stops asking, because nobody is there to answer. The next Hello begins anew.
    pub(super) fn stop(&mut self) {
        self.pull = None;
        self.pull_at = None;
    }

    /// The flow told which version it has announced. What is to be pulled is not asked for within
    /// the time that `patience` gives, which costs something to reckon.
    pub(super) fn on_hello(
        &mut self,
        now: Instant,
        version: u64,
        digest: u64,
        patience: impl FnOnce() -> Duration,
    ) {
        if version < self.version {
            // A late Hello, unless the next ones say so too.
            self.older_hellos += 1;
            if self.older_hellos < 3 {
                return;
            }
            self.doubt = true;
        } else {
            self.older_hellos = 0;
        }
        self.heard = (version, digest);
        if (self.version, self.digest) == self.heard {
            self.settle();
            return;
        }
        self.doubt |= version == self.version;
        if self.pull.is_none() && self.pull_at.is_none() {
            self.plan_pull(now + patience());
        }
    }

    fn settle(&mut self) {
        self.doubt = false;
        self.failures = 0;
        self.pull = None;
        self.pull_at = None;
        let version = self.version;
        self.pending.retain(|(to, _), _| *to > version);
    }

    fn plan_pull(&mut self, now: Instant) {
        if self.pull.is_none() {
            let pause = if self.failures == 0 {
                GRACE
            } else {
                FIRST_PAUSE.saturating_mul(1 << self.failures.min(8)).min(LONGEST_PAUSE)
            };
            self.pull_at.get_or_insert(now + pause);
        }
    }

    /// Takes a part of a Delta. Returns the topics that changed.
    pub(super) fn on_delta(
        &mut self,
        now: Instant,
        delta: wire::Delta,
        topics: &mut Topics,
        faults: &mut SyncFaults,
    ) -> BTreeSet<TopicName> {
        let (from, to) = (delta.from_version, delta.to_version);
        let (Ok(part), Ok(parts)) = (usize::try_from(delta.part), usize::try_from(delta.parts))
        else {
            return BTreeSet::new();
        };
        if from >= to
            || delta.parts > MAX_DELTA_PARTS
            || part >= parts
            || delta.entries.len() > MAX_PART_ENTRIES
        {
            faults.bad_parts += 1;
            return BTreeSet::new();
        }
        if to <= self.version && self.pull.is_none() {
            return BTreeSet::new();
        }
        let pending = self
            .pending
            .entry((to, from))
            .or_insert_with(|| PartialDelta { parts: vec![None; parts], missing: parts });
        if pending.parts.len() != parts {
            faults.bad_parts += 1;
        } else if let Some(slot @ None) = pending.parts.get_mut(part) {
            pending.missing -= 1;
            *slot = Some(delta.entries);
        }
        if self.pending.len() > MAX_PENDING_DELTAS {
            self.pending.pop_first();
            faults.evicted_deltas += 1;
        }
        self.advance(now, topics, faults)
    }

    /// Applies every Delta that follows from the held version.
    fn advance(
        &mut self,
        now: Instant,
        topics: &mut Topics,
        faults: &mut SyncFaults,
    ) -> BTreeSet<TopicName> {
        let mut changed = BTreeSet::new();
        while !self.doubt {
            let version = self.version;
            let follows = |(to, from): (u64, u64)| to > version && from <= version;
            let mut newest_first = self.pending.iter().rev();
            let next = newest_first.find(|(key, delta)| follows(**key) && delta.missing == 0);
            let Some(key) = next.map(|(key, _)| *key) else { break };
            let delta = if self.pull.is_some() {
                // The snapshot that is being pulled may be older than this: then it is needed once
                // more.
                self.pending.get(&key).map(|delta| delta.parts.clone())
            } else {
                self.pending.remove(&key).map(|delta| delta.parts)
            };
            let pieces = delta.into_iter().flatten().flatten().flatten();
            self.apply(pieces, false, topics, faults, &mut changed);
            self.version = key.0;
        }
        let version = self.version;
        if self.pull.is_none() {
            self.pending.retain(|(to, _), _| *to > version);
        }
        if version == self.heard.0 && self.digest != self.heard.1 {
            self.doubt = true;
        }
        if !self.doubt && version >= self.heard.0 {
            self.heard = (version, self.digest);
            self.pull = None;
            self.pull_at = None;
            self.pending.retain(|(to, _), _| *to > version);
        }
        if self.doubt || !self.pending.is_empty() || version < self.heard.0 {
            self.plan_pull(now);
        }
        changed
    }

    /// Takes a part of a snapshot. Returns the topics that changed.
    pub(super) fn on_snapshot(
        &mut self,
        now: Instant,
        snapshot: wire::Snapshot,
        topics: &mut Topics,
        faults: &mut SyncFaults,
    ) -> BTreeSet<TopicName> {
        if self.pull.is_none() && self.pull_at.is_some() {
            // Somebody else has asked for what this one was about to ask for, and all hear the
            // answer.
            self.pull_at = None;
            self.pull = Some(Pull::overheard(now, self.retry.unwrap_or(DEFAULT_RETRY)));
        }
        let Some(pull) = &mut self.pull else {
            faults.unasked_parts += 1;
            return BTreeSet::new();
        };
        if snapshot.parts > MAX_SNAPSHOT_PARTS
            || snapshot.part >= snapshot.parts
            || snapshot.entries.len() > MAX_PART_ENTRIES
        {
            faults.bad_parts += 1;
            return BTreeSet::new();
        }
        if !pull.take(now, snapshot) {
            faults.unasked_parts += 1;
        }
        match self.pull.take_if(|pull| pull.is_complete()) {
            Some(pull) => self.finish(now, pull, topics, faults),
            None => BTreeSet::new(),
        }
    }

    fn finish(
        &mut self,
        now: Instant,
        pull: Pull,
        topics: &mut Topics,
        faults: &mut SyncFaults,
    ) -> BTreeSet<TopicName> {
        let mut changed = BTreeSet::new();
        self.apply(pull.parts.into_iter().flatten().flatten(), true, topics, faults, &mut changed);
        self.version = pull.version.unwrap_or(0);
        self.pull_at = None;
        self.older_hellos = 0;
        self.doubt = false;
        self.failures = self.failures.saturating_add(1);
        changed.extend(self.advance(now, topics, faults));
        if self.is_in_step() {
            self.settle();
        }
        changed
    }

    /// Applies the pieces of a whole Delta or snapshot.
    fn apply(
        &mut self,
        pieces: impl IntoIterator<Item = wire::Entry>,
        replace: bool,
        topics: &mut Topics,
        faults: &mut SyncFaults,
        changed: &mut BTreeSet<TopicName>,
    ) {
        let mut gone: BTreeSet<TopicName> =
            if replace { self.entries.keys().cloned().collect() } else { BTreeSet::new() };
        // What goes makes room for what comes.
        let (removed, told): (Vec<_>, Vec<_>) =
            join(pieces).into_values().partition(|entry| entry.removed);
        for entry in removed {
            match entry.topic.parse() {
                Ok(topic) if self.entries.contains_key(&topic) => {
                    gone.insert(topic);
                }
                Ok(_) => {}
                Err(_) => faults.bad_entries += 1,
            }
        }
        for entry in told {
            let Ok((topic, merged)) = from_wire(&entry) else {
                faults.bad_entries += 1;
                continue;
            };
            gone.remove(&topic);
            if !self.entries.contains_key(&topic) && self.entries.len() >= MAX_ENTRIES + gone.len()
            {
                faults.too_many_entries += 1;
                continue;
            }
            let hash = entry_hash(&entry);
            let new = RemoteEntry { hash, routes: entry.route_state };
            let old = self.entries.insert(topic.clone(), new);
            self.digest =
                self.digest.wrapping_add(hash).wrapping_sub(old.as_ref().map_or(0, |old| old.hash));
            let before = topics.remove(&topic).unwrap_or_default();
            // Not all of it is in the hash.
            if old.is_none_or(|old| old.hash != hash) || before != merged {
                changed.insert(topic.clone());
            }
            if !merged.is_empty() {
                topics.insert(topic, merged);
            }
        }
        for topic in gone {
            topics.remove(&topic);
            if let Some(old) = self.entries.remove(&topic) {
                self.digest = self.digest.wrapping_sub(old.hash);
                changed.insert(topic);
            }
        }
    }

    /// When [`Remote::poll`] has something to ask for.
    pub(super) fn next_poll(&self) -> Option<Instant> {
        match &self.pull {
            Some(pull) => Some(pull.next_request),
            None => self.pull_at,
        }
    }

    /// The next request, if it is time for one. `may_start` tells whether another pull may begin.
    pub(super) fn poll(&mut self, now: Instant, may_start: bool) -> Option<wire::SnapshotRequest> {
        if self.pull.is_none() {
            if !may_start || self.pull_at.is_none_or(|at| at > now) {
                return None;
            }
            self.pull_at = None;
            self.pull = Some(Pull::new(now));
        }
        let retry = self.retry.unwrap_or(DEFAULT_RETRY);
        let pull = self.pull.as_mut().filter(|pull| pull.next_request <= now)?;
        if pull.tries >= MAX_TRIES {
            self.pull = None;
            self.failures = self.failures.saturating_add(1);
            self.plan_pull(now);
            return None;
        }
        Some(pull.request(now, retry))
    }
}
