//! What the worker starts from: of one store the copy with the higher revision, of two stores the later one; notes of both.
//!
//! A copy that could not be read in time is read before it is first written ([`Target::is_read`], [`Found`](super::Found)).

use std::sync::Arc;
use std::time::Duration;

use super::{CopyError, Loaded, LocalCopy, Target};

/// How long the database is waited for where the file has something: services get their last configuration within two
/// seconds, also while the database is away.
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

/// Reads both copies and takes the newer one.
pub async fn choose(file: Option<Arc<dyn LocalCopy>>, database: Option<Arc<dyn LocalCopy>>) -> Start {
    let mut start = Start::default();
    if let Some(file) = file {
        let loaded = file.load().await;
        start.take(file, loaded);
    }
    if let Some(database) = database {
        let limit = match start.loaded {
            Some(_) => DATABASE_LIMIT,
            None => DATABASE_LIMIT * PATIENT,
        };
        let loaded = tokio::time::timeout(limit, database.load()).await;
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
        self.targets.push(Target { copy, is_read });
        let Some(mut found) = found else { return };
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
