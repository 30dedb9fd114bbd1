//! Tables, order and changes of `blaze problems`.

use super::*;
use crate::args::Command;
use crate::args::tests::parse;
use crate::config::stub::{Reply, Stub};

/// Half a minute after the problems of these tests began.
const NOW: i64 = 1_795_244_472_345;
const SINCE: &str = "2026-11-21T07:00:42.345Z";

fn problem(code: &str, name: &str, state: &str) -> Value {
    json!({"code": code, "scope": "node", "name": name, "state": state, "since": SINCE,
        "detail": "2 % free", "remedy": "Delete what is old."})
}

fn placed(code: &str, name: &str, state: &str) -> Value {
    let mut problem = problem(code, name, state);
    problem["layer"] = "edge".into();
    problem["node"] = "robot-1".into();
    problem
}

fn options(line: &str) -> ProblemsOptions {
    match parse(line).unwrap().command {
        Command::Problems(options) => options,
        other => panic!("{other:?}"),
    }
}

#[test]
fn the_server_is_asked_where_the_command_line_names_one() {
    assert!(!options("problems -w --monitor robot:9103").server.is_given());
    assert!(options("problems --server http://127.0.0.1:1").server.is_given());
    assert!(options("problems --context lab").server.is_given());
}

#[tokio::test]
async fn problems_of_node_and_services_come_worst_first_with_their_place() {
    let health = json!({"layer": "edge", "node": "robot-1", "state": "down", "since": SINCE,
        "problems": [problem("hot", "cpu", "degraded"), 7],
        "services": [{"service": "slam", "instance": "0", "problems":
            [problem("service_gone", "slam/0", "down"), problem("hot", "cpu", "degraded")]}]});
    let stub = Stub::start(move |_, _| Reply::json(&health)).await;
    let admin = stub.admin();
    let found = Source::Monitor(&admin).problems().await.unwrap();
    assert_eq!(found, [placed("service_gone", "slam/0", "down"), placed("hot", "cpu", "degraded")]);
    assert_eq!(stub.lines(), ["GET /v1/health"]);
    let stub = Stub::start(|_, _| Reply::json(&json!({"flow": "edge/robot-1"}))).await;
    let admin = stub.admin();
    let error = Source::Monitor(&admin).problems().await.unwrap_err();
    assert!(error.to_string().contains("not as a monitor does"), "{error}");
}

#[tokio::test]
async fn the_main_service_is_asked_for_all_nodes() {
    let stub = Stub::start(|_, _| {
        let of_layer = json!({"code": "no_ready_flow", "scope": "layer", "name": "fog",
            "state": "down", "since": SINCE, "layer": "fog"});
        Reply::json(&json!({"items": [placed("hot", "cpu", "degraded"), of_layer]}))
    })
    .await;
    let found = Source::Server(Box::new(stub.client())).problems().await.unwrap();
    assert_eq!(
        table(&found, NOW, None),
        "STATE     FOR  CODE           WHERE         WHAT       DETAIL\n\
         down      30s  no_ready_flow  fog           layer fog\n\
         degraded  30s  hot            edge/robot-1  node cpu   2 % free\n\
         What to do (hot): Delete what is old.\n"
    );
    assert_eq!(table(&[], NOW, None), "No problems.\n");
}

#[tokio::test]
async fn a_watch_survives_a_monitor_that_ends_but_no_refusal() {
    let stub = Stub::start(|_, before| match before {
        0 => Reply::Cut,
        1 => Reply::Full(503, Vec::new(), String::new()),
        _ => Reply::Full(404, Vec::new(), String::new()),
    })
    .await;
    let admin = stub.admin();
    let source = Source::Monitor(&admin);
    for expected in [true, true, false] {
        let error = source.problems().await.unwrap_err();
        assert_eq!(passes(&error), expected, "{error}");
    }
}

#[test]
fn changes_are_raised_and_cleared_once() {
    let mut known = Known::default();
    let (hot, full) = (placed("hot", "cpu", "degraded"), placed("disk_full", "/", "degraded"));
    let texts = |changes: Vec<Change>| -> Vec<String> {
        changes.iter().map(|change| line(change, Format::Table).unwrap()).collect()
    };
    let first = texts(known.update(vec![hot.clone(), full.clone()], "T1"));
    assert_eq!(
        first[0],
        format!(
            "{SINCE}  RAISED   hot  edge/robot-1  node cpu  degraded: 2 % free  What to do: Delete \
             what is old."
        )
    );
    assert_eq!(first.len(), 2);
    // Other figures are no change; another state is one.
    let mut moved = hot.clone();
    moved["detail"] = "3 % free".into();
    assert_eq!(known.update(vec![moved, full], "T2"), []);
    let worse = placed("disk_full", "/", "down");
    let next = texts(known.update(vec![worse], "T3"));
    assert_eq!(next[0], "T3  CLEARED  hot  edge/robot-1  node cpu");
    assert!(
        next[1].starts_with("T3  RAISED   disk_full  edge/robot-1  node /  down: "),
        "{next:?}"
    );
    let last = known.update(Vec::new(), "T4");
    let json: Value = serde_json::from_str(&line(&last[0], Format::Json).unwrap()).unwrap();
    assert_eq!((&json["change"], &json["time"]), (&json!("cleared"), &json!("T4")));
    assert_eq!(json["code"], "disk_full");
}
