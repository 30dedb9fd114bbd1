//! The documentation, and that it is that of the router.

use axum::http::Method;

use super::*;

#[tokio::test]
async fn the_documentation_needs_nothing_from_elsewhere() {
    let api = open().await;
    let document = api.get("/openapi.json").await;
    assert_eq!(String::from_utf8(document.body.to_vec()).unwrap(), openapi_json());
    assert_eq!(api.get("/openapi-3.0.json").await.json()["openapi"], "3.0.3");
    let page = api.get("/docs").await;
    let html = String::from_utf8(page.body.to_vec()).unwrap();
    assert!(page.header("content-security-policy").contains("script-src 'self'"));
    assert!(!html.contains("//"), "{html}");
    let links = html.split('"').filter(|part| part.starts_with("/docs/ui/"));
    for link in links {
        let file = api.get(link).await;
        assert_eq!(file.status, 200, "{link}");
        assert!(!file.body.is_empty(), "{link}");
    }
    for code in blaze_domain::config::Code::ALL {
        let page = api.get(&format!("/docs/errors/{code}")).await;
        assert_eq!(
            (page.status.as_u16(), page.header("content-type")),
            (200, "text/html; charset=utf-8"),
            "{code}"
        );
    }
    assert_eq!(api.get("/version").await.json()["version"], env!("CARGO_PKG_VERSION"));
    assert_eq!(api.get("/readyz").await.json()["status"], "ready");
}

#[tokio::test]
async fn the_router_takes_what_the_document_says() {
    let api = open().await;
    let document: Value = serde_json::from_str(&openapi_json()).unwrap();
    for (path, item) in document["paths"].as_object().unwrap() {
        let path = path
            .replace("{service}", "slam")
            .replace("{name}", "edge")
            .replace("{id}", "x");
        for method in item.as_object().unwrap().keys() {
            let method = Method::from_bytes(method.to_uppercase().as_bytes()).unwrap();
            // A type that no route takes, and a query that none knows: the answer comes from the operation itself.
            let reply = api
                .call(method.as_str(), &format!("{path}?x=1"), &[("content-type", "x/y")], "")
                .await;
            assert!(
                [400, 415].contains(&reply.status.as_u16()),
                "{method} {path}: {}",
                reply.json()
            );
        }
    }
}
