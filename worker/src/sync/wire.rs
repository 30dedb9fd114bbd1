//! What comes over the stream, turned into words of the domain.

use std::time::Duration;

use blaze_domain::config::Document;
use blaze_proto::config::WireError;
use blaze_proto::v1;

use crate::core::{Edit, Incoming};

/// A message of the stream that cannot be taken.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum IncomingError {
    /// The message is of a kind that this version does not know.
    #[error("a message of the stream is of no kind that is known here")]
    Unknown,
    /// A document of it says nothing sensible.
    #[error("{message} at revision {revision}: {error}")]
    Document {
        /// In which message.
        message: &'static str,
        /// At which revision.
        revision: u64,
        /// What is wrong.
        error: WireError,
    },
    /// A change without its document.
    #[error("the commit of revision {revision} has a change without document")]
    NoDocument {
        /// Which commit.
        revision: u64,
    },
    /// A change that does something else than create, update, delete, leave or roll back.
    #[error("the commit of revision {revision} has a change of kind {op}, which is no change")]
    Op {
        /// Which commit.
        revision: u64,
        /// The number of what it does.
        op: i32,
    },
}

impl TryFrom<v1::SyncResponse> for Incoming {
    type Error = IncomingError;

    fn try_from(wire: v1::SyncResponse) -> Result<Self, IncomingError> {
        use v1::sync_response::Msg;
        match wire.msg.ok_or(IncomingError::Unknown)? {
            Msg::Welcome(welcome) => Ok(Self::Welcome {
                protocol: welcome.protocol,
                store_id: welcome.store_id,
                revision: welcome.revision,
                resumed: welcome.resumed,
            }),
            Msg::Snapshot(snapshot) => from_snapshot(snapshot),
            Msg::Commit(commit) => from_commit(commit),
            Msg::Bookmark(bookmark) => Ok(Self::Bookmark {
                revision: bookmark.revision,
                digest: bookmark.digest,
                beside: bookmark.beside,
            }),
            Msg::GoAway(go_away) => Ok(Self::GoAway {
                retry_after: Duration::from_millis(go_away.retry_after_ms.into()),
                reason: go_away.reason,
            }),
        }
    }
}

fn from_snapshot(snapshot: v1::Snapshot) -> Result<Incoming, IncomingError> {
    let revision = snapshot.revision;
    let documents = snapshot.documents.into_iter().map(Document::try_from);
    Ok(Incoming::Snapshot {
        revision,
        documents: documents.collect::<Result<_, _>>().map_err(|error| {
            IncomingError::Document { message: "the snapshot", revision, error }
        })?,
        last: snapshot.last,
    })
}

fn from_commit(commit: v1::Commit) -> Result<Incoming, IncomingError> {
    let revision = commit.revision;
    let edits = commit.changes.into_iter().map(|change| edit(revision, change));
    Ok(Incoming::Commit {
        revision,
        previous: commit.previous,
        edits: edits.collect::<Result<_, _>>()?,
    })
}

fn edit(revision: u64, change: v1::Change) -> Result<Edit, IncomingError> {
    let wire = change.document.ok_or(IncomingError::NoDocument { revision })?;
    let document = Document::try_from(wire).map_err(|error| IncomingError::Document {
        message: "the commit",
        revision,
        error,
    })?;
    match v1::Op::try_from(change.op) {
        Ok(v1::Op::Create | v1::Op::Update | v1::Op::Rollback) => Ok(Edit::Put(document)),
        Ok(v1::Op::Delete | v1::Op::Leave) => Ok(Edit::Remove(document.key)),
        Ok(v1::Op::Unspecified | v1::Op::Unchanged) | Err(_) => {
            Err(IncomingError::Op { revision, op: change.op })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn document(name: &str) -> v1::Document {
        v1::Document {
            r#ref: Some(v1::Ref {
                kind: v1::Kind::Node.into(),
                name: name.to_owned(),
                service: String::new(),
            }),
            revision: 7,
            spec_json: r#"{"layer":"edge"}"#.to_owned(),
            ..v1::Document::default()
        }
    }

    fn incoming(msg: v1::sync_response::Msg) -> Result<Incoming, IncomingError> {
        v1::SyncResponse { msg: Some(msg) }.try_into()
    }

    fn commit(op: i32, document: Option<v1::Document>) -> Result<Incoming, IncomingError> {
        incoming(v1::sync_response::Msg::Commit(v1::Commit {
            revision: 7,
            previous: 5,
            changes: vec![v1::Change { op, document }],
            ..v1::Commit::default()
        }))
    }

    #[test]
    fn a_change_puts_its_document_or_removes_it() {
        for (op, is_there) in [
            (v1::Op::Create, true),
            (v1::Op::Update, true),
            (v1::Op::Rollback, true),
            (v1::Op::Delete, false),
            (v1::Op::Leave, false),
        ] {
            let found = commit(op.into(), Some(document("robot-1"))).unwrap();
            let Incoming::Commit { revision: 7, previous: 5, edits } = &found else {
                panic!("{op:?} is not taken as a commit: {found:?}");
            };
            let key = match &edits[..] {
                [Edit::Put(document)] if is_there => &document.key,
                [Edit::Remove(key)] if !is_there => key,
                _ => panic!("{op:?}"),
            };
            assert_eq!(key.to_string(), "Node/robot-1");
        }
    }

    #[test]
    fn what_is_no_change_is_refused() {
        for op in [0, v1::Op::Unchanged.into(), 99, -1] {
            let error = commit(op, Some(document("robot-1"))).unwrap_err();
            assert_eq!(error, IncomingError::Op { revision: 7, op });
        }
        let error = commit(1, None).unwrap_err();
        assert_eq!(error, IncomingError::NoDocument { revision: 7 });
        let error = commit(1, Some(document("Robot"))).unwrap_err();
        assert!(matches!(error, IncomingError::Document { revision: 7, .. }), "{error}");
    }
}
