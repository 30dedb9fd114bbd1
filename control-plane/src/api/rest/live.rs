//! `GET /live`: a picture of the fleet and what changes of it, as server-sent events.
//!
//! ```text
//! core: LiveStream ──item──▶ bytes ──▶ body of the answer, when the client takes more
//!   Snapshot  event: snapshot ⏎ data: {…}
//!   Delta     event: delta ⏎ data: merge patch
//!   Bookmark  event: bookmark ⏎ data: {"revision":419}
//!   End       event: error ⏎ data: {problem}, or nothing
//! ```

use std::convert::Infallible;
use std::time::Duration;

use axum::body::Body;
use axum::response::Response;
use blaze_domain::config::Problem;
use blaze_domain::{LayerName, NodeName};
use bytes::Bytes;
use futures::{StreamExt as _, stream};
use serde_json::json;

use super::frame::Visit;
use super::operation::Call;
use super::query::Param;
use super::watch::{MAX_TIMEOUT_S, retry_line, streaming};
use crate::core::{LiveItem, LiveQuery, live_view};
use crate::status::limits::{DEFAULT_PERIOD_MS, PERIOD_MS};

/// What `view` may be.
pub(super) const VIEWS: &[&str] = &["fleet", "node", "topic", "latency"];

/// `GET /live`
pub(super) async fn open(call: &Call) -> Result<Response, Problem> {
    let query = query(call)?;
    let read = call.query.read_options()?;
    let options = &call.rest().options;
    let slot = options.limits.open_watch(&call.caller.claims.subject)?;
    let answer = call.service().live(&call.caller, query, &read).await?;
    let (visit, held) = (call.visit.clone(), (slot, options.metrics.watcher()));
    let events = answer.value.filter_map(move |item| {
        // Counted as long as the stream is there.
        let _ = &held;
        std::future::ready(event(item, &visit))
    });
    let events = stream::iter([retry_line()]).chain(events).map(Ok::<_, Infallible>);
    Ok(streaming(Body::from_stream(events), answer.revision))
}

fn query(call: &Call) -> Result<LiveQuery, Problem> {
    let query = &call.query;
    let node = query.name::<NodeName>(Param::LiveNode)?;
    let topic = query.topic(Param::LiveTopic)?.map(|topic| topic.to_string());
    let period = query.number(Param::PeriodMs, *PERIOD_MS.start(), *PERIOD_MS.end())?;
    let timeout_s = query.number(Param::TimeoutS, 1, MAX_TIMEOUT_S)?;
    Ok(LiveQuery {
        view: live_view(query.word(Param::LiveView, VIEWS)?, node.as_ref(), topic)?,
        layer: query.name::<LayerName>(Param::Layer)?,
        node,
        label_selector: query.text(Param::LabelSelector).map(str::to_owned),
        period: Duration::from_millis(period.unwrap_or(DEFAULT_PERIOD_MS)),
        timeout_s: timeout_s.and_then(|seconds| u32::try_from(seconds).ok()),
    })
}

/// JSON is one line, whatever its texts hold. `None`: the stream ends well.
fn event(item: LiveItem, visit: &Visit) -> Option<Bytes> {
    let (name, data) = match item {
        LiveItem::Snapshot(picture) => ("snapshot", picture),
        LiveItem::Delta(patch) => ("delta", patch),
        LiveItem::Bookmark(revision) => ("bookmark", json!({ "revision": revision })),
        LiveItem::End(problem) => ("error", problem?.to_json(&visit.path, &visit.request_id)),
    };
    Some(Bytes::from(format!("event: {name}\ndata: {data}\n\n")))
}
