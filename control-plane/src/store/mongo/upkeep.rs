//! Backup, restore and rewriting.

use std::collections::BTreeMap;

use futures::future::BoxFuture;
use mongodb::bson::{Document, doc};
use mongodb::{ClientSession, Collection, Database};
use tokio::sync::mpsc;

use super::client::{LONG, USUAL, limited};
use super::errors::write_errors;
use super::rows::{self, FLOOR};
use super::{MongoStore, collect};
use crate::store::encode::{corrupt, signed};
use crate::store::upkeep::{
    BackupHead, BackupRow, Piece, RESTORE_RAISES_BY, Restored, Rewriter, Row, not_empty, not_whole, now, rewritten,
    send,
};
use crate::store::{CommitError, StoreError};

/// Documents that one step of a rewriting looks at, and rows that one insertion of a restore has at most.
const STEP: i64 = 200;
const ROWS: usize = 1_000;
/// Bytes of one insertion of a restore.
const BYTES: usize = 8 * 1024 * 1024;

/// Called before each step of a rewriting; an error ends it.
pub(super) type BeforeStep<'a> = &'a (dyn Fn() -> BoxFuture<'a, Result<(), StoreError>> + Sync);

/// How a row is read back.
type ReadRow = fn(&Document) -> Result<Row, StoreError>;

impl MongoStore {
    /// Sends everything, read in one snapshot. A server keeps a snapshot for five minutes
    /// (`minSnapshotHistoryWindowInSeconds`).
    pub(super) async fn send_all(&self, pieces: &mpsc::Sender<Piece>) -> Result<(), StoreError> {
        let tables: [(&str, ReadRow); 5] = [
            ("documents", |found| rows::read_document(found).map(Row::Document)),
            ("versions", |found| rows::read_version(found).map(Row::Version)),
            ("audit", |found| rows::read_audit(found).map(Box::new).map(Row::Audit)),
            ("tokens", |found| rows::read_token(found).map(Row::Token)),
            ("idempotency", |found| {
                rows::read_idempotency(found).map(Row::Idempotency)
            }),
        ];
        // A snapshot session brings its read concern; one of the collections would stand in its way.
        let plain = self.tables.client.database(self.tables.database.name());
        let mut session = limited(USUAL, self.tables.client.start_session().snapshot(true)).await?;
        let head = read_head(&plain, &mut session).await?;
        send(pieces, Piece::Head(head)).await?;
        for (table, read) in tables {
            let table = plain.collection::<Document>(table);
            let find = table.find(doc! {}).sort(doc! { "_id": 1 });
            let mut cursor = limited(USUAL, async { find.session(&mut session).await }).await?;
            while let Some(found) = next(&mut cursor, &mut session).await? {
                if found.get_str("_id").is_ok_and(|id| id != FLOOR) {
                    send(pieces, Piece::Row(BackupRow(read(&found)?))).await?;
                }
            }
        }
        send(pieces, Piece::End).await
    }

    /// Fills an empty store, which cannot be opened until it is whole.
    pub(super) async fn receive_all(&self, mut pieces: mpsc::Receiver<Piece>) -> Result<Restored, StoreError> {
        if !self.is_empty().await? {
            return Err(not_empty());
        }
        let Some(Piece::Head(head)) = pieces.recv().await else {
            return Err(not_whole());
        };
        self.mark(doc! { "$set": { "restoring": true } }).await?;
        let mut filling = Filling::default();
        loop {
            match pieces.recv().await {
                Some(Piece::Row(BackupRow(row))) => filling.add(self, row).await?,
                Some(Piece::End) => break,
                Some(Piece::Head(_)) | None => return Err(not_whole()),
            }
        }
        filling.flush_all(self).await?;
        let restored = Restored {
            store_id: uuid::Uuid::now_v7().to_string(),
            revision: head.revision + RESTORE_RAISES_BY,
        };
        self.raise_floor(signed(restored.revision)).await?;
        self.mark(doc! { "$set": { "store_id": &restored.store_id }, "$unset": { "restoring": "" } })
            .await?;
        Ok(restored)
    }

    async fn mark(&self, change: Document) -> Result<(), StoreError> {
        limited(USUAL, self.tables.meta.update_one(doc! { "_id": "store" }, change)).await?;
        Ok(())
    }

    async fn is_empty(&self) -> Result<bool, StoreError> {
        if self.read_head().await? != 0 {
            return Ok(false);
        }
        let tables = &self.tables;
        for table in [&tables.documents, &tables.versions, &tables.tokens] {
            let any = table
                .find_one(doc! { "_id": { "$ne": FLOOR } })
                .projection(doc! { "_id": 1 });
            if limited(USUAL, any).await?.is_some() {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Rewrites documents, then versions. A document that is changed meanwhile keeps its change.
    pub(super) async fn rewrite_all(&self, make: Rewriter<'_>, before: BeforeStep<'_>) -> Result<u64, StoreError> {
        let documents = self.rewrite_table(&self.tables.documents, make, before).await?;
        Ok(documents + self.rewrite_table(&self.tables.versions, make, before).await?)
    }

    async fn rewrite_table(
        &self,
        table: &Collection<Document>,
        make: Rewriter<'_>,
        before: BeforeStep<'_>,
    ) -> Result<u64, StoreError> {
        let (mut place, mut replaced) = (String::new(), 0);
        loop {
            before().await?;
            let behind = doc! { "_id": { "$gt": &place, "$ne": FLOOR } };
            let find = table.find(behind).sort(doc! { "_id": 1 }).limit(STEP);
            let find = find.projection(doc! { "_id": 1, "document": 1 });
            let texts = collect(find, |found| {
                Ok((rows::text(found, "_id")?, rows::text(found, "document")?))
            })
            .await?;
            let Some((last, _)) = texts.last() else {
                return Ok(replaced);
            };
            place.clone_from(last);
            let mut updates = Vec::new();
            for (id, text) in texts {
                let key = id.split('@').next().unwrap_or_default();
                if let Some(new) = rewritten(key, &text, make)? {
                    updates.push(doc! { "q": { "_id": &id, "document": text }, "u": { "$set": { "document": new } } });
                }
            }
            for some in chunks(updates) {
                replaced += self.replace(table.name(), some).await?;
            }
        }
    }

    async fn replace(&self, table: &str, updates: Vec<Document>) -> Result<u64, StoreError> {
        let command = doc! {
            "update": table, "updates": updates, "ordered": false, "writeConcern": { "w": "majority", "j": true },
        };
        let answer = limited(LONG, self.tables.database.run_command(command)).await?;
        match write_errors(&answer) {
            Some(CommitError::NotWritten(error) | CommitError::Unknown(error)) => Err(error),
            Some(CommitError::Conflict) => Err(StoreError::Unavailable("MongoDB: a write conflict".to_owned())),
            None => u64::try_from(rows::integer(&answer, "nModified")?).map_err(corrupt),
        }
    }
}

/// Below the size of a command, two texts to each update.
fn chunks(updates: Vec<Document>) -> Vec<Vec<Document>> {
    let mut chunks = vec![Vec::new()];
    let mut bytes = 0;
    for update in updates {
        let size = text_bytes(&update);
        if bytes + size > BYTES {
            chunks.push(Vec::new());
            bytes = 0;
        }
        bytes += size;
        if let Some(chunk) = chunks.last_mut() {
            chunk.push(update);
        }
    }
    chunks.retain(|chunk| !chunk.is_empty());
    chunks
}

fn text_bytes(found: &Document) -> usize {
    let sizes = found.values().map(|value| match value {
        mongodb::bson::Bson::String(text) => text.len(),
        mongodb::bson::Bson::Document(inner) => text_bytes(inner),
        _ => 16,
    });
    sizes.sum::<usize>() + rows::OVERHEAD_BYTES
}

async fn read_head(plain: &Database, session: &mut ClientSession) -> Result<BackupHead, StoreError> {
    let events = plain.collection::<Document>("events");
    let newest = events
        .find_one(doc! {})
        .sort(doc! { "_id": -1 })
        .projection(doc! { "_id": 1 });
    let newest = limited(USUAL, newest.session(&mut *session)).await?;
    let floor = plain.collection::<Document>("documents");
    let floor = limited(USUAL, floor.find_one(doc! { "_id": FLOOR }).session(&mut *session)).await?;
    let store = plain.collection::<Document>("meta");
    let store = limited(USUAL, store.find_one(doc! { "_id": "store" }).session(&mut *session)).await?;
    let (Some(floor), Some(store)) = (floor, store) else {
        return Err(corrupt("the floor or the store's identity is missing"));
    };
    let floor = rows::integer(&floor, FLOOR)?;
    let newest = newest.map_or(Ok(0), |newest| rows::integer(&newest, "_id"))?;
    Ok(BackupHead {
        format: 1,
        store_id: rows::text(&store, "store_id")?,
        revision: u64::try_from(newest.max(floor)).map_err(corrupt)?,
        floor: u64::try_from(floor).map_err(corrupt)?,
        time: now().to_string(),
    })
}

async fn next(
    cursor: &mut mongodb::SessionCursor<Document>,
    session: &mut ClientSession,
) -> Result<Option<Document>, StoreError> {
    limited(USUAL, async { cursor.next(session).await.transpose() }).await
}

/// Rows on their way into an empty store, by table.
#[derive(Default)]
struct Filling {
    waiting: BTreeMap<&'static str, Vec<Document>>,
    bytes: usize,
}

impl Filling {
    async fn add(&mut self, store: &MongoStore, row: Row) -> Result<(), StoreError> {
        let table = row.table();
        let new = match row {
            Row::Document(row) => rows::document(&row),
            Row::Version(row) => rows::version(&row),
            Row::Audit(row) => rows::audit(&row),
            Row::Idempotency(row) => rows::idempotency(&row),
            Row::Token(row) => rows::token(&row),
        };
        self.bytes += text_bytes(&new);
        let waiting = self.waiting.entry(table).or_default();
        waiting.push(new);
        if self.bytes >= BYTES || waiting.len() >= ROWS {
            self.flush_all(store).await?;
        }
        Ok(())
    }

    async fn flush_all(&mut self, store: &MongoStore) -> Result<(), StoreError> {
        self.bytes = 0;
        for (table, rows) in std::mem::take(&mut self.waiting) {
            let table = store.tables.database.collection::<Document>(table);
            // No retry by ourselves: a restore that fails is done again, into a new database.
            limited(LONG, async { table.insert_many(rows).await.map(|_| ()) }).await?;
        }
        Ok(())
    }
}
