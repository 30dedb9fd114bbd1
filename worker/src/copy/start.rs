//! What the worker starts from: of one store the copy with the higher revision, of two stores the
//! later one; notes of both.
//!
//! A copy that could not be read in time is read before it is first written ([`Target::is_read`],
//! [`Found`](super::Found)).

use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::timeout;

use super::{CopyError, Loaded, LocalCopy, Target};

/// How long the database is waited for where the file has something: services get their last
/// configuration within two seconds, also while the database is away.
const DATABASE_LIMIT: Duration = Duration::from_secs(1);
/// The same where the file has nothing: then there is nothing to serve meanwhile.
const PATIENT: u32 = 5;

/// What was found at the start.
#[derive(Default)]
pub struct Start {
    /// What to serve; none: nothing was ever written, or nothing can be read.
    pub loaded: Option<Loaded>,
    /// Where it is from, for people.
    pub from: Option<String>,
    /// The copies, from now on.
    pub targets: Vec<Target>,
}

/// Reads both copies at once and takes the newer one.
pub async fn choose(
    file: Option<Arc<dyn LocalCopy>>,
    database: Option<Arc<dyn LocalCopy>>,
) -> Start {
    let mut start = Start::default();
    let load = |copy: Option<Arc<dyn LocalCopy>>| async move {
        match copy {
            Some(copy) => copy.load().await,
            None => Ok(None),
        }
    };
    let mut asked = pin!(load(database.clone()));
    let (of_file, in_time) =
        tokio::join!(load(file.clone()), timeout(DATABASE_LIMIT, asked.as_mut()));
    if let Some(file) = file {
        start.take(file, of_file);
    }
    if let Some(database) = database {
        let (loaded, limit) = match in_time {
            Err(_) if start.loaded.is_none() => {
                let more = DATABASE_LIMIT * (PATIENT - 1);
                (timeout(more, asked).await, DATABASE_LIMIT * PATIENT)
            }
            in_time => (in_time, DATABASE_LIMIT),
        };
        let loaded = loaded.unwrap_or_else(|_| {
            Err(CopyError::Away {
                place: database.describe(),
                detail: format!("no answer within {} ms", limit.as_millis()),
            })
        });
        start.take(database, loaded);
    }
    start
}

impl Start {
    fn take(&mut self, copy: Arc<dyn LocalCopy>, loaded: Result<Option<Loaded>, CopyError>) {
        let (found, is_read) = match loaded {
            Ok(found) => (found, true),
            Err(error) => {
                tracing::warn!(%error, "a copy of the configuration cannot be read");
                (None, error.is_unreadable())
            }
        };
        let place = copy.describe();
        let written = found.as_ref().map(|found| found.position.clone());
        self.targets.push(Target { copy, is_read, written });
        let Some(mut found) = found else { return };
        // Both get the notes of both.
        if self.loaded.as_ref().is_some_and(|held| held.notes != found.notes) {
            self.targets.iter_mut().for_each(|target| target.written = None);
        }
        match &mut self.loaded {
            Some(held) if !found.position.is_newer_than(&held.position) => {
                // A roll-out that failed stays so, whichever copy was written last.
                Arc::make_mut(&mut held.notes).merge(&found.notes);
            }
            held => {
                if let Some(held) = held {
                    Arc::make_mut(&mut found.notes).merge(&held.notes);
                }
                *held = Some(found);
                self.from = Some(place);
            }
        }
    }
}

#[cfg(test)]
#[path = "start_tests.rs"]
mod tests;
