//! Wakes threads that wait for futures.

use std::sync::Arc;
use std::task::{Wake, Waker};
use std::thread::{self, Thread};

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
