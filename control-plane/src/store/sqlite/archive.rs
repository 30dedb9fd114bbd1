//! What was, and what is written beside commits.

use blaze_domain::config::{Document, Key, Timestamp};
use rusqlite::{Connection, OptionalExtension as _, ToSql, TransactionBehavior, params_from_iter};

use super::connection::number;
use super::errors::store_error;
use super::rows;
use crate::store::encode::{corrupt, document, signed, unsigned};
use crate::store::rows::{AuditRow, IdempotencyRow, TokenRow};
use crate::store::{AuditEntry, AuditQuery, IdempotencyRecord, StoreError, TokenRecord, Version};

pub(super) fn versions(
    connection: &Connection,
    key: &Key,
    below: Option<u64>,
    limit: usize,
) -> Result<Vec<Version>, StoreError> {
    let sql = format!(
        "SELECT {} FROM versions WHERE key = ?1 AND revision < ?2 ORDER BY revision DESC LIMIT ?3",
        rows::VERSION
    );
    let mut statement = connection.prepare(&sql).map_err(store_error)?;
    let below = below.map_or(i64::MAX, signed);
    let found = statement
        .query_map((key.to_string(), below, limit_of(limit)), rows::version)
        .map_err(store_error)?;
    found.map(|row| row.map_err(store_error)?.into_version()).collect()
}

pub(super) fn documents_at(
    connection: &mut Connection,
    revision: u64,
    until: u64,
) -> Result<Vec<(Key, Option<Document>)>, StoreError> {
    // The first change after the revision says which version was there before it.
    const SQL: &str = "
        SELECT first.key, first.previous, before.document
        FROM (SELECT key, min(revision) AS revision FROM versions WHERE revision > ?1 AND revision <= ?2 GROUP BY key) AS changed
        JOIN versions AS first ON first.key = changed.key AND first.revision = changed.revision
        LEFT JOIN versions AS before ON before.key = first.key AND before.revision = first.previous";
    let transaction = connection.transaction().map_err(store_error)?;
    let floor = unsigned(number(&transaction, "floor")?)?;
    let mut statement = transaction.prepare(SQL).map_err(store_error)?;
    let found = statement
        .query_map([signed(revision), signed(until)], |row| {
            Ok((
                row.get::<_, String>(0)?,
                row.get::<_, Option<i64>>(1)?,
                row.get::<_, Option<String>>(2)?,
            ))
        })
        .map_err(store_error)?;
    let mut documents = Vec::new();
    for row in found {
        let (key, previous, text) = row.map_err(store_error)?;
        let key: Key = key.parse().map_err(|error| corrupt(format_args!("a version: {error}")))?;
        if previous.is_some() && text.is_none() && revision >= floor {
            return Err(corrupt(format_args!(
                "{key} of revision {previous:?} is missing from its history"
            )));
        }
        let before = text.map(|text| document(key.clone(), &text)).transpose()?;
        documents.push((key, before));
    }
    Ok(documents)
}

pub(super) fn revision_before(connection: &Connection, time: Timestamp) -> Result<u64, StoreError> {
    let found: Option<i64> = connection
        .query_row(
            "SELECT revision FROM events WHERE time < ?1 ORDER BY revision DESC LIMIT 1",
            [time.as_millis()],
            |row| row.get(0),
        )
        .optional()
        .map_err(store_error)?;
    unsigned(found.unwrap_or(0))
}

pub(super) fn append_audit(
    connection: &mut Connection,
    entries: &[AuditRow],
) -> Result<(), StoreError> {
    let transaction = connection
        .transaction_with_behavior(TransactionBehavior::Immediate)
        .map_err(store_error)?;
    insert_audit(&transaction, entries)?;
    transaction.commit().map_err(store_error)
}

fn insert_audit(connection: &Connection, entries: &[AuditRow]) -> Result<(), StoreError> {
    let mut statement = connection.prepare(&rows::insert_audit()).map_err(store_error)?;
    for entry in entries {
        rows::bind_audit(&mut statement, entry).map_err(store_error)?;
    }
    Ok(())
}

pub(super) fn audit(
    connection: &Connection,
    query: &AuditQuery,
) -> Result<Vec<AuditEntry>, StoreError> {
    let mut conditions = vec!["1"];
    let mut values: Vec<&dyn ToSql> = Vec::new();
    let (since, until) =
        (query.since.map(Timestamp::as_millis), query.until.map(Timestamp::as_millis));
    for (condition, value) in [
        ("subject = ?", query.subject.as_ref().map(|value| value as &dyn ToSql)),
        ("kind = ?", query.kind.as_ref().map(|value| value as &dyn ToSql)),
        ("name = ?", query.name.as_ref().map(|value| value as &dyn ToSql)),
        ("action = ?", query.action.as_ref().map(|value| value as &dyn ToSql)),
        ("allowed = ?", query.allowed.as_ref().map(|value| value as &dyn ToSql)),
        ("time >= ?", since.as_ref().map(|value| value as &dyn ToSql)),
        ("time < ?", until.as_ref().map(|value| value as &dyn ToSql)),
        ("id < ?", query.below.as_ref().map(|value| value as &dyn ToSql)),
    ] {
        if let Some(value) = value {
            conditions.push(condition);
            values.push(value);
        }
    }
    let limit = limit_of(query.limit);
    values.push(&limit);
    let sql = format!(
        "SELECT {} FROM audit WHERE {} ORDER BY id DESC LIMIT ?",
        rows::AUDIT,
        conditions.join(" AND ")
    );
    let mut statement = connection.prepare(&sql).map_err(store_error)?;
    let found = statement.query_map(params_from_iter(values), rows::audit).map_err(store_error)?;
    found.map(|row| row.map_err(store_error)?.decode()).collect()
}

pub(super) fn idempotency(
    connection: &Connection,
    id: &str,
    now: Timestamp,
) -> Result<Option<IdempotencyRecord>, StoreError> {
    let sql =
        format!("SELECT {} FROM idempotency WHERE id = ?1 AND expires > ?2", rows::IDEMPOTENCY);
    let found = connection
        .query_row(&sql, (id, now.as_millis()), rows::idempotency)
        .optional()
        .map_err(store_error)?;
    found.map(IdempotencyRow::decode).transpose()
}

pub(super) fn add_token(
    connection: &mut Connection,
    token: &TokenRow,
    audit: &AuditRow,
) -> Result<(), StoreError> {
    let transaction = connection
        .transaction_with_behavior(TransactionBehavior::Immediate)
        .map_err(store_error)?;
    {
        let mut statement = transaction.prepare(&rows::insert_token()).map_err(store_error)?;
        rows::bind_token(&mut statement, token).map_err(store_error)?;
    }
    insert_audit(&transaction, std::slice::from_ref(audit))?;
    transaction.commit().map_err(store_error)
}

pub(super) fn revoke_token(
    connection: &mut Connection,
    id: &str,
    time: Timestamp,
    audit: &AuditRow,
) -> Result<bool, StoreError> {
    let transaction = connection
        .transaction_with_behavior(TransactionBehavior::Immediate)
        .map_err(store_error)?;
    let found = transaction
        .execute(
            "UPDATE tokens SET revoke_time = coalesce(revoke_time, ?2) WHERE id = ?1",
            (id, time.as_millis()),
        )
        .map_err(store_error)?;
    if found == 0 {
        return Ok(false);
    }
    insert_audit(&transaction, std::slice::from_ref(audit))?;
    transaction.commit().map_err(store_error)?;
    Ok(true)
}

pub(super) fn tokens(
    connection: &Connection,
    now: Timestamp,
) -> Result<Vec<TokenRecord>, StoreError> {
    let sql = format!(
        "SELECT {} FROM tokens WHERE expire_time > ?1 ORDER BY create_time DESC, id DESC",
        rows::TOKEN
    );
    let mut statement = connection.prepare(&sql).map_err(store_error)?;
    let found = statement.query_map([now.as_millis()], rows::token).map_err(store_error)?;
    found.map(|row| row.map_err(store_error)?.decode()).collect()
}

fn limit_of(limit: usize) -> i64 {
    i64::try_from(limit).unwrap_or(i64::MAX)
}
