//! Documents together with the roll-outs that this worker has undone by itself.

use std::sync::Arc;

use blaze_domain::ServiceName;
use blaze_domain::config::Key;
use blaze_domain::config::effective::{ConfigTarget, Sources};
use blaze_domain::config::spec::PROGRAMS;
use blaze_domain::config::state::State;

use super::served_target::{ServedTarget, Site};

/// All that an effective configuration follows from. A clone shares everything.
#[derive(Clone, Default)]
pub(super) struct World {
    pub(super) state: State,
    /// Of which store; `None`: of none, or that is not known.
    pub(super) store: Option<Arc<str>>,
    /// Uids of roll-outs that failed here, the oldest first: as long as the main service does not
    /// know, their change does not count here.
    pub(super) failed: Arc<Vec<String>>,
    /// Whether documents came from anywhere; without it nobody can be answered.
    pub(super) is_loaded: bool,
}

impl World {
    pub(super) fn sources(&self, at: &ConfigTarget) -> Sources {
        Sources::at_where(&self.state, at, |rollout| !self.failed.contains(&rollout.uid))
    }

    /// Programs are there also without a document: what layers and nodes say of them counts.
    pub(super) fn has_service(&self, service: &ServiceName) -> bool {
        PROGRAMS.contains(&service.as_str()) || self.state.get(&Key::service(service)).is_some()
    }

    /// The documents that count at a place; `None` if its service is not there.
    pub(super) fn at(&self, site: &Site, place: &ServedTarget) -> Option<Sources> {
        self.has_service(&place.service).then(|| self.sources(&place.at(site)))
    }
}
