//! The SQLite file itself, on the thread that has it.

use std::fs::{self, OpenOptions};
use std::os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::LayerName;
use blaze_domain::config::{Document, Key, Timestamp};
use rusqlite::{Connection, ErrorCode, OpenFlags, OptionalExtension as _, Transaction, TransactionBehavior};

use super::aside::set_aside;
use super::json::{self, FormError};
use super::sqlite::away;
use super::{CopyError, Loaded, Position, Vault, progress};

/// `BLWC`: what `file` and we know such a file by.
const APPLICATION_ID: i64 = 0x424C_5743;
/// What is written here, and the newest that is read.
const FORMAT: i64 = 1;
/// How long a lock of another process is waited for.
const BUSY: Duration = Duration::from_secs(2);
/// Files that SQLite itself puts beside a database. They belong to it: beside another one they would be read as its own.
const COMPANIONS: [&str; 2] = ["-wal", "-shm"];

/// Makes the tables and the marks of a new file, at once: a file with our mark has them.
fn tables() -> String {
    format!(
        "BEGIN IMMEDIATE;
         CREATE TABLE head (
           id INTEGER PRIMARY KEY CHECK (id = 1), store_id TEXT NOT NULL, layer TEXT NOT NULL,
           revision INTEGER NOT NULL, as_of INTEGER NOT NULL, notes TEXT NOT NULL
         ) STRICT;
         CREATE TABLE documents (key TEXT PRIMARY KEY, document TEXT NOT NULL) STRICT;
         PRAGMA application_id = {APPLICATION_ID};
         PRAGMA user_version = {FORMAT};
         COMMIT"
    )
}

/// Where it is and whose it is.
pub(super) struct Facts {
    pub(super) path: PathBuf,
    pub(super) place: String,
    pub(super) layer: LayerName,
    pub(super) vault: Vault,
}

/// The file and the connection to it.
pub(super) struct Database {
    facts: Facts,
    /// None before the first use and after a failure.
    connection: Option<Connection>,
    /// Why it could not be read: it is moved aside before something else is written.
    unreadable: Option<CopyError>,
}

impl Database {
    pub(super) fn new(facts: Facts) -> Self {
        Self {
            facts,
            connection: None,
            unreadable: None,
        }
    }

    /// Reads everything, in one transaction.
    ///
    /// # Errors
    /// [`CopyError`].
    pub(super) fn load(&mut self) -> Result<Option<Loaded>, CopyError> {
        if self.is_missing() {
            return Ok(None);
        }
        let read = self.open().and_then(|(facts, connection)| facts.read(connection));
        if let Err(error) = &read {
            self.unreadable = Some(error.clone()).filter(CopyError::is_unreadable);
        }
        read
    }

    /// Makes this the content.
    ///
    /// # Errors
    /// [`CopyError`].
    pub(super) fn replace(&mut self, whole: &Loaded) -> Result<(), CopyError> {
        let notes = json::notes_to_json(&whole.notes).to_string();
        let sealed = self.facts.sealed(&whole.documents)?;
        let checked = match self.unreadable.take() {
            Some(error) => Err(error),
            None => self.open().and_then(|(facts, connection)| {
                let held = facts.head(connection)?;
                let held = held.as_ref().map(|(held, _)| held);
                progress::check_whole(held, &whole.position, &facts.place)
            }),
        };
        match checked {
            Err(error) if error.is_unreadable() => self.move_aside(&error)?,
            checked => checked?,
        }
        self.write(|transaction| {
            transaction.execute("DELETE FROM documents", [])?;
            put(transaction, &sealed)?;
            set_head(transaction, &whole.position, Some(&notes))
        })
    }

    /// Adds commits. Notes that are not given stay.
    ///
    /// # Errors
    /// [`CopyError`].
    pub(super) fn advance(
        &mut self,
        position: &Position,
        puts: &[Arc<Document>],
        removes: &[Key],
        notes: Option<&str>,
    ) -> Result<(), CopyError> {
        let sealed = self.facts.sealed(puts)?;
        if self.is_missing() {
            return progress::check(None, position, &self.facts.place);
        }
        let (facts, connection) = self.open()?;
        let head = facts.head(connection)?;
        progress::check(head.as_ref().map(|(held, _)| held), position, &facts.place)?;
        self.write(|transaction| {
            let mut remove = transaction.prepare("DELETE FROM documents WHERE key = ?1")?;
            for key in removes {
                remove.execute([key.to_string()])?;
            }
            put(transaction, &sealed)?;
            set_head(transaction, position, notes)
        })
    }

    /// Reading must not make a file.
    fn is_missing(&self) -> bool {
        self.connection.is_none() && !self.facts.path.exists()
    }

    /// Does all of it or nothing.
    fn write(&mut self, work: impl FnOnce(&Transaction<'_>) -> rusqlite::Result<()>) -> Result<(), CopyError> {
        let (facts, connection) = self.open()?;
        let written = connection
            .transaction_with_behavior(TransactionBehavior::Immediate)
            .and_then(|transaction| {
                work(&transaction)?;
                transaction.commit()
            });
        let written = written.map_err(|error| facts.failed(&error));
        if written.is_err() {
            // Opened anew, it is also checked anew.
            self.connection = None;
        }
        written
    }

    /// The connection; made where there is none.
    fn open(&mut self) -> Result<(&Facts, &mut Connection), CopyError> {
        let connection = match self.connection.take() {
            // Somebody has taken the file away: what is written to it now would be lost.
            Some(connection) if self.facts.path.exists() => connection,
            Some(_) | None => self.facts.connect()?,
        };
        Ok((&self.facts, self.connection.insert(connection)))
    }

    /// Keeps what is there for people and begins anew.
    fn move_aside(&mut self, why: &CopyError) -> Result<(), CopyError> {
        self.connection = None;
        let facts = &self.facts;
        let aside = set_aside(&facts.path, &COMPANIONS).map_err(|error| away(&facts.place, &error))?;
        tracing::warn!(
            error = %why, aside = %aside.display(),
            "the local database cannot be read; it was moved aside and a new one is begun"
        );
        Ok(())
    }
}

impl Facts {
    fn read(&self, connection: &mut Connection) -> Result<Option<Loaded>, CopyError> {
        let failed = |error: rusqlite::Error| self.failed(&error);
        let transaction = connection.transaction().map_err(failed)?;
        let Some((position, notes)) = self.head(&transaction)? else {
            return Ok(None);
        };
        let mut statement = transaction.prepare("SELECT document FROM documents").map_err(failed)?;
        let rows = statement.query_map([], |row| row.get::<_, String>(0)).map_err(failed)?;
        let mut documents = Vec::new();
        let mut lost = 0;
        for text in rows {
            let text = text.map_err(failed)?;
            let document = json::document_from_text(text.as_bytes()).map_err(|error| self.form(&error))?;
            let (document, unopened) = self.vault.open(document);
            lost += unopened;
            documents.push(Arc::new(document));
        }
        if lost > 0 {
            tracing::warn!(database = %self.path.display(), lost, "secrets of the local database do not open");
        }
        documents.sort_by(|one, other| one.key.cmp(&other.key));
        let notes = json::value_from_text(notes.as_bytes()).and_then(json::notes_from_json);
        Ok(Some(Loaded {
            position,
            documents,
            notes: Arc::new(notes.map_err(|error| self.form(&error))?),
        }))
    }

    /// The head record with the text of the notes; it is of our layer.
    fn head(&self, connection: &Connection) -> Result<Option<(Position, String)>, CopyError> {
        const HEAD: &str = "SELECT store_id, layer, revision, as_of, notes FROM head WHERE id = 1";
        type Row = (String, String, i64, i64, String);
        let row: Option<Row> = connection
            .query_row(HEAD, [], |row| row.try_into())
            .optional()
            .map_err(|error| self.failed(&error))?;
        let Some((store_id, layer, revision, as_of, notes)) = row else {
            return Ok(None);
        };
        let wrong = |member| {
            let detail = "breaks the rules for it";
            self.form(&FormError { member, detail })
        };
        let position = Position {
            store_id,
            layer: layer.parse().map_err(|_| wrong("layer"))?,
            revision: u64::try_from(revision).map_err(|_| wrong("revision"))?,
            as_of: Timestamp::from_millis(as_of),
        };
        if position.layer != self.layer {
            return Err(CopyError::OtherLayer {
                place: self.place.clone(),
                found: position.layer,
                wanted: self.layer.clone(),
            });
        }
        Ok(Some((position, notes)))
    }

    /// Keys and texts as they are written.
    fn sealed(&self, documents: &[Arc<Document>]) -> Result<Vec<(String, String)>, CopyError> {
        let sealed = |document: &Arc<Document>| {
            let text = self.vault.seal(document)?.to_json().to_string();
            Ok((document.key.to_string(), text))
        };
        documents.iter().map(sealed).collect()
    }

    fn connect(&self) -> Result<Connection, CopyError> {
        let mut options = OpenOptions::new();
        options.read(true).write(true).create(true).truncate(false).mode(0o600);
        let made = options.open(&self.path).and_then(|file| {
            // One that somebody copied here may have other rights. SQLite gives those of the file to its log.
            file.set_permissions(fs::Permissions::from_mode(0o600))
        });
        made.map_err(|error| CopyError::Refused {
            place: self.place.clone(),
            detail: error.to_string(),
        })?;
        let failed = |error: rusqlite::Error| self.failed(&error);
        // No URI: a path stays a path. No mutex: the connection belongs to one thread.
        let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let connection = Connection::open_with_flags(&self.path, flags).map_err(failed)?;
        connection.busy_timeout(BUSY).map_err(failed)?;
        let is_new = self.check(&connection)?;
        for (name, value) in [
            ("journal_mode", "WAL"),
            ("synchronous", "FULL"),
            ("temp_store", "MEMORY"),
            ("trusted_schema", "OFF"),
        ] {
            let set = connection.pragma_update_and_check(None, name, value, |_| Ok(()));
            set.optional().map_err(failed)?;
        }
        if is_new {
            connection.execute_batch(&tables()).map_err(failed)?;
        }
        Ok(connection)
    }

    /// Makes sure that it is sound, ours, and of a format that is known. Gives whether it is empty.
    fn check(&self, connection: &Connection) -> Result<bool, CopyError> {
        let broken = |detail: String| CopyError::Broken {
            place: self.place.clone(),
            detail,
        };
        let number = |query: &str| {
            let value: rusqlite::Result<i64> = connection.query_row(query, [], |row| row.get(0));
            value.map_err(|error| self.failed(&error))
        };
        let owner = number("PRAGMA application_id")?;
        let is_new = owner == 0 && number("SELECT count(*) FROM sqlite_schema")? == 0;
        if owner != APPLICATION_ID && !is_new {
            return Err(broken("it is a database of another program".to_owned()));
        }
        let format = number("PRAGMA user_version")?;
        if format > FORMAT {
            return Err(CopyError::NewerFormat {
                place: self.place.clone(),
                found: format.unsigned_abs(),
                known: FORMAT.unsigned_abs(),
            });
        }
        let said: String = connection
            .query_row("PRAGMA quick_check(1)", [], |row| row.get(0))
            .map_err(|error| self.failed(&error))?;
        if said == "ok" { Ok(is_new) } else { Err(broken(said)) }
    }

    fn form(&self, error: &FormError) -> CopyError {
        CopyError::Broken {
            place: self.place.clone(),
            detail: error.to_string(),
        }
    }

    fn failed(&self, error: &rusqlite::Error) -> CopyError {
        use rusqlite::Error as E;
        let (place, detail) = (self.place.clone(), error.to_string());
        match error {
            E::SqliteFailure(failure, _) => match failure.code {
                // Our statements are right: what does not know a table is another file.
                ErrorCode::DatabaseCorrupt | ErrorCode::NotADatabase | ErrorCode::Unknown => CopyError::Broken { place, detail },
                ErrorCode::ReadOnly | ErrorCode::CannotOpen | ErrorCode::PermissionDenied => {
                    CopyError::Refused { place, detail }
                }
                _ => CopyError::Away { place, detail },
            },
            E::FromSqlConversionFailure(..)
            | E::IntegralValueOutOfRange(..)
            | E::InvalidColumnType(..)
            | E::Utf8Error(..)
            // A table or column is not there.
            | E::SqlInputError { .. } => CopyError::Broken { place, detail },
            _ => CopyError::Away { place, detail },
        }
    }
}

fn put(transaction: &Transaction<'_>, sealed: &[(String, String)]) -> rusqlite::Result<()> {
    const PUT: &str = "INSERT INTO documents (key, document) VALUES (?1, ?2)
                       ON CONFLICT (key) DO UPDATE SET document = excluded.document";
    let mut statement = transaction.prepare(PUT)?;
    sealed
        .iter()
        .try_for_each(|row| statement.execute((&row.0, &row.1)).map(|_| ()))
}

/// Notes that are not given stay.
fn set_head(transaction: &Transaction<'_>, position: &Position, notes: Option<&str>) -> rusqlite::Result<()> {
    const HEAD: &str = "INSERT INTO head (id, store_id, layer, revision, as_of, notes) VALUES (1, ?1, ?2, ?3, ?4, ?5)
                        ON CONFLICT (id) DO UPDATE SET store_id = excluded.store_id, layer = excluded.layer,
                          revision = excluded.revision, as_of = excluded.as_of,
                          notes = coalesce(?6, notes)";
    let revision = i64::try_from(position.revision).unwrap_or(i64::MAX);
    let row = (
        &position.store_id,
        position.layer.as_str(),
        revision,
        position.as_of.as_millis(),
        notes.unwrap_or_default(),
        notes,
    );
    transaction.execute(HEAD, row).map(|_| ())
}
