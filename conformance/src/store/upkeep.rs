//! Backup, restore, rewriting, closing.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::sync::Arc;

use blaze_domain::config::Document;
use serde_json::{Value, json};

use super::Fixture;
use super::samples::{self, answer, audit, token};
use super::tools::{Model, Outcome, by_key, commit, fresh, log, same, store_name, told, unavailable};
use blaze_config::store::upkeep::{RESTORE_RAISES_BY, now};
use blaze_config::store::{AuditQuery, CommitError, Op, StoreError, backup};

/// Each document and each version is rewritten, once, and nothing else changes.
///
/// # Errors
/// How the store breaks the rule.
pub async fn documents_are_rewritten_in_place(fixture: &dyn Fixture) -> Outcome {
    let mut model = Model::new(fixture, "rewrite").await?;
    let names: Vec<String> = (0..450).map(|number| format!("n{number}")).collect();
    let all: Vec<&str> = names.iter().map(String::as_str).collect();
    model.write(&[&all, &all[..10], &["-n0"]]).await?;
    let make = |document: &Document| {
        let mut new = document.clone();
        let mut spec = (*new.spec).clone();
        let place = spec.pointer_mut("/config/password/$secret/key")?;
        let old = std::mem::replace(place, Value::from("e2"));
        new.spec = Arc::new(spec);
        (old != json!("e2")).then_some(new)
    };
    let rewritten = told("rewrite", model.store.rewrite(&make).await)?;
    same("how many were rewritten", &rewritten, &(449 + 450 + 10 + 1))?;
    same(
        "how many a second time",
        &told("rewrite", model.store.rewrite(&make).await)?,
        &0,
    )?;
    for documents in model.states.iter_mut().chain([&mut model.documents]) {
        for document in documents.values_mut() {
            if let Some(new) = make(document) {
                *document = new;
            }
        }
    }
    model.check_now().await?;
    model.check_past(0).await?;
    same("commits", &log(model.store.as_ref(), 0).await?.len(), &3)
}

/// A restored store has the documents, their history, audit, tokens and answers of the backup, another identity, and a
/// revision far above; everything before it counts as trimmed. The backup is of one revision although writing went on.
///
/// # Errors
/// How the store breaks the rule.
pub async fn a_backup_is_restored_elsewhere(fixture: &dyn Fixture) -> Outcome {
    let mut model = Model::new(fixture, "backup").await?;
    model.write(&[&["a", "b"], &["a"], &["-b"], &["c"]]).await?;
    let mut repeated = model.record(&["a"]);
    repeated.idempotency = Some(answer("kept", 5));
    commit(model.store.as_ref(), &[repeated.clone()]).await?;
    told(
        "add_token",
        model.store.add_token(&token("t"), &audit("token_create", None)).await,
    )?;
    told("trim", model.store.trim(2, 20).await)?;
    let mut file = Vec::new();
    let saving = backup::write(|pieces| model.store.export(pieces), &mut file);
    let summary = told("backup", saving.await)?;
    same("the revision of the backup", &summary.head.revision, &5)?;
    let name = store_name("restored");
    let new = fixture.open(&name).await?;
    let restored = told("restore", backup::restore(new.as_ref(), &mut Cursor::new(&file)).await)?;
    let expected = 5 + RESTORE_RAISES_BY;
    let snapshot = told("load", new.load().await)?;
    same(
        "revision and floor",
        &(snapshot.revision, snapshot.floor),
        &(expected, expected),
    )?;
    same("the identity", &snapshot.store_id, &restored.store_id)?;
    if snapshot.store_id == summary.head.store_id {
        return Err("the restored store has the identity of the old one".to_owned());
    }
    same("the documents", &by_key(snapshot.documents), &model.documents)?;
    same("the head", &told("head", new.head().await)?, &expected)?;
    for name in ["a", "b", "c"] {
        let versions = [&model.store, &new].map(|store| {
            let (store, key) = (Arc::clone(store), samples::key(name));
            async move { store.versions(&key, None, 20).await }
        });
        let [old, new] = versions;
        same(
            &format!("history of {name}"),
            &told("versions", new.await)?,
            &told("versions", old.await)?,
        )?;
    }
    let query = AuditQuery {
        limit: 100,
        ..AuditQuery::default()
    };
    same(
        "the audit",
        &told("audit", new.audit(&query).await)?,
        &told("audit", model.store.audit(&query).await)?,
    )?;
    same(
        "the tokens",
        &told("tokens", new.tokens(now()).await)?,
        &told("tokens", model.store.tokens(now()).await)?,
    )?;
    same(
        "the answer to repeat",
        &told("idempotency", new.idempotency("kept", now()).await)?,
        &repeated.idempotency,
    )?;
    let below = told("commits_after", new.commits_after(5, 10).await)?;
    same(
        "the floor that a follower of the old store is told",
        &below.floor,
        &expected,
    )?;
    // Revisions go on above, and what was at the new floor can be told.
    let mut change = samples::change(Op::Update, "a", expected + 1, Some(5));
    change.paths.clear();
    commit(
        new.as_ref(),
        &[samples::record(samples::commit_of(expected + 1, vec![change]))],
    )
    .await?;
    let before: BTreeMap<_, _> = told("documents_at", new.documents_at(expected, expected + 1).await)?
        .into_iter()
        .collect();
    let of_a = before.get(&samples::key("a")).cloned().flatten();
    same(
        "a at the floor",
        &of_a.as_ref(),
        &model.documents.get(&samples::key("a")),
    )?;
    new.close().await;
    let again = told("load", fixture.open(&name).await?.load().await)?;
    same("the revision after reopening", &again.revision, &(expected + 1))?;
    let full = fresh(fixture, "full").await?;
    commit(full.as_ref(), &[samples::record(samples::commit(1, &["x"]))]).await?;
    match backup::restore(full.as_ref(), &mut Cursor::new(&file)).await {
        Err(backup::BackupError::Store(StoreError::Refused(_))) => {}
        other => return Err(format!("a store that is not empty must be refused, but was {other:?}")),
    }
    same("its documents", &told("load", full.load().await)?.documents.len(), &1)
}

/// A store that was closed answers everything with [`StoreError::Unavailable`], and writes nothing.
///
/// # Errors
/// How the store breaks the rule.
pub async fn a_closed_store_is_unavailable(fixture: &dyn Fixture) -> Outcome {
    let name = store_name("closed");
    let store = fixture.open(&name).await?;
    commit(store.as_ref(), &[samples::record(samples::commit(1, &["a"]))]).await?;
    store.close().await;
    store.close().await;
    unavailable("load", store.load().await)?;
    unavailable("head", store.head().await)?;
    unavailable("trim", store.trim(1, 1).await)?;
    match store.commit(&[samples::record(samples::commit(2, &["a"]))]).await {
        Err(CommitError::NotWritten(StoreError::Unavailable(_))) => {}
        other => {
            return Err(format!(
                "a commit to a closed store must not be written, but was {other:?}"
            ));
        }
    }
    let again = fixture.open(&name).await?;
    same("the head afterwards", &told("head", again.head().await)?, &1)
}
