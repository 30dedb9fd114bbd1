//! Tokens that are bound to one layer: whatever is outside of it is refused, existing or not, on every route and method;
//! lists and watches leave it out.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use blaze_proto::{Message as _, v1};
use reqwest::Method;
use serde_json::{Value, json};
use tonic::Code;

use super::client::{Client, Rest, Via};
use super::raw::Raw;
use super::routes::{SERVICE, methods, operations};
use super::stage::{Main, Stage, within};
use super::stream::{Next, Op, Stream};

/// Stands in everything that the tokens must not see.
const MARK: &str = "only-for-fog";

/// What is asked in vain, or what is asked and must leave out the other layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Expect {
    Refused,
    Filtered,
}

/// A request of REST, with the path of the router that it is for.
#[derive(Debug)]
struct Case {
    method: Method,
    route: &'static str,
    target: String,
    body: Option<Value>,
    expect: Expect,
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
        "canary": { "node_selector": "canary=true" }, "gate": { "window_s": 60, "max_unhealthy": 0 },
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
        { "kind": "Instance", "service": "hidden", "name": "h", "spec": { "layer": "fog", "config": { "mark": MARK } } },
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

/// Requests for every operation of the document that clients are generated from.
fn cases(made: u64) -> Vec<Case> {
    use Expect::{Filtered, Refused};
    let mut cases = Vec::new();
    let mut add = |method: Method, route: &'static str, target: String, body: Option<Value>, expect: Expect| {
        cases.push(Case {
            method,
            route,
            target,
            body,
            expect,
        });
    };
    let leak = |text: String| -> &'static str { Box::leak(text.into_boxed_str()) };
    for other in others() {
        let (route, collection, spec) = (other.route, other.collection, &other.spec);
        let (one, below) = (leak(format!("{route}/{{name}}")), |part: &str| {
            leak(format!("{route}/{{name}}/{part}"))
        });
        let (patch, whole) = (
            json!({ "labels": { "a": "b" } }),
            json!({ "spec": spec, "labels": { "a": "b" } }),
        );
        for method in [Method::GET, Method::HEAD] {
            add(method, route, collection.to_owned(), None, Filtered);
        }
        add(
            Method::POST,
            route,
            collection.to_owned(),
            Some(json!({ "name": "new", "spec": spec })),
            Refused,
        );
        // What is there, and what is not: both are outside.
        for name in [other.name, "absent"] {
            let target = format!("{collection}/{name}");
            for (method, query) in [
                (Method::GET, ""),
                (Method::HEAD, ""),
                (Method::GET, "?consistency=cached"),
            ] {
                add(method, one, format!("{target}{query}"), None, Refused);
            }
            add(Method::GET, one, format!("{target}?revision={made}"), None, Refused);
            add(Method::PUT, one, target.clone(), Some(whole.clone()), Refused);
            add(Method::PATCH, one, target.clone(), Some(patch.clone()), Refused);
            add(Method::DELETE, one, target.clone(), None, Refused);
            add(Method::DELETE, one, format!("{target}?cascade=true"), None, Refused);
            for method in [Method::GET, Method::HEAD] {
                add(
                    method.clone(),
                    below("history"),
                    format!("{target}/history?view=full"),
                    None,
                    Refused,
                );
                add(
                    method,
                    below("diff"),
                    format!("{target}/diff?from={made}"),
                    None,
                    Refused,
                );
            }
            add(
                Method::POST,
                below("rollback"),
                format!("{target}/rollback"),
                Some(json!({ "revision": made })),
                Refused,
            );
        }
    }
    for service in ["hidden", "absent"] {
        // A service that the layer must not see has no instances to list, and none are made.
        let (route, target) = (
            "/api/v1/services/{service}/instances",
            format!("/api/v1/services/{service}/instances"),
        );
        add(Method::GET, route, target.clone(), None, Refused);
        let own = json!({ "name": "new", "spec": { "layer": "edge" } });
        add(Method::POST, route, target, Some(own), Refused);
    }
    for name in ["to-fog", "absent"] {
        for word in ["promote", "abort"] {
            let route = leak(format!("/api/v1/rollouts/{{name}}/{word}"));
            add(
                Method::POST,
                route,
                format!("/api/v1/rollouts/{name}/{word}"),
                Some(json!({})),
                Refused,
            );
        }
    }
    let everything = "/api/v1/services/-/instances";
    add(
        Method::GET,
        "/api/v1/services/{service}/instances",
        everything.to_owned(),
        None,
        Filtered,
    );
    let foreign = json!([
        { "kind": "Node", "name": "e1", "spec": { "layer": "edge", "config": { "b": 2 } } },
        { "kind": "Node", "name": "f1", "spec": { "layer": "fog" } },
    ]);
    let gone = json!([{ "kind": "Node", "name": "f1", "delete": true }]);
    let shared = json!([{ "kind": "Service", "name": "both", "spec": {} }]);
    let moved = json!([{ "kind": "Node", "name": "e1", "spec": { "layer": "fog" } }]);
    let nowhere = json!([{ "kind": "Instance", "service": "both", "name": "e", "spec": {} }]);
    for body in [foreign, gone, shared, moved, nowhere] {
        for query in ["", "?dry_run=true"] {
            add(
                Method::POST,
                "/api/v1/apply",
                format!("/api/v1/apply{query}"),
                Some(body.clone()),
                Refused,
            );
        }
    }
    let revert = json!({ "revision": made, "force": true });
    add(
        Method::POST,
        "/api/v1/revert",
        "/api/v1/revert".to_owned(),
        Some(revert),
        Refused,
    );
    for method in [Method::GET, Method::HEAD] {
        for (route, query) in [
            ("/api/v1/effective", "?node=f1"),
            ("/api/v1/effective", "?layer=fog"),
            ("/api/v1/effective", "?service=hidden"),
            ("/api/v1/effective", "?service=both&instance=f"),
            ("/api/v1/effective", "?service=both&node=f1&explain=true"),
            ("/api/v1/effective", "?service=both&layer=fog"),
            ("/api/v1/effective", "?service=absent"),
            ("/api/v1/effective", "?node=absent"),
            ("/api/v1/digest", "?layer=fog"),
            ("/api/v1/digest", "?layer=absent"),
            ("/api/v1/watch", "?layer=fog"),
            ("/api/v1/watch", "?layer=absent"),
            ("/api/v1/audit", ""),
            ("/api/v1/tokens", ""),
        ] {
            add(method.clone(), route, format!("{route}{query}"), None, Refused);
        }
        for (route, query) in [
            ("/api/v1/topology", ""),
            ("/api/v1/workers", ""),
            ("/api/v1/watch", "?since=0&timeout_s=1"),
        ] {
            add(method.clone(), route, format!("{route}{query}"), None, Filtered);
        }
    }
    // Whose power ends at a layer must not make tokens without such an end, nor trim what concerns all.
    let token = json!({ "subject": "a", "roles": ["admin"], "layer": null, "expires_in_s": 60 });
    let own = json!({ "subject": "a", "roles": ["viewer"], "layer": "edge", "expires_in_s": 60 });
    for body in [token, own] {
        add(
            Method::POST,
            "/api/v1/tokens",
            "/api/v1/tokens".to_owned(),
            Some(body),
            Refused,
        );
    }
    add(
        Method::DELETE,
        "/api/v1/tokens/{id}",
        "/api/v1/tokens/absent".to_owned(),
        None,
        Refused,
    );
    add(
        Method::POST,
        "/api/v1/trim",
        "/api/v1/trim".to_owned(),
        Some(json!({ "before": 1 })),
        Refused,
    );
    cases
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_of_one_layer_is_refused_on_every_route_to_another() {
    let stage = Stage::sqlite();
    let world = world(&stage).await;
    let at = world.main.at().rest;
    let cases = cases(world.made);
    let walked: BTreeSet<(String, &str)> = cases.iter().map(|case| (case.method.to_string(), case.route)).collect();
    let all = operations();
    let routes: BTreeSet<(String, &str)> = all
        .iter()
        .map(|one| (one.method.to_string(), one.path.as_str()))
        .collect();
    assert_eq!(walked, routes, "every operation is walked");
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
            match case.expect {
                Expect::Refused => {
                    assert_eq!(answer.status, 403, "{what}");
                    assert!(
                        case.method == Method::HEAD || answer.code() == "permission_denied",
                        "{what}"
                    );
                    refused += 1;
                }
                Expect::Filtered => {
                    assert_eq!(answer.status, 200, "{what}");
                    assert!(
                        ["f1", "f2", "to-fog", "hidden"]
                            .iter()
                            .all(|name| !answer.text.contains(&format!("\"{name}\""))),
                        "{what}"
                    );
                    filtered += 1;
                }
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
        items
            .iter()
            .map(|item| item["name"].as_str().unwrap().to_owned())
            .collect::<Vec<_>>()
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
    rest.post(
        at,
        "/api/v1/nodes",
        &json!({ "name": "e2", "spec": { "layer": "edge" } }),
    )
    .await;
    rest.post(at, "/api/v1/rollouts/to-edge/abort", &json!({})).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_of_one_layer_is_refused_by_every_method_to_another() {
    let stage = Stage::sqlite();
    let world = world(&stage).await;
    let raw = Raw::new(world.main.at().grpc);
    let messages = messages(world.made);
    let walked: BTreeSet<&str> = messages.iter().map(|(method, _)| *method).collect();
    // These leave out what is outside, and have no way to name it.
    let filtered = ["GetTopology", "ListWorkers", "List"];
    let all = methods();
    let names: BTreeSet<&str> = all
        .iter()
        .map(|(name, _)| name.as_str())
        .filter(|name| !filtered.contains(name))
        .collect();
    assert_eq!(walked, names, "every method is walked");
    for role in ["viewer", "operator", "admin", "worker"] {
        let authorization = [format!("Bearer {}", stage.token("bound", role, Some("edge")))];
        for (method, message) in &messages {
            let status = raw.call(&format!("/{SERVICE}/{method}"), &authorization, message).await;
            assert_eq!(status.code(), Code::PermissionDenied, "{role}: {method}: {status:?}");
        }
    }
    let client = Client::new(Via::Grpc, &world.main, &stage.token("bound", "viewer", Some("edge")));
    let mut grpc = client.grpc().await.unwrap();
    for kind in [
        v1::Kind::Layer,
        v1::Kind::Node,
        v1::Kind::Service,
        v1::Kind::Instance,
        v1::Kind::Rollout,
    ] {
        let request = v1::ListRequest {
            kind: kind.into(),
            ..v1::ListRequest::default()
        };
        let list = grpc.list(client.signed(request)).await.unwrap().into_inner();
        assert!(!list.items.is_empty(), "{kind:?}");
        assert!(!format!("{list:?}").contains(MARK), "{list:?}");
    }
    let topology = grpc
        .get_topology(client.signed(v1::GetTopologyRequest {}))
        .await
        .unwrap()
        .into_inner()
        .json;
    assert!(
        topology.contains("\"e1\"") && !topology.contains("\"f1\""),
        "{topology}"
    );
    grpc.list_workers(client.signed(v1::ListWorkersRequest {}))
        .await
        .unwrap();
    let at = world.main.at().rest;
    assert_eq!(world.admin.list(at, "nodes").await.0, world.now, "nothing was written");
}

/// For every method that can name something, messages that name something outside.
fn messages(made: u64) -> Vec<(&'static str, Vec<u8>)> {
    let reference = |kind: v1::Kind, name: &str, service: &str| v1::Ref {
        kind: kind.into(),
        name: name.to_owned(),
        service: service.to_owned(),
    };
    let specs = others().map(|other| other.spec.to_string());
    let targets = [
        (reference(v1::Kind::Layer, "fog", ""), &specs[0]),
        (reference(v1::Kind::Node, "f1", ""), &specs[1]),
        (reference(v1::Kind::Node, "absent", ""), &specs[1]),
        (reference(v1::Kind::Service, "hidden", ""), &specs[2]),
        (reference(v1::Kind::Instance, "f", "both"), &specs[3]),
        (reference(v1::Kind::Rollout, "to-fog", ""), &specs[4]),
    ];
    let mut all: Vec<(&'static str, Vec<u8>)> = Vec::new();
    for (target, spec) in targets {
        let exists = target.name != "absent";
        let any = exists.then_some(v1::Precondition {
            is: Some(v1::precondition::Is::Any(true)),
        });
        let named = Some(target.clone());
        let document = Some(v1::Document {
            r#ref: Some(target),
            spec_json: spec.clone(),
            labels: [("a".to_owned(), "b".to_owned())].into(),
            ..v1::Document::default()
        });
        let new = document.clone().map(|mut document| {
            document.r#ref.as_mut().unwrap().name = "new".to_owned();
            document
        });
        let get = v1::GetRequest {
            r#ref: named.clone(),
            read: None,
        };
        let create = v1::CreateRequest {
            document: new,
            request_id: String::new(),
        };
        let replace = v1::ReplaceRequest {
            document: document.clone(),
            precondition: any,
        };
        let patch = v1::PatchRequest {
            r#ref: named.clone(),
            merge_patch_json: r#"{"labels":{"a":"b"}}"#.to_owned(),
            precondition: any,
        };
        let delete = v1::DeleteRequest {
            r#ref: named.clone(),
            precondition: any,
            cascade: true,
        };
        let apply = v1::ApplyRequest {
            items: vec![v1::ApplyItem {
                document,
                delete: false,
            }],
            ..v1::ApplyRequest::default()
        };
        let history = v1::ListHistoryRequest {
            r#ref: named.clone(),
            page: None,
            full: true,
        };
        let diff = v1::DiffRequest {
            r#ref: named.clone(),
            from_revision: made,
            to_revision: 0,
        };
        let rollback = v1::RollbackRequest {
            r#ref: named,
            revision: made,
            ..v1::RollbackRequest::default()
        };
        all.extend([
            ("Get", get.encode_to_vec()),
            ("Create", create.encode_to_vec()),
            ("Replace", replace.encode_to_vec()),
            ("Patch", patch.encode_to_vec()),
            ("Delete", delete.encode_to_vec()),
            ("Apply", apply.encode_to_vec()),
            ("ListHistory", history.encode_to_vec()),
            ("Diff", diff.encode_to_vec()),
            ("Rollback", rollback.encode_to_vec()),
        ]);
    }
    for (service, instance, layer, node) in [
        ("", "", "fog", ""),
        ("", "", "", "f1"),
        ("hidden", "", "", ""),
        ("both", "f", "", ""),
        ("both", "", "fog", ""),
    ] {
        let place = v1::Place {
            service: service.to_owned(),
            instance: instance.to_owned(),
            layer: layer.to_owned(),
            node: node.to_owned(),
        };
        let request = v1::GetEffectiveRequest {
            place: Some(place),
            explain: true,
            read: None,
        };
        all.push(("GetEffective", request.encode_to_vec()));
    }
    for action in ["promote", "abort"] {
        let request = v1::SetRolloutRequest {
            name: "to-fog".to_owned(),
            action: action.to_owned(),
            reason: String::new(),
        };
        all.push(("SetRollout", request.encode_to_vec()));
    }
    let fog = || "fog".to_owned();
    let watch = v1::WatchRequest {
        layer: fog(),
        ..v1::WatchRequest::default()
    };
    let token = v1::CreateTokenRequest {
        subject: "a".to_owned(),
        roles: vec!["viewer".to_owned()],
        layer: "edge".to_owned(),
        expires_in_s: 60,
    };
    let revert = v1::RevertRequest {
        revision: made,
        force: true,
    };
    all.extend([
        ("Watch", watch.encode_to_vec()),
        ("GetDigest", v1::GetDigestRequest { layer: fog() }.encode_to_vec()),
        ("Revert", revert.encode_to_vec()),
        ("CreateToken", token.encode_to_vec()),
        (
            "RevokeToken",
            v1::RevokeTokenRequest {
                id: "absent".to_owned(),
            }
            .encode_to_vec(),
        ),
        ("ListTokens", Vec::new()),
        ("ListAudit", Vec::new()),
        ("Trim", v1::TrimRequest { before: 1 }.encode_to_vec()),
    ]);
    all
}

/// A watch of a bound token is told of what comes into its layer and what leaves it, and of nothing else.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_watch_of_one_layer_tells_nothing_of_another() {
    let stage = Stage::sqlite();
    let World { main, admin, now, .. } = world(&stage).await;
    let at = main.at().rest;
    let token = stage.token("bound", "worker", Some("edge"));
    let mut streams = Vec::new();
    for via in [Via::Rest, Via::Grpc] {
        let client = Client::new(via, &main, &token);
        streams.push(
            Stream::open(&client, 0)
                .await
                .unwrap_or_else(|refused| panic!("{refused:?}")),
        );
    }
    let put = async |path: &str, spec: Value| admin.put(at, path, &json!({ "spec": spec })).await.revision.unwrap();
    let instance = "/api/v1/services/both/instances/f";
    put(
        "/api/v1/nodes/f2",
        json!({ "layer": "fog", "config": { "mark": MARK, "n": 1 } }),
    )
    .await;
    let comes = put(instance, json!({ "node": "e1", "config": { "here": true } })).await;
    put(
        "/api/v1/services/hidden",
        json!({ "layers": ["fog"], "config": { "mark": MARK, "n": 2 } }),
    )
    .await;
    let changes = put(instance, json!({ "node": "e1", "config": { "here": 2 } })).await;
    let leaves = put(instance, json!({ "node": "f1", "config": { "mark": MARK } })).await;
    put(instance, json!({ "node": "f1", "config": { "mark": MARK, "n": 3 } })).await;
    let last = put(
        "/api/v1/nodes/e1",
        json!({ "layer": "edge", "config": { "last": true } }),
    )
    .await;
    for mut stream in streams {
        let told = within("the watch", Duration::from_secs(30), stream.until(last)).await;
        let commits = told.unwrap_or_else(|other: Next| panic!("{other:?}"));
        assert!(!format!("{commits:?}").contains(MARK), "{commits:?}");
        let mut previous = 0;
        for commit in &commits {
            assert!(
                commit.previous.is_none_or(|found| found == previous),
                "{commit:?} after {previous}"
            );
            previous = commit.revision;
        }
        let of_begin: BTreeSet<&str> = commits
            .iter()
            .filter(|commit| commit.revision <= now)
            .flat_map(|commit| &commit.changes)
            .map(|change| change.name.as_str())
            .collect();
        assert_eq!(
            of_begin,
            BTreeSet::from(["anywhere", "both", "e", "e1", "edge", "to-edge"])
        );
        let later = commits.iter().filter(|commit| commit.revision > now);
        let later: Vec<(u64, Op, &str, &Value)> = later
            .map(|commit| {
                assert_eq!(commit.changes.len(), 1, "{commit:?}");
                let change = &commit.changes[0];
                (commit.revision, change.op, change.name.as_str(), &change.config)
            })
            .collect();
        let (here, there, end) = (json!({ "here": true }), json!({ "here": 2 }), json!({ "last": true }));
        let expected = [
            (comes, Op::Update, "f", &here),
            (changes, Op::Update, "f", &there),
            // What it was when it was last seen, not what it is now.
            (leaves, Op::Leave, "f", &there),
            (last, Op::Update, "e1", &end),
        ];
        assert_eq!(later, expected);
    }
}
