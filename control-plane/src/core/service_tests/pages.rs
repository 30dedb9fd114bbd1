//! Lists in pages.

use super::*;

#[tokio::test]
async fn pages_show_one_revision() {
    let w = world().await;
    for number in 0..5 {
        w.put(&format!("Layer/l{number}"), json!({ "kind": "fog" })).await;
    }
    let mut query = ListQuery {
        kind: Some(blaze_domain::config::Kind::Layer),
        limit: Some(2),
        ..ListQuery::default()
    };
    let mut names = Vec::new();
    loop {
        let page = w.service.list(&w.admin, &query, &ReadOptions::default()).await.unwrap();
        assert_eq!(page.revision, 5);
        names.extend(page.value.items.iter().map(|document| document.key.name().to_string()));
        if page.value.next_page_token.is_empty() {
            break;
        }
        query.page_token = page.value.next_page_token;
        // What changes in between is not part of this list.
        w.service
            .delete(
                &w.admin,
                &key(&format!("Layer/l{}", 5 - names.len() / 2)),
                Precondition::Any,
                false,
            )
            .await
            .unwrap_or(Answer { revision: 0, replayed: false, value: () });
    }
    assert_eq!(names, ["l0", "l1", "l2", "l3", "l4"]);
    query.limit = Some(0);
    assert_eq!(
        code(w.service.list(&w.admin, &query, &ReadOptions::default()).await),
        Code::InvalidRequest
    );
}

#[tokio::test]
async fn a_page_of_large_documents_is_shorter() {
    let w = world().await;
    let text = "x".repeat(200 * 1024);
    let (documents, versions) = (50, 45);
    for number in 0..documents {
        let spec = json!({ "config": { "text": text, "number": number } });
        w.put(&format!("Service/s{number:02}"), spec).await;
    }
    let mut query = ListQuery { limit: Some(1000), ..ListQuery::default() };
    let mut pages = Vec::new();
    loop {
        let page = w.service.list(&w.admin, &query, &ReadOptions::default()).await.unwrap().value;
        pages.push(page.items.len());
        query.page_token = page.next_page_token;
        if query.page_token.is_empty() {
            break;
        }
    }
    assert_eq!((pages.len(), pages.iter().sum::<usize>()), (2, documents), "{pages:?}");

    for number in 1..versions {
        w.put("Service/s00", json!({ "config": { "text": text, "number": number } })).await;
    }
    let of = async |full, limit, token: &str| {
        let (key, read) = (key("Service/s00"), ReadOptions::default());
        let history = w.service.history(&w.admin, &key, Some(limit), token, full, &read).await;
        history.unwrap().value
    };
    assert_eq!(of(false, 1000, "").await.items.len(), versions);
    let first = of(true, 1000, "").await;
    let second = of(true, 1000, &first.next_page_token).await;
    let seen: Vec<u64> =
        first.items.iter().chain(&second.items).map(|entry| entry.revision).collect();
    assert_eq!((seen.len(), second.next_page_token.as_str()), (versions, ""));
    assert!(seen.is_sorted_by(|a, b| a > b) && first.items.len() < versions);
    assert_eq!(of(true, 3, "").await.items.len(), 3);
}
