//! Commits: written whole, once, and read in order.

use super::Fixture;
use super::samples::{self, answer, commit_of, record};
use super::tools::{Model, commit, conflict, fresh, log};
use blaze_config::store::upkeep::now;
use blaze_config::store::{AuditQuery, CommitError, Op};

/// A new store has nothing, and its floor and revision are 0.
pub async fn an_empty_store_is_at_zero(fixture: &dyn Fixture) {
    let store = fresh(fixture, "empty").await;
    let snapshot = store.load().await.unwrap();
    assert_eq!((snapshot.revision, snapshot.floor), (0, 0), "revision and floor");
    assert_eq!(snapshot.documents.len(), 0, "documents");
    assert_eq!(store.head().await.unwrap(), 0, "head");
    let batch = store.commits_after(0, 10).await.unwrap();
    assert_eq!((batch.commits.len(), batch.floor), (0, 0), "commits and floor");
    let other = fresh(fixture, "empty").await.load().await.unwrap();
    assert!(!snapshot.store_id.is_empty());
    assert_ne!(snapshot.store_id, other.store_id, "two stores");
}

/// Documents, commits, audit and answers are read as they were written, whatever keys and numbers
/// they hold.
pub async fn what_was_written_is_read_back(fixture: &dyn Fixture) {
    let mut model = Model::new(fixture, "read-back").await;
    model.write(&[&["a", "b"]]).await;
    model.write(&[&["a", "-b", "c"]]).await;
    let mut last = model.record(&["b"]);
    last.idempotency = Some(answer("repeat", 3));
    last.audit.push(samples::audit("create", Some(3)));
    commit(model.store.as_ref(), &[last.clone()]).await;
    model.check_now().await;
    assert_eq!(log(model.store.as_ref(), 0).await, model.commits, "the log");
    let kept = model.store.idempotency("repeat", now()).await.unwrap();
    assert_eq!(kept, last.idempotency, "the answer to repeat");
    let query = AuditQuery { limit: 100, ..AuditQuery::default() };
    let mut audit = model.store.audit(&query).await.unwrap();
    audit.retain(|entry| entry.revision == Some(3));
    audit.sort_by(|one, other| one.id.cmp(&other.id));
    last.audit.sort_by(|one, other| one.id.cmp(&other.id));
    assert_eq!(audit, last.audit, "the audit of commit 3");
}

/// A group is one transaction: all of its commits are there, and a fault in one of them keeps out
/// all.
pub async fn a_group_is_written_whole(fixture: &dyn Fixture) {
    let mut model = Model::new(fixture, "group").await;
    // Within a group a document may be made, changed and deleted several times.
    model.write(&[&["a", "b"], &["a"], &["-a"], &["a", "c"], &["-c"], &["b", "-a"]]).await;
    model.check_now().await;
    assert_eq!(log(model.store.as_ref(), 0).await, model.commits, "the log");
    let many: Vec<String> = (0..256).map(|number| format!("n{number}")).collect();
    let names: Vec<[&str; 1]> = many.iter().map(|name| [name.as_str()]).collect();
    let group: Vec<&[&str]> = names.iter().map(|names| &names[..]).collect();
    model.write(&group).await;
    model.check_now().await;
    // The second commit of this group cannot be written, so the first one is not, either.
    let revision = model.revision() + 1;
    let mut good = record(samples::commit(revision, &["x"]));
    good.idempotency = Some(answer("first", revision));
    let mut bad = record(samples::commit(revision + 1, &["y"]));
    bad.idempotency = Some(answer("first", revision + 1));
    conflict("an answer that is there twice", &model.store.commit(&[good, bad]).await);
    model.check_now().await;
    assert_eq!(log(model.store.as_ref(), 0).await, model.commits, "the log");
    let kept = model.store.idempotency("first", now()).await.unwrap();
    assert_eq!(kept, None, "the answer of a group that was not written");
    let none = commit_of(revision, Vec::new());
    let refused = model.store.commit(&[record(none)]).await;
    assert!(matches!(refused, Err(CommitError::NotWritten(_))), "without changes: {refused:?}");
    model.check_now().await;
}

/// A revision is given once. Who comes second has a conflict, and nothing of his is there.
pub async fn a_taken_revision_is_a_conflict(fixture: &dyn Fixture) {
    let mut model = Model::new(fixture, "taken").await;
    model.write(&[&["a"], &["a"], &["b"]]).await;
    for revision in 1..=3 {
        let mut late =
            record(commit_of(revision, vec![samples::change(Op::Create, "late", revision, None)]));
        late.idempotency = Some(answer("late", revision));
        conflict(&format!("revision {revision} again"), &model.store.commit(&[late]).await);
    }
    model.check_now().await;
    assert_eq!(log(model.store.as_ref(), 0).await, model.commits, "the log");
    let query = AuditQuery { limit: 100, ..AuditQuery::default() };
    assert_eq!(model.store.audit(&query).await.unwrap().len(), 3, "audit entries");
    assert_eq!(
        model.store.idempotency("late", now()).await.unwrap(),
        None,
        "the answer of a conflict"
    );
    model.write(&[&["a"]]).await;
    model.check_now().await;
}

/// A key of a repeated request is given once, until it has expired.
pub async fn a_taken_answer_is_a_conflict(fixture: &dyn Fixture) {
    let mut model = Model::new(fixture, "answer").await;
    let mut first = model.record(&["a"]);
    first.idempotency = Some(answer("same", 1));
    commit(model.store.as_ref(), &[first.clone()]).await;
    let mut second = record(samples::commit(2, &["b"]));
    second.idempotency = Some(answer("same", 2));
    conflict("an answer that is there", &model.store.commit(&[second]).await);
    model.check_now().await;
    let kept = model.store.idempotency("same", now()).await.unwrap();
    assert_eq!(kept, first.idempotency, "the first answer");
    // One that has expired gives way. The commit is of a later day than it.
    let mut old = model.record(&["b"]);
    let mut expired = answer("old", 2);
    expired.expires = samples::time(2);
    old.idempotency = Some(expired);
    commit(model.store.as_ref(), &[old]).await;
    let mut new = model.record(&["c"]);
    new.idempotency = Some(answer("old", 3));
    commit(model.store.as_ref(), &[new.clone()]).await;
    let kept = model.store.idempotency("old", now()).await.unwrap();
    assert_eq!(kept, new.idempotency, "the answer after the one that had expired");
    model.check_now().await;
}

/// The log is read in parts of any size, each in order and without a hole, and large commits come
/// alone.
pub async fn commits_come_in_order_and_in_parts(fixture: &dyn Fixture) {
    let mut model = Model::new(fixture, "parts").await;
    for _ in 0..10 {
        model.write(&[&["a", "b"], &["c"]]).await;
    }
    for limit in [1, 3, 7, 100] {
        let mut found = Vec::new();
        loop {
            let after = u64::try_from(found.len()).unwrap_or(u64::MAX);
            let batch = model.store.commits_after(after, limit).await.unwrap();
            if batch.commits.is_empty() {
                break;
            }
            assert!(
                batch.commits.len() <= limit,
                "{} where {limit} were asked for",
                batch.commits.len()
            );
            found.extend(batch.commits);
        }
        assert_eq!(found, model.commits, "the log in parts of {limit}");
    }
    // 40 documents of 250 KiB are more than one read takes; each commit has one of them.
    let store = fresh(fixture, "large").await;
    for revision in 1..=40 {
        let mut large = samples::node("large", revision);
        large.spec = std::sync::Arc::new(
            serde_json::json!({ "config": { "text": "x".repeat(250 * 1024) } }),
        );
        let mut change =
            samples::change(Op::Update, "large", revision, (revision > 1).then(|| revision - 1));
        change.document = std::sync::Arc::new(large);
        commit(store.as_ref(), &[record(commit_of(revision, vec![change]))]).await;
    }
    let batch = store.commits_after(0, 1_000).await.unwrap();
    let count = batch.commits.len();
    assert!((1..40).contains(&count), "{count} commits of 250 KiB in one read");
    assert_eq!(log(store.as_ref(), 0).await.len(), 40, "{count} in the first part");
}

/// A commit may be larger than a database likes: it is whole all the same, alone and among others,
/// in the log, in history and after trimming.
pub async fn commits_are_whole_whatever_their_size(fixture: &dyn Fixture) {
    let store = fresh(fixture, "huge").await;
    let mut commits = Vec::new();
    for (revision, documents) in [(1, 70), (2, 1), (3, 30), (4, 30)] {
        let changes = (0..documents).map(|number| large_change(number, revision));
        let mut large = commit_of(revision, changes.collect());
        if revision > 1 {
            // Those after the first one are one group.
            "group".clone_into(&mut large.batch);
        }
        commits.push(large);
    }
    let records: Vec<_> = commits.iter().cloned().map(record).collect();
    let (first, rest) = records.split_at(1);
    commit(store.as_ref(), first).await;
    commit(store.as_ref(), rest).await;
    for round in 0..2 {
        let found = log(store.as_ref(), 0).await;
        assert!(found == commits, "commits differ from what was written, round {round}");
        let snapshot = store.load().await.unwrap();
        assert_eq!(snapshot.documents.len(), 70, "documents");
        for document in &snapshot.documents {
            let changes = commits.iter().flat_map(|commit| &commit.changes).rev();
            let mut last = changes.map(|change| &change.document);
            let last = last.find(|last| last.key == document.key);
            let is_same = last.map(AsRef::as_ref) == Some(document);
            assert!(is_same, "{} differs from what was written, round {round}", document.key);
        }
        for (name, expected) in [("n69", 1), ("n29", 3), ("n0", 4)] {
            let history = store.versions(&samples::key(name), None, 9).await.unwrap();
            assert_eq!(history.len(), expected, "versions of {name}");
        }
        let before = store.documents_at(2, 4).await.unwrap();
        let old = before.iter().filter_map(|(_, document)| document.as_ref());
        let revisions: Vec<u64> = old.map(|document| document.revision).collect();
        assert_eq!(revisions.len(), 30, "documents that were there at 2");
        assert_eq!(revisions.iter().filter(|revision| **revision == 2).count(), 1, "the one of 2");
        store.tidy().await.unwrap();
    }
    assert_eq!(store.trim(3, 1).await.unwrap(), 3, "the floor");
    assert_eq!(store.load().await.unwrap().documents.len(), 70, "documents");
    assert_eq!(log(store.as_ref(), 3).await.len(), 1, "commits");
    let before = store.documents_at(3, 4).await.unwrap();
    assert_eq!(
        before.iter().filter(|(_, old)| old.is_some()).count(),
        30,
        "documents that were there at 3"
    );
    let history = store.versions(&samples::key("n69"), None, 9).await.unwrap();
    assert_eq!(history.len(), 1, "versions of the last document");
}

/// Of documents n0, n1, …, which are all in commit 1; n0 is in 2, and others are in 3 and 4.
fn large_change(number: u32, revision: u64) -> blaze_config::store::Change {
    let name = format!("n{number}");
    let mut large = samples::node(&name, revision);
    let text = ["", "a", "b", "c", "d"][usize::try_from(revision % 5).unwrap_or(0)];
    large.spec =
        std::sync::Arc::new(serde_json::json!({ "config": { "text": text.repeat(250 * 1024) } }));
    let before = match (revision, number) {
        (1, _) => None,
        (3, 0) => Some(2),
        (2 | 3, _) => Some(1),
        _ => Some(3),
    };
    let mut change = samples::change(Op::Update, &name, revision, before);
    change.document = std::sync::Arc::new(large);
    change
}
