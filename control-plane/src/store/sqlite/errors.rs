//! What SQLite's errors mean.

use rusqlite::ErrorCode;

use crate::store::{CommitError, StoreError};

/// A read or write that failed.
#[expect(clippy::needless_pass_by_value, reason = "it stands in `map_err`")]
pub(super) fn store_error(error: rusqlite::Error) -> StoreError {
    use rusqlite::Error as E;
    match &error {
        E::SqliteFailure(failure, _) => match failure.code {
            ErrorCode::DatabaseCorrupt | ErrorCode::NotADatabase => {
                StoreError::Corrupt(error.to_string())
            }
            ErrorCode::DiskFull => {
                StoreError::Unavailable(format!("{error}: free space on the disk of the store"))
            }
            ErrorCode::ReadOnly => StoreError::Unavailable(format!(
                "{error}: the file and its folder must be writable by this user"
            )),
            _ => StoreError::Unavailable(error.to_string()),
        },
        E::FromSqlConversionFailure(..)
        | E::IntegralValueOutOfRange(..)
        | E::InvalidColumnType(..)
        | E::Utf8Error(..) => StoreError::Corrupt(error.to_string()),
        _ => StoreError::Unavailable(error.to_string()),
    }
}

/// A statement of a commit that failed: the transaction is rolled back, so nothing was written.
pub(super) fn not_written(error: rusqlite::Error) -> CommitError {
    match error.sqlite_error_code() {
        Some(ErrorCode::ConstraintViolation) => CommitError::Conflict,
        _ => CommitError::NotWritten(store_error(error)),
    }
}
