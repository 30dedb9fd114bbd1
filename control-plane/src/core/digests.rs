//! Digests of what layers see, remembered: workers of one layer ask for the same ones at the same
//! time.

use std::num::NonZeroUsize;

use blaze_domain::LayerName;
use blaze_domain::config::placement::layer_digest;
use blaze_domain::config::state::State;
use lru::LruCache;
use parking_lot::Mutex;

/// Digests that are remembered.
const REMEMBERED: NonZeroUsize = NonZeroUsize::MIN.saturating_add(255);

/// The newest ones.
pub(crate) struct Digests {
    known: Mutex<LruCache<(LayerName, u64), String>>,
}

impl Default for Digests {
    fn default() -> Self {
        Self { known: Mutex::new(LruCache::new(REMEMBERED)) }
    }
}

impl Digests {
    /// Digest of what a layer sees in a state. The state must be one of this store: its revision
    /// stands for it.
    pub(crate) fn of(&self, state: &State, layer: &LayerName) -> String {
        let key = (layer.clone(), state.revision());
        if let Some(known) = self.known.lock().get(&key) {
            return known.clone();
        }
        // Two may work it out at once; holding the lock would keep the others waiting.
        let digest = layer_digest(state, layer);
        self.known.lock().put(key, digest.clone());
        digest
    }
}
