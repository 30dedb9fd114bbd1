//! Calls of ROS 2 services from clients of Redis: in the cloud, whose flow is on no ROS 2 network,
//! and beside the server.

use std::collections::BTreeMap;
use std::process::Output;

use anyhow::Context as _;
use blaze_tests::flow::{FlowProcess, FlowSpec};
use blaze_tests::network::{self, Host, Plan, Topology};
use blaze_tests::plain::{self, RedisReader};
use blaze_tests::process::binary;
use blaze_tests::ros2::{Peer, Release, open_loopback};
use blaze_tests::servers::RedisServer;
use blaze_tests::wait;
use blaze_tests::wan::Shape;
use serde_json::{Value, json};

use super::support::{ARRIVE, DOMAIN, LINK_DOMAIN, MEET, NODE, redis};

const REPLY_TO: &str = "blaze/reply/planner";

/// A host with a Redis and a flow on it.
struct Site {
    host: Host,
    redis: RedisServer,
    flow: FlowProcess,
    answers: RedisReader,
}

impl Site {
    fn start(host: &Host, spec: FlowSpec) -> anyhow::Result<Self> {
        open_loopback(host)?;
        let redis = redis(host)?;
        let url = redis.url();
        let flow = FlowProcess::launch(spec.on_redis(&url, ""))?;
        let answers = network::inside(&host.namespace, || RedisReader::new(&url, REPLY_TO))?;
        Ok(Self { host: host.clone(), redis, flow, answers })
    }

    fn say(&self, call: &Value) -> anyhow::Result<()> {
        let url = self.redis.url();
        network::inside(&self.host.namespace, || plain::tell_redis(&url, "", call))
    }

    /// The answer to a call.
    fn call(&mut self, service: &str, request: &Value, timeout_ms: u64) -> anyhow::Result<Value> {
        self.say(&call(service, "7", request, timeout_ms))?;
        self.answers.next_json(ARRIVE)
    }

    /// `blaze call` beside the flow.
    fn command(&self, service: &str, request: &str) -> anyhow::Result<Output> {
        let file = tempfile::NamedTempFile::new()?;
        std::fs::write(file.path(), self.flow.spec.to_yaml(file.path()))?;
        let mut command = network::program(Some(&self.host.namespace), binary("blaze")?);
        command.args(["call", service, request, "--timeout", "20s", "--config"]).arg(file.path());
        Ok(command.output()?)
    }
}

fn call(service: &str, id: &str, request: &Value, timeout_ms: u64) -> Value {
    json!({
        "op": "call", "topic": service, "service": "planner", "id": id, "reply_to": REPLY_TO,
        "request": request, "timeout_ms": timeout_ms,
    })
}

#[test]
fn clients_of_redis_call_services_of_ros_2() -> anyhow::Result<()> {
    const TOLD: &str = "it is on";
    let network = Topology::build(&Plan::two_hosts("robot", "cloud", Shape::to_cloud()))?;
    let (robot, cloud) = (network.host("robot")?, network.host("cloud")?);
    let spec = |layer, node, host: &Host, peers: &[_]| {
        FlowSpec::new(layer, node).joined(LINK_DOMAIN).inside(host, peers)
    };
    let edge = spec("edge", "robot-1", robot, &[cloud.address]).on_ros2(DOMAIN);
    let mut edge = Site::start(robot, edge)?;
    let mut cloud = Site::start(cloud, spec("cloud", "cloud-1", cloud, &[]))?;
    edge.flow.wait_ready()?;
    cloud.flow.wait_ready()?;
    let code = |answer: &Value| answer["error"]["code"].as_str().unwrap_or_default().to_owned();
    let none = cloud.call("power", &json!({"data": true}), 20_000)?;
    assert_eq!((&none["id"], code(&none).as_str()), (&json!("7"), "no_server"), "{none}");

    let peer = Peer::start(Release::Jazzy, robot, DOMAIN)?;
    peer.node(NODE)?;
    let server = |name: &str, delay_ms: u64| {
        peer.end(json!({
            "op": "server", "node": NODE, "service": name, "type": "std_srvs/srv/SetBool",
            "reply": {"success": true, "message": TOLD}, "delay_ms": delay_ms,
        }))
    };
    let (power, slow) = (server("/power", 0)?, server("/slow", 2_000)?);
    let knows = |flow: &FlowProcess, service: &str| {
        let topics = flow.admin().json("/v1/topics").unwrap_or_default();
        topics.to_string().contains(&format!("{service}/_request"))
    };
    for service in ["power", "slow"] {
        let known = || knows(&cloud.flow, service) && knows(&edge.flow, service);
        wait::until("the server is known", MEET, known, || cloud.flow.tail())?;
    }
    // From the other layer, and from the broker beside the network of the server.
    let mut executed = 0;
    for site in [&mut cloud, &mut edge] {
        let answer = site.call("power", &json!({"data": true}), 20_000)?;
        let reply = json!({"success": true, "message": TOLD});
        let expected = json!({"id": "7", "ok": true, "flow": "edge/robot-1", "reply": reply});
        assert_eq!(answer, expected, "{}", site.flow.tail());
        executed += 1;
        let wrong = site.call("power", &json!({"data": "yes"}), 20_000)?;
        let pointer = &wrong["error"]["pointer"];
        assert_eq!((code(&wrong).as_str(), pointer), ("convert_error", &json!("/request/data")));
    }
    assert_eq!(power.served()?, executed, "what cannot be converted is not executed");

    // Many, as many at once as a server of ROS 2 has room for: each has its own answer, and is
    // executed once.
    let mut answered = BTreeMap::new();
    for round in 0..6 {
        let ids: Vec<String> = (0..8).map(|number| format!("{round}-{number}")).collect();
        for id in &ids {
            cloud.say(&call("power", id, &json!({"data": false}), 20_000))?;
        }
        for _ in &ids {
            let answer = cloud.answers.next_json(ARRIVE)?;
            assert_eq!(answer["ok"], true, "{answer} {:?}", power.served());
            let id = answer["id"].as_str().context("no id")?.to_owned();
            *answered.entry(id).or_insert(0) += 1;
        }
    }
    assert!(answered.len() == 48 && answered.values().all(|count| *count == 1), "{answered:?}");
    assert_eq!(power.served()?, executed + 48);

    // The server is slower than its client waits; it executes the request all the same, once.
    let late = cloud.call("slow", &json!({"data": true}), 1_000)?;
    assert_eq!(code(&late), "timeout", "{late}");
    let in_time = cloud.call("slow", &json!({"data": true}), 20_000)?;
    assert_eq!((&in_time["ok"], slow.served()?), (&json!(true), 2), "{in_time}");

    for (service, request, exit, part) in [
        ("/power", r#"{"data": true}"#, 0, TOLD),
        ("/power", r#"{"date": true}"#, 7, "/request/date"),
        ("/nobody", "{}", 4, "no_server"),
    ] {
        let done = cloud.command(service, request)?;
        let text = [&done.stdout[..], &done.stderr[..]].map(String::from_utf8_lossy).concat();
        assert_eq!(done.status.code(), Some(exit), "{service} {request}: {text}");
        assert!(text.contains(part), "{text}");
    }
    let timeouts = cloud.flow.admin().metric("blaze_ros2_calls_total", &["outcome=\"timeout\""]);
    assert_eq!(timeouts, Some(1.0));
    peer.finish()
}
