//! Wakes threads that wait for futures.

use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Wake, Waker};
use std::thread::{self, Thread};
use std::time::Duration;

struct Unpark(Thread);

impl Wake for Unpark {
    fn wake(self: Arc<Self>) {
        self.0.unpark();
    }
}

/// A waker of the calling thread.
pub(crate) fn unpark_waker() -> Waker {
    Waker::from(Arc::new(Unpark(thread::current())))
}

/// Waits in this thread, at most for a time.
pub(crate) fn wait(future: impl Future<Output = ()>, longest: Duration) {
    let waker = unpark_waker();
    let mut context = Context::from_waker(&waker);
    let mut future = pin!(future);
    if future.as_mut().poll(&mut context).is_pending() {
        thread::park_timeout(longest);
        // What it came for is taken, or would wake the next wait.
        let _ = future.poll(&mut context);
    }
}
