//! Where documents are kept: the port, and what is behind it.
//!
//! ```text
//! core ──[port]──▶ sqlite   a file, one process
//!             └──▶ mongo    a replica set, any number of processes (feature `mongodb`)
//! both: rows and encode (how it is stored), retain (what history keeps), migrate (schemas), backup (files), conformance (the rules for both)
//! ```
//!
//! One commit is one revision, and revisions have no holes. A commit with its history, audit and
//! answer to repeat is in the store or nothing of it is. Nobody gives revisions out: who inserts
//! revision n + 1 first has it.

pub mod backup;
pub(crate) mod encode;
pub mod migrate;
#[cfg(feature = "mongodb")]
pub mod mongo;
mod port;
pub(crate) mod retain;
pub(crate) mod rows;
#[cfg(test)]
#[path = "../../../conformance/src/store/samples.rs"]
pub(crate) mod samples;
pub mod sqlite;
pub mod upkeep;

use std::sync::Arc;

use blaze_domain::node_file::StoreSection;
use blaze_runtime::supervisor::Supervisor;
use tokio::sync::mpsc;

#[cfg(feature = "mongodb")]
pub use mongo::MongoStore;
pub use port::*;
pub use sqlite::SqliteStore;
pub use upkeep::{FullStore, Upkeep};

use migrate::{Migrations, Plan};
use upkeep::Piece;

/// About how much of the log one read takes into memory, in bytes.
pub(crate) const READ_BYTES: i64 = 8 * 1024 * 1024;
/// How long the audit is kept: 400 days, in milliseconds.
pub(crate) const AUDIT_KEPT_MS: i64 = 400 * 24 * 3_600 * 1_000;
/// How long a token is remembered after it has run out: clocks differ, and a revoked one must be
/// known as long as it is accepted (`blaze_auth::LEEWAY_S`, twice). MongoDB's index says the same.
pub(crate) const TOKEN_KEPT_MS: i64 = 60_000;

/// Opens the store that the node file names, and migrates it.
///
/// # Errors
/// [`StoreError::Refused`] says what to do; [`StoreError::Unavailable`] if it cannot be reached
/// now.
pub async fn open(
    section: &StoreSection,
    supervisor: &Supervisor,
) -> Result<Arc<dyn FullStore>, StoreError> {
    open_with(section, &Migrations::default(), supervisor).await
}

/// As [`open`], with migrations of one's own.
///
/// # Errors
/// As [`open`].
pub async fn open_with(
    section: &StoreSection,
    migrations: &Migrations,
    supervisor: &Supervisor,
) -> Result<Arc<dyn FullStore>, StoreError> {
    match section {
        StoreSection::Sqlite { path } => {
            Ok(Arc::new(SqliteStore::open_with(path, migrations, supervisor).await?))
        }
        #[cfg(feature = "mongodb")]
        StoreSection::MongoDb(section) => {
            use blaze_runtime::supervisor::TaskPolicy;

            let store = Arc::new(MongoStore::open_with(section, migrations).await?);
            if section.password_file.is_some() {
                let (store, stop) = (Arc::clone(&store), supervisor.shutdown_token());
                supervisor.spawn("password of MongoDB", TaskPolicy::Essential, async move {
                    tokio::select! {
                        () = store.follow_password() => {}
                        () = stop.cancelled() => {}
                    }
                });
            }
            Ok(store)
        }
        #[cfg(not(feature = "mongodb"))]
        StoreSection::MongoDb(_) => Err(without_mongodb()),
    }
}

/// A store in memory, for `--dev` and tests.
///
/// # Errors
/// [`StoreError::Unavailable`].
pub async fn in_memory(supervisor: &Supervisor) -> Result<Arc<dyn FullStore>, StoreError> {
    Ok(Arc::new(SqliteStore::in_memory(supervisor).await?))
}

/// What [`open`] would migrate; nothing is changed.
///
/// # Errors
/// As [`open`].
pub async fn plan(section: &StoreSection) -> Result<Plan, StoreError> {
    let migrations = Migrations::default();
    match section {
        StoreSection::Sqlite { path } => SqliteStore::plan(path, &migrations).await,
        #[cfg(feature = "mongodb")]
        StoreSection::MongoDb(section) => MongoStore::plan(section, &migrations).await,
        #[cfg(not(feature = "mongodb"))]
        StoreSection::MongoDb(_) => Err(without_mongodb()),
    }
}

/// Sends everything in a store that other processes may be using, as [`Upkeep::export`] does.
///
/// # Errors
/// [`StoreError::Refused`] if it is of another schema than this program's; [`StoreError`].
pub async fn export(
    section: &StoreSection,
    supervisor: &Supervisor,
    pieces: mpsc::Sender<Piece>,
) -> Result<(), StoreError> {
    match section {
        StoreSection::Sqlite { path } => SqliteStore::export_beside(path, supervisor, pieces).await,
        #[cfg(feature = "mongodb")]
        StoreSection::MongoDb(section) => MongoStore::export_beside(section, pieces).await,
        #[cfg(not(feature = "mongodb"))]
        StoreSection::MongoDb(_) => Err(without_mongodb()),
    }
}

#[cfg(not(feature = "mongodb"))]
fn without_mongodb() -> StoreError {
    StoreError::Refused(
        "this program was built without MongoDB: build it with the feature `mongodb`".to_owned(),
    )
}
