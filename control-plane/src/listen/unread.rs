//! What still comes of a body when its request was answered.
//!
//! ```text
//! request ─▶ handler ─▶ answer
//!    body ──────┘ └ dropped before its end: read on for a while, and thrown away
//! ```
//!
//! A client that sends everything before it reads would lose the answer, a 413 above all: over
//! HTTP/1.1 the connection would be reset. So the rest is read, up to a number of bytes and for a
//! time.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use axum::body::{Body, HttpBody as _};
use axum::extract::{Request, State};
use axum::http::header::EXPECT;
use axum::middleware::Next;
use axum::response::Response;
use blaze_runtime::{Supervisor, TaskPolicy};
use bytes::Bytes;
use futures::stream;
use http_body_util::{BodyExt as _, StreamBody};

use super::{ListenLimits, Peer};

/// What reads on.
#[derive(Clone)]
pub(super) struct Reader {
    pub(super) limits: Arc<ListenLimits>,
    pub(super) supervisor: Supervisor,
}

/// The first middleware of a request.
pub(super) async fn read_on(
    State(reader): State<Reader>,
    request: Request,
    next: Next,
) -> Response {
    if let Some(peer) = request.extensions().get::<Peer>() {
        peer.has_asked.store(true, Ordering::Relaxed);
    }
    let waits = request.headers().contains_key(EXPECT);
    next.run(request.map(|body| reader.read_on(body, waits))).await
}

impl Reader {
    fn read_on(self, body: Body, waits: bool) -> Body {
        if body.is_end_stream() {
            return body;
        }
        let rest = Rest { body, waits, reader: self };
        Body::new(StreamBody::new(stream::unfold(rest, |mut rest| async {
            rest.waits = false;
            let frame = rest.body.frame().await;
            if !matches!(frame, Some(Ok(_))) {
                rest.body = Body::empty();
            }
            Some((frame?, rest))
        })))
    }
}

/// What is left of a body.
struct Rest {
    body: Body,
    /// `Expect: 100-continue`: the client waits to be asked for the body, and reading is asking.
    waits: bool,
    reader: Reader,
}

impl Drop for Rest {
    fn drop(&mut self) {
        let body = std::mem::take(&mut self.body);
        if self.waits || body.is_end_stream() {
            return;
        }
        let limits = Arc::clone(&self.reader.limits);
        let reading = async move {
            // Over the time it is dropped, as it would have been at once.
            let _ = tokio::time::timeout(limits.unread_time, read(body, limits.unread_bytes)).await;
        };
        self.reader.supervisor.spawn("rest of a body", TaskPolicy::MayEnd, reading);
    }
}

async fn read(mut body: Body, most: usize) {
    let mut left = most;
    while let Some(Ok(frame)) = body.frame().await {
        let bytes = frame.data_ref().map_or(0, Bytes::len);
        let Some(rest) = left.checked_sub(bytes) else { return };
        left = rest;
    }
}
