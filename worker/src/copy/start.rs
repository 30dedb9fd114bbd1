//! What the worker starts from: the local database or the last-known-good file.
//!
//! ```text
//! database (limited) ─┐
//!                     ├─▶ of one store the higher revision, of two the later time; notes of both
//! file ───────────────┘
//! ```
//!
//! What could not be read in time is read before it is first written ([`Start::is_unread`], [`Found`](super::Found)).

use std::sync::Arc;
use std::time::Duration;

use super::{CopyError, Loaded, LocalCopy};

/// How long the database is waited for where the file has something: services get their last configuration within two
/// seconds, also while the database is away.
pub const DATABASE_LIMIT: Duration = Duration::from_secs(1);
/// The same where the file has nothing: then there is nothing to serve meanwhile.
const PATIENT: u32 = 5;

/// A copy that could not be read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Which copy.
    pub place: String,
    /// Why.
    pub error: CopyError,
}

/// What was found at the start.
#[derive(Debug, Default)]
pub struct Start {
    /// What to serve; none: nothing was ever written, or nothing can be read.
    pub loaded: Option<Loaded>,
    /// Where it is from, for people.
    pub from: Option<String>,
    /// The database holds exactly this.
    pub is_database_current: bool,
    /// The file holds exactly this.
    pub is_file_current: bool,
    /// It is from the file, not from the database.
    pub is_from_file: bool,
    /// What could not be read.
    pub problems: Vec<Problem>,
}

/// Reads both copies at once and takes the newer one. `limit` is for the database; see [`DATABASE_LIMIT`].
pub async fn choose(
    database: Option<&Arc<dyn LocalCopy>>,
    file: Option<&Arc<dyn LocalCopy>>,
    limit: Duration,
) -> Start {
    let mut start = Start::default();
    let file_load = async {
        match file {
            Some(file) => file.load().await,
            None => Ok(None),
        }
    };
    let database_load = async {
        match database {
            Some(database) => database.load().await,
            None => Ok(None),
        }
    };
    let database_load = tokio::time::timeout(limit * PATIENT, database_load);
    tokio::pin!(file_load, database_load);
    let began = tokio::time::Instant::now();
    let mut early = None;
    let from_file = loop {
        tokio::select! {
            loaded = &mut file_load => break loaded,
            loaded = &mut database_load, if early.is_none() => early = Some(loaded),
        }
    };
    let waits_for = if matches!(from_file, Ok(Some(_))) {
        limit
    } else {
        limit * PATIENT
    };
    let from_database = match early {
        Some(loaded) => Ok(loaded),
        None => tokio::time::timeout_at(began + waits_for, database_load).await,
    };
    let from_database = from_database.and_then(std::convert::identity).unwrap_or_else(|_| {
        Err(CopyError::Away {
            place: database.map(|database| database.describe()).unwrap_or_default(),
            detail: format!("no answer within {} ms", waits_for.as_millis()),
        })
    });
    let from_database = start.note(database, from_database);
    let from_file = start.note(file, from_file);
    start.take(from_database, from_file);
    let from = if start.is_from_file { file } else { database };
    start.from = from.filter(|_| start.loaded.is_some()).map(|copy| copy.describe());
    start
}

impl Start {
    /// Whether nobody knows what a copy holds: it may be newer than what is served. What nobody here can read is not.
    #[must_use]
    pub fn is_unread(&self, copy: &dyn LocalCopy) -> bool {
        let place = copy.describe();
        let mut problems = self.problems.iter().filter(|problem| problem.place == place);
        problems.any(|problem| !problem.error.is_unreadable())
    }

    fn note(&mut self, copy: Option<&Arc<dyn LocalCopy>>, loaded: Result<Option<Loaded>, CopyError>) -> Option<Loaded> {
        match loaded {
            Ok(loaded) => loaded,
            Err(error) => {
                tracing::warn!(%error, "a copy of the configuration cannot be read");
                let place = copy.map(|copy| copy.describe()).unwrap_or_default();
                self.problems.push(Problem { place, error });
                None
            }
        }
    }

    fn take(&mut self, from_database: Option<Loaded>, from_file: Option<Loaded>) {
        let (mut taken, other) = match (from_database, from_file) {
            (None, None) => return,
            (Some(database), None) => {
                self.is_database_current = true;
                (database, None)
            }
            (None, Some(file)) => {
                (self.is_file_current, self.is_from_file) = (true, true);
                (file, None)
            }
            (Some(database), Some(file)) => {
                let is_same = database.position.store_id == file.position.store_id
                    && database.position.revision == file.position.revision
                    && database.notes == file.notes;
                let is_file = file.position.is_newer_than(&database.position);
                // Secrets that one of them has and the other has not.
                let is_file = if is_same {
                    database.lacks_secrets() && !file.lacks_secrets()
                } else {
                    is_file
                };
                self.is_database_current = !is_file || is_same;
                self.is_file_current = is_file || is_same;
                self.is_from_file = is_file;
                if is_file {
                    (file, Some(database))
                } else {
                    (database, Some(file))
                }
            }
        };
        if let Some(other) = other.filter(|other| other.notes != taken.notes) {
            // What was told or failed once stays so, whichever copy was written last.
            Arc::make_mut(&mut taken.notes).merge(&other.notes);
            (self.is_database_current, self.is_file_current) = (false, false);
        }
        self.loaded = Some(taken);
    }
}

#[cfg(test)]
#[path = "start_tests.rs"]
mod tests;
