//! The core from outside, on a store in memory.

mod behind;
mod failed;
mod once;
mod pages;
mod rollouts;
mod secrets;
mod sync;
mod views;
mod watches;
mod writes;

use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::config::{Code, Document, Key, Labels, Problem};
use blaze_runtime::Supervisor;
use futures::{FutureExt as _, StreamExt as _};
use serde_json::{Value, json};

use super::types::*;
use super::{ConfigService, testing};
use crate::auth::{Claims, Right};
use crate::store::{AuditQuery, SqliteStore, Store};

struct World {
    service: ConfigService,
    admin: Caller,
    _supervisor: Supervisor,
}

async fn world() -> World {
    let supervisor = Supervisor::new("test");
    let service = testing::service(&supervisor).await.unwrap();
    World { admin: caller(&["admin"], None), service, _supervisor: supervisor }
}

fn caller(roles: &[&str], layer: Option<&str>) -> Caller {
    Caller {
        claims: Arc::new(Claims {
            subject: "ops".to_owned(),
            roles: roles.iter().map(|role| (*role).to_owned()).collect(),
            layer: layer.map(|layer| layer.parse().unwrap()),
            expires_s: None,
            token_id: None,
        }),
        request_id: "r-1".to_owned(),
        address: IpAddr::V4(Ipv4Addr::LOCALHOST),
    }
}

fn key(text: &str) -> Key {
    text.parse().unwrap()
}

fn input(name: &str, spec: Value) -> DocumentInput {
    DocumentInput { key: key(name), labels: Labels::new(), annotations: Labels::new(), spec }
}

impl World {
    async fn put(&self, name: &str, spec: Value) -> Arc<Document> {
        self.try_put(name, spec, Precondition::Any).await.unwrap().document
    }

    async fn try_put(
        &self,
        name: &str,
        spec: Value,
        precondition: Precondition,
    ) -> Result<Written, Problem> {
        let exists = self.get(name).await.is_ok();
        let precondition = if exists || precondition != Precondition::Any {
            precondition
        } else {
            Precondition::None
        };
        let answer = self.service.replace(&self.admin, input(name, spec), precondition).await?;
        Ok(answer.value)
    }

    async fn get(&self, name: &str) -> Result<Arc<Document>, Problem> {
        let read = ReadOptions::default();
        Ok(self.service.get(&self.admin, &key(name), &read).await?.value)
    }

    async fn patch(&self, name: &str, patch: Value) -> Result<Arc<Document>, Problem> {
        let answer = self.service.patch(&self.admin, &key(name), patch, Precondition::Any).await?;
        Ok(answer.value.document)
    }

    async fn delete(&self, name: &str, cascade: bool) -> Result<Answer<()>, Problem> {
        let any = Precondition::Any;
        self.service.delete(&self.admin, &key(name), any, cascade).await
    }

    /// A document with its secrets as text.
    async fn revealed(&self, name: &str) -> Arc<Document> {
        let reveal = ReadOptions { reveal: true, ..ReadOptions::default() };
        self.service.get(&self.admin, &key(name), &reveal).await.unwrap().value
    }

    async fn apply(&self, items: Vec<(&str, Value)>) -> Result<ApplyReport, Problem> {
        let items = items.into_iter().map(|(name, spec)| ApplyItem {
            input: input(name, spec),
            revision: None,
            delete: false,
        });
        let request = ApplyRequest { items: items.collect(), ..ApplyRequest::default() };
        Ok(self.service.apply(&self.admin, request, None).await?.value)
    }

    async fn effective(&self, place: Place) -> Effective {
        let read = ReadOptions::default();
        self.service.effective(&self.admin, &place, true, &read).await.unwrap().value
    }

    /// A robot in an edge layer with a service that has one instance.
    async fn robot(&self) {
        let report = self
            .apply(vec![
                (
                    "Layer/edge",
                    json!({
                        "kind": "edge",
                        "config": { "a": 1, "b": 1 },
                        "overrides": { "slam": { "c": 3 } },
                    }),
                ),
                ("Node/robot-1", json!({ "layer": "edge", "config": { "b": 2 } })),
                ("Service/slam", json!({ "config": { "a": 0, "camera": { "rate_hz": 30 } } })),
                (
                    "Instance/slam/0",
                    json!({ "node": "robot-1", "config": { "camera": { "rate_hz": 10 } } }),
                ),
            ])
            .await
            .unwrap();
        assert_eq!(report.revision, 1);
    }
}

fn slam() -> Place {
    Place {
        service: Some("slam".parse().unwrap()),
        instance: Some("0".parse().unwrap()),
        ..Place::default()
    }
}

fn code<T: std::fmt::Debug>(result: Result<T, Problem>) -> Code {
    result.unwrap_err().code
}

#[tokio::test]
async fn a_document_is_made_read_changed_and_deleted() {
    let w = world().await;
    let made = w.put("Layer/edge", json!({ "kind": "edge" })).await;
    assert_eq!((made.revision, made.updated_by.as_str()), (1, "ops"));
    assert_eq!(w.get("Layer/edge").await.unwrap(), made);
    // The same again changes nothing, also where `{}` is written out.
    let same = w.put("Layer/edge", json!({ "kind": "edge", "config": {} })).await;
    assert_eq!(same.revision, 1);
    let patched = w.patch("Layer/edge", json!({ "labels": { "site": "lab" } })).await.unwrap();
    assert_eq!((patched.revision, patched.uid == made.uid), (2, true));
    assert_eq!(w.service.revision(), 2);
    w.delete("Layer/edge", false).await.unwrap();
    assert_eq!(code(w.get("Layer/edge").await), Code::NotFound);
    let again = w.put("Layer/edge", json!({ "kind": "edge" })).await;
    assert_ne!(again.uid, made.uid);
}

#[tokio::test]
async fn preconditions_are_insisted_on() {
    let w = world().await;
    let spec = || json!({ "kind": "edge" });
    let other = || json!({ "kind": "fog" });
    assert_eq!(
        code(w.try_put("Layer/edge", spec(), Precondition::Revisions(vec![1])).await),
        Code::PreconditionFailed
    );
    assert_eq!(
        code(w.service.patch(&w.admin, &key("Layer/edge"), json!({}), Precondition::None).await),
        Code::NotFound
    );
    w.put("Layer/edge", spec()).await;
    assert_eq!(
        code(w.try_put("Layer/edge", other(), Precondition::None).await),
        Code::PreconditionRequired
    );
    assert_eq!(
        code(w.try_put("Layer/edge", other(), Precondition::Absent).await),
        Code::PreconditionFailed
    );
    let stale =
        w.try_put("Layer/edge", other(), Precondition::Revisions(vec![7])).await.unwrap_err();
    assert_eq!((stale.code, stale.revision), (Code::PreconditionFailed, Some(1)));
    assert_eq!(
        code(w.service.create(&w.admin, input("Layer/edge", spec()), None).await),
        Code::AlreadyExists
    );
    let written =
        w.try_put("Layer/edge", other(), Precondition::Revisions(vec![7, 1])).await.unwrap();
    assert_eq!((written.created, written.document.revision), (false, 2));
}

#[tokio::test]
async fn the_effective_configuration_is_merged_in_order_and_explained() {
    let w = world().await;
    w.robot().await;
    let effective = w.effective(slam()).await;
    assert_eq!(effective.config, json!({ "a": 1, "b": 2, "c": 3, "camera": { "rate_hz": 10 } }));
    assert_eq!(effective.place.node.as_ref().map(ToString::to_string).as_deref(), Some("robot-1"));
    let explain = effective.explain.unwrap();
    assert_eq!(explain["/camera/rate_hz"]["kind"], "Instance");
    assert_eq!(explain["/camera/rate_hz"]["overridden"][0]["value"], 30);
    assert_eq!(explain["/c"]["override"], true);
    let mut unknown = slam();
    unknown.service = Some("slamm".parse().unwrap());
    let refused =
        w.service.effective(&w.admin, &unknown, false, &ReadOptions::default()).await.unwrap_err();
    assert_eq!(refused.code, Code::NotFound);
    assert!(refused.detail.contains("did you mean slam?"), "{refused}");
}

#[tokio::test]
async fn references_must_exist_and_hold() {
    let w = world().await;
    let missing = w
        .try_put("Node/robot-1", json!({ "layer": "edge" }), Precondition::None)
        .await
        .unwrap_err();
    assert_eq!(missing.code, Code::ReferenceNotFound);
    assert_eq!(missing.errors[0].pointer, "/spec/layer");
    w.robot().await;
    let used = w.delete("Layer/edge", false).await;
    assert_eq!(code(used), Code::InUse);
    w.delete("Layer/edge", true).await.unwrap();
    for gone in ["Layer/edge", "Node/robot-1", "Instance/slam/0"] {
        assert_eq!(code(w.get(gone).await), Code::NotFound, "{gone}");
    }
    assert!(w.get("Service/slam").await.is_ok());
    assert_eq!(w.service.revision(), 2);
}

#[tokio::test]
async fn a_schema_guards_every_write_that_could_break_it() {
    let w = world().await;
    w.robot().await;
    let schema = json!({
        "type": "object", "required": ["camera"],
        "properties": { "camera": { "type": "object",
            "properties": { "rate_hz": { "type": "integer", "maximum": 30 } } } },
    });
    w.patch("Service/slam", json!({ "spec": { "schema": schema } })).await.unwrap();
    for (name, patch) in [
        ("Instance/slam/0", json!({ "spec": { "config": { "camera": { "rate_hz": 31 } } } })),
        (
            "Node/robot-1",
            json!({ "spec": { "overrides": { "slam": { "camera": { "rate_hz": "fast" } } } } }),
        ),
        ("Layer/edge", json!({ "spec": { "overrides": { "slam": { "camera": 5 } } } })),
        ("Service/slam", json!({ "spec": { "config": { "camera": { "rate_hz": 99 } } } })),
    ] {
        let refused = w.patch(name, patch).await.unwrap_err();
        assert_eq!(refused.code, Code::SchemaMismatch, "{name}");
        assert!(!refused.detail.contains("99"), "values are not told: {refused}");
    }
    let bad = w
        .patch("Service/slam", json!({ "spec": { "schema": { "type": "objekt" } } }))
        .await
        .unwrap_err();
    assert_eq!(
        (bad.code, bad.errors[0].pointer.as_str()),
        (Code::ValidationFailed, "/spec/schema")
    );
}

#[tokio::test]
async fn apply_is_all_or_nothing() {
    let w = world().await;
    w.robot().await;
    let refused = w
        .apply(vec![
            ("Layer/fog", json!({ "kind": "fog" })),
            ("Node/fog-1", json!({ "layer": "foog" })),
        ])
        .await
        .unwrap_err();
    assert_eq!((refused.code, refused.errors[0].document), (Code::ReferenceNotFound, Some(1)));
    assert!(refused.detail.contains("did you mean Layer/fog?"), "{refused}");
    assert_eq!(code(w.get("Layer/fog").await), Code::NotFound);
    let twice = w
        .apply(vec![("Layer/x", json!({ "kind": "fog" })), ("Layer/x", json!({ "kind": "fog" }))])
        .await;
    assert_eq!(code(twice), Code::ValidationFailed);
    let report = w
        .apply(vec![
            ("Node/robot-1", json!({ "layer": "edge", "config": { "b": 5 } })),
            ("Layer/fog", json!({ "kind": "fog" })),
            ("Service/slam", json!({ "config": { "a": 0, "camera": { "rate_hz": 30 } } })),
        ])
        .await
        .unwrap();
    let actions: Vec<&str> = report.results.iter().map(|result| result.action.as_str()).collect();
    assert_eq!(actions, ["updated", "created", "unchanged"]);
    assert_eq!(report.results[0].changes[0].path, "/spec/config/b");
    assert!(
        report.affected.iter().any(|place| place.instance.is_some() && place.node.is_some()),
        "{report:?}"
    );
    assert_eq!(report.revision, 2);
}

#[tokio::test]
async fn pruning_needs_confirmation_beyond_twenty() {
    let w = world().await;
    for number in 0..22 {
        let mut one = input(&format!("Layer/l{number}"), json!({ "kind": "fog" }));
        one.labels.insert("app".to_owned(), "x".to_owned());
        w.service.create(&w.admin, one, None).await.unwrap();
    }
    let request = |confirm| ApplyRequest {
        prune: Some("app=x".to_owned()),
        prune_confirm: confirm,
        ..ApplyRequest::default()
    };
    let refused = w.service.apply(&w.admin, request(None), None).await.unwrap_err();
    assert_eq!(refused.code, Code::LimitExceeded);
    assert!(refused.detail.contains("22"), "{refused}");
    let report = w.service.apply(&w.admin, request(Some(22)), None).await.unwrap().value;
    assert_eq!(report.results.len(), 22);
}

/// A world on a store that may hold something, with these keys.
async fn world_on<S: Store>(store: &Arc<S>, keys: &[(&str, [u8; 32])]) -> World {
    let supervisor = Supervisor::new("test");
    let store = Arc::clone(store) as Arc<dyn Store>;
    World {
        admin: caller(&["admin"], None),
        service: testing::service_on(&supervisor, store, keys).await.unwrap(),
        _supervisor: supervisor,
    }
}

#[tokio::test]
async fn what_is_written_leaves_an_old_key_behind_and_what_has_no_key_is_not_shown_as_empty() {
    let supervisor = Supervisor::new("store");
    let store = Arc::new(SqliteStore::in_memory(&supervisor).await.unwrap());
    let (old, new) = (("e1", [7; 32]), ("e2", [8; 32]));
    let w = world_on(&store, &[old]).await;
    for name in ["Service/a", "Service/b"] {
        w.put(name, json!({ "config": { "password": { "$secret": "canary" } } })).await;
    }
    let w = world_on(&store, &[new, old]).await;
    let again =
        json!({ "config": { "password": { "$secret": { "redacted": true, "version": 1 } } } });
    assert_eq!(w.put("Service/a", again).await.revision, 1, "a new key alone is no change");
    w.patch("Service/a", json!({ "spec": { "description": "x" } })).await.unwrap();

    let w = world_on(&store, &[new]).await;
    let password = async |name: &str| {
        let shown = w.revealed(name).await;
        shown.spec["config"]["password"]["$secret"].clone()
    };
    assert_eq!(password("Service/a").await, json!({ "text": "canary", "version": 1 }));
    let kept = password("Service/b").await;
    assert_eq!(kept, json!({ "redacted": true, "version": 2 }));
    // Who writes it back as it was shown does not lose it.
    let back = json!({ "description": "y", "config": { "password": { "$secret": kept } } });
    w.put("Service/b", back).await;
    let w = world_on(&store, &[new, old]).await;
    let clear = w.revealed("Service/b").await;
    assert_eq!(clear.spec["config"]["password"]["$secret"]["text"], "canary");
}

#[tokio::test]
async fn secrets_are_kept_encrypted_and_shown_redacted() {
    let w = world().await;
    let canary = "canary-7d1f";
    let spec = |secret: Value| json!({ "config": { "db": { "password": secret } } });
    let made = w.put("Service/slam", spec(json!({ "$secret": canary }))).await;
    let redacted = json!({ "$secret": { "redacted": true, "version": 1 } });
    assert_eq!(made.spec.pointer("/config/db/password"), Some(&redacted));
    // What was read may be written back: the text stays.
    let same = w.put("Service/slam", spec(redacted.clone())).await;
    assert_eq!(same.revision, 1);
    let changed = w.patch("Service/slam", json!({ "spec": { "description": "x" } })).await.unwrap();
    assert_eq!(changed.spec.pointer("/config/db/password"), Some(&redacted));
    let reveal = ReadOptions { reveal: true, ..ReadOptions::default() };
    let clear = w.revealed("Service/slam").await;
    let shown = json!({ "$secret": { "text": canary, "version": 1 } });
    assert_eq!(clear.spec.pointer("/config/db/password"), Some(&shown));
    let unknown = w.try_put("Service/other", spec(redacted), Precondition::None).await;
    assert_eq!(code(unknown), Code::SecretUnknown);
    let operator = caller(&["operator"], None);
    assert_eq!(
        code(w.service.get(&operator, &key("Service/slam"), &reveal).await),
        Code::PermissionDenied
    );
    // A new text has a new version, and a rollback brings the old one back.
    let newer = w.put("Service/slam", spec(json!({ "$secret": "other" }))).await;
    assert_eq!(newer.spec.pointer("/config/db/password/$secret/version"), Some(&json!(3)));
    w.service.rollback(&w.admin, &key("Service/slam"), 1, Precondition::None, None).await.unwrap();
    let clear = w.revealed("Service/slam").await;
    assert_eq!(clear.spec.pointer("/config/db/password/$secret/text"), Some(&json!(canary)));
    let history = w
        .service
        .history(&w.admin, &key("Service/slam"), None, "", true, &ReadOptions::default())
        .await
        .unwrap();
    assert!(!format!("{history:?}").contains(canary));
    let audit = w
        .service
        .audit(&w.admin, AuditQuery::default(), "", &ReadOptions::default())
        .await
        .unwrap();
    assert!(!format!("{audit:?}").contains(canary));
    assert!(audit.value.items.iter().any(|entry| entry.action == "reveal"));
}

#[tokio::test]
async fn a_commit_is_reverted_unless_its_documents_changed_since() {
    let w = world().await;
    w.robot().await;
    let before = w.get("Node/robot-1").await.unwrap();
    w.apply(vec![
        ("Node/robot-1", json!({ "layer": "edge", "type": "mobile" })),
        ("Layer/fog", json!({ "kind": "fog" })),
    ])
    .await
    .unwrap();
    let report = w.service.revert(&w.admin, 2, false, None).await.unwrap();
    assert_eq!(report.revision, 3);
    assert_eq!(w.get("Node/robot-1").await.unwrap().spec, before.spec);
    assert_eq!(code(w.get("Layer/fog").await), Code::NotFound);
    assert_eq!(code(w.service.revert(&w.admin, 2, false, None).await), Code::RevisionConflict);
    assert_eq!(code(w.service.revert(&w.admin, 99, false, None).await), Code::NotFound);
}
