//! Answers of the methods are those of REST, and no text of a secret is in any that was not asked
//! for it.

use std::fmt::Debug;

use serde_json::{Value, json};

use super::*;

/// A text that nobody may see who does not ask for it.
const CANARY: &str = "canary-5f1c";

fn clean(what: &str, said: &str) {
    assert!(!said.contains(CANARY), "{what} holds the secret: {said}");
}

/// The message of an answer, without a secret.
fn shown<T: Debug>(what: &str, answer: Result<tonic::Response<T>, tonic::Status>) -> T {
    let message = answer.unwrap_or_else(|status| panic!("{what}: {status:?}")).into_inner();
    clean(what, &format!("{message:?}"));
    message
}

fn parsed(json: &str) -> Value {
    serde_json::from_str(json).unwrap_or_else(|error| panic!("{json}: {error}"))
}

/// A document as REST shows it.
fn same(document: &v1::Document, rest: &Value) {
    assert_eq!(parsed(&document.spec_json), rest["spec"]);
    assert_eq!(
        (json!(document.uid), json!(document.revision)),
        (rest["uid"].clone(), rest["revision"].clone())
    );
    match document.status_json.as_str() {
        "" => assert!(rest["status"].is_null(), "{rest}"),
        status => assert_eq!(parsed(status), rest["status"]),
    }
}

fn service() -> Option<v1::Ref> {
    reference(v1::Kind::Service, "slam")
}

fn item(r#ref: Option<v1::Ref>, spec: &Value) -> v1::ApplyItem {
    let document = v1::Document {
        r#ref,
        spec_json: spec.to_string(),
        labels: [("canary".to_owned(), "true".to_owned())].into(),
        ..Default::default()
    };
    v1::ApplyItem { document: Some(document), delete: false }
}

/// A service with a secret and one instance, in revision 1.
async fn world() -> Fixture {
    let fixture = Fixture::open().await;
    let secret = json!({ "$secret": format!("{CANARY}-1") });
    let mut instance = reference(v1::Kind::Instance, "0").unwrap();
    instance.service = "slam".into();
    let apply = v1::ApplyRequest {
        items: vec![
            item(reference(v1::Kind::Layer, "edge"), &json!({ "kind": "edge" })),
            item(reference(v1::Kind::Node, "robot-1"), &json!({ "layer": "edge" })),
            item(service(), &json!({ "config": { "n": 1, "password": secret } })),
            item(Some(instance), &json!({ "node": "robot-1" })),
        ],
        ..Default::default()
    };
    let answer = shown("Apply", fixture.client().apply(apply).await);
    assert_eq!(answer.revision, 1);
    fixture
}

async fn get(fixture: &Fixture, reveal: bool) -> v1::Document {
    let request = v1::GetRequest {
        r#ref: service(),
        read: Some(v1::ReadOptions { reveal, ..Default::default() }),
    };
    fixture.client().get(request).await.unwrap().into_inner()
}

#[tokio::test]
async fn what_shows_the_system_says_the_same_as_rest() {
    let fixture = world().await;
    let mut client = fixture.client();
    let token = v1::CreateTokenRequest {
        subject: "ops".into(),
        roles: vec!["viewer".into()],
        ..Default::default()
    };
    let token = client.create_token(token).await.unwrap().into_inner();
    let revoke = v1::RevokeTokenRequest { id: token.id.clone() };
    shown("RevokeToken", client.revoke_token(revoke).await);

    let place = v1::Place { service: "slam".into(), instance: "0".into(), ..Default::default() };
    let effective = v1::GetEffectiveRequest { place: Some(place), explain: true, read: None };
    let effective = shown("GetEffective", client.get_effective(effective).await);
    let rest = fixture.rest("/api/v1/effective?service=slam&instance=0&explain=true").await;
    assert_eq!(parsed(&effective.config_json), rest["config"]);
    assert_eq!(parsed(&effective.explain_json), rest["explain"]);
    assert_eq!(
        (json!(effective.revision), json!(effective.hash)),
        (rest["revision"].clone(), rest["hash"].clone())
    );
    let place = effective.place.unwrap();
    for (member, name) in [
        ("service", place.service),
        ("instance", place.instance),
        ("layer", place.layer),
        ("node", place.node),
    ] {
        assert_eq!(name, rest[member].as_str().unwrap_or_default(), "{member}");
    }
    assert!(effective.config_json.contains("redacted"), "the secret is part of what is shown");

    let digest = v1::GetDigestRequest { layer: "edge".into() };
    let digest = shown("GetDigest", client.get_digest(digest).await).json;
    let topology = shown("GetTopology", client.get_topology(v1::GetTopologyRequest {}).await).json;
    let workers = shown("ListWorkers", client.list_workers(v1::ListWorkersRequest {}).await).json;
    let audit = shown("ListAudit", client.list_audit(v1::ListAuditRequest::default()).await).json;
    let tokens = shown("ListTokens", client.list_tokens(v1::ListTokensRequest {}).await).json;
    for (said, path, holds) in [
        (digest, "digest?layer=edge", "digest"),
        (topology, "topology", "robot-1"),
        (workers, "workers", "revision"),
        (audit, "audit", "token_revoke"),
        (tokens.clone(), "tokens", token.id.as_str()),
    ] {
        assert_eq!(parsed(&said), fixture.rest(&format!("/api/v1/{path}")).await, "{path}");
        assert!(said.contains(holds), "{path}: {said}");
    }
    assert!(parsed(&tokens)["items"][0]["revoke_time"].is_string(), "it was revoked: {tokens}");
}

#[tokio::test]
async fn what_changes_the_past_and_ends_roll_outs_does_it() {
    let fixture = world().await;
    let mut client = fixture.client();
    let n = async || parsed(&get(&fixture, false).await.spec_json)["config"]["n"].clone();
    let patch = v1::PatchRequest {
        r#ref: service(),
        merge_patch_json: json!({ "spec": { "config": { "n": 2 } } }).to_string(),
        precondition: exactly(1),
    };
    shown("Patch", client.patch(patch).await);
    let rollback = v1::RollbackRequest { r#ref: service(), revision: 1, ..Default::default() };
    let back = shown("Rollback", client.rollback(rollback).await);
    assert_eq!((back.revision, n().await), (3, json!(1)));
    same(&back, &fixture.rest("/api/v1/services/slam").await);

    let set = |name: &str, action: &str, reason: &str| v1::SetRolloutRequest {
        name: name.into(),
        action: action.into(),
        reason: reason.into(),
    };
    let mut promoted = 0;
    for (name, action, reason, phase, tried) in
        [("good", "promote", "", "promoted", 3), ("bad", "abort", "enough of it", "aborted", 4)]
    {
        let spec = json!({
            "target": { "kind": "Service", "name": "slam" }, "patch": { "config": { "n": tried } },
            "canary": { "node_selector": "canary=true" }, "gate": {
                "window_s": 60,
                "max_unhealthy": 0,
            },
        });
        let create = v1::CreateRequest {
            document: item(reference(v1::Kind::Rollout, name), &spec).document,
            request_id: String::new(),
        };
        shown("Create", client.create(create).await);
        let ended = shown(action, client.set_rollout(set(name, action, reason)).await);
        let status = parsed(&ended.status_json);
        assert_eq!(
            (&status["phase"], status["reason"].as_str().unwrap_or_default()),
            (&json!(phase), reason)
        );
        same(&ended, &fixture.rest(&format!("/api/v1/rollouts/{name}")).await);
        if phase == "promoted" {
            promoted = ended.revision;
        }
        assert_eq!(n().await, 3, "{name}");
        let again = client.set_rollout(set(name, "abort", "")).await.unwrap_err();
        assert_eq!(
            (again.code(), code(&again)),
            (tonic::Code::FailedPrecondition, Code::RolloutState),
            "{name}"
        );
    }
    let revert = v1::RevertRequest { revision: promoted, force: false };
    let report = shown("Revert", client.revert(revert).await);
    let ops: Vec<_> = report.results.iter().map(v1::ApplyResult::op).collect();
    assert!(ops.contains(&v1::Op::Update), "{report:?}");
    assert_eq!(n().await, 1);
    let trimmed = shown("Trim", client.trim(v1::TrimRequest { before: 3 }).await);
    assert_eq!(parsed(&trimmed.json), json!({ "oldest_revision": 2 }));
}

#[tokio::test]
async fn a_secret_is_told_to_nobody_who_does_not_ask_for_it() {
    let fixture = world().await;
    let mut client = fixture.client();
    let secret = |number: u32| json!({ "$secret": format!("{CANARY}-{number}") });
    let document = |spec_json: String| {
        Some(v1::Document { r#ref: service(), spec_json, ..Default::default() })
    };
    let replace = v1::ReplaceRequest {
        document: document(json!({ "config": { "password": secret(2) } }).to_string()),
        precondition: exactly(1),
    };
    let mut said = vec![format!("{:?}", shown("Replace", client.replace(replace).await))];
    let patch = |merge_patch_json: String| v1::PatchRequest {
        r#ref: service(),
        merge_patch_json,
        precondition: Some(v1::Precondition { is: Some(v1::precondition::Is::Any(true)) }),
    };
    let merge = json!({ "spec": { "config": { "list": [secret(3)] } } }).to_string();
    said.push(format!("{:?}", shown("Patch", client.patch(patch(merge)).await)));
    let list = v1::ListRequest { kind: v1::Kind::Service.into(), ..Default::default() };
    said.push(format!("{:?}", shown("List", client.list(list).await)));
    let history = v1::ListHistoryRequest { r#ref: service(), full: true, ..Default::default() };
    said.push(format!("{:?}", shown("ListHistory", client.list_history(history).await)));
    let diff = v1::DiffRequest { r#ref: service(), from_revision: 1, to_revision: 3 };
    said.push(format!("{:?}", shown("Diff", client.diff(diff).await)));
    let watch = v1::WatchRequest { since: Some(0), ..Default::default() };
    let mut stream = client.watch(watch).await.unwrap().into_inner();
    let mut told = 0;
    while told < 3 {
        if let Some(Event::Commit(commit)) = stream.next().await.unwrap().unwrap().event {
            told = commit.revision;
            said.push(format!("{commit:?}"));
        }
    }
    for said in said {
        clean("an answer", &said);
        assert!(said.contains("redacted"), "that there is a secret is shown: {said}");
    }

    // What ends too soon is not quoted where that is said.
    let cut = format!(r#"{{"spec":{{"config":{{"password":{{"$secret":"{CANARY}-4"#);
    let create = v1::CreateRequest { document: document(cut.clone()), request_id: String::new() };
    let wrong =
        json!({ "spec": { "config": { "a": { "$secret": format!("{CANARY}-5"), "b": 1 } } } });
    for refused in [
        client.create(create).await.unwrap_err(),
        client.patch(patch(cut)).await.unwrap_err(),
        client.patch(patch(wrong.to_string())).await.unwrap_err(),
    ] {
        assert_eq!(refused.code(), tonic::Code::InvalidArgument, "{refused:?}");
        clean("a refusal", &format!("{refused:?} {:?}", refused.get_error_details()));
    }

    clean("Get", &get(&fixture, false).await.spec_json);
    let revealed = get(&fixture, true).await.spec_json;
    assert_eq!(
        parsed(&revealed).pointer("/config/password/$secret/text"),
        Some(&json!(format!("{CANARY}-2"))),
        "{revealed}"
    );
}
