//! A secret that services are not told is nowhere: not with the broker, not in logs, metrics or
//! answers, not in the copies, and not in the memory of the worker. Where services are told it, the
//! copies have it encrypted or not at all.

use std::io::{BufRead as _, BufReader, Write as _};
use std::net::TcpStream;
use std::os::unix::process::ExitStatusExt as _;
use std::path::Path;
use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use blaze_tests::process::Signal;
use blaze_tests::servers::RedisServer;
use parking_lot::Mutex;
use reqwest::Method;
use rustix::process::{Pid, Resource, Rlimit, prlimit};
use serde_json::{Value, json};

use super::kit::{Robot, content};
use super::stage::{PATIENCE, Stage, Worker, next};

/// The beginning of every secret text, and of nothing else.
const CANARY: &str = "kanarienvogel-93ab";
/// Stands beside the secrets: where this is, a secret would have been found too.
const PLAIN: &str = "sperling-51cc";

fn secret(number: u32) -> Value {
    json!({ "$secret": format!("{CANARY}-{number}") })
}

fn config(number: u32) -> Value {
    json!({
        "plain": PLAIN,
        "number": number,
        "db": { "password": secret(number) },
        "list": [{ "key": secret(number + 1) }],
    })
}

/// Fails where a secret is found, also as a plain encoding of it. Gives whether what stands beside
/// the secrets is there.
fn clean(what: &str, text: &str) -> bool {
    let encoded = (0..3).map(|skip| {
        let bytes = &CANARY.as_bytes()[skip..];
        STANDARD.encode(&bytes[..bytes.len() / 3 * 3])
    });
    for canary in encoded.chain([CANARY.to_owned()]) {
        if let Some(at) = text.find(&canary) {
            let from = text.floor_char_boundary(at.saturating_sub(300));
            panic!("{what} holds the secret: {}", &text[from..text.ceil_char_boundary(at + 100)]);
        }
    }
    text.contains(PLAIN)
}

/// Everything that a Redis is told, as `MONITOR` shows it.
struct Monitor(Arc<Mutex<String>>);

impl Monitor {
    fn start(redis: &RedisServer) -> Self {
        let mut stream = TcpStream::connect(("127.0.0.1", redis.port())).unwrap();
        stream.write_all(b"MONITOR\r\n").unwrap();
        let mut lines = BufReader::new(stream);
        let mut first = String::new();
        lines.read_line(&mut first).unwrap();
        assert_eq!(first.trim(), "+OK");
        let seen = Arc::new(Mutex::new(String::new()));
        let kept = Arc::clone(&seen);
        std::thread::spawn(move || {
            for line in lines.lines().map_while(Result::ok) {
                kept.lock().push_str(&line);
            }
        });
        Self(seen)
    }

    fn seen(&self) -> String {
        self.0.lock().clone()
    }
}

/// All keys of a Redis with what they hold.
fn keys(redis: &RedisServer) -> String {
    let script = "local out = {} for _, key in ipairs(redis.call('KEYS', '*')) do out[#out + 1] = \
                  key \
                  if redis.call('TYPE', key).ok == 'string' then out[#out + 1] = redis.call('GET', \
                  key) \
                  else out[#out + 1] = cjson.encode(redis.call('HGETALL', key)) end end return out";
    redis.cli(&["EVAL", script, "0"]).unwrap()
}

/// Secrets in documents of each kind that can have them.
async fn documents(stage: &Stage) {
    let documents = json!([
        {
            "kind": "Layer",
            "name": "edge",
            "spec": {
                "kind": "edge",
                "config": { "of_layer": config(10) },
                "overrides": { "slam": { "more": config(12) } },
            },
        },
        {
            "kind": "Node",
            "name": "robot-1",
            "spec": { "layer": "edge", "config": { "of_node": config(14) } },
        },
        { "kind": "Service", "name": "slam", "spec": { "config": config(16) } },
        { "kind": "Service", "name": "nav", "spec": { "config": config(18) } },
        {
            "kind": "Instance",
            "service": "slam",
            "name": "0",
            "spec": { "node": "robot-1", "config": { "own": config(20) } },
        },
    ]);
    stage.send(Method::POST, "/apply", Some(&documents)).await;
}

/// Services ask and hear while the secrets are changed in each way. `is_shown`: whether they are to
/// get the texts.
async fn everything(stage: &Stage, robot: &Robot, worker: &Worker, is_shown: bool) {
    let mut plain = robot.service().await;
    let mut notices = plain.listen("slam").await;
    let process = robot.run("slam", "sdk", &[]);
    process.until("the SDK has it", |seen| seen["config"]["plain"] == PLAIN);
    let is_right = |what: &str, text: &str| {
        assert_eq!(text.contains(CANARY), is_shown, "{what}: {text}");
        assert!(text.contains(PLAIN), "{what}: {text}");
    };
    for request in
        [json!({ "service": "slam", "instance": "0" }), json!({ "service": "nav" }), json!({})]
    {
        is_right("the answer", &plain.ask(request, PATIENCE).await.to_string());
    }
    let spec = json!({ "config": config(30) });
    stage.put("/services/slam", spec).await;
    is_right("the notice", &next(&mut notices).await.to_string());
    // A change beside the secrets, then one of them taken away and put back.
    let kept = stage.get("/services/slam").await["spec"].clone();
    for number in [31, 32] {
        let mut spec = kept.clone();
        spec["config"]["number"] = json!(number);
        stage.put("/services/slam", spec).await;
    }
    stage.put("/services/nav", json!({ "config": { "plain": PLAIN } })).await;
    stage.put("/services/nav", json!({ "config": config(40) })).await;
    stage.send(Method::DELETE, "/services/nav", None).await;
    stage.equal(worker, PATIENCE).await;
    process.until("the SDK has the newest", |seen| seen["config"]["number"] == 32);
    assert_eq!(process.seen().last().unwrap().to_string().contains(CANARY), is_shown);
    process.kill();
    // Who asks wrongly is told so, without a word of anything.
    let wrong = plain.ask(json!({ "service": CANARY.to_uppercase() }), PATIENCE).await;
    assert!(wrong["error"].is_object(), "{wrong}");
}

/// What an operator sees: answers of the admin port and the log of a process.
async fn operator_sees_none(worker: &Worker, logs: &[&Path]) {
    for path in ["/v1/status", "/metrics", "/readyz", "/healthz", "/livez"] {
        clean(path, &worker.text(path).await);
    }
    for log in logs {
        let text = std::fs::read_to_string(log).unwrap();
        clean(&log.display().to_string(), &text);
        assert!(
            text.lines().filter(|line| line.contains("TRACE")).count() > 50,
            "{}",
            log.display()
        );
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_services_are_not_told_is_nowhere() {
    let stage = Stage::new();
    let (main_log, log, log_again) =
        (stage.path("main.log"), stage.path("worker.log"), stage.path("again.log"));
    let main = stage.main_at("trace", Some(&main_log));
    documents(&stage).await;
    let robot = Robot::new(&stage, "robot-1").with(&json!({
        "log": { "level": "trace" },
        "worker": { "deliver_secrets": false },
    }));
    let monitor = Monitor::start(&robot.redis);
    let worker = robot.worker_logged(&stage, &log);
    stage.equal(&worker, PATIENCE).await;
    everything(&stage, &robot, &worker, false).await;
    worker.has_kept_all(1).await;
    operator_sees_none(&worker, &[&main_log, &log]).await;
    assert!(clean("Redis", &keys(&robot.redis)));
    assert!(clean("what Redis was told", &monitor.seen()));
    assert!(clean("the file", &content(&stage.path("robot-1"))));
    let in_memory =
        |worker: &Worker, text: &str| worker.process.count_in_memory(text.as_bytes()).unwrap();
    assert!(in_memory(&worker, PLAIN) > 0);
    assert_eq!(in_memory(&worker, CANARY), 0, "the worker has the text of a secret in its memory");
    println!(
        "the main service has it {} times in its memory",
        main.count_in_memory(CANARY.as_bytes()).unwrap()
    );

    // A life that begins with the copies, and finds nobody.
    drop(main);
    worker.kill();
    let worker = robot.worker_logged(&stage, &log_again);
    let mut service = robot.service().await;
    let answer = service.ask(json!({ "service": "slam", "instance": "0" }), PATIENCE).await;
    assert_eq!(answer["source"], "copy");
    assert!(clean("the answer", &answer.to_string()));
    let _main = stage.main_at("trace", Some(&main_log));
    stage.equal(&worker, PATIENCE).await;
    let changes = worker.text("/metrics").await;
    assert!(changes.contains("blaze_worker_sync_faults_total 0"), "{changes}");
    operator_sees_none(&worker, &[&log_again]).await;
    assert_eq!(in_memory(&worker, CANARY), 0);
    leaves_no_core(worker);
}

/// A crash of it leaves no core dump, though the system would write one.
fn leaves_no_core(mut worker: Worker) {
    let allow = |id: u32| {
        let pid = Pid::from_raw(i32::try_from(id).unwrap());
        let endless = Rlimit { current: None, maximum: None };
        prlimit(pid, Resource::Core, endless).unwrap();
    };
    let folder = tempfile::tempdir().unwrap();
    let mut other = std::process::Command::new("sleep")
        .arg("60")
        .current_dir(folder.path())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    allow(other.id());
    allow(worker.id());
    let pid = Pid::from_raw(i32::try_from(other.id()).unwrap()).unwrap();
    rustix::process::kill_process(pid, Signal::ABORT).unwrap();
    let is_dumped = other.wait().unwrap().core_dumped();
    worker.process.signal(Signal::ABORT).unwrap();
    let end = worker.process.end(Duration::from_secs(20)).unwrap();
    assert_eq!(end.signal(), Some(Signal::ABORT.as_raw()));
    assert!(!end.core_dumped(), "a core dump was written");
    println!("another process leaves a core dump here: {is_dumped}");
}

/// The worker with texts and a key, or without one. What its copies hold, and what a life from the
/// copies alone has.
async fn copies(with_key: bool) {
    let stage = Stage::new();
    let (main_log, log) = (stage.path("main.log"), stage.path("worker.log"));
    let mut main = stage.main_at("trace", Some(&main_log));
    documents(&stage).await;
    let key = stage.path("worker.key");
    std::fs::write(&key, blaze_auth::generate_encryption_key().unwrap().as_bytes()).unwrap();
    let mut change = json!({ "log": { "level": "trace" }, "worker": { "deliver_secrets": true } });
    if with_key {
        change["worker"]["key_file"] = json!(key);
    }
    let robot = Robot::new(&stage, "robot-1").with(&change);
    let worker = robot.worker_logged(&stage, &log);
    stage.equal(&worker, PATIENCE).await;
    everything(&stage, &robot, &worker, true).await;
    worker.has_kept_all(1).await;
    operator_sees_none(&worker, &[&main_log, &log]).await;
    assert!(keys(&robot.redis).contains(CANARY), "services of this robot are to have it");
    // With a key the copies are encrypted as a whole.
    let is_readable = clean("the copies", &content(&stage.path("robot-1")));
    assert!(is_readable || with_key);
    println!(
        "with texts the worker has it {} times in its memory",
        worker.process.count_in_memory(CANARY.as_bytes()).unwrap()
    );
    main.kill().unwrap();
    worker.kill();
    let worker = robot.worker(&stage);
    let mut service = robot.service().await;
    let answer = service.ask(json!({ "service": "slam", "instance": "0" }), PATIENCE).await;
    assert_eq!(answer["source"], "copy");
    assert_eq!(answer.to_string().contains(CANARY), with_key, "{answer}");
    let _main = stage.main();
    stage.equal(&worker, PATIENCE).await;
    // Without a key the texts come from the main service again.
    let start = tokio::time::Instant::now();
    while !service
        .ask(json!({ "service": "slam", "instance": "0" }), PATIENCE)
        .await
        .to_string()
        .contains(CANARY)
    {
        assert!(start.elapsed() < PATIENCE, "{}", worker.tail());
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_copies_hold_texts_encrypted_or_not_at_all() {
    for with_key in [true, false] {
        copies(with_key).await;
    }
}
