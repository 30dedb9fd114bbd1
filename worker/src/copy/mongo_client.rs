//! The connection to MongoDB: made at the first use, and limited in everything.

use std::future::IntoFuture;
use std::time::Duration;

use blaze_domain::node_file::SecretText;
use mongodb::bson::Document;
use mongodb::error::{Error, ErrorKind, WriteFailure};
use mongodb::options::{
    ClientOptions, DatabaseOptions, ReadPreference, SelectionCriteria, WriteConcern,
};
use mongodb::{Client, Collection};
use tokio::sync::Mutex;

use super::CopyError;

/// Until a server is found, and until a connection stands.
const SELECTION: Duration = Duration::from_secs(2);
/// Each operation.
const OPERATION: Duration = Duration::from_secs(5);
/// Most connections: one who writes, one who reads.
const CONNECTIONS: u32 = 4;
/// Longest name of a database.
const NAME_BYTES: usize = 63;
const DUPLICATE_KEY: i32 = 11_000;
/// No right, wrong password, no such command: waiting does not help.
const NEVER: [i32; 3] = [13, 18, 59];

/// Where the copy is.
pub(crate) struct Server {
    uri: SecretText,
    database: String,
    app_name: String,
    place: String,
    tables: Mutex<Option<Tables>>,
}

/// Its collections. Writes count once a majority has them on disk; a server that is alone is its
/// own majority.
#[derive(Clone)]
pub(crate) struct Tables {
    pub(crate) head: Collection<Document>,
    pub(crate) chunks: Collection<Document>,
    pub(crate) leases: Collection<Document>,
}

impl Server {
    /// `place` is what errors call it.
    ///
    /// # Errors
    /// [`CopyError::Refused`] for a name that no database can have.
    pub(crate) fn new(
        uri: SecretText,
        database: &str,
        copy: &str,
        place: &str,
    ) -> Result<Self, CopyError> {
        let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-');
        if database.is_empty() || database.len() > NAME_BYTES || !database.chars().all(allowed) {
            return Err(CopyError::Refused {
                place: "MongoDB".to_owned(),
                detail: format!(
                    "{database:?} is no name of a database: 1 to {NAME_BYTES} of A-Z, a-z, 0-9, _ \
                     and -"
                ),
            });
        }
        Ok(Self {
            uri,
            database: database.to_owned(),
            app_name: format!("blaze-worker/{copy}"),
            place: place.to_owned(),
            tables: Mutex::new(None),
        })
    }

    /// The collections.
    ///
    /// # Errors
    /// [`CopyError::Refused`], [`CopyError::Away`].
    pub(crate) async fn tables(&self) -> Result<Tables, CopyError> {
        let mut held = self.tables.lock().await;
        if let Some(tables) = &*held {
            return Ok(tables.clone());
        }
        let mut options = self.limited(ClientOptions::parse(self.uri.reveal())).await?;
        options.app_name = Some(self.app_name.clone());
        options.server_selection_timeout = Some(SELECTION);
        options.connect_timeout = Some(SELECTION);
        options.max_pool_size.get_or_insert(CONNECTIONS);
        // What a URI says of consistency would break promises of ours.
        options.read_concern = None;
        options.write_concern = None;
        options.selection_criteria = None;
        let client = Client::with_options(options).map_err(|error| self.failed(&error))?;
        // A standalone server takes this for itself alone.
        let mut durable = WriteConcern::majority();
        durable.journal = Some(true);
        let options = DatabaseOptions::builder()
            .write_concern(durable)
            .selection_criteria(SelectionCriteria::ReadPreference(ReadPreference::Primary))
            .build();
        let database = client.database_with_options(&self.database, options);
        let tables = Tables {
            head: database.collection("head"),
            chunks: database.collection("chunks"),
            leases: database.collection("leases"),
        };
        Ok(held.insert(tables).clone())
    }

    /// Waits for the driver, which has no limit of its own once a request is sent.
    ///
    /// # Errors
    /// [`CopyError::Away`] at the limit, else what the driver says.
    pub(crate) async fn limited<T>(
        &self,
        work: impl IntoFuture<Output = mongodb::error::Result<T>>,
    ) -> Result<T, CopyError> {
        self.within(work).await?.map_err(|error| self.failed(&error))
    }

    /// As [`Self::limited`], with what the driver says as it is.
    ///
    /// # Errors
    /// [`CopyError::Away`] at the limit.
    pub(crate) async fn within<T>(
        &self,
        work: impl IntoFuture<Output = mongodb::error::Result<T>>,
    ) -> Result<mongodb::error::Result<T>, CopyError> {
        let done = tokio::time::timeout(OPERATION, work.into_future()).await;
        done.map_err(|_| CopyError::Away {
            place: self.place.clone(),
            detail: format!("no answer within {} ms", OPERATION.as_millis()),
        })
    }

    /// What an error of the driver means.
    pub(crate) fn failed(&self, error: &Error) -> CopyError {
        // The kind alone: the rest may repeat documents.
        let (place, detail) = (self.place.clone(), error.kind.to_string());
        let never = match error.kind.as_ref() {
            ErrorKind::Authentication { .. }
            | ErrorKind::InvalidTlsConfig { .. }
            | ErrorKind::InvalidArgument { .. }
            | ErrorKind::IncompatibleServer { .. } => true,
            ErrorKind::Command(command) => NEVER.contains(&command.code),
            _ => false,
        };
        match never {
            true => CopyError::Refused { place, detail },
            false => CopyError::Away { place, detail },
        }
    }
}

/// Whether a record with this `_id` is there already.
pub(crate) fn is_duplicate(error: &Error) -> bool {
    match error.kind.as_ref() {
        ErrorKind::Write(WriteFailure::WriteError(write)) => write.code == DUPLICATE_KEY,
        ErrorKind::Command(command) => command.code == DUPLICATE_KEY,
        _ => false,
    }
}
