//! Backup, restore and rewriting.

use std::collections::BTreeMap;

use futures::future::BoxFuture;
use mongodb::bson::{Document, doc};
use mongodb::{ClientSession, Collection, Database};
use tokio::sync::mpsc;

use super::client::{LONG, Tables, USUAL, limited};
use super::errors::write_error;
use super::rows::{self, FLOOR, Guard, Record};
use super::statements::RECORD_COMMITS;
use super::{MongoStore, collect};
use crate::store::StoreError;
use crate::store::encode::{corrupt, signed};
use crate::store::rows::DocumentRow;
use crate::store::upkeep::{
    BackupHead, BackupRow, Piece, RESTORE_RAISES_BY, Restored, Rewriter, Row, not_empty, not_whole,
    now, rewritten, send,
};

/// Documents that one step of a rewriting looks at, and rows that one insertion of a restore has at
/// most.
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
        let tables = self.tables();
        let kinds: [(&str, ReadRow); 4] = [
            ("versions", |found| rows::read_version(found).map(Row::Version)),
            ("audit", |found| rows::read_audit(found).map(Box::new).map(Row::Audit)),
            ("tokens", |found| rows::read_token(found).map(Row::Token)),
            ("idempotency", |found| rows::read_idempotency(found).map(Row::Idempotency)),
        ];
        // A snapshot session brings its read concern; one of the collections would stand in its
        // way.
        let plain = tables.client.database(tables.database.name());
        let mut session = limited(USUAL, tables.client.start_session().snapshot(true)).await?;
        let (head, guard) = read_head(&plain, &mut session).await?;
        send(pieces, Piece::Head(head)).await?;
        let row = |row| send(pieces, Piece::Row(BackupRow(row)));
        // What the documents lack, they get on the way.
        let mut changed = self.send_log(&plain, &mut session, guard, pieces).await?;
        let documents = plain.collection::<Document>("documents");
        let find = documents.find(doc! { "_id": { "$ne": FLOOR } }).sort(doc! { "_id": 1 });
        let mut cursor = limited(USUAL, async { find.session(&mut session).await }).await?;
        while let Some(found) = next(&mut cursor, &mut session).await? {
            let old = rows::read_document(&found)?;
            if let Some(now) = changed.remove(&old.key).unwrap_or(Some(old)) {
                row(Row::Document(now)).await?;
            }
        }
        for new in changed.into_values().flatten() {
            row(Row::Document(new)).await?;
        }
        for (table, read) in kinds {
            let table = plain.collection::<Document>(table);
            let find = table.find(doc! {}).sort(doc! { "_id": 1 });
            let mut cursor = limited(USUAL, async { find.session(&mut session).await }).await?;
            while let Some(found) = next(&mut cursor, &mut session).await? {
                row(read(&found)?).await?;
            }
        }
        send(pieces, Piece::End).await
    }

    /// Sends what is in the log alone. Gives the documents that changed since those of the table;
    /// none for a deleted one.
    async fn send_log(
        &self,
        plain: &Database,
        session: &mut ClientSession,
        guard: Guard,
        pieces: &mpsc::Sender<Piece>,
    ) -> Result<BTreeMap<String, Option<DocumentRow>>, StoreError> {
        let row = |row| send(pieces, Piece::Row(BackupRow(row)));
        let mut changed = BTreeMap::new();
        let events = plain.collection::<Document>("events");
        let above =
            doc! { "last": { "$gt": guard.floor }, "_id": { "$gt": guard.floor - RECORD_COMMITS } };
        let find = events.find(above).sort(doc! { "_id": 1 });
        let mut cursor = limited(USUAL, async { find.session(&mut *session).await }).await?;
        let mut ahead = read_next(&mut cursor, session).await?;
        while let Some(record) = ahead.take() {
            ahead = read_next(&mut cursor, session).await?;
            if ahead.as_ref().is_some_and(|next| next.first <= record.last) {
                // It lies under others, so it came too late: see `fence`.
                continue;
            }
            let lacking: Vec<i64> = record.incomplete().collect();
            for version in record.versions {
                if version.revision > guard.folded {
                    let current = (!version.is_deletion()).then(|| version.clone().into_current());
                    changed.insert(version.key.clone(), current);
                }
                // Up to the floor they are copied already.
                if version.revision > guard.floor {
                    row(Row::Version(version)).await?;
                }
            }
            self.note_rest(plain, session, (lacking, guard.folded), &mut changed).await?;
            for entry in record.audit {
                row(Row::Audit(Box::new(entry))).await?;
            }
            for answer in record.answers {
                row(Row::Idempotency(answer)).await?;
            }
        }
        Ok(changed)
    }

    /// Changes that a record had no room for are sent with the table that has them.
    async fn note_rest(
        &self,
        plain: &Database,
        session: &mut ClientSession,
        (lacking, folded): (Vec<i64>, i64),
        changed: &mut BTreeMap<String, Option<DocumentRow>>,
    ) -> Result<(), StoreError> {
        if lacking.is_empty() {
            return Ok(());
        }
        let versions = plain.collection::<Document>("versions");
        let find = versions.find(doc! { "revision": { "$in": lacking } });
        let mut cursor = limited(USUAL, async { find.session(&mut *session).await }).await?;
        while let Some(found) = next(&mut cursor, session).await? {
            let version = rows::read_version(&found)?;
            if version.revision > folded {
                let current = (!version.is_deletion()).then(|| version.clone().into_current());
                changed.insert(version.key, current);
            }
        }
        Ok(())
    }

    /// Fills an empty store, which cannot be opened until it is whole.
    pub(super) async fn receive_all(
        &self,
        mut pieces: mpsc::Receiver<Piece>,
    ) -> Result<Restored, StoreError> {
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
        self.start_at(signed(restored.revision)).await?;
        self.mark(
            doc! { "$set": { "store_id": &restored.store_id }, "$unset": { "restoring": "" } },
        )
        .await?;
        Ok(restored)
    }

    /// The log goes on above a revision, and the documents are those of it.
    async fn start_at(&self, revision: i64) -> Result<(), StoreError> {
        let tables = self.tables();
        let guard = doc! { "$max": { FLOOR: revision, "folded": revision } };
        limited(USUAL, tables.documents.update_one(doc! { "_id": FLOOR }, guard)).await?;
        Ok(())
    }

    async fn mark(&self, change: Document) -> Result<(), StoreError> {
        let tables = self.tables();
        limited(USUAL, tables.meta.update_one(doc! { "_id": "store" }, change)).await?;
        Ok(())
    }

    async fn is_empty(&self) -> Result<bool, StoreError> {
        let tables = self.tables();
        if self.read_head().await? != 0 {
            return Ok(false);
        }
        for table in [&tables.documents, &tables.versions, &tables.tokens] {
            let any =
                table.find_one(doc! { "_id": { "$ne": FLOOR } }).projection(doc! { "_id": 1 });
            if limited(USUAL, any).await?.is_some() {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Rewrites the log, then documents and versions. A document that is changed meanwhile keeps
    /// its change. Whoever has read of the log before, and is about to copy it, finds the guard
    /// changed, and begins anew.
    pub(super) async fn rewrite_all(
        &self,
        make: Rewriter<'_>,
        before: BeforeStep<'_>,
    ) -> Result<u64, StoreError> {
        let tables = self.tables();
        if !self.has_guard().await? {
            // It was never opened, so it has no documents.
            return Ok(0);
        }
        let head = self.read_head().await?;
        self.fold_until(signed(head)).await?;
        let mut replaced = self.rewrite_log(make, before).await?;
        let count = doc! { "$inc": { "rewrites": 1_i64 } };
        limited(USUAL, tables.documents.update_one(doc! { "_id": FLOOR }, count)).await?;
        replaced += self.rewrite_table(|tables| &tables.documents, make, before).await?;
        Ok(replaced + self.rewrite_table(|tables| &tables.versions, make, before).await?)
    }

    /// Below the floor, too, for as long as it is there.
    async fn rewrite_log(
        &self,
        make: Rewriter<'_>,
        before: BeforeStep<'_>,
    ) -> Result<u64, StoreError> {
        let (mut place, mut replaced) = (i64::MIN, 0);
        loop {
            before().await?;
            let tables = self.tables();
            let behind = doc! { "_id": { "$gt": place } };
            let find = tables.events.find(behind).sort(doc! { "_id": 1 }).limit(STEP / 4);
            let find = find.projection(doc! { "docs.key": 1, "docs.document": 1 });
            let found = collect(find, |found| Ok(found.clone())).await?;
            let Some(last) = found.last() else {
                return Ok(replaced);
            };
            place = rows::integer(last, "_id")?;
            for record in found {
                replaced += self.rewrite_record(&record, make).await?;
            }
        }
    }

    async fn rewrite_record(
        &self,
        record: &Document,
        make: Rewriter<'_>,
    ) -> Result<u64, StoreError> {
        let tables = self.tables();
        let (mut old, mut new) = (doc! { "_id": rows::integer(record, "_id")? }, Document::new());
        for (place, change) in rows::members(record, "docs").enumerate() {
            let change = change?;
            let text = rows::text(change, "document")?;
            if let Some(made) = rewritten(&rows::text(change, "key")?, &text, make)? {
                // Nothing changes a record but another rewriting, and that changes all of it.
                if new.is_empty() {
                    old.insert(format!("docs.{place}.document"), text);
                }
                new.insert(format!("docs.{place}.document"), made);
            }
        }
        if new.is_empty() {
            return Ok(0);
        }
        let count = u64::try_from(new.len()).map_err(corrupt)?;
        let update = tables.events.update_one(old, doc! { "$set": new });
        let done = limited(LONG, update).await?;
        Ok(count * done.modified_count)
    }

    async fn rewrite_table(
        &self,
        table: fn(&Tables) -> &Collection<Document>,
        make: Rewriter<'_>,
        before: BeforeStep<'_>,
    ) -> Result<u64, StoreError> {
        let (mut place, mut replaced) = (String::new(), 0);
        loop {
            before().await?;
            let tables = self.tables();
            let table = table(&tables);
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
                    updates.push(doc! { "q": { "_id": &id, "document": text },
                    "u": { "$set": { "document": new } } });
                }
            }
            for some in chunks(updates, BYTES) {
                replaced += self.replace(table.name(), some).await?;
            }
        }
    }

    async fn replace(&self, table: &str, updates: Vec<Document>) -> Result<u64, StoreError> {
        let tables = self.tables();
        let command = doc! {
            "update": table, "updates": updates, "ordered": false,
            "writeConcern": { "w": "majority", "j": true },
        };
        let answer = limited(LONG, tables.database.run_command(command)).await?;
        match write_error(&answer) {
            Some(error) => Err(error),
            None => u64::try_from(rows::integer(&answer, "nModified")?).map_err(corrupt),
        }
    }
}

/// Updates in commands of a size, about.
pub(super) fn chunks(updates: Vec<Document>, most: usize) -> Vec<Vec<Document>> {
    let mut chunks = vec![Vec::new()];
    let mut bytes = 0;
    for update in updates {
        let size = text_bytes(&update);
        if bytes + size > most {
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

async fn read_head(
    plain: &Database,
    session: &mut ClientSession,
) -> Result<(BackupHead, Guard), StoreError> {
    let events = plain.collection::<Document>("events");
    let newest = events.find_one(doc! {}).sort(doc! { "_id": -1 }).projection(doc! { "last": 1 });
    let newest = limited(USUAL, newest.session(&mut *session)).await?;
    let floor = plain.collection::<Document>("documents");
    let floor =
        limited(USUAL, floor.find_one(doc! { "_id": FLOOR }).session(&mut *session)).await?;
    let store = plain.collection::<Document>("meta");
    let store =
        limited(USUAL, store.find_one(doc! { "_id": "store" }).session(&mut *session)).await?;
    let (Some(floor), Some(store)) = (floor, store) else {
        return Err(corrupt("the floor or the store's identity is missing"));
    };
    let guard = Guard::read(&floor)?;
    let newest = newest.map_or(Ok(0), |newest| rows::integer(&newest, "last"))?;
    let head = BackupHead {
        format: 1,
        store_id: rows::text(&store, "store_id")?,
        revision: u64::try_from(newest.max(guard.floor)).map_err(corrupt)?,
        floor: u64::try_from(guard.floor).map_err(corrupt)?,
        time: now().to_string(),
    };
    Ok((head, guard))
}

async fn next(
    cursor: &mut mongodb::SessionCursor<Document>,
    session: &mut ClientSession,
) -> Result<Option<Document>, StoreError> {
    limited(USUAL, async { cursor.next(session).await.transpose() }).await
}

async fn read_next(
    cursor: &mut mongodb::SessionCursor<Document>,
    session: &mut ClientSession,
) -> Result<Option<Record>, StoreError> {
    let found = next(cursor, session).await?;
    found.as_ref().map(rows::read_record).transpose()
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
            let table = store.tables().database.collection::<Document>(table);
            // No retry by ourselves: a restore that fails is done again, into a new database.
            limited(LONG, async { table.insert_many(rows).await.map(|_| ()) }).await?;
        }
        Ok(())
    }
}
