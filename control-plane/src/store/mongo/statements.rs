//! What the transaction of a group of commits consists of.

use mongodb::bson::{DateTime, Document, doc};

use super::rows::{self, FLOOR};
use crate::store::encode::{EncodedCommit, last_versions};

/// Bytes and documents of one command; a command is one BSON document, of at most 16 MiB.
const COMMAND_BYTES: usize = 6 * 1024 * 1024;
const COMMAND_DOCUMENTS: usize = 10_000;

/// What a transaction writes.
pub(super) struct Statements {
    pub(super) events: Vec<Document>,
    pub(super) versions: Vec<Document>,
    /// Commands, and how many documents each must find or make.
    pub(super) documents: Vec<(Document, i64)>,
    pub(super) deleted: Vec<String>,
    pub(super) audit: Vec<Document>,
    pub(super) answers: Vec<Document>,
}

impl Statements {
    pub(super) fn of(group: &[EncodedCommit], writer: &str) -> Self {
        Self {
            events: group.iter().map(|commit| rows::event(&commit.event, writer)).collect(),
            versions: group
                .iter()
                .flat_map(|commit| &commit.versions)
                .map(rows::version)
                .collect(),
            documents: document_updates(group),
            deleted: deleted_keys(group),
            audit: group.iter().flat_map(|commit| &commit.audit).map(rows::audit).collect(),
            answers: answer_updates(group),
        }
    }
}

/// Commands that bring the current documents up to date, and how many documents each must find or make. The first one has
/// the guard.
fn document_updates(group: &[EncodedCommit]) -> Vec<(Document, i64)> {
    let first = group.first().map_or(0, |commit| commit.event.revision);
    // Changes nothing, so it hinders nobody.
    let guard = doc! { "q": { "_id": FLOOR, "floor": { "$lt": first } }, "u": { "$max": { "floor": 0_i64 } } };
    let mut updates = vec![guard];
    let mut commands = Vec::new();
    let mut bytes = 0;
    for row in last_versions(group).into_values().filter(|row| !row.is_deletion()) {
        if bytes + row.document.len() > COMMAND_BYTES || updates.len() >= COMMAND_DOCUMENTS {
            commands.push(update_command("documents", std::mem::take(&mut updates)));
            bytes = 0;
        }
        bytes += row.document.len() + rows::OVERHEAD_BYTES;
        updates.push(doc! {
            "q": { "_id": &row.key },
            "u": { "revision": row.revision, "document": &row.document },
            "upsert": true,
        });
    }
    commands.push(update_command("documents", updates));
    commands
}

fn deleted_keys(group: &[EncodedCommit]) -> Vec<String> {
    let last = last_versions(group).into_values().filter(|row| row.is_deletion());
    last.map(|row| row.key.clone()).collect()
}

/// Commands that keep the answers to repeat. An answer that has expired gives way, and any other has a duplicate key.
fn answer_updates(group: &[EncodedCommit]) -> Vec<Document> {
    let mut updates = Vec::new();
    let mut commands = Vec::new();
    let mut bytes = 0;
    for (row, now) in group
        .iter()
        .filter_map(|commit| Some((commit.idempotency.as_ref()?, commit.event.time)))
    {
        if bytes + row.answer.len() > COMMAND_BYTES {
            commands.push(update_command("idempotency", std::mem::take(&mut updates)).0);
            bytes = 0;
        }
        bytes += row.answer.len() + rows::OVERHEAD_BYTES;
        let mut new = rows::idempotency(row);
        new.remove("_id");
        updates.push(doc! {
            "q": { "_id": &row.id, "expires": { "$lte": DateTime::from_millis(now) } },
            "u": new,
            "upsert": true,
        });
    }
    if !updates.is_empty() {
        commands.push(update_command("idempotency", updates).0);
    }
    commands
}

fn update_command(table: &str, updates: Vec<Document>) -> (Document, i64) {
    let count = i64::try_from(updates.len()).unwrap_or(i64::MAX);
    (doc! { "update": table, "updates": updates, "ordered": true }, count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::Op;
    use crate::store::conformance::samples::{answer, change, commit, commit_of, record};
    use crate::store::encode::encode_group;

    #[test]
    fn the_guard_is_there_even_if_nothing_is_updated() {
        let gone = commit_of(9, vec![change(Op::Delete, "a", 9, Some(3))]);
        let group = encode_group(&[record(gone)]).unwrap();
        let commands = document_updates(&group);
        assert_eq!(commands.len(), 1);
        assert_eq!(commands[0].1, 1);
        let updates = commands[0].0.get_array("updates").unwrap();
        assert_eq!(
            updates[0].as_document().unwrap().get_document("q").unwrap(),
            &doc! { "_id": FLOOR, "floor": { "$lt": 9_i64 } }
        );
        assert_eq!(deleted_keys(&group), ["Node/a"]);
    }

    #[test]
    fn only_the_last_state_of_a_document_is_written() {
        let group = encode_group(&[
            record(commit(1, &["a", "b"])),
            record(commit_of(
                2,
                vec![change(Op::Update, "a", 2, Some(1)), change(Op::Delete, "b", 2, Some(1))],
            )),
            record(commit(3, &["b"])),
        ])
        .unwrap();
        let commands = document_updates(&group);
        assert_eq!(commands[0].1, 3);
        assert!(deleted_keys(&group).is_empty());
    }

    #[test]
    fn large_groups_are_several_commands_below_the_limit_of_the_server() {
        let mut large = commit(1, &[]);
        for number in 0..60 {
            let mut change = change(Op::Create, &format!("n{number}"), 1, None);
            let mut document = (*change.document).clone();
            document.spec = std::sync::Arc::new(serde_json::json!("x".repeat(250 * 1024)));
            change.document = std::sync::Arc::new(document);
            large.changes.push(change);
        }
        let mut large = record(large);
        large.idempotency = Some(answer("a", 1));
        let group = encode_group(&[large]).unwrap();
        let commands = document_updates(&group);
        assert!(commands.len() > 2);
        assert_eq!(commands.iter().map(|(_, count)| count).sum::<i64>(), 61);
        for (command, _) in commands {
            assert!(command.to_vec().unwrap().len() < 8 * 1024 * 1024);
        }
        assert_eq!(answer_updates(&group).len(), 1);
    }
}
