//! What is remembered of the places, and what they are told next.

use super::notice::Notice;
use super::place::{Place, Source};

/// What a place was told last.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Told {
    /// Where the store stood when its configuration became what it is.
    pub revision: u64,
    /// Over the configuration; `None`: that its service is deleted.
    pub hash: Option<String>,
}

/// Documents of a weaker source than those that are served.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("documents from {offered} do not replace those from {held}")]
pub struct WeakerSource {
    /// Where those come from that are served.
    pub held: Source,
    /// Where those come from that were refused.
    pub offered: Source,
}

/// What follows from the changes since the last time.
#[derive(Debug, Default)]
pub struct Flushed {
    /// In the order of the services; those of one service all with the same revision, or older ones.
    pub notices: Vec<Notice>,
    /// Places that are told of changes from now on, whether there is a notice now or not.
    pub tracked: Vec<Place>,
    /// Places that are not told any more: whatever is kept for them outside would become old.
    pub untracked: Vec<Place>,
}
