//! What must survive besides documents.

use serde::{Deserialize, Serialize};

use crate::core::ServedTarget;

/// What must survive besides documents.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Notes {
    /// Roll-outs that failed here, by `uid`, oldest first.
    pub failed: Vec<String>,
    /// Places that are notified of changes.
    pub places: Vec<ServedTarget>,
    /// Places whose last notice the broker still keeps.
    pub ended: Vec<ServedTarget>,
    /// No place is notified with a lower revision.
    pub floor: u64,
}

impl Notes {
    /// Takes over what another copy has beyond this one.
    pub fn merge(&mut self, other: &Self) {
        let more = other.failed.iter().filter(|uid| !self.failed.contains(uid));
        let more: Vec<String> = more.cloned().collect();
        self.failed.extend(more);
        for (own, others) in [(&mut self.places, &other.places), (&mut self.ended, &other.ended)] {
            own.extend(others.iter().cloned());
            own.sort_unstable();
            own.dedup();
        }
        self.floor = self.floor.max(other.floor);
    }
}
