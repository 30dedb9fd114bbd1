use super::*;
use crate::config::kinds::parse_key;
use crate::config::stub::{Reply, Stub};

fn page(names: &[&str], next: &str) -> Value {
    let items: Vec<Value> =
        names.iter().map(|name| json!({"kind": "Node", "name": name})).collect();
    json!({"items": items, "revision": 412, "next_page_token": next})
}

fn names(listing: &Listing) -> Vec<&str> {
    listing.items.iter().filter_map(|item| item["name"].as_str()).collect()
}

#[tokio::test]
async fn pages_are_joined() {
    let stub = Stub::start(|_, before| {
        Reply::json(&match before {
            0 => page(&["a", "b"], "t1"),
            1 => page(&["c"], "t2"),
            _ => page(&["d"], ""),
        })
    })
    .await;
    let filter = Filter { selector: Some("site=lab".to_owned()), ..Filter::default() };
    let listing = stub.client().list(Kind::Node, &filter).await.unwrap();
    assert_eq!(names(&listing), ["a", "b", "c", "d"]);
    assert_eq!(
        stub.lines(),
        [
            "GET /api/v1/nodes?label_selector=site%3Dlab&limit=1000",
            "GET /api/v1/nodes?label_selector=site%3Dlab&limit=1000&page_token=t1",
            "GET /api/v1/nodes?label_selector=site%3Dlab&limit=1000&page_token=t2",
        ]
    );
    let joined = listing.into_json();
    assert_eq!((&joined["revision"], &joined["next_page_token"]), (&json!(412), &json!("")));
}

#[tokio::test]
async fn a_limit_ends_a_list_and_says_that_there_is_more() {
    let stub = Stub::start(|_, _| Reply::json(&page(&["a", "b"], "t1"))).await;
    let filter = Filter { limit: Some(2), ..Filter::default() };
    let listing = stub.client().list(Kind::Node, &filter).await.unwrap();
    assert!(listing.is_cut());
    assert_eq!(stub.lines(), ["GET /api/v1/nodes?limit=2"]);
}

#[tokio::test]
async fn pages_that_are_trimmed_away_begin_anew() {
    let stub = Stub::start(|_, before| match before {
        0 => Reply::json(&page(&["a"], "t1")),
        1 => Reply::problem(410, "revision_trimmed", "gone"),
        _ => Reply::json(&page(&["b"], "")),
    })
    .await;
    let listing = stub.client().list(Kind::Node, &Filter::default()).await.unwrap();
    assert_eq!(names(&listing), ["b"]);
    assert_eq!(stub.lines()[2], "GET /api/v1/nodes?limit=1000");
    let always = Stub::start(|_, _| Reply::problem(410, "revision_trimmed", "gone")).await;
    assert!(always.client().list(Kind::Node, &Filter::default()).await.is_err());
    assert_eq!(always.asked().len(), MAX_BEGINNINGS);
}

#[tokio::test]
async fn pages_that_never_end_are_an_error() {
    let stub = Stub::start(|_, _| Reply::json(&page(&["a"], "same"))).await;
    let error = stub.client().list(Kind::Node, &Filter::default()).await.unwrap_err();
    assert!(error.to_string().contains("do not end"), "{error}");
    assert_eq!(stub.asked().len(), 2);
}

#[tokio::test]
async fn a_name_that_does_not_exist_gets_a_suggestion() {
    let stub = Stub::start(|asked, _| match asked.target.as_str() {
        "/api/v1/services?limit=1000" => Reply::json(&page(&["detector", "slam"], "")),
        "/api/v1/services/slamm/instances?limit=1000" => Reply::json(&page(&[], "")),
        _ => Reply::problem(404, "not_found", "there is no such document"),
    })
    .await;
    let client = stub.client();
    for (kind, name, meant) in [
        (Kind::Service, "slamm", "did you mean slam?"),
        (Kind::Instance, "slamm/0", "did you mean slam/0?"),
    ] {
        let key = parse_key(kind, name).unwrap();
        let error = client.document(&key, None).await.unwrap_err();
        assert!(error.to_string().contains(meant), "{error}");
        assert_eq!(error.exit() as u8, 4);
    }
    let far = parse_key(Kind::Service, "zebra").unwrap();
    let error = client.document(&far, None).await.unwrap_err();
    assert!(!error.to_string().contains("did you mean"), "{error}");
    assert!(client.existing(&far).await.unwrap().is_none());
}

#[tokio::test]
async fn changes_insist_on_what_was_read() {
    let stub = Stub::start(|_, _| Reply::at(412, &json!({"name": "robot-1"}))).await;
    let key = parse_key(Kind::Node, "robot-1").unwrap();
    let client = stub.client();
    assert_eq!(client.precondition(&key, false).await.unwrap(), "\"412\"");
    assert_eq!(client.precondition(&key, true).await.unwrap(), "*");
    assert_eq!(stub.asked().len(), 1);
}

#[test]
fn a_clean_document_keeps_its_order() {
    let document = json!({"kind": "Node", "name": "a", "labels": {}, "annotations": {},
        "spec": {"layer": "edge"}, "uid": "u",
        "revision": 3, "create_time": "t", "update_time": "t", "updated_by": "s"});
    assert_eq!(
        clean(document).to_string(),
        r#"{"kind":"Node","name":"a","labels":{},"annotations":{},"spec":{"layer":"edge"}}"#
    );
}

#[tokio::test]
async fn secrets_are_revealed_on_demand_alone() {
    let stub = Stub::start(|_, _| Reply::json(&page(&[], ""))).await;
    let client = stub.client();
    let key = parse_key(Kind::Service, "slam").unwrap();
    client.document(&key, None).await.unwrap();
    client.read_document(&key, Some(4), true).await.unwrap();
    let filter = Filter { reveal: true, ..Filter::default() };
    client.list(Kind::Service, &filter).await.unwrap();
    assert_eq!(
        stub.lines(),
        [
            "GET /api/v1/services/slam",
            "GET /api/v1/services/slam?revision=4&reveal=true",
            "GET /api/v1/services?reveal=true&limit=1000",
        ]
    );
}
