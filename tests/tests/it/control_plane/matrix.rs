//! Tokens that must not be taken, and rights that roles do not have: refused on every route with every method.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use aws_lc_rs::rand;
use futures::StreamExt as _;
use reqwest::Method;
use reqwest::header::HeaderMap;
use serde_json::{Value, json};
use tonic::Code;
use tonic_types::StatusExt as _;

use blaze_auth::{Algorithm, NewToken, Realm, sign_locally};

use super::client::Rest;
use super::raw::Raw;
use super::routes::{OPENAPI, Operation, ROLES, Right, SERVICE, filled, methods, operations, other_methods};
use super::stage::{Main, Stage, within};
use super::token::{claims_with, good_claims, hmac_token, now_s, unsigned};

/// Requests at once.
const AT_ONCE: usize = 16;
const ALL_METHODS: [Method; 8] = [
    Method::GET,
    Method::HEAD,
    Method::POST,
    Method::PUT,
    Method::PATCH,
    Method::DELETE,
    Method::OPTIONS,
    Method::TRACE,
];

/// What a request says of who asks, and what that is.
#[derive(Debug, Clone)]
struct Bad {
    what: String,
    /// Values of `Authorization`; none, one or more.
    values: Vec<String>,
}

fn bearer(token: &str) -> String {
    format!("Bearer {token}")
}

/// A good header for the key that signs.
fn header() -> Value {
    json!({ "alg": "HS256", "typ": "JWT", "kid": "k1" })
}

fn header_with(name: &str, value: Value) -> Value {
    let mut header = header();
    header[name] = value;
    header
}

/// A token of the key that is only checked here.
fn rsa_token(stage: &Stage, private: &str, kid: &str) -> String {
    assert!(stage.rsa.public.contains("PUBLIC KEY"));
    let roles = ["admin".to_owned()];
    let token = NewToken {
        subject: "mallory",
        roles: &roles,
        layer: None,
        issued_s: now_s(),
        expires_s: now_s() + 3600,
        id: "rsa-1",
    };
    sign_locally(
        &Realm::default(),
        private.as_bytes(),
        Algorithm::Rs256,
        Some(kid),
        &token,
    )
    .unwrap()
}

/// Everything that is no token of somebody. Each differs from a good one in one way.
fn bad(stage: &Stage, revoked: &str) -> Vec<Bad> {
    let mut all: Vec<Bad> = Vec::new();
    let mut add = |what: &str, values: &[String]| {
        all.push(Bad {
            what: what.to_owned(),
            values: values.to_vec(),
        });
    };
    let good = hmac_token(&header(), &good_claims(), &stage.secret);
    let parts: Vec<&str> = good.split('.').collect();

    add("none", &[]);
    add("of another scheme", &["Basic b3BzOm9wcw==".to_owned()]);
    add("without scheme", std::slice::from_ref(&good));
    add("of an empty text", &[bearer("")]);
    add("garbage", &[bearer("garbage")]);
    add("three parts of garbage", &[bearer("a.b.c")]);
    add("two points", &[bearer("..")]);
    add("cut off", &[bearer(&good[..good.len() - 2])]);
    add("with a fourth part", &[bearer(&format!("{good}.x"))]);
    add("too long", &[bearer(&"x".repeat(blaze_auth::MAX_TOKEN_BYTES + 1))]);
    add("there twice", &[bearer(&good), bearer(&good)]);
    add("revoked", &[bearer(revoked)]);

    let claims: [(&str, &str, Value); 17] = [
        ("expired", "exp", json!(now_s() - 3600)),
        ("without end", "exp", Value::Null),
        ("with an end that is no time", "exp", json!("tomorrow")),
        ("not yet valid", "nbf", json!(now_s() + 3600)),
        ("issued in the future", "iat", json!(now_s() + 3600)),
        ("of another issuer", "iss", json!("mallory")),
        ("of no issuer", "iss", Value::Null),
        ("for another audience", "aud", json!("blaze-flow")),
        ("for other audiences", "aud", json!(["blaze-flow", "blaze"])),
        ("for nobody", "aud", Value::Null),
        ("of nobody", "sub", Value::Null),
        ("of a nameless one", "sub", json!("")),
        ("without roles", "roles", Value::Null),
        ("with roles that are no list", "roles", json!("admin")),
        ("with a role that is no text", "roles", json!([1])),
        ("of a worker without layer", "roles", json!(["worker"])),
        ("with a layer that is no name", "layer", json!("Edge!")),
    ];
    for (what, name, value) in claims {
        let token = hmac_token(&header(), &claims_with(name, value), &stage.secret);
        add(what, &[bearer(&token)]);
    }

    for algorithm in ["none", "None", "NONE", "nOnE", ""] {
        let header = header_with("alg", json!(algorithm));
        add(
            &format!("alg {algorithm:?} without signature"),
            &[bearer(&format!("{}.", unsigned(&header, &good_claims())))],
        );
        add(
            &format!("alg {algorithm:?} signed"),
            &[bearer(&hmac_token(&header, &good_claims(), &stage.secret))],
        );
    }
    for (what, name, value) in [
        ("of another algorithm of the key", "alg", json!("HS512")),
        ("of an algorithm of another key", "alg", json!("RS256")),
        ("of an unknown key", "kid", json!("k2")),
        ("of a key of another kind", "kid", json!("r1")),
        ("of a key that is no name", "kid", json!({})),
        ("with an extension", "crit", json!(["b64"])),
    ] {
        let token = hmac_token(&header_with(name, value), &good_claims(), &stage.secret);
        add(what, &[bearer(&token)]);
    }
    let nameless = json!({ "alg": "HS256", "typ": "JWT" });
    add(
        "of no key",
        &[bearer(&hmac_token(&nameless, &good_claims(), &stage.secret))],
    );

    // Who knows only what everybody may know.
    let public = stage.rsa.public.as_bytes();
    for (what, header) in [
        (
            "HS256 with the public key, as that key",
            json!({ "alg": "HS256", "kid": "r1" }),
        ),
        (
            "HS256 with the public key, as the other key",
            json!({ "alg": "HS256", "kid": "k1" }),
        ),
        ("HS256 with the public key, as no key", json!({ "alg": "HS256" })),
        (
            "RS256 said, HS256 with the public key",
            json!({ "alg": "RS256", "kid": "r1" }),
        ),
    ] {
        add(what, &[bearer(&hmac_token(&header, &good_claims(), public))]);
        let trimmed = stage.rsa.public.trim_end().as_bytes();
        add(
            &format!("{what}, without its last line end"),
            &[bearer(&hmac_token(&header, &good_claims(), trimmed))],
        );
    }
    let stranger = blaze_auth::generate_key(Algorithm::Rs256).unwrap();
    add(
        "of a stranger's key",
        &[bearer(&rsa_token(stage, &stranger.private, "r1"))],
    );
    add(
        "of the right key by the wrong name",
        &[bearer(&rsa_token(stage, &stage.rsa.private, "k1"))],
    );
    let mut secret = [0_u8; 48];
    rand::fill(&mut secret).unwrap();
    add(
        "of a stranger's secret",
        &[bearer(&hmac_token(&header(), &good_claims(), &secret))],
    );
    add(
        "of an empty secret",
        &[bearer(&hmac_token(&header(), &good_claims(), b""))],
    );

    // More rights than it was signed with.
    let viewer = hmac_token(&header(), &claims_with("roles", json!(["viewer"])), &stage.secret);
    let signature = viewer.rsplit('.').next().unwrap();
    add(
        "with other claims than were signed",
        &[bearer(&format!("{}.{}.{signature}", parts[0], parts[1]))],
    );
    let other = unsigned(&header_with("typ", json!("at+jwt")), &good_claims());
    add(
        "with another header than was signed",
        &[bearer(&format!("{other}.{}", parts[2]))],
    );
    all
}

/// An answer without its stream, if it is one.
struct Reply {
    status: u16,
    headers: HeaderMap,
    body: Value,
}

async fn send(
    rest: &Rest,
    at: SocketAddr,
    method: &Method,
    path: &str,
    authorization: &[String],
    body: Option<&Value>,
) -> Reply {
    let mut request = rest.http.request(method.clone(), format!("http://{at}{path}"));
    for value in authorization {
        request = request.header("authorization", value);
    }
    if let Some(body) = body {
        request = request.json(body);
    }
    let response = request.send().await.unwrap();
    let (status, headers) = (response.status().as_u16(), response.headers().clone());
    let body = match status {
        200 => Value::Null,
        _ => serde_json::from_str(&response.text().await.unwrap()).unwrap_or_default(),
    };
    Reply { status, headers, body }
}

/// What all refusals of tokens have in common.
fn anonymous(mut body: Value) -> Value {
    let members = body.as_object_mut().unwrap();
    assert!(members.remove("request_id").is_some() && members.remove("instance").is_some());
    body
}

/// A process, and a token that it has taken back.
async fn stage() -> (Stage, Arc<Main>, Rest, String) {
    let stage = Stage::sqlite();
    let main = stage.start("main");
    let rest = Rest::new(&stage.admin_token());
    let at = main.at().rest;
    let made = json!({ "subject": "gone", "roles": ["admin"], "layer": null, "expires_in_s": 3600 });
    let made = rest.post(at, "/api/v1/tokens", &made).await;
    let (id, token) = (
        made.body["id"].as_str().unwrap(),
        made.body["token"].as_str().unwrap().to_owned(),
    );
    let as_made = rest.with_token(&token);
    assert_eq!(as_made.get(at, "/api/v1/nodes").await.unwrap().status, 200);
    let answer = rest
        .send(at, Method::DELETE, &format!("/api/v1/tokens/{id}"), &[], None)
        .await
        .unwrap();
    assert_eq!(answer.status, 204, "{}", answer.text);
    let begin = Instant::now();
    while as_made.get(at, "/api/v1/nodes").await.unwrap().status != 401 {
        assert!(begin.elapsed().as_secs() < 5, "a revoked token is still taken");
    }
    (stage, main, rest, token)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_bad_token_gets_through_any_route_with_any_method() {
    let (stage, main, rest, revoked) = stage().await;
    let (at, admin) = (main.at().rest, Rest::new(""));
    let served: Value = admin.get(at, "/openapi.json").await.unwrap().body;
    assert_eq!(
        served,
        serde_json::from_str::<Value>(OPENAPI).unwrap(),
        "the list of routes is that of the service"
    );
    let bad = bad(&stage, &revoked);
    let operations = operations();
    let mut paths: Vec<String> = operations.iter().map(Operation::target).collect();
    paths.sort_unstable();
    paths.dedup();
    // What is no route gives nothing away either.
    paths.extend(
        [
            "/api/",
            "/api/v1",
            "/api/v2/nodes",
            "/api/v1/nodes/",
            "/api/v1/metrics",
            "/api//v1",
        ]
        .map(str::to_owned),
    );
    let mut asked = Vec::new();
    for path in &paths {
        for method in &ALL_METHODS {
            let is_operation = operations
                .iter()
                .any(|one| one.method == *method && one.target() == *path);
            let all = is_operation || blaze_tests::long();
            // Of the rest, the plainest will do.
            let some = bad
                .iter()
                .filter(|bad| all || ["none", "garbage", "expired"].contains(&bad.what.as_str()));
            asked.extend(some.map(|bad| (method, path, bad)));
        }
    }
    let expected = anonymous(send(&rest, at, &Method::GET, "/api/v1/nodes", &[], None).await.body);
    assert_eq!(
        (&expected["code"], &expected["status"]),
        (&json!("unauthenticated"), &json!(401))
    );
    let count = asked.len();
    futures::stream::iter(asked)
        .for_each_concurrent(AT_ONCE, |(method, path, bad)| {
            let (rest, expected) = (&rest, &expected);
            async move {
                let reply = send(rest, at, method, path, &bad.values, None).await;
                let what = format!("{method} {path} with a token {}: {}", bad.what, reply.body);
                assert_eq!(reply.status, 401, "{what}");
                let challenge = if bad.values.is_empty() {
                    "Bearer"
                } else {
                    "Bearer error=\"invalid_token\""
                };
                assert_eq!(reply.headers["www-authenticate"], challenge, "{what}");
                assert!(!reply.headers.contains_key("blaze-revision"), "{what}");
                if *method != Method::HEAD {
                    assert_eq!(anonymous(reply.body), *expected, "it says why: {what}");
                }
            }
        })
        .await;
    println!(
        "{count} requests over {} paths with {} bad tokens: 401",
        paths.len(),
        bad.len()
    );

    // Those that differ in nothing are taken: the ways above are what was refused.
    let good = [
        hmac_token(&header(), &good_claims(), &stage.secret),
        rsa_token(&stage, &stage.rsa.private, "r1"),
        stage.admin_token(),
    ];
    for token in good {
        for operation in &operations {
            let body = (operation.right != Right::Read).then(|| json!({}));
            let reply = send(
                &rest,
                at,
                &operation.method,
                &operation.target(),
                &[bearer(&token)],
                body.as_ref(),
            )
            .await;
            assert!(
                ![401, 403].contains(&reply.status),
                "{operation:?}: {} {}",
                reply.status,
                reply.body
            );
        }
    }
    for path in [
        "/livez",
        "/readyz",
        "/version",
        "/openapi.json",
        "/openapi-3.0.json",
        "/docs",
        "/docs/errors/not_found",
    ] {
        for bad in [Vec::new(), vec![bearer("garbage")]] {
            assert_eq!(
                send(&rest, at, &Method::GET, path, &bad, None).await.status,
                200,
                "{path} needs no token"
            );
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_bad_token_gets_through_any_method_of_grpc() {
    let (stage, main, _, revoked) = stage().await;
    let raw = Raw::new(main.at().grpc);
    let bad = bad(&stage, &revoked);
    let mut paths: Vec<String> = methods()
        .into_iter()
        .map(|(name, _)| format!("/{SERVICE}/{name}"))
        .collect();
    let known = paths.len();
    paths.extend(["Nothing", "get"].map(|name| format!("/{SERVICE}/{name}")));
    let asked = paths.iter().flat_map(|path| bad.iter().map(move |bad| (path, bad)));
    let answers = futures::stream::iter(asked).map(|(path, bad)| {
        let raw = &raw;
        async move {
            let status = raw.call(path, &bad.values, &[]).await;
            let what = format!("{path} with a token {}: {status:?}", bad.what);
            assert_eq!(status.code(), Code::Unauthenticated, "{what}");
            let info = status.get_details_error_info().unwrap();
            assert_eq!(info.metadata["code"], "unauthenticated", "{what}");
            status.message().to_owned()
        }
    });
    let mut messages: Vec<String> = answers.buffer_unordered(AT_ONCE).collect().await;
    println!(
        "{} calls of {} methods with {} bad tokens: UNAUTHENTICATED",
        messages.len(),
        paths.len(),
        bad.len()
    );
    messages.sort_unstable();
    messages.dedup();
    assert_eq!(messages.len(), 1, "it says why: {messages:?}");
    for path in &paths[..known] {
        let status = raw.call(path, &[bearer(&stage.admin_token())], &[]).await;
        assert!(
            ![Code::Unauthenticated, Code::PermissionDenied].contains(&status.code()),
            "{path}: {status:?}"
        );
    }
    // Not served here, so nobody is let through; and what needs no token.
    let reflection = "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo".to_owned();
    for path in other_methods().into_iter().chain([reflection]) {
        let status = raw.call(&path, &[], &[]).await;
        assert!(
            [Code::Unauthenticated, Code::Unimplemented].contains(&status.code()),
            "{path}: {status:?}"
        );
    }
    assert_eq!(
        raw.call("/grpc.health.v1.Health/Check", &[], &[]).await.code(),
        Code::Ok
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_role_has_more_rights_than_the_table_gives_it() {
    let (stage, main, rest, _) = stage().await;
    let raw = Raw::new(main.at().grpc);
    let mut tokens: Vec<(String, String, [bool; 3])> = Vec::new();
    for (role, rights) in ROLES {
        // A worker's token names a layer; of names outside it, it is told nothing.
        let layer = (role == "worker").then_some("edge");
        tokens.push((role.to_owned(), stage.token("somebody", role, layer), rights));
    }
    for roles in [
        json!([]),
        json!(["root"]),
        json!(["Admin"]),
        json!(["admin", "root"]),
        json!(["root", "admin"]),
    ] {
        let token = hmac_token(&header(), &claims_with("roles", roles.clone()), &stage.secret);
        tokens.push((roles.to_string(), token, [false; 3]));
    }
    let may = |rights: [bool; 3], right: Right| match right {
        Right::Read => rights[0],
        Right::Write => rights[1],
        Right::Admin => rights[2],
    };
    let (mut refused, mut allowed) = (0, 0);
    for (who, token, rights) in &tokens {
        let authorization = [bearer(token)];
        for operation in operations() {
            let reply = send(
                &rest,
                main.at().rest,
                &operation.method,
                &filled(&operation.path),
                &authorization,
                None,
            )
            .await;
            let what = format!("{who}: {operation:?}: {} {}", reply.status, reply.body);
            if !may(*rights, operation.right) {
                assert_eq!(reply.status, 403, "{what}");
                assert!(
                    operation.method == Method::HEAD || reply.body["code"] == "permission_denied",
                    "{what}"
                );
                refused += 1;
            } else if who != "worker" {
                assert!(![401, 403].contains(&reply.status), "{what}");
                allowed += 1;
            }
        }
        for (method, right) in methods() {
            let status = raw.call(&format!("/{SERVICE}/{method}"), &authorization, &[]).await;
            let what = format!("{who}: {method}: {status:?}");
            if !may(*rights, right) {
                assert_eq!(status.code(), Code::PermissionDenied, "{what}");
                assert_eq!(
                    status.get_details_error_info().unwrap().metadata["code"],
                    "permission_denied",
                    "{what}"
                );
                refused += 1;
            } else if who != "worker" {
                assert!(
                    ![Code::Unauthenticated, Code::PermissionDenied].contains(&status.code()),
                    "{what}"
                );
                allowed += 1;
            }
        }
    }
    println!("{refused} times refused, {allowed} times let through");
    // Nothing was written by all that, and the refusals are in the audit.
    let at = main.at().rest;
    let (revision, _) = rest.list(at, "services").await;
    assert_eq!(revision, 0);
    within("refusals in the audit", Duration::from_secs(5), async {
        let is_refusal = |entry: &Value| entry["code"] == "permission_denied" && entry["revision"].is_null();
        while !rest
            .pages(at, "/api/v1/audit?outcome=denied")
            .await
            .iter()
            .any(is_refusal)
        {}
    })
    .await;
}
