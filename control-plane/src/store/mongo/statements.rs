//! What the records of a group of commits are.
//!
//! ```text
//! group ──▶ one record ──▶ one insertion                                    nearly always
//!      └──▶ several records, and changes that no record has room for ──▶ one transaction
//! ```

use mongodb::bson::{Document, doc};

use super::rows::{self, OVERHEAD_BYTES};
use crate::store::encode::EncodedCommit;
use crate::store::rows::VersionRow;

/// Bytes of one record, about; one BSON document has at most 16 MiB.
const RECORD_BYTES: usize = 12 * 1024 * 1024;
/// Commits of one record, at most.
pub(super) const RECORD_COMMITS: i64 = 1_000;
const MOST_COMMITS: usize = 1_000;

/// What is written.
pub(super) struct Statements {
    /// Records of the log.
    pub(super) records: Vec<Document>,
    /// Changes beside them.
    pub(super) versions: Vec<Document>,
}

impl Statements {
    pub(super) fn of(group: &[EncodedCommit], writer: &str) -> Self {
        let (mut records, mut versions) = (Vec::new(), Vec::new());
        let (mut begin, mut bytes) = (0, 0);
        let mut close = |from: usize, to: usize, inline: usize| {
            if let Some(commits) = group.get(from..to).filter(|commits| !commits.is_empty()) {
                records.push(rows::record(commits, writer, inline));
            }
        };
        for (place, commit) in group.iter().enumerate() {
            let size = beside(commit) + commit.versions.iter().map(version_bytes).sum::<usize>();
            if bytes + size > RECORD_BYTES || place - begin >= MOST_COMMITS {
                close(begin, place, usize::MAX);
                (begin, bytes) = (place, 0);
            }
            if size > RECORD_BYTES {
                let inline = fitting(commit);
                versions.extend(commit.versions.iter().skip(inline).map(rows::version));
                close(place, place + 1, inline);
                begin = place + 1;
            } else {
                bytes += size;
            }
        }
        close(begin, group.len(), usize::MAX);
        Self { records, versions }
    }
}

/// How many changes of a large commit its record has room for.
fn fitting(commit: &EncodedCommit) -> usize {
    let mut bytes = beside(commit);
    let fits = |version: &&VersionRow| {
        bytes += version_bytes(version);
        bytes <= RECORD_BYTES
    };
    commit.versions.iter().take_while(fits).count()
}

fn version_bytes(version: &VersionRow) -> usize {
    version.document.len() + version.paths.len() + OVERHEAD_BYTES
}

/// Bytes of a commit beside its changes.
fn beside(commit: &EncodedCommit) -> usize {
    let audit = commit.audit.iter().map(|entry| entry.paths.len() + 2 * OVERHEAD_BYTES);
    let answer = commit.idempotency.as_ref().map_or(0, |answer| answer.answer.len());
    audit.sum::<usize>() + answer + 2 * OVERHEAD_BYTES
}

/// Commands that make documents what they are after these changes, of which each is of another
/// document.
pub(super) fn document_updates(rows: &[VersionRow]) -> Vec<Document> {
    let (gone, there): (Vec<&VersionRow>, Vec<&VersionRow>) =
        rows.iter().partition(|row| row.is_deletion());
    let mut commands = Vec::new();
    if !there.is_empty() {
        let update = |row: &&VersionRow| {
            doc! {
                "q": { "_id": &row.key },
                "u": { "revision": row.revision, "document": &row.document },
                "upsert": true,
            }
        };
        commands.push(update_command("documents", there.iter().map(update).collect()));
    }
    if !gone.is_empty() {
        let gone: Vec<&str> = gone.iter().map(|row| row.key.as_str()).collect();
        commands.push(doc! { "delete": "documents",
        "deletes": [{ "q": { "_id": { "$in": gone } }, "limit": 0 }] });
    }
    commands
}

pub(super) fn update_command(table: &str, updates: Vec<Document>) -> Document {
    doc! { "update": table, "updates": updates, "ordered": true }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::Op;
    use crate::store::encode::encode_group;
    use crate::store::samples::{answer, change, commit, commit_of, record};

    #[test]
    fn a_group_is_one_record() {
        let group =
            encode_group(&[record(commit(4, &["a", "b"])), record(commit(5, &["c"]))]).unwrap();
        let statements = Statements::of(&group, "me");
        assert_eq!((statements.records.len(), statements.versions.len()), (1, 0));
        let found = rows::read_record(&statements.records[0]).unwrap();
        assert_eq!((found.first, found.last, found.versions.len()), (4, 5, 3));
    }

    #[test]
    fn documents_are_replaced_and_removed() {
        let group = encode_group(&[
            record(commit(1, &["a"])),
            record(commit_of(2, vec![change(Op::Delete, "b", 2, Some(1))])),
        ])
        .unwrap();
        let rows: Vec<VersionRow> = group.into_iter().flat_map(|commit| commit.versions).collect();
        let commands = document_updates(&rows);
        assert_eq!(commands.len(), 2);
        assert_eq!(commands[0].get_array("updates").unwrap().len(), 1);
        assert_eq!(
            commands[1],
            doc! {
                "delete": "documents",
                "deletes": [{ "q": { "_id": { "$in": ["Node/b"] } }, "limit": 0 }],
            }
        );
        assert!(document_updates(&[]).is_empty());
    }

    fn large(revision: u64, documents: u32) -> crate::store::CommitRecord {
        let mut large = commit(revision, &[]);
        for number in 0..documents {
            let mut change = change(Op::Create, &format!("n{number}"), revision, None);
            let mut document = (*change.document).clone();
            document.spec = std::sync::Arc::new(serde_json::json!("x".repeat(250 * 1024)));
            change.document = std::sync::Arc::new(document);
            large.changes.push(change);
        }
        let mut large = record(large);
        large.idempotency = Some(answer("a", revision));
        large
    }

    #[test]
    fn large_groups_are_several_records_below_the_limit_of_the_server() {
        let group = encode_group(&[
            large(1, 20),
            large(2, 20),
            large(3, 20),
            large(4, 100),
            large(5, 1),
            large(6, 1),
        ])
        .unwrap();
        let statements = Statements::of(&group, "me");
        let records: Vec<_> =
            statements.records.iter().map(|found| rows::read_record(found).unwrap()).collect();
        let ranges: Vec<_> = records.iter().map(|record| (record.first, record.last)).collect();
        assert_eq!(ranges, [(1, 2), (3, 3), (4, 4), (5, 6)]);
        for found in &statements.records {
            assert!(found.to_vec().unwrap().len() < 16 * 1024 * 1024);
        }
        assert_eq!(records[2].versions.len() + statements.versions.len(), 100);
        assert!(records[2].versions.len() > 40);
    }
}
