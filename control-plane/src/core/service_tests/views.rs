//! What a token that is bound to a layer learns of others: nothing.

use super::*;

/// Robot-1 in layer edge with an instance of a service that the layer does not see, and node server
/// in fog.
async fn two_layers() -> (World, Caller) {
    let w = world().await;
    w.robot().await;
    w.put("Layer/fog", json!({ "kind": "fog" })).await;
    w.put("Node/server", json!({ "layer": "fog" })).await;
    w.put("Service/ghost", json!({ "layers": ["fog"] })).await;
    w.put("Instance/ghost/0", json!({ "node": "robot-1" })).await;
    (w, caller(&["operator"], Some("edge")))
}

#[tokio::test]
async fn refusals_name_only_what_is_seen() {
    let (w, bound) = two_layers().await;
    let delete = async |cascade| {
        let deleted =
            w.service.delete(&bound, &key("Node/robot-1"), Precondition::Any, cascade).await;
        deleted.unwrap_err()
    };
    let used = delete(false).await;
    assert_eq!(used.code, Code::InUse);
    assert!(
        used.detail.contains("Instance/slam/0, documents that the token does not see"),
        "{used}"
    );
    let cascaded = delete(true).await;
    assert_eq!(cascaded.code, Code::PermissionDenied);
    assert!(!format!("{used:?} {cascaded:?}").contains("ghost"), "{used} {cascaded}");
    // A schema of a service that is not seen.
    let schema = json!({ "properties": { "n": { "type": "integer" } } });
    w.patch("Service/ghost", json!({ "spec": { "schema": schema } })).await.unwrap();
    let patch = json!({ "spec": { "config": { "n": "text" } } });
    let refused =
        w.service.patch(&bound, &key("Node/robot-1"), patch, Precondition::Any).await.unwrap_err();
    assert_eq!(refused.code, Code::SchemaMismatch);
    assert_eq!((refused.errors.len(), refused.errors[0].pointer.as_str()), (1, "/spec"));
    assert!(!format!("{refused:?}").contains("ghost"), "{refused}");
}

#[tokio::test]
async fn who_is_affected_is_told_as_far_as_it_is_seen() {
    let (w, bound) = two_layers().await;
    let request = || ApplyRequest {
        items: vec![ApplyItem {
            input: input("Node/robot-1", json!({ "layer": "edge", "config": { "b": 7 } })),
            revision: None,
            delete: false,
        }],
        dry_run: true,
        ..ApplyRequest::default()
    };
    let names = async |caller: &Caller| {
        let report = w.service.apply(caller, request(), None).await.unwrap().value;
        assert_eq!(report.affected.len() as u64, report.affected_total);
        format!("{:?}", report.affected)
    };
    assert!(names(&w.admin).await.contains("ghost"));
    let own = names(&bound).await;
    assert!(own.contains("slam") && !own.contains("ghost"), "{own}");
}

#[tokio::test]
async fn the_past_outside_of_a_layer_is_not_shown_in_it() {
    let (w, bound) = two_layers().await;
    let read = ReadOptions::default();
    w.put("Node/n", json!({ "layer": "fog", "config": { "of": "fog" } })).await;
    let outside = w.get("Node/n").await.unwrap().revision;
    w.put("Node/n", json!({ "layer": "edge" })).await;
    let inside = w.get("Node/n").await.unwrap().revision;
    w.put("Node/n", json!({ "layer": "edge", "type": "mobile" })).await;
    let history = async |caller: &Caller, limit, token: &str| {
        let page = w.service.history(caller, &key("Node/n"), limit, token, true, &read).await;
        page.unwrap().value
    };
    assert_eq!(history(&w.admin, None, "").await.items.len(), 3);
    let seen = history(&bound, None, "").await;
    assert_eq!((seen.items.len(), seen.next_page_token.as_str()), (2, ""));
    assert!(!format!("{seen:?}").contains("fog"));
    let at = async |caller: &Caller, revision| {
        let read = ReadOptions { at_revision: Some(revision), ..ReadOptions::default() };
        w.service.get(caller, &key("Node/n"), &read).await
    };
    assert!(at(&w.admin, outside).await.is_ok());
    assert!(at(&bound, inside).await.is_ok());
    assert_eq!(code(at(&bound, outside).await), Code::PermissionDenied);
    let diff = w.service.diff(&bound, &key("Node/n"), outside, None, &read).await;
    assert_eq!(code(diff), Code::PermissionDenied);
    assert!(w.service.diff(&bound, &key("Node/n"), inside, None, &read).await.is_ok());
    let back = async |revision| {
        let (key, none) = (key("Node/n"), Precondition::None);
        w.service.rollback(&bound, &key, revision, none, None).await
    };
    assert_eq!(code(back(outside).await), Code::PermissionDenied);
    assert!(back(inside).await.is_ok());
    // Of a document that had the name before.
    w.delete("Node/n", false).await.unwrap();
    w.put("Node/n", json!({ "layer": "edge" })).await;
    assert_eq!(code(at(&bound, outside).await), Code::PermissionDenied);
}

#[tokio::test]
async fn an_answer_is_not_given_again_to_another_binding() {
    let (w, bound) = two_layers().await;
    let once = || {
        Some(Idempotency { key: "k".to_owned(), path: "/api/v1/nodes".to_owned(), body: [1; 32] })
    };
    let node = || input("Node/n", json!({ "layer": "fog" }));
    w.service.create(&w.admin, node(), once()).await.unwrap();
    for (other, expected) in
        [(bound, Code::PermissionDenied), (caller(&["operator"], Some("fog")), Code::AlreadyExists)]
    {
        assert_eq!(code(w.service.create(&other, node(), once()).await), expected);
    }
    assert!(w.service.create(&w.admin, node(), once()).await.unwrap().replayed);
}

#[tokio::test]
async fn an_instance_elsewhere_is_as_one_that_nobody_uses() {
    let (w, bound) = two_layers().await;
    w.put("Instance/slam/far", json!({ "node": "server", "config": { "of": "fog" } })).await;
    let of = async |instance: &str, layer: Option<&str>| {
        let place = Place {
            instance: Some(instance.parse().unwrap()),
            layer: layer.map(|layer| layer.parse().unwrap()),
            ..slam()
        };
        let answer = w.service.effective(&bound, &place, true, &ReadOptions::default()).await;
        answer.map(|answer| {
            let mut value = answer.value;
            value.place.instance = None;
            value
        })
    };
    assert_eq!(of("far", Some("edge")).await.unwrap(), of("unused", Some("edge")).await.unwrap());
    for name in ["far", "unused"] {
        assert_eq!(of(name, None).await.unwrap_err().code, Code::PermissionDenied, "{name}");
    }
}

#[tokio::test]
async fn a_bound_token_sees_and_changes_its_own_layer_alone() {
    let w = world().await;
    w.robot().await;
    w.put("Layer/fog", json!({ "kind": "fog" })).await;
    w.put("Service/cloud-only", json!({ "layers": ["fog"] })).await;
    let bound = caller(&["operator"], Some("edge"));
    let read = ReadOptions::default();
    for (name, seen) in [
        ("Layer/edge", true),
        ("Node/robot-1", true),
        ("Service/slam", true),
        ("Instance/slam/0", true),
        ("Layer/fog", false),
        ("Service/cloud-only", false),
        ("Node/absent", false),
    ] {
        let result = w.service.get(&bound, &key(name), &read).await;
        match seen {
            true => assert!(result.is_ok(), "{name}"),
            false => assert_eq!(code(result), Code::PermissionDenied, "{name}"),
        }
    }
    let patch = async |name: &str, spec: Value| {
        let patch = json!({ "spec": spec });
        w.service.patch(&bound, &key(name), patch, Precondition::Any).await
    };
    assert_eq!(
        code(patch("Service/slam", json!({ "description": "x" })).await),
        Code::PermissionDenied
    );
    assert_eq!(
        code(patch("Node/robot-1", json!({ "layer": "fog" })).await),
        Code::PermissionDenied
    );
    assert!(patch("Node/robot-1", json!({ "type": "mobile" })).await.is_ok());
    w.put("Node/server", json!({ "layer": "fog" })).await;
    // Of many documents, those outside are refused before anything is told of them.
    let apply = async |name: &str, spec: Value, revision: Option<u64>, delete: bool| {
        let items = vec![ApplyItem { input: input(name, spec), revision, delete }];
        let request = ApplyRequest { items, ..ApplyRequest::default() };
        w.service.apply(&bound, request, None).await
    };
    let fog = || json!({ "layer": "fog" });
    for outside in [
        apply("Node/server", fog(), None, false).await,
        apply("Node/server", fog(), Some(1), false).await,
        apply("Node/absent", fog(), Some(1), false).await,
        apply("Node/absent", json!({}), None, true).await,
        apply("Service/slam", json!({}), None, false).await,
    ] {
        assert_eq!(code(outside), Code::PermissionDenied);
    }
    // What is placed nowhere counts everywhere: a roll-out on it is none of one layer's.
    w.put("Instance/slam/anywhere", json!({})).await;
    let rollout = json!({
        "target": {
            "kind": "Instance",
            "service": "slam",
            "name": "anywhere",
        }, "patch": { "config": { "a": 5 } },
        "canary": { "node_selector": "!absent" },
    });
    let started = w.service.create(&bound, input("Rollout/r", rollout), None).await;
    assert_eq!(code(started), Code::PermissionDenied);
    // Who may make tokens could make one that is bound to nothing.
    let admin = caller(&["admin"], Some("edge"));
    let token = TokenRequest {
        subject: "x".to_owned(),
        roles: vec!["admin".to_owned()],
        layer: None,
        expires_in_s: 60,
    };
    assert_eq!(code(w.service.create_token(&admin, token).await), Code::PermissionDenied);
    assert_eq!(code(w.service.revoke_token(&admin, "x").await), Code::PermissionDenied);
    assert_eq!(code(w.service.tokens(&admin, &read).await), Code::PermissionDenied);
    assert_eq!(
        code(w.service.audit(&admin, AuditQuery::default(), "", &read).await),
        Code::PermissionDenied
    );
    assert_eq!(code(w.service.trim(&admin, 1, None).await), Code::PermissionDenied);
    assert!(w.service.authorize(&caller(&["viewer"], None).claims, Right::Write).is_err());
    assert!(w.service.authorize(&caller(&["admin", "wizard"], None).claims, Right::Read).is_err());
}
