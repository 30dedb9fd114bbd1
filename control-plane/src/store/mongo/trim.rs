//! Removing what nobody needs any more. What expires by itself (audit, answers, tokens) is removed by the server.

use std::collections::BTreeSet;

use futures::TryStreamExt as _;
use mongodb::bson::{Document, doc};

use super::client::{LONG, USUAL, limited, limited_steps};
use super::errors::store_error;
use super::{MongoStore, collect, rows};
use crate::store::StoreError;
use crate::store::encode::{signed, unsigned};
use crate::store::retain::{Trimmed, to_spare};

/// Commits or versions that one command removes.
const STEP: i64 = 1_000;

impl MongoStore {
    /// Raises the floor, which readers see before anything goes, then removes.
    pub(super) async fn trim_to(&self, floor: u64, keep: u32) -> Result<u64, StoreError> {
        let head = signed(self.read_head().await?);
        let floor = self.raise_floor(signed(floor).min(head)).await?;
        let now = Trimmed { floor, head, keep };
        self.remove_events(floor).await?;
        self.remove_versions(now).await?;
        let note = doc! { "$set": { "floor": now.floor, "head": now.head, "keep": i64::from(now.keep) } };
        let note = self
            .tables
            .meta
            .update_one(doc! { "_id": "trimmed" }, note)
            .upsert(true);
        limited(USUAL, note).await?;
        unsigned(floor)
    }

    async fn remove_events(&self, floor: i64) -> Result<(), StoreError> {
        let events = &self.tables.events;
        loop {
            let oldest = events
                .find_one(doc! {})
                .sort(doc! { "_id": 1 })
                .projection(doc! { "_id": 1 });
            let Some(oldest) = limited(USUAL, oldest).await? else {
                return Ok(());
            };
            let oldest = rows::integer(&oldest, "_id")?;
            if oldest > floor {
                return Ok(());
            }
            let until = floor.min(oldest + STEP - 1);
            limited(USUAL, events.delete_many(doc! { "_id": { "$lte": until } })).await?;
        }
    }

    async fn remove_versions(&self, now: Trimmed) -> Result<(), StoreError> {
        let before = self.read_note().await?;
        let mut doomed = Vec::new();
        for key in self.changed_keys(before, now).await? {
            let mine = rows::versions_below(&key, i64::MAX);
            let find = self
                .tables
                .versions
                .find(mine)
                .sort(doc! { "_id": -1 })
                .projection(doc! { "_id": 1 });
            let revisions = collect(find, |found| Ok(rows::split_version_id(&rows::text(found, "_id")?)?.1)).await?;
            let gone = to_spare(&revisions, now.floor, now.keep);
            doomed.extend(gone.into_iter().map(|revision| rows::version_id(&key, revision)));
            if doomed.len() >= usize::try_from(STEP).unwrap_or(usize::MAX) {
                self.remove_named(std::mem::take(&mut doomed)).await?;
            }
        }
        self.remove_named(doomed).await
    }

    async fn remove_named(&self, ids: Vec<String>) -> Result<(), StoreError> {
        if !ids.is_empty() {
            limited(USUAL, self.tables.versions.delete_many(doc! { "_id": { "$in": ids } })).await?;
        }
        Ok(())
    }

    /// Documents that may have versions to spare since the last trimming.
    async fn changed_keys(&self, before: Trimmed, now: Trimmed) -> Result<BTreeSet<String>, StoreError> {
        let mut keys = BTreeSet::new();
        for (above, until) in before.ranges_until(now) {
            let range = doc! { "revision": { "$gt": above, "$lte": until } };
            let find = self.tables.versions.find(range).projection(doc! { "_id": 1 });
            limited_steps(LONG, async {
                let mut cursor = find.await.map_err(store_error)?;
                while let Some(found) = cursor.try_next().await.map_err(store_error)? {
                    keys.insert(rows::split_version_id(&rows::text(&found, "_id")?)?.0.to_owned());
                }
                Ok(())
            })
            .await?;
        }
        Ok(keys)
    }

    /// How far the last trimming came; what is not there means that everything is looked at.
    async fn read_note(&self) -> Result<Trimmed, StoreError> {
        let found = limited(USUAL, self.tables.meta.find_one(doc! { "_id": "trimmed" })).await?;
        Ok(found.as_ref().and_then(note).unwrap_or_default())
    }
}

fn note(found: &Document) -> Option<Trimmed> {
    Some(Trimmed {
        floor: rows::integer(found, "floor").ok()?,
        head: rows::integer(found, "head").ok()?,
        keep: u32::try_from(rows::integer(found, "keep").ok()?).ok()?,
    })
}
