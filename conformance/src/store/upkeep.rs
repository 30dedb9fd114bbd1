//! Backup, restore, rewriting, closing.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::sync::Arc;

use blaze_domain::config::Document;
use serde_json::{Value, json};

use super::Fixture;
use super::samples::{self, answer, audit, token};
use super::tools::{Model, by_key, commit, fresh, log, store_name, unavailable};
use blaze_config::store::upkeep::{RESTORE_RAISES_BY, now};
use blaze_config::store::{AuditQuery, CommitError, Op, StoreError, backup};

/// Each document and each version is rewritten, once, and nothing else changes.
pub async fn documents_are_rewritten_in_place(fixture: &dyn Fixture) {
    let mut model = Model::new(fixture, "rewrite").await;
    let names: Vec<String> = (0..450).map(|number| format!("n{number}")).collect();
    let all: Vec<&str> = names.iter().map(String::as_str).collect();
    model.write(&[&all, &all[..10], &["-n0"]]).await;
    let make = |document: &Document| {
        let mut new = document.clone();
        let mut spec = (*new.spec).clone();
        let place = spec.pointer_mut("/config/password/$secret/key")?;
        let old = std::mem::replace(place, Value::from("e2"));
        new.spec = Arc::new(spec);
        (old != json!("e2")).then_some(new)
    };
    let rewritten = model.store.rewrite(&make).await.unwrap();
    assert_eq!(rewritten, (449 + 450 + 10 + 1), "how many were rewritten");
    assert_eq!(model.store.rewrite(&make).await.unwrap(), 0, "how many a second time");
    for documents in model.states.iter_mut().chain([&mut model.documents]) {
        for document in documents.values_mut() {
            if let Some(new) = make(document) {
                *document = new;
            }
        }
    }
    model.check_now().await;
    model.check_past(0).await;
    assert_eq!(log(model.store.as_ref(), 0).await.len(), 3, "commits");
}

/// A restored store has the documents, their history, audit, tokens and answers of the backup,
/// another identity, and a revision far above; everything before it counts as trimmed. The backup
/// is of one revision although writing went on.
pub async fn a_backup_is_restored_elsewhere(fixture: &dyn Fixture) {
    let mut model = Model::new(fixture, "backup").await;
    model.write(&[&["a", "b"], &["a"], &["-b"], &["c"]]).await;
    let mut repeated = model.record(&["a"]);
    repeated.idempotency = Some(answer("kept", 5));
    commit(model.store.as_ref(), &[repeated.clone()]).await;
    model.store.add_token(&token("t"), &audit("token_create", None)).await.unwrap();
    model.store.trim(2, 20).await.unwrap();
    let mut file = Vec::new();
    let saving = backup::write(|pieces| model.store.export(pieces), &mut file);
    let summary = saving.await.unwrap();
    assert_eq!(summary.head.revision, 5, "the revision of the backup");
    let name = store_name("restored");
    let new = fixture.open(&name).await;
    let restored = backup::restore(new.as_ref(), &mut Cursor::new(&file)).await.unwrap();
    let expected = 5 + RESTORE_RAISES_BY;
    let snapshot = new.load().await.unwrap();
    assert_eq!((snapshot.revision, snapshot.floor), (expected, expected), "revision and floor");
    assert_eq!(snapshot.store_id, restored.store_id, "the identity");
    assert_ne!(snapshot.store_id, summary.head.store_id, "the identity of the old one");
    assert_eq!(by_key(snapshot.documents), model.documents, "the documents");
    assert_eq!(new.head().await.unwrap(), expected, "the head");
    for name in ["a", "b", "c"] {
        let key = samples::key(name);
        let old = model.store.versions(&key, None, 20).await.unwrap();
        assert_eq!(new.versions(&key, None, 20).await.unwrap(), old, "history of {name}");
    }
    let query = AuditQuery { limit: 100, ..AuditQuery::default() };
    assert_eq!(
        new.audit(&query).await.unwrap(),
        model.store.audit(&query).await.unwrap(),
        "the audit"
    );
    assert_eq!(
        new.tokens(now()).await.unwrap(),
        model.store.tokens(now()).await.unwrap(),
        "the tokens"
    );
    assert_eq!(
        new.idempotency("kept", now()).await.unwrap(),
        repeated.idempotency,
        "the answer to repeat"
    );
    let below = new.commits_after(5, 10).await.unwrap();
    assert_eq!(below.floor, expected, "the floor that a follower of the old store is told");
    // Revisions go on above, and what was at the new floor can be told.
    let mut change = samples::change(Op::Update, "a", expected + 1, Some(5));
    change.paths.clear();
    commit(new.as_ref(), &[samples::record(samples::commit_of(expected + 1, vec![change]))]).await;
    let before: BTreeMap<_, _> =
        new.documents_at(expected, expected + 1).await.unwrap().into_iter().collect();
    let of_a = before.get(&samples::key("a")).cloned().flatten();
    assert_eq!(of_a.as_ref(), model.documents.get(&samples::key("a")), "a at the floor");
    new.close().await;
    let again = fixture.open(&name).await.load().await.unwrap();
    assert_eq!(again.revision, expected + 1, "the revision after reopening");
    let full = fresh(fixture, "full").await;
    commit(full.as_ref(), &[samples::record(samples::commit(1, &["x"]))]).await;
    let refused = backup::restore(full.as_ref(), &mut Cursor::new(&file)).await.err();
    let is_refused = matches!(refused, Some(backup::BackupError::Store(StoreError::Refused(_))));
    assert!(is_refused, "a store that is not empty must be refused: {refused:?}");
    assert_eq!(full.load().await.unwrap().documents.len(), 1, "its documents");
}

/// A store that was closed answers everything with [`StoreError::Unavailable`], and writes nothing.
pub async fn a_closed_store_is_unavailable(fixture: &dyn Fixture) {
    let name = store_name("closed");
    let store = fixture.open(&name).await;
    commit(store.as_ref(), &[samples::record(samples::commit(1, &["a"]))]).await;
    store.close().await;
    store.close().await;
    unavailable("load", store.load().await);
    unavailable("head", store.head().await);
    unavailable("trim", store.trim(1, 1).await);
    let told = store.commit(&[samples::record(samples::commit(2, &["a"]))]).await;
    let is_refused = matches!(told, Err(CommitError::NotWritten(StoreError::Unavailable(_))));
    assert!(is_refused, "a commit to a closed store: {told:?}");
    let again = fixture.open(&name).await;
    assert_eq!(again.head().await.unwrap(), 1, "the head afterwards");
}
