//! What MongoDB's errors mean.

use mongodb::bson::Document;
use mongodb::error::{Error, ErrorKind, TRANSIENT_TRANSACTION_ERROR, WriteFailure};

use crate::store::{CommitError, StoreError};

pub(super) const DUPLICATE_KEY: i32 = 11_000;
pub(super) const WRITE_CONFLICT: i32 = 112;
const NO_SUCH_TRANSACTION: i32 = 251;
const SNAPSHOT_UNAVAILABLE: i32 = 246;
/// Longer than `maxTimeMS`.
pub(super) const TOO_SLOW: i32 = 50;
pub(super) const NAMESPACE_EXISTS: i32 = 48;
/// Another transaction holds a lock, or this one was replaced by a newer one of its session, or was
/// ended for it.
const OTHER_TRANSACTION: [i32; 4] = [24, 225, 267, 290];
/// No right, wrong password, not a replica set, no such command: waiting does not help.
const NEVER: [i32; 4] = [13, 18, 20, 59];

/// A read or write that failed.
#[expect(clippy::needless_pass_by_value, reason = "it stands in `map_err`")]
pub(super) fn store_error(error: Error) -> StoreError {
    let text = error.kind.to_string();
    match error.kind.as_ref() {
        ErrorKind::Authentication { .. }
        | ErrorKind::InvalidTlsConfig { .. }
        | ErrorKind::InvalidArgument { .. }
        | ErrorKind::IncompatibleServer { .. }
        | ErrorKind::SessionsNotSupported => StoreError::Refused(format!("MongoDB: {text}")),
        ErrorKind::Bson(_) => StoreError::Corrupt(format!("MongoDB: {text}")),
        _ if codes(&error).iter().any(|code| NEVER.contains(code)) => {
            StoreError::Refused(format!("MongoDB: {text}"))
        }
        _ => StoreError::Unavailable(format!("MongoDB: {text}")),
    }
}

/// A statement of a transaction that failed: whatever the transaction did is undone.
pub(super) fn not_written(error: Error) -> CommitError {
    let codes = codes(&error);
    let is = |code: &i32| {
        [DUPLICATE_KEY, WRITE_CONFLICT, NO_SUCH_TRANSACTION, SNAPSHOT_UNAVAILABLE].contains(code)
            || OTHER_TRANSACTION.contains(code)
    };
    match codes.iter().any(is) {
        true => CommitError::Conflict,
        false => CommitError::NotWritten(store_error(error)),
    }
}

/// Whether an open transaction of somebody else is in the way: the revision may not have been taken
/// at all.
pub(super) fn is_write_conflict(error: &Error) -> bool {
    codes(error).iter().any(|code| *code == WRITE_CONFLICT || *code == 24)
}

/// Whether a command that failed like this has never left this process. A pool that was cleared
/// says nothing: commands that were sent already fail by it, too.
pub(super) fn was_not_sent(error: &Error) -> bool {
    matches!(
        error.kind.as_ref(),
        ErrorKind::ServerSelection { .. }
            | ErrorKind::Shutdown
            | ErrorKind::Authentication { .. }
            | ErrorKind::InvalidArgument { .. }
            | ErrorKind::InvalidTlsConfig { .. }
            | ErrorKind::DnsResolve { .. }
    )
}

/// Whether the server did not even begin with a command.
pub(super) fn is_refused(error: &Error) -> bool {
    codes(error).iter().any(|code| NEVER.contains(code))
}

/// Whether the end of a transaction that failed like this has surely not been.
pub(super) fn surely_aborted(error: &Error) -> bool {
    error.contains_label(TRANSIENT_TRANSACTION_ERROR)
}

/// Whether a snapshot is not to be had yet, as just after collections were made.
pub(super) fn is_snapshot_unavailable(error: &Error) -> bool {
    codes(error).contains(&SNAPSHOT_UNAVAILABLE)
}

pub(super) fn is_duplicate(error: &Error) -> bool {
    let codes = codes(error);
    !codes.is_empty() && codes.iter().all(|code| *code == DUPLICATE_KEY)
}

/// The server's code for a command that it refused.
pub(super) fn command_code(error: &Error) -> Option<i32> {
    match error.kind.as_ref() {
        ErrorKind::Command(command) => Some(command.code),
        _ => None,
    }
}

fn codes(error: &Error) -> Vec<i32> {
    match error.kind.as_ref() {
        ErrorKind::Command(command) => vec![command.code],
        ErrorKind::Write(WriteFailure::WriteError(write)) => vec![write.code],
        ErrorKind::Write(WriteFailure::WriteConcernError(concern)) => vec![concern.code],
        ErrorKind::InsertMany(many) => {
            let writes = many.write_errors.iter().flatten().map(|write| write.code);
            writes.chain(many.write_concern_error.as_ref().map(|concern| concern.code)).collect()
        }
        _ => Vec::new(),
    }
}

/// What is wrong with an answer to a command that the server accepted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Wrong {
    /// A document was not written: code and text.
    Document(i32, String),
    /// It was written, but it is not known whether a majority has it.
    Concern(String),
}

/// A command that the server accepted may still have failed for some of its documents.
pub(super) fn write_code(answer: &Document) -> Option<Wrong> {
    let errors = answer.get_array("writeErrors").ok();
    if let Some(first) = errors.and_then(|errors| errors.first()) {
        let first = first.as_document();
        let code = first.and_then(|error| error.get_i32("code").ok()).unwrap_or(0);
        let text = first.and_then(|error| error.get_str("errmsg").ok()).unwrap_or_default();
        return Some(Wrong::Document(code, text.to_owned()));
    }
    let concern = answer.get_document("writeConcernError").ok()?;
    Some(Wrong::Concern(concern.get_str("errmsg").unwrap_or_default().to_owned()))
}

/// What is wrong with an answer, for a command that may be done again.
pub(super) fn write_error(answer: &Document) -> Option<StoreError> {
    write_code(answer).map(|wrong| match wrong {
        Wrong::Document(_, text) | Wrong::Concern(text) => {
            StoreError::Unavailable(format!("MongoDB: {text}"))
        }
    })
}

#[cfg(test)]
mod tests {
    use mongodb::bson::doc;

    use super::*;

    #[test]
    fn errors_of_single_documents_are_seen() {
        assert_eq!(write_code(&doc! { "ok": 1, "n": 1 }), None);
        assert_eq!(write_code(&doc! { "ok": 1, "writeErrors": [] }), None);
        let taken =
            doc! { "ok": 1, "writeErrors": [{ "index": 0, "code": 11_000, "errmsg": "E11000" }] };
        assert_eq!(write_code(&taken), Some(Wrong::Document(DUPLICATE_KEY, "E11000".to_owned())));
        let late = doc! { "ok": 1, "n": 1, "writeConcernError": { "code": 64, "errmsg": "late" } };
        assert_eq!(write_code(&late), Some(Wrong::Concern("late".to_owned())));
        assert!(matches!(write_error(&taken), Some(StoreError::Unavailable(_))));
    }

    #[test]
    fn what_never_gets_better_is_refused() {
        let io = Error::from(std::io::Error::from(std::io::ErrorKind::ConnectionReset));
        assert!(store_error(io.clone()).is_transient());
        assert!(!was_not_sent(&io), "it may have arrived");
        assert!(matches!(not_written(io), CommitError::NotWritten(StoreError::Unavailable(_))));
    }
}
