//! Secrets are put, changed, brought back, compared, watched, refused and backed up. Their texts
//! are given out to who asks for them and may have them, and are nowhere else.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use blaze_proto::v1;
use serde_json::{Value, json};
use tonic_types::StatusExt as _;

use blaze_tests::servers::mongo_command;
use blaze_tests::wait;

use super::client::{Answer, Client, Rest, Via};
use super::sse::Events;
use super::stage::{Main, Stage, Store, blocking, within};

/// The beginning of every secret text, and of nothing else.
const CANARY: &str = "kanarienvogel-7d1f";
/// Stands beside the secrets: where this is, a secret would have been found too.
const PLAIN: &str = "sperling-20b6";

/// A text that nobody may see.
fn secret(number: u32) -> Value {
    json!({ "$secret": text(number) })
}

fn text(number: u32) -> String {
    format!("{CANARY}-{number}")
}

/// A spec with a secret deep in its configuration, and in a list.
fn spec(number: u32) -> Value {
    json!({ "config": { "plain": PLAIN, "db": { "password": secret(number) },
        "list": [{ "key": secret(number + 1) }] } })
}

/// Fails where a secret is found, also as a plain encoding of it.
fn clean(what: &str, text: &str) {
    // All but the last of its bytes, in each of the three ways that base64 may cut them.
    let encoded = (0..3).map(|skip| {
        let bytes = &CANARY.as_bytes()[skip..];
        STANDARD.encode(&bytes[..bytes.len() / 3 * 3])
    });
    for canary in encoded.chain([CANARY.to_owned()]) {
        if let Some(at) = text.find(&canary) {
            let (from, to) = (
                text.floor_char_boundary(at.saturating_sub(300)),
                text.ceil_char_boundary(at + 100),
            );
            panic!("{what} holds the secret: {}", &text[from..to]);
        }
    }
}

type Headers<'h> = &'h [(&'h str, &'h str)];
const NONE: Headers<'static> = &[];
const ANY: Headers<'static> = &[("if-match", "*")];

/// A process, and who asks it; every answer is looked at.
struct World {
    main: Arc<Main>,
    log: PathBuf,
    rest: Rest,
    grpc: Client,
    viewer: Rest,
}

impl World {
    fn new(stage: &Stage) -> Self {
        let (main, log) = stage.start_talkative("main");
        let token = stage.admin_token();
        Self {
            grpc: Client::new(Via::Grpc, &main, &token),
            rest: Rest::new(&token),
            viewer: Rest::new(&stage.token("nosy", "viewer", None)),
            main,
            log,
        }
    }

    async fn ask(
        &self,
        rest: &Rest,
        method: &str,
        path: &str,
        headers: Headers<'_>,
        body: Option<&Value>,
    ) -> Answer {
        let headers: Vec<(&str, String)> =
            headers.iter().map(|(name, value)| (*name, (*value).to_owned())).collect();
        let at = self.main.at().rest;
        let answer = rest.send(at, method.parse().unwrap(), path, &headers, body).await.unwrap();
        clean(&format!("{method} {path}"), &answer.text);
        answer
    }

    /// A change that must be made.
    async fn write(&self, method: &str, path: &str, headers: Headers<'_>, body: &Value) -> Answer {
        let answer = self.ask(&self.rest, method, path, headers, Some(body)).await;
        assert!(answer.status < 300, "{path}: {}", answer.text);
        answer
    }

    /// A change that must be refused for what it says.
    async fn refused(
        &self,
        method: &str,
        path: &str,
        headers: Headers<'_>,
        body: &Value,
    ) -> Answer {
        let answer = self.ask(&self.rest, method, path, headers, Some(body)).await;
        assert_eq!(answer.status, 422, "{path}: {}", answer.text);
        answer
    }

    async fn read(&self, path: &str) -> Answer {
        let answer = self.ask(&self.rest, "GET", path, NONE, None).await;
        assert_eq!(answer.status, 200, "{path}: {}", answer.text);
        answer
    }

    /// The status of a request of raw bytes, as who makes mistakes sends it.
    async fn send(&self, method: &str, path: &str, media: &str, body: String) -> u16 {
        let url = format!("http://{}{path}", self.main.at().rest);
        let request =
            self.rest.http.request(method.parse().unwrap(), url).bearer_auth(&self.rest.token);
        let request = request.header("content-type", media).header("if-match", "*").body(body);
        let response = request.send().await.unwrap();
        let status = response.status().as_u16();
        clean(&format!("{method} {path}"), &response.text().await.unwrap());
        status
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_secret_is_nowhere_but_where_it_is_asked_for() {
    let stage = Arc::new(Stage::sqlite());
    let world = World::new(&stage);
    everything(&world).await;
    end(&stage, &world).await;
    // The files of the store, the log and the backup, and whatever else there is.
    let mut plain = 0;
    for entry in std::fs::read_dir(stage.folder.path()).unwrap() {
        let path = entry.unwrap().path();
        let bytes = std::fs::read(&path).unwrap();
        let content = String::from_utf8_lossy(&bytes);
        clean(&path.display().to_string(), &content);
        plain += usize::from(content.contains(PLAIN));
    }
    // The file of the store and the backup.
    assert!(plain >= 2, "{PLAIN} is in {plain} files");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_secret_is_nowhere_on_mongodb() {
    let stage = Stage::mongo();
    let world = World::new(&stage);
    written(&world).await;
    holds_no_secret(&stage, &["events"]);
    // What is trimmed away from the log is moved to where it outlives it.
    let head = world.read("/api/v1/nodes").await.revision.unwrap();
    let trim = json!({ "before": head + 1 });
    world.write("POST", "/api/v1/trim", NONE, &trim).await;
    holds_no_secret(&stage, &["documents", "versions", "idempotency"]);
}

/// Looks into every collection; these hold what stands beside the secrets.
fn holds_no_secret(stage: &Stage, plain: &[&str]) {
    let Store::Mongo { server, database } = &stage.store else { panic!("it is MongoDB") };
    let ask = |command: &Value| mongo_command(&server.uri(), database, command).unwrap();
    let tables = ask(&json!({ "listCollections": 1, "cursor": { "batchSize": 1000 } }));
    let mut found = BTreeSet::new();
    for table in tables.get_document("cursor").unwrap().get_array("firstBatch").unwrap() {
        let name = table.as_document().unwrap().get_str("name").unwrap();
        let rows = ask(&json!({ "find": name, "batchSize": 100_000, "limit": 100_000 }));
        // As bytes: whatever type a text has, it is found.
        let bytes = rows.to_vec().unwrap();
        let content = String::from_utf8_lossy(&bytes);
        clean(name, &content);
        if content.contains(PLAIN) {
            found.insert(name);
        }
    }
    for name in plain {
        assert!(found.contains(name), "{PLAIN} is not in {name}, only in {found:?}");
    }
}

fn read_file(path: &Path) -> String {
    String::from_utf8_lossy(&std::fs::read(path).unwrap()).into_owned()
}

async fn everything(world: &World) {
    let begin = written(world).await;
    by_grpc(world).await;
    refused(world).await;
    read(world, begin).await;
    watched(world).await;
    revealed(world).await;
}

/// Backs up while it runs, waits until all is logged, and kills it: what is in the files stays as
/// it is.
async fn end(stage: &Arc<Stage>, world: &World) {
    let (_, metrics) = world.main.admin().get("/metrics").unwrap();
    clean("metrics", &metrics);
    assert!(metrics.contains("blaze_config_requests_total"));
    let (file, of_stage) = (stage.path("backup"), Arc::clone(stage));
    let name = file.to_str().unwrap().to_owned();
    let said = blocking(move || of_stage.command(&["backup", &name]).unwrap()).await;
    clean("what the backup says", &said);
    assert!(read_file(&file).contains(PLAIN));
    // Its line is behind those of all that was asked before.
    let mark = "the-last-request";
    world.ask(&world.rest, "GET", "/api/v1/nodes", &[("x-request-id", mark)], None).await;
    let log = world.log.clone();
    blocking(move || {
        wait::until(
            "the last line",
            Duration::from_secs(20),
            || read_file(&log).contains(mark),
            String::new,
        )
        .unwrap();
    })
    .await;
    clean("stdout", &world.main.printed());
    let log = read_file(&world.log);
    clean("the log", &log);
    let lines = |level: &str| log.lines().filter(|line| line.contains(level)).count();
    for (level, least) in [("TRACE", 100), ("DEBUG", 5), ("INFO", 50)] {
        assert!(lines(level) > least, "{} lines of {level}", lines(level));
    }
    let main = Arc::clone(&world.main);
    blocking(move || main.kill()).await;
}

/// Secrets in documents of every kind that can have them, by every way of REST. The revision of the
/// first.
async fn written(world: &World) -> u64 {
    let slam = "/api/v1/services/slam";
    let edge = json!({ "name": "edge", "spec": { "kind": "edge" } });
    let begin = world.write("POST", "/api/v1/layers", NONE, &edge).await.revision.unwrap();
    let body = json!({ "name": "slam", "spec": spec(10) });
    for replayed in [false, true] {
        let answer =
            world.write("POST", "/api/v1/services", &[("idempotency-key", "once")], &body).await;
        assert!(answer.text.contains("redacted"), "{replayed}: {}", answer.text);
    }
    let part = |number: u32| spec(number)["config"].clone();
    let layer = json!({ "kind": "edge", "config": part(20), "overrides": { "slam": part(22) } });
    let node = json!({ "layer": "edge", "config": part(24), "overrides": { "slam": part(26) } });
    let instance = json!({ "node": "robot", "config": part(28) });
    for (method, path, headers, body) in [
        ("PUT", "/api/v1/layers/edge", ANY, json!({ "spec": layer })),
        ("POST", "/api/v1/nodes", NONE, json!({ "name": "robot", "spec": node })),
        ("POST", "/api/v1/services/slam/instances", NONE, json!({ "name": "0", "spec": instance })),
        ("PUT", slam, ANY, json!({ "spec": spec(30) })),
        ("PATCH", slam, ANY, json!({ "spec": { "config": { "db": { "password": secret(32) } } } })),
    ] {
        world.write(method, path, headers, &body).await;
    }
    // Written back as it was read.
    let shown = world.read(slam).await.body;
    let body = json!({ "spec": shown["spec"], "labels": { "a": "b" } });
    world.write("PUT", slam, ANY, &body).await;
    let documents = json!([
        { "kind": "Service", "name": "slam", "spec": spec(40) },
        { "kind": "Service", "name": "map", "spec": spec(42) },
    ]);
    for path in ["/api/v1/apply?dry_run=true", "/api/v1/apply"] {
        let answer = world.write("POST", path, &[("idempotency-key", "apply")], &documents).await;
        assert!(answer.text.contains("/spec/config/db/password"), "{}", answer.text);
    }
    let yaml = format!(
        "kind: Service\nname: map\nspec:\n  config: {{ db: {{ password: {{ $secret: {} }} }} }}\n",
        text(44)
    );
    assert_eq!(world.send("POST", "/api/v1/apply", "application/yaml", yaml).await, 200);
    let last = &world.read("/api/v1/services/map").await.body["revision"];
    // Brought back, taken back, gone, and back from what it was.
    for (method, path, headers, body) in [
        ("POST", "/api/v1/services/slam/rollback", NONE, json!({ "revision": begin + 1 })),
        ("POST", "/api/v1/revert", NONE, json!({ "revision": last })),
        ("DELETE", "/api/v1/services/map", ANY, Value::Null),
        ("POST", "/api/v1/services/map/rollback", NONE, json!({ "revision": last })),
    ] {
        world.write(method, path, headers, &body).await;
    }
    begin
}

/// The messages of gRPC go another way through the program; what they hold is the same.
async fn by_grpc(world: &World) {
    let client = &world.grpc;
    let mut grpc = client.grpc().await.unwrap();
    let create = |spec: &Value| v1::CreateRequest {
        document: Some(v1::Document {
            r#ref: Some(v1::Ref {
                kind: v1::Kind::Service.into(),
                name: "plan".to_owned(),
                service: String::new(),
            }),
            spec_json: spec.to_string(),
            ..v1::Document::default()
        }),
        request_id: String::new(),
    };
    let made = grpc.create(client.signed(create(&spec(50)))).await.unwrap();
    clean("Create", &format!("{made:?}"));
    let bad = json!({ "config": { "a": { "$secret": text(60), "b": 1 } } });
    let status = grpc.create(client.signed(create(&bad))).await.unwrap_err();
    clean("a refusal", &format!("{status:?} {:?}", status.get_error_details()));
}

/// Requests that hold a secret and are refused, for every reason that there is.
async fn refused(world: &World) {
    let strict = json!({ "spec": {
        "config": { "plain": PLAIN },
        "schema": {
            "type": "object",
            "properties": {
                "short": { "type": "string", "maxLength": 3 },
                "number": { "type": "integer" },
                "word": { "enum": ["a", "b"] },
                "fixed": { "const": 1 },
                "pattern": { "type": "string", "pattern": "^[0-9]+$" },
                "not": { "not": { "type": "string" } },
                "any": { "anyOf": [{ "type": "integer" }, { "maxLength": 2 }] },
                "one": { "oneOf": [{ "type": "string" }, { "minLength": 1 }] },
                "format": { "type": "array", "items": { "type": "integer" }, "uniqueItems": true },
                "closed": { "type": "object", "properties": {}, "additionalProperties": false },
            },
        },
    } });
    let service = "/api/v1/services/strict";
    world.write("PUT", service, NONE, &strict).await;
    // What a schema says of its text is not asked: the answer would tell of it.
    for name in ["short", "word", "fixed", "pattern", "not", "any", "one"] {
        let patch = json!({ "spec": { "config": { name: secret(99) } } });
        world.write("PATCH", service, ANY, &patch).await;
    }
    let (mismatch, invalid) = ("schema_mismatch", "validation_failed");
    let sealed = json!({ "key": text(115), "nonce": text(115), "data": text(115), "version": 1 });
    for (config, code) in [
        (json!({ "number": secret(100) }), mismatch),
        (json!({ "format": [secret(110), secret(110)] }), mismatch),
        (json!({ "closed": { "x": secret(111) } }), mismatch),
        (json!({ "a": { "$secret": text(112), "b": 1 } }), invalid),
        (json!({ "a": { "$secret": [text(113)] } }), invalid),
        (json!({ "a": { "$secret": { "text": text(114), "version": "x" } } }), invalid),
        (json!({ "a": { "$secret": sealed } }), invalid),
        (secret(116), invalid),
        (json!({ "worker": { "lease_ms": secret(117) } }), invalid),
        (
            json!({
                "unknown": { "$secret": { "redacted": true, "version": 1 } },
                "a": secret(118),
            }),
            "secret_unknown",
        ),
    ] {
        let body = json!({ "spec": { "config": config } });
        let answer = world.refused("PATCH", service, ANY, &body).await;
        assert_eq!(answer.code(), code, "{}", answer.text);
        // The same as one of many, and where only what would happen is asked.
        let spec = json!({ "config": config, "schema": strict["spec"]["schema"] });
        let many = json!([{ "kind": "Service", "name": "strict", "spec": spec }]);
        world.refused("POST", "/api/v1/apply?dry_run=true", NONE, &many).await;
    }
    for body in [
        json!({ "spec": { "config": {} }, "extra": secret(120) }),
        json!({ "spec": { "config": {} }, "labels": { "a": secret(121) } }),
        json!({ "spec": { "config": {}, "description": secret(122) } }),
        json!({ "spec": secret(123) }),
        json!({ "spec": [secret(124)] }),
        json!({ "name": "another", "spec": { "config": { "a": secret(125) } } }),
    ] {
        world.refused("PUT", service, ANY, &body).await;
    }
    let patch = json!({
        "target": { "kind": "Service", "name": "slam" },
        "patch": { "config": { "a": secret(126) } },
        "canary": { "node_selector": "a" },
    });
    let rollout = json!({ "name": "r", "spec": patch });
    world.refused("POST", "/api/v1/rollouts", NONE, &rollout).await;
    let good = json!({ "spec": spec(130) });
    for (rest, headers, status) in [
        (&world.rest, &[("if-match", "\"1\"")][..], 412),
        (&world.rest, NONE, 428),
        (&world.viewer, ANY, 403),
        (&world.rest.with_token("garbage"), ANY, 401),
    ] {
        let answer = world.ask(rest, "PUT", service, headers, Some(&good)).await;
        assert_eq!(answer.status, status, "{}", answer.text);
    }
    let text = text(140);
    for body in [
        format!("{{\"spec\":{{\"config\":{{\"a\":{{\"$secret\":\"{text}\""),
        format!(
            "{{\"spec\":{{\"config\":{{\"a\":{{\"$secret\":\"{text}\",\"$secret\":\"{text}\"}}}}}}}}"
        ),
        format!(
            "{{\"spec\":{{\"config\":{{\"a\":{{\"$secret\":\"{text}\"}},\"n\":9007199254740993}}}}}}"
        ),
        format!("{{\"spec\": {text}}}"),
    ] {
        assert_eq!(world.send("PUT", service, "application/json", body).await, 400);
    }
    assert_eq!(world.send("PUT", service, "text/plain", good.to_string()).await, 415);
    for yaml in [
        format!("kind: Service\nname: x\nspec: {{ config: {{ a: {{ $secret: {text} }} }}"),
        format!(
            "kind: Service\nname: x\nspec: {{ config: {{ a: {{ $secret: &anchor {text} }} }} }}\n"
        ),
        format!(
            "kind: Service\nname: x\nspec:\n  config:\n    a: {{ $secret: {text} }}\n   b: 1\n"
        ),
        format!("kind: Service\nname: x\nspec: {{ config: {{ a: !tag {text} }} }}\n"),
        format!("a: {text}\na: {text}\n"),
        format!("kind: Service\n  a: [{text}"),
    ] {
        assert_eq!(world.send("POST", "/api/v1/apply", "application/yaml", yaml).await, 400);
    }
    let too_long = json!({ "spec": { "config": { "a": { "$secret": format!("{text}{}",
        "x".repeat(300 * 1024)) } } } });
    let answer = world.ask(&world.rest, "PUT", service, ANY, Some(&too_long)).await;
    assert!([413, 422].contains(&answer.status), "{}", answer.text);
    let revealed = "/api/v1/services/slam?reveal=true";
    let answer = world.ask(&world.viewer, "GET", revealed, NONE, None).await;
    assert_eq!(answer.status, 403, "{}", answer.text);
}

/// Whatever shows documents, or says what was done to them.
async fn read(world: &World, begin: u64) {
    let head = world.read("/api/v1/nodes").await.revision.unwrap();
    for name in [
        "layers/edge",
        "nodes/robot",
        "services/slam",
        "services/map",
        "services/plan",
        "services/slam/instances/0",
    ] {
        let shown = world.read(&format!("/api/v1/{name}")).await;
        assert!(
            shown.text.contains("redacted")
                && (name == "services/map" || shown.text.contains(PLAIN)),
            "{}",
            shown.text
        );
        let history = world.read(&format!("/api/v1/{name}/history?view=full")).await;
        assert!(history.text.contains("redacted"), "{}", history.text);
        world.read(&format!("/api/v1/{name}/history")).await;
        for entry in history.body["items"].as_array().unwrap() {
            let (revision, op) = (entry["revision"].as_u64().unwrap(), &entry["op"]);
            if op != "delete" {
                world.read(&format!("/api/v1/{name}?revision={revision}")).await;
                world.read(&format!("/api/v1/{name}/diff?from={begin}&to={revision}")).await;
            }
            let diff = world.read(&format!("/api/v1/{name}/diff?from={revision}&to={head}")).await;
            assert!(diff.body["changes"].is_array());
        }
    }
    for path in [
        "layers",
        "nodes",
        "services",
        "services/-/instances",
        "effective?service=slam&instance=0&explain=true",
        "effective?service=slam&node=robot&explain=true",
        "effective?service=slam&layer=edge&explain=true",
        "effective?node=robot&explain=true",
        "effective?layer=edge&explain=true",
        "topology",
        "workers",
        "digest?layer=edge",
        "tokens",
    ] {
        world.read(&format!("/api/v1/{path}")).await;
    }
    let explain = world.read("/api/v1/effective?service=slam&instance=0&explain=true").await;
    assert!(
        explain.body["explain"]["/db/password"]["overridden"].as_array().unwrap().len() > 2,
        "{}",
        explain.text
    );
    let audit = world.rest.pages(world.main.at().rest, "/api/v1/audit").await;
    let audit = Value::Array(audit).to_string();
    clean("the audit", &audit);
    assert!(audit.contains("/spec/config/db/password") && audit.contains("rollback"));
    for path in ["/openapi.json", "/docs/errors/schema_mismatch", "/readyz", "/version"] {
        world.read(path).await;
    }
}

async fn watched(world: &World) {
    let at = world.main.at();
    let head = world.read("/api/v1/nodes").await.revision.unwrap();
    let mut events = Events::open(&world.rest, at.rest, "since=0", None)
        .await
        .unwrap_or_else(|refused| panic!("{refused:?}"));
    let told = within("the watch", Duration::from_secs(30), async {
        let mut told = String::new();
        loop {
            let event = events.next().await.unwrap();
            told.push_str(&event.data.to_string());
            if event.id == Some(head) {
                return told;
            }
        }
    })
    .await;
    assert!(told.contains("redacted") && told.contains(PLAIN));
    clean("the watch", &told);
}

/// It was there all the time.
async fn revealed(world: &World) {
    let at = world.main.at().rest;
    let slam = world.rest.get(at, "/api/v1/services/slam?reveal=true").await.unwrap();
    assert_eq!(
        slam.body.pointer("/spec/config/db/password/$secret/text"),
        Some(&json!(text(10))),
        "{}",
        slam.status
    );
    let instance =
        world.rest.get(at, "/api/v1/effective?service=slam&instance=0&reveal=true").await.unwrap();
    assert_eq!(
        instance.body.pointer("/config/list/0/key/$secret/text"),
        Some(&json!(text(29))),
        "{}",
        instance.status
    );
    let audit = world.read("/api/v1/audit?action=reveal").await;
    assert!(audit.body["items"].as_array().unwrap().len() > 1, "{}", audit.text);
}
