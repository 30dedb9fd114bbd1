//! A snapshot of another flow's announcements that is being pulled, part by part.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use blaze_proto::link::link_control as wire;

use super::announce::MAX_ASKED_PARTS;

/// The parts that came, and those that are asked for.
pub(super) struct Pull {
    /// `None` until the first part tells which version it is.
    pub(super) version: Option<u64>,
    pub(super) parts: Vec<Option<Vec<wire::Entry>>>,
    missing: usize,
    asked: BTreeSet<u32>,
    pub(super) next_request: Instant,
    /// Requests since the last part that came.
    pub(super) tries: u32,
}

impl Pull {
    /// A pull of the newest version, to be asked for at once.
    pub(super) fn new(now: Instant) -> Self {
        Self {
            version: None,
            parts: Vec::new(),
            missing: 0,
            asked: (0..).take(MAX_ASKED_PARTS).collect(),
            next_request: now,
            tries: 0,
        }
    }

    /// A pull of what another flow has asked for; what does not come is asked for later.
    pub(super) fn overheard(now: Instant, retry: Duration) -> Self {
        Self { next_request: now + retry, ..Self::new(now) }
    }

    /// Whether all parts came.
    pub(super) fn is_complete(&self) -> bool {
        self.version.is_some() && self.missing == 0
    }

    /// Takes a part that was asked for.
    pub(super) fn take(&mut self, now: Instant, snapshot: wire::Snapshot) -> bool {
        let count = usize::try_from(snapshot.parts).unwrap_or(0);
        match self.version {
            Some(version) if version == snapshot.version => {}
            // The version that was begun is gone: begin with this one.
            Some(version) if version > snapshot.version => return false,
            _ => {
                self.version = Some(snapshot.version);
                self.parts = vec![None; count];
                self.missing = count;
                self.asked = (0..snapshot.parts).take(MAX_ASKED_PARTS).collect();
            }
        }
        if self.parts.len() != count || !self.asked.remove(&snapshot.part) {
            return false;
        }
        let slot = usize::try_from(snapshot.part).ok().and_then(|part| self.parts.get_mut(part));
        if let Some(slot @ None) = slot {
            *slot = Some(snapshot.entries);
            self.missing -= 1;
        }
        self.tries = 0;
        if self.asked.is_empty() {
            self.next_request = now;
        }
        true
    }

    /// Asks for what was asked for and did not come, filled up with the next parts.
    pub(super) fn request(&mut self, now: Instant, retry: Duration) -> wire::SnapshotRequest {
        if self.version.is_some() {
            let next =
                (0..).zip(&self.parts).filter(|(_, part)| part.is_none()).map(|(index, _)| index);
            self.asked = next.take(MAX_ASKED_PARTS).collect();
        }
        self.tries += 1;
        self.next_request = now + retry;
        wire::SnapshotRequest {
            version: self.version.unwrap_or(0),
            parts: self.asked.iter().copied().collect(),
        }
    }
}
