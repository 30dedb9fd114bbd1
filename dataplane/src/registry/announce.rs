//! What the flow tells others of its own topics: versions, deltas and snapshots.
//!
//! ```text
//! mark ─(quiet for 10 ms)─► announce: version + 1, digest, Delta to every flow
//! SnapshotRequest ─► request: parts of one version, which is kept until it is no longer asked for
//! ```

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use blaze_domain::TopicName;
use blaze_proto::link::link_control as wire;

use super::pieces::{entry_hash, pack, pieces};
use super::wire::removed;

/// Changes wait this long for more of them.
const DEBOUNCE: Duration = Duration::from_millis(10);
/// Longest Delta, in parts; more changes at once are pulled as a snapshot, at the receiver's pace.
const MAX_DELTA_PARTS: usize = 8;
/// Versions that a Delta may reach back, so that one lost Delta is repaired by the next.
const REACH_BACK: usize = 8;
/// Most leases of a flow, hence most topics that it announces because of them.
pub(super) const MAX_LEASED_ENTRIES: usize = 10_000;
/// Most topics that it announces only to tell of their routes.
const MAX_ROUTE_ENTRIES: usize = 2_000;
/// Most topics that any flow announces.
pub(super) const MAX_ENTRIES: usize = MAX_LEASED_ENTRIES + MAX_ROUTE_ENTRIES;
/// Parts of a snapshot that may be asked for at a time.
pub(super) const MAX_ASKED_PARTS: usize = 8;
/// A snapshot that nobody asks for is kept this long.
const SNAPSHOT_UNUSED: Duration = Duration::from_secs(5);
/// A snapshot this young is given to newcomers, though changes came since: deltas bring them.
const SNAPSHOT_FRESH: Duration = Duration::from_millis(500);
/// Snapshots of different versions kept at a time; the one unused for longest gives way.
const MAX_SNAPSHOTS: usize = 8;

struct Announced {
    entry: wire::Entry,
    hash: u64,
}

struct HeldSnapshot {
    version: u64,
    parts: Vec<Vec<wire::Entry>>,
    made: Instant,
    used: Instant,
}

/// The announced state, and what is not yet announced.
#[derive(Default)]
pub(super) struct Announcer {
    version: u64,
    digest: u64,
    entries: BTreeMap<TopicName, Announced>,
    dirty: BTreeSet<TopicName>,
    due: Option<Instant>,
    recent: VecDeque<(u64, BTreeSet<TopicName>)>,
    snapshots: Vec<HeldSnapshot>,
    route_entries: usize,
    /// Route states that were not announced, because there are too many.
    pub(super) left_out: u64,
}

impl Announcer {
    /// Version and digest of what is announced.
    pub(super) fn announced(&self) -> (u64, u64) {
        (self.version, self.digest)
    }

    /// A topic may have changed.
    pub(super) fn mark(&mut self, now: Instant, topic: TopicName) {
        self.dirty.insert(topic);
        self.due.get_or_insert(now + DEBOUNCE);
    }

    /// When [`Announcer::announce`] has something to do.
    pub(super) fn due(&self) -> Option<Instant> {
        self.due
    }

    /// Takes the changes into the announced state; the parts of the Delta to send, if any. `current` gives the entry of
    /// a topic, `None` where nothing is left of it.
    pub(super) fn announce(
        &mut self,
        now: Instant,
        current: impl Fn(&TopicName) -> Option<wire::Entry>,
    ) -> Vec<wire::Delta> {
        if self.due.is_none_or(|due| due > now) {
            return Vec::new();
        }
        self.due = None;
        let mut changed = BTreeSet::new();
        for topic in std::mem::take(&mut self.dirty) {
            if self.take(&topic, current(&topic)) {
                changed.insert(topic);
            }
        }
        if changed.is_empty() {
            return Vec::new();
        }
        self.version += 1;
        if self.recent.len() == REACH_BACK {
            self.recent.pop_front();
        }
        self.recent.push_back((self.version, changed));
        self.delta()
    }

    fn take(&mut self, topic: &TopicName, entry: Option<wire::Entry>) -> bool {
        let old = self.entries.remove(topic);
        if let Some(old) = &old {
            self.digest = self.digest.wrapping_sub(old.hash);
            self.route_entries -= usize::from(only_routes(&old.entry));
        }
        let fits = |entry: &wire::Entry| self.route_entries < MAX_ROUTE_ENTRIES || !only_routes(entry);
        let Some(entry) = entry else {
            return old.is_some();
        };
        if !fits(&entry) {
            self.left_out += 1;
            return old.is_some();
        }
        let changed = old.as_ref().is_none_or(|old| old.entry != entry);
        let hash = entry_hash(&entry);
        self.digest = self.digest.wrapping_add(hash);
        self.route_entries += usize::from(only_routes(&entry));
        self.entries.insert(topic.clone(), Announced { entry, hash });
        changed
    }

    /// The Delta to the newest version, from as far back as costs no further datagram.
    fn delta(&self) -> Vec<wire::Delta> {
        let mut topics = BTreeSet::new();
        let mut parts = Vec::new();
        let mut from_version = self.version;
        for (version, changed) in self.recent.iter().rev() {
            topics.extend(changed.iter());
            let longer = pack(topics.iter().flat_map(|topic| self.pieces_of(topic)));
            let newest = *version == self.version;
            if (newest && longer.len() > MAX_DELTA_PARTS) || (!newest && longer.len() > 1) {
                break;
            }
            parts = longer;
            from_version = version - 1;
        }
        let count = u32::try_from(parts.len()).unwrap_or(0);
        (0..)
            .zip(parts)
            .map(|(part, entries)| wire::Delta {
                from_version,
                to_version: self.version,
                part,
                parts: count,
                entries,
            })
            .collect()
    }

    fn pieces_of(&self, topic: &TopicName) -> Vec<wire::Entry> {
        match self.entries.get(topic) {
            Some(announced) => pieces(announced.entry.clone()),
            None => vec![removed(topic)],
        }
    }

    /// The parts of a snapshot that another flow asks for.
    pub(super) fn request(&mut self, now: Instant, request: &wire::SnapshotRequest) -> Vec<wire::Snapshot> {
        let wanted: Vec<u32> = if request.parts.is_empty() {
            (0..).take(MAX_ASKED_PARTS).collect()
        } else {
            request.parts.iter().copied().take(MAX_ASKED_PARTS).collect()
        };
        let index = match self.snapshots.iter().position(|held| held.version == request.version) {
            Some(index) if request.version != 0 => index,
            // The newest is asked for, or the one that is asked for is gone: the asker starts anew.
            _ => self.newest_snapshot(now),
        };
        let Some(held) = self.snapshots.get_mut(index) else {
            return Vec::new();
        };
        held.used = now;
        let parts = u32::try_from(held.parts.len()).unwrap_or(u32::MAX);
        let part_of = |part: u32| {
            let entries = held.parts.get(usize::try_from(part).ok()?)?.clone();
            Some(wire::Snapshot {
                version: held.version,
                part,
                parts,
                entries,
            })
        };
        wanted
            .into_iter()
            .collect::<BTreeSet<_>>()
            .into_iter()
            .filter_map(part_of)
            .collect()
    }

    fn newest_snapshot(&mut self, now: Instant) -> usize {
        let fresh = |held: &HeldSnapshot| {
            held.version == self.version || now.saturating_duration_since(held.made) < SNAPSHOT_FRESH
        };
        let newest = self.snapshots.iter().enumerate().max_by_key(|(_, held)| held.version);
        if let Some((index, held)) = newest
            && fresh(held)
        {
            return index;
        }
        if self.snapshots.len() >= MAX_SNAPSHOTS
            && let Some((oldest, _)) = self.snapshots.iter().enumerate().min_by_key(|(_, held)| held.used)
        {
            self.snapshots.swap_remove(oldest);
        }
        self.snapshots.push(HeldSnapshot {
            version: self.version,
            parts: pack(
                self.entries
                    .values()
                    .flat_map(|announced| pieces(announced.entry.clone())),
            ),
            made: now,
            used: now,
        });
        self.snapshots.len() - 1
    }

    /// Forgets snapshots that nobody asks for any more.
    pub(super) fn tidy(&mut self, now: Instant) {
        self.snapshots
            .retain(|held| now.saturating_duration_since(held.used) < SNAPSHOT_UNUSED);
    }
}

fn only_routes(entry: &wire::Entry) -> bool {
    entry.node_advertise.is_none()
        && entry.layer_advertise.is_none()
        && entry.node_request.is_none()
        && entry.layer_request.is_none()
        && entry.outside_advertise.is_none()
        && entry.outside_request.is_none()
}
