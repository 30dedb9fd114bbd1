//! Backup, restore and rewriting.

use rusqlite::{Connection, TransactionBehavior};
use tokio::sync::mpsc;

use super::connection::{head, number, set_number, store_id};
use super::errors::store_error;
use super::rows;
use crate::store::StoreError;
use crate::store::encode::{signed, unsigned};
use crate::store::upkeep::{
    BackupHead, BackupRow, Piece, RESTORE_RAISES_BY, Restored, Row, gone, not_empty, not_whole, now,
};

/// Reads everything in one snapshot. Blocks the thread.
pub(super) fn export(
    connection: &mut Connection,
    pieces: &mpsc::Sender<Piece>,
) -> Result<(), StoreError> {
    let transaction = connection.transaction().map_err(store_error)?;
    let send = |piece| pieces.blocking_send(piece).map_err(|_| gone());
    send(Piece::Head(BackupHead {
        format: 1,
        store_id: store_id(&transaction)?,
        revision: unsigned(head(&transaction)?)?,
        floor: unsigned(number(&transaction, "floor")?)?,
        time: now().to_string(),
    }))?;
    let each = |sql: &str, read: fn(&rusqlite::Row<'_>) -> rusqlite::Result<Row>| {
        let mut statement = transaction.prepare(sql).map_err(store_error)?;
        for row in statement.query_map([], read).map_err(store_error)? {
            send(Piece::Row(BackupRow(row.map_err(store_error)?)))?;
        }
        Ok::<_, StoreError>(())
    };
    each("SELECT key, revision, document FROM documents ORDER BY key", |row| {
        rows::document(row).map(Row::Document)
    })?;
    each(&format!("SELECT {} FROM versions ORDER BY revision, position", rows::VERSION), |row| {
        rows::version(row).map(Row::Version)
    })?;
    each(&format!("SELECT {} FROM audit ORDER BY id", rows::AUDIT), |row| {
        rows::audit(row).map(Box::new).map(Row::Audit)
    })?;
    each(&format!("SELECT {} FROM tokens ORDER BY id", rows::TOKEN), |row| {
        rows::token(row).map(Row::Token)
    })?;
    each(&format!("SELECT {} FROM idempotency ORDER BY id", rows::IDEMPOTENCY), |row| {
        rows::idempotency(row).map(Row::Idempotency)
    })?;
    send(Piece::End)
}

/// Writes everything in one transaction. Blocks the thread.
pub(super) fn import(
    connection: &mut Connection,
    mut pieces: mpsc::Receiver<Piece>,
) -> Result<Restored, StoreError> {
    let transaction = connection
        .transaction_with_behavior(TransactionBehavior::Immediate)
        .map_err(store_error)?;
    if !is_empty(&transaction)? {
        return Err(not_empty());
    }
    let Some(Piece::Head(head)) = pieces.blocking_recv() else {
        return Err(not_whole());
    };
    {
        let mut document = transaction.prepare(rows::PUT_DOCUMENT).map_err(store_error)?;
        let mut version = transaction.prepare(&rows::insert_version()).map_err(store_error)?;
        let mut audit = transaction.prepare(&rows::insert_audit()).map_err(store_error)?;
        let mut token = transaction.prepare(&rows::insert_token()).map_err(store_error)?;
        let mut idempotency = transaction.prepare(&rows::put_idempotency()).map_err(store_error)?;
        loop {
            let row = match pieces.blocking_recv() {
                Some(Piece::Row(BackupRow(row))) => row,
                Some(Piece::End) => break,
                Some(Piece::Head(_)) | None => return Err(not_whole()),
            };
            let done = match &row {
                Row::Document(row) => document.execute((&row.key, row.revision, &row.document)),
                Row::Version(row) => rows::bind_version(&mut version, row),
                Row::Audit(row) => rows::bind_audit(&mut audit, row),
                Row::Token(row) => rows::bind_token(&mut token, row),
                Row::Idempotency(row) => rows::bind_idempotency(&mut idempotency, row, i64::MAX),
            };
            done.map_err(store_error)?;
        }
    }
    let restored = Restored {
        store_id: uuid::Uuid::now_v7().to_string(),
        revision: head.revision + RESTORE_RAISES_BY,
    };
    set_number(&transaction, "floor", signed(restored.revision))?;
    transaction
        .execute("UPDATE meta SET value = ?1 WHERE name = 'store_id'", [&restored.store_id])
        .map_err(store_error)?;
    transaction.commit().map_err(store_error)?;
    Ok(restored)
}

fn is_empty(connection: &Connection) -> Result<bool, StoreError> {
    let rows: i64 = connection
        .query_row(
            "SELECT (SELECT count(*) FROM documents) + (SELECT count(*) FROM versions) + (SELECT \
             count(*) FROM tokens)",
            [],
            |row| row.get(0),
        )
        .map_err(store_error)?;
    Ok(rows == 0 && head(connection)? == 0)
}

/// What a rewriting goes through.
#[derive(Clone, Copy)]
pub(super) enum Texts {
    Documents,
    Versions,
}

/// A stored text with its place.
pub(super) struct Text {
    pub(super) rowid: i64,
    pub(super) key: String,
    pub(super) text: String,
}

impl Texts {
    fn table(self) -> &'static str {
        match self {
            Self::Documents => "documents",
            Self::Versions => "versions",
        }
    }

    /// The next texts behind a place.
    pub(super) fn after(
        self,
        connection: &Connection,
        rowid: i64,
        limit: i64,
    ) -> Result<Vec<Text>, StoreError> {
        let sql = format!(
            "SELECT rowid, key, document FROM {} WHERE rowid > ?1 ORDER BY rowid LIMIT ?2",
            self.table()
        );
        let mut statement = connection.prepare(&sql).map_err(store_error)?;
        let found = statement
            .query_map([rowid, limit], |row| {
                Ok(Text { rowid: row.get(0)?, key: row.get(1)?, text: row.get(2)? })
            })
            .map_err(store_error)?;
        found.collect::<Result<_, _>>().map_err(store_error)
    }

    /// Replaces texts (place, old, new) that are still what they were.
    pub(super) fn replace(
        self,
        connection: &mut Connection,
        texts: &[(i64, String, String)],
    ) -> Result<u64, StoreError> {
        let transaction = connection
            .transaction_with_behavior(TransactionBehavior::Immediate)
            .map_err(store_error)?;
        let mut replaced = 0;
        {
            let sql = format!(
                "UPDATE {} SET document = ?3 WHERE rowid = ?1 AND document = ?2",
                self.table()
            );
            let mut statement = transaction.prepare(&sql).map_err(store_error)?;
            for (rowid, old, new) in texts {
                replaced += statement.execute((rowid, old, new)).map_err(store_error)?;
            }
        }
        transaction.commit().map_err(store_error)?;
        Ok(u64::try_from(replaced).unwrap_or(u64::MAX))
    }
}
