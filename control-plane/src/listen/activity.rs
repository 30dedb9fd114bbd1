//! What goes on in one connection: requests that run, answers that the client does not take, silence.

use std::collections::HashMap;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use axum::body::Body;
use bytes::Bytes;
use hyper::body::{Body as HttpBody, Frame, SizeHint};
use parking_lot::Mutex;
use tokio::time::Instant;

use super::ListenLimits;

/// Why a connection should end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Trouble {
    /// It has brought no request at all.
    NoRequest,
    /// It has brought none for long.
    Idle,
    /// An answer is not taken.
    Stalled,
}

/// Shared by the connection and its requests.
pub(super) struct Activity {
    state: Mutex<State>,
}

struct State {
    running: usize,
    /// Whether there was ever a request.
    has_served: bool,
    /// When the last request ended, or the connection began.
    since: Instant,
    next_id: u64,
    /// Requests whose answer has a part that is not taken yet, with the time at which it was offered.
    offered: HashMap<u64, Instant>,
}

impl Activity {
    pub(super) fn new() -> Arc<Self> {
        Arc::new(Self {
            state: Mutex::new(State {
                running: 0,
                has_served: false,
                since: Instant::now(),
                next_id: 0,
                offered: HashMap::new(),
            }),
        })
    }

    /// A request has come; it runs until what is given back is dropped.
    pub(super) fn begin(self: &Arc<Self>) -> Running {
        let mut state = self.state.lock();
        state.running += 1;
        state.has_served = true;
        state.next_id += 1;
        Running {
            activity: Arc::clone(self),
            id: state.next_id,
        }
    }

    pub(super) fn has_served(&self) -> bool {
        self.state.lock().has_served
    }

    /// Waits until there is a reason to end the connection.
    pub(super) async fn trouble(&self, limits: &ListenLimits) -> Trouble {
        loop {
            let next = match self.look(limits, Instant::now()) {
                Ok(next) => next,
                Err(trouble) => return trouble,
            };
            tokio::time::sleep_until(next).await;
        }
    }

    /// When to look again, unless there is a reason now. What begins later is not due before that time.
    fn look(&self, limits: &ListenLimits, now: Instant) -> Result<Instant, Trouble> {
        let state = self.state.lock();
        let mut next = now + limits.stream_stall.min(limits.idle_timeout);
        if let Some(oldest) = state.offered.values().min() {
            let end = *oldest + limits.stream_stall;
            if end <= now {
                return Err(Trouble::Stalled);
            }
            next = next.min(end);
        }
        if state.running == 0 {
            let (quiet, trouble) = if state.has_served {
                (limits.idle_timeout, Trouble::Idle)
            } else {
                (limits.head_timeout, Trouble::NoRequest)
            };
            let end = state.since + quiet;
            if end <= now {
                return Err(trouble);
            }
            next = next.min(end);
        }
        Ok(next)
    }

    /// Waits until no request has run for a while.
    pub(super) async fn quiet(&self, while_for: std::time::Duration) {
        loop {
            let next = {
                let (state, now) = (self.state.lock(), Instant::now());
                match state.running {
                    0 if state.since + while_for <= now => return,
                    0 => state.since + while_for,
                    _ => now + while_for,
                }
            };
            tokio::time::sleep_until(next).await;
        }
    }
}

/// One request, until its answer is handed over.
pub(super) struct Running {
    activity: Arc<Activity>,
    id: u64,
}

impl Running {
    fn offered(&self) {
        self.activity.state.lock().offered.insert(self.id, Instant::now());
    }

    fn taken(&self) {
        self.activity.state.lock().offered.remove(&self.id);
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let mut state = self.activity.state.lock();
        state.offered.remove(&self.id);
        state.running = state.running.saturating_sub(1);
        state.since = Instant::now();
    }
}

/// The body of an answer. The connection asks it for the next part only when the client has taken enough of those before.
pub(super) struct WatchedBody {
    body: Body,
    running: Running,
    has_offered: bool,
}

impl WatchedBody {
    pub(super) fn new(body: Body, running: Running) -> Self {
        Self {
            body,
            running,
            has_offered: false,
        }
    }
}

impl HttpBody for WatchedBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        if std::mem::take(&mut self.has_offered) {
            self.running.taken();
        }
        let frame = Pin::new(&mut self.body).poll_frame(context);
        // Of an answer in one part nothing is left to ask for.
        if matches!(frame, Poll::Ready(Some(Ok(_)))) && !self.body.is_end_stream() {
            self.has_offered = true;
            self.running.offered();
        }
        frame
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[tokio::test]
    async fn silence_and_stalls_are_found_when_due() {
        let limits = ListenLimits::default();
        let activity = Activity::new();
        let start = Instant::now();
        let after = |seconds| start + Duration::from_secs(seconds);
        assert!(activity.look(&limits, after(29)).is_ok());
        assert_eq!(activity.look(&limits, after(31)), Err(Trouble::NoRequest));
        let running = activity.begin();
        assert!(activity.look(&limits, after(500)).is_ok(), "a request may take long");
        running.offered();
        assert!(activity.look(&limits, after(599)).is_ok());
        assert_eq!(activity.look(&limits, after(601)), Err(Trouble::Stalled));
        running.taken();
        assert!(activity.look(&limits, after(601)).is_ok());
        running.offered();
        drop(running);
        assert!(activity.has_served());
        assert!(activity.look(&limits, after(299)).is_ok());
        assert_eq!(activity.look(&limits, after(301)), Err(Trouble::Idle));
        activity.quiet(Duration::from_millis(1)).await;
    }
}
