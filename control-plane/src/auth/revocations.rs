//! Tokens that are refused although they have not run out.

use std::collections::HashMap;
use std::sync::Arc;

use arc_swap::ArcSwap;
use tokio::sync::watch;

/// The revoked tokens by `jti`, shared by its clones. Who reads the store tells of them; who holds
/// a stream open waits for [`Revocations::changed`] and asks again.
#[derive(Debug, Clone)]
pub struct Revocations {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    /// With the time from which on the token is refused anyway, in seconds since 1970.
    revoked: ArcSwap<HashMap<String, i64>>,
    /// Counts the changes.
    serial: watch::Sender<u64>,
}

impl Default for Revocations {
    fn default() -> Self {
        Self {
            shared: Arc::new(Shared { revoked: ArcSwap::default(), serial: watch::Sender::new(0) }),
        }
    }
}

impl Revocations {
    /// None yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Whether a token is revoked.
    #[must_use]
    pub fn is_revoked(&self, id: &str) -> bool {
        self.shared.revoked.load().contains_key(id)
    }

    /// How many there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.shared.revoked.load().len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// What the store says: `jti` and expiry, in seconds since 1970. A revocation is for ever, so
    /// what was known stays known until the token has run out at `now_s`; an older list does no
    /// harm. Tells of it if there is one that was not known.
    pub fn learn(&self, revoked: impl IntoIterator<Item = (String, i64)>, now_s: i64) {
        // Within the lock of the counter, so that nothing is lost between two that write.
        self.shared.serial.send_if_modified(|serial| {
            let before = self.shared.revoked.load_full();
            let mut all: HashMap<String, i64> =
                before.iter().map(|(id, expires_s)| (id.clone(), *expires_s)).collect();
            all.extend(revoked);
            all.retain(|_, expires_s| lasts(*expires_s, now_s));
            let news = all.keys().any(|id| !before.contains_key(id));
            if news || all.len() != before.len() {
                self.shared.revoked.store(Arc::new(all));
            }
            *serial += u64::from(news);
            news
        });
    }

    /// One more, at once: the process that revokes need not wait for its own store.
    pub fn add(&self, id: &str, expires_s: i64) {
        self.shared.serial.send_if_modified(|serial| {
            let news = !self.is_revoked(id);
            if news {
                let mut more = HashMap::clone(&self.shared.revoked.load());
                more.insert(id.to_owned(), expires_s);
                self.shared.revoked.store(Arc::new(more));
                *serial += 1;
            }
            news
        });
    }

    /// Changes with every revocation that was not known before.
    #[must_use]
    pub fn changed(&self) -> watch::Receiver<u64> {
        self.shared.serial.subscribe()
    }
}

/// Whether a token could still be accepted, whatever the clocks.
fn lasts(expires_s: i64, now_s: i64) -> bool {
    expires_s.saturating_add(2 * blaze_auth::LEEWAY_S) > now_s
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(id: &str, expires_s: i64) -> (String, i64) {
        (id.to_owned(), expires_s)
    }

    #[test]
    fn streams_are_told_of_what_is_new() {
        let revocations = Revocations::new();
        let mut changed = revocations.clone().changed();
        revocations.learn([entry("a", 1_000), entry("old", 900)], 1_000);
        assert!(changed.has_changed().unwrap());
        changed.mark_unchanged();
        assert!(
            revocations.is_revoked("a")
                && !revocations.is_revoked("old")
                && !revocations.is_revoked("b")
        );
        revocations.learn([entry("a", 1_000)], 1_000);
        assert!(!changed.has_changed().unwrap(), "nothing is new");
        revocations.add("b", 2_000);
        assert!(changed.has_changed().unwrap());
        changed.mark_unchanged();
        revocations.add("b", 2_000);
        assert!(!changed.has_changed().unwrap());
        assert_eq!((revocations.len(), revocations.is_empty()), (2, false));
        revocations.learn([], 1_059);
        assert!(
            revocations.is_revoked("a") && revocations.is_revoked("b"),
            "an older list takes nothing back"
        );
        revocations.learn([], 1_060);
        assert!(!revocations.is_revoked("a") && revocations.is_revoked("b"));
        assert!(!changed.has_changed().unwrap(), "one less is no news for a stream");
    }
}
