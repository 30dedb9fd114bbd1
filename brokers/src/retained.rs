//! The retained cache: the last messages of each transient_local writer, for those who come later.
//! A hub, a client of Redis and the lanes of a flow each have one.

use std::collections::VecDeque;
use std::hash::Hash;

use lru::LruCache;

/// Bounds of a cache. The newest message of a writer always fits.
#[derive(Debug, Clone, Copy)]
pub struct RetainedBounds {
    /// Most writers; the one that was silent longest gives way with all its messages.
    pub writers: usize,
    /// Most bytes of all writers; whole writers give way, since shortening many would leave all of
    /// them incomplete.
    pub bytes: usize,
    /// Most bytes of one writer; its oldest messages give way.
    pub bytes_of_writer: usize,
}

/// What is retained of one writer, oldest first.
#[derive(Debug)]
pub struct Retained<M> {
    messages: VecDeque<(M, usize)>,
    bytes: usize,
}

impl<M> Retained<M> {
    /// Its messages, oldest first.
    pub fn iter(&self) -> impl Iterator<Item = &M> {
        self.messages.iter().map(|(message, _)| message)
    }

    /// The sizes of its messages together.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    fn pop(&mut self) {
        self.bytes -= self.messages.pop_front().map_or(0, |(_, size)| size);
    }
}

/// Messages by writer, bounded.
pub struct RetainedCache<K: Hash + Eq, M> {
    writers: LruCache<K, Retained<M>>,
    bounds: RetainedBounds,
    bytes: usize,
    evicted: u64,
}

impl<K: Hash + Eq + Clone, M> RetainedCache<K, M> {
    /// An empty cache.
    #[must_use]
    pub fn new(bounds: RetainedBounds) -> Self {
        Self { writers: LruCache::unbounded(), bounds, bytes: 0, evicted: 0 }
    }

    /// Takes a message in as the newest of its writer, of whom the last `depth` stay.
    pub fn keep(&mut self, writer: K, message: M, size: usize, depth: usize) {
        let retained = self
            .writers
            .get_or_insert_mut(writer, || Retained { messages: VecDeque::new(), bytes: 0 });
        let before = retained.bytes;
        retained.bytes += size;
        retained.messages.push_back((message, size));
        let most = self.bounds.bytes.min(self.bounds.bytes_of_writer);
        while retained.messages.len() > 1
            && (retained.messages.len() > depth || retained.bytes > most)
        {
            self.evicted += u64::from(retained.messages.len() <= depth);
            retained.pop();
        }
        self.bytes = self.bytes - before + retained.bytes;
        // This writer was used last, so it goes only when it is alone.
        while self.writers.len() > self.bounds.writers
            || (self.bytes > self.bounds.bytes && self.writers.len() > 1)
        {
            let Some((_, oldest)) = self.writers.pop_lru() else {
                break;
            };
            self.bytes -= oldest.bytes;
            self.evicted += oldest.messages.len() as u64;
        }
    }

    /// Messages that gave way to a bound of the cache; those beyond the depth of their writer do
    /// not count.
    #[must_use]
    pub fn evicted(&self) -> u64 {
        self.evicted
    }

    /// What is retained of a writer.
    pub fn get(&self, writer: &K) -> Option<&Retained<M>> {
        self.writers.peek(writer)
    }

    /// All writers, each with its newest message and what is retained of it.
    pub fn iter(&self) -> impl Iterator<Item = (&K, &M, &Retained<M>)> {
        self.writers
            .iter()
            .filter_map(|(writer, retained)| Some((writer, &retained.messages.back()?.0, retained)))
    }

    /// Forgets a writer.
    pub fn forget(&mut self, writer: &K) {
        self.bytes -= self.writers.pop(writer).map_or(0, |retained| retained.bytes);
    }

    /// Forgets the writers that are gone, by their newest messages. Returns which.
    pub fn forget_if(&mut self, is_gone: impl Fn(&K, &M) -> bool) -> Vec<K> {
        let gone = self.iter().filter(|(writer, newest, _)| is_gone(writer, newest));
        let gone: Vec<K> = gone.map(|(writer, ..)| writer.clone()).collect();
        for writer in &gone {
            self.forget(writer);
        }
        gone
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cache(writers: usize, bytes: usize, bytes_of_writer: usize) -> RetainedCache<u8, u64> {
        RetainedCache::new(RetainedBounds { writers, bytes, bytes_of_writer })
    }

    fn found(cache: &RetainedCache<u8, u64>) -> Vec<(u8, Vec<u64>)> {
        let mut found: Vec<_> = cache
            .iter()
            .map(|(writer, _, retained)| (*writer, retained.iter().copied().collect()))
            .collect();
        found.sort_unstable();
        assert_eq!(cache.bytes, cache.iter().map(|(.., retained)| retained.bytes()).sum::<usize>());
        found
    }

    #[test]
    fn the_last_of_each_writer_stay_and_the_writer_that_was_silent_longest_gives_way() {
        let mut cache = cache(2, usize::MAX, usize::MAX);
        for sequence in 1..=4 {
            cache.keep(1, sequence, 10, 2);
            cache.keep(2, sequence, 10, 1);
        }
        assert_eq!(found(&cache), [(1, vec![3, 4]), (2, vec![4])]);
        cache.keep(1, 5, 10, 2);
        cache.keep(3, 1, 10, 2);
        assert_eq!(found(&cache), [(1, vec![4, 5]), (3, vec![1])]);
        assert_eq!(cache.evicted(), 1);
    }

    #[test]
    fn bytes_are_bounded_and_one_message_always_fits() {
        let mut cache = cache(100, 40, 30);
        for sequence in 1..=4 {
            cache.keep(1, sequence, 10, 9);
        }
        assert_eq!(found(&cache), [(1, vec![2, 3, 4])]);
        cache.keep(2, 1, 10, 9);
        assert_eq!(found(&cache).len(), 2);
        cache.keep(3, 1, 10, 9);
        assert_eq!(found(&cache), [(2, vec![1]), (3, vec![1])], "a whole writer");
        cache.keep(3, 2, 1_000, 9);
        assert_eq!(found(&cache), [(3, vec![2])]);
        assert_eq!(cache.evicted(), 1 + 3 + 1 + 1);
    }

    #[test]
    fn forgetting_leaves_nothing_behind() {
        let mut cache = cache(100, usize::MAX, usize::MAX);
        for writer in 1..=3 {
            cache.keep(writer, 7, 10, 1);
            cache.keep(writer, 7 + u64::from(writer), 10, 2);
        }
        assert_eq!(cache.forget_if(|_, newest| *newest == 9), [2]);
        assert_eq!(found(&cache), [(1, vec![7, 8]), (3, vec![7, 10])]);
        for writer in 0..=3 {
            cache.forget(&writer);
        }
        assert!(found(&cache).is_empty() && cache.bytes == 0);
    }
}
