//! The flow within `blaze dev` follows BlazeConfig as `blaze-flow` does: it takes what it can, and
//! says what it cannot.

use std::time::{Duration, Instant};

use blaze_tests::plain::{self, RedisReader};
use blaze_tests::process::Process;
use blaze_tests::wait;
use serde_json::{Value, json};

use crate::cli::dev::{dev, dev_on_redis, put};
use crate::cli::stage::{PATIENCE, ready};

/// Bytes a second of 8 Mbit/s.
const EIGHT: f64 = 8.0 * 1024.0 * 1024.0 / 8.0;

/// What the flow may send to other layers, in bytes a second.
async fn bandwidth(flow: &str) -> Option<f64> {
    let metrics = reqwest::get(format!("http://{flow}/metrics")).await.ok()?.text().await.ok()?;
    let is_it = |line: &&str| {
        let budget = line.strip_prefix("blaze_flow_budget_bytes_per_second{");
        budget.is_some_and(|rest| rest.contains("\"limit\"") && rest.contains("\"inter\""))
    };
    metrics.lines().find(is_it)?.rsplit(' ').next()?.parse().ok()
}

/// Asks until the answer is as it should be.
async fn until(process: &Process, what: &str, url: &str, is_so: impl Fn(&Value) -> bool) {
    let start = Instant::now();
    loop {
        let seen: Value = match reqwest::get(url).await {
            Ok(answer) => answer.json().await.unwrap_or_default(),
            Err(_) => Value::Null,
        };
        if is_so(&seen) {
            return;
        }
        assert!(start.elapsed() < PATIENCE, "{what}: {seen} {}", process.tail());
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

/// Waits until the worker hears that the flow is ready and has its newest configuration.
async fn is_configured(process: &Process, worker: &str) {
    let is_so = |status: &Value| {
        status["services"].as_array().into_iter().flatten().any(|row| {
            row["service"] == "blaze-flow"
                && row["state"] == "ready"
                && row["hash"].is_string()
                && row["hash"] == row["config_hash"]
        })
    };
    until(process, "the flow is ready", &format!("http://{worker}/v1/status"), is_so).await;
}

/// Waits until the check `config` of the flow is as it should be; it stays ready.
async fn check(process: &Process, flow: &str, status: &str, key: &str) {
    let is_so = |seen: &Value| {
        let config = &seen["checks"]["config"];
        let detail = config["detail"].as_str().unwrap_or_default();
        seen["status"] == "ready" && config["status"] == status && detail.contains(key)
    };
    until(process, key, &format!("http://{flow}/readyz"), is_so).await;
}

async fn say(rest: &str, of_flow: &Value) -> u64 {
    let body = json!({ "spec": { "layer": "edge", "overrides": { "blaze-flow": of_flow } } });
    put(rest, "/nodes/dev-1", &body).await
}

/// What is acknowledged of a revision. Of an older one it may be said once more meanwhile.
fn acknowledged(acks: &mut RedisReader, revision: u64) -> Value {
    let start = Instant::now();
    loop {
        let ack = acks.next_json(PATIENCE).unwrap();
        if ack["service"] == "blaze-flow" && ack["revision"] == revision {
            return ack;
        }
        assert!(start.elapsed() < PATIENCE, "revision {revision}: {ack}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn on_redis_it_lives_and_says_what_it_does_not_take() {
    let mut process = dev_on_redis(&[]);
    let places = ready(&process);
    let (rest, flow, redis) = (&places["rest"], &places["flow"], &places["broker"]);
    is_configured(&process, &places["worker"]).await;
    let mut connection = plain::connect(redis).unwrap();
    let mut state = || {
        let asked =
            redis::cmd("HGET").arg("blaze:watchdog:blaze-flow:dev-1:0").arg("state").to_owned();
        asked.query::<Option<String>>(&mut connection).unwrap()
    };
    assert_eq!(state().as_deref(), Some("ready"), "it shows that it lives");
    let mut acks = RedisReader::new(redis, "blaze/config/ack").unwrap();

    let good = json!({ "flow": { "bandwidth": { "limit_mbps": 8 } }, "log": { "level": "info" } });
    let revision = say(rest, &good).await;
    let ack = acknowledged(&mut acks, revision);
    assert_eq!((&ack["status"], &ack["node"]), (&json!("applied"), &json!("dev-1")));
    assert_eq!(bandwidth(flow).await, Some(EIGHT));
    // At `warn`, with which it began, it would not say so.
    let is_told = || process.stderr().iter().any(|line| line.contains("configuration reloaded"));
    wait::until("it logs more", PATIENCE, is_told, || process.tail()).unwrap();
    is_configured(&process, &places["worker"]).await;

    // With what is faulty comes a limit, which must not count either.
    let faulty = json!({
        "flow": { "bandwidth": { "limit_mbps": 7 } },
        "log": { "level": "blaze_flow[=info" },
    });
    let revision = say(rest, &faulty).await;
    let ack = acknowledged(&mut acks, revision);
    assert_eq!(ack["status"], "rejected", "{ack}");
    assert!(ack["detail"].as_str().unwrap().contains("log.level"), "{ack}");
    check(&process, flow, "failed", "log.level").await;
    assert_eq!(bandwidth(flow).await, Some(EIGHT));

    say(rest, &good).await;
    check(&process, flow, "ok", "").await;
    // No main service takes this; the flow looks at it all the same.
    let notice = json!({ "service": "blaze-flow", "instance": "0", "layer": "edge", "node": "dev-1",
        "revision": 1_000_001,
        "hash": "sha256:1000001", "paths": [], "scopes": [],
        "config": { "flow": { "bandwidth": { "limit_mbps": -1 } } }, "source": "main" });
    plain::publish(redis, "blaze/config/changed/blaze-flow", notice.to_string().as_bytes())
        .unwrap();
    let ack = acknowledged(&mut acks, 1_000_001);
    assert_eq!(ack["status"], "rejected", "{ack}");
    check(&process, flow, "failed", "flow.bandwidth.limit_mbps").await;
    assert_eq!(bandwidth(flow).await, Some(EIGHT));
    assert_eq!(process.terminate(PATIENCE).unwrap(), Some(0), "{}", process.tail());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn in_memory_it_lives_and_takes_what_is_said() {
    // What is set is the node file's, so BlazeConfig counts over it.
    let set = "flow.bandwidth.limit_mbps=9";
    let mut process = dev(&["--broker", "memory", "--set", set], None);
    let places = ready(&process);
    is_configured(&process, &places["worker"]).await;
    let said = json!({ "flow": { "bandwidth": { "limit_mbps": 8 } } });
    say(&places["rest"], &said).await;
    let start = Instant::now();
    while bandwidth(&places["flow"]).await != Some(EIGHT) {
        assert!(start.elapsed() < PATIENCE, "{}", process.tail());
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    is_configured(&process, &places["worker"]).await;
    assert_eq!(process.terminate(PATIENCE).unwrap(), Some(0), "{}", process.tail());
}
