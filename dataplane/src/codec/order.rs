//! Results in order: a message that is being compressed is not overtaken by those of its writer
//! that came after it.
//!
//! ```text
//! group (a topic) ─┬─ line (a writer) ─► [ ready ] [ begun ] [ waits ] [ ready ] ◄── push
//!                  └─ line …            pop_ready ◄┘  └ finish  └ begin, or it gives way to a newer one
//! ```
//!
//! Each writer of a topic has a line of places. What is finished waits in its place until all
//! before it have left; other lines do not notice. Who is begun with next goes in rounds: one place
//! of each group, and within a group one of each line, so that nobody who has much to do keeps the
//! others waiting. A place that gives way to a newer one of its line leaves its turn to that.
//! Without clock, threads or locks: the owner holds it behind a lock. Everything costs O(log n) in
//! the places of one line at most.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::hash::Hash;

use super::pool::{URGENCIES, Urgency};

#[cfg(test)]
mod tests;

const MIB: usize = 1024 * 1024;

/// What may be held at most. A place that is alone always fits as far as bytes go.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// Places of all groups.
    pub items: usize,
    /// Bytes of all groups.
    pub bytes: usize,
    /// Places of one group.
    pub items_of_one: usize,
    /// Bytes of one group.
    pub bytes_of_one: usize,
    /// Bytes of one group that nobody works on yet.
    pub waiting_of_one: usize,
}

impl Default for Bounds {
    /// 16,384 places and 64 MiB, of which one group may have a quarter and a half, and 8 MiB that
    /// nobody works on yet.
    fn default() -> Self {
        Self {
            items: 16_384,
            bytes: 64 * MIB,
            items_of_one: 4_096,
            bytes_of_one: 32 * MIB,
            waiting_of_one: 8 * MIB,
        }
    }
}

/// How much is held, or waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Waiting {
    /// Places.
    pub items: usize,
    /// Their bytes, as they were given.
    pub bytes: usize,
}

impl Waiting {
    fn add(&mut self, bytes: usize) {
        self.items += 1;
        self.bytes += bytes;
    }

    fn remove(&mut self, bytes: usize) {
        self.items -= 1;
        self.bytes -= bytes;
    }

    fn without(self, other: Self) -> Self {
        Self {
            items: self.items.saturating_sub(other.items),
            bytes: self.bytes.saturating_sub(other.bytes),
        }
    }

    fn has_room(self, bytes: usize, items_bound: usize, bytes_bound: usize) -> bool {
        self.items < items_bound
            && (self.items == 0 || self.bytes.saturating_add(bytes) <= bytes_bound)
    }
}

/// Nothing was put in its place: the caller drops the message, and counts it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Full {
    /// The group has used up its own part.
    #[error("too much waits for this group")]
    Group,
    /// All groups together have.
    #[error("too much waits for all groups")]
    All,
}

/// What came of [`InOrder::push_waiting`].
#[derive(Debug)]
pub struct Pushed<T> {
    /// Older ones that gave way, for the caller to count.
    pub gave_way: Vec<T>,
    /// The item itself where there was no room for it; nothing gave way then.
    pub refused: Option<(T, Full)>,
}

/// A place that is begun. Of use for the [`InOrder`] that gave it only; one that is finished or
/// given up means nothing any more.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Ticket<G, L> {
    key: (G, L),
    number: u64,
}

impl<G, L> Ticket<G, L> {
    /// Group and line that it belongs to.
    #[must_use]
    pub fn key(&self) -> &(G, L) {
        &self.key
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// Nobody works on it yet.
    Waits,
    Begun,
    Ready,
}

struct Place<T> {
    bytes: usize,
    stage: Stage,
    item: T,
}

struct Line<T> {
    /// By number: numbers only grow, so this is the order of arrival.
    places: BTreeMap<u64, Place<T>>,
    /// By urgency, the places that nobody works on yet, oldest first.
    waits: [VecDeque<u64>; URGENCIES],
    /// Whether it is in the rounds of its group.
    in_rounds: [bool; URGENCIES],
}

impl<T> Line<T> {
    fn new() -> Self {
        Self { places: BTreeMap::new(), waits: Default::default(), in_rounds: Default::default() }
    }
}

struct Group<L, T> {
    lines: HashMap<L, Line<T>>,
    /// By urgency, the lines of which something waits, each once.
    rounds: [VecDeque<L>; URGENCIES],
    /// Whether it is in the rounds of all groups.
    in_rounds: [bool; URGENCIES],
    held: Waiting,
    waits: Waiting,
}

impl<L, T> Group<L, T> {
    fn new() -> Self {
        Self {
            lines: HashMap::new(),
            rounds: Default::default(),
            in_rounds: Default::default(),
            held: Waiting::default(),
            waits: Waiting::default(),
        }
    }
}

/// Lines of places, in groups.
pub struct InOrder<G, L, T> {
    bounds: Bounds,
    groups: HashMap<G, Group<L, T>>,
    /// By urgency, the groups of which something waits, each once.
    rounds: [VecDeque<G>; URGENCIES],
    held: Waiting,
    waits: [Waiting; URGENCIES],
    next: u64,
}

impl<G: Copy + Eq + Hash, L: Copy + Eq + Hash, T> InOrder<G, L, T> {
    /// Without any places.
    #[must_use]
    pub fn new(bounds: Bounds) -> Self {
        Self {
            bounds,
            groups: HashMap::new(),
            rounds: Default::default(),
            held: Waiting::default(),
            waits: Default::default(),
            next: 0,
        }
    }

    /// Whether nothing of a line is held: what is ready may go on without a place.
    #[must_use]
    pub fn is_clear(&self, (group, line): &(G, L)) -> bool {
        let lines = self.groups.get(group).map(|group| &group.lines);
        lines.is_none_or(|lines| !lines.contains_key(line))
    }

    /// Whether something of a group is held.
    #[must_use]
    pub fn holds(&self, group: &G) -> bool {
        self.groups.contains_key(group)
    }

    /// What is held, of all groups.
    #[must_use]
    pub fn held(&self) -> Waiting {
        self.held
    }

    /// What nobody works on yet, of all groups.
    #[must_use]
    pub fn waits(&self, urgency: Urgency) -> Waiting {
        self.waits[urgency as usize]
    }

    /// Everything that is held of a group.
    pub fn items(&self, group: G) -> impl Iterator<Item = &T> {
        let lines = self.groups.get(&group).into_iter().flat_map(|group| group.lines.values());
        lines.flat_map(|line| line.places.values().map(|place| &place.item))
    }

    /// The same, to be changed.
    pub fn items_mut(&mut self, group: &G) -> impl Iterator<Item = &mut T> {
        let group = self.groups.get_mut(group);
        let lines = group.into_iter().flat_map(|group| group.lines.values_mut());
        lines.flat_map(|line| line.places.values_mut().map(|place| &mut place.item))
    }

    /// Puts something that is ready behind what its line holds.
    ///
    /// # Errors
    /// The item, and what is full.
    pub fn push_ready(&mut self, key: (G, L), item: T, bytes: usize) -> Result<(), (T, Full)> {
        if let Err(full) = self.room(&key.0, bytes, false, Waiting::default()) {
            return Err((item, full));
        }
        let place = Place { bytes, stage: Stage::Ready, item };
        self.put(key, place, None);
        Ok(())
    }

    /// Keeps a place, behind what its line holds, for something that is yet to be done. `bytes`:
    /// what it holds until then. Of the places of the line and urgency that nobody works on yet
    /// only the newest `keep` stay, this one among them, and fewer where the group has no room for
    /// its bytes otherwise; 0: all of them.
    pub fn push_waiting(
        &mut self,
        key: (G, L),
        urgency: Urgency,
        item: T,
        bytes: usize,
        keep: usize,
    ) -> Pushed<T> {
        let freed = self.surplus(&key, urgency, bytes, keep);
        if let Err(full) = self.room(&key.0, bytes, true, freed) {
            return Pushed { gave_way: Vec::new(), refused: Some((item, full)) };
        }
        let gave_way = self.withdraw(&key, urgency, freed.items);
        let place = Place { bytes, stage: Stage::Waits, item };
        self.put(key, place, Some(urgency));
        Pushed { gave_way, refused: None }
    }

    /// What has to give way if one more comes and only `keep` may stay.
    fn surplus(
        &self,
        (group, line): &(G, L),
        urgency: Urgency,
        bytes: usize,
        keep: usize,
    ) -> Waiting {
        let mut surplus = Waiting::default();
        let group = self.groups.get(group).filter(|_| keep > 0);
        let Some((group, line)) = group.and_then(|group| Some((group, group.lines.get(line)?)))
        else {
            return surplus;
        };
        let waits = &line.waits[urgency as usize];
        let Bounds { items_of_one, waiting_of_one, .. } = self.bounds;
        for (at, number) in waits.iter().enumerate() {
            let too_many = waits.len() - at + 1 > keep;
            if !too_many
                && group.waits.without(surplus).has_room(bytes, items_of_one, waiting_of_one)
            {
                break;
            }
            surplus.add(line.places.get(number).map_or(0, |place| place.bytes));
        }
        surplus
    }

    fn room(&self, group: &G, bytes: usize, waits: bool, freed: Waiting) -> Result<(), Full> {
        let bounds = &self.bounds;
        let (held, waiting) = self
            .groups
            .get(group)
            .map(|group| (group.held.without(freed), group.waits.without(freed)))
            .unwrap_or_default();
        let fits = held.has_room(bytes, bounds.items_of_one, bounds.bytes_of_one);
        if !fits || (waits && !waiting.has_room(bytes, bounds.items_of_one, bounds.waiting_of_one))
        {
            return Err(Full::Group);
        }
        if !self.held.without(freed).has_room(bytes, bounds.items, bounds.bytes) {
            return Err(Full::All);
        }
        Ok(())
    }

    /// Takes the oldest waiting places out of a line. The line stays where it is in the rounds: a
    /// newer place follows.
    fn withdraw(&mut self, (group, line): &(G, L), urgency: Urgency, count: usize) -> Vec<T> {
        let at = urgency as usize;
        let mut gone = Vec::new();
        let Some(group) = self.groups.get_mut(group) else {
            return gone;
        };
        let Some(line) = group.lines.get_mut(line) else {
            return gone;
        };
        for _ in 0..count {
            let oldest = line.waits[at].pop_front();
            let Some(place) = oldest.and_then(|number| line.places.remove(&number)) else {
                break;
            };
            group.held.remove(place.bytes);
            group.waits.remove(place.bytes);
            self.held.remove(place.bytes);
            self.waits[at].remove(place.bytes);
            gone.push(place.item);
        }
        gone
    }

    fn put(&mut self, (name, writer): (G, L), place: Place<T>, urgency: Option<Urgency>) {
        let number = self.next;
        self.next += 1;
        let bytes = place.bytes;
        self.held.add(bytes);
        let group = self.groups.entry(name).or_insert_with(Group::new);
        group.held.add(bytes);
        let line = group.lines.entry(writer).or_insert_with(Line::new);
        line.places.insert(number, place);
        if let Some(urgency) = urgency {
            self.enlist((name, writer), number, urgency);
        }
    }

    /// A place waits from now on until somebody begins with it.
    fn enlist(&mut self, (name, writer): (G, L), number: u64, urgency: Urgency) {
        let at = urgency as usize;
        let Some(group) = self.groups.get_mut(&name) else { return };
        let Some(line) = group.lines.get_mut(&writer) else { return };
        let Some(place) = line.places.get_mut(&number) else { return };
        place.stage = Stage::Waits;
        self.waits[at].add(place.bytes);
        group.waits.add(place.bytes);
        let older = line.waits[at].partition_point(|other| *other < number);
        line.waits[at].insert(older, number);
        if !std::mem::replace(&mut line.in_rounds[at], true) {
            group.rounds[at].push_back(writer);
        }
        if !std::mem::replace(&mut group.in_rounds[at], true) {
            self.rounds[at].push_back(name);
        }
    }

    /// Somebody begins to work on the place whose turn it is: from now on it does not give way. Its
    /// item is his to look at. `None`: nothing waits.
    pub fn begin(&mut self, urgency: Urgency) -> Option<(Ticket<G, L>, &mut T)> {
        let at = urgency as usize;
        let name = self.rounds[at].pop_front()?;
        let group = self.groups.get_mut(&name)?;
        let writer = group.rounds[at].pop_front()?;
        let line = group.lines.get_mut(&writer)?;
        let number = line.waits[at].pop_front()?;
        line.in_rounds[at] = !line.waits[at].is_empty();
        if line.in_rounds[at] {
            group.rounds[at].push_back(writer);
        }
        group.in_rounds[at] = !group.rounds[at].is_empty();
        if group.in_rounds[at] {
            self.rounds[at].push_back(name);
        }
        let place = line.places.get_mut(&number)?;
        place.stage = Stage::Begun;
        group.waits.remove(place.bytes);
        self.waits[at].remove(place.bytes);
        let key = (name, writer);
        Some((Ticket { key, number }, &mut place.item))
    }

    /// The item of a place that is begun.
    pub fn begun(&mut self, ticket: &Ticket<G, L>) -> Option<&mut T> {
        let group = self.groups.get_mut(&ticket.key.0)?;
        let line = group.lines.get_mut(&ticket.key.1)?;
        let place = line.places.get_mut(&ticket.number)?;
        (place.stage == Stage::Begun).then_some(&mut place.item)
    }

    /// A place that is begun waits again, with its turn among those of its line. `false`: it was not
    /// begun.
    pub fn wait_again(&mut self, ticket: &Ticket<G, L>, urgency: Urgency) -> bool {
        let is_begun = self.begun(ticket).is_some();
        if is_begun {
            self.enlist(ticket.key, ticket.number, urgency);
        }
        is_begun
    }

    /// What was to be done is done. `bytes`: what the item holds from now on; this is taken
    /// whatever the bounds are. `false`: it was not begun.
    pub fn finish(&mut self, ticket: &Ticket<G, L>, bytes: usize) -> bool {
        let Some(group) = self.groups.get_mut(&ticket.key.0) else {
            return false;
        };
        let line = group.lines.get_mut(&ticket.key.1);
        let place = line.and_then(|line| line.places.get_mut(&ticket.number));
        let Some(place) = place.filter(|place| place.stage == Stage::Begun) else {
            return false;
        };
        for held in [&mut group.held, &mut self.held] {
            held.remove(place.bytes);
            held.add(bytes);
        }
        place.bytes = bytes;
        place.stage = Stage::Ready;
        true
    }

    /// Nothing comes of a place that was begun: those behind it wait no longer. `None`: it was not
    /// begun.
    pub fn give_up(&mut self, ticket: &Ticket<G, L>) -> Option<T> {
        self.begun(ticket)?;
        self.take(&ticket.key, ticket.number)
    }

    /// The oldest item of a line, if it is ready. To be called until there is none, after each
    /// push, [`InOrder::finish`] and [`InOrder::give_up`].
    pub fn pop_ready(&mut self, key: &(G, L)) -> Option<T> {
        let line = self.groups.get(&key.0)?.lines.get(&key.1)?;
        let (number, first) = line.places.first_key_value()?;
        let number = (first.stage == Stage::Ready).then_some(*number)?;
        self.take(key, number)
    }

    /// Takes a place out of its line that does not wait.
    fn take(&mut self, (name, writer): &(G, L), number: u64) -> Option<T> {
        let group = self.groups.get_mut(name)?;
        let line = group.lines.get_mut(writer)?;
        let place = line.places.remove(&number)?;
        if line.places.is_empty() {
            group.lines.remove(writer);
        }
        group.held.remove(place.bytes);
        self.held.remove(place.bytes);
        if group.lines.is_empty() {
            self.groups.remove(name);
        }
        Some(place.item)
    }
}
