//! What still comes of a body when its request was answered.
//!
//! ```text
//! request ─▶ handler ─▶ answer
//!    body ──────┘ └ dropped before its end: read on for a while, and forgotten
//! ```
//!
//! Who sends everything before it reads would lose the answer, a 413 above all: over HTTP/1.1 the connection would be
//! reset, over HTTP/2 the stream. So what is left is read, up to a number of bytes and for a time; then the client loses
//! its connection or stream after all.

use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::Bytes;
use http_body_util::BodyExt as _;
use hyper::body::{Body as HttpBody, Frame, Incoming, SizeHint};
use hyper::header::{EXPECT, HeaderMap};
use hyper::rt::Executor;

use super::connection::StreamTasks;

/// What is read of one body that nobody wants.
#[derive(Debug, Clone, Copy)]
pub(super) struct Patience {
    pub(super) bytes: usize,
    pub(super) time: Duration,
}

/// The body of a request. Dropped before its end, it is read on.
pub(super) struct ReadOn {
    /// `None` after its end.
    body: Option<Incoming>,
    /// `Expect: 100-continue`: the client waits to be asked for the body, and reading is asking.
    waits: bool,
    patience: Patience,
    tasks: StreamTasks,
}

impl ReadOn {
    pub(super) fn new(body: Incoming, headers: &HeaderMap, patience: Patience, tasks: StreamTasks) -> Self {
        Self {
            body: Some(body),
            waits: headers.contains_key(EXPECT),
            patience,
            tasks,
        }
    }
}

impl HttpBody for ReadOn {
    type Data = Bytes;
    type Error = hyper::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, hyper::Error>>> {
        self.waits = false;
        let Some(body) = &mut self.body else {
            return Poll::Ready(None);
        };
        let frame = Pin::new(body).poll_frame(context);
        if matches!(frame, Poll::Ready(None | Some(Err(_)))) {
            self.body = None;
        }
        frame
    }

    fn is_end_stream(&self) -> bool {
        self.body.as_ref().is_none_or(HttpBody::is_end_stream)
    }

    fn size_hint(&self) -> SizeHint {
        self.body
            .as_ref()
            .map_or_else(|| SizeHint::with_exact(0), HttpBody::size_hint)
    }
}

impl Drop for ReadOn {
    fn drop(&mut self) {
        let Some(body) = self.body.take().filter(|body| !self.waits && !body.is_end_stream()) else {
            return;
        };
        let Patience { bytes, time } = self.patience;
        self.tasks.execute(async move {
            // Over the time it is dropped, as it would have been at once.
            let _ = tokio::time::timeout(time, read(body, bytes)).await;
        });
    }
}

async fn read(mut body: Incoming, most: usize) {
    let mut left = most;
    while let Some(Ok(frame)) = body.frame().await {
        let bytes = frame.data_ref().map_or(0, Bytes::len);
        let Some(rest) = left.checked_sub(bytes) else { return };
        left = rest;
    }
}
