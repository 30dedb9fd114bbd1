//! The documentation.

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
