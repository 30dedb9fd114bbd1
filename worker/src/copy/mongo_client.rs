//! The connection to MongoDB: made at the first use, and limited in everything.

use std::future::IntoFuture;
use std::mem::Discriminant;
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::node_file::{MongoSection, SecretText};
use blaze_runtime::read_password;
use mongodb::bson::{Document, doc};
use mongodb::error::{Error, ErrorKind, WriteFailure};
use mongodb::options::{
    ClientOptions, ConnectionString, DatabaseOptions, ReadPreference, SelectionCriteria,
    WriteConcern,
};
use mongodb::{Client, Collection};
use tokio::sync::Mutex;
use tokio::task::JoinSet;
use tokio::time::Instant;

use super::CopyError;

/// Until a server is found, and until a connection stands.
const SELECTION: Duration = Duration::from_secs(2);
/// Each operation.
const OPERATION: Duration = Duration::from_secs(5);
/// Between two tries to log in with another password.
const LOG_IN_AGAIN: Duration = Duration::from_secs(1);
/// Most connections: one who writes, one who reads.
const CONNECTIONS: u32 = 4;
const DUPLICATE_KEY: i32 = 11_000;
/// No right, wrong password, no such command: waiting does not help.
const NEVER: [i32; 3] = [13, 18, 59];

/// What is wrong with the URI, as far as that is seen without the server.
///
/// # Errors
/// For people; it names the part that is wrong and not the whole, for it may hold a password.
pub fn check_uri(section: &MongoSection) -> Result<(), String> {
    let parsed = ConnectionString::parse(section.uri.reveal());
    parsed.map(drop).map_err(|error| error.kind.to_string())
}

/// Where the copy is.
#[derive(Clone)]
pub(crate) struct Server {
    section: MongoSection,
    app_name: String,
    place: String,
    connected: Arc<Mutex<Option<Connected>>>,
}

/// The collections of a client, and what it logs in with where that is not in the URI.
type LoggedIn = (Tables, Option<SecretText>);

/// The client that serves.
struct Connected {
    tables: Tables,
    password: Option<SecretText>,
    /// One that logs in with another password.
    trying: JoinSet<Result<LoggedIn, CopyError>>,
    /// When that is tried next, at the earliest.
    again: Instant,
    /// Which kind of error was said last.
    told: Option<Discriminant<CopyError>>,
}

impl Connected {
    /// Takes over a client that the server has let in; begins to try one, if the file holds
    /// another password.
    fn follow(&mut self, server: &Server, password: Result<Option<SecretText>, CopyError>) {
        match self.trying.try_join_next() {
            Some(Ok(Ok((tables, password)))) => {
                (self.tables, self.password, self.told) = (tables, password, None);
                tracing::info!(place = server.place, "logged in with another password");
            }
            Some(Ok(Err(error))) => self.tell(&error),
            // The second: the runtime goes away.
            None | Some(Err(_)) => {}
        }
        let now = Instant::now();
        match password {
            Ok(password) => {
                if password != self.password && self.trying.is_empty() && self.again <= now {
                    self.again = now + LOG_IN_AGAIN;
                    self.trying.spawn(server.clone().log_in(password));
                }
            }
            Err(error) => self.tell(&error),
        }
    }

    fn tell(&mut self, error: &CopyError) {
        // Not by its text: that of a server that is away changes from look to look.
        let kind = std::mem::discriminant(error);
        if self.told.replace(kind) != Some(kind) {
            tracing::warn!(%error, "the password of MongoDB that the file holds is not used");
        }
    }
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
    pub(crate) fn new(section: MongoSection, copy: &str, place: &str) -> Self {
        Self {
            section,
            app_name: format!("blaze-worker/{copy}"),
            place: place.to_owned(),
            connected: Arc::default(),
        }
    }

    /// The collections. Where the file holds another password, a client that logs in with it is
    /// tried beside; until the server takes it, the one of before serves.
    ///
    /// # Errors
    /// [`CopyError::Refused`], [`CopyError::Away`].
    pub(crate) async fn tables(&self) -> Result<Tables, CopyError> {
        let password = self.password().await;
        let mut held = self.connected.lock().await;
        if let Some(before) = &mut *held {
            before.follow(self, password);
            return Ok(before.tables.clone());
        }
        let password = password?;
        let tables = self.connect(password.as_ref()).await?;
        let (again, told, trying) = (Instant::now(), None, JoinSet::new());
        *held = Some(Connected { tables: tables.clone(), password, trying, again, told });
        Ok(tables)
    }

    /// A client that the server has let in.
    async fn log_in(self, password: Option<SecretText>) -> Result<LoggedIn, CopyError> {
        let tables = self.connect(password.as_ref()).await?;
        let database = tables.head.client().database("admin");
        self.limited(database.run_command(doc! { "ping": 1 })).await?;
        Ok((tables, password))
    }

    async fn password(&self) -> Result<Option<SecretText>, CopyError> {
        let Some(file) = self.section.password_file.clone() else {
            return Ok(None);
        };
        let read = tokio::task::spawn_blocking(move || read_password(&file)).await;
        let away = |detail| CopyError::Away { place: self.place.clone(), detail };
        // The blocking task ends early only when the runtime goes away.
        let password = read.unwrap_or_else(|error| Err(error.to_string())).map_err(away)?;
        Ok(Some(password.into()))
    }

    async fn connect(&self, password: Option<&SecretText>) -> Result<Tables, CopyError> {
        let uri = self.section.uri_with(password);
        let mut options = self.limited(ClientOptions::parse(uri.reveal())).await?;
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
        let database = client.database_with_options(&self.section.database, options);
        Ok(Tables {
            head: database.collection("head"),
            chunks: database.collection("chunks"),
            leases: database.collection("leases"),
        })
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
