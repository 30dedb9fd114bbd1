//! How far a stream from the main service has come.

use std::io;

use blaze_domain::config::Document;

/// Where a stream stands.
pub(super) enum Stream {
    /// There is none, or it has not begun.
    Closed,
    /// The parts of a snapshot come.
    Snapshot {
        store_id: String,
        /// Of the first part, once it is there.
        revision: Option<u64>,
        documents: Vec<Document>,
        bytes: usize,
    },
    /// Commits come.
    Live {
        /// The commit that was told last, or where the stream began.
        told: u64,
        /// Until the first commit that is new, older ones may come again; the revision from which the stream was resumed.
        resumed: Option<u64>,
    },
    /// Nothing sensible comes any more.
    Over,
}

/// The same, without what belongs to it.
#[derive(Clone, Copy)]
pub(super) enum Phase {
    Closed,
    Snapshot,
    Live,
    Over,
}

impl Stream {
    pub(super) fn phase(&self) -> Phase {
        match self {
            Self::Closed => Phase::Closed,
            Self::Snapshot { .. } => Phase::Snapshot,
            Self::Live { .. } => Phase::Live,
            Self::Over => Phase::Over,
        }
    }
}

/// Bytes of a spec as compact JSON, without writing it anywhere.
pub(super) fn spec_bytes(document: &Document) -> usize {
    struct Count(usize);
    impl io::Write for Count {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0 += bytes.len();
            Ok(bytes.len())
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }
    let mut count = Count(0);
    // Nothing can fail: the names of objects are texts and the counter takes everything.
    match serde_json::to_writer(&mut count, &*document.spec) {
        Ok(()) | Err(_) => count.0,
    }
}
