//! Removing what nobody needs any more, in steps small enough for commits to go on between them.

use std::time::Duration;

use rusqlite::{Connection, OptionalExtension as _, TransactionBehavior};

use super::connection::{head, number, set_number};
use super::errors::store_error;
use crate::store::encode::signed;
use crate::store::retain::{self, Trimmed, to_spare};
use crate::store::{AUDIT_KEPT_MS, StoreError, TOKEN_KEPT_MS};

/// Rows that one step removes.
const ROWS: i64 = 1_000;

/// The time by which records expire, among the numbers of `meta`.
const EXPIRY: &str = "expiry_time";

/// The floor as it now is, and which documents may have versions to spare.
pub(super) struct Work {
    pub(super) now: Trimmed,
    pub(super) keys: Vec<String>,
}

/// Raises the floor. Readers see that before anything goes.
pub(super) fn raise_floor(
    connection: &mut Connection,
    floor: u64,
    keep: u32,
) -> Result<Work, StoreError> {
    let transaction = connection
        .transaction_with_behavior(TransactionBehavior::Immediate)
        .map_err(store_error)?;
    let head = head(&transaction)?;
    let floor = signed(floor).min(head).max(number(&transaction, "floor")?);
    set_number(&transaction, "floor", floor)?;
    let before = trimmed(&transaction)?;
    let now = Trimmed { floor, head, keep };
    let mut keys = Vec::new();
    for range in before.ranges_until(now) {
        let mut statement = transaction
            .prepare("SELECT DISTINCT key FROM versions WHERE revision > ?1 AND revision <= ?2")
            .map_err(store_error)?;
        for key in statement.query_map(range, |row| row.get(0)).map_err(store_error)? {
            keys.push(key.map_err(store_error)?);
        }
    }
    transaction.commit().map_err(store_error)?;
    keys.sort_unstable();
    keys.dedup();
    Ok(Work { now, keys })
}

/// Removes some commits up to the floor; `false` when there are no more.
pub(super) fn remove_events(connection: &Connection, floor: i64) -> Result<bool, StoreError> {
    let removed = connection
        .execute(
            "DELETE FROM events WHERE revision IN (SELECT revision FROM events WHERE revision <= \
             ?1 ORDER BY revision LIMIT ?2)",
            [floor, ROWS],
        )
        .map_err(store_error)?;
    Ok(removed > 0)
}

/// Removes what these documents have to spare.
pub(super) fn remove_versions(
    connection: &mut Connection,
    now: Trimmed,
    keys: &[String],
) -> Result<(), StoreError> {
    let transaction = connection
        .transaction_with_behavior(TransactionBehavior::Immediate)
        .map_err(store_error)?;
    {
        let mut find = transaction
            .prepare("SELECT revision FROM versions WHERE key = ?1 ORDER BY revision DESC")
            .map_err(store_error)?;
        let mut remove = transaction
            .prepare("DELETE FROM versions WHERE key = ?1 AND revision = ?2")
            .map_err(store_error)?;
        for key in keys {
            let found = find.query_map([key], |row| row.get(0)).map_err(store_error)?;
            let revisions: Vec<i64> = found.collect::<Result<_, _>>().map_err(store_error)?;
            for revision in to_spare(&revisions, now.floor, now.keep) {
                remove.execute((key, revision)).map_err(store_error)?;
            }
        }
    }
    transaction.commit().map_err(store_error)
}

/// Moves on the time by which records expire.
pub(super) fn move_expiry(
    connection: &Connection,
    clock: i64,
    most: Duration,
) -> Result<i64, StoreError> {
    let before = match number(connection, EXPIRY)? {
        0 => newest(connection)?,
        before => Some(before),
    };
    let time = retain::expiry_time(clock, before, most);
    set_number(connection, EXPIRY, time)?;
    Ok(time)
}

/// The time by which records expire; that of the clock where it was never moved on.
pub(super) fn expiry(connection: &Connection, clock: i64) -> Result<i64, StoreError> {
    match number(connection, EXPIRY)? {
        0 => Ok(clock),
        time => Ok(time),
    }
}

/// Time of the newest commit.
fn newest(connection: &Connection) -> Result<Option<i64>, StoreError> {
    connection
        .query_row("SELECT time FROM events ORDER BY revision DESC LIMIT 1", [], |row| row.get(0))
        .optional()
        .map_err(store_error)
}

/// Removes some of what has expired; `false` when there is no more.
pub(super) fn remove_expired(connection: &Connection, now: i64) -> Result<bool, StoreError> {
    let mut removed = 0;
    for (table, column, limit) in [
        ("idempotency", "expires", now),
        ("tokens", "expire_time", now.saturating_sub(TOKEN_KEPT_MS)),
        ("audit", "time", now.saturating_sub(AUDIT_KEPT_MS)),
    ] {
        let sql = format!(
            "DELETE FROM {table} WHERE id IN (SELECT id FROM {table} WHERE {column} <= ?1 ORDER BY \
             {column} LIMIT ?2)"
        );
        removed += connection.execute(&sql, [limit, ROWS]).map_err(store_error)?;
    }
    Ok(removed > 0)
}

/// Notes how far it came.
pub(super) fn note(connection: &Connection, now: Trimmed) -> Result<(), StoreError> {
    let text = format!("{} {} {}", now.floor, now.head, now.keep);
    connection
        .execute(
            "INSERT INTO meta (name, value) VALUES ('trimmed', ?1) ON CONFLICT (name) DO UPDATE \
             SET value = excluded.value",
            [text],
        )
        .map_err(store_error)?;
    Ok(())
}

fn trimmed(connection: &Connection) -> Result<Trimmed, StoreError> {
    let text: Option<String> = connection
        .query_row("SELECT value FROM meta WHERE name = 'trimmed'", [], |row| row.get(0))
        .optional()
        .map_err(store_error)?;
    Ok(text.as_deref().and_then(parse).unwrap_or_default())
}

/// What cannot be read means that everything is looked at again.
fn parse(text: &str) -> Option<Trimmed> {
    let mut words = text.split(' ');
    Some(Trimmed {
        floor: words.next()?.parse().ok()?,
        head: words.next()?.parse().ok()?,
        keep: words.next()?.parse().ok()?,
    })
}
