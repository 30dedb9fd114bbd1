//! `blaze doctor` beside a flow on a real Redis: nothing fails while all is well, and a broken
//! broker is named.

use std::net::SocketAddr;

use blaze_tests::flow::{FlowProcess, FlowSpec};
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer, free_port};
use serde_json::{Value, json};

use crate::cli::stage::Stage;

/// The node file of the flow, with the port that the system gave it.
fn node_file(stage: &Stage, url: &str, flow: SocketAddr) -> String {
    let free = || format!("127.0.0.1:{}", free_port().unwrap());
    let file = json!({
        "layer": { "name": "edge", "kind": "edge" }, "node": { "name": "robot-1" },
        "brokers": { "node": { "redis": { "url": url } } },
        "admin": { "flow": flow, "worker": free(), "monitor": free() },
        "control_plane": { "admin": { "listen": free() } },
        "state_dir": stage.path("state"),
        // The disk of the machine that runs the test is not what is tested.
        "monitor": { "thresholds": { "disk_free_ratio": 0 } },
    });
    stage.write("doctor.yaml", &file.to_string()).display().to_string()
}

fn check<'v>(answer: &'v Value, name: &str) -> &'v Value {
    let checks = answer["checks"].as_array().unwrap();
    checks.iter().find(|check| check["check"] == name).unwrap()
}

#[test]
fn a_healthy_node_has_no_failing_check_and_a_dead_broker_is_named() {
    let stage = Stage::new();
    let server = RedisServer::start(RedisKind::Redis, RedisOptions::default()).unwrap();
    let spec = FlowSpec::new("edge", "robot-1").on_redis(&server.url(), "");
    let flow = FlowProcess::start(spec).unwrap();
    let secret = server.url().replace("redis://", "redis://:sesame@");
    let file = node_file(&stage, &server.url(), flow.admin().address);
    let doctor = |file: &str| stage.run("blaze", &["doctor", "-o", "json", "--config", file]);
    let healthy = doctor(&file);
    assert_eq!(healthy.code, 0, "{healthy:?}");
    let answer = healthy.json();
    assert_eq!(answer["checks"].as_array().unwrap().len(), 19);
    for name in ["node_file", "ports", "brokers", "versions", "leases", "budget", "descriptors"] {
        assert_eq!(check(&answer, name)["result"], "ok", "{answer}");
    }
    for row in answer["checks"].as_array().unwrap() {
        assert_ne!(row["result"], "fail", "{row}");
        assert!(row["result"] == "ok" || row["remedy"] != "", "{row}");
    }
    server.kill().unwrap();
    let file = node_file(&stage, &secret, flow.admin().address);
    let broken = doctor(&file);
    assert_eq!(broken.code, 1, "{broken:?}");
    let answer = broken.json();
    let brokers = check(&answer, "brokers");
    assert_eq!(brokers["result"], "fail", "{answer}");
    assert!(brokers["detail"].as_str().unwrap().contains(&server.url()), "{brokers}");
    assert!(brokers["remedy"].as_str().unwrap().contains("redis-cli -u"), "{brokers}");
    assert!(!broken.stdout.contains("sesame"), "{broken:?}");
}
