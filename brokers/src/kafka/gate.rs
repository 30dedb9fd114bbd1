//! When nothing may be written or read.

use std::sync::atomic::{AtomicBool, Ordering};

/// When nothing may be handed over.
#[derive(Debug, Default)]
pub(super) struct Gate {
    up: AtomicBool,
    stood_back: AtomicBool,
}

impl Gate {
    /// The server answers, or does not.
    pub(super) fn set_up(&self, up: bool) {
        self.up.store(up, Ordering::Release);
    }

    /// The scope belongs to another flow, or to us.
    pub(super) fn set_stood_back(&self, stood_back: bool) {
        self.stood_back.store(stood_back, Ordering::Release);
    }

    /// Whether the server answers.
    pub(super) fn is_open(&self) -> bool {
        self.up.load(Ordering::Acquire)
    }

    /// Whether a topic is used now.
    pub(super) fn lets(&self, stays_open: bool) -> bool {
        stays_open || !self.stood_back.load(Ordering::Acquire)
    }
}
