//! The steps of a write, so that a test can end it after each of them as a crash would.

#[cfg(test)]
use std::sync::Arc;
#[cfg(test)]
use std::sync::atomic::{AtomicUsize, Ordering};

use super::CopyError;

/// Passed before each step that changes something outside of the process.
#[derive(Debug, Clone, Default)]
pub(super) struct Steps {
    /// Steps that are still done; none: all.
    #[cfg(test)]
    left: Option<Arc<AtomicUsize>>,
}

impl Steps {
    /// Lets `count` steps pass, then none any more.
    #[cfg(test)]
    pub(super) fn crash_after(count: usize) -> Self {
        Self {
            left: Some(Arc::new(AtomicUsize::new(count))),
        }
    }

    /// Whether the next step may be done.
    ///
    /// # Errors
    /// [`CopyError::Away`], in tests alone.
    #[cfg_attr(not(test), expect(clippy::unused_self, reason = "only tests count"))]
    #[cfg_attr(not(test), expect(clippy::unnecessary_wraps, reason = "only tests count"))]
    pub(super) fn pass(&self) -> Result<(), CopyError> {
        #[cfg(test)]
        if let Some(left) = &self.left {
            let less = |left: usize| left.checked_sub(1);
            if left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, less).is_err() {
                return Err(CopyError::Away {
                    place: "test".to_owned(),
                    detail: "crashed".to_owned(),
                });
            }
        }
        Ok(())
    }
}
