//! Writing commits, and reading the log.

use rusqlite::{Connection, ErrorCode, OptionalExtension as _, Transaction, TransactionBehavior};

use super::connection::{head, number, store_id};
use super::errors::{not_written, store_error};
use super::rows;
use crate::store::encode::{EncodedCommit, decode_commits, last_versions, signed, unsigned};
use crate::store::rows::EventRow;
use crate::store::{CommitBatch, CommitError, READ_BYTES, Snapshot, StoreError};

/// Writes a group in one transaction, synced to the disk before it returns.
pub(super) fn commit(
    connection: &mut Connection,
    group: &[EncodedCommit],
) -> Result<(), CommitError> {
    let Some(first) = group.first().map(|commit| &commit.event) else {
        return Ok(());
    };
    let transaction = connection
        .transaction_with_behavior(TransactionBehavior::Immediate)
        .map_err(not_written)?;
    if head(&transaction).map_err(CommitError::NotWritten)? + 1 != first.revision {
        return Err(CommitError::Conflict);
    }
    // Dropped on an error, the transaction is rolled back.
    insert(&transaction, group)?;
    match transaction.commit() {
        Ok(()) => Ok(()),
        // The log may hold the whole transaction although it was not acknowledged, and recovery
        // after a crash would take it for true.
        Err(error) if error.sqlite_error_code() == Some(ErrorCode::SystemIoFailure) => {
            settle(connection, first, error)
        }
        Err(error) => Err(not_written(error)),
    }
}

fn insert(transaction: &Transaction<'_>, group: &[EncodedCommit]) -> Result<(), CommitError> {
    let mut event = transaction.prepare_cached(&rows::insert_event()).map_err(not_written)?;
    let mut version = transaction.prepare_cached(&rows::insert_version()).map_err(not_written)?;
    let mut audit = transaction.prepare_cached(&rows::insert_audit()).map_err(not_written)?;
    for commit in group {
        rows::bind_event(&mut event, &commit.event).map_err(not_written)?;
        for row in &commit.versions {
            rows::bind_version(&mut version, row).map_err(not_written)?;
        }
        for row in &commit.audit {
            rows::bind_audit(&mut audit, row).map_err(not_written)?;
        }
        if let Some(row) = &commit.idempotency {
            let mut put =
                transaction.prepare_cached(&rows::put_idempotency()).map_err(not_written)?;
            if rows::bind_idempotency(&mut put, row, commit.event.time).map_err(not_written)? == 0 {
                return Err(CommitError::Conflict);
            }
        }
    }
    let mut put = transaction.prepare_cached(rows::PUT_DOCUMENT).map_err(not_written)?;
    let mut delete =
        transaction.prepare_cached("DELETE FROM documents WHERE key = ?1").map_err(not_written)?;
    for (key, row) in last_versions(group.iter().flat_map(|commit| &commit.versions)) {
        let done = match row.is_deletion() {
            true => delete.execute([key]),
            false => put.execute((key, row.revision, &row.document)),
        };
        done.map_err(not_written)?;
    }
    Ok(())
}

/// Finds out what became of a transaction whose end failed. A further transaction that succeeds
/// stands in the log where the failed one did, or behind it: then what can be read is what is true.
fn settle(
    connection: &mut Connection,
    first: &EventRow,
    error: rusqlite::Error,
) -> Result<(), CommitError> {
    match batch_for_certain(connection, first.revision) {
        Ok(Some(batch)) if batch == first.batch => Ok(()),
        Ok(Some(_)) => Err(CommitError::Conflict),
        Ok(None) => Err(CommitError::NotWritten(store_error(error))),
        Err(_) => Err(CommitError::Unknown(store_error(error))),
    }
}

fn batch_for_certain(
    connection: &mut Connection,
    revision: i64,
) -> rusqlite::Result<Option<String>> {
    let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
    transaction.execute("UPDATE meta SET value = value + 1 WHERE name = 'settled'", [])?;
    let batch = transaction
        .query_row("SELECT batch FROM events WHERE revision = ?1", [revision], |row| row.get(0))
        .optional()?;
    transaction.commit()?;
    Ok(batch)
}

/// Everything at one revision.
pub(super) fn load(connection: &mut Connection) -> Result<Snapshot, StoreError> {
    let transaction = connection.transaction().map_err(store_error)?;
    let mut statement = transaction
        .prepare("SELECT key, revision, document FROM documents")
        .map_err(store_error)?;
    let mut documents = Vec::new();
    for row in statement.query_map([], rows::document).map_err(store_error)? {
        documents.push(row.map_err(store_error)?.into_document()?);
    }
    Ok(Snapshot {
        store_id: store_id(&transaction)?,
        floor: unsigned(number(&transaction, "floor")?)?,
        revision: unsigned(head(&transaction)?)?,
        documents,
    })
}

/// Commits after a revision, and the floor.
pub(super) fn commits_after(
    connection: &mut Connection,
    revision: u64,
    limit: usize,
) -> Result<CommitBatch, StoreError> {
    // One snapshot, so that the floor is as old as the commits.
    let transaction = connection.transaction().map_err(store_error)?;
    let floor = unsigned(number(&transaction, "floor")?)?;
    if floor > revision {
        return Ok(CommitBatch { commits: Vec::new(), floor });
    }
    let events = events(&transaction, signed(revision), limit)?;
    let last = events.last().map_or(signed(revision), |event| event.revision);
    let sql = format!(
        "SELECT {} FROM versions WHERE revision > ?1 AND revision <= ?2 ORDER BY revision, \
         position",
        rows::VERSION
    );
    let mut statement = transaction.prepare(&sql).map_err(store_error)?;
    let found =
        statement.query_map([signed(revision), last], rows::version).map_err(store_error)?;
    let versions = found.collect::<Result<_, _>>().map_err(store_error)?;
    Ok(CommitBatch { commits: decode_commits(revision, events, versions)?, floor })
}

/// As many as `limit` and [`READ_BYTES`] allow, at least one.
fn events(
    transaction: &Transaction<'_>,
    after: i64,
    limit: usize,
) -> Result<Vec<EventRow>, StoreError> {
    let sql = format!(
        "SELECT {} FROM events WHERE revision > ?1 ORDER BY revision LIMIT ?2",
        rows::EVENT
    );
    let mut statement = transaction.prepare(&sql).map_err(store_error)?;
    let limit = i64::try_from(limit.max(1)).unwrap_or(i64::MAX);
    let mut events = Vec::new();
    let mut bytes = 0;
    for row in statement.query_map([after, limit], rows::event).map_err(store_error)? {
        let row = row.map_err(store_error)?;
        bytes += row.bytes;
        if bytes > READ_BYTES && !events.is_empty() {
            break;
        }
        events.push(row);
    }
    Ok(events)
}
