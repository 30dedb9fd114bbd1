//! Why a copy is not read or written.

use blaze_domain::LayerName;

/// Why a copy is not read or written. `place` is what
/// [`LocalCopy::describe`](super::LocalCopy::describe) says.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CopyError {
    /// It does not answer, or the disk is full: later it may.
    #[error("{place} cannot be used now: {detail}")]
    Away {
        /// Which copy.
        place: String,
        /// What was said.
        detail: String,
    },
    /// It will not get better by waiting: a wrong address, password or right.
    #[error("{place} refuses: {detail}")]
    Refused {
        /// Which copy.
        place: String,
        /// What was said.
        detail: String,
    },
    /// What is there is cut off, was changed, or has another form.
    #[error("{place} is broken: {detail}")]
    Broken {
        /// Which copy.
        place: String,
        /// What is wrong with it.
        detail: String,
    },
    /// It is encrypted, and `worker.key_file` is not given or holds another key.
    #[error("{place} is encrypted with key {found}, and worker.key_file {}", held(.own.as_deref()))]
    OtherKey {
        /// Which copy.
        place: String,
        /// By what its key is known.
        found: String,
        /// The same of the key that is here; none: no key is given.
        own: Option<String>,
    },
    /// It is the copy of another layer.
    #[error("{place} is the copy of layer {found}, not of {wanted}")]
    OtherLayer {
        /// Which copy.
        place: String,
        /// Whose it is.
        found: LayerName,
        /// Whose it should be.
        wanted: LayerName,
    },
    /// A newer version of this program wrote it.
    #[error("{place} has format {found}; this version reads up to {known}")]
    NewerFormat {
        /// Which copy.
        place: String,
        /// Its format.
        found: u64,
        /// The newest that is known here.
        known: u64,
    },
    /// It holds a later state of the same store, which nothing older replaces.
    #[error(
        "{place} is at revision {held} of this store, so that {offered} is not written over it"
    )]
    Newer {
        /// Which copy.
        place: String,
        /// Its revision.
        held: u64,
        /// Of what was to be written.
        offered: u64,
    },
    /// Another worker of the same layer and node has replaced it during the write.
    #[error("another worker of this layer and node has written {place} meanwhile")]
    Raced {
        /// Which copy.
        place: String,
    },
    /// `worker.key_file` is no key.
    #[error("worker.key_file: {detail}")]
    Key {
        /// With the path.
        detail: String,
    },
    /// The library for encryption failed.
    #[error("encrypting failed")]
    Sealing,
}

impl CopyError {
    /// Whether what is there can be read by nobody here, so that it is moved aside before something
    /// else is written.
    #[must_use]
    pub fn is_unreadable(&self) -> bool {
        match self {
            Self::Broken { .. }
            | Self::OtherKey { .. }
            | Self::OtherLayer { .. }
            | Self::NewerFormat { .. } => true,
            Self::Away { .. }
            | Self::Refused { .. }
            | Self::Newer { .. }
            | Self::Raced { .. }
            | Self::Key { .. }
            | Self::Sealing => false,
        }
    }
}

fn held(own: Option<&str>) -> String {
    own.map_or_else(|| "is not given".to_owned(), |own| format!("holds {own}"))
}
