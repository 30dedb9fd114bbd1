//! `GET /watch`: commits as server-sent events.
//!
//! ```text
//! core: WatchStream ──item──▶ Events ──bytes──▶ body of the answer
//!   Commit    id: 413 ⏎ event: change ⏎ data: {…}          the JSON is shared by all who watch the same
//!   Bookmark  id: 419 ⏎ event: bookmark ⏎ data: {"revision":419}
//!   End       event: error ⏎ data: {problem}, or nothing   then the stream ends
//! ```

use std::collections::VecDeque;
use std::convert::Infallible;

use axum::body::Body;
use axum::http::StatusCode;
use axum::http::header::{CONTENT_TYPE, HeaderName};
use axum::response::Response;
use blaze_domain::config::{Kind, Problem};
use bytes::Bytes;
use futures::{Stream, StreamExt, stream};
use serde_json::json;

use super::frame::Visit;
use super::headers::last_event_id;
use super::negotiate::EVENT_STREAM;
use super::operation::Call;
use super::query::Param;
use super::reply;
use crate::api::json as answers;
use crate::api::limits::WatchSlot;
use crate::core::{WatchItem, WatchQuery};
use crate::metrics::OpenGauge;

/// Tells reverse proxies to hand on every event at once.
const X_ACCEL_BUFFERING: HeaderName = HeaderName::from_static("x-accel-buffering");
/// Milliseconds until a client that was cut off comes back, drawn once per stream: clients that are
/// cut off together do not come back together.
const RETRY_MS: std::ops::RangeInclusive<u32> = 1000..=5000;
/// Longest a watch may be asked for, in seconds.
pub(super) const MAX_TIMEOUT_S: u64 = 3600;
/// An event of so many bytes is sent in one piece; a longer one shares its JSON with the other
/// watchers.
const COPIED_BYTES: usize = 4096;

/// `GET /watch`
pub(super) async fn open(call: &Call) -> Result<Response, Problem> {
    let query = query(call)?;
    let read = call.query.read_options()?;
    let slot = call.rest().options.limits.open_watch(&call.caller.claims.subject)?;
    let answer = call.service().watch_with(&call.caller, &query, &read).await?;
    let events = Events {
        items: answer.value,
        visit: call.visit.clone(),
        ready: VecDeque::from([retry_line()]),
        ended: false,
        _slot: slot,
        _open: call.rest().options.metrics.watcher(),
    };
    Ok(streaming(Body::from_stream(events.into_stream()), answer.revision))
}

/// The answer that events go on in.
pub(super) fn streaming(events: Body, revision: u64) -> Response {
    let mut response = Response::new(events);
    *response.status_mut() = StatusCode::OK;
    reply::set(&mut response, CONTENT_TYPE, EVENT_STREAM);
    reply::set(&mut response, X_ACCEL_BUFFERING, "no");
    reply::set(&mut response, super::headers::BLAZE_REVISION, &revision.to_string());
    response
}

/// The first line of a stream.
pub(super) fn retry_line() -> Bytes {
    Bytes::from(format!("retry: {}\n", rand::random_range(RETRY_MS)))
}

fn query(call: &Call) -> Result<WatchQuery, Problem> {
    let query = &call.query;
    let kinds: Vec<&'static str> = Kind::ALL.iter().map(|kind| kind.as_str()).collect();
    let kind = query.word(Param::Kind, &kinds)?;
    let timeout_s = query.number(Param::TimeoutS, 1, MAX_TIMEOUT_S)?;
    let since = query.revision(Param::Since)?;
    Ok(WatchQuery {
        since: last_event_id(&call.headers)?.or(since),
        kind: kind.and_then(|kind| kind.parse().ok()),
        name: query.name::<blaze_domain::DocumentName>(Param::Name)?.map(|name| name.to_string()),
        service: query.name(Param::Service)?,
        layer: query.name(Param::Layer)?,
        label_selector: query.text(Param::LabelSelector).map(str::to_owned),
        timeout_s: timeout_s.and_then(|seconds| u32::try_from(seconds).ok()),
    })
}

/// The bytes of one watch.
struct Events<S> {
    items: S,
    visit: Visit,
    /// Made and not sent yet.
    ready: VecDeque<Bytes>,
    ended: bool,
    _slot: WatchSlot,
    _open: OpenGauge,
}

impl<S: Stream<Item = WatchItem> + Send + Unpin + 'static> Events<S> {
    fn into_stream(self) -> impl Stream<Item = Result<Bytes, Infallible>> + Send + 'static {
        stream::unfold(self, |mut events| async move {
            let bytes = events.next().await?;
            Some((Ok(bytes), events))
        })
    }

    async fn next(&mut self) -> Option<Bytes> {
        loop {
            if let Some(bytes) = self.ready.pop_front() {
                return Some(bytes);
            }
            if self.ended {
                return None;
            }
            match self.items.next().await {
                Some(item) => self.push(item),
                None => self.ended = true,
            }
        }
    }

    fn push(&mut self, item: WatchItem) {
        match item {
            WatchItem::Commit(commit) => {
                let data = answers::watch_commit(&commit).clone();
                self.event(Some(commit.revision), "change", data);
            }
            WatchItem::Bookmark(revision) => {
                let data = json!({ "revision": revision }).to_string();
                self.event(Some(revision), "bookmark", Bytes::from(data));
            }
            WatchItem::End(None) => self.ended = true,
            WatchItem::End(Some(problem)) => {
                let data = problem.to_json(&self.visit.path, &self.visit.request_id).to_string();
                self.event(None, "error", Bytes::from(data));
                self.ended = true;
            }
        }
    }

    /// JSON is one line, whatever its texts hold.
    fn event(&mut self, id: Option<u64>, name: &str, data: Bytes) {
        let head = match id {
            Some(id) => format!("id: {id}\nevent: {name}\ndata: "),
            None => format!("event: {name}\ndata: "),
        };
        if data.len() <= COPIED_BYTES {
            let mut whole = head.into_bytes();
            whole.extend_from_slice(&data);
            whole.extend_from_slice(b"\n\n");
            self.ready.push_back(Bytes::from(whole));
        } else {
            self.ready.extend([Bytes::from(head), data, Bytes::from_static(b"\n\n")]);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::net::{IpAddr, Ipv4Addr};
    use std::sync::{Arc, OnceLock};

    use blaze_domain::config::{Code, Document, Timestamp};
    use blaze_domain::node_file::LimitsSection;
    use serde_json::Value;

    use super::*;
    use crate::api::limits::ApiLimits;
    use crate::core::{WatchCommit, WatchOp};
    use crate::metrics::ApiMetrics;

    fn commit(revision: u64, padding: usize) -> WatchItem {
        let document = Arc::new(Document {
            key: "Node/robot-1".parse().unwrap(),
            uid: String::new(),
            revision,
            create_time: Timestamp::default(),
            update_time: Timestamp::default(),
            updated_by: "line\nbreak".to_owned(),
            labels: Default::default(),
            annotations: Default::default(),
            spec: Arc::new(json!({ "layer": "x".repeat(padding) })),
            status: None,
        });
        WatchItem::Commit(Arc::new(WatchCommit {
            revision,
            previous: 0,
            time: Timestamp::default(),
            subject: "ops".to_owned(),
            changes: vec![(WatchOp::Update, document)],
            json: OnceLock::new(),
            wire: OnceLock::new(),
        }))
    }

    async fn text(items: Vec<WatchItem>) -> String {
        let limits = ApiLimits::new(&LimitsSection {
            in_flight: 1,
            watches_per_subject: 1,
            requests_per_s: 0,
            auth_failures_per_s: 0,
        });
        let events = Events {
            items: stream::iter(items),
            visit: Visit {
                request_id: "r-1".into(),
                address: IpAddr::V4(Ipv4Addr::LOCALHOST),
                path: "/api/v1/watch".into(),
                deadline: tokio::time::Instant::now(),
            },
            ready: VecDeque::from([Bytes::from_static(b"retry: 2731\n")]),
            ended: false,
            _slot: limits.open_watch("ops").unwrap(),
            _open: ApiMetrics::new().unwrap().watcher(),
        };
        let chunks: Vec<Bytes> = events.into_stream().map(Result::unwrap).collect().await;
        String::from_utf8(chunks.concat()).unwrap()
    }

    #[tokio::test]
    async fn events_have_the_form_of_the_contract() {
        let text = text(vec![
            commit(413, 1),
            WatchItem::Bookmark(419),
            WatchItem::End(None),
            commit(420, 1),
        ])
        .await;
        let lines: Vec<&str> = text.split('\n').collect();
        assert_eq!(lines[..3], ["retry: 2731", "id: 413", "event: change"]);
        let event: Value = serde_json::from_str(lines[3].strip_prefix("data: ").unwrap()).unwrap();
        assert_eq!(event["changes"][0]["document"]["updated_by"], "line\nbreak");
        assert_eq!(
            lines[4..],
            ["", "id: 419", "event: bookmark", "data: {\"revision\":419}", "", ""]
        );
    }

    #[tokio::test]
    async fn a_long_event_is_whole_too() {
        let text = text(vec![commit(1, COPIED_BYTES)]).await;
        let data = text.lines().find_map(|line| line.strip_prefix("data: ")).unwrap();
        let event: Value = serde_json::from_str(data).unwrap();
        assert_eq!(
            event["changes"][0]["document"]["spec"]["layer"].as_str().unwrap().len(),
            COPIED_BYTES
        );
        assert!(text.ends_with("}\n\n"));
    }

    #[tokio::test]
    async fn trouble_ends_the_stream_without_an_id() {
        let problem = Problem::new(Code::WatchTooSlow, "1,000 events behind").at(500);
        let text = text(vec![WatchItem::End(Some(Box::new(problem))), commit(1, 1)]).await;
        let (head, data) = text.split_once("data: ").unwrap();
        assert_eq!(head, "retry: 2731\nevent: error\n");
        let problem: Value = serde_json::from_str(data.trim_end()).unwrap();
        assert_eq!(
            (&problem["code"], &problem["request_id"]),
            (&json!("watch_too_slow"), &json!("r-1"))
        );
    }
}
