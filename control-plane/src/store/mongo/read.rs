//! Reading the log and the documents.

use std::time::Duration;

use futures::TryStreamExt as _;
use mongodb::bson::{Document, doc};
use mongodb::error::Error;
use tokio::time::Instant;

use super::MongoStore;
use super::client::{LONG, QUICK, USUAL, limited, limited_steps};
use super::errors::{is_snapshot_unavailable, store_error};
use super::rows::{self, FLOOR};
use crate::store::encode::{corrupt, decode_commits, signed, unsigned};
use crate::store::rows::EventRow;
use crate::store::{CommitBatch, READ_BYTES, Snapshot, StoreError};

/// Just after collections were made there is no snapshot of them for a moment.
const NO_SNAPSHOT: Duration = Duration::from_secs(5);

impl MongoStore {
    /// The newest revision that a majority has.
    pub(super) async fn read_head(&self) -> Result<u64, StoreError> {
        let newest = self
            .tables
            .events
            .find_one(doc! {})
            .sort(doc! { "_id": -1 })
            .projection(doc! { "_id": 1 });
        match limited(QUICK, newest).await? {
            Some(found) => unsigned(rows::integer(&found, "_id")?),
            // All commits up to the floor are gone, and none came after it.
            None => self.read_floor().await,
        }
    }

    pub(super) async fn read_floor(&self) -> Result<u64, StoreError> {
        let found = limited(QUICK, self.tables.documents.find_one(doc! { "_id": FLOOR })).await?;
        let found = found.ok_or_else(|| corrupt("the floor is missing"))?;
        unsigned(rows::integer(&found, FLOOR)?)
    }

    /// Everything in one snapshot.
    pub(super) async fn read_all(&self) -> Result<Snapshot, StoreError> {
        let until = Instant::now() + NO_SNAPSHOT;
        loop {
            match limited_steps(LONG, async { Ok(self.read_snapshot().await) }).await? {
                Ok(snapshot) => return snapshot,
                Err(error) if is_snapshot_unavailable(&error) && Instant::now() < until => {
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
                Err(error) => return Err(store_error(error)),
            }
        }
    }

    async fn read_snapshot(&self) -> Result<Result<Snapshot, StoreError>, Error> {
        // A snapshot session brings its read concern; one of the collection would stand in its way.
        let plain = self.tables.client.database(self.tables.database.name());
        let mut session = self.tables.client.start_session().snapshot(true).await?;
        let events = plain.collection::<Document>("events");
        let newest = events
            .find_one(doc! {})
            .sort(doc! { "_id": -1 })
            .projection(doc! { "_id": 1 });
        let newest = newest.session(&mut session).await?;
        let meta = plain.collection::<Document>("meta");
        let meta = meta.find_one(doc! { "_id": "store" }).session(&mut session).await?;
        let documents = plain.collection::<Document>("documents");
        let mut cursor = documents.find(doc! {}).session(&mut session).await?;
        let mut found = Vec::new();
        while let Some(document) = cursor.next(&mut session).await.transpose()? {
            found.push(document);
        }
        Ok(snapshot(newest.as_ref(), meta.as_ref(), &found))
    }

    /// Commits after a revision, then the floor.
    pub(super) async fn read_commits(&self, after: u64, limit: usize) -> Result<CommitBatch, StoreError> {
        let events = self.read_events(signed(after), limit).await?;
        let Some(last) = events.last().map(|event| event.revision) else {
            return Ok(CommitBatch {
                commits: Vec::new(),
                floor: self.read_floor().await?,
            });
        };
        let range = doc! { "revision": { "$gt": signed(after), "$lte": last } };
        let versions = self
            .tables
            .versions
            .find(range)
            .sort(doc! { "revision": 1, "position": 1 });
        let versions = super::collect(versions, rows::read_version).await?;
        let floor = self.read_floor().await?;
        if floor > after {
            // Some of it may have been removed while it was read.
            return Ok(CommitBatch {
                commits: Vec::new(),
                floor,
            });
        }
        Ok(CommitBatch {
            commits: decode_commits(after, events, versions)?,
            floor,
        })
    }

    /// As many as `limit` and [`READ_BYTES`] allow, at least one.
    async fn read_events(&self, after: i64, limit: usize) -> Result<Vec<EventRow>, StoreError> {
        let limit = i64::try_from(limit.max(1)).unwrap_or(i64::MAX);
        let find = self
            .tables
            .events
            .find(doc! { "_id": { "$gt": after } })
            .sort(doc! { "_id": 1 })
            .limit(limit);
        limited_steps(USUAL, async {
            let mut cursor = find.await.map_err(store_error)?;
            let mut events: Vec<EventRow> = Vec::new();
            let mut bytes = 0;
            while let Some(found) = cursor.try_next().await.map_err(store_error)? {
                let event = rows::read_event(&found)?;
                bytes += event.bytes;
                if bytes > READ_BYTES && !events.is_empty() {
                    break;
                }
                events.push(event);
            }
            Ok(events)
        })
        .await
    }
}

fn snapshot(newest: Option<&Document>, meta: Option<&Document>, found: &[Document]) -> Result<Snapshot, StoreError> {
    let meta = meta.ok_or_else(|| corrupt("the store's identity is missing"))?;
    let mut floor = None;
    let mut documents = Vec::with_capacity(found.len());
    for document in found {
        match document.get_str("_id") {
            Ok(FLOOR) => floor = Some(unsigned(rows::integer(document, FLOOR)?)?),
            _ => documents.push(rows::read_document(document)?.into_document()?),
        }
    }
    let floor = floor.ok_or_else(|| corrupt("the floor is missing"))?;
    let newest = newest
        .map(|newest| unsigned(rows::integer(newest, "_id")?))
        .transpose()?;
    Ok(Snapshot {
        store_id: rows::text(meta, "store_id")?,
        floor,
        revision: newest.unwrap_or(0).max(floor),
        documents,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_store_without_commits_is_at_its_floor() {
        let meta = doc! { "_id": "store", "store_id": "s" };
        let floor = doc! { "_id": FLOOR, "floor": 9_i64 };
        let found = snapshot(None, Some(&meta), std::slice::from_ref(&floor)).unwrap();
        assert_eq!((found.revision, found.floor, found.documents.len()), (9, 9, 0));
        let newest = doc! { "_id": 12_i64 };
        assert_eq!(snapshot(Some(&newest), Some(&meta), &[floor]).unwrap().revision, 12);
        assert!(snapshot(None, Some(&meta), &[]).is_err());
        assert!(snapshot(None, None, &[]).is_err());
    }
}
