//! Migrations, by one process at a time.
//!
//! ```text
//! lease {holder, until, fence} ── taken when free or run out: fence + 1, by the server's clock
//! step ─▶ renew, if the fence is still mine ─▶ do ─▶ transaction: fence is still mine, record the step
//! ```
//!
//! A process that was stopped within a step and wakes up after its lease ran out does that step
//! again, which changes nothing, and can record nothing any more.

use std::time::Duration;

use async_trait::async_trait;
use futures::FutureExt as _;
use mongodb::bson::{Document, doc};
use tokio::time::Instant;

use super::client::{LONG, USUAL, limited};
use super::errors::{NAMESPACE_EXISTS, command_code, is_duplicate, store_error};
use super::rows::{self, FLOOR};
use super::{MongoStore, collect};
use crate::store::StoreError;
use crate::store::encode::corrupt;
use crate::store::migrate::{Action, Done, Migrations, Plan, StoreKind, Target, apply, plan};
use crate::store::upkeep::now;

/// How long a lease lasts without being renewed, in milliseconds.
const LEASE_MS: i64 = 60_000;
/// How long to wait for another process that migrates.
const PATIENCE: Duration = Duration::from_secs(90);
/// Between two looks whether it is done.
const PAUSE: Duration = Duration::from_millis(200);

/// The right to migrate.
struct Lease<'a> {
    store: &'a MongoStore,
    fence: i64,
}

impl MongoStore {
    /// What opening the store would migrate.
    pub(super) async fn plan_of(&self, migrations: &Migrations) -> Result<Plan, StoreError> {
        plan(&Lease { store: self, fence: 0 }, migrations).await
    }

    /// Makes what is there before any migration, and does those that are to be done.
    pub(super) async fn migrate(&self, migrations: &Migrations) -> Result<(), StoreError> {
        self.create("meta").await?;
        self.create("migrations").await?;
        let identity = doc! { "store_id": uuid::Uuid::now_v7().to_string(), "min_version": 0_i64 };
        self.insert_if_absent("store", identity).await?;
        let free = doc! { "holder": "", "until": mongodb::bson::DateTime::MIN, "fence": 0_i64 };
        self.insert_if_absent("lease", free).await?;
        self.refuse_half_restored().await?;
        let until = Instant::now() + PATIENCE;
        // Nothing to do is the usual case, and needs no lease.
        while !self.plan_of(migrations).await?.pending.is_empty() {
            if let Some(fence) = self.take_lease().await? {
                let lease = Lease { store: self, fence };
                let done = apply(&lease, migrations).await;
                lease.give_back().await;
                done?;
            } else if Instant::now() > until {
                return Err(StoreError::Unavailable(
                    "another process is migrating the store".to_owned(),
                ));
            } else {
                tokio::time::sleep(PAUSE).await;
            }
        }
        self.insert_floor().await
    }

    async fn insert_floor(&self) -> Result<(), StoreError> {
        let tables = self.tables();
        let floor = doc! { "$setOnInsert": { FLOOR: 0_i64, "folded": 0_i64, "turn": 0_i64,
        "rewrites": 0_i64 } };
        let insert = tables.documents.update_one(doc! { "_id": FLOOR }, floor).upsert(true);
        limited(USUAL, insert).await?;
        Ok(())
    }

    async fn insert_if_absent(&self, id: &str, value: Document) -> Result<(), StoreError> {
        let tables = self.tables();
        let insert =
            tables.meta.update_one(doc! { "_id": id }, doc! { "$setOnInsert": value }).upsert(true);
        let insert = async {
            match insert.await {
                Err(error) if !is_duplicate(&error) => Err(error),
                Ok(_) | Err(_) => Ok(()),
            }
        };
        limited(USUAL, insert).await
    }

    async fn create(&self, collection: &str) -> Result<(), StoreError> {
        self.command(doc! { "create": collection }).await
    }

    /// A command that does nothing when it is done again.
    async fn command(&self, mut command: Document) -> Result<(), StoreError> {
        let tables = self.tables();
        command.insert("writeConcern", doc! { "w": "majority", "j": true });
        let run = async {
            match tables.database.run_command(command).await {
                Err(error) if command_code(&error) != Some(NAMESPACE_EXISTS) => Err(error),
                Ok(_) | Err(_) => Ok(()),
            }
        };
        limited(LONG, run).await
    }

    async fn take_lease(&self) -> Result<Option<i64>, StoreError> {
        let tables = self.tables();
        let run_out = doc! { "_id": "lease", "$expr": { "$lt": ["$until", "$$NOW"] } };
        let take = doc! { "$set": {
            "holder": &self.writer, "until": { "$add": ["$$NOW", LEASE_MS] },
            "fence": { "$add": ["$fence", 1_i64] },
        } };
        let take = tables.meta.find_one_and_update(run_out, vec![take]);
        let taken =
            limited(USUAL, take.return_document(mongodb::options::ReturnDocument::After)).await?;
        taken.map(|lease| rows::integer(&lease, "fence")).transpose()
    }

    /// A restore that was cut off has left a part of the documents.
    async fn refuse_half_restored(&self) -> Result<(), StoreError> {
        let tables = self.tables();
        let found = limited(USUAL, tables.meta.find_one(doc! { "_id": "store" })).await?;
        let half = found.is_some_and(|store| store.get_bool("restoring").unwrap_or(false));
        match half {
            false => Ok(()),
            true => Err(StoreError::Refused(format!(
                "a restore into the database {} was not finished: drop the database, and restore \
                 again",
                tables.database.name()
            ))),
        }
    }
}

impl Lease<'_> {
    fn mine(&self) -> Document {
        doc! { "_id": "lease", "fence": self.fence }
    }

    fn renewal() -> Vec<Document> {
        vec![doc! { "$set": { "until": { "$add": ["$$NOW", LEASE_MS] } } }]
    }

    async fn renew(&self) -> Result<(), StoreError> {
        let tables = self.store.tables();
        let renewed = limited(USUAL, tables.meta.update_one(self.mine(), Self::renewal())).await?;
        match renewed.matched_count {
            0 => Err(lost()),
            _ => Ok(()),
        }
    }

    async fn give_back(&self) {
        let tables = self.store.tables();
        let free = doc! { "$set": { "until": mongodb::bson::DateTime::MIN } };
        if let Err(error) = limited(USUAL, tables.meta.update_one(self.mine(), free)).await {
            tracing::debug!(%error, "the lease for migrations runs out by itself");
        }
    }

    async fn record(&self, done: &Done) -> Result<(), StoreError> {
        let record = doc! {
            "_id": format!("{:04}.{:04}", done.number, done.step), "number": i64::from(done.number),
            "step": i64::from(done.step), "name": &done.name, "checksum": &done.checksum,
            "time": now().as_millis(),
        };
        let mine = self.mine();
        let recorded = self.store.in_transaction(|tables, session| {
            let (mine, record) = (mine.clone(), record.clone());
            async move {
                let renewed =
                    tables.meta.update_one(mine, Self::renewal()).session(&mut *session).await?;
                if renewed.matched_count == 0 {
                    return Ok(false);
                }
                tables.migrations.insert_one(record).session(&mut *session).await?;
                Ok(true)
            }
            .boxed()
        });
        match recorded.await? {
            true => Ok(()),
            false => Err(lost()),
        }
    }
}

fn lost() -> StoreError {
    StoreError::Unavailable("another process has taken over the migration of the store".to_owned())
}

#[async_trait]
impl Target for Lease<'_> {
    fn kind(&self) -> StoreKind {
        StoreKind::MongoDb
    }

    async fn state(&self) -> Result<(Vec<Done>, u32), StoreError> {
        let tables = self.store.tables();
        let find = tables.migrations.find(doc! {}).sort(doc! { "_id": 1 });
        let done = collect(find, |found| {
            Ok(Done {
                number: small(found, "number")?,
                step: small(found, "step")?,
                name: rows::text(found, "name")?,
                checksum: rows::text(found, "checksum")?,
            })
        })
        .await?;
        let store = limited(USUAL, tables.meta.find_one(doc! { "_id": "store" })).await?;
        let min_version = store.map_or(Ok(0), |store| small(&store, "min_version"))?;
        Ok((done, min_version))
    }

    async fn perform(&self, action: &Action, done: &Done) -> Result<(), StoreError> {
        self.renew().await?;
        match action {
            Action::Command(text) => {
                let command: serde_json::Value = serde_json::from_str(text).map_err(corrupt)?;
                let command = mongodb::bson::serialize_to_document(&command);
                self.store.command(command.map_err(|error| store_error(error.into()))?).await?;
            }
            Action::Rewrite { function, .. } => {
                let renew = || self.renew().boxed();
                self.store.rewrite_all(function, &renew).await?;
            }
            Action::Sql(_) => {
                return Err(StoreError::Refused(format!(
                    "step {} is SQL, which MongoDB has none of",
                    done.name
                )));
            }
        }
        self.record(done).await
    }

    async fn raise_min_version(&self, version: u32) -> Result<(), StoreError> {
        let tables = self.store.tables();
        self.renew().await?;
        let raise = doc! { "$max": { "min_version": i64::from(version) } };
        limited(USUAL, tables.meta.update_one(doc! { "_id": "store" }, raise)).await?;
        Ok(())
    }
}

fn small(found: &Document, name: &str) -> Result<u32, StoreError> {
    u32::try_from(rows::integer(found, name)?).map_err(corrupt)
}
