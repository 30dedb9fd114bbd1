//! Bodies that are on their way: how many of one subject, and how much of them is held.
//!
//! ```text
//! body ─▶ metered ─▶ reader ─▶ whole ─▶ a place among the requests at work
//!            └ not there yet: counted for its subject, with its bytes, until it is whole or given up
//! ```
//!
//! Only what is whole takes a place among the requests at work, so that slow senders hold up themselves alone.

use std::collections::HashMap;
use std::error::Error;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use axum::BoxError;
use axum::body::{Body, HttpBody};
use blaze_domain::config::{Code, Problem};
use bytes::Bytes;
use hyper::body::{Frame, SizeHint};
use parking_lot::Mutex;

/// Bodies of one subject that are not whole yet.
const SUBJECT_BODIES: usize = 1_000;
/// Bytes of these (64 MiB): eight of the largest.
const SUBJECT_BYTES: usize = 64 * 1024 * 1024;
/// Bytes of all subjects together (512 MiB).
const ALL_BYTES: usize = 512 * 1024 * 1024;

/// What is on its way.
#[derive(Debug, Default)]
pub(super) struct Uploads {
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    bytes: usize,
    subjects: HashMap<String, Share>,
}

/// What one subject has of it.
#[derive(Debug, Default)]
struct Share {
    bodies: usize,
    bytes: usize,
}

impl Uploads {
    /// A body of a subject that counts for it while it is not whole.
    pub(super) fn metered(self: &Arc<Self>, subject: &str, body: Body) -> Body {
        Body::new(Metered {
            body,
            bytes: 0,
            counted: None,
            subject: subject.to_owned(),
            uploads: Arc::clone(self),
        })
    }

    fn begin(self: &Arc<Self>, subject: &str) -> Result<Counted, Problem> {
        let mut state = self.state.lock();
        let share = state.subjects.entry(subject.to_owned()).or_default();
        if share.bodies >= SUBJECT_BODIES {
            let detail =
                format!("{SUBJECT_BODIES} bodies of the subject are on their way: send them to their end first");
            return Err(Problem::new(Code::RateLimited, detail).retry_after(1));
        }
        share.bodies += 1;
        Ok(Counted {
            bytes: 0,
            subject: subject.to_owned(),
            uploads: Arc::clone(self),
        })
    }
}

/// A body as it counts for its subject, until it is dropped.
#[derive(Debug)]
struct Counted {
    bytes: usize,
    subject: String,
    uploads: Arc<Uploads>,
}

impl Counted {
    fn add(&mut self, bytes: usize) -> Result<(), Problem> {
        let mut state = self.uploads.state.lock();
        let all = state.bytes + bytes;
        if all > ALL_BYTES {
            let detail = "the service holds as much of bodies that are on their way as it may: try again";
            return Err(Problem::new(Code::Overloaded, detail).retry_after(1));
        }
        let Some(share) = state.subjects.get_mut(&self.subject) else {
            return Ok(());
        };
        if share.bytes + bytes > SUBJECT_BYTES {
            let detail =
                format!("more than {SUBJECT_BYTES} bytes of the subject are on their way: send less at the same time");
            return Err(Problem::new(Code::RateLimited, detail).retry_after(1));
        }
        share.bytes += bytes;
        state.bytes = all;
        self.bytes += bytes;
        Ok(())
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        let mut state = self.uploads.state.lock();
        state.bytes = state.bytes.saturating_sub(self.bytes);
        if let Some(share) = state.subjects.get_mut(&self.subject) {
            share.bodies = share.bodies.saturating_sub(1);
            share.bytes = share.bytes.saturating_sub(self.bytes);
            if share.bodies == 0 {
                state.subjects.remove(&self.subject);
            }
        }
    }
}

struct Metered {
    body: Body,
    /// What came before it had to be waited for.
    bytes: usize,
    /// It had to be waited for.
    counted: Option<Counted>,
    subject: String,
    uploads: Arc<Uploads>,
}

impl Metered {
    fn wait(&mut self) -> Result<(), Problem> {
        if self.counted.is_none() {
            let mut counted = self.uploads.begin(&self.subject)?;
            counted.add(self.bytes)?;
            self.counted = Some(counted);
        }
        Ok(())
    }

    fn take(&mut self, bytes: usize) -> Result<(), Problem> {
        match &mut self.counted {
            Some(counted) => counted.add(bytes),
            None => {
                self.bytes += bytes;
                Ok(())
            }
        }
    }
}

impl HttpBody for Metered {
    type Data = Bytes;
    type Error = BoxError;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, BoxError>>> {
        let frame = match Pin::new(&mut self.body).poll_frame(context) {
            Poll::Pending => {
                return match self.wait() {
                    Ok(()) => Poll::Pending,
                    Err(problem) => Poll::Ready(Some(Err(problem.into()))),
                };
            }
            Poll::Ready(frame) => frame,
        };
        Poll::Ready(match frame {
            Some(Ok(frame)) => {
                let taken = self.take(frame.data_ref().map_or(0, Bytes::len));
                Some(taken.map(|()| frame).map_err(Into::into))
            }
            Some(Err(error)) => Some(Err(error.into())),
            None => {
                self.counted = None;
                None
            }
        })
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// The refusal that a failed reading of a metered body ends with, if it is one.
pub(super) fn refusal<'a>(error: &'a (dyn Error + 'static)) -> Option<&'a Problem> {
    let mut cause = Some(error);
    while let Some(error) = cause {
        if let Some(problem) = error.downcast_ref::<Problem>() {
            return Some(problem);
        }
        cause = error.source();
    }
    None
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use futures::{FutureExt as _, StreamExt as _, stream};
    use http_body_util::BodyExt as _;

    use super::*;

    /// Some bytes, and then it stands still.
    fn slow(bytes: usize) -> Body {
        let first = stream::iter([Ok::<_, Infallible>(Bytes::from(vec![0; bytes]))]);
        Body::from_stream(first.chain(stream::pending()))
    }

    #[test]
    fn what_is_whole_at_once_counts_for_nobody() {
        let uploads = Arc::<Uploads>::default();
        let mut body = uploads.metered("ops", Body::from("whole"));
        assert!(body.frame().now_or_never().unwrap().unwrap().is_ok());
        assert!(uploads.state.lock().subjects.is_empty());
    }

    #[test]
    fn slow_bodies_are_bounded_for_each_subject() {
        let uploads = Arc::<Uploads>::default();
        let mut open: Vec<Body> = (0..SUBJECT_BODIES).map(|_| uploads.metered("ops", slow(1))).collect();
        for body in &mut open {
            assert!(body.frame().now_or_never().unwrap().unwrap().is_ok());
            assert!(body.frame().now_or_never().is_none());
        }
        let begin = |subject: &str| {
            let mut body = uploads.metered(subject, slow(0));
            assert!(body.frame().now_or_never().unwrap().unwrap().is_ok());
            body.frame().now_or_never().map(|frame| frame.unwrap().unwrap_err())
        };
        let refused = begin("ops").unwrap();
        assert_eq!(refusal(&refused).unwrap().code, Code::RateLimited);
        assert!(begin("other").is_none(), "others go on");
        open.pop();
        assert!(begin("ops").is_none());
        drop(open);
        let state = uploads.state.lock();
        assert!(state.subjects.is_empty() && state.bytes == 0, "{state:?}");
    }

    #[test]
    fn their_bytes_are_bounded_too() {
        let uploads = Arc::<Uploads>::default();
        let mut first = uploads.begin("ops").unwrap();
        first.add(SUBJECT_BYTES).unwrap();
        let mut second = uploads.begin("ops").unwrap();
        assert_eq!(second.add(1).unwrap_err().code, Code::RateLimited);
        let others: Vec<Counted> = (1..ALL_BYTES / SUBJECT_BYTES)
            .map(|number| {
                let mut other = uploads.begin(&format!("s{number}")).unwrap();
                other.add(SUBJECT_BYTES).unwrap();
                other
            })
            .collect();
        let mut last = uploads.begin("last").unwrap();
        assert_eq!(last.add(1).unwrap_err().code, Code::Overloaded);
        drop(others);
        last.add(1).unwrap();
        drop(first);
        second.add(1).unwrap();
    }
}
