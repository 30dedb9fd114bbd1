//! Watches: what they tell, from where on, and how they end.

use super::*;

/// Revision and changes of the next commit; bookmarks are passed over.
async fn next(stream: &mut crate::core::WatchStream) -> (u64, Vec<(&'static str, String)>) {
    let wait = async {
        loop {
            match stream.next().await {
                Some(WatchItem::Commit(commit)) => {
                    let changes = commit
                        .changes
                        .iter()
                        .map(|(op, document)| (op.as_str(), document.key.to_string()));
                    return (commit.revision, changes.collect());
                }
                Some(WatchItem::Bookmark(_)) => {}
                other => panic!("the stream ended: {other:?}"),
            }
        }
    };
    tokio::time::timeout(Duration::from_secs(10), wait).await.expect("a commit within 10 s")
}

#[tokio::test]
async fn a_watch_tells_every_commit_from_a_revision_on() {
    let w = world().await;
    w.robot().await;
    w.put("Layer/fog", json!({ "kind": "fog" })).await;
    let query = WatchQuery { since: Some(0), ..WatchQuery::default() };
    let mut stream = w.service.watch(&w.admin, &query).await.unwrap().value;
    let (revision, changes) = next(&mut stream).await;
    assert_eq!((revision, changes.len()), (1, 4));
    assert_eq!(next(&mut stream).await, (2, vec![("create", "Layer/fog".to_owned())]));
    w.delete("Layer/fog", false).await.unwrap();
    assert_eq!(next(&mut stream).await, (3, vec![("delete", "Layer/fog".to_owned())]));
}

#[tokio::test]
async fn what_leaves_a_filter_is_told_also_when_it_moves_with_its_node() {
    let w = world().await;
    w.robot().await;
    w.put("Layer/fog", json!({ "kind": "fog" })).await;
    let query = |layer: &str| WatchQuery {
        layer: Some(layer.parse().unwrap()),
        since: Some(2),
        ..WatchQuery::default()
    };
    let mut edge = w.service.watch(&w.admin, &query("edge")).await.unwrap().value;
    let mut fog = w.service.watch(&w.admin, &query("fog")).await.unwrap().value;
    w.patch("Node/robot-1", json!({ "spec": { "layer": "fog" } })).await.unwrap();
    let both = |op: &'static str| {
        vec![(op, "Node/robot-1".to_owned()), (op, "Instance/slam/0".to_owned())]
    };
    assert_eq!(next(&mut edge).await, (3, both("leave")));
    assert_eq!(next(&mut fog).await, (3, both("update")));
}

#[tokio::test]
async fn a_watch_of_what_is_trimmed_is_refused_with_where_to_begin() {
    let w = world().await;
    for number in 0..6 {
        w.put(&format!("Layer/l{number}"), json!({ "kind": "fog" })).await;
    }
    assert_eq!(w.service.trim(&w.admin, 4, None).await.unwrap().value, 3);
    let query = |since| WatchQuery { since: Some(since), ..WatchQuery::default() };
    let refused = w.service.watch(&w.admin, &query(2)).await.err().unwrap();
    assert_eq!(
        (refused.code, refused.oldest_revision, refused.revision),
        (Code::RevisionTrimmed, Some(3), Some(6))
    );
    let mut stream = w.service.watch(&w.admin, &query(3)).await.unwrap().value;
    assert_eq!(next(&mut stream).await.0, 4);
}

#[tokio::test]
async fn a_watch_ends_in_time_although_there_is_more_to_tell() {
    let w = world().await;
    for number in 0..5 {
        w.put(&format!("Layer/l{number}"), json!({ "kind": "fog" })).await;
    }
    let query = WatchQuery { since: Some(0), timeout_s: Some(1), ..WatchQuery::default() };
    let mut stream = w.service.watch(&w.admin, &query).await.unwrap().value;
    assert_eq!(next(&mut stream).await.0, 1);
    tokio::time::pause();
    tokio::time::advance(Duration::from_secs(2)).await;
    assert!(matches!(stream.next().await, Some(WatchItem::Bookmark(1))));
    assert!(matches!(stream.next().await, Some(WatchItem::End(None))));
    assert!(stream.next().await.is_none());
}

#[tokio::test]
async fn a_watch_begins_at_the_revision_that_is_waited_for() {
    let w = world().await;
    let read = ReadOptions { cached: true, min_revision: Some(2), ..ReadOptions::default() };
    let query = WatchQuery::default();
    let writes = async {
        for name in ["Layer/a", "Layer/b"] {
            w.put(name, json!({ "kind": "fog" })).await;
        }
    };
    let (watch, ()) = tokio::join!(w.service.watch_with(&w.admin, &query, &read), writes);
    assert_eq!(watch.unwrap().revision, 2);
}

#[tokio::test]
async fn a_bound_token_is_told_of_its_layer_alone() {
    let w = world().await;
    w.robot().await;
    for (name, spec) in [
        ("Layer/fog", json!({ "kind": "fog" })),
        ("Node/server", json!({ "layer": "fog" })),
        ("Instance/slam/0", json!({ "node": "server", "config": { "of": "fog" } })),
        ("Instance/slam/0", json!({ "node": "server", "config": { "of": "more fog" } })),
        ("Layer/edge", json!({ "kind": "edge" })),
    ] {
        w.put(name, spec).await;
    }
    let query = WatchQuery { since: Some(1), ..WatchQuery::default() };
    let bound = caller(&["viewer"], Some("edge"));
    let mut stream = w.service.watch(&bound, &query).await.unwrap().value;
    let mut told = Vec::new();
    while told.len() < 2 {
        match tokio::time::timeout(Duration::from_secs(10), stream.next()).await.unwrap() {
            Some(WatchItem::Commit(commit)) => told.push(commit),
            Some(WatchItem::Bookmark(_)) => {}
            other => panic!("the stream ended: {other:?}"),
        }
    }
    // What it was when it was last seen, not what it is now.
    assert!(!format!("{told:?}").contains("fog"), "{told:?}");
    let told: Vec<(u64, &str, String)> = told
        .iter()
        .flat_map(|commit| {
            commit.changes.iter().map(|(op, document)| (commit.revision, op, document))
        })
        .map(|(revision, op, document)| (revision, op.as_str(), document.key.to_string()))
        .collect();
    assert_eq!(
        told,
        [(4, "leave", "Instance/slam/0".to_owned()), (6, "update", "Layer/edge".to_owned())]
    );
}

/// Why a quiet stream ended, within five seconds: before it would look by itself.
async fn end(stream: &mut crate::core::WatchStream) -> Problem {
    let wait = async {
        loop {
            match stream.next().await {
                Some(WatchItem::End(problem)) => return *problem.unwrap(),
                Some(_) => {}
                None => panic!("it ends without a word"),
            }
        }
    };
    tokio::time::timeout(Duration::from_secs(5), wait).await.expect("an end within 5 s")
}

#[tokio::test]
async fn a_watch_ends_with_its_reason_when_the_service_ends() {
    let w = world().await;
    let mut stream = w.service.watch(&w.admin, &WatchQuery::default()).await.unwrap().value;
    w.service.end_watches();
    assert_eq!(end(&mut stream).await.code, Code::ShuttingDown);
}

#[tokio::test]
async fn a_quiet_watch_ends_when_its_token_runs_out() {
    let w = world().await;
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap();
    let expires_s = Some(now.as_secs() as i64 + 2);
    let claims = Claims { expires_s, ..(*w.admin.claims).clone() };
    let caller = Caller { claims: Arc::new(claims), ..w.admin.clone() };
    let mut stream = w.service.watch(&caller, &WatchQuery::default()).await.unwrap().value;
    assert!(matches!(stream.next().await, Some(WatchItem::Bookmark(_))), "it is open");
    assert_eq!(end(&mut stream).await.code, Code::Unauthenticated);
}
