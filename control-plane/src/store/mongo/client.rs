//! The connection to the replica set.

use std::future::IntoFuture;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use arc_swap::ArcSwap;
use blaze_domain::node_file::{MongoSection, SecretText};
use blaze_runtime::read_password;
use mongodb::bson::{Document, doc};
use mongodb::options::{
    ClientOptions, ConnectionString, DatabaseOptions, ReadConcern, ReadPreference,
    SelectionCriteria, WriteConcern,
};
use mongodb::{Client, Collection, Database};

use super::errors::store_error;
use crate::store::StoreError;

/// Most connections to one server. The committer has one, reads share one query, follow and upkeep
/// have theirs.
const CONNECTIONS: u32 = 32;
/// Until a server is found, where the URI says nothing else: a lost store shows within two seconds.
const SELECTION: Duration = Duration::from_millis(1_500);
/// Until a connection stands, where the URI says nothing else.
const CONNECT: Duration = Duration::from_secs(2);
/// Between two looks at each server, where the URI says nothing else.
const HEARTBEAT: Duration = Duration::from_secs(1);

/// A read that many wait for.
pub(super) const QUICK: Duration = Duration::from_secs(2);
/// Any other read or write.
pub(super) const USUAL: Duration = Duration::from_secs(10);
/// Reading everything.
pub(super) const LONG: Duration = Duration::from_secs(120);

/// What is wrong with the URI, as far as that is seen without the server.
///
/// # Errors
/// For people; it names the part that is wrong and not the whole, for it may hold a password.
pub fn check_uri(section: &MongoSection) -> Result<(), String> {
    let parsed = ConnectionString::parse(section.uri.reveal());
    parsed.map(drop).map_err(|error| error.kind.to_string())
}

/// Where the store is, and its collections as they are reached now.
pub(super) struct Connection {
    section: MongoSection,
    tables: ArcSwap<Tables>,
}

impl Connection {
    /// # Errors
    /// As [`Tables::connect`]; with a password file that cannot be read, [`StoreError::Unavailable`]:
    /// it may just be written.
    pub(super) async fn open(section: &MongoSection) -> Result<Self, StoreError> {
        let password = read(section.password_file.as_deref()).await?;
        let tables = Tables::connect(section, password).await?;
        Ok(Self { section: section.clone(), tables: ArcSwap::from_pointee(tables) })
    }

    pub(super) fn tables(&self) -> Arc<Tables> {
        self.tables.load_full()
    }

    /// The collections as they are reached with the password that the file holds now, if that is
    /// another one.
    ///
    /// # Errors
    /// As [`Connection::open`].
    pub(super) async fn connect_anew(&self) -> Result<Option<Tables>, StoreError> {
        let password = read(self.section.password_file.as_deref()).await?;
        if password == self.tables.load().password {
            return Ok(None);
        }
        Tables::connect(&self.section, password).await.map(Some)
    }

    pub(super) fn replace(&self, tables: Tables) {
        self.tables.store(Arc::new(tables));
    }
}

async fn read(file: Option<&Path>) -> Result<Option<SecretText>, StoreError> {
    let Some(file) = file.map(Path::to_owned) else {
        return Ok(None);
    };
    let read = tokio::task::spawn_blocking(move || read_password(&file)).await;
    // The blocking task ends early only when the runtime goes away.
    let password = read.unwrap_or_else(|error| Err(error.to_string()));
    password.map(|password| Some(password.into())).map_err(StoreError::Unavailable)
}

/// The collections of a store. All of them read what no crash can take back, and write so that no
/// crash can.
#[derive(Clone)]
pub(super) struct Tables {
    pub(super) client: Client,
    /// What it logs in with, if that is not in the URI.
    password: Option<SecretText>,
    pub(super) database: Database,
    /// Store identity, lease, notes.
    pub(super) meta: Collection<Document>,
    /// Which steps of migrations are done.
    pub(super) migrations: Collection<Document>,
    /// The log: one record per commit.
    pub(super) events: Collection<Document>,
    /// One record per change.
    pub(super) versions: Collection<Document>,
    /// What is now, and the floor.
    pub(super) documents: Collection<Document>,
    pub(super) audit: Collection<Document>,
    pub(super) idempotency: Collection<Document>,
    pub(super) tokens: Collection<Document>,
    /// By which our transactions are known among those on the server.
    pub(super) app_name: String,
    /// Only one member of the replica set can be its primary, as far as was known when it was
    /// connected to.
    pub(super) is_single: bool,
}

impl Tables {
    /// Connects, and makes sure that it is a replica set.
    ///
    /// # Errors
    /// [`StoreError::Refused`] for a wrong URI, name or password, and a server that is alone;
    /// [`StoreError::Unavailable`] if none answers.
    async fn connect(
        section: &MongoSection,
        password: Option<SecretText>,
    ) -> Result<Self, StoreError> {
        let name = &section.database;
        let app_name = format!("blaze-config/{name}");
        let uri = section.uri_with(password.as_ref());
        let mut options = ClientOptions::parse(uri.reveal()).await.map_err(store_error)?;
        options.app_name = Some(app_name.clone());
        options.server_selection_timeout.get_or_insert(SELECTION);
        options.connect_timeout.get_or_insert(CONNECT);
        options.heartbeat_freq.get_or_insert(HEARTBEAT);
        options.max_pool_size.get_or_insert(CONNECTIONS);
        // What a URI says of consistency would break promises of ours.
        options.read_concern = None;
        options.write_concern = None;
        options.selection_criteria = None;
        let client = Client::with_options(options).map_err(store_error)?;
        let database = client.database_with_options(name, database_options());
        let mut tables = Self {
            meta: database.collection("meta"),
            migrations: database.collection("migrations"),
            events: database.collection("events"),
            versions: database.collection("versions"),
            documents: database.collection("documents"),
            audit: database.collection("audit"),
            idempotency: database.collection("idempotency"),
            tokens: database.collection("tokens"),
            client,
            password,
            database,
            app_name,
            is_single: false,
        };
        let hello = limited(USUAL, tables.admin().run_command(doc! { "hello": 1 })).await?;
        if hello.get_str("msg").is_ok_and(|what| what == "isdbgrid") {
            return Err(StoreError::Refused(
                "this MongoDB is the router of a sharded cluster: name the members of a replica \
                 set of its own"
                    .to_owned(),
            ));
        }
        if hello.get_str("setName").is_err() {
            return Err(StoreError::Refused(
                "this MongoDB is no replica set, and has no transactions: start mongod with \
                 `--replSet rs0`, run \
                 `rs.initiate()` once (one member is enough)"
                    .to_owned(),
            ));
        }
        tables.is_single = hello.get_array("hosts").is_ok_and(|hosts| hosts.len() == 1);
        Ok(tables)
    }

    /// For commands that belong to no database.
    pub(super) fn admin(&self) -> Database {
        self.client.database("admin")
    }
}

/// Every read is answered by the primary, from what a majority of the members has: whoever was told
/// of a commit before the read began is told of it again. One case is open: a primary that was cut
/// off from the others and does not know it yet (at most 10 s, until its lease as primary ends) may
/// answer with what was true when it was cut off. It cannot acknowledge commits. `linearizable`
/// reads would close this for 100 ms each, which is why they are not used.
fn database_options() -> DatabaseOptions {
    let mut durable = WriteConcern::majority();
    durable.journal = Some(true);
    DatabaseOptions::builder()
        .read_concern(ReadConcern::majority())
        .write_concern(durable)
        .selection_criteria(SelectionCriteria::ReadPreference(ReadPreference::Primary))
        .build()
}

/// Waits for the driver, which has no limit of its own once a request is sent.
///
/// # Errors
/// [`StoreError::Unavailable`] at the limit, else what the driver says.
pub(super) async fn limited<T>(
    limit: Duration,
    work: impl IntoFuture<Output = mongodb::error::Result<T>>,
) -> Result<T, StoreError> {
    match tokio::time::timeout(limit, work.into_future()).await {
        Ok(done) => done.map_err(store_error),
        Err(_) => Err(too_slow(limit)),
    }
}

/// As [`limited`], for work of several steps.
///
/// # Errors
/// As [`limited`].
pub(super) async fn limited_steps<T>(
    limit: Duration,
    work: impl Future<Output = Result<T, StoreError>>,
) -> Result<T, StoreError> {
    tokio::time::timeout(limit, work).await.unwrap_or_else(|_| Err(too_slow(limit)))
}

fn too_slow(limit: Duration) -> StoreError {
    StoreError::Unavailable(format!("MongoDB: no answer within {} ms", limit.as_millis()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_uri_that_is_none_is_refused() {
        for uri in ["mongodb://", "http://127.0.0.1", "mongodb://h/?w=x&nonsense"] {
            let section = MongoSection::of(uri, "x");
            let found = Tables::connect(&section, None).await.err();
            assert!(found.is_some(), "{uri}");
        }
    }
}
