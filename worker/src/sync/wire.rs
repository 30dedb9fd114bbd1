//! What comes over the stream, turned into words of the domain.

use std::time::Duration;

use blaze_domain::config::Document;
use blaze_proto::config::{WireError, timestamp_from_wire};
use blaze_proto::v1;

use crate::core::{Edit, Incoming, Op};

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
        documents: documents
            .collect::<Result<_, _>>()
            .map_err(|error| IncomingError::Document {
                message: "the snapshot",
                revision,
                error,
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
        time: timestamp_from_wire(commit.time.as_ref()),
        subject: commit.subject,
        edits: edits.collect::<Result<_, _>>()?,
    })
}

fn edit(revision: u64, change: v1::Change) -> Result<Edit, IncomingError> {
    let op = match v1::Op::try_from(change.op) {
        Ok(v1::Op::Create) => Op::Create,
        Ok(v1::Op::Update) => Op::Update,
        Ok(v1::Op::Delete) => Op::Delete,
        Ok(v1::Op::Leave) => Op::Leave,
        Ok(v1::Op::Rollback) => Op::Rollback,
        Ok(v1::Op::Unspecified | v1::Op::Unchanged) | Err(_) => {
            return Err(IncomingError::Op {
                revision,
                op: change.op,
            });
        }
    };
    let wire = change.document.ok_or(IncomingError::NoDocument { revision })?;
    let document = Document::try_from(wire).map_err(|error| IncomingError::Document {
        message: "the commit",
        revision,
        error,
    })?;
    Ok(Edit { op, document })
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
    fn every_change_keeps_its_kind_and_its_document() {
        for (wire, op) in [
            (v1::Op::Create, Op::Create),
            (v1::Op::Update, Op::Update),
            (v1::Op::Delete, Op::Delete),
            (v1::Op::Leave, Op::Leave),
            (v1::Op::Rollback, Op::Rollback),
        ] {
            let Ok(Incoming::Commit {
                revision: 7,
                previous: 5,
                edits,
                ..
            }) = commit(wire.into(), Some(document("robot-1")))
            else {
                panic!("{wire:?} is not taken as a commit");
            };
            assert_eq!(edits.len(), 1);
            assert_eq!(edits[0].op, op);
            assert_eq!(edits[0].document.key.to_string(), "Node/robot-1");
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

    #[test]
    fn an_empty_message_is_refused() {
        let error = Incoming::try_from(v1::SyncResponse { msg: None }).unwrap_err();
        assert_eq!(error, IncomingError::Unknown);
    }

    #[test]
    fn the_rest_is_taken_over() {
        let away = incoming(v1::sync_response::Msg::GoAway(v1::GoAway {
            retry_after_ms: 1500,
            reason: "shutting down".to_owned(),
        }));
        assert!(matches!(
            away,
            Ok(Incoming::GoAway { retry_after, ref reason })
                if retry_after == Duration::from_millis(1500) && reason == "shutting down"
        ));
        let snapshot = incoming(v1::sync_response::Msg::Snapshot(v1::Snapshot {
            revision: 9,
            documents: vec![document("robot-1"), document("robot-2")],
            last: true,
        }));
        assert!(matches!(
            snapshot,
            Ok(Incoming::Snapshot { revision: 9, ref documents, last: true }) if documents.len() == 2
        ));
    }
}
