//! What the routes do with documents.

use super::*;

#[tokio::test]
async fn a_document_lives() {
    let api = open().await;
    let made = api.send("POST", "/api/v1/layers", &layer()).await;
    assert_eq!((made.status.as_u16(), made.header("location")), (201, "/api/v1/layers/edge"));
    let tag = made.header("etag").to_owned();
    assert_eq!(tag, format!("\"{}\"", made.header("blaze-revision")));
    assert_eq!(
        api.send("POST", "/api/v1/layers", &layer()).await.code(),
        (409, "already_exists".to_owned())
    );

    let read = api.get("/api/v1/layers/edge").await;
    assert_eq!((read.status.as_u16(), read.header("etag")), (200, tag.as_str()));
    let unchanged = api.call("GET", "/api/v1/layers/edge", &[("if-none-match", &tag)], "").await;
    assert_eq!(
        (unchanged.status.as_u16(), unchanged.body.len(), unchanged.header("etag")),
        (304, 0, tag.as_str())
    );
    let weak = format!("W/{tag}");
    assert_eq!(
        api.call("GET", "/api/v1/layers/edge", &[("if-none-match", &weak)], "").await.status,
        304
    );

    let other = json!({ "labels": { "site": "lab" }, "spec": { "kind": "edge" } });
    let put = async |headers: &[(&str, &str)], body: &Value| {
        api.send_with("PUT", "/api/v1/layers/edge", headers, body).await
    };
    let bare = put(&[], &other).await;
    assert_eq!(bare.code(), (428, "precondition_required".to_owned()));
    assert_eq!(bare.json()["revision"], read.json()["revision"]);
    assert_eq!(put(&[("if-match", "\"999\"")], &other).await.status, 412);
    assert_eq!(put(&[("if-match", &weak)], &other).await.status, 412);
    assert_eq!(put(&[("if-none-match", "*")], &other).await.status, 412);
    // Preconditions are looked at before the faults of the document.
    let faulty = json!({ "spec": { "kind": "edge" }, "colour": 1 });
    assert_eq!(put(&[], &faulty).await.status, 428);
    assert_eq!(put(&[("if-match", "\"999\"")], &faulty).await.status, 412);
    assert_eq!(put(&[("if-match", "*")], &faulty).await.status, 422);
    assert_eq!(api.send("PUT", "/api/v1/layers/fog", &faulty).await.status, 422);
    let replaced = put(&[("if-match", &tag)], &other).await;
    assert_eq!(
        (replaced.status.as_u16(), &replaced.json()["labels"]),
        (200, &json!({ "site": "lab" }))
    );

    let patch = json!({ "labels": { "site": null, "tier": "a" } });
    let patched = api.send_with("PATCH", "/api/v1/layers/edge", &[("if-match", "*")], &patch).await;
    assert_eq!(
        (patched.status.as_u16(), &patched.json()["labels"]),
        (200, &json!({ "tier": "a" }))
    );
    assert_eq!(api.send("PATCH", "/api/v1/layers/edge", &patch).await.status, 428);
    assert_eq!(api.send("PATCH", "/api/v1/layers/none", &json!({ "colour": 1 })).await.status, 404);

    let history = api.get("/api/v1/layers/edge/history?view=full&limit=2").await.json();
    assert_eq!(history["items"].as_array().unwrap().len(), 2);
    assert_eq!(history["items"][0]["document"]["labels"], json!({ "tier": "a" }));
    let diff = api.get("/api/v1/layers/edge/diff?from=1").await.json();
    assert_eq!(diff["changes"][0]["op"], "add");
    assert_eq!(
        api.get("/api/v1/layers/edge/diff").await.code(),
        (400, "invalid_request".to_owned())
    );
    let back = api.send("POST", "/api/v1/layers/edge/rollback", &json!({ "revision": 1 })).await;
    assert_eq!((back.status.as_u16(), &back.json()["labels"]), (200, &json!({})));

    assert_eq!(api.call("DELETE", "/api/v1/layers/edge", &[], "").await.status, 428);
    let gone = api.call("DELETE", "/api/v1/layers/edge", &[("if-match", "*")], "").await;
    assert_eq!((gone.status.as_u16(), gone.body.len()), (204, 0));
    assert!(!gone.header("blaze-revision").is_empty());
    assert_eq!(api.get("/api/v1/layers/edge").await.status, 404);
    assert_eq!(api.call("DELETE", "/api/v1/layers/edge", &[], "").await.status, 404);
    let made = api.send_with("PUT", "/api/v1/layers/edge", &[("if-none-match", "*")], &other).await;
    assert_eq!((made.status.as_u16(), made.header("location")), (201, "/api/v1/layers/edge"));
}

#[tokio::test]
async fn a_request_may_come_twice() {
    let api = open().await;
    let key = [("idempotency-key", "k-1")];
    let first = api.send_with("POST", "/api/v1/layers", &key, &layer()).await;
    assert_eq!((first.status.as_u16(), first.header("idempotent-replayed")), (201, ""));
    let again = api.send_with("POST", "/api/v1/layers", &key, &layer()).await;
    assert_eq!((again.status.as_u16(), again.header("idempotent-replayed")), (201, "true"));
    assert_eq!((again.json(), again.header("location")), (first.json(), "/api/v1/layers/edge"));
    let other = json!({ "name": "fog", "spec": { "kind": "fog" } });
    let reused = api.send_with("POST", "/api/v1/layers", &key, &other).await;
    assert_eq!(reused.code(), (422, "idempotency_key_reused".to_owned()));
    let bad = api.send_with("POST", "/api/v1/layers", &[("idempotency-key", "a b")], &other).await;
    assert_eq!(bad.code(), (400, "invalid_header".to_owned()));
}

#[tokio::test]
async fn many_documents_are_one_commit() {
    let api = open().await;
    let yaml = "kind: Node\nname: robot-1\nspec: { layer: edge }\n---\nkind: Layer\nname: edge\nspec: { kind: edge }\n";
    let headers = [("content-type", "application/yaml; charset=utf-8")];
    let dry = api.call("POST", "/api/v1/apply?dry_run=true", &headers, yaml).await;
    assert_eq!(
        (dry.status.as_u16(), &dry.json()["dry_run"]),
        (200, &json!(true)),
        "{}",
        dry.json()
    );
    assert_eq!(api.get("/api/v1/nodes/robot-1").await.status, 404);
    let applied = api.call("POST", "/api/v1/apply", &headers, yaml).await.json();
    assert_eq!(applied["results"][0]["action"], "created");
    assert_eq!(applied["results"][1]["kind"], "Layer");
    let same = api
        .send(
            "POST",
            "/api/v1/apply",
            &json!([{ "kind": "Layer", "name": "edge", "spec": { "kind": "edge" } }]),
        )
        .await;
    assert_eq!(same.json()["results"][0]["action"], "unchanged");
    let faulty = api
        .send(
            "POST",
            "/api/v1/apply",
            &json!([
                { "kind": "Layer", "name": "a", "spec": { "kind": "edge" } },
                { "kind": "Layer" },
            ]),
        )
        .await;
    assert_eq!((faulty.status.as_u16(), &faulty.json()["errors"][0]["document"]), (422, &json!(1)));
    let reverted =
        api.send("POST", "/api/v1/revert", &json!({ "revision": applied["revision"] })).await;
    assert_eq!(
        (reverted.status.as_u16(), &reverted.json()["results"][0]["action"]),
        (200, &json!("deleted"))
    );
}

#[tokio::test]
async fn the_rest_of_the_routes_answers() {
    let api = open().await.with_layer().await;
    for path in [
        "/api/v1/topology",
        "/api/v1/workers",
        "/api/v1/digest?layer=edge",
        "/api/v1/audit?limit=5&outcome=allowed&since_time=2020-01-01T00:00:00Z",
        "/api/v1/tokens",
        "/api/v1/effective?layer=edge&explain=true",
        "/api/v1/services/-/instances?layer=edge",
        "/api/v1/layers?label_selector=!spare&consistency=cached&min_revision=1",
    ] {
        let reply = api.get(path).await;
        assert_eq!(reply.status, 200, "{path} {}", reply.json());
        assert_eq!(reply.header("blaze-revision"), "1", "{path}");
        assert_eq!(reply.json()["revision"], 1, "{path}");
    }
    assert_eq!(api.get("/api/v1/digest").await.status, 400);
    assert_eq!(api.get("/api/v1/effective?service=none").await.status, 404);
    assert_eq!(
        api.get("/api/v1/layers?label_selector=%3D").await.code(),
        (400, "invalid_label_selector".to_owned())
    );
    assert_eq!(
        api.get("/api/v1/layers?page_token=x").await.code(),
        (400, "invalid_page_token".to_owned())
    );
    let token =
        api.send("POST", "/api/v1/tokens", &json!({ "subject": "a", "roles": ["viewer"] })).await;
    assert_eq!(token.code(), (409, "signing_disabled".to_owned()));
    assert_eq!(api.call("DELETE", "/api/v1/tokens/none", &[], "").await.status, 404);
    assert_eq!(
        api.send("POST", "/api/v1/trim", &json!({ "before": 1 })).await.json(),
        json!({ "oldest_revision": 0 })
    );
}
