//! Transactions whose process has gone.
//!
//! A process that is killed within a transaction leaves it open on the server, which ends it only
//! after `transactionLifetimeLimitSeconds` (60 s). Until then it holds the next revision, and
//! nobody can write. So a writer that was held up for longer than a live process takes ends those
//! of our transactions that nobody works on. Should one be of a live process all the same, its next
//! statement fails, and it tries again: nothing but time is lost.

use futures::TryStreamExt as _;
use mongodb::bson::{Bson, Document, doc};

use super::client::{QUICK, Tables, limited, limited_steps};
use super::errors::store_error;
use crate::store::StoreError;

/// A transaction in which nothing was done for so long is not worked on, in microseconds.
const IDLE_MICROS: i64 = 300_000;

/// Ends them. What does not work is told in the log: then the server does it, later.
pub(super) async fn end_idle_transactions(tables: &Tables) {
    match end(tables).await {
        Ok(0) => {
            tracing::debug!("another transaction holds the next revision, and is being worked on");
        }
        Ok(count) => tracing::info!(count, "ended transactions of processes that are gone"),
        Err(error) => tracing::warn!(
            %error,
            "a transaction of another process holds up all writes, and cannot be ended here: the \
             server ends it within 60 s"
        ),
    }
}

async fn end(tables: &Tables) -> Result<usize, StoreError> {
    let pipeline = [
        doc! { "$currentOp": { "allUsers": false, "idleSessions": true } },
        doc! { "$match": { "type": "idleSession",
        "transaction.timeInactiveMicros": { "$gte": IDLE_MICROS } } },
    ];
    let admin = tables.admin();
    let sessions = limited_steps(QUICK, async {
        let mut cursor = admin.aggregate(pipeline).await.map_err(store_error)?;
        let mut sessions = Vec::new();
        while let Some(found) = cursor.try_next().await.map_err(store_error)? {
            if is_ours(&found, &tables.app_name) {
                sessions.extend(session_id(&found));
            }
        }
        Ok(sessions)
    })
    .await?;
    let count = sessions.len();
    if count > 0 {
        limited(QUICK, admin.run_command(doc! { "killSessions": sessions })).await?;
    }
    Ok(count)
}

fn is_ours(found: &Document, app_name: &str) -> bool {
    let at_top = found.get_str("appName").ok();
    let client = found.get_document("clientMetadata").ok();
    let within =
        client.and_then(|client| client.get_document("application").ok()?.get_str("name").ok());
    at_top == Some(app_name) || within == Some(app_name)
}

/// Without the user's part, which the server adds.
fn session_id(found: &Document) -> Option<Bson> {
    let id = found.get_document("lsid").ok()?.get("id")?;
    Some(Bson::Document(doc! { "id": id }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_our_own_transactions_are_ended() {
        let ours = doc! { "appName": "blaze-config/x", "lsid": { "id": 7, "uid": 8 } };
        assert!(is_ours(&ours, "blaze-config/x"));
        assert!(!is_ours(&ours, "blaze-config/y"));
        assert!(is_ours(&doc! { "clientMetadata": { "application": { "name": "a" } } }, "a"));
        assert!(!is_ours(&doc! {}, "a"));
        assert_eq!(session_id(&ours), Some(Bson::Document(doc! { "id": 7 })));
    }
}
