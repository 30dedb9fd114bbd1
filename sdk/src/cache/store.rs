//! What a service keeps keys in.

use std::time::Duration;

use async_trait::async_trait;
use blaze_brokers::redis::{KeyChange, KeyError, Record, RedisKeys};
use bytes::Bytes;

/// Keys that vanish. Redis, or what tests take for it.
#[async_trait]
pub(crate) trait Store: Send + Sync + 'static {
    /// A record; `None` if there is none.
    async fn record(&self, key: &str) -> Result<Option<Record>, KeyError>;
    /// Records whose key begins so, at most so many.
    async fn records(
        &self,
        beginning: &str,
        most: usize,
    ) -> Result<Vec<(String, Record)>, KeyError>;
    /// A record with these members and no others, for so long.
    async fn put_record(
        &self,
        key: &str,
        members: Record,
        expires: Duration,
    ) -> Result<(), KeyError>;
    /// There is no such record of this epoch.
    async fn delete_record(&self, key: &str, epoch: &str) -> Result<(), KeyError>;
    /// The value of a key.
    async fn get(&self, key: &str) -> Result<Option<Bytes>, KeyError>;
    /// A value, for so long.
    async fn put(&self, key: &str, value: &Bytes, expires: Duration) -> Result<(), KeyError>;
}

#[async_trait]
impl Store for RedisKeys {
    async fn record(&self, key: &str) -> Result<Option<Record>, KeyError> {
        Self::record(self, key).await
    }

    async fn records(
        &self,
        beginning: &str,
        most: usize,
    ) -> Result<Vec<(String, Record)>, KeyError> {
        Self::records(self, beginning, most).await
    }

    async fn put_record(
        &self,
        key: &str,
        members: Record,
        expires: Duration,
    ) -> Result<(), KeyError> {
        let key = key.to_owned();
        self.apply(&[KeyChange::PutRecord { key, members, expires }], &[]).await
    }

    async fn delete_record(&self, key: &str, epoch: &str) -> Result<(), KeyError> {
        Self::delete_record(self, key, "epoch", epoch).await
    }

    async fn get(&self, key: &str) -> Result<Option<Bytes>, KeyError> {
        Self::get(self, key).await
    }

    async fn put(&self, key: &str, value: &Bytes, expires: Duration) -> Result<(), KeyError> {
        self.put_for(key, value, expires).await
    }
}
