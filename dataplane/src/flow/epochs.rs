//! The epochs of one flow's lives: the clock in milliseconds, and always larger than the last.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use blaze_domain::FlowId;
use blaze_runtime::state::{Unkept, next_epoch};

use super::plane::wall_ms;

/// Gives a flow its epochs. Clones share them.
#[derive(Debug, Clone)]
pub struct Epochs {
    me: FlowId,
    state_dir: Option<PathBuf>,
    first: u64,
    doubt: Option<String>,
    last: Arc<AtomicU64>,
}

impl Epochs {
    /// Begins a life of a flow. Without a directory the clock alone gives the epochs.
    #[must_use]
    pub fn begin(me: &FlowId, state_dir: Option<&Path>) -> Self {
        let mut epochs = Self {
            me: me.clone(),
            state_dir: state_dir.map(Path::to_owned),
            first: 0,
            doubt: None,
            last: Arc::default(),
        };
        let unkept;
        (epochs.first, unkept) = epochs.next();
        epochs.doubt = unkept.filter(|unkept| unkept.is_doubtful).map(|unkept| unkept.reason);
        epochs
    }

    /// The epoch that the flow began with. Its brokers know it by this one.
    #[must_use]
    pub fn first(&self) -> u64 {
        self.first
    }

    /// Why the life before this one, or the next one, may have the same epoch; `None`: no other
    /// has.
    pub(super) fn doubt(&self) -> Option<&str> {
        self.doubt.as_deref()
    }

    fn next(&self) -> (u64, Option<Unkept>) {
        let (given, unkept) = match &self.state_dir {
            Some(dir) => next_epoch(dir, self.me.layer.as_str(), self.me.node.as_str()),
            None => (wall_ms(), None),
        };
        if let Some(Unkept { reason, .. }) = &unkept {
            tracing::warn!(reason, "the epoch is taken from the clock and is not kept");
        }
        (self.after_last(given), unkept)
    }

    /// One for a rebuilt participant.
    pub(super) fn renew(&self) -> u64 {
        self.next().0
    }

    /// The clock may have been set back.
    fn after_last(&self, given: u64) -> u64 {
        let newer = |last: u64| given.max(last + 1);
        let before =
            self.last.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |last| Some(newer(last)));
        newer(before.unwrap_or_else(|last| last))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn epochs_grow_and_the_first_one_stays_known() {
        let directory = tempfile::tempdir().unwrap();
        let me: FlowId = "edge/robot-1".parse().unwrap();
        let epochs = Epochs::begin(&me, Some(directory.path()));
        let again = epochs.clone();
        let (second, third) = (epochs.renew(), again.renew());
        assert!(epochs.first() < second && second < third);
        assert_eq!(again.first(), epochs.first());
        let next_life = Epochs::begin(&me, Some(directory.path()));
        assert!(next_life.first() > third);
    }
}
