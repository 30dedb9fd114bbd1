//! Small transactions beside the log.

use std::time::Duration;

use futures::future::BoxFuture;
use mongodb::ClientSession;
use mongodb::error::{Error, TRANSIENT_TRANSACTION_ERROR, UNKNOWN_TRANSACTION_COMMIT_RESULT};
use tokio::time::Instant;

use super::MongoStore;
use super::client::{Tables, USUAL, limited, limited_steps};
use super::commit::begin;
use super::errors::store_error;
use crate::store::StoreError;

/// Between two tries.
const PAUSE: Duration = Duration::from_millis(20);

impl MongoStore {
    /// Does something whole or not at all, and tries again where another transaction was in the
    /// way. `false` of the work undoes it.
    ///
    /// # Errors
    /// [`StoreError`]. If it is [`StoreError::Unavailable`], it may have been done.
    pub(super) async fn in_transaction<F>(&self, work: F) -> Result<bool, StoreError>
    where
        F: for<'a> Fn(
                &'a Tables,
                &'a mut ClientSession,
            ) -> BoxFuture<'a, mongodb::error::Result<bool>>
            + Send
            + Sync,
    {
        let tables = self.tables();
        let until = Instant::now() + USUAL;
        let mut session = limited(USUAL, tables.client.start_session()).await?;
        loop {
            let tried =
                limited_steps(USUAL, async { Ok(once(&tables, &mut session, &work).await) }).await;
            match tried {
                Ok(Ok(done)) => return Ok(done),
                Ok(Err(error))
                    if error.contains_label(TRANSIENT_TRANSACTION_ERROR)
                        && Instant::now() < until =>
                {
                    tokio::time::sleep(PAUSE).await;
                }
                Ok(Err(error)) => return Err(store_error(error)),
                Err(error) => return Err(error),
            }
        }
    }
}

async fn once<F>(tables: &Tables, session: &mut ClientSession, work: &F) -> Result<bool, Error>
where
    F: for<'a> Fn(&'a Tables, &'a mut ClientSession) -> BoxFuture<'a, mongodb::error::Result<bool>>
        + Send
        + Sync,
{
    begin(session).await?;
    let done = work(tables, session).await;
    if !matches!(done, Ok(true)) {
        session.abort_transaction().await?;
        return done;
    }
    match session.commit_transaction().await {
        Err(error) if error.contains_label(UNKNOWN_TRANSACTION_COMMIT_RESULT) => {
            session.commit_transaction().await?;
        }
        result => result?,
    }
    Ok(true)
}
