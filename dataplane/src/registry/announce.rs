//! What the flow tells others of its own topics: versions, deltas and snapshots.
//!
//! ```text
//! mark ─(quiet for 10 ms)─► announce: version + 1, digest, Delta to every flow
//! SnapshotRequest ─► request: parts of one version, which is kept until it is no longer asked for
//! ```
//!
//! Others follow no more than [`MAX_ENTRIES`] topics of a flow, so no more are announced: what does
//! not fit waits until something goes. What is announced stays, unless something of a higher
//! [`Rank`] needs its place.

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
/// Most leases of a flow, hence most topics that it announces because of its own services.
pub(super) const MAX_LEASED_ENTRIES: usize = 10_000;
/// Most topics that it announces only to tell of their routes.
const MAX_ROUTE_ENTRIES: usize = 2_000;
/// Most topics that any flow announces; what those leave a gateway has for the topics of others
/// that it speaks for.
pub(super) const MAX_ENTRIES: usize = MAX_LEASED_ENTRIES + MAX_ROUTE_ENTRIES;
/// Parts of a snapshot that may be asked for at a time.
pub(super) const MAX_ASKED_PARTS: usize = 8;
/// A snapshot that nobody asks for is kept this long.
const SNAPSHOT_UNUSED: Duration = Duration::from_secs(5);
/// A snapshot this young is given to newcomers, though changes came since: deltas bring them.
const SNAPSHOT_FRESH: Duration = Duration::from_millis(500);
/// Snapshots of different versions kept at a time; the one unused for longest gives way.
const MAX_SNAPSHOTS: usize = 8;

/// What a topic is announced for. Where there are too many, the first of these have precedence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Rank {
    /// Services here lease it.
    Leased,
    /// This flow has routes of it.
    Carried,
    /// Others do that this flow speaks for.
    Merged,
}

impl Rank {
    const ALL: [Self; 3] = [Self::Leased, Self::Carried, Self::Merged];
}

/// What is to be told of a topic.
pub(super) struct Told {
    pub(super) entry: wire::Entry,
    pub(super) rank: Rank,
}

/// How often something was not announced, because there is too much.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct LeftOut {
    /// Topics beyond [`MAX_ENTRIES`].
    pub(super) topics: u64,
    /// Topics beyond those of which only routes are told.
    pub(super) routes: u64,
}

struct Announced {
    told: Told,
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
    /// Announced topics that give way to those of a higher rank; the last first.
    yielding: BTreeSet<(Rank, TopicName)>,
    /// Topics that wait for others to go; the first first.
    waiting: BTreeSet<(Rank, TopicName)>,
    /// Topics of which there are only routes, that wait for others like them to go.
    waiting_routes: BTreeSet<TopicName>,
    left_out: LeftOut,
}

impl Announcer {
    /// Version and digest of what is announced.
    pub(super) fn announced(&self) -> (u64, u64) {
        (self.version, self.digest)
    }

    /// How often something was not announced.
    pub(super) fn left_out(&self) -> LeftOut {
        self.left_out
    }

    /// How many topics [`Announcer::announce`] would look at now.
    pub(super) fn count_due(&self, now: Instant) -> usize {
        if self.due.is_some_and(|due| due <= now) { self.dirty.len() } else { 0 }
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

    /// Takes the changes into the announced state; the parts of the Delta to send, if any.
    /// `current` gives what is to be told of a topic, `None` where nothing is left of it.
    pub(super) fn announce(
        &mut self,
        now: Instant,
        current: impl Fn(&TopicName) -> Option<Told>,
    ) -> Vec<wire::Delta> {
        if self.due.is_none_or(|due| due > now) {
            return Vec::new();
        }
        self.due = None;
        let mut changed = BTreeSet::new();
        for topic in std::mem::take(&mut self.dirty) {
            self.take(&topic, current(&topic), &mut changed);
        }
        // One that is looked at again is announced, gone, or waits for what there is no room for:
        // that comes to an end.
        loop {
            let next = self.have_room();
            if next.is_empty() {
                break;
            }
            for topic in next {
                self.take(&topic, current(&topic), &mut changed);
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

    /// Takes what is told of one topic now; what others are to hear of because of it goes to
    /// `changed`.
    fn take(&mut self, topic: &TopicName, told: Option<Told>, changed: &mut BTreeSet<TopicName>) {
        let old = self.remove(topic);
        let waited = self.stop_waiting(topic);
        let told = told.filter(|told| self.makes_room(topic, told, waited, changed));
        if old.as_ref().map(|old| &old.entry) != told.as_ref().map(|told| &told.entry) {
            changed.insert(topic.clone());
        }
        if let Some(told) = told {
            self.put(topic, told);
        }
    }

    fn remove(&mut self, topic: &TopicName) -> Option<Told> {
        let Announced { told, hash } = self.entries.remove(topic)?;
        self.digest = self.digest.wrapping_sub(hash);
        self.route_entries -= usize::from(only_routes(&told.entry));
        self.yielding.remove(&(told.rank, topic.clone()));
        Some(told)
    }

    fn put(&mut self, topic: &TopicName, told: Told) {
        let hash = entry_hash(&told.entry);
        self.digest = self.digest.wrapping_add(hash);
        self.route_entries += usize::from(only_routes(&told.entry));
        if told.rank != Rank::Leased {
            self.yielding.insert((told.rank, topic.clone()));
        }
        self.entries.insert(topic.clone(), Announced { told, hash });
    }

    /// Whether the topic waited.
    fn stop_waiting(&mut self, topic: &TopicName) -> bool {
        let mut waited = self.waiting_routes.remove(topic);
        if !self.waiting.is_empty() {
            for rank in Rank::ALL {
                waited |= self.waiting.remove(&(rank, topic.clone()));
            }
        }
        waited
    }

    /// Whether there is room for a topic, or another one gave way; else it waits, and is counted
    /// unless it `waited` before.
    fn makes_room(
        &mut self,
        topic: &TopicName,
        told: &Told,
        waited: bool,
        changed: &mut BTreeSet<TopicName>,
    ) -> bool {
        if only_routes(&told.entry) && self.route_entries >= MAX_ROUTE_ENTRIES {
            self.waiting_routes.insert(topic.clone());
            self.left_out.routes += u64::from(!waited);
            return false;
        }
        if self.entries.len() < MAX_ENTRIES {
            return true;
        }
        let lowest = self.yielding.last().filter(|(rank, _)| *rank > told.rank).cloned();
        if let Some((rank, other)) = lowest {
            self.remove(&other);
            self.waiting.insert((rank, other.clone()));
            self.left_out.topics += 1;
            changed.insert(other);
            return true;
        }
        self.waiting.insert((told.rank, topic.clone()));
        self.left_out.topics += u64::from(!waited);
        false
    }

    /// Topics that waited for room that there is now.
    fn have_room(&self) -> Vec<TopicName> {
        let room = MAX_ENTRIES.saturating_sub(self.entries.len());
        let routes = MAX_ROUTE_ENTRIES.saturating_sub(self.route_entries).min(room);
        let waiting = self.waiting.iter().take(room).map(|(_, topic)| topic);
        waiting.chain(self.waiting_routes.iter().take(routes)).cloned().collect()
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
            Some(announced) => pieces(announced.told.entry.clone()),
            None => vec![removed(topic)],
        }
    }

    /// The parts of a snapshot that another flow asks for.
    pub(super) fn request(
        &mut self,
        now: Instant,
        request: &wire::SnapshotRequest,
    ) -> Vec<wire::Snapshot> {
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
            Some(wire::Snapshot { version: held.version, part, parts, entries })
        };
        wanted.into_iter().collect::<BTreeSet<_>>().into_iter().filter_map(part_of).collect()
    }

    fn newest_snapshot(&mut self, now: Instant) -> usize {
        let fresh = |held: &HeldSnapshot| {
            held.version == self.version
                || now.saturating_duration_since(held.made) < SNAPSHOT_FRESH
        };
        let newest = self.snapshots.iter().enumerate().max_by_key(|(_, held)| held.version);
        if let Some((index, held)) = newest
            && fresh(held)
        {
            return index;
        }
        if self.snapshots.len() >= MAX_SNAPSHOTS
            && let Some((oldest, _)) =
                self.snapshots.iter().enumerate().min_by_key(|(_, held)| held.used)
        {
            self.snapshots.swap_remove(oldest);
        }
        self.snapshots.push(HeldSnapshot {
            version: self.version,
            parts: pack(
                self.entries.values().flat_map(|announced| pieces(announced.told.entry.clone())),
            ),
            made: now,
            used: now,
        });
        self.snapshots.len() - 1
    }

    /// Forgets snapshots that nobody asks for any more.
    pub(super) fn tidy(&mut self, now: Instant) {
        self.snapshots.retain(|held| now.saturating_duration_since(held.used) < SNAPSHOT_UNUSED);
    }
}

fn only_routes(entry: &wire::Entry) -> bool {
    entry.node_advertise.is_none()
        && entry.layer_advertise.is_none()
        && entry.node_request.is_none()
        && entry.layer_request.is_none()
        && entry.outside_advertise.is_none()
        && entry.outside_request.is_none()
        && entry.ros2_advertise.is_none()
        && entry.ros2_request.is_none()
}
