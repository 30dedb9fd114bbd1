//! What is remembered of the places, and what they are told next.

use super::notice::Notice;
use super::served_target::ServedTarget;

/// What a place was told last.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Told {
    /// Where the store stood when its configuration became what it is.
    pub revision: u64,
    /// Over the configuration; `None`: that its service is deleted.
    pub hash: Option<String>,
}

/// What follows from the changes since the last time.
#[derive(Debug, Default)]
pub struct Flushed {
    /// In the order of the services; those of one service all with the same revision, or older
    /// ones.
    pub notices: Vec<Notice>,
    /// Places that are told of changes from now on, whether there is a notice now or not.
    pub tracked: Vec<ServedTarget>,
    /// Places that are not told any more: whatever is kept for them outside would become old.
    pub untracked: Vec<ServedTarget>,
}
