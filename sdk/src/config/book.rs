//! What a service knows of its configuration, as a state machine without input or output.
//!
//! ```text
//! Nothing ── answer or notice ──► Held ◄── newer revision, or another hash at the same one
//!                                  │ ▲
//!                        deleted   ▼ │   newer revision
//!                                Deleted
//!
//! Of another store of the main service any revision is newer: it was made anew, or restored.
//!
//! asks: at once ─► again 1 s later without an answer ─► 60 s after an answer, with the hash
//! ```

use std::time::{Duration, Instant};

use blaze_domain::Scope;
use blaze_domain::config::diff::{diff, paths};

use super::change::{ConfigChange, ConfigScope, ConfigSource, Held};
use super::wire::{self, Answer, Notice, Refusal};
use crate::service::Identity;

/// Without an answer the service asks again after this time.
pub(super) const RETRY: Duration = Duration::from_secs(1);
/// A service that the worker does not know may come into being; nobody would tell.
pub(super) const RETRY_UNKNOWN: Duration = Duration::from_secs(5);
/// After an answer the service asks again after this time: that repairs a lost notice.
pub(super) const PERIOD: Duration = Duration::from_secs(60);

/// What the service has.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Standing {
    /// No worker has answered yet.
    Nothing,
    /// A configuration.
    Held(Held),
    /// None: the service was deleted.
    Deleted {
        /// When.
        revision: u64,
        /// Store that the revision is of.
        store: Option<String>,
    },
}

impl Standing {
    pub(super) fn held(&self) -> Option<&Held> {
        match self {
            Self::Held(held) => Some(held),
            Self::Nothing | Self::Deleted { .. } => None,
        }
    }

    /// Revision of the last word; `None`: there is none yet.
    pub(super) fn revision(&self) -> Option<u64> {
        match self {
            Self::Nothing => None,
            Self::Held(held) => Some(held.revision),
            Self::Deleted { revision, .. } => Some(*revision),
        }
    }

    fn store(&self) -> Option<&str> {
        match self {
            Self::Nothing => None,
            Self::Held(held) => held.store.as_deref(),
            Self::Deleted { store, .. } => store.as_deref(),
        }
    }

    /// Whether it is of another store than what the main service has now. A copy may be of an
    /// earlier one.
    fn is_of_another_store(&self, store: Option<&str>, source: ConfigSource) -> bool {
        let both = self.store().zip(store);
        source == ConfigSource::Main && both.is_some_and(|(own, theirs)| own != theirs)
    }
}

/// What was left alone, and how often.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ConfigCounts {
    /// Requests that were made.
    pub asked: u64,
    /// Changes that callbacks were given.
    pub changes: u64,
    /// Answers and notices of an older revision than the service has.
    pub older: u64,
    /// Notices for another instance or node.
    pub for_others: u64,
}

/// The configuration of one service.
pub(super) struct ConfigBook {
    identity: Identity,
    /// Where the service runs as far as its broker tells; `None`: not known, and on the broker of a
    /// layer nowhere in particular.
    node: Option<String>,
    scope: Scope,
    /// Begins all identities of requests, so that they differ from those of other services on a
    /// shared reply topic.
    id_prefix: String,
    reply_to: String,
    standing: Standing,
    refusal: Option<Refusal>,
    next: Instant,
    counts: ConfigCounts,
}

impl ConfigBook {
    pub(super) fn new(
        identity: Identity,
        scope: Scope,
        life: u64,
        reply_to: String,
        now: Instant,
    ) -> Self {
        Self {
            node: identity.node.as_ref().map(ToString::to_string),
            identity,
            scope,
            id_prefix: format!("{life:016x}-"),
            reply_to,
            standing: Standing::Nothing,
            refusal: None,
            next: now,
            counts: ConfigCounts::default(),
        }
    }

    pub(super) fn standing(&self) -> &Standing {
        &self.standing
    }

    /// Why the last request got nothing.
    pub(super) fn refusal(&self) -> Option<&Refusal> {
        self.refusal.as_ref()
    }

    pub(super) fn counts(&self) -> ConfigCounts {
        self.counts
    }

    /// When to ask next.
    pub(super) fn next_due(&self) -> Instant {
        self.next
    }

    /// What may have been missed is asked for at once.
    pub(super) fn ask_now(&mut self, now: Instant) {
        self.next = now;
    }

    /// The request that is due, if one is.
    pub(super) fn poll(&mut self, now: Instant) -> Option<String> {
        if now < self.next {
            return None;
        }
        self.counts.asked += 1;
        self.next = now + RETRY;
        let id = format!("{}{}", self.id_prefix, self.counts.asked);
        let hash = self.standing.held().map(|held| held.hash.as_str());
        Some(wire::request(&self.identity, &id, &self.reply_to, hash))
    }

    /// Takes what came on the reply channel in. Returns the change that it makes, if it makes one.
    pub(super) fn on_reply(&mut self, payload: &[u8], now: Instant) -> Option<ConfigChange> {
        match wire::answer(payload, &self.id_prefix)? {
            Answer::Given { held, node } => {
                self.answered(now);
                if self.node.is_none() {
                    self.node = node;
                }
                self.take(held, None, now)
            }
            Answer::Unchanged { revision, hash, source, store } => {
                self.answered(now);
                let is_other = self.standing.is_of_another_store(store.as_deref(), source);
                let Standing::Held(held) = &mut self.standing else {
                    return None;
                };
                // The hash may be that of an earlier request; then the answer says nothing of what
                // there is now.
                if held.hash == hash && (is_other || revision >= held.revision) {
                    held.revision = revision;
                    held.source = source;
                    held.store = store;
                }
                None
            }
            Answer::Refused(refusal) => {
                self.next = now
                    + match refusal.code.as_str() {
                        "not_ready" => RETRY,
                        "not_found" => RETRY_UNKNOWN,
                        // The same again gets the same.
                        _ => PERIOD,
                    };
                self.refusal = Some(refusal);
                None
            }
        }
    }

    /// Takes a notice in. Returns the change that it makes, if it makes one.
    pub(super) fn on_notice(&mut self, payload: &[u8], now: Instant) -> Option<ConfigChange> {
        let notice = wire::notice(payload)?;
        if !self.is_for_us(&notice) {
            self.counts.for_others += 1;
            return None;
        }
        match notice.held {
            Some(held) => self.take(held, Some((notice.paths, notice.scopes)), now),
            None => self.delete(notice.revision, notice.store, notice.source),
        }
    }

    fn answered(&mut self, now: Instant) {
        self.refusal = None;
        self.next = now + PERIOD;
    }

    fn is_for_us(&self, notice: &Notice) -> bool {
        let of_node = match (&self.node, self.scope) {
            (Some(own), _) => notice.node.as_ref() == Some(own),
            // On the broker of a node all is for that node.
            (None, Scope::Node) => true,
            (None, Scope::Layer | Scope::Ros2 | Scope::Inter) => notice.node.is_none(),
        };
        of_node
            && notice.service == self.identity.service.as_str()
            && notice.instance.as_deref() == Some(self.identity.instance.as_str())
    }

    /// Takes a configuration, unless it is an older one.
    fn take(
        &mut self,
        new: Held,
        told: Option<(Vec<String>, Vec<ConfigScope>)>,
        now: Instant,
    ) -> Option<ConfigChange> {
        let is_other = self.standing.is_of_another_store(new.store.as_deref(), new.source);
        let is_older = match &self.standing {
            _ if is_other => false,
            Standing::Nothing => false,
            Standing::Held(old) => new.revision < old.revision,
            // At the revision that deleted it, a configuration is one of before. All that a mounted
            // file says is of revision 0, and comes in its order.
            Standing::Deleted { revision: 0, .. } => false,
            Standing::Deleted { revision, .. } => new.revision <= *revision,
        };
        if is_older {
            self.counts.older += 1;
            return None;
        }
        let old = match std::mem::replace(&mut self.standing, Standing::Held(new.clone())) {
            Standing::Held(old) => Some(old),
            Standing::Nothing | Standing::Deleted { .. } => None,
        };
        if old.as_ref().is_some_and(|old| old.hash == new.hash) {
            return None;
        }
        if old.as_ref().is_some_and(|old| old.revision == new.revision) {
            // A node that drops a roll-out by itself makes another configuration of the same
            // revision. Which of two is the later one, their order does not tell for sure; the
            // worker does.
            self.next = self.next.min(now + RETRY);
        }
        let old = old.map(|old| old.config);
        let (paths, scopes) = told.unwrap_or_else(|| {
            let nothing = serde_json::Value::Object(serde_json::Map::new());
            let different = diff(old.as_deref().unwrap_or(&nothing), &new.config, "");
            (paths(&different), Vec::new())
        });
        self.counts.changes += 1;
        Some(ConfigChange {
            old,
            revision: new.revision,
            hash: Some(new.hash),
            new: Some(new.config),
            paths,
            scopes,
            deleted: false,
        })
    }

    fn delete(
        &mut self,
        revision: u64,
        store: Option<String>,
        source: ConfigSource,
    ) -> Option<ConfigChange> {
        let is_other = self.standing.is_of_another_store(store.as_deref(), source);
        if !is_other && self.standing.revision().is_some_and(|own| revision < own) {
            self.counts.older += 1;
            return None;
        }
        let old = std::mem::replace(&mut self.standing, Standing::Deleted { revision, store });
        let old = old.held()?.config.clone();
        self.counts.changes += 1;
        Some(ConfigChange {
            old: Some(old),
            new: None,
            revision,
            hash: None,
            paths: Vec::new(),
            scopes: Vec::new(),
            deleted: true,
        })
    }
}

#[cfg(test)]
#[path = "book_tests.rs"]
mod tests;
