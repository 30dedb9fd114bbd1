//! BlazeFlow's own settings while messages flow, in a roll-out, and whatever starts first.

use std::time::{Duration, Instant};

use blaze_tests::flow::{FlowProcess, FlowSpec, free_domain};
use blaze_tests::plain;
use blaze_tests::process::Process;
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer};
use blaze_tests::{wait, within};
use serde_json::{Value, json};

use super::flow::{Acks, allocates, check, has_limit, is_configured, layer, limit, soon, spec};
use super::stage::{PATIENCE, Stage};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn rates_rules_and_compression_follow_while_messages_flow() {
    const BYTES: usize = 200_000;
    let stage = Stage::new();
    let _main = stage.main();
    stage.robot().await;
    let worker = stage.worker("robot-1");
    stage.equal(&worker, PATIENCE).await;
    let domain = free_domain().unwrap();
    let far_redis = RedisServer::start(RedisKind::Redis, RedisOptions::default()).unwrap();
    let far = FlowSpec::new("fog", "fog-1")
        .on_redis(&far_redis.url(), "")
        .joined(domain);
    let mut flow = FlowProcess::launch(spec(&stage, "robot-1").joined(domain)).unwrap();
    let mut far = FlowProcess::launch(far).unwrap();
    flow.wait_ready().unwrap();
    far.wait_ready().unwrap();
    is_configured(&worker).await;
    let near = stage.redis.url();
    let advertise = json!({ "op": "advertise", "topic": "camera/x", "service": "camera", "rate_hz": 50, "max_bytes": BYTES, "ttl_s": 600 });
    plain::tell_redis(&near, "", &advertise).unwrap();
    let request = json!({ "op": "request", "topic": "camera/x", "service": "viewer", "ttl_s": 600 });
    plain::tell_redis(&far_redis.url(), "", &request).unwrap();
    flow.wait_bridge("camera/x", PATIENCE).unwrap();
    let topic = |seen: &Value| {
        let mut rows = seen["topics"].as_array().into_iter().flatten();
        rows.find(|row| row["topic"] == "camera/x").cloned().unwrap_or_default()
    };
    let rate = move |seen: &Value| topic(seen)["lanes"][0]["allocated_hz"].as_f64().unwrap_or_default();
    // 50 Hz of 200 kB need some 80 Mbit/s.
    allocates(&flow, "all of it fits", PATIENCE, move |seen| rate(seen) > 49.0);
    stage.put("/layers/edge", layer(&limit(16.0))).await;
    // 2 MiB/s, and what the wire takes besides.
    let took = allocates(&flow, "a fifth of it fits", soon(), move |seen| {
        (7.0..11.0).contains(&rate(seen))
    });
    eprintln!("another rate is allocated after {took:?}");
    let mut ruled = limit(16.0);
    ruled["flow"]["topics"] = json!([{ "match": "camera/**", "max_rate_hz": 4 }]);
    stage.put("/layers/edge", layer(&ruled)).await;
    allocates(&flow, "the rule counts", soon(), move |seen| {
        (3.9..4.1).contains(&rate(seen))
    });
    ruled["flow"]["compression"] = json!({ "level": 1, "adaptive": false });
    stage.put("/layers/edge", layer(&ruled)).await;
    let payload = vec![b'a'; BYTES];
    let level = |seen: &Value| topic(seen)["compression"]["level"].clone();
    let publishes = |what: &str, level_wanted: Value| {
        let ask = || {
            plain::publish(&near, "camera/x", &payload).unwrap();
            std::thread::sleep(Duration::from_millis(20));
            flow.admin().json("/v1/allocation").unwrap_or_default()
        };
        wait::until(
            what,
            PATIENCE,
            || level(&ask()) == level_wanted,
            || format!("{} {}", ask(), flow.tail()),
        )
        .unwrap();
    };
    publishes("level 1", json!(1));
    ruled["flow"]["topics"][0]["compression"] = json!({ "level": 5 });
    stage.put("/layers/edge", layer(&ruled)).await;
    publishes("level 5 by the rule of the topic", json!(5));
    stage.put("/layers/edge", layer(&json!({}))).await;
    allocates(&flow, "as in the file", PATIENCE, move |seen| rate(seen) > 49.0);
    worker.stop();
}

/// A worker of another node of the layer, which has a Redis of its own.
fn worker_elsewhere(stage: &Stage, node: &str, redis: &str) -> Process {
    let path = stage.path(&format!("{node}.yaml"));
    let file = json!({
        "layer": { "name": "edge", "kind": "edge" }, "node": { "name": node }, "admin": { "worker": "127.0.0.1:0" },
        "brokers": { "node": { "redis": { "url": redis } } }, "config": { "server": format!("http://{}", stage.grpc()) },
        "worker": { "state_dir": stage.path(node) },
    });
    std::fs::write(&path, file.to_string()).unwrap();
    let process = Process::start("blaze-worker", &["--config", path.to_str().unwrap()], None).unwrap();
    let is_ready = || process.stdout().iter().any(|line| line.starts_with("ready "));
    wait::until("the worker of the other node", PATIENCE, is_ready, || process.tail()).unwrap();
    process
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_roll_out_of_a_limit_changes_the_flow_of_its_canary_alone() {
    let stage = Stage::new();
    let _main = stage.main();
    stage.robot().await;
    let nodes = json!([
        { "kind": "Node", "name": "robot-1", "labels": { "canary": "true" }, "spec": { "layer": "edge" } },
        { "kind": "Node", "name": "robot-2", "spec": { "layer": "edge" } },
    ]);
    stage.send(reqwest::Method::POST, "/apply", Some(&nodes)).await;
    stage.put("/layers/edge", layer(&limit(20.0))).await;
    let worker = stage.worker("robot-1");
    stage.equal(&worker, PATIENCE).await;
    let other_redis = RedisServer::start(RedisKind::Redis, RedisOptions::default()).unwrap();
    let _other_worker = worker_elsewhere(&stage, "robot-2", &other_redis.url());
    let flow = FlowProcess::start(spec(&stage, "robot-1")).unwrap();
    let other = FlowProcess::start(FlowSpec::new("edge", "robot-2").on_redis(&other_redis.url(), "")).unwrap();
    for flow in [&flow, &other] {
        has_limit(flow, 20.0, PATIENCE);
    }
    is_configured(&worker).await;
    let mut acks = Acks::new(&stage);
    let rollout = |patch: Value| {
        json!({ "spec": {
            "target": { "kind": "Layer", "name": "edge" }, "patch": { "overrides": { "blaze-flow": patch } },
            "canary": { "node_selector": "canary=true" }, "gate": { "window_s": 5, "max_unhealthy": 0 },
        } })
    };
    let mut good = rollout(limit(10.0));
    good["name"] = json!("slower");
    stage.send(reqwest::Method::POST, "/rollouts", Some(&good)).await;
    has_limit(&flow, 10.0, soon());
    acks.next("applied");
    has_limit(&other, 20.0, Duration::ZERO);
    stage
        .send(reqwest::Method::POST, "/rollouts/slower/promote", Some(&json!({})))
        .await;
    has_limit(&other, 10.0, PATIENCE);
    // One that the flow of the canary refuses is undone by its worker.
    let mut bad =
        rollout(json!({ "flow": { "bandwidth": { "limit_mbps": 5 } }, "log": { "level": "blaze_flow[=info" } }));
    bad["name"] = json!("worse");
    stage.send(reqwest::Method::POST, "/rollouts", Some(&bad)).await;
    acks.next("rejected");
    let start = Instant::now();
    while stage.get("/rollouts/worse").await["status"]["phase"] != "failed" {
        assert!(start.elapsed() < PATIENCE, "{}", stage.get("/rollouts/worse").await);
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    acks.next("applied");
    check(&flow, "it is as before", |status, _| status == "ok");
    for flow in [&flow, &other] {
        has_limit(flow, 10.0, Duration::ZERO);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn flow_and_worker_start_in_any_order() {
    const READY: Duration = Duration::from_secs(5);
    let rounds = if blaze_tests::long() { 40 } else { 4 };
    let (mut flow_first, mut config_first) = (Vec::new(), Vec::new());
    for round in 0..rounds {
        let stage = Stage::new();
        {
            // The store has its documents before anything starts.
            let _main = stage.main();
            stage.robot().await;
            stage.put("/layers/edge", layer(&limit(12.0))).await;
        }
        let start = Instant::now();
        if round % 2 == 0 {
            let mut flow = FlowProcess::launch(spec(&stage, "robot-1")).unwrap();
            flow.wait_ready().unwrap();
            let alone = start.elapsed();
            let start = Instant::now();
            let _main = stage.main();
            let worker = stage.worker("robot-1");
            has_limit(&flow, 12.0, PATIENCE);
            flow_first.push((alone, start.elapsed()));
            worker.stop();
        } else {
            let _main = stage.main();
            let worker = stage.worker("robot-1");
            let alone = start.elapsed();
            let start = Instant::now();
            let mut flow = FlowProcess::launch(spec(&stage, "robot-1")).unwrap();
            flow.wait_ready().unwrap();
            has_limit(&flow, 12.0, PATIENCE);
            config_first.push((alone, start.elapsed()));
            worker.stop();
        }
    }
    eprintln!("flow, then config: {flow_first:?}; config, then flow: {config_first:?}");
    for (first, then) in flow_first.into_iter().chain(config_first) {
        assert!(first.max(then) <= within(READY), "{first:?}, {then:?}");
    }
}
