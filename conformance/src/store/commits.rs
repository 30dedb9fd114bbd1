//! Commits: written whole, once, and read in order.

use super::Fixture;
use super::samples::{self, answer, commit_of, record};
use super::tools::{Model, Outcome, commit, conflict, fresh, log, same, told};
use blaze_config::store::upkeep::now;
use blaze_config::store::{AuditQuery, Op};

/// A new store has nothing, and its floor and revision are 0.
///
/// # Errors
/// How the store breaks the rule.
pub async fn an_empty_store_is_at_zero(fixture: &dyn Fixture) -> Outcome {
    let store = fresh(fixture, "empty").await?;
    let snapshot = told("load", store.load().await)?;
    same("revision and floor", &(snapshot.revision, snapshot.floor), &(0, 0))?;
    same("documents", &snapshot.documents.len(), &0)?;
    same("head", &told("head", store.head().await)?, &0)?;
    let batch = told("commits_after", store.commits_after(0, 10).await)?;
    same("commits and floor", &(batch.commits.len(), batch.floor), &(0, 0))?;
    let other = told("load", fresh(fixture, "empty").await?.load().await)?;
    match snapshot.store_id.is_empty() || snapshot.store_id == other.store_id {
        true => Err(format!("two stores are both called {:?}", snapshot.store_id)),
        false => Ok(()),
    }
}

/// Documents, commits, audit and answers are read as they were written, whatever keys and numbers they hold.
///
/// # Errors
/// How the store breaks the rule.
pub async fn what_was_written_is_read_back(fixture: &dyn Fixture) -> Outcome {
    let mut model = Model::new(fixture, "read-back").await?;
    model.write(&[&["a", "b"]]).await?;
    model.write(&[&["a", "-b", "c"]]).await?;
    let mut last = model.record(&["b"]);
    last.idempotency = Some(answer("repeat", 3));
    last.audit.push(samples::audit("create", Some(3)));
    commit(model.store.as_ref(), &[last.clone()]).await?;
    model.check_now().await?;
    same("the log", &log(model.store.as_ref(), 0).await?, &model.commits)?;
    let kept = told("idempotency", model.store.idempotency("repeat", now()).await)?;
    same("the answer to repeat", &kept, &last.idempotency)?;
    let query = AuditQuery {
        limit: 100,
        ..AuditQuery::default()
    };
    let mut audit = told("audit", model.store.audit(&query).await)?;
    audit.retain(|entry| entry.revision == Some(3));
    audit.sort_by(|one, other| one.id.cmp(&other.id));
    last.audit.sort_by(|one, other| one.id.cmp(&other.id));
    same("the audit of commit 3", &audit, &last.audit)
}

/// A group is one transaction: all of its commits are there, and a fault in one of them keeps out all.
///
/// # Errors
/// How the store breaks the rule.
pub async fn a_group_is_written_whole(fixture: &dyn Fixture) -> Outcome {
    let mut model = Model::new(fixture, "group").await?;
    // Within a group a document may be made, changed and deleted several times.
    model
        .write(&[&["a", "b"], &["a"], &["-a"], &["a", "c"], &["-c"], &["b", "-a"]])
        .await?;
    model.check_now().await?;
    same("the log", &log(model.store.as_ref(), 0).await?, &model.commits)?;
    let many: Vec<String> = (0..256).map(|number| format!("n{number}")).collect();
    let names: Vec<[&str; 1]> = many.iter().map(|name| [name.as_str()]).collect();
    let group: Vec<&[&str]> = names.iter().map(|names| &names[..]).collect();
    model.write(&group).await?;
    model.check_now().await?;
    // The second commit of this group cannot be written, so the first one is not, either.
    let revision = model.revision() + 1;
    let mut good = record(samples::commit(revision, &["x"]));
    good.idempotency = Some(answer("first", revision));
    let mut bad = record(samples::commit(revision + 1, &["y"]));
    bad.idempotency = Some(answer("first", revision + 1));
    conflict("an answer that is there twice", model.store.commit(&[good, bad]).await)?;
    model.check_now().await?;
    same("the log", &log(model.store.as_ref(), 0).await?, &model.commits)?;
    let kept = told("idempotency", model.store.idempotency("first", now()).await)?;
    same("the answer of a group that was not written", &kept, &None)?;
    let none = commit_of(revision, Vec::new());
    match model.store.commit(&[record(none)]).await {
        Err(blaze_config::store::CommitError::NotWritten(_)) => model.check_now().await,
        other => Err(format!("a commit without changes must be refused, but was {other:?}")),
    }
}

/// A revision is given once. Who comes second has a conflict, and nothing of his is there.
///
/// # Errors
/// How the store breaks the rule.
pub async fn a_taken_revision_is_a_conflict(fixture: &dyn Fixture) -> Outcome {
    let mut model = Model::new(fixture, "taken").await?;
    model.write(&[&["a"], &["a"], &["b"]]).await?;
    for revision in 1..=3 {
        let mut late = record(commit_of(
            revision,
            vec![samples::change(Op::Create, "late", revision, None)],
        ));
        late.idempotency = Some(answer("late", revision));
        conflict(&format!("revision {revision} again"), model.store.commit(&[late]).await)?;
    }
    model.check_now().await?;
    same("the log", &log(model.store.as_ref(), 0).await?, &model.commits)?;
    let query = AuditQuery {
        limit: 100,
        ..AuditQuery::default()
    };
    same(
        "audit entries",
        &told("audit", model.store.audit(&query).await)?.len(),
        &3,
    )?;
    same(
        "the answer of a conflict",
        &told("idempotency", model.store.idempotency("late", now()).await)?,
        &None,
    )?;
    model.write(&[&["a"]]).await?;
    model.check_now().await
}

/// A key of a repeated request is given once, until it has expired.
///
/// # Errors
/// How the store breaks the rule.
pub async fn a_taken_answer_is_a_conflict(fixture: &dyn Fixture) -> Outcome {
    let mut model = Model::new(fixture, "answer").await?;
    let mut first = model.record(&["a"]);
    first.idempotency = Some(answer("same", 1));
    commit(model.store.as_ref(), &[first.clone()]).await?;
    let mut second = record(samples::commit(2, &["b"]));
    second.idempotency = Some(answer("same", 2));
    conflict("an answer that is there", model.store.commit(&[second]).await)?;
    model.check_now().await?;
    let kept = told("idempotency", model.store.idempotency("same", now()).await)?;
    same("the first answer", &kept, &first.idempotency)?;
    // One that has expired gives way. The commit is of a later day than it.
    let mut old = model.record(&["b"]);
    let mut expired = answer("old", 2);
    expired.expires = samples::time(2);
    old.idempotency = Some(expired);
    commit(model.store.as_ref(), &[old]).await?;
    let mut new = model.record(&["c"]);
    new.idempotency = Some(answer("old", 3));
    commit(model.store.as_ref(), &[new.clone()]).await?;
    let kept = told("idempotency", model.store.idempotency("old", now()).await)?;
    same("the answer after the one that had expired", &kept, &new.idempotency)?;
    model.check_now().await
}

/// The log is read in parts of any size, each in order and without a hole, and large commits come alone.
///
/// # Errors
/// How the store breaks the rule.
pub async fn commits_come_in_order_and_in_parts(fixture: &dyn Fixture) -> Outcome {
    let mut model = Model::new(fixture, "parts").await?;
    for _ in 0..10 {
        model.write(&[&["a", "b"], &["c"]]).await?;
    }
    for limit in [1, 3, 7, 100] {
        let mut found = Vec::new();
        loop {
            let after = u64::try_from(found.len()).unwrap_or(u64::MAX);
            let batch = told("commits_after", model.store.commits_after(after, limit).await)?;
            if batch.commits.is_empty() {
                break;
            }
            if batch.commits.len() > limit {
                return Err(format!("{} commits where {limit} were asked for", batch.commits.len()));
            }
            found.extend(batch.commits);
        }
        same(&format!("the log in parts of {limit}"), &found, &model.commits)?;
    }
    // 40 documents of 250 KiB are more than one read takes; each commit has one of them.
    let store = fresh(fixture, "large").await?;
    for revision in 1..=40 {
        let mut large = samples::node("large", revision);
        large.spec = std::sync::Arc::new(serde_json::json!({ "config": { "text": "x".repeat(250 * 1024) } }));
        let mut change = samples::change(Op::Update, "large", revision, (revision > 1).then(|| revision - 1));
        change.document = std::sync::Arc::new(large);
        commit(store.as_ref(), &[record(commit_of(revision, vec![change]))]).await?;
    }
    let batch = told("commits_after", store.commits_after(0, 1_000).await)?;
    match batch.commits.len() {
        count @ 1..40 => same(
            "commits after the first part",
            &log(store.as_ref(), 0).await?.len(),
            &40,
        )
        .map_err(|error| format!("{error} ({count} in the first part)")),
        count => Err(format!("{count} commits of 250 KiB in one read")),
    }
}

/// A commit may be larger than a database likes: it is whole all the same, alone and among others, in the log, in history
/// and after trimming.
///
/// # Errors
/// How the store breaks the rule.
pub async fn commits_are_whole_whatever_their_size(fixture: &dyn Fixture) -> Outcome {
    let store = fresh(fixture, "huge").await?;
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
    commit(store.as_ref(), first).await?;
    commit(store.as_ref(), rest).await?;
    for round in 0..2 {
        let found = log(store.as_ref(), 0).await?;
        if found != commits {
            return Err(format!("commits differ from what was written, round {round}"));
        }
        let snapshot = told("load", store.load().await)?;
        same("documents", &snapshot.documents.len(), &70)?;
        for document in &snapshot.documents {
            let changes = commits.iter().flat_map(|commit| &commit.changes).rev();
            let mut last = changes.map(|change| &change.document);
            let last = last.find(|last| last.key == document.key);
            if last.map(AsRef::as_ref) != Some(document) {
                return Err(format!("{} differs from what was written, round {round}", document.key));
            }
        }
        for (name, expected) in [("n69", 1), ("n29", 3), ("n0", 4)] {
            let history = told("versions", store.versions(&samples::key(name), None, 9).await)?;
            same(&format!("versions of {name}"), &history.len(), &expected)?;
        }
        let before = told("documents_at", store.documents_at(2, 4).await)?;
        let old = before.iter().filter_map(|(_, document)| document.as_ref());
        let revisions: Vec<u64> = old.map(|document| document.revision).collect();
        same("documents that were there at 2", &revisions.len(), &30)?;
        same(
            "the one of 2",
            &revisions.iter().filter(|revision| **revision == 2).count(),
            &1,
        )?;
        told("tidy", store.tidy().await)?;
    }
    same("the floor", &told("trim", store.trim(3, 1).await)?, &3)?;
    same("documents", &told("load", store.load().await)?.documents.len(), &70)?;
    same("commits", &log(store.as_ref(), 3).await?.len(), &1)?;
    let before = told("documents_at", store.documents_at(3, 4).await)?;
    same(
        "documents that were there at 3",
        &before.iter().filter(|(_, old)| old.is_some()).count(),
        &30,
    )?;
    let history = told("versions", store.versions(&samples::key("n69"), None, 9).await)?;
    same("versions of the last document", &history.len(), &1)
}

/// Of documents n0, n1, …, which are all in commit 1; n0 is in 2, and others are in 3 and 4.
fn large_change(number: u32, revision: u64) -> blaze_config::store::Change {
    let name = format!("n{number}");
    let mut large = samples::node(&name, revision);
    let text = ["", "a", "b", "c", "d"][usize::try_from(revision % 5).unwrap_or(0)];
    large.spec = std::sync::Arc::new(serde_json::json!({ "config": { "text": text.repeat(250 * 1024) } }));
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
