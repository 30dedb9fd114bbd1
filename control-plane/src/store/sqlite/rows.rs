//! Rows of the tables, read and written.

use rusqlite::{Row, Statement, params};

use crate::store::rows::{AuditRow, DocumentRow, EventRow, IdempotencyRow, TokenRow, VersionRow};

type Result<T> = rusqlite::Result<T>;

pub(super) const EVENT: &str = "revision, batch, time, subject, request_id, changes, bytes";
pub(super) const VERSION: &str =
    "key, revision, position, op, previous, time, subject, request_id, paths, document";
pub(super) const AUDIT: &str = "id, time, revision, subject, roles, action, kind, service, name, \
                                allowed, code, \
                                paths, request_id, address, detail";
pub(super) const IDEMPOTENCY: &str = "id, body, expires, revision, answer";
pub(super) const TOKEN: &str = "id, subject, roles, layer, create_time, expire_time, revoke_time";

pub(super) fn insert_event() -> String {
    format!("INSERT INTO events ({EVENT}) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)")
}

pub(super) fn insert_version() -> String {
    format!("INSERT INTO versions ({VERSION}) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10)")
}

pub(super) const PUT_DOCUMENT: &str =
    "INSERT INTO documents (key, revision, document) VALUES (?1, ?2, ?3)
     ON CONFLICT (key) DO UPDATE SET revision = excluded.revision, document = excluded.document";

/// Twice the same id is once the entry: who did not hear that it was written tries again.
pub(super) fn insert_audit() -> String {
    format!(
        "INSERT INTO audit ({AUDIT}) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11, ?12, ?13, ?14, ?15)
         ON CONFLICT (id) DO NOTHING"
    )
}

/// `?6` is now: a record that has expired gives way.
pub(super) fn put_idempotency() -> String {
    format!(
        "INSERT INTO idempotency ({IDEMPOTENCY}) VALUES (?1, ?2, ?3, ?4, ?5)
         ON CONFLICT (id) DO UPDATE SET body = excluded.body, expires = excluded.expires,
           revision = excluded.revision, answer = excluded.answer WHERE idempotency.expires <= ?6"
    )
}

pub(super) fn insert_token() -> String {
    format!("INSERT INTO tokens ({TOKEN}) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)")
}

pub(super) fn bind_event(statement: &mut Statement<'_>, row: &EventRow) -> Result<usize> {
    statement.execute(params![
        row.revision,
        row.batch,
        row.time,
        row.subject,
        row.request_id,
        row.changes,
        row.bytes
    ])
}

pub(super) fn event(row: &Row<'_>) -> Result<EventRow> {
    Ok(EventRow {
        revision: row.get(0)?,
        batch: row.get(1)?,
        time: row.get(2)?,
        subject: row.get(3)?,
        request_id: row.get(4)?,
        changes: row.get(5)?,
        bytes: row.get(6)?,
    })
}

pub(super) fn bind_version(statement: &mut Statement<'_>, row: &VersionRow) -> Result<usize> {
    statement.execute(params![
        row.key,
        row.revision,
        row.position,
        row.op,
        row.previous,
        row.time,
        row.subject,
        row.request_id,
        row.paths,
        row.document
    ])
}

pub(super) fn version(row: &Row<'_>) -> Result<VersionRow> {
    Ok(VersionRow {
        key: row.get(0)?,
        revision: row.get(1)?,
        position: row.get(2)?,
        op: row.get(3)?,
        previous: row.get(4)?,
        time: row.get(5)?,
        subject: row.get(6)?,
        request_id: row.get(7)?,
        paths: row.get(8)?,
        document: row.get(9)?,
    })
}

pub(super) fn document(row: &Row<'_>) -> Result<DocumentRow> {
    Ok(DocumentRow { key: row.get(0)?, revision: row.get(1)?, document: row.get(2)? })
}

pub(super) fn bind_audit(statement: &mut Statement<'_>, row: &AuditRow) -> Result<usize> {
    statement.execute(params![
        row.id,
        row.time,
        row.revision,
        row.subject,
        row.roles,
        row.action,
        row.kind,
        row.service,
        row.name,
        row.allowed,
        row.code,
        row.paths,
        row.request_id,
        row.address,
        row.detail
    ])
}

pub(super) fn audit(row: &Row<'_>) -> Result<AuditRow> {
    Ok(AuditRow {
        id: row.get(0)?,
        time: row.get(1)?,
        revision: row.get(2)?,
        subject: row.get(3)?,
        roles: row.get(4)?,
        action: row.get(5)?,
        kind: row.get(6)?,
        service: row.get(7)?,
        name: row.get(8)?,
        allowed: row.get(9)?,
        code: row.get(10)?,
        paths: row.get(11)?,
        request_id: row.get(12)?,
        address: row.get(13)?,
        detail: row.get(14)?,
    })
}

/// Changes nothing if there is a record that has not expired at `now`.
pub(super) fn bind_idempotency(
    statement: &mut Statement<'_>,
    row: &IdempotencyRow,
    now: i64,
) -> Result<usize> {
    statement.execute(params![row.id, row.body, row.expires, row.revision, row.answer, now])
}

pub(super) fn idempotency(row: &Row<'_>) -> Result<IdempotencyRow> {
    Ok(IdempotencyRow {
        id: row.get(0)?,
        body: row.get(1)?,
        expires: row.get(2)?,
        revision: row.get(3)?,
        answer: row.get(4)?,
    })
}

pub(super) fn bind_token(statement: &mut Statement<'_>, row: &TokenRow) -> Result<usize> {
    statement.execute(params![
        row.id,
        row.subject,
        row.roles,
        row.layer,
        row.create_time,
        row.expire_time,
        row.revoke_time
    ])
}

pub(super) fn token(row: &Row<'_>) -> Result<TokenRow> {
    Ok(TokenRow {
        id: row.get(0)?,
        subject: row.get(1)?,
        roles: row.get(2)?,
        layer: row.get(3)?,
        create_time: row.get(4)?,
        expire_time: row.get(5)?,
        revoke_time: row.get(6)?,
    })
}
