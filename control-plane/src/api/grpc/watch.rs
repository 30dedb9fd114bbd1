//! The stream of a watch.
//!
//! ```text
//! core::WatchStream ─ Commit ─────▶ WatchResponse.commit
//!                   ─ Bookmark ───▶ WatchResponse.bookmark
//!                   ─ End(None) ──▶ OK
//!                   ─ End(why) ───▶ status with details
//! ```

use std::future::ready;
use std::pin::Pin;

use blaze_proto::v1;
use blaze_proto::v1::watch_response::Event;
use futures::{Stream, StreamExt as _};
use tonic::Status;

use super::{outgoing, status};
use crate::core::WatchItem;

/// What the client gets, until the first refusal or the end.
pub(super) type Responses = Pin<Box<dyn Stream<Item = Result<v1::WatchResponse, Status>> + Send>>;

/// `held` (what counts the watch as open) is dropped with the stream.
pub(super) fn responses<S, H>(items: S, held: H, request_id: String) -> Responses
where
    S: Stream<Item = WatchItem> + Send + 'static,
    H: Send + 'static,
{
    let responses =
        items.scan((held, request_id), |(_, request_id), item| ready(response(item, request_id)));
    Box::pin(responses)
}

/// `None`: the stream ends well.
fn response(item: WatchItem, request_id: &str) -> Option<Result<v1::WatchResponse, Status>> {
    let event = match item {
        WatchItem::Commit(commit) => Event::Commit(outgoing::commit(&commit)),
        WatchItem::Bookmark(revision) => Event::Bookmark(revision),
        WatchItem::End(None) => return None,
        WatchItem::End(Some(problem)) => {
            return Some(Err(status::from_problem(&problem, request_id)));
        }
    };
    Some(Ok(v1::WatchResponse { event: Some(event) }))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use blaze_domain::config::{Code, Problem};
    use futures::stream;

    use super::*;

    #[tokio::test]
    async fn a_stream_ends_well_or_with_its_reason_and_frees_its_place() {
        let items = |end| {
            stream::iter([WatchItem::Bookmark(7), WatchItem::End(end), WatchItem::Bookmark(8)])
        };

        let all: Vec<_> = responses(items(None), (), "r1".into()).collect().await;
        let [Ok(only)] = all.as_slice() else {
            panic!("{all:?}");
        };
        assert_eq!(only.event, Some(Event::Bookmark(7)));

        let held = Arc::new(());
        let slow = Problem::new(Code::WatchTooSlow, "1,000 events behind").at(9);
        let mut stream = responses(items(Some(Box::new(slow))), Arc::clone(&held), "r1".into());
        assert!(stream.next().await.unwrap().is_ok());
        let status = stream.next().await.unwrap().unwrap_err();
        assert_eq!(status.code(), tonic::Code::Aborted);
        assert_eq!(status::code_of(&status), Some(Code::WatchTooSlow));

        assert_eq!(Arc::strong_count(&held), 2);
        drop(stream);
        assert_eq!(Arc::strong_count(&held), 1);
    }
}
