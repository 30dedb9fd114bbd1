//! Hearing of other processes' commits.
//!
//! A change stream only wakes: what there is, is read from the log. So it may fail, repeat itself
//! or come late without harm; while there is none, the log is looked at every 100 ms. A process
//! that is alone on the database needs none: it hears of another one before that writes
//! ([`super::members`]). It may keep an idle one all the same, for speed.

use std::time::Duration;

use futures::StreamExt as _;
use mongodb::bson::{Document, doc};
use mongodb::change_stream::ChangeStream;
use mongodb::change_stream::event::ChangeStreamEvent;
use tokio::time::{Instant, sleep, sleep_until, timeout};

use super::MongoStore;
use super::client::{QUICK, limited};

/// Between two looks at the log without a change stream.
const POLL: Duration = Duration::from_millis(100);
/// A stream may be cut without a word from the network.
const AT_LATEST: Duration = Duration::from_secs(1);
/// Looks at whether it is still alone until the log is read all the same: a commit may be found
/// there of which it was not known whether it was written.
const LOOKS: usize = 10;

/// A change stream that is open.
pub(super) enum Stream {
    /// Of the commits of others.
    Others(Changes),
    /// Of a collection in which nothing happens.
    Idle(Changes),
}

type Changes = ChangeStream<ChangeStreamEvent<Document>>;

impl MongoStore {
    /// Returns when another process may have committed.
    pub(super) async fn wait_for_others(&self) {
        let mut place = self.stream.lock().await;
        if let Some(members) = self.members.as_ref().filter(|members| members.is_alone()) {
            self.open_idle(&mut place).await;
            for _ in 0..LOOKS {
                idle(&mut place).await;
                if !members.is_alone() {
                    break;
                }
            }
            return;
        }
        let Some(Stream::Others(stream)) = place.as_mut() else {
            *place = None;
            match self.open_stream().await {
                // What was committed before it stood is not told by it.
                Ok(stream) => *place = Some(Stream::Others(stream)),
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

    /// A member that is alone in its set makes a durable write wait for the next whole millisecond,
    /// unless somebody follows its oplog, as other members would. So this process does, where it
    /// costs least: a stream of the commits would cost the database as much as they do, all of
    /// which are our own.
    async fn open_idle(&self, place: &mut Option<Stream>) {
        let tables = self.tables();
        if matches!(place, Some(Stream::Idle(_))) {
            return;
        }
        *place = None;
        if tables.is_single {
            match limited(QUICK, tables.migrations.watch()).await {
                Ok(stream) => *place = Some(Stream::Idle(stream)),
                Err(error) => {
                    tracing::debug!(
                        %error,
                        "no idle change stream: writes wait for whole milliseconds",
                    );
                }
            }
        }
    }

    async fn open_stream(&self) -> Result<Changes, crate::store::StoreError> {
        let tables = self.tables();
        let pipeline = [
            doc! { "$match": { "operationType": "insert",
            "fullDocument.writer": { "$ne": &self.writer } } },
            doc! { "$project": { "fullDocument": 0 } },
        ];
        limited(QUICK, tables.events.watch().pipeline(pipeline)).await
    }
}

/// Waits 100 ms, and keeps an idle stream going.
async fn idle(place: &mut Option<Stream>) {
    let until = Instant::now() + POLL;
    if let Some(Stream::Idle(stream)) = place
        && let Ok(Some(Err(_)) | None) = timeout(POLL, stream.next()).await
    {
        *place = None;
    }
    sleep_until(until).await;
}
