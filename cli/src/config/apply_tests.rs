use serde_json::json;

use super::*;
use crate::config::stub::{Asked, Reply, Stub};

const FILE: &str = "kind: Layer\nname: edge\nspec: { kind: edge }\n---\nkind: Node\nname: robot-1\nspec: { layer: edgee }\n";

fn sources() -> Vec<Source> {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("a.yaml");
    std::fs::write(&file, FILE).unwrap();
    files::read(&[file]).unwrap()
}

fn answer(revision: u64, affected: &Value, actions: [&str; 2]) -> Value {
    json!({
        "dry_run": false, "revision": revision, "affected": affected,
        "affected_total": affected.as_array().unwrap().len(),
        "results": [
            {
                "kind": "Layer",
                "name": "edge",
                "action": actions[0],
                "revision": revision,
                "changes": [],
            },
            {"kind": "Node", "name": "robot-1", "action": actions[1], "revision": revision,
             "changes": [{"op": "add", "path": "", "value": {}}]},
        ],
    })
}

#[tokio::test]
async fn all_files_go_in_one_request() {
    let stub =
        Stub::start(|_, _| Reply::json(&answer(420, &json!([]), ["unchanged", "created"]))).await;
    let request = Request { dry_run: true, prune: Some("site=lab"), prune_confirm: Some(25) };
    let answer = send(&stub.client(), &sources(), &request).await.unwrap();
    let asked = &stub.asked()[0];
    assert_eq!(asked.line(), "POST /api/v1/apply?dry_run=true&prune=site%3Dlab&prune_confirm=25");
    assert_eq!(asked.header("content-type"), Some("application/json"));
    assert_eq!(asked.json()[1]["spec"]["layer"], "edgee");
    assert!(table(&answer).contains("node/robot-1  created"), "{}", table(&answer));
    assert_eq!(summary(&answer), "1 created, 1 unchanged; revision 420; 0 configurations affected");
}

#[tokio::test]
async fn faults_are_told_with_file_and_line() {
    let stub = Stub::start(|_, _| {
        let problem =
            json!({"code": "reference_not_found", "title": "t", "detail": "d", "status": 422,
            "applied": "no",
            "errors": [{"pointer": "/spec/layer", "code": "reference_not_found",
                "detail": "no layer edgee", "document": 1}]});
        Reply::Full(422, Vec::new(), problem.to_string())
    })
    .await;
    let error = send(&stub.client(), &sources(), &Request::default()).await.unwrap_err();
    assert_eq!(error.exit() as u8, 7);
    assert!(
        error
            .to_string()
            .contains("a.yaml:5 (document 2): node/robot-1: /spec/layer: no layer edgee"),
        "{error}"
    );
    assert!(error.to_json()["errors"][0]["source"].as_str().unwrap().contains("a.yaml:5"));
}

#[tokio::test]
async fn nothing_and_too_much_are_refused_before_they_are_sent() {
    let stub = Stub::start(|_, _| Reply::Cut).await;
    let none = send(&stub.client(), &[], &Request::default()).await.unwrap_err();
    assert_eq!(none.exit() as u8, 2);
    let large = json!(["x".repeat(MAX_BYTES)]);
    let error = send_array(&stub.client(), &large, &Request::default()).await.unwrap_err();
    assert_eq!(error.exit() as u8, 7);
    assert!(stub.asked().is_empty());
}

#[test]
fn the_layers_concerned_are_those_of_what_is_affected_and_changed() {
    let sources = sources();
    let place =
        |layer: &Value| json!({"service": "slam", "instance": null, "layer": layer, "node": null});
    let names = |answer: &Value| {
        layers(answer, &sources).map(|layers| layers.into_iter().collect::<Vec<_>>())
    };
    let fog = json!([place(&json!("fog"))]);
    assert_eq!(names(&answer(1, &fog, ["unchanged", "unchanged"])).unwrap(), ["fog"]);
    assert_eq!(names(&answer(1, &fog, ["updated", "created"])).unwrap(), ["edge", "edgee", "fog"]);
    assert_eq!(names(&answer(1, &json!([place(&Value::Null)]), ["updated", "updated"])), None);
    let mut many = answer(1, &fog, ["updated", "updated"]);
    many["affected_total"] = json!(5_000);
    assert_eq!(names(&many), None);
}

fn workers(edge: u64, cloud: u64) -> Value {
    json!({"items": [
        {"layer": "edge", "node": "robot-1", "connected": true, "revision": edge},
        {"layer": "edge", "node": "robot-2", "connected": false, "revision": 1},
        {"layer": "cloud", "node": null, "connected": true, "revision": cloud},
    ]})
}

#[test]
fn only_connected_workers_of_the_layers_count() {
    let edge = BTreeSet::from(["edge".to_owned()]);
    let late = |workers: &Value, layers| behind(&concerned(workers, layers), 420);
    assert!(late(&workers(420, 1), Some(&edge)).is_empty());
    assert_eq!(
        late(&workers(419, 420), Some(&edge)),
        ["the worker of edge/robot-1 is at revision 419"]
    );
    assert_eq!(late(&workers(420, 1), None), ["the worker of cloud/- is at revision 1"]);
    assert_eq!(everywhere(0, 7), "revision 7 is written; no worker concerned is connected");
}

#[tokio::test]
async fn waiting_ends_when_all_have_it_or_the_time_is_over() {
    let stub = Stub::start(|_: &Asked, before| match before {
        0 => Reply::problem(503, "store_unavailable", "later"),
        1 => Reply::json(&workers(419, 1)),
        _ => Reply::json(&workers(420, 1)),
    })
    .await;
    let affected =
        json!([{"service": "slam", "instance": "0", "layer": "edge", "node": "robot-1"}]);
    let done = answer(420, &affected, ["updated", "unchanged"]);
    let client = stub.client();
    wait(&client, &done, &sources(), Duration::from_secs(60), Format::Json).await.unwrap();
    assert_eq!(stub.asked().len(), 3);

    let slow = Stub::start(|_, _| Reply::json(&workers(419, 1))).await;
    let client = slow.client();
    let error = wait(&client, &done, &sources(), Duration::ZERO, Format::Json).await.unwrap_err();
    assert_eq!(error.exit() as u8, 1);
    assert!(error.to_string().contains("edge/robot-1 is at revision 419"), "{error}");
    // Who may not ask for workers has written all the same.
    let hidden = Stub::start(|_, _| Reply::problem(403, "permission_denied", "no")).await;
    let error = wait(&hidden.client(), &done, &sources(), Duration::from_secs(60), Format::Json)
        .await
        .unwrap_err();
    assert!(error.to_string().contains("Revision 420 is written"), "{error}");
    // Where nothing changed there is nothing to wait for.
    let same = answer(420, &json!([]), ["unchanged", "unchanged"]);
    wait(&client, &same, &[], Duration::ZERO, Format::Json).await.unwrap();
}
