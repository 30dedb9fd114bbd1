//! Types that were sought, bounded.

use std::num::NonZeroUsize;
use std::time::Instant;

use lru::LruCache;

use super::{Found, MessageType};

/// Names that are kept; the least recently used go first.
const MAX_NAMES: usize = 1_024;
/// Hashes of one name that are kept; the oldest go first.
const MAX_HASHES: usize = 8;

/// One type.
#[derive(Debug)]
struct Entry {
    hash: String,
    found: Found,
    /// When it is to be sought again, if it was not found.
    again: Instant,
}

/// Types by name, then by hash.
#[derive(Debug)]
pub(super) struct Cache(LruCache<String, Vec<Entry>>);

impl Default for Cache {
    fn default() -> Self {
        Self(LruCache::new(NonZeroUsize::new(MAX_NAMES).unwrap_or(NonZeroUsize::MIN)))
    }
}

impl Cache {
    pub(super) fn get(&mut self, now: Instant, ty: MessageType<&str>) -> Option<Found> {
        let entries = self.0.get(ty.name)?;
        let entry = entries.iter().find(|entry| entry.hash == ty.hash)?;
        (entry.found.is_ok() || now < entry.again).then(|| entry.found.clone())
    }

    pub(super) fn put(&mut self, again: Instant, ty: MessageType<&str>, found: Found) {
        let entries = self.0.get_or_insert_mut(ty.name.to_owned(), Vec::new);
        entries.retain(|entry| entry.hash != ty.hash);
        if entries.len() >= MAX_HASHES {
            entries.remove(0);
        }
        entries.push(Entry { hash: ty.hash.to_owned(), found, again });
    }

    /// What was not found of a name is sought again.
    pub(super) fn forget_unknown(&mut self, name: &str) {
        if let Some(entries) = self.0.get_mut(name) {
            entries.retain(|entry| entry.found.is_ok());
        }
    }

    pub(super) fn clear(&mut self) {
        self.0.clear();
    }
}
