//! Results in order: a message that is being compressed is not overtaken by those that came after it.
//!
//! ```text
//! key ─► [ ready ] [ pending, begun ] [ pending ] [ ready ] ◄── push
//!   pop_ready ◄─┘         └─ finish      └─ may be withdrawn
//! ```
//!
//! Each key (a topic) has a queue of places. What is finished waits in its place until all before it have left; other
//! keys do not notice. Without clock, threads or locks: whoever owns it holds it behind a lock of his own. Everything
//! costs O(log n) in the places of one key at most.

use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, HashMap, VecDeque};
use std::hash::Hash;

#[cfg(test)]
mod tests;

/// What may wait at most. A place that is alone always fits as far as bytes go.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// Places of all keys.
    pub items: usize,
    /// Bytes of all keys.
    pub bytes: usize,
    /// Places of one key.
    pub items_of_one: usize,
    /// Bytes of one key.
    pub bytes_of_one: usize,
}

impl Default for Bounds {
    /// 16,384 places and 64 MiB, of which one key may have a quarter and a half.
    fn default() -> Self {
        Self {
            items: 16_384,
            bytes: 64 * 1024 * 1024,
            items_of_one: 4_096,
            bytes_of_one: 32 * 1024 * 1024,
        }
    }
}

/// How much waits, or was removed.
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

    fn has_room(self, bytes: usize, items_bound: usize, bytes_bound: usize) -> bool {
        self.items < items_bound && (self.items == 0 || self.bytes.saturating_add(bytes) <= bytes_bound)
    }
}

/// Nothing was put in its place: the caller drops the message, and counts it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Full {
    /// The key has used up its own part.
    #[error("too much waits for this key")]
    Key,
    /// All keys together have.
    #[error("too much waits for all keys")]
    All,
}

/// A place that is pending. Of use for the [`InOrder`] that gave it only; one that is finished, given up, withdrawn or
/// removed means nothing any more.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Ticket<K> {
    key: K,
    number: u64,
}

impl<K> Ticket<K> {
    /// The key that it belongs to.
    #[must_use]
    pub fn key(&self) -> &K {
        &self.key
    }
}

struct Place<W, T> {
    bytes: usize,
    state: State<W, T>,
}

enum State<W, T> {
    /// Nobody works on it yet.
    Waits(W),
    Begun,
    Ready(T),
}

struct Queue<W, T> {
    /// By number: numbers only grow, so this is the order of arrival.
    places: BTreeMap<u64, Place<W, T>>,
    /// Per writer, its places that nobody works on yet, oldest first.
    waits: HashMap<W, VecDeque<u64>>,
    held: Waiting,
}

impl<W: Eq + Hash, T> Queue<W, T> {
    fn new() -> Self {
        Self {
            places: BTreeMap::new(),
            waits: HashMap::new(),
            held: Waiting::default(),
        }
    }

    /// Somebody works on it, or nobody will.
    fn waits_no_more(&mut self, writer: &W, number: u64) {
        if let Some(waits) = self.waits.get_mut(writer) {
            // Nearly always the first: the oldest is worked on first.
            if let Some(at) = waits.iter().position(|other| *other == number) {
                waits.remove(at);
            }
            if waits.is_empty() {
                self.waits.remove(writer);
            }
        }
    }
}

/// Queues of places, one per key. `W` tells the writers of a key apart.
pub struct InOrder<K, W, T> {
    bounds: Bounds,
    queues: HashMap<K, Queue<W, T>>,
    held: Waiting,
    next: u64,
}

impl<K: Copy + Eq + Hash, W: Clone + Eq + Hash, T> InOrder<K, W, T> {
    /// Without any places.
    #[must_use]
    pub fn new(bounds: Bounds) -> Self {
        Self {
            bounds,
            queues: HashMap::new(),
            held: Waiting::default(),
            next: 0,
        }
    }

    /// Whether nothing of the key waits: what is ready may go on without a place.
    #[must_use]
    pub fn is_clear(&self, key: &K) -> bool {
        !self.queues.contains_key(key)
    }

    /// What waits, of all keys.
    #[must_use]
    pub fn waiting(&self) -> Waiting {
        self.held
    }

    /// What waits of one key.
    #[must_use]
    pub fn waiting_of(&self, key: &K) -> Waiting {
        self.queues.get(key).map(|queue| queue.held).unwrap_or_default()
    }

    /// Puts something that is ready behind what waits.
    ///
    /// # Errors
    /// The item, and what is full.
    pub fn push_ready(&mut self, key: K, item: T, bytes: usize) -> Result<(), (T, Full)> {
        if let Err(full) = self.room(&key, bytes) {
            return Err((item, full));
        }
        self.put(key, bytes, State::Ready(item));
        Ok(())
    }

    /// Keeps a place behind what waits for something that is yet to be done. `bytes`: what it holds until then.
    ///
    /// # Errors
    /// What is full.
    pub fn push_pending(&mut self, key: K, writer: W, bytes: usize) -> Result<Ticket<K>, Full> {
        self.room(&key, bytes)?;
        let number = self.put(key, bytes, State::Waits(writer.clone()));
        if let Some(queue) = self.queues.get_mut(&key) {
            queue.waits.entry(writer).or_default().push_back(number);
        }
        Ok(Ticket { key, number })
    }

    fn room(&self, key: &K, bytes: usize) -> Result<(), Full> {
        let bounds = &self.bounds;
        if !self
            .waiting_of(key)
            .has_room(bytes, bounds.items_of_one, bounds.bytes_of_one)
        {
            return Err(Full::Key);
        }
        if !self.held.has_room(bytes, bounds.items, bounds.bytes) {
            return Err(Full::All);
        }
        Ok(())
    }

    fn put(&mut self, key: K, bytes: usize, state: State<W, T>) -> u64 {
        let number = self.next;
        self.next += 1;
        let queue = self.queues.entry(key).or_insert_with(Queue::new);
        queue.places.insert(number, Place { bytes, state });
        queue.held.add(bytes);
        self.held.add(bytes);
        number
    }

    /// Somebody begins to work on it: from now on it is not withdrawn. `false`: it is not wanted any more, the work can
    /// be spared.
    pub fn begin(&mut self, ticket: &Ticket<K>) -> bool {
        let Some(queue) = self.queues.get_mut(&ticket.key) else {
            return false;
        };
        let Some(place) = queue.places.get_mut(&ticket.number) else {
            return false;
        };
        if let State::Waits(_) = place.state
            && let State::Waits(writer) = std::mem::replace(&mut place.state, State::Begun)
        {
            queue.waits_no_more(&writer, ticket.number);
        }
        true
    }

    /// What was to be done is done. `bytes`: what the item holds from now on; this is taken whatever the bounds are.
    ///
    /// # Errors
    /// The item, if its place is gone: it was withdrawn or removed, and counted there.
    pub fn finish(&mut self, ticket: &Ticket<K>, item: T, bytes: usize) -> Result<(), T> {
        if !self.begin(ticket) {
            return Err(item);
        }
        let Some(queue) = self.queues.get_mut(&ticket.key) else {
            return Err(item);
        };
        match queue.places.get_mut(&ticket.number) {
            Some(place) if matches!(place.state, State::Begun) => {
                for held in [&mut queue.held, &mut self.held] {
                    held.remove(place.bytes);
                    held.add(bytes);
                }
                *place = Place {
                    bytes,
                    state: State::Ready(item),
                };
                Ok(())
            }
            _ => Err(item),
        }
    }

    /// Nothing comes of it: those behind it wait no longer. `false`: its place was gone.
    pub fn give_up(&mut self, ticket: &Ticket<K>) -> bool {
        let Entry::Occupied(mut queue) = self.queues.entry(ticket.key) else {
            return false;
        };
        let is_pending = |place: &Place<W, T>| !matches!(place.state, State::Ready(_));
        if !queue.get().places.get(&ticket.number).is_some_and(is_pending) {
            return false;
        }
        let bytes = remove(queue.get_mut(), ticket.number);
        self.held.remove(bytes);
        if queue.get().places.is_empty() {
            queue.remove();
        }
        true
    }

    /// The oldest item of a key, if it is ready. To be called until there is none, after each push,
    /// [`InOrder::finish`], [`InOrder::give_up`] and [`InOrder::keep_newest`].
    pub fn pop_ready(&mut self, key: &K) -> Option<T> {
        let queue = self.queues.get_mut(key)?;
        let first = queue.places.first_entry()?;
        if !matches!(first.get().state, State::Ready(_)) {
            return None;
        }
        let Place { bytes, state } = first.remove();
        queue.held.remove(bytes);
        self.held.remove(bytes);
        if queue.places.is_empty() {
            self.queues.remove(key);
        }
        match state {
            State::Ready(item) => Some(item),
            State::Waits(_) | State::Begun => None,
        }
    }

    /// Of one writer's places that nobody works on yet only the newest `keep` stay. Returns what was withdrawn, for the
    /// caller to count.
    pub fn keep_newest(&mut self, key: &K, writer: &W, keep: usize) -> Waiting {
        let mut withdrawn = Waiting::default();
        let Some(queue) = self.queues.get_mut(key) else {
            return withdrawn;
        };
        let surplus = queue
            .waits
            .get(writer)
            .map_or(0, |waits| waits.len().saturating_sub(keep));
        for _ in 0..surplus {
            let Some(oldest) = queue.waits.get(writer).and_then(|waits| waits.front().copied()) else {
                break;
            };
            let bytes = remove(queue, oldest);
            self.held.remove(bytes);
            withdrawn.add(bytes);
        }
        if queue.places.is_empty() {
            self.queues.remove(key);
        }
        withdrawn
    }

    /// Forgets a key with all its places. Returns what that was, for the caller to count.
    pub fn remove_key(&mut self, key: &K) -> Waiting {
        let removed = self.queues.remove(key).map(|queue| queue.held).unwrap_or_default();
        self.held.items -= removed.items;
        self.held.bytes -= removed.bytes;
        removed
    }
}

/// Takes a place that is pending out of its queue. Returns its bytes.
fn remove<W: Eq + Hash, T>(queue: &mut Queue<W, T>, number: u64) -> usize {
    let Some(place) = queue.places.remove(&number) else {
        return 0;
    };
    if let State::Waits(writer) = &place.state {
        queue.waits_no_more(writer, number);
    }
    queue.held.remove(place.bytes);
    place.bytes
}
