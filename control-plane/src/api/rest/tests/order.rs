//! Requests that are refused before the core is asked, and in which order.

use std::time::{SystemTime, UNIX_EPOCH};

use super::*;
use crate::auth::{Algorithm, NamedKey, NewToken, Realm, Right, read_key};

#[tokio::test]
async fn without_a_token_everything_below_api_is_401() {
    let api = locked(&NO_LIMITS).await;
    let mut paths: Vec<String> = routes::all().map(path_of).collect();
    paths.extend(
        ["/api/", "/api/v1", "/api/v2/nodes", "/api/v1/nodes/", "/api//v1", "/api/v1/nodes/%2e"]
            .map(str::to_owned),
    );
    for path in paths {
        for method in ["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE"] {
            let none = api.call(method, &path, &[], "").await;
            assert_eq!(
                (none.status.as_u16(), none.header("www-authenticate")),
                (401, "Bearer"),
                "{method} {path}"
            );
            assert!(!none.headers.contains_key("blaze-revision"));
            let bad = api.call(method, &path, &[("authorization", "Bearer x")], "").await;
            assert_eq!(
                bad.header("www-authenticate"),
                "Bearer error=\"invalid_token\"",
                "{method} {path}"
            );
            assert_eq!(none.json()["detail"], bad.json()["detail"], "it does not say why");
        }
    }
    for path in [
        "/livez",
        "/readyz",
        "/version",
        "/openapi.json",
        "/openapi-3.0.json",
        "/docs",
        "/docs/errors",
    ] {
        assert_eq!(api.get(path).await.status, 200, "{path}");
    }
    for path in [
        "/",
        "/api",
        "/nothing",
        "/Livez",
        "/livez/",
        "/docs/",
        "/docs/ui/x",
        "/docs/errors/x",
        "/%61pi/v1/nodes",
    ] {
        assert_eq!(api.get(path).await.code(), (404, "not_found".to_owned()), "{path}");
    }
}

#[tokio::test]
async fn a_role_opens_what_its_rights_say() {
    let key = NamedKey {
        id: "k1".to_owned(),
        key: read_key(Algorithm::Hs256, &[b'k'; 32], true).unwrap(),
        sign: true,
    };
    let keys = Arc::new(Authenticator::with_keys(Realm::default(), vec![key]));
    let api = guarded(&NO_LIMITS, Some(Arc::clone(&keys))).await;
    let now_s = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs() as i64;
    let token = |role: &str| {
        let roles = [role.to_owned()];
        let token = NewToken {
            subject: "ops",
            roles: &roles,
            layer: (role == "worker").then_some("edge"),
            issued_s: now_s,
            expires_s: now_s + 3600,
            id: "t1",
        };
        format!("Bearer {}", keys.sign(&token).unwrap().unwrap())
    };
    for (role, rights) in [
        ("worker", &[Right::Read][..]),
        ("viewer", &[Right::Read]),
        ("operator", &[Right::Read, Right::Write]),
        ("admin", &[Right::Read, Right::Write, Right::Admin]),
    ] {
        let token = token(role);
        for route in routes::all() {
            // What is let through is refused for its parameter or its body.
            let path = format!("{}?x=1", path_of(route));
            let method = route.verb.name().to_uppercase();
            let reply = api.call(&method, &path, &[("authorization", &token)], "").await;
            let expected = match rights.contains(&route.right) {
                true => &[400, 415][..],
                false => &[403],
            };
            assert!(
                expected.contains(&reply.status.as_u16()),
                "{role} {method} {path}: {:?}",
                reply.code()
            );
        }
    }
    let admin = token("admin");
    let headers = [("authorization", admin.as_str())];
    let audit = api.call("GET", "/api/v1/audit?outcome=denied", &headers, "").await.json();
    assert_eq!(audit["items"][0]["code"], "permission_denied", "{audit}");
}

#[tokio::test]
async fn refused_tokens_close_the_address() {
    let limits = LimitsSection { auth_failures_per_s: 1, ..NO_LIMITS };
    let api = locked(&limits).await;
    let bad = [("authorization", "Bearer x")];
    let closed = repeat_until(429, async || api.call("GET", "/api/v1/nodes", &bad, "").await).await;
    assert_eq!(closed.code(), (429, "rate_limited".to_owned()));
    assert_eq!(closed.header("retry-after"), "1");
    // 404 outside /api comes before.
    assert_eq!(api.get("/nothing").await.status, 404);
}

#[tokio::test]
async fn the_route_is_looked_at_in_its_order() {
    let api = open().await;
    for path in [
        "/api/v1",
        "/api/v1/",
        "/api/v1/node",
        "/api/v1/nodes/",
        "/api/v1//nodes",
        "/api/v1/Nodes",
        "/api/v1/nodes/%72obot",
        "/api/v1/nodes/a/b",
        "/api/v1/nodes/Robot",
        "/api/v1/nodes/.",
        "/api/v1/services/-/instances/0",
        "/API/v1/nodes",
    ] {
        assert_eq!(api.get(path).await.code(), (404, "not_found".to_owned()), "{path}");
    }
    for route in routes::all() {
        for method in ["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE"] {
            let allowed = routes::allow(route.path);
            if allowed.split(", ").any(|one| one == method) {
                continue;
            }
            let reply = api.call(method, &path_of(route), &[("accept", "text/html")], "").await;
            assert_eq!(
                (reply.status.as_u16(), reply.header("allow")),
                (405, allowed.as_str()),
                "{method} {}",
                route.path
            );
        }
    }
    let html = [("accept", "text/html")];
    assert_eq!(
        api.call("GET", "/api/v1/nodes?x=1", &html, "").await.code(),
        (406, "not_acceptable".to_owned())
    );
    assert_eq!(api.get("/api/v1/nodes?x=1").await.code(), (400, "unknown_parameter".to_owned()));
    assert_eq!(api.get("/api/v1/nodes?limit=0").await.code(), (400, "invalid_request".to_owned()));
    for method in ["OPTIONS", "POST"] {
        let reply = api.call(method, "/livez?x=1", &[], "").await;
        assert_eq!((reply.status.as_u16(), reply.header("allow")), (405, "GET, HEAD"));
    }
    for page in ["/livez", "/readyz", "/version", "/openapi.json", "/docs", "/docs/errors/in_use"] {
        for query in ["x=1", "verbose"] {
            let reply = api.get(&format!("{page}?{query}")).await;
            assert_eq!(reply.code(), (400, "unknown_parameter".to_owned()), "{page}?{query}");
        }
        assert_eq!(api.get(&format!("{page}?")).await.status, 200, "{page}");
    }
    assert_eq!(api.get("/docs/errors/none?x=1").await.status, 404);
}

#[tokio::test]
async fn bodies_are_looked_at_in_their_order() {
    let api = open().await;
    let text = [("content-type", "text/plain")];
    let large = "x".repeat(1024 * 1024 + 1);
    let length = large.len().to_string();
    let announced = [("content-type", "text/plain"), ("content-length", length.as_str())];
    assert_eq!(api.call("POST", "/api/v1/nodes?x=1", &announced, &large).await.status, 413);
    assert_eq!(api.call("POST", "/api/v1/nodes?x=1", &text, "{}").await.status, 415);
    assert_eq!(
        api.send("POST", "/api/v1/nodes?x=1", &json!({})).await.code().1,
        "unknown_parameter"
    );
    let patch = api.call("PATCH", "/api/v1/nodes/x", &text, "{}").await;
    assert_eq!(
        (patch.status.as_u16(), patch.header("accept-patch")),
        (415, "application/merge-patch+json, application/json")
    );
    for bad in ["", "{", "{\"a\":1,\"a\":2}", "{\"a\":9007199254740993}", &"[".repeat(40)] {
        let reply =
            api.call("POST", "/api/v1/nodes", &[("content-type", "application/json")], bad).await;
        assert_eq!(reply.code(), (400, "invalid_request".to_owned()), "{bad}");
    }
    let unquoted =
        api.send_with("PUT", "/api/v1/layers/edge", &[("if-match", "1")], &layer()).await;
    assert_eq!(unquoted.code(), (400, "invalid_header".to_owned()));
    let unknown = api
        .send(
            "POST",
            "/api/v1/layers",
            &json!({ "name": "edge", "spec": { "kind": "edge" }, "colour": 1 }),
        )
        .await;
    assert_eq!(unknown.code(), (422, "validation_failed".to_owned()));
    assert_eq!(unknown.json()["errors"][0]["pointer"], "/colour");
    for (path, body) in [
        ("/api/v1/layers/edge/rollback", json!({ "revision": 0 })),
        ("/api/v1/revert", json!({ "revision": 1, "x": 1 })),
        ("/api/v1/trim", json!({})),
        ("/api/v1/tokens", json!({ "subject": "a" })),
    ] {
        assert_eq!(api.send("POST", path, &body).await.status, 422, "{path}");
    }
}

#[tokio::test]
async fn every_answer_has_its_headers() {
    let api = open().await;
    let trace = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";
    let reply = api
        .call("GET", "/api/v1/nodes", &[("x-request-id", "run-7"), ("traceparent", trace)], "")
        .await;
    assert_eq!(reply.status, 200);
    for (name, value) in [
        ("x-request-id", "run-7"),
        ("traceparent", trace),
        ("blaze-revision", "0"),
        ("cache-control", "no-store"),
        ("x-content-type-options", "nosniff"),
        ("content-type", "application/json"),
    ] {
        assert_eq!(reply.header(name), value, "{name}");
    }
    let refused = api.call("GET", "/api/v1/nodes/none", &[("x-request-id", "a b")], "").await;
    assert_eq!((refused.status.as_u16(), refused.header("blaze-revision")), (404, "0"));
    let problem = refused.json();
    assert_eq!(refused.header("content-type"), "application/problem+json");
    assert_eq!(problem["request_id"], refused.header("x-request-id"));
    assert_eq!(
        (&problem["type"], &problem["instance"]),
        (&json!("/docs/errors/not_found"), &json!("/api/v1/nodes/none"))
    );
    assert_eq!((&problem["status"], &problem["applied"]), (&json!(404), &json!("no")));
    let head = api.call("HEAD", "/api/v1/nodes", &[], "").await;
    assert_eq!((head.status.as_u16(), head.body.len()), (200, 0));
    assert_eq!(head.header("content-length"), reply.body.len().to_string());
    let long = "x".repeat(33 * 1024);
    assert_eq!(api.call("GET", "/nothing", &[("x", &long)], "").await.status, 431);
    assert_eq!(api.get(&format!("/nothing?{}", "x".repeat(8 * 1024))).await.status, 414);
    let text = api.metrics.text();
    assert!(
        text.contains(
            "blaze_config_requests_total{api=\"rest\",code=\"not_found\",operation=\"get_node\"} 1"
        ),
        "{text}"
    );
}

#[tokio::test]
async fn in_development_other_hosts_are_refused() {
    let api = open().await;
    let request = Request::builder()
        .uri("/livez")
        .header("host", "evil.example")
        .body(Body::empty())
        .unwrap();
    assert_eq!(api.router.clone().oneshot(request).await.unwrap().status(), 403);
    let foreign = [("origin", "http://evil.example")];
    assert_eq!(
        api.call("GET", "/api/v1/nodes", &foreign, "").await.code(),
        (403, "permission_denied".to_owned())
    );
}

#[tokio::test]
async fn a_request_with_two_hosts_is_refused_everywhere() {
    let api = open().await;
    for path in ["/livez", "/nothing", "/api/v1/nodes"] {
        let reply = api.call("GET", path, &[("host", "localhost")], "").await;
        assert_eq!(reply.code(), (400, "invalid_header".to_owned()), "{path}");
    }
}

#[tokio::test]
async fn slow_bodies_take_no_place_among_those_at_work() {
    let limits = LimitsSection { in_flight: 1, ..NO_LIMITS };
    let api = open_with(&limits).await;
    let send = |body: Body| {
        let request = Request::builder()
            .method("POST")
            .uri("/api/v1/layers")
            .header("host", "localhost")
            .header("content-type", "application/json")
            .body(body)
            .unwrap();
        Box::pin(api.router.clone().oneshot(request))
    };
    let never =
        || Body::from_stream(futures::stream::pending::<Result<Bytes, std::convert::Infallible>>());
    let mut slow = [send(never()), send(never()), send(never())];
    for one in &mut slow {
        assert!(futures::FutureExt::now_or_never(one).is_none());
    }
    let made = send(Body::from(layer().to_string())).await.unwrap();
    assert_eq!(made.status(), 201);
}

#[tokio::test]
async fn a_body_that_never_comes_has_changed_nothing() {
    let api = open().await;
    tokio::time::pause();
    let never = futures::stream::pending::<Result<Bytes, std::convert::Infallible>>();
    let request = Request::builder()
        .method("POST")
        .uri("/api/v1/layers")
        .header("host", "localhost")
        .header("content-type", "application/json")
        .body(Body::from_stream(never))
        .unwrap();
    let response = api.router.clone().oneshot(request).await.unwrap();
    assert_eq!(response.status(), 504);
    let body = response.into_body().collect().await.unwrap().to_bytes();
    let problem: Value = serde_json::from_slice(&body).unwrap();
    assert_eq!(
        (&problem["code"], &problem["applied"]),
        (&json!("deadline_exceeded"), &json!("no"))
    );
}

#[tokio::test]
async fn too_much_at_once_is_refused() {
    let limits = LimitsSection { requests_per_s: 1, ..NO_LIMITS };
    let api = open_with(&limits).await;
    let refused = repeat_until(429, async || api.get("/api/v1/nodes").await).await;
    assert_eq!(refused.code(), (429, "rate_limited".to_owned()));
    assert_eq!(refused.header("retry-after"), "1");
}

/// Sends as fast as it goes; on a slow machine the first ones may come too late to be too many.
async fn repeat_until(status: u16, send: impl AsyncFn() -> Reply) -> Reply {
    for _ in 0..1000 {
        let reply = send().await;
        if reply.status == status {
            return reply;
        }
    }
    panic!("there was no {status}");
}
