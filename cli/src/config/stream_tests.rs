use serde_json::json;

use super::*;
use crate::config::stub::{Asked, Reply, Stub};

const PATH: &str = "/api/v1/watch";

fn change(revision: u64) -> String {
    format!(
        "retry: 1\nid: {revision}\nevent: change\ndata: {{\"revision\":{revision},\"changes\":[]}}\n\n"
    )
}

fn bookmark(revision: u64) -> String {
    format!("retry: 1\nid: {revision}\nevent: bookmark\ndata: {{\"revision\":{revision}}}\n\n")
}

fn trouble(code: &str) -> String {
    format!("event: error\ndata: {{\"code\":\"{code}\",\"title\":\"t\",\"detail\":\"d\"}}\n\n")
}

fn told(revision: u64) -> Told {
    Told::Change(json!({"revision": revision, "changes": []}))
}

fn watcher(client: &Client, since: Option<u64>) -> Watcher<'_> {
    Watcher::new(client, Call::get(PATH).query("kind", "Node"), since, false)
}

#[tokio::test]
async fn a_broken_stream_goes_on_behind_the_last_event() {
    let stub = Stub::start(|_, before| {
        Reply::Events(match before {
            0 => format!("{}{}", bookmark(410), change(413)),
            // Cut in the middle of an event: it is told once, by the next connection.
            1 => format!("{}id: 420\nevent: change\nda", change(414)),
            _ => change(420),
        })
    })
    .await;
    let client = stub.client();
    let mut watcher = watcher(&client, Some(409));
    assert_eq!(watcher.next().await.unwrap(), Told::Bookmark(json!({"revision": 410})));
    for revision in [413, 414, 420] {
        assert_eq!(watcher.next().await.unwrap(), told(revision));
    }
    let asked = stub.asked();
    let ids: Vec<Option<&str>> = asked.iter().map(|asked| asked.header("last-event-id")).collect();
    assert_eq!(ids, [None, Some("413"), Some("414")]);
    assert_eq!(asked[0].line(), "GET /api/v1/watch?kind=Node&since=409");
    assert_eq!(asked[0].header("accept"), Some("text/event-stream"));
}

#[tokio::test]
async fn a_watch_from_now_on_remembers_where_now_was() {
    let stub = Stub::start(|_, before| match before {
        // It breaks before the first bookmark.
        0 => Reply::Full(
            200,
            vec![
                ("content-type", "text/event-stream".to_owned()),
                ("blaze-revision", "77".to_owned()),
            ],
            "retry: 1\n".to_owned(),
        ),
        _ => Reply::Events(change(78)),
    })
    .await;
    let client = stub.client();
    assert_eq!(watcher(&client, None).next().await.unwrap(), told(78));
    assert_eq!(
        stub.lines(),
        ["GET /api/v1/watch?kind=Node", "GET /api/v1/watch?kind=Node&since=77"]
    );
}

#[tokio::test]
async fn what_is_trimmed_away_is_listed_anew() {
    let stub = Stub::start(|asked: &Asked, before| match before {
        0 => Reply::Events(format!("{}{}", change(5), trouble("revision_trimmed"))),
        _ if asked.header("last-event-id").is_some() => {
            Reply::problem(410, "revision_trimmed", "gone")
        }
        _ => Reply::Events(change(101)),
    })
    .await;
    let client = stub.client();
    let mut watcher = watcher(&client, Some(4));
    assert_eq!(watcher.next().await.unwrap(), told(5));
    // Once as an event, once as an answer.
    assert_eq!(watcher.next().await.unwrap(), Told::Relist(Lost::Trimmed));
    assert_eq!(watcher.next().await.unwrap(), Told::Relist(Lost::Trimmed));
    watcher.resume(100);
    assert_eq!(watcher.next().await.unwrap(), told(101));
    let last = stub.asked().pop().unwrap();
    assert_eq!(last.line(), "GET /api/v1/watch?kind=Node&since=100");
    assert_eq!(last.header("last-event-id"), None);
}

#[tokio::test]
async fn a_watch_ahead_of_the_store_says_where_the_store_is() {
    let stub = Stub::start(|_, _| {
        let problem = json!({
            "code": "revision_unknown",
            "title": "t",
            "detail": "d",
            "status": 410,
            "revision": 12,
        });
        Reply::Full(410, Vec::new(), problem.to_string())
    })
    .await;
    let client = stub.client();
    let told = watcher(&client, Some(99_999)).next().await.unwrap();
    assert_eq!(told, Told::Relist(Lost::Ahead(Some(12))));
}

#[tokio::test]
async fn trouble_passes_and_refusals_do_not() {
    let stub = Stub::start(|_, before| match before {
        0 => Reply::Events(format!("{}{}", change(5), trouble("watch_too_slow"))),
        1 => Reply::problem(503, "shutting_down", "bye"),
        2 => Reply::Cut,
        3 => Reply::Events(format!("{}{}", change(6), trouble("unauthenticated"))),
        _ => Reply::problem(401, "unauthenticated", "no"),
    })
    .await;
    let client = stub.client();
    let mut watcher = watcher(&client, Some(4));
    assert_eq!(watcher.next().await.unwrap(), told(5));
    assert_eq!(watcher.next().await.unwrap(), told(6));
    assert_eq!(watcher.next().await.unwrap_err().exit() as u8, 6);
    assert_eq!(stub.asked().len(), 5);
}

#[tokio::test]
async fn the_first_failure_is_told_at_once() {
    let stub = Stub::start(|_, _| Reply::problem(503, "store_unavailable", "no")).await;
    let client = stub.client();
    assert!(watcher(&client, None).next().await.is_err());
    assert_eq!(stub.asked().len(), 1);
}

#[tokio::test]
async fn events_of_later_versions_are_passed_over_and_garbage_is_not() {
    let later = format!("event: news\ndata: {{}}\n\n{}", change(5));
    let stub = Stub::start(move |_, _| Reply::Events(later.clone())).await;
    let client = stub.client();
    assert_eq!(watcher(&client, Some(4)).next().await.unwrap(), told(5));
    let stub = Stub::start(|_, _| Reply::Events("event: change\ndata: [1]\n\n".to_owned())).await;
    let client = stub.client();
    let error = watcher(&client, Some(4)).next().await.unwrap_err();
    assert!(error.to_string().contains("no JSON object"), "{error}");
}
