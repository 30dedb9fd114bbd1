//! The lease as a key of Redis, with the mark in a second key beside it.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use blaze_brokers::redis::{RedisKeys, RedisLock};
use blaze_domain::LayerName;

use super::{Held, Lease, Mark};
use crate::core::messages::lease_key;

/// A key of Redis, which has the worker's id while it is held.
pub struct RedisLease {
    keys: Arc<RedisKeys>,
    lock: RedisLock,
}

impl RedisLease {
    /// The lease of a layer, for a worker.
    #[must_use]
    pub fn new(keys: Arc<RedisKeys>, layer: &LayerName, owner: String) -> Self {
        let key = lease_key(layer);
        Self { keys, lock: RedisLock { key, owner } }
    }
}

#[async_trait]
impl Lease for RedisLease {
    async fn hold(&self, time: Duration, told: Option<&Mark>) -> Result<Held, String> {
        let text = told.map(Mark::to_text);
        let held = self.keys.hold(&self.lock, time, text.as_deref()).await;
        let held = held.map_err(|error| error.to_string())?;
        Ok(Held { is_held: held.is_held, told: held.note.as_deref().and_then(Mark::parse) })
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
