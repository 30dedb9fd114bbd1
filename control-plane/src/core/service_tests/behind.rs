//! Two services on one store, of which one hears nothing of what the other commits.

use async_trait::async_trait;
use blaze_domain::config::Timestamp;

use super::*;
use crate::store::{
    Archive, AuditEntry, CommitBatch, CommitError, CommitLog, CommitRecord, IdempotencyRecord,
    Snapshot, StoreError, TokenRecord, TokenStore, Version,
};

/// A store that others write to as well, and that never says so.
struct Silent(SqliteStore);

#[async_trait]
impl CommitLog for Silent {
    fn is_shared(&self) -> bool {
        true
    }

    async fn load(&self) -> Result<Snapshot, StoreError> {
        self.0.load().await
    }

    async fn head(&self) -> Result<u64, StoreError> {
        self.0.head().await
    }

    async fn commits_after(&self, revision: u64, limit: usize) -> Result<CommitBatch, StoreError> {
        self.0.commits_after(revision, limit).await
    }

    async fn commit(&self, records: &[CommitRecord]) -> Result<(), CommitError> {
        self.0.commit(records).await
    }

    async fn foreign_commit(&self) {
        std::future::pending::<()>().await;
    }
}

#[async_trait]
impl Archive for Silent {
    async fn versions(
        &self,
        key: &Key,
        below: Option<u64>,
        limit: usize,
    ) -> Result<Vec<Version>, StoreError> {
        self.0.versions(key, below, limit).await
    }

    async fn documents_at(
        &self,
        revision: u64,
        until: u64,
    ) -> Result<Vec<(Key, Option<Document>)>, StoreError> {
        self.0.documents_at(revision, until).await
    }

    async fn trim(&self, floor: u64, keep_versions: u32) -> Result<u64, StoreError> {
        self.0.trim(floor, keep_versions).await
    }

    async fn expiry_time(&self, clock: Timestamp, most: Duration) -> Result<Timestamp, StoreError> {
        self.0.expiry_time(clock, most).await
    }

    async fn revision_before(&self, time: Timestamp) -> Result<u64, StoreError> {
        self.0.revision_before(time).await
    }

    async fn append_audit(&self, entries: &[AuditEntry]) -> Result<(), StoreError> {
        self.0.append_audit(entries).await
    }

    async fn audit(&self, query: &AuditQuery) -> Result<Vec<AuditEntry>, StoreError> {
        self.0.audit(query).await
    }

    async fn idempotency(
        &self,
        id: &str,
        now: Timestamp,
    ) -> Result<Option<IdempotencyRecord>, StoreError> {
        self.0.idempotency(id, now).await
    }
}

#[async_trait]
impl TokenStore for Silent {
    async fn add_token(&self, token: &TokenRecord, audit: &AuditEntry) -> Result<(), StoreError> {
        self.0.add_token(token, audit).await
    }

    async fn revoke_token(
        &self,
        id: &str,
        time: Timestamp,
        audit: &AuditEntry,
    ) -> Result<bool, StoreError> {
        self.0.revoke_token(id, time, audit).await
    }

    async fn tokens(&self, now: Timestamp) -> Result<Vec<TokenRecord>, StoreError> {
        self.0.tokens(now).await
    }
}

#[tokio::test]
async fn a_change_that_would_change_nothing_is_compared_with_the_newest_state() {
    let supervisor = Supervisor::new("store");
    let store = Arc::new(Silent(SqliteStore::in_memory(&supervisor).await.unwrap()));
    let (one, other) = (world_on(&store, &[]).await, world_on(&store, &[]).await);
    let spec = |n: u64| json!({ "config": { "n": n } });
    one.put("Service/s", spec(1)).await;
    other.put("Layer/l", json!({ "kind": "edge" })).await;
    // Both know the first; only one knows the second.
    one.put("Service/s", spec(2)).await;
    let again = other.patch("Service/s", json!({ "spec": spec(1) })).await.unwrap();
    assert_eq!((again.revision, &*again.spec), (4, &spec(1)));
}
