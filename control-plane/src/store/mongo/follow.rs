//! Hearing of other processes' commits.
//!
//! A change stream only wakes: what there is, is read from the log. So it may fail, repeat itself or come late without
//! harm; while there is none, the log is looked at every 100 ms. A process that is alone on the database needs none: it
//! hears of another one before that writes ([`super::members`]).

use std::time::Duration;

use futures::StreamExt as _;
use mongodb::bson::{Document, doc};
use mongodb::change_stream::ChangeStream;
use mongodb::change_stream::event::ChangeStreamEvent;
use tokio::time::{sleep, timeout};

use super::MongoStore;
use super::client::{QUICK, limited};

/// Between two looks at the log without a change stream.
const POLL: Duration = Duration::from_millis(100);
/// A stream may be cut without a word from the network.
const AT_LATEST: Duration = Duration::from_secs(1);
/// Looks at whether it is still alone until the log is read all the same: a commit may be found there of which it was not
/// known whether it was written.
const LOOKS: usize = 10;

pub(super) type Stream = ChangeStream<ChangeStreamEvent<Document>>;

impl MongoStore {
    /// Returns when another process may have committed.
    pub(super) async fn wait_for_others(&self) {
        let mut place = self.stream.lock().await;
        if let Some(members) = self.members.as_ref().filter(|members| members.is_alone()) {
            // A stream would cost the database as much as the commits themselves, all of which are our own.
            *place = None;
            for _ in 0..LOOKS {
                sleep(POLL).await;
                if !members.is_alone() {
                    break;
                }
            }
            return;
        }
        let Some(stream) = place.as_mut() else {
            match self.open_stream().await {
                // What was committed before it stood is not told by it.
                Ok(stream) => *place = Some(stream),
                Err(error) => {
                    tracing::debug!(%error, "no change stream: looking at the log every 100 ms");
                    sleep(POLL).await;
                }
            }
            return;
        };
        match timeout(AT_LATEST, stream.next()).await {
            Ok(Some(Ok(_))) | Err(_) => {}
            Ok(Some(Err(_)) | None) => {
                *place = None;
                sleep(POLL).await;
            }
        }
    }

    async fn open_stream(&self) -> Result<Stream, crate::store::StoreError> {
        let pipeline = [
            doc! { "$match": { "operationType": "insert", "fullDocument.writer": { "$ne": &self.writer } } },
            doc! { "$project": { "fullDocument": 0 } },
        ];
        limited(QUICK, self.tables.events.watch().pipeline(pipeline)).await
    }
}
