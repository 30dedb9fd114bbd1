//! Values of keys that wait to be written to a server. Of a key only the last value counts, so one
//! that the server did not take is simply written again.

use std::collections::{HashMap, VecDeque};
use std::hash::Hash;

/// Values that wait at most; beyond that `put` returns false, and the caller decides (Redis:
/// rewrite all leases; Kafka: the value is lost).
const MAX_PENDING: usize = 131_072;

/// What waits, each key once and in order.
#[derive(Debug)]
pub(crate) struct Pending<K, V> {
    values: HashMap<K, V>,
    order: VecDeque<K>,
    /// Values that the last call took are not settled.
    under_way: bool,
}

impl<K, V> Default for Pending<K, V> {
    fn default() -> Self {
        Self { values: HashMap::new(), order: VecDeque::new(), under_way: false }
    }
}

impl<K: Hash + Eq + Clone, V> Pending<K, V> {
    /// Takes a value in, in place of an older one of the key that still waits. Returns false, and
    /// takes nothing, where too many wait.
    pub(crate) fn put(&mut self, key: K, value: V) -> bool {
        if let Some(before) = self.values.get_mut(&key) {
            *before = value;
        } else if self.values.len() < MAX_PENDING {
            self.order.push_back(key.clone());
            self.values.insert(key, value);
        } else {
            return false;
        }
        true
    }

    /// Forgets what waits.
    pub(crate) fn clear(&mut self) {
        self.values.clear();
        self.order.clear();
    }

    /// The oldest values that may be written now, up to a limit. Those of the call before are
    /// settled: written, or put back.
    pub(crate) fn take(&mut self, limit: usize, may_go: impl Fn(&V) -> bool) -> Vec<(K, V)> {
        let mut taken = Vec::new();
        let mut later = VecDeque::new();
        while taken.len() < limit
            && let Some(key) = self.order.pop_front()
        {
            if self.values.get(&key).is_some_and(&may_go) {
                taken.extend(self.values.remove_entry(&key));
            } else {
                later.push_back(key);
            }
        }
        later.append(&mut self.order);
        self.order = later;
        self.under_way = !taken.is_empty();
        taken
    }

    /// Values that were taken and may not have arrived wait again, unless there are newer ones:
    /// behind the others, which a value that is never taken must not hold up.
    pub(crate) fn put_back(&mut self, taken: Vec<(K, V)>) {
        for (key, value) in taken {
            if !self.values.contains_key(&key) {
                self.order.push_back(key.clone());
                self.values.insert(key, value);
            }
        }
    }

    /// Whether a value of the key waits.
    pub(crate) fn contains(&self, key: &K) -> bool {
        self.values.contains_key(key)
    }

    /// Whether nothing waits or is under way.
    pub(crate) fn is_settled(&self) -> bool {
        self.values.is_empty() && !self.under_way
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_value_of_a_key_counts_and_what_did_not_arrive_waits_again_unless_it_is_out_of_date()
    {
        let mut pending = Pending::default();
        for (key, value) in [("absent", 0), ("a", 1), ("b", 1), ("a", 2), ("c", 1)] {
            pending.put(key, value);
        }
        let taken = pending.take(2, |value| *value != 0);
        assert_eq!(taken, [("a", 2), ("b", 1)]);
        pending.put("b", 2);
        pending.put_back(taken);
        assert!(pending.contains(&"a"));
        assert_eq!(pending.take(9, |_| true), [("absent", 0), ("c", 1), ("b", 2), ("a", 2)]);
        assert!(!pending.is_settled(), "under way");
        assert!(pending.take(9, |_| true).is_empty() && pending.is_settled());
    }

    #[test]
    fn what_waits_is_bounded() {
        let mut pending = Pending::default();
        for key in 0..MAX_PENDING + 3 {
            assert_eq!(pending.put(key, ()), key < MAX_PENDING);
        }
        assert_eq!(pending.values.len(), MAX_PENDING);
    }
}
