//! Migrations of the file. Nobody else has it, so no lease is needed.

use async_trait::async_trait;
use rusqlite::{Connection, OptionalExtension as _, TransactionBehavior};

use super::SqliteStore;
use super::connection::{number, set_number};
use super::errors::store_error;
use crate::store::StoreError;
use crate::store::migrate::{Action, Done, Migrations, Plan, StoreKind, Target, plan};
use crate::store::upkeep::{Upkeep as _, now};

#[async_trait]
impl Target for SqliteStore {
    fn kind(&self) -> StoreKind {
        StoreKind::Sqlite
    }

    async fn state(&self) -> Result<(Vec<Done>, u32), StoreError> {
        self.write(|connection| state(connection)).await
    }

    async fn perform(&self, action: &Action, done: &Done) -> Result<(), StoreError> {
        let done = done.clone();
        match action {
            Action::Sql(text) => {
                let text = text.to_string();
                self.write(move |connection| {
                    let transaction = connection
                        .transaction_with_behavior(TransactionBehavior::Immediate)
                        .map_err(store_error)?;
                    transaction.execute_batch(&text).map_err(store_error)?;
                    record(&transaction, &done)?;
                    transaction.commit().map_err(store_error)
                })
                .await
            }
            Action::Rewrite { function, .. } => {
                self.rewrite(function).await?;
                self.write(move |connection| record(connection, &done)).await
            }
            Action::Command(_) => Err(StoreError::Refused(format!(
                "step {} is a command, which SQLite has none of",
                done.name
            ))),
        }
    }

    async fn raise_min_version(&self, version: u32) -> Result<(), StoreError> {
        self.write(move |connection| set_number(connection, "min_version", i64::from(version)))
            .await
    }
}

/// What was done; nothing in a file that is new.
fn state(connection: &Connection) -> Result<(Vec<Done>, u32), StoreError> {
    let there: Option<i64> = connection
        .query_row("SELECT 1 FROM sqlite_schema WHERE name = 'migrations'", [], |row| row.get(0))
        .optional()
        .map_err(store_error)?;
    if there.is_none() {
        return Ok((Vec::new(), 0));
    }
    let mut statement = connection
        .prepare("SELECT number, step, name, checksum FROM migrations ORDER BY number, step")
        .map_err(store_error)?;
    let found = statement
        .query_map([], |row| {
            Ok(Done {
                number: row.get(0)?,
                step: row.get(1)?,
                name: row.get(2)?,
                checksum: row.get(3)?,
            })
        })
        .map_err(store_error)?;
    let done = found.collect::<Result<_, _>>().map_err(store_error)?;
    let min_version = u32::try_from(number(connection, "min_version")?).unwrap_or(u32::MAX);
    Ok((done, min_version))
}

fn record(connection: &Connection, done: &Done) -> Result<(), StoreError> {
    connection
        .execute(
            "INSERT INTO migrations (number, step, name, checksum, time) VALUES (?1, ?2, ?3, ?4, \
             ?5)",
            (done.number, done.step, &done.name, &done.checksum, now().as_millis()),
        )
        .map_err(store_error)?;
    Ok(())
}

/// A file that is only looked at.
struct Looked(Vec<Done>, u32);

#[async_trait]
impl Target for Looked {
    fn kind(&self) -> StoreKind {
        StoreKind::Sqlite
    }

    async fn state(&self) -> Result<(Vec<Done>, u32), StoreError> {
        Ok((self.0.clone(), self.1))
    }

    async fn perform(&self, _action: &Action, _done: &Done) -> Result<(), StoreError> {
        Err(StoreError::Refused("the file is only looked at".to_owned()))
    }

    async fn raise_min_version(&self, _version: u32) -> Result<(), StoreError> {
        Err(StoreError::Refused("the file is only looked at".to_owned()))
    }
}

/// What a migration of the file behind this connection would do.
pub(super) async fn look(
    connection: Connection,
    migrations: &Migrations,
) -> Result<Plan, StoreError> {
    let (done, min_version) = state(&connection)?;
    drop(connection);
    plan(&Looked(done, min_version), migrations).await
}

/// What a migration of a file that is not there would do.
pub(super) async fn look_at_nothing(migrations: &Migrations) -> Result<Plan, StoreError> {
    plan(&Looked(Vec::new(), 0), migrations).await
}
