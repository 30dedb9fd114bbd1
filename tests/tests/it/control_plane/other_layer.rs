//! Tokens that are bound to one layer: whatever is outside of it is refused, existing or not, on
//! every route; lists and watches leave it out.

use std::collections::BTreeSet;
use std::sync::Arc;

use reqwest::Method;
use serde_json::{Value, json};

use super::client::Rest;
use super::stage::{Main, Stage};

/// The document that clients are generated from; a test beside the router compares the two.
const OPENAPI: &str = include_str!("../../../../openapi/openapi.json");
/// Stands in everything that the tokens must not see.
const MARK: &str = "only-for-fog";

/// A request, and the path of the router that it is for.
#[derive(Debug)]
struct Case {
    method: Method,
    route: String,
    target: String,
    body: Option<Value>,
    /// Refused, or answered without what is of the other layer.
    is_refused: bool,
}

#[derive(Default)]
struct Cases(Vec<Case>);

impl Cases {
    fn add(&mut self, is_refused: bool, method: &str, route: &str, target: &str, body: Value) {
        self.0.push(Case {
            method: method.parse().unwrap(),
            route: route.to_owned(),
            target: target.to_owned(),
            body: (!body.is_null()).then_some(body),
            is_refused,
        });
    }

    fn refused(&mut self, method: &str, route: &str, target: &str, body: Value) {
        self.add(true, method, route, target, body);
    }

    fn unread(&mut self, route: &str, target: &str) {
        for method in ["GET", "HEAD"] {
            self.add(true, method, route, target, Value::Null);
        }
    }

    fn filtered(&mut self, route: &str, target: &str) {
        for method in ["GET", "HEAD"] {
            self.add(false, method, route, target, Value::Null);
        }
    }
}

/// Every operation, `HEAD` with each `GET`.
fn operations() -> BTreeSet<(String, String)> {
    let document: Value = serde_json::from_str(OPENAPI).unwrap();
    let mut all = BTreeSet::new();
    for (path, item) in document["paths"].as_object().unwrap() {
        for method in item.as_object().unwrap().keys() {
            all.insert((method.to_uppercase(), path.clone()));
            if method == "get" {
                all.insert(("HEAD".to_owned(), path.clone()));
            }
        }
    }
    all
}

/// A document of the other layer, and one that could be made there.
struct Other {
    route: &'static str,
    collection: &'static str,
    name: &'static str,
    spec: Value,
}

fn rollout(node: &str, mark: &str) -> Value {
    json!({
        "target": { "kind": "Node", "name": node }, "patch": { "config": { "mark": mark } },
        "canary": { "node_selector": "canary=true" }, "gate": {
            "window_s": 60,
            "max_unhealthy": 0,
        },
    })
}

/// One of each kind.
fn others() -> [Other; 5] {
    [
        Other {
            route: "/api/v1/layers",
            collection: "/api/v1/layers",
            name: "fog",
            spec: json!({ "kind": "fog", "config": { "mark": MARK } }),
        },
        Other {
            route: "/api/v1/nodes",
            collection: "/api/v1/nodes",
            name: "f1",
            spec: json!({ "layer": "fog", "config": { "mark": MARK } }),
        },
        Other {
            route: "/api/v1/services",
            collection: "/api/v1/services",
            name: "hidden",
            spec: json!({ "layers": ["fog"], "config": { "mark": MARK } }),
        },
        Other {
            route: "/api/v1/services/{service}/instances",
            collection: "/api/v1/services/both/instances",
            name: "f",
            spec: json!({ "node": "f1", "config": { "mark": MARK } }),
        },
        Other {
            route: "/api/v1/rollouts",
            collection: "/api/v1/rollouts",
            name: "to-fog",
            spec: rollout("f1", MARK),
        },
    ]
}

/// All documents but the roll-outs, which must find their nodes.
fn documents() -> Value {
    let canary = json!({ "canary": "true" });
    json!([
        { "kind": "Layer", "name": "edge", "spec": { "kind": "edge" } },
        { "kind": "Layer", "name": "fog", "spec": others()[0].spec },
        { "kind": "Node", "name": "e1", "labels": canary, "spec": { "layer": "edge" } },
        { "kind": "Node", "name": "f1", "labels": canary, "spec": others()[1].spec },
        { "kind": "Node", "name": "f2", "spec": { "layer": "fog", "config": { "mark": MARK } } },
        { "kind": "Service", "name": "both", "spec": { "config": { "a": 1 } } },
        { "kind": "Service", "name": "hidden", "spec": others()[2].spec },
        { "kind": "Instance", "service": "both", "name": "e", "spec": { "node": "e1" } },
        { "kind": "Instance", "service": "both", "name": "f", "spec": others()[3].spec },
        { "kind": "Instance", "service": "both", "name": "anywhere", "spec": {} },
        {
            "kind": "Instance",
            "service": "hidden",
            "name": "h",
            "spec": { "layer": "fog", "config": { "mark": MARK } },
        },
    ])
}

struct World {
    main: Arc<Main>,
    admin: Rest,
    /// Of the commit that made all documents, and of the newest one.
    made: u64,
    now: u64,
}

async fn world(stage: &Stage) -> World {
    let main = stage.start("main");
    let (admin, at) = (Rest::new(&stage.admin_token()), main.at().rest);
    let made = admin.post(at, "/api/v1/apply", &documents()).await.revision.unwrap();
    let mut now = made;
    for (name, node, mark) in [("to-fog", "f1", MARK), ("to-edge", "e1", "")] {
        let body = json!({ "name": name, "spec": rollout(node, mark) });
        now = admin.post(at, "/api/v1/rollouts", &body).await.revision.unwrap();
    }
    World { main, admin, made, now }
}

/// Requests for every operation.
fn cases(made: u64) -> Vec<Case> {
    let mut cases = Cases::default();
    for other in others() {
        of_kind(&mut cases, &other, made);
    }
    let instances = "/api/v1/services/{service}/instances";
    cases.filtered(instances, "/api/v1/services/-/instances");
    for service in ["hidden", "absent"] {
        // A service that the layer must not see has no instances to list, and none are made.
        let target = format!("/api/v1/services/{service}/instances");
        cases.unread(instances, &target);
        let own = json!({ "name": "new", "spec": { "layer": "edge" } });
        cases.refused("POST", instances, &target, own);
    }
    for name in ["to-fog", "absent"] {
        for word in ["promote", "abort"] {
            let route = format!("/api/v1/rollouts/{{name}}/{word}");
            cases.refused("POST", &route, &route.replace("{name}", name), json!({}));
        }
    }
    for documents in [
        json!([
            { "kind": "Node", "name": "e1", "spec": { "layer": "edge", "config": { "b": 2 } } },
            { "kind": "Node", "name": "f1", "spec": { "layer": "fog" } },
        ]),
        json!([{ "kind": "Node", "name": "f1", "delete": true }]),
        json!([{ "kind": "Service", "name": "both", "spec": {} }]),
        json!([{ "kind": "Node", "name": "e1", "spec": { "layer": "fog" } }]),
        json!([{ "kind": "Instance", "service": "both", "name": "e", "spec": {} }]),
    ] {
        for query in ["", "?dry_run=true"] {
            let target = format!("/api/v1/apply{query}");
            cases.refused("POST", "/api/v1/apply", &target, documents.clone());
        }
    }
    for (route, queries) in [
        (
            "/api/v1/effective",
            &[
                "?node=f1",
                "?layer=fog",
                "?service=hidden",
                "?service=both&instance=f",
                "?service=both&node=f1&explain=true",
                "?service=both&layer=fog",
                "?service=absent",
                "?node=absent",
            ][..],
        ),
        ("/api/v1/digest", &["?layer=fog", "?layer=absent"]),
        ("/api/v1/watch", &["?layer=fog", "?layer=absent"]),
        ("/api/v1/live", &["?layer=fog", "?layer=absent", "?view=node&node=f1"]),
        ("/api/v1/series", &["?node=f1", "?node=absent"]),
        ("/api/v1/audit", &[""]),
        ("/api/v1/tokens", &[""]),
    ] {
        for query in queries {
            cases.unread(route, &format!("{route}{query}"));
        }
    }
    cases.filtered("/api/v1/topology", "/api/v1/topology");
    cases.filtered("/api/v1/workers", "/api/v1/workers");
    cases.filtered("/api/v1/live", "/api/v1/live?timeout_s=1");
    for route in ["/api/v1/problems", "/api/v1/topics", "/api/v1/targets"] {
        cases.filtered(route, route);
    }
    cases.filtered("/api/v1/problems", "/api/v1/problems?layer=fog");
    cases.filtered("/api/v1/why", "/api/v1/why?topic=a&from=fog/f1&to=fog");
    cases.filtered("/api/v1/watch", "/api/v1/watch?since=0&timeout_s=1");
    // Whose power ends at a layer must not make tokens without such an end, nor trim what concerns
    // all.
    let unbound = json!({ "subject": "a", "roles": ["admin"], "layer": null, "expires_in_s": 60 });
    let bound = json!({ "subject": "a", "roles": ["viewer"], "layer": "edge", "expires_in_s": 60 });
    for (method, route, target, body) in [
        ("POST", "/api/v1/revert", "/api/v1/revert", json!({ "revision": made, "force": true })),
        ("POST", "/api/v1/tokens", "/api/v1/tokens", unbound),
        ("POST", "/api/v1/tokens", "/api/v1/tokens", bound),
        ("DELETE", "/api/v1/tokens/{id}", "/api/v1/tokens/absent", Value::Null),
        ("POST", "/api/v1/trim", "/api/v1/trim", json!({ "before": 1 })),
    ] {
        cases.refused(method, route, target, body);
    }
    cases.0
}

/// Every operation of one kind of document.
fn of_kind(cases: &mut Cases, other: &Other, made: u64) {
    let (route, collection, spec) = (other.route, other.collection, &other.spec);
    let one = format!("{route}/{{name}}");
    cases.filtered(route, collection);
    cases.refused("POST", route, collection, json!({ "name": "new", "spec": spec }));
    // What is there, and what is not: both are outside.
    for name in [other.name, "absent"] {
        let target = format!("{collection}/{name}");
        for query in [String::new(), "?consistency=cached".to_owned(), format!("?revision={made}")]
        {
            cases.unread(&one, &format!("{target}{query}"));
        }
        let whole = json!({ "spec": spec, "labels": { "a": "b" } });
        cases.refused("PUT", &one, &target, whole);
        cases.refused("PATCH", &one, &target, json!({ "labels": { "a": "b" } }));
        for query in ["", "?cascade=true"] {
            cases.refused("DELETE", &one, &format!("{target}{query}"), Value::Null);
        }
        for (part, query) in [("history", "view=full".to_owned()), ("diff", format!("from={made}"))]
        {
            cases.unread(&format!("{one}/{part}"), &format!("{target}/{part}?{query}"));
        }
        let back = json!({ "revision": made });
        cases.refused("POST", &format!("{one}/rollback"), &format!("{target}/rollback"), back);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_of_one_layer_is_refused_on_every_route_to_another() {
    let stage = Stage::sqlite();
    let world = world(&stage).await;
    let at = world.main.at().rest;
    let cases = cases(world.made);
    let walked = cases.iter().map(|case| (case.method.to_string(), case.route.clone()));
    assert_eq!(walked.collect::<BTreeSet<_>>(), operations(), "every operation is walked");
    let (mut refused, mut filtered) = (0, 0);
    for role in ["viewer", "operator", "admin", "worker"] {
        let rest = world.admin.with_token(&stage.token("bound", role, Some("edge")));
        for case in &cases {
            // What is missing, and what stands there, must not show by a precondition either.
            let changes = [Method::PUT, Method::PATCH, Method::DELETE].contains(&case.method);
            if changes {
                let any = [("if-match", "*".to_owned())];
                let answer = rest
                    .send(at, case.method.clone(), &case.target, &any, case.body.as_ref())
                    .await
                    .unwrap();
                assert_eq!(answer.status, 403, "{role}: {case:?} with If-Match: {}", answer.text);
            }
            let answer = rest
                .send(at, case.method.clone(), &case.target, &[], case.body.as_ref())
                .await
                .unwrap();
            let what = format!("{role}: {case:?}: {} {}", answer.status, answer.text);
            assert!(!answer.text.contains(MARK), "{what}");
            if case.is_refused {
                assert_eq!(answer.status, 403, "{what}");
                assert!(
                    case.method == Method::HEAD || answer.code() == "permission_denied",
                    "{what}"
                );
                refused += 1;
            } else {
                // No flow reports here, of any layer.
                let status = if case.route == "/api/v1/why" { 503 } else { 200 };
                assert_eq!(answer.status, status, "{what}");
                let outside = ["\"f1\"", "\"f2\"", "\"to-fog\"", "\"hidden\""];
                assert!(outside.iter().all(|name| !answer.text.contains(name)), "{what}");
                filtered += 1;
            }
        }
    }
    println!("{refused} times refused, {filtered} times filtered");
    assert_eq!(world.admin.list(at, "nodes").await.0, world.now, "nothing was written");
    own_layer(&stage, &world).await;
}

/// The same requests within the layer are answered, so it was the layer that was refused.
async fn own_layer(stage: &Stage, world: &World) {
    let at = world.main.at().rest;
    let rest = world.admin.with_token(&stage.token("bound", "operator", Some("edge")));
    for target in [
        "/api/v1/layers/edge",
        "/api/v1/nodes/e1",
        "/api/v1/nodes/e1/history",
        "/api/v1/services/both",
        "/api/v1/services/both/instances/e",
        "/api/v1/services/both/instances/anywhere",
        "/api/v1/rollouts/to-edge",
        "/api/v1/effective?service=both&instance=e&explain=true",
        "/api/v1/effective?node=e1",
        "/api/v1/digest?layer=edge",
    ] {
        let answer = rest.get(at, target).await.unwrap();
        assert_eq!(answer.status, 200, "{target}: {}", answer.text);
    }
    let names = |items: Vec<Value>| {
        items.iter().map(|item| item["name"].as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(names(rest.list(at, "nodes").await.1), ["e1"]);
    assert_eq!(names(rest.list(at, "services/-/instances").await.1), ["anywhere", "e"]);
    assert_eq!(names(rest.list(at, "rollouts").await.1), ["to-edge"]);
    rest.put(
        at,
        "/api/v1/nodes/e1",
        &json!({ "spec": { "layer": "edge", "config": { "own": true } } }),
    )
    .await;
    rest.post(at, "/api/v1/nodes", &json!({ "name": "e2", "spec": { "layer": "edge" } })).await;
    rest.post(at, "/api/v1/rollouts/to-edge/abort", &json!({})).await;
}
