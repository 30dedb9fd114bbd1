//! BlazeFlow takes its own settings from the worker of its node: what counts, what is refused, who
//! else hears, and what follows while messages flow.

use std::time::{Duration, Instant};

use blaze_tests::flow::{FlowProcess, FlowSpec, free_domain};
use blaze_tests::plain::{self, RedisReader};
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer};
use blaze_tests::{wait, within};
use reqwest::Method;
use serde_json::{Value, json};

use super::stage::{PATIENCE, Stage, Worker, next, rest};

/// What is acknowledged to a user is in effect so soon.
fn soon() -> Duration {
    within(Duration::from_secs(1))
}

fn spec(stage: &Stage, node: &str) -> FlowSpec {
    FlowSpec::new("edge", node).on_redis(&stage.redis.url(), "")
}

/// The layer as `Stage::robot` makes it, with overrides for the flow.
fn layer(flow: &Value) -> Value {
    json!({
        "kind": "edge",
        "config": { "verbosity": "info" },
        "overrides": { "blaze-flow": flow },
    })
}

fn limit(limit_mbps: f64) -> Value {
    json!({ "flow": { "bandwidth": { "limit_mbps": limit_mbps } } })
}

/// Waits until `/v1/allocation` satisfies.
fn allocates(
    flow: &FlowProcess,
    what: &str,
    within: Duration,
    is_so: impl Fn(&Value) -> bool,
) -> Duration {
    let ask = || flow.admin().json("/v1/allocation").unwrap_or_default();
    wait::until(what, within, || is_so(&ask()), || format!("{} {}", ask(), flow.tail())).unwrap()
}

fn has_limit(flow: &FlowProcess, limit_mbps: f64, within: Duration) -> Duration {
    allocates(flow, &format!("limit {limit_mbps}"), within, |seen| {
        seen["limit_mbps"] == limit_mbps
            && seen["budget_bytes_per_s"].as_f64() == Some((limit_mbps * 131_072.0).floor())
    })
}

/// Waits until the check `config` satisfies; a flow stays ready whatever it says.
fn check(flow: &FlowProcess, what: &str, is_so: impl Fn(&str, &str) -> bool) {
    let ask = || flow.admin().json("/readyz").unwrap_or_default();
    let holds = || {
        let seen = ask();
        let config = &seen["checks"]["config"];
        seen["status"] == "ready"
            && is_so(
                config["status"].as_str().unwrap_or_default(),
                config["detail"].as_str().unwrap_or_default(),
            )
    };
    wait::until(what, PATIENCE, holds, || format!("{} {}", ask(), flow.tail())).unwrap();
}

/// Acknowledgements of a flow, as anybody on the broker hears them.
struct Acks(RedisReader);

impl Acks {
    fn new(stage: &Stage) -> Self {
        Self(RedisReader::new(&stage.redis.url(), "blaze/config/ack").unwrap())
    }

    fn next(&mut self, status: &str) -> Value {
        let start = Instant::now();
        loop {
            let ack = self.0.next_json(PATIENCE).unwrap();
            if ack["service"] == "blaze-flow" && ack["status"] == status {
                return ack;
            }
            assert!(start.elapsed() < PATIENCE, "{status}: {ack}");
        }
    }
}

/// Waits until the worker knows that the flow has its newest configuration.
async fn is_configured(worker: &Worker) {
    worker
        .until("the flow has its configuration", |status| {
            let mut rows = status["services"].as_array().into_iter().flatten();
            rows.any(|row| {
                row["service"] == "blaze-flow"
                    && row["instance"] == "0"
                    && row["state"] == "ready"
                    && row["hash"].is_string()
                    && row["hash"] == row["config_hash"]
            })
        })
        .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_limit_of_layer_or_node_is_in_effect_within_a_second_and_nobody_else_hears() {
    let stage = Stage::new();
    // The flow first, for once: it is ready without a worker, and finds the one that comes.
    let mut flow =
        FlowProcess::start(FlowSpec { limit_mbps: 30.0, ..spec(&stage, "robot-1") }).unwrap();
    has_limit(&flow, 30.0, PATIENCE);
    let _main = stage.main();
    stage.robot().await;
    let worker = stage.worker("robot-1");
    stage.equal(&worker, PATIENCE).await;
    is_configured(&worker).await;
    let record = stage.keys().record("blaze:watchdog:blaze-flow:robot-1:0").await.unwrap();
    let record = record.expect("the flow shows that it lives");
    assert_eq!((record["state"].as_str(), record["layer"].as_str()), ("ready", "edge"));

    let service = stage.service().await;
    let mut acks = Acks::new(&stage);
    let (mut slam, mut nav) = (service.listen("slam").await, service.listen("nav").await);
    let mut own = service.listen("blaze-flow").await;
    // There is no document of the service `blaze-flow`: programs are there without one.
    stage.put("/layers/edge", layer(&limit(12.0))).await;
    let took = has_limit(&flow, 12.0, soon());
    let notice = next(&mut own).await;
    assert_eq!(notice["paths"], json!(["/flow/bandwidth/limit_mbps"]));
    let ack = acks.next("applied");
    assert_eq!((&ack["hash"], &ack["node"]), (&notice["hash"], &json!("robot-1")));
    stage
        .put(
            "/nodes/robot-1",
            json!({ "layer": "edge", "overrides": { "blaze-flow": limit(9.5) } }),
        )
        .await;
    let again = has_limit(&flow, 9.5, soon());
    eprintln!("a changed limit is in effect after {took:?} and {again:?}");
    let effective = stage.get("/effective?service=blaze-flow&node=robot-1").await;
    assert_eq!(effective["config"]["flow"]["bandwidth"]["limit_mbps"], 9.5);
    // What is taken away gives the weaker value again, at last that of the file.
    stage.put("/nodes/robot-1", json!({ "layer": "edge" })).await;
    has_limit(&flow, 12.0, soon());
    stage.put("/layers/edge", layer(&json!({}))).await;
    has_limit(&flow, 30.0, soon());
    next(&mut own).await;
    let others = (rest(&mut slam).await, rest(&mut nav).await);
    assert!(others.0.is_empty() && others.1.is_empty(), "{others:?}");

    flow.terminate().unwrap();
    assert_eq!(flow.exit(PATIENCE).unwrap(), Some(0), "{}", flow.tail());
    let gone = stage.keys().record("blaze:watchdog:blaze-flow:robot-1:0").await.unwrap();
    assert!(gone.is_none(), "a flow that ends takes its sign of life away: {gone:?}");
    worker.stop();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_the_flow_cannot_take_changes_nothing_and_says_so() {
    let stage = Stage::new();
    let _main = stage.main();
    stage.robot().await;
    let worker = stage.worker("robot-1");
    stage.equal(&worker, PATIENCE).await;
    let domain = free_domain().unwrap();
    let flow =
        FlowProcess::start(FlowSpec { limit_mbps: 30.0, ..spec(&stage, "robot-1").joined(domain) })
            .unwrap();
    is_configured(&worker).await;
    let mut acks = Acks::new(&stage);
    stage.put("/layers/edge", layer(&limit(20.0))).await;
    has_limit(&flow, 20.0, PATIENCE);
    acks.next("applied");

    // Directives that no log takes, and a domain that the node file has for something else: each
    // part is good by itself, so the main service takes it. With it comes a limit, which must not
    // count either.
    let log = json!({
        "flow": { "bandwidth": { "limit_mbps": 7 } },
        "log": { "level": "blaze_flow[=info" },
    });
    let dds = json!({ "flow": { "bandwidth": { "limit_mbps": 8 } },
        "brokers": { "layer": { "dds": { "domain": domain, "interface": "127.0.0.1" } } } });
    for (faulty, key) in [(&log, "log.level"), (&dds, "brokers.inter.dds.domain")] {
        stage.put("/layers/edge", layer(faulty)).await;
        let ack = acks.next("rejected");
        let detail = ack["detail"].as_str().unwrap();
        assert!(detail.contains(key), "{detail}");
        check(&flow, "it is shown", |status, detail| status == "failed" && detail.contains(key));
        has_limit(&flow, 20.0, Duration::ZERO);
    }
    // It is said again, for whoever was away.
    acks.next("rejected");

    // A roll-out reaches the flow of its canary; one that this refuses is undone by the worker, and
    // has failed.
    stage.put("/layers/edge", layer(&limit(20.0))).await;
    let canary = json!([{
        "kind": "Node",
        "name": "robot-1",
        "labels": { "canary": "true" },
        "spec": { "layer": "edge" },
    }]);
    stage.send(Method::POST, "/apply", Some(&canary)).await;
    let rollout = |name: &str, flow: &Value| {
        json!({ "name": name, "spec": {
            "target": { "kind": "Layer", "name": "edge" },
            "patch": { "overrides": { "blaze-flow": flow } },
            "canary": { "node_selector": "canary=true" }, "gate": {
                "window_s": 600,
                "max_unhealthy": 0,
            },
        } })
    };
    let slower = rollout("slower", &limit(10.0));
    stage.send(Method::POST, "/rollouts", Some(&slower)).await;
    has_limit(&flow, 10.0, PATIENCE);
    let abort = Some(json!({}));
    stage.send(Method::POST, "/rollouts/slower/abort", abort.as_ref()).await;
    has_limit(&flow, 20.0, PATIENCE);
    check(&flow, "nothing is refused any more", |status, _| status == "ok");
    let worse = rollout("worse", &log);
    stage.send(Method::POST, "/rollouts", Some(&worse)).await;
    let start = Instant::now();
    let reason = loop {
        let status = stage.get("/rollouts/worse").await["status"].clone();
        if status["phase"] == "failed" {
            break status["canaries"][0]["reason"].to_string();
        }
        assert!(start.elapsed() < PATIENCE, "{status}; {}", worker.tail());
        tokio::time::sleep(Duration::from_millis(20)).await;
    };
    assert!(reason.contains("log.level"), "it is the flow that refused: {reason}");
    check(&flow, "it is as before", |status, _| status == "ok");
    has_limit(&flow, 20.0, Duration::ZERO);
    let status = worker.status().await;
    assert!(status["connected"].as_bool().unwrap(), "{status}");
    worker.stop();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_node_file_and_blaze_config_change_apart_from_each_other() {
    let stage = Stage::new();
    let _main = stage.main();
    stage.robot().await;
    let worker = stage.worker("robot-1");
    stage.equal(&worker, PATIENCE).await;
    let mut flow =
        FlowProcess::start(FlowSpec { limit_mbps: 30.0, ..spec(&stage, "robot-1") }).unwrap();
    is_configured(&worker).await;
    stage.put("/layers/edge", layer(&limit(20.0))).await;
    has_limit(&flow, 20.0, PATIENCE);
    // The file says something else beside, which counts, and another limit, which does not.
    flow.edit(|spec| {
        spec.limit_mbps = 31.0;
        spec.bandwidth = "share: fair".to_owned();
    })
    .unwrap();
    allocates(&flow, "both count", PATIENCE, |seen| {
        seen["share"] == "fair" && seen["limit_mbps"] == 20.0
    });
    // What does not change while a flow runs is named.
    stage.put("/layers/edge", layer(&json!({ "flow": { "gateway": true } }))).await;
    has_limit(&flow, 31.0, PATIENCE);
    check(&flow, "it is named", |status, detail| {
        status == "ok" && detail.contains("flow.gateway") && detail.contains("BlazeConfig")
    });
    // Without the main service and the worker it stays as it is.
    stage.put("/layers/edge", layer(&limit(22.0))).await;
    has_limit(&flow, 22.0, PATIENCE);
    worker.kill();
    flow.edit(|spec| spec.bandwidth = "share: paper".to_owned()).unwrap();
    allocates(&flow, "without a worker", PATIENCE, |seen| {
        seen["share"] == "paper" && seen["limit_mbps"] == 22.0
    });
    let _worker = stage.worker("robot-1");
    stage.put("/layers/edge", layer(&json!({}))).await;
    has_limit(&flow, 31.0, PATIENCE);
}

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
    let far = FlowSpec::new("fog", "fog-1").on_redis(&far_redis.url(), "").joined(domain);
    let mut flow = FlowProcess::launch(spec(&stage, "robot-1").joined(domain)).unwrap();
    let mut far = FlowProcess::launch(far).unwrap();
    flow.wait_ready().unwrap();
    far.wait_ready().unwrap();
    is_configured(&worker).await;
    let near = stage.redis.url();
    let advertise = json!({
        "op": "advertise",
        "topic": "camera/x",
        "service": "camera",
        "rate_hz": 50,
        "max_bytes": BYTES,
        "ttl_s": 600,
    });
    plain::tell_redis(&near, "", &advertise).unwrap();
    let request =
        json!({ "op": "request", "topic": "camera/x", "service": "viewer", "ttl_s": 600 });
    plain::tell_redis(&far_redis.url(), "", &request).unwrap();
    flow.wait_bridge("camera/x", PATIENCE).unwrap();
    let topic = |seen: &Value| {
        let mut rows = seen["topics"].as_array().into_iter().flatten();
        rows.find(|row| row["topic"] == "camera/x").cloned().unwrap_or_default()
    };
    let rate =
        move |seen: &Value| topic(seen)["lanes"][0]["allocated_hz"].as_f64().unwrap_or_default();
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
    allocates(&flow, "the rule counts", soon(), move |seen| (3.9..4.1).contains(&rate(seen)));
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
