//! What a token that is bound to a layer learns of others: nothing.

use super::*;

/// Robot-1 in layer edge with an instance of a service that the layer does not see, and node server in fog.
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
        let deleted = w
            .service
            .delete(&bound, &key("Node/robot-1"), Precondition::Any, cascade)
            .await;
        deleted.unwrap_err()
    };
    let used = delete(false).await;
    assert_eq!(used.code, Code::InUse);
    assert!(
        used.detail
            .contains("Instance/slam/0, documents that the token does not see"),
        "{used}"
    );
    let cascaded = delete(true).await;
    assert_eq!(cascaded.code, Code::PermissionDenied);
    assert!(!format!("{used:?} {cascaded:?}").contains("ghost"), "{used} {cascaded}");
    // A schema of a service that is not seen.
    let schema = json!({ "properties": { "n": { "type": "integer" } } });
    w.patch("Service/ghost", json!({ "spec": { "schema": schema } }))
        .await
        .unwrap();
    let patch = json!({ "spec": { "config": { "n": "text" } } });
    let refused = w
        .service
        .patch(&bound, &key("Node/robot-1"), patch, Precondition::Any)
        .await
        .unwrap_err();
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
    w.put("Node/n", json!({ "layer": "fog", "config": { "of": "fog" } }))
        .await;
    let outside = w.get("Node/n").await.unwrap().revision;
    w.put("Node/n", json!({ "layer": "edge" })).await;
    let inside = w.get("Node/n").await.unwrap().revision;
    w.put("Node/n", json!({ "layer": "edge", "type": "mobile" })).await;
    let history = async |caller: &Caller, limit, token: &str| {
        let page = w
            .service
            .history(caller, &key("Node/n"), limit, token, true, &read)
            .await;
        page.unwrap().value
    };
    assert_eq!(history(&w.admin, None, "").await.items.len(), 3);
    let seen = history(&bound, None, "").await;
    assert_eq!((seen.items.len(), seen.next_page_token.as_str()), (2, ""));
    assert!(!format!("{seen:?}").contains("fog"));
    let at = async |caller: &Caller, revision| {
        let read = ReadOptions {
            at_revision: Some(revision),
            ..ReadOptions::default()
        };
        w.service.get(caller, &key("Node/n"), &read).await
    };
    assert!(at(&w.admin, outside).await.is_ok());
    assert!(at(&bound, inside).await.is_ok());
    assert_eq!(code(at(&bound, outside).await), Code::PermissionDenied);
    let diff = w.service.diff(&bound, &key("Node/n"), outside, None, &read).await;
    assert_eq!(code(diff), Code::PermissionDenied);
    assert!(
        w.service
            .diff(&bound, &key("Node/n"), inside, None, &read)
            .await
            .is_ok()
    );
    let back = async |revision| {
        let (key, none) = (key("Node/n"), Precondition::None);
        w.service.rollback(&bound, &key, revision, none, None).await
    };
    assert_eq!(code(back(outside).await), Code::PermissionDenied);
    assert!(back(inside).await.is_ok());
    // Of a document that had the name before.
    let none = Precondition::Any;
    w.service.delete(&w.admin, &key("Node/n"), none, false).await.unwrap();
    w.put("Node/n", json!({ "layer": "edge" })).await;
    assert_eq!(code(at(&bound, outside).await), Code::PermissionDenied);
}

#[tokio::test]
async fn an_answer_is_not_given_again_to_another_binding() {
    let (w, bound) = two_layers().await;
    let once = || {
        Some(Idempotency {
            key: "k".to_owned(),
            path: "/api/v1/nodes".to_owned(),
            body: [1; 32],
        })
    };
    let node = || input("Node/n", json!({ "layer": "fog" }));
    w.service.create(&w.admin, node(), once()).await.unwrap();
    for (other, expected) in [
        (bound, Code::PermissionDenied),
        (caller(&["operator"], Some("fog")), Code::AlreadyExists),
    ] {
        assert_eq!(code(w.service.create(&other, node(), once()).await), expected);
    }
    assert!(w.service.create(&w.admin, node(), once()).await.unwrap().replayed);
}

#[tokio::test]
async fn an_instance_elsewhere_is_as_one_that_nobody_uses() {
    let (w, bound) = two_layers().await;
    w.put(
        "Instance/slam/far",
        json!({ "node": "server", "config": { "of": "fog" } }),
    )
    .await;
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
    assert_eq!(
        of("far", Some("edge")).await.unwrap(),
        of("unused", Some("edge")).await.unwrap()
    );
    for name in ["far", "unused"] {
        assert_eq!(of(name, None).await.unwrap_err().code, Code::PermissionDenied, "{name}");
    }
}
