//! Callbacks for changes, each with a queue of its own on the service's pool.
//!
//! A listener has at most one ticket in the pool, so its callbacks come one at a time and in order.
//! A full queue makes one change of its last two: a slow callback sees fewer steps, and always the
//! last state.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use parking_lot::Mutex;

use super::change::{ConfigChange, ConfigScope};
use crate::pool::{Job, PoolHandle};

/// Changes that wait for one callback, at most.
pub(super) const MAX_WAITING: usize = 16;

type Callback = Box<dyn Fn(&ConfigChange) + Send + Sync>;

/// Everyone who is told.
pub(super) struct Listeners {
    pool: PoolHandle,
    all: Mutex<Vec<Arc<Inner>>>,
}

struct Inner {
    /// What it wants to hear of; empty: everything.
    scopes: Vec<ConfigScope>,
    callback: Callback,
    queue: Mutex<Queue>,
    merged: AtomicU64,
    panicked: AtomicU64,
}

#[derive(Default)]
struct Queue {
    waiting: VecDeque<ConfigChange>,
    has_ticket: bool,
    closed: bool,
}

/// A callback for changes, as long as it is held.
#[must_use = "dropping it ends the callbacks"]
pub struct ConfigListener {
    inner: Arc<Inner>,
}

impl ConfigListener {
    /// Changes that became one with the one before because the callback was slow.
    #[must_use]
    pub fn merged(&self) -> u64 {
        self.inner.merged.load(Ordering::Relaxed)
    }

    /// Callbacks that panicked.
    #[must_use]
    pub fn panicked(&self) -> u64 {
        self.inner.panicked.load(Ordering::Relaxed)
    }
}

impl Drop for ConfigListener {
    fn drop(&mut self) {
        let mut queue = self.inner.queue.lock();
        queue.closed = true;
        queue.waiting.clear();
    }
}

impl Listeners {
    pub(super) fn new(pool: PoolHandle) -> Self {
        Self { pool, all: Mutex::default() }
    }

    pub(super) fn add(&self, scopes: &[ConfigScope], callback: Callback) -> ConfigListener {
        let inner = Arc::new(Inner {
            scopes: scopes.to_vec(),
            callback,
            queue: Mutex::default(),
            merged: AtomicU64::new(0),
            panicked: AtomicU64::new(0),
        });
        let mut all = self.all.lock();
        all.retain(|inner| !inner.queue.lock().closed);
        all.push(Arc::clone(&inner));
        ConfigListener { inner }
    }

    /// Tells all that want to hear of it.
    pub(super) fn tell(&self, change: &ConfigChange) {
        let mut all = self.all.lock();
        all.retain(|inner| !inner.queue.lock().closed);
        for inner in all.iter().filter(|inner| inner.wants(change)) {
            if inner.offer(change.clone()) {
                self.pool.submit(Arc::clone(inner) as Arc<dyn Job>);
            }
        }
    }
}

impl Inner {
    fn wants(&self, change: &ConfigChange) -> bool {
        self.scopes.is_empty() || self.scopes.iter().any(|scope| change.is_of(*scope))
    }

    /// Returns whether it needs a ticket.
    fn offer(&self, change: ConfigChange) -> bool {
        let mut queue = self.queue.lock();
        let change = match queue.waiting.len() >= MAX_WAITING {
            true => {
                self.merged.fetch_add(1, Ordering::Relaxed);
                match queue.waiting.pop_back() {
                    Some(last) => last.followed_by(change),
                    None => change,
                }
            }
            false => change,
        };
        queue.waiting.push_back(change);
        !std::mem::replace(&mut queue.has_ticket, true)
    }
}

impl Job for Inner {
    fn run_one(&self) -> bool {
        let next = self.queue.lock().waiting.pop_front();
        if let Some(change) = next
            && catch_unwind(AssertUnwindSafe(|| (self.callback)(&change))).is_err()
        {
            self.panicked.fetch_add(1, Ordering::Relaxed);
            tracing::error!(
                revision = change.revision,
                "the callback for a change of the configuration panicked"
            );
        }
        let mut queue = self.queue.lock();
        queue.has_ticket = !queue.waiting.is_empty();
        queue.has_ticket
    }
}

#[cfg(test)]
mod tests {
    use blaze_runtime::Supervisor;

    use super::*;
    use crate::config::change::tests::change;
    use crate::pool::Pool;
    use crate::pool::tests::eventually;

    #[tokio::test]
    async fn a_slow_callback_sees_fewer_steps_in_order_and_the_last_state() {
        let supervisor = Supervisor::new("t");
        let pool = Pool::start(2, &supervisor).unwrap();
        let listeners = Listeners::new(pool.handle());
        let gate = Arc::new(Mutex::new(()));
        let seen: Arc<Mutex<Vec<(u64, u64)>>> = Arc::default();
        let (passes, notes) = (Arc::clone(&gate), Arc::clone(&seen));
        let number = |config: &Option<Arc<serde_json::Value>>| {
            config.as_ref().unwrap()["n"].as_u64().unwrap()
        };
        let listener = listeners.add(
            &[],
            Box::new(move |change| {
                let _pass = passes.lock();
                notes.lock().push((number(&change.old), number(&change.new)));
            }),
        );
        let closed = gate.lock();
        let all = 3 * MAX_WAITING as u64;
        for revision in 1..=all {
            listeners.tell(&change(revision, &[], &[]));
        }
        drop(closed);
        eventually(|| seen.lock().last().is_some_and(|(_, new)| *new == all));
        let seen = seen.lock();
        assert!(seen.len() <= MAX_WAITING + 1 && listener.merged() >= all - 1 - MAX_WAITING as u64);
        assert_eq!(seen[0].0, 0);
        assert!(seen.windows(2).all(|pair| pair[0].1 == pair[1].0), "no step is missing: {seen:?}");
    }

    #[tokio::test]
    async fn a_callback_hears_of_its_scopes_and_survives_its_own_panic() {
        let supervisor = Supervisor::new("t");
        let pool = Pool::start(2, &supervisor).unwrap();
        let listeners = Listeners::new(pool.handle());
        let seen: Arc<Mutex<Vec<u64>>> = Arc::default();
        let notes = Arc::clone(&seen);
        let listener = listeners.add(
            &[ConfigScope::Node],
            Box::new(move |change| {
                notes.lock().push(change.revision);
                assert_ne!(change.revision, 2, "on purpose");
            }),
        );
        listeners.tell(&change(1, &[ConfigScope::Service], &[]));
        listeners.tell(&change(2, &[ConfigScope::Node], &[]));
        listeners.tell(&change(3, &[], &[]));
        eventually(|| seen.lock().len() == 2 && listener.panicked() == 1);
        assert_eq!(*seen.lock(), [2, 3]);
        drop(listener);
        listeners.tell(&change(4, &[], &[]));
        assert!(listeners.all.lock().is_empty());
    }
}
