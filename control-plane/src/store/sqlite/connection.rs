//! Opening the file.

use std::fs::OpenOptions;
use std::io::ErrorKind;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rusqlite::{Connection, OpenFlags, OptionalExtension as _, TransactionBehavior};

use super::errors::store_error;
use crate::store::StoreError;

/// `BLCF`: what `file` and we know such a file by.
const APPLICATION_ID: i64 = 0x424C_4346;
/// How long a connection waits for the other one's lock.
const BUSY: Duration = Duration::from_secs(5);
/// The log beside the file is cut to this after it was copied into the file.
const LOG_BYTES: i64 = 64 * 1024 * 1024;
/// Pages of the log from which a commit copies it itself: where copying beside it does not come to
/// an end, because there is always one more. 64 MiB.
const LOG_PAGES: i64 = 16 * 1024;

/// The path without links and relative parts, so that one file has one lock.
///
/// # Errors
/// As [`file_error`].
pub(super) fn real_path(path: &Path) -> Result<PathBuf, StoreError> {
    let failed = |error: std::io::Error| file_error(path, "cannot be opened", &error);
    match path.canonicalize() {
        Ok(real) => Ok(real),
        Err(error) if error.kind() == ErrorKind::NotFound => {
            let folder = path
                .parent()
                .filter(|folder| !folder.as_os_str().is_empty())
                .unwrap_or(Path::new("."));
            let name = path.file_name().ok_or_else(|| failed(error))?;
            Ok(folder.canonicalize().map_err(failed)?.join(name))
        }
        Err(error) => Err(failed(error)),
    }
}

/// What a file that cannot be opened means: [`StoreError::Refused`] where waiting does not help, as
/// without its folder.
pub(super) fn file_error(path: &Path, what: &str, error: &std::io::Error) -> StoreError {
    let text = format!("{} {what}: {error}", path.display());
    match error.kind() {
        ErrorKind::NotFound => StoreError::Refused(format!(
            "{text}: its folder must be there; make or mount it, or name another file in \
             `control_plane.store.sqlite.path`"
        )),
        ErrorKind::PermissionDenied
        | ErrorKind::NotADirectory
        | ErrorKind::IsADirectory
        | ErrorKind::ReadOnlyFilesystem
        | ErrorKind::InvalidInput
        | ErrorKind::InvalidFilename => StoreError::Refused(format!(
            "{text}: this user must be able to write the file and its folder, or name another file \
             in \
             `control_plane.store.sqlite.path`"
        )),
        _ => StoreError::Unavailable(text),
    }
}

/// The connection that writes. The file is made if it is not there, readable by its owner alone.
///
/// # Errors
/// [`StoreError::Refused`] for a file of another program, [`StoreError::Unavailable`],
/// [`StoreError::Corrupt`].
pub(super) fn open_writer(path: &Path) -> Result<Connection, StoreError> {
    let mut options = OpenOptions::new();
    options.read(true).write(true).create(true).truncate(false).mode(0o600);
    let opened = options.open(path);
    drop(opened.map_err(|error| file_error(path, "cannot be written", &error))?);
    let connection = open(path, OpenFlags::SQLITE_OPEN_READ_WRITE)?;
    check_owner(&connection, path)?;
    let mode: String = connection
        .pragma_update_and_check(None, "journal_mode", "WAL", |row| row.get(0))
        .map_err(store_error)?;
    if !mode.eq_ignore_ascii_case("wal") {
        return Err(StoreError::Refused(format!(
            "{} is on a file system without shared memory, which SQLite's write-ahead log needs: \
             put it on a local disk",
            path.display()
        )));
    }
    prepare(&connection)?;
    Ok(connection)
}

/// A connection that only reads.
///
/// # Errors
/// As [`open_writer`].
pub(super) fn open_reader(path: &Path) -> Result<Connection, StoreError> {
    let connection = open(path, OpenFlags::SQLITE_OPEN_READ_ONLY)?;
    check_owner(&connection, path)?;
    Ok(connection)
}

/// A connection that copies the log into the file.
///
/// # Errors
/// As [`open_writer`].
pub(super) fn open_copier(path: &Path) -> Result<Connection, StoreError> {
    let connection = open(path, OpenFlags::SQLITE_OPEN_READ_WRITE)?;
    prepare(&connection)?;
    Ok(connection)
}

/// Copies as much of the log into the file as nobody reads, without holding up writers. A writer
/// begins it anew when all of it was copied.
///
/// # Errors
/// [`StoreError`]; what was committed is safe in the log.
pub(super) fn copy_log(connection: &Connection) -> Result<(), StoreError> {
    connection.query_row("PRAGMA wal_checkpoint(PASSIVE)", [], |_| Ok(())).map_err(store_error)
}

/// A store that is gone with its connection.
///
/// # Errors
/// [`StoreError::Unavailable`].
pub(super) fn open_memory() -> Result<Connection, StoreError> {
    let connection = Connection::open_in_memory().map_err(store_error)?;
    prepare(&connection)?;
    Ok(connection)
}

fn open(path: &Path, access: OpenFlags) -> Result<Connection, StoreError> {
    // No URI: a path stays a path. No mutex: a connection belongs to one thread.
    let flags = access | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let connection = Connection::open_with_flags(path, flags)
        .map_err(|error| StoreError::Unavailable(format!("{}: {error}", path.display())))?;
    connection.busy_timeout(BUSY).map_err(store_error)?;
    Ok(connection)
}

/// Never writes into a database that somebody made for something else.
fn check_owner(connection: &Connection, path: &Path) -> Result<(), StoreError> {
    let id: i64 = connection
        .pragma_query_value(None, "application_id", |row| row.get(0))
        .map_err(store_error)?;
    if id == APPLICATION_ID {
        return Ok(());
    }
    let tables: i64 = connection
        .query_row("SELECT count(*) FROM sqlite_schema", [], |row| row.get(0))
        .map_err(store_error)?;
    if id == 0 && tables == 0 {
        return Ok(());
    }
    Err(StoreError::Refused(format!(
        "{} is a database of another program: name another file in \
         `control_plane.store.sqlite.path`",
        path.display()
    )))
}

fn prepare(connection: &Connection) -> Result<(), StoreError> {
    let set = |name: &str, value: &dyn rusqlite::ToSql| {
        connection.pragma_update(None, name, value).map_err(store_error)
    };
    set("synchronous", &"FULL")?;
    set("temp_store", &"MEMORY")?;
    set("trusted_schema", &"OFF")?;
    connection
        .pragma_update_and_check(None, "wal_autocheckpoint", LOG_PAGES, |_| Ok(()))
        .map_err(store_error)?;
    connection
        .pragma_update_and_check(None, "journal_size_limit", LOG_BYTES, |_| Ok(()))
        .map_err(store_error)
}

/// What is there before any migration: the records of migrations, and who the store is.
///
/// # Errors
/// [`StoreError`].
pub(super) fn bootstrap(connection: &mut Connection) -> Result<(), StoreError> {
    const TABLES: &str = "
        CREATE TABLE IF NOT EXISTS meta (name TEXT PRIMARY KEY, value ANY NOT NULL) STRICT;
        CREATE TABLE IF NOT EXISTS migrations (
          number INTEGER NOT NULL, step INTEGER NOT NULL, name TEXT NOT NULL, checksum TEXT NOT NULL,
          time INTEGER NOT NULL, PRIMARY KEY (number, step)
        ) STRICT;";
    let transaction = connection
        .transaction_with_behavior(TransactionBehavior::Immediate)
        .map_err(store_error)?;
    transaction.execute_batch(TABLES).map_err(store_error)?;
    transaction.pragma_update(None, "application_id", APPLICATION_ID).map_err(store_error)?;
    for (name, value) in [("floor", 0), ("min_version", 0), ("settled", 0)] {
        transaction
            .execute("INSERT OR IGNORE INTO meta (name, value) VALUES (?1, ?2)", (name, value))
            .map_err(store_error)?;
    }
    transaction
        .execute(
            "INSERT OR IGNORE INTO meta (name, value) VALUES ('store_id', ?1)",
            [uuid::Uuid::now_v7().to_string()],
        )
        .map_err(store_error)?;
    transaction.commit().map_err(store_error)
}

/// A number of `meta`; 0 if it is not there.
pub(super) fn number(connection: &Connection, name: &str) -> Result<i64, StoreError> {
    let mut find =
        connection.prepare_cached("SELECT value FROM meta WHERE name = ?1").map_err(store_error)?;
    let found = find.query_row([name], |row| row.get(0)).optional().map_err(store_error)?;
    Ok(found.unwrap_or(0))
}

/// Sets a number of `meta`.
pub(super) fn set_number(
    connection: &Connection,
    name: &str,
    value: i64,
) -> Result<(), StoreError> {
    connection
        .execute(
            "INSERT INTO meta (name, value) VALUES (?1, ?2) ON CONFLICT (name) DO UPDATE SET value \
             = excluded.value",
            (name, value),
        )
        .map_err(store_error)?;
    Ok(())
}

/// Which store this is.
pub(super) fn store_id(connection: &Connection) -> Result<String, StoreError> {
    connection
        .query_row("SELECT value FROM meta WHERE name = 'store_id'", [], |row| row.get(0))
        .map_err(store_error)
}

/// The newest revision: that of the last commit, or the floor if all commits up to it are gone.
pub(super) fn head(connection: &Connection) -> Result<i64, StoreError> {
    let mut find =
        connection.prepare_cached("SELECT max(revision) FROM events").map_err(store_error)?;
    let newest: Option<i64> = find.query_row([], |row| row.get(0)).map_err(store_error)?;
    Ok(newest.unwrap_or(0).max(number(connection, "floor")?))
}
