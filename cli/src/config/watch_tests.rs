use super::*;
use crate::config::stub::{Asked, Reply, Stub};

fn change(revision: u64, kind: &str, name: &str) -> Value {
    json!({
        "op": "update",
        "kind": kind,
        "name": name,
        "document": {"kind": kind, "name": name, "revision": revision},
    })
}

fn commit(revision: u64, changes: &[Value]) -> Value {
    json!({"revision": revision, "time": "t", "subject": "ops", "changes": changes})
}

fn event(commit: &Value) -> String {
    format!("retry: 1\nid: {}\nevent: change\ndata: {commit}\n\n", commit["revision"])
}

/// Follows until so many things were shown.
async fn first(client: &Client, scope: &Scope, since: Option<u64>, number: usize) -> Vec<Shown> {
    let mut all = Vec::new();
    let mut show = |shown: Shown| {
        all.push(shown);
        if all.len() == number { Err(CliError::OutputClosed) } else { Ok(()) }
    };
    let ended = follow(client, scope, since, false, &mut show).await;
    assert!(matches!(ended, Err(CliError::OutputClosed)), "{ended:?}");
    all
}

#[tokio::test]
async fn a_trimmed_watch_lists_and_goes_on_without_gap_or_repeat() {
    let node = json!({"kind": "Node", "name": "a", "revision": 90});
    let listed = node.clone();
    let stub = Stub::start(move |asked: &Asked, _| match asked.target.as_str() {
        target if target.starts_with("/api/v1/watch") && target.contains("since=3") => {
            Reply::problem(410, "revision_trimmed", "gone")
        }
        // Layers were listed at 95, nodes at 97: what lies between is told for layers and not again
        // for nodes.
        target if target.starts_with("/api/v1/watch") => {
            let both = commit(96, &[change(96, "Layer", "edge"), change(96, "Node", "a")]);
            let old = commit(97, &[change(97, "Node", "a")]);
            let new = commit(98, &[change(98, "Node", "a")]);
            Reply::Events(format!("{}{}{}", event(&both), event(&old), event(&new)))
        }
        "/api/v1/nodes?limit=1000" => {
            Reply::json(&json!({"items": [listed], "revision": 97, "next_page_token": ""}))
        }
        "/api/v1/layers?limit=1" => {
            Reply::json(&json!({"items": [], "revision": 94, "next_page_token": "x"}))
        }
        _ => Reply::json(&json!({"items": [], "revision": 95, "next_page_token": ""})),
    })
    .await;
    let shown = first(&stub.client(), &Scope::default(), Some(3), 8).await;
    let empty = |kind| Shown::Listed { kind, revision: 95, items: Vec::new() };
    assert_eq!(
        shown,
        [
            Shown::Relist(Lost::Trimmed),
            empty(Kind::Layer),
            Shown::Listed { kind: Kind::Node, revision: 97, items: vec![node] },
            empty(Kind::Service),
            empty(Kind::Instance),
            empty(Kind::Rollout),
            Shown::Commit(commit(96, &[change(96, "Layer", "edge")])),
            Shown::Commit(commit(98, &[change(98, "Node", "a")])),
        ]
    );
    assert!(stub.lines().contains(&"GET /api/v1/watch?since=95".to_owned()));
}

#[tokio::test]
async fn one_document_is_listed_alone_also_when_it_is_gone() {
    let stub = Stub::start(|asked: &Asked, _| match asked.target.as_str() {
        "/api/v1/layers?limit=1" => {
            Reply::json(&json!({"items": [], "revision": 50, "next_page_token": ""}))
        }
        "/api/v1/services/slam/instances/0" => Reply::problem(404, "not_found", "no"),
        target if target.ends_with("since=50") => {
            Reply::Events(event(&commit(51, &[change(51, "Instance", "0")])))
        }
        _ => Reply::problem(410, "revision_unknown", "ahead"),
    })
    .await;
    let scope = Scope {
        kind: Some(Kind::Instance),
        key: Some(kinds::parse_key(Kind::Instance, "slam/0").unwrap()),
        ..Scope::default()
    };
    let shown = first(&stub.client(), &scope, Some(9_000), 3).await;
    assert_eq!(shown[0], Shown::Relist(Lost::Ahead(None)));
    assert_eq!(shown[1], Shown::Listed { kind: Kind::Instance, revision: 50, items: Vec::new() });
    assert_eq!(stub.lines()[0], "GET /api/v1/watch?kind=Instance&name=0&service=slam&since=9000");
}

#[test]
fn each_line_is_one_object() {
    let both =
        Shown::Commit(commit(413, &[change(413, "Node", "robot-1"), change(413, "Layer", "edge")]));
    let text_of = |shown: &Shown, format| text(shown, format).unwrap();
    assert_eq!(text_of(&both, Format::Json).lines().count(), 1);
    assert_eq!(text_of(&Shown::Relist(Lost::Trimmed), Format::Json), r#"{"relist":true}"#);
    assert_eq!(
        text_of(&both, Format::Table),
        "     413  update  node/robot-1  by ops\n     413  update  layer/edge  by ops\n"
    );
    let listed = Shown::Listed {
        kind: Kind::Node,
        revision: 97,
        items: vec![json!({"kind": "Node", "name": "a"})],
    };
    assert_eq!(
        text_of(&listed, Format::Json),
        r#"{"kind":"Node","revision":97,"items":[{"kind":"Node","name":"a"}]}"#
    );
    assert_eq!(text_of(&listed, Format::Table), "      97  exists  node/a\n");
    assert_eq!(text_of(&Shown::Relist(Lost::Trimmed), Format::Yaml), "---\nrelist: true\n");
}

#[test]
fn scopes_that_make_no_sense_are_refused() {
    let service: Option<ServiceName> = Some("slam".parse().unwrap());
    let nodes = Scope { kind: Some(Kind::Node), service: service.clone(), ..Scope::default() };
    assert!(nodes.check().is_err());
    let instances = Scope { kind: Some(Kind::Instance), service, ..Scope::default() };
    assert!(instances.check().is_ok());
}

#[test]
fn why_all_is_listed_is_told_as_it_is() {
    assert!(reason(Lost::Trimmed).contains("no longer kept"));
    let ahead = reason(Lost::Ahead(Some(12)));
    assert!(ahead.contains("it is at revision 12") && !ahead.contains("kept"), "{ahead}");
    assert!(reason(Lost::Ahead(None)).contains("is not as far as that ("));
}
