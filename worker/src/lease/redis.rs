//! The lease as a key of Redis, with the mark in a second key beside it.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use blaze_brokers::redis::{RedisKeys, RedisLock};
use blaze_domain::{LayerName, NodeName};

use super::{Held, Lease, Mark};
use crate::core::messages::{lease_key, node_lease_key};

/// A key of Redis, which has the worker's id while it is held.
pub struct RedisLease {
    keys: Arc<RedisKeys>,
    lock: RedisLock,
    of_node: bool,
}

impl RedisLease {
    /// The lease of a layer, for a worker.
    #[must_use]
    pub fn new(keys: Arc<RedisKeys>, layer: &LayerName, owner: String) -> Self {
        let key = lease_key(layer);
        Self { keys, lock: RedisLock { key, owner }, of_node: false }
    }

    /// The lease of a node. One worker is meant to run there: the one that was started last takes
    /// it at once, and what was started before stands back until that one has ended. `started_ms`
    /// is since 1970; `worker` is its name and place, for people.
    #[must_use]
    pub fn of_node(
        keys: Arc<RedisKeys>,
        (layer, node): (&LayerName, &NodeName),
        started_ms: u64,
        worker: &str,
    ) -> Self {
        let key = node_lease_key(layer, node);
        // Of equal length, so that the later one is the larger name.
        let owner = format!("{started_ms:020} {worker}");
        Self { keys, lock: RedisLock { key, owner }, of_node: true }
    }
}

#[async_trait]
impl Lease for RedisLease {
    async fn hold(&self, time: Duration, told: Option<&Mark>) -> Result<Held, String> {
        if self.of_node {
            let other = self.keys.claim(&self.lock, time).await;
            let other = other.map_err(|error| error.to_string())?;
            let by = other.map(|owner| match owner.split_once(' ') {
                Some((_, worker)) => worker.to_owned(),
                None => owner,
            });
            return Ok(Held { is_held: by.is_none(), told: None, by });
        }
        let text = told.map(Mark::to_text);
        let held = self.keys.hold(&self.lock, time, text.as_deref()).await;
        let held = held.map_err(|error| error.to_string())?;
        Ok(Held {
            is_held: held.is_held,
            told: held.note.as_deref().and_then(Mark::parse),
            by: None,
        })
    }

    async fn release(&self) {
        if let Err(error) = self.keys.release(&self.lock).await {
            tracing::debug!(%error, "the lease was not given up; it runs out");
        }
    }

    fn lock(&self) -> Option<&RedisLock> {
        Some(&self.lock)
    }

    fn describe(&self) -> String {
        format!("Redis {}, key {}", self.keys.place(), self.lock.key)
    }
}
