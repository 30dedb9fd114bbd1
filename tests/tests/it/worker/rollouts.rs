//! Roll-outs with services that judge them: a bad value stops at the canary, and stays away whoever
//! is killed meanwhile.

use std::collections::BTreeSet;
use std::process::Command;
use std::time::Duration;

use blaze_tests::process::binary;
use reqwest::Method;
use serde_json::{Value, json};

use super::kit::{Robot, ServiceProcess};
use super::stage::{PATIENCE, Stage, Worker, rest};

/// What a service has that was told nothing of a roll-out.
const FORMER: u64 = 10;

fn rollout(name: &str, rate_hz: u64) -> Value {
    json!({ "kind": "Rollout", "name": name, "spec": {
        "target": {
            "kind": "Service",
            "name": "slam",
        }, "patch": { "config": { "rate_hz": rate_hz } },
        "canary": { "node_selector": "canary=true" }, "gate": {
            "window_s": 600,
            "max_unhealthy": 0,
        },
    } })
}

/// Two robots with an instance each; the first one is a canary.
async fn documents(stage: &Stage) {
    let documents = json!([
        { "kind": "Layer", "name": "edge", "spec": { "kind": "edge" } },
        {
            "kind": "Node",
            "name": "robot-1",
            "labels": { "canary": "true" },
            "spec": { "layer": "edge" },
        },
        { "kind": "Node", "name": "robot-2", "spec": { "layer": "edge" } },
        { "kind": "Service", "name": "slam", "spec": { "config": { "rate_hz": FORMER } } },
        { "kind": "Instance", "service": "slam", "name": "a", "spec": { "node": "robot-1" } },
        { "kind": "Instance", "service": "slam", "name": "b", "spec": { "node": "robot-2" } },
    ]);
    stage.send(Method::POST, "/apply", Some(&documents)).await;
}

/// What the command line says; `Err`: its exit code and what it says on stderr.
fn blaze(stage: &Stage, arguments: &[&str]) -> Result<Value, (i32, String)> {
    let output = Command::new(binary("blaze").unwrap())
        .args(arguments)
        .args(["--server", &format!("http://{}", stage.rest), "-o", "json"])
        .output()
        .unwrap();
    match output.status.code() {
        Some(0) => Ok(serde_json::from_slice(&output.stdout).unwrap()),
        code => Err((code.unwrap_or(-1), String::from_utf8_lossy(&output.stderr).into_owned())),
    }
}

fn rate(config: &Value) -> Option<u64> {
    config["config"]["rate_hz"].as_u64()
}

fn has(rate_hz: u64) -> impl Fn(&Value) -> bool {
    move |config| rate(config) == Some(rate_hz)
}

/// All rates that a service has had.
fn rates(service: &ServiceProcess) -> BTreeSet<u64> {
    service.seen().iter().filter_map(rate).collect()
}

/// Waits until the roll-out has ended in this way on the main service, and gives what it says of
/// its first canary.
async fn ends(stage: &Stage, name: &str, phase: &str) -> Value {
    let start = tokio::time::Instant::now();
    loop {
        let status = stage.get(&format!("/rollouts/{name}")).await["status"].clone();
        if status["phase"] == phase {
            return status["canaries"][0].clone();
        }
        assert!(start.elapsed() < PATIENCE, "{name} is not {phase}: {status}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

async fn is_failed(worker: &Worker) -> Value {
    let is_failed = |status: &Value| status["rollouts"][0]["phase"] == "failed";
    worker.until("the roll-out fails here", is_failed).await["rollouts"][0].clone()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bad_value_is_undone_without_the_main_service_and_stays_away() {
    let stage = Stage::new();
    let mut main = stage.main();
    documents(&stage).await;
    let (first, second) = (Robot::new(&stage, "robot-1"), Robot::new(&stage, "robot-2"));
    let (mut canary, other) = (first.worker(&stage), second.worker(&stage));
    let judges = stage.path("judges");
    let judge = ["--reject-above", "30", "--acknowledge-when", judges.to_str().unwrap()];
    let (a, b) = (first.run("slam", "a", &judge), second.run("slam", "b", &judge));
    for service in [&a, &b] {
        service.until("the former value", has(FORMER));
    }
    stage.equal(&other, PATIENCE).await;
    let listener = second.service().await;
    let mut heard = listener.listen("slam").await;

    let file = stage.write("rollout.json", &rollout("faster", 99));
    let started = blaze(&stage, &["rollout", "start", "-f", &file]).unwrap();
    assert_eq!(started["status"]["phase"], "canary", "{started}");
    a.until("the canary tries it", has(99));
    let is_applied = |status: &Value| status["rollouts"][0]["phase"] == "applied";
    canary.until("it is judged", is_applied).await;
    let status = blaze(&stage, &["rollout", "status", "faster"]).unwrap();
    assert_eq!(status["status"]["phase"], "canary");

    // The main service is gone before the service says what it thinks.
    main.kill().unwrap();
    canary.until("nobody is there", |status| status["connected"] == false).await;
    assert_eq!(a.seen().last().and_then(rate), Some(99));
    std::fs::write(&judges, "").unwrap();
    a.until("it is undone", has(FORMER));
    let failed = is_failed(&canary).await;
    assert!(failed["reason"].as_str().unwrap().contains("rate_hz: at most 30"), "{failed}");

    // Neither does it come back in a new life of the canary's worker and broker.
    canary.has_kept_all(1).await;
    let count = a.seen().len();
    canary.kill();
    first.redis.kill().unwrap();
    first.redis.restart().unwrap();
    canary = first.worker(&stage);
    is_failed(&canary).await;
    let mut plain = first.service().await;
    let asks = json!({ "service": "slam", "instance": "a" });
    assert_eq!(plain.ask(asks.clone(), PATIENCE).await["config"]["rate_hz"], FORMER);
    let key = first.key("blaze:config:slam:a").await.unwrap();
    assert_eq!((&key["config"]["rate_hz"], &key["rollout"]), (&json!(FORMER), &Value::Null));
    let late = first.run("slam", "late", &judge);
    late.until("a new one has the former value", has(FORMER));

    // The main service is back and takes it over.
    main = stage.main();
    let canary_status = ends(&stage, "faster", "failed").await;
    assert_eq!(canary_status["node"], "robot-1");
    let status = blaze(&stage, &["rollout", "status", "faster"]).unwrap();
    assert_eq!(status["status"]["phase"], "failed");
    stage.equal(&canary, PATIENCE).await;
    stage.equal(&other, PATIENCE).await;
    // Both have noted it for a life after this one. Who asked is kept as well: else `late` hears
    // nothing until it asks again.
    canary.has_kept_all(1).await;
    main.kill().unwrap();
    canary.kill();
    let _main = stage.main();
    let canary = first.worker(&stage);
    stage.equal(&canary, PATIENCE).await;
    stage.equal(&other, PATIENCE).await;
    ends(&stage, "faster", "failed").await;
    assert_eq!(plain.ask(asks, PATIENCE).await["config"]["rate_hz"], FORMER);

    // A change that everybody hears of: what had been told before has come by then.
    stage.put("/layers/edge", json!({ "kind": "edge", "config": { "mark": 1 } })).await;
    for service in [&a, &b, &late] {
        service.until("the mark", |config| config["config"]["mark"] == 1);
    }
    assert_eq!(rates(&b), BTreeSet::from([FORMER]), "the other robot never had it");
    assert_eq!(rates(&late), BTreeSet::from([FORMER]));
    let after = &a.seen()[count..];
    assert!(after.iter().all(has(FORMER)), "it came back: {after:?}");
    let notices = rest(&mut heard).await;
    assert!(notices.iter().all(|notice| notice["config"]["mark"] == 1), "{notices:?}");
    for process in [a, b, late] {
        process.kill();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_good_one_is_promoted_and_others_are_undone() {
    let stage = Stage::new();
    let _main = stage.main();
    documents(&stage).await;
    let (first, second) = (Robot::new(&stage, "robot-1"), Robot::new(&stage, "robot-2"));
    let (canary, other) = (first.worker(&stage), second.worker(&stage));
    let judge = ["--unhealthy-above", "50"];
    let (a, b) = (first.run("slam", "a", &judge), second.run("slam", "b", &judge));
    for (service, worker) in [(&a, &canary), (&b, &other)] {
        service.until("the former value", has(FORMER));
        let is_seen = |status: &Value| {
            let services = status["services"].as_array().unwrap();
            services.iter().any(|service| service["state"] == "ready")
        };
        worker.until("its watchdog is seen", is_seen).await;
    }
    let stage = &stage;

    // Started over REST, promoted by the command line.
    stage.send(Method::POST, "/rollouts", Some(&rollout("good", 20))).await;
    a.until("the canary tries it", has(20));
    let file = stage.write("second.json", &rollout("second", 30));
    let (code, words) = blaze(stage, &["rollout", "start", "-f", &file]).unwrap_err();
    assert!(code == 5 && words.contains("rollout_active"), "{code}: {words}");
    assert_eq!(rates(&b), BTreeSet::from([FORMER]));
    blaze(stage, &["rollout", "promote", "good"]).unwrap();
    b.until("promoted", has(20));
    ends(stage, "good", "promoted").await;
    assert_eq!(a.seen().last().and_then(rate), Some(20));

    // Aborted by the command line.
    stage.send(Method::POST, "/rollouts", Some(&rollout("aborted", 25))).await;
    a.until("the canary tries it", has(25));
    let said = blaze(stage, &["rollout", "abort", "aborted", "--reason", "no need"]).unwrap();
    assert_eq!(said["status"]["phase"], "aborted", "{said}");
    a.until("undone", has(20));

    // One that makes the service unhealthy, which its watchdog says.
    let file = stage.write("unhealthy.json", &rollout("unhealthy", 60));
    blaze(stage, &["rollout", "start", "-f", &file]).unwrap();
    a.until("the canary tries it", has(60));
    let failed = ends(stage, "unhealthy", "failed").await;
    assert!(failed["reason"].as_str().unwrap().contains("is unhealthy"), "{failed}");
    a.until("undone", has(20));
    let is_well = |status: &Value| {
        let services = status["services"].as_array().unwrap();
        services.iter().any(|service| service["instance"] == "a" && service["state"] == "ready")
    };
    canary.until("it is well again", is_well).await;

    // One that kills the service, which its watchdog does not say any more.
    stage.send(Method::POST, "/rollouts", Some(&rollout("deadly", 40))).await;
    a.until("the canary tries it", has(40));
    let is_applied = |status: &Value| {
        let rollouts = status["rollouts"].as_array().unwrap();
        rollouts.iter().any(|rollout| rollout["name"] == "deadly" && rollout["phase"] == "applied")
    };
    canary.until("it is judged", is_applied).await;
    a.kill();
    let failed = ends(stage, "deadly", "failed").await;
    assert!(failed["reason"].as_str().unwrap().contains("lost its watchdog"), "{failed}");
    let a = first.run("slam", "a", &judge);
    a.until("the next life has the former value", has(20));
    assert_eq!(rates(&b), BTreeSet::from([FORMER, 20]), "the other robot had what was promoted");
    stage.equal(&canary, PATIENCE).await;
    stage.equal(&other, PATIENCE).await;
}
