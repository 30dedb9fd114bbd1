//! Watches.

use super::*;

/// Takes events off a stream until a text is there.
async fn read_until(body: &mut Body, end: &str) -> String {
    let mut text = String::new();
    let read = async {
        while !text.contains(end) {
            let frame = body.frame().await.unwrap().unwrap();
            text.push_str(std::str::from_utf8(frame.data_ref().unwrap()).unwrap());
        }
    };
    let ended = tokio::time::timeout(SOON, read).await;
    assert!(ended.is_ok(), "{end} does not come after {text}");
    text
}

#[tokio::test]
async fn a_watch_tells_commits() {
    let api = open().await;
    let watch = async |path: &str, headers: &[(&str, &str)]| {
        let mut request = Request::builder()
            .uri(path)
            .header("host", "localhost")
            .header("accept", "text/event-stream");
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        api.router.clone().oneshot(request.body(Body::empty()).unwrap()).await.unwrap()
    };
    let first = watch("/api/v1/watch?since=0", &[]).await;
    assert_eq!(first.status(), 200);
    assert_eq!(first.headers()["content-type"], "text/event-stream");
    assert_eq!(first.headers()["x-accel-buffering"], "no");
    assert_eq!(first.headers()["cache-control"], "no-store");
    let mut first = first.into_body();
    assert_eq!(api.send("POST", "/api/v1/layers", &layer()).await.status, 201);
    let text = read_until(&mut first, "\"changes\"").await;
    assert!(text.starts_with("retry: "), "{text}");
    assert!(text.contains("id: 1\nevent: change\ndata: {\"revision\":1,"), "{text}");

    // The id of the last event goes before `since`.
    let resumed = watch("/api/v1/watch?since=0", &[("last-event-id", "1")]).await;
    let text = read_until(&mut resumed.into_body(), "event: bookmark").await;
    assert!(!text.contains("event: change") && text.contains("id: 1\n"), "{text}");

    // Two may be open; one of them ends when its body is dropped.
    let second = watch("/api/v1/watch", &[]).await;
    assert_eq!(second.status(), 200);
    assert_eq!(watch("/api/v1/watch", &[]).await.status(), 429);
    assert!(api.metrics.text().contains("blaze_config_watchers 2"));
    drop(second);
    assert_eq!(watch("/api/v1/watch?timeout_s=1", &[]).await.status(), 200);

    assert_eq!(
        api.get("/api/v1/watch?timeout_s=0").await.code(),
        (400, "invalid_request".to_owned())
    );
    assert_eq!(
        api.call("GET", "/api/v1/watch", &[("last-event-id", "x")], "").await.code(),
        (400, "invalid_header".to_owned())
    );
    assert_eq!(
        api.call("GET", "/api/v1/watch", &[("accept", "application/json")], "").await.status,
        406
    );
}
