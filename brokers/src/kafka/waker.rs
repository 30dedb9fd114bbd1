//! Wakes a thread.

use std::time::Duration;

use parking_lot::{Condvar, Mutex};

use crate::wake::unpark_waker;

/// A thread waits for it. A wake-up before the wait ends the wait at once.
#[derive(Debug, Default)]
pub(super) struct ThreadWaker {
    woken: Mutex<bool>,
    changed: Condvar,
}

impl ThreadWaker {
    pub(super) fn wake(&self) {
        *self.woken.lock() = true;
        self.changed.notify_one();
    }

    /// Waits for a wake-up, at most for a time.
    pub(super) fn wait(&self, timeout: Duration) {
        let mut woken = self.woken.lock();
        if !*woken {
            self.changed.wait_for(&mut woken, timeout);
        }
        *woken = false;
    }
}

/// Runs a future to its end on this thread, which waits in between.
pub(super) fn block_on<F: Future>(future: F) -> F::Output {
    let waker = unpark_waker();
    let mut context = std::task::Context::from_waker(&waker);
    let mut future = std::pin::pin!(future);
    loop {
        match future.as_mut().poll(&mut context) {
            std::task::Poll::Ready(output) => return output,
            std::task::Poll::Pending => std::thread::park(),
        }
    }
}
