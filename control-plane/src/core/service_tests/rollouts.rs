//! Roll-outs: what may be tried, and what becomes of it.

use super::*;

fn on(kind: &str, name: &str, patch: &Value) -> Value {
    json!({
        "target": { "kind": kind, "name": name }, "patch": patch,
        "canary": { "node_selector": "canary=true" }, "gate": {
            "window_s": 60,
            "max_unhealthy": 0,
        },
    })
}

/// A robot that is a canary, without any configuration of its own.
async fn canary_world() -> World {
    let w = world().await;
    w.apply(vec![
        ("Layer/edge", json!({ "kind": "edge" })),
        ("Layer/fog", json!({ "kind": "fog" })),
        ("Service/s", json!({ "config": { "n": 1 } })),
    ])
    .await
    .unwrap();
    let mut node = input("Node/robot-1", json!({ "layer": "edge" }));
    node.labels.insert("canary".to_owned(), "true".to_owned());
    w.service.create(&w.admin, node, None).await.unwrap();
    w
}

async fn start(w: &World, by: &Caller, name: &str, spec: Value) -> Result<Written, Problem> {
    let rollout = input(&format!("Rollout/{name}"), spec);
    Ok(w.service.create(by, rollout, None).await?.value)
}

#[tokio::test]
async fn a_roll_out_is_checked_where_it_is_tried() {
    let w = canary_world().await;
    let schema = json!({ "properties": { "n": { "type": "integer" } } });
    w.patch("Service/s", json!({ "spec": { "schema": schema } })).await.unwrap();
    for (kind, name, patch) in [
        ("Service", "s", json!({ "config": { "n": "text" } })),
        ("Layer", "edge", json!({ "config": { "n": "text" } })),
        ("Node", "robot-1", json!({ "overrides": { "s": { "n": "text" } } })),
    ] {
        let refused = start(&w, &w.admin, "r", on(kind, name, &patch)).await;
        assert_eq!(code(refused), Code::SchemaMismatch, "{kind}");
    }
    let patch = json!({ "config": { "n": 2 } });
    let items = vec![("Rollout/r", on("Service", "s", &patch))];
    let report = w.apply(items).await.unwrap();
    let nodes: Vec<_> = report.affected.iter().filter_map(|place| place.node.as_ref()).collect();
    assert_eq!(nodes.len(), 1, "{report:?}");
    w.patch("Node/robot-1", json!({ "labels": { "x": "y" } })).await.unwrap();
}

#[tokio::test]
async fn what_a_roll_out_makes_of_its_target_must_be_allowed() {
    let w = canary_world().await;
    let refused =
        start(&w, &w.admin, "r", on("Node", "robot-1", &json!({ "layer": "nowhere" }))).await;
    let problem = refused.unwrap_err();
    assert_eq!(problem.code, Code::ReferenceNotFound);
    assert_eq!(problem.errors[0].pointer, "/spec/patch/layer");
    let bound = caller(&["operator"], Some("edge"));
    let moves = on("Node", "robot-1", &json!({ "layer": "fog" }));
    assert_eq!(code(start(&w, &bound, "r", moves).await), Code::PermissionDenied);
    let stays = on("Node", "robot-1", &json!({ "type": "mobile" }));
    start(&w, &bound, "r", stays).await.unwrap();

    // Two halves that are too large together, when it begins and when it is promoted.
    let half = |letter: &str| letter.repeat(140 * 1024);
    w.put("Service/s", json!({ "config": { "a": half("a") } })).await;
    let large = on("Service", "s", &json!({ "config": { "b": half("b") } }));
    assert_eq!(code(start(&w, &w.admin, "large", large.clone()).await), Code::PayloadTooLarge);
    w.put("Service/s", json!({})).await;
    start(&w, &w.admin, "large", large).await.unwrap();
    w.put("Service/s", json!({ "config": { "a": half("a") } })).await;
    let promoted = w.service.promote_rollout(&w.admin, &"large".parse().unwrap(), None).await;
    assert_eq!(code(promoted), Code::PayloadTooLarge);
}

#[tokio::test]
async fn one_roll_out_at_a_time_until_it_has_ended() {
    let w = canary_world().await;
    let spec = || on("Service", "s", &json!({ "config": { "n": 2 } }));
    start(&w, &w.admin, "first", spec()).await.unwrap();
    let problem = start(&w, &w.admin, "second", spec()).await.unwrap_err();
    let first = w.get("Rollout/first").await.unwrap();
    assert_eq!((problem.code, problem.revision), (Code::RolloutActive, Some(first.revision)));
    let name = "first".parse().unwrap();
    w.service.abort_rollout(&w.admin, &name, "enough", None).await.unwrap();
    start(&w, &w.admin, "second", spec()).await.unwrap();
    let again = w.service.abort_rollout(&w.admin, &name, "", None).await.unwrap_err();
    let first = w.get("Rollout/first").await.unwrap();
    assert_eq!((again.code, again.revision), (Code::RolloutState, Some(first.revision)));
}

#[tokio::test]
async fn a_promotion_can_be_reverted_and_the_roll_out_stays_as_it_is() {
    let w = canary_world().await;
    let spec = on("Service", "s", &json!({ "config": { "n": 2 } }));
    let started = start(&w, &w.admin, "r", spec).await.unwrap().document.revision;
    let name = "r".parse().unwrap();
    let promoted = w.service.promote_rollout(&w.admin, &name, None).await.unwrap().revision;
    assert_eq!(w.get("Service/s").await.unwrap().spec["config"]["n"], 2);
    let report = w.service.revert(&w.admin, promoted, false, None).await.unwrap().value;
    assert_eq!(w.get("Service/s").await.unwrap().spec["config"]["n"], 1);
    let rollout = w.get("Rollout/r").await.unwrap();
    assert_eq!(rollout.status.as_ref().unwrap()["phase"], "promoted");
    let left = report.results.iter().find(|result| result.key == rollout.key).unwrap();
    assert_eq!(left.action, ApplyAction::Unchanged);
    // What made it is reverted by taking it away.
    w.service.revert(&w.admin, started, true, None).await.unwrap();
    assert_eq!(code(w.get("Rollout/r").await), Code::NotFound);
    // A commit that changed nothing but a roll-out has nothing to give back.
    start(&w, &w.admin, "q", on("Service", "s", &json!({ "config": { "n": 3 } }))).await.unwrap();
    let name = "q".parse().unwrap();
    let aborted = w.service.abort_rollout(&w.admin, &name, "", None).await.unwrap().revision;
    assert_eq!(code(w.service.revert(&w.admin, aborted, false, None).await), Code::RolloutState);
}

#[tokio::test]
async fn a_schema_that_is_tried_is_checked_on_the_canaries() {
    let w = canary_world().await;
    let tries = |schema: Value| on("Service", "s", &json!({ "schema": schema }));
    let broken = start(&w, &w.admin, "r", tries(json!({ "type": "objekt" }))).await.unwrap_err();
    assert_eq!(
        (broken.code, broken.errors[0].pointer.as_str()),
        (Code::ValidationFailed, "/spec/patch/schema")
    );
    let wrong = json!({ "properties": { "n": { "type": "string" } } });
    assert_eq!(code(start(&w, &w.admin, "r", tries(wrong)).await), Code::SchemaMismatch);
    let right = json!({ "properties": { "n": { "maximum": 5 } } });
    start(&w, &w.admin, "r", tries(right)).await.unwrap();
    // Where it is tried it holds, and elsewhere not yet.
    let refused = w.patch("Node/robot-1", json!({ "spec": { "config": { "n": 6 } } })).await;
    assert_eq!(code(refused), Code::SchemaMismatch);
    w.put("Node/robot-2", json!({ "layer": "edge", "config": { "n": 6 } })).await;
    let promoted = w.service.promote_rollout(&w.admin, &"r".parse().unwrap(), None).await;
    assert_eq!(code(promoted), Code::SchemaMismatch);
}

#[tokio::test]
async fn a_roll_out_is_judged_by_what_the_whole_request_makes() {
    let w = world().await;
    let item = |name: &str, spec: Value, canary: bool| {
        let mut input = input(name, spec);
        if canary {
            input.labels.insert("canary".to_owned(), "true".to_owned());
        }
        ApplyItem { input, revision: None, delete: false }
    };
    let apply = async |items: Vec<ApplyItem>| {
        let request = ApplyRequest { items, ..ApplyRequest::default() };
        w.service.apply(&w.admin, request, None).await
    };
    let rollout = || on("Service", "s", &json!({ "config": { "n": 2 } }));
    let node = || json!({ "layer": "edge" });
    let layer = || item("Layer/edge", json!({ "kind": "edge" }), false);
    // With its target and its node, in whatever order.
    let all = vec![
        item("Rollout/r", rollout(), false),
        item("Node/robot-1", node(), true),
        item("Service/s", json!({ "config": { "n": 1 } }), false),
        layer(),
    ];
    apply(all).await.unwrap();
    let status = w.get("Rollout/r").await.unwrap().status.clone().unwrap();
    assert_eq!(status["canaries"][0]["node"], "robot-1");
    w.service.abort_rollout(&w.admin, &"r".parse().unwrap(), "", None).await.unwrap();
    // A node that is none afterwards.
    let without = vec![item("Rollout/q", rollout(), false), item("Node/robot-1", node(), false)];
    let problem = apply(without).await.unwrap_err();
    assert_eq!(problem.errors[0].pointer, "/spec/canary/node_selector");
    assert_eq!(problem.errors[0].document, Some(0));
    // A target that is too large together with the patch.
    let half = |letter: &str| letter.repeat(140 * 1024);
    let large = on("Service", "s", &json!({ "config": { "b": half("b") } }));
    let large = vec![
        item("Rollout/q", large, false),
        item("Service/s", json!({ "config": { "a": half("a") } }), false),
    ];
    assert_eq!(code(apply(large).await), Code::PayloadTooLarge);
}

#[tokio::test]
async fn a_roll_out_that_began_tells_its_revision() {
    let w = canary_world().await;
    let spec = on("Service", "s", &json!({ "config": { "n": 2 } }));
    let started = start(&w, &w.admin, "r", spec).await.unwrap().document.revision;
    let other = on("Service", "s", &json!({ "config": { "n": 3 } }));
    let problem = w.try_put("Rollout/r", other, Precondition::Any).await.unwrap_err();
    assert_eq!((problem.code, problem.revision), (Code::RolloutState, Some(started)));
    let back = w
        .service
        .rollback(&w.admin, &key("Rollout/r"), started, Precondition::None, None)
        .await
        .unwrap_err();
    assert_eq!((back.code, back.revision), (Code::RolloutState, Some(started)));
}

#[tokio::test]
async fn a_roll_out_is_not_tried_on_more_nodes_than_its_status_can_tell_of() {
    let w = canary_world().await;
    for half in 0..2 {
        let keys: Vec<String> = (0..500).map(|number| format!("Node/n{half}-{number}")).collect();
        let nodes = keys.iter().map(|key| (key.as_str(), json!({ "layer": "edge" })));
        w.apply(nodes.collect()).await.unwrap();
    }
    let mut spec = on("Service", "s", &json!({ "config": { "n": 2 } }));
    // All but those with a label that nobody has.
    spec["canary"]["node_selector"] = json!("!none");
    let refused = start(&w, &w.admin, "r", spec).await.unwrap_err();
    assert_eq!(refused.code, Code::ValidationFailed);
    assert!(refused.errors[0].detail.contains("more than 1000 nodes"), "{refused:?}");
}

#[tokio::test]
async fn a_roll_out_counts_on_its_canaries_until_it_is_promoted() {
    let w = world().await;
    w.robot().await;
    let mut second = input("Node/robot-2", json!({ "layer": "edge" }));
    second.labels.insert("canary".to_owned(), "true".to_owned());
    w.service.create(&w.admin, second, None).await.unwrap();
    let spec = json!({
        "target": { "kind": "Service", "name": "slam" },
        "patch": { "config": { "camera": { "rate_hz": 5 } } },
        "canary": { "node_selector": "canary=true" }, "gate": {
            "window_s": 60,
            "max_unhealthy": 0,
        },
    });
    let started = w
        .service
        .create(&w.admin, input("Rollout/slower", spec.clone()), None)
        .await
        .unwrap()
        .value;
    assert_eq!(started.document.status.as_ref().unwrap()["phase"], "canary");
    let on = |node: &str| Place {
        service: Some("slam".parse().unwrap()),
        node: Some(node.parse().unwrap()),
        ..Place::default()
    };
    assert_eq!(w.effective(on("robot-2")).await.config["camera"]["rate_hz"], 5);
    assert_eq!(w.effective(on("robot-2")).await.rollout.as_deref(), Some("slower"));
    assert_eq!(w.effective(on("robot-1")).await.config["camera"]["rate_hz"], 30);
    assert_eq!(
        code(w.service.create(&w.admin, input("Rollout/other", spec), None).await),
        Code::RolloutActive
    );
    let name = "slower".parse().unwrap();
    w.service.promote_rollout(&w.admin, &name, None).await.unwrap();
    assert_eq!(w.effective(on("robot-1")).await.config["camera"]["rate_hz"], 5);
    assert_eq!(
        code(w.service.abort_rollout(&w.admin, &name, "late", None).await),
        Code::RolloutState
    );
}

#[tokio::test]
async fn a_change_is_tried_only_where_its_target_counts() {
    let w = world().await;
    w.robot().await;
    w.put("Layer/fog", json!({ "kind": "fog" })).await;
    for (name, layer) in [("robot-2", "edge"), ("server", "fog")] {
        let mut node = input(&format!("Node/{name}"), json!({ "layer": layer }));
        node.labels.insert("canary".to_owned(), "true".to_owned());
        w.service.create(&w.admin, node, None).await.unwrap();
    }
    w.put("Service/inner", json!({ "layers": ["fog"] })).await;
    let spec = |kind: &str, name: &str| {
        json!({
            "target": { "kind": kind, "name": name }, "patch": { "config": { "a": 5 } },
            "canary": { "node_selector": "canary=true" }, "gate": {
                "window_s": 60,
                "max_unhealthy": 0,
            },
        })
    };
    for (kind, name, expected) in [
        ("Service", "slam", &["robot-2", "server"][..]),
        ("Service", "inner", &["server"]),
        ("Layer", "edge", &["robot-2"]),
        ("Node", "server", &["server"]),
    ] {
        let rollout = input(&format!("Rollout/to-{name}"), spec(kind, name));
        let started = w.service.create(&w.admin, rollout, None).await.unwrap().value;
        let canaries =
            started.document.status.as_ref().unwrap()["canaries"].as_array().unwrap().clone();
        let names: Vec<&str> =
            canaries.iter().map(|canary| canary["node"].as_str().unwrap()).collect();
        assert_eq!(names, expected, "{kind} {name}");
    }
    let nowhere = input("Rollout/nowhere", spec("Node", "robot-1"));
    assert_eq!(code(w.service.create(&w.admin, nowhere, None).await), Code::ValidationFailed);
}
