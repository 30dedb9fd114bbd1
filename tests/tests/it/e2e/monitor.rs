//! Monitors beside two flows that are joined: pings go through BlazeFlow, latency comes from the
//! flows, and what is broken is named and over again when it is mended.

use std::time::Duration;

use blaze_tests::fleet::{MainService, MainStore};
use blaze_tests::flow::{FlowProcess, FlowSpec, free_domain};
use blaze_tests::monitor::MonitorProcess;
use blaze_tests::plain::{connect, tell_redis};
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer, unique_name};
use blaze_tests::wait;
use serde_json::{Value, json};

/// A fault is named within 10 s, and gone 30 s after it is mended.
const NAMED: Duration = Duration::from_secs(20);
const OVER: Duration = Duration::from_secs(40);
const SOON: Duration = Duration::from_secs(30);

/// Pings come quickly, and the disk of the machine that runs the test is not what is tested.
const SECTION: &str = "monitor: { ping_period_s: 1, latency_topics: [\"imu/**\"], \
                       thresholds: { disk_free_ratio: 0, memory_free_ratio: 0, celsius: 200 } }\n";

struct Pair {
    robot: FlowProcess,
    cloud: FlowProcess,
    server: RedisServer,
    run: String,
}

impl Pair {
    fn start() -> anyhow::Result<Self> {
        let server = RedisServer::start(RedisKind::Redis, RedisOptions::default())?;
        let (domain, run) = (free_domain()?, unique_name("monitor"));
        let launch = |layer: &str, node: &str| {
            let spec = FlowSpec::new(layer, node).joined(domain);
            FlowProcess::launch(spec.on_redis(&server.url(), &format!("{run}-{node}:")))
        };
        let (mut robot, mut cloud) = (launch("edge", "robot-1")?, launch("cloud", "cloud-1")?);
        robot.wait_ready()?;
        cloud.wait_ready()?;
        Ok(Self { robot, cloud, server, run })
    }

    fn tell(&self, node: &str, message: &Value) -> anyhow::Result<()> {
        tell_redis(&self.server.url(), &format!("{}-{node}:", self.run), message)
    }

    fn publish(&self, topic: &str) -> anyhow::Result<()> {
        let channel = format!("{}-robot-1:{topic}", self.run);
        redis::cmd("PUBLISH").arg(channel).arg("{}").exec(&mut connect(&self.server.url())?)?;
        Ok(())
    }
}

fn row<'v>(ping: &'v Value, node: &str) -> Option<&'v Value> {
    ping["nodes"].as_array()?.iter().find(|row| row["node"] == node)
}

#[test]
fn two_nodes_ping_each_other_and_tell_how_long_messages_take() -> anyhow::Result<()> {
    let pair = Pair::start()?;
    let robot = MonitorProcess::beside(&pair.robot, SECTION)?;
    let cloud = MonitorProcess::beside(&pair.cloud, SECTION)?;
    for (monitor, other) in [(&robot, "cloud-1"), (&cloud, "robot-1")] {
        let ping = wait::until_some(
            "a ping is answered",
            SOON,
            || {
                let ping = monitor.admin().json("/v1/ping").ok()?;
                row(&ping, other)?["latency_ms"]["p50"].as_f64()?;
                Some(ping)
            },
            || monitor.process().tail(),
        )?;
        let row = row(&ping, other).unwrap();
        // One clock: the true offset is 0.
        let (offset, error) = (&row["clock_offset_ms"], &row["clock_error_ms"]);
        let (offset, error) = (offset.as_f64().unwrap(), error.as_f64().unwrap());
        assert!(offset.abs() <= error, "{row}");
    }
    let topic = "imu/data";
    let advertise = json!({"op":"advertise","topic":topic,"service":"imu","ttl_s":0});
    let request = json!({"op":"request","topic":topic,"service":"log","ttl_s":0});
    pair.tell("robot-1", &advertise)?;
    pair.tell("cloud-1", &request)?;
    let latency = wait::until_some(
        "the cloud's monitor has the latency of the topic",
        SOON,
        || {
            let _ = pair.publish(topic);
            let latency = cloud.admin().json("/v1/latency").ok()?;
            let row = latency["topics"].as_array()?.first()?.clone();
            row["latency_ms"]["p50"].as_f64()?;
            Some(row)
        },
        || format!("{:?}\n{}", cloud.admin().json("/v1/latency"), cloud.process().tail()),
    )?;
    assert_eq!(
        (&latency["topic"], &latency["method"]),
        (&json!(topic), &json!("age")),
        "{latency}"
    );
    assert_eq!(latency["from"], "edge/robot-1", "{latency}");
    let (_, page) = cloud.admin().get("/metrics?all=1")?;
    for series in [
        "blaze_ping_sent_total{program=\"blaze-monitor\",to_layer=\"edge\"",
        "blaze_flow_messages_total{program=\"blaze-flow\"",
        "blaze_health{program=\"blaze-monitor\",",
        "blaze_node_cpu_seconds_total{program=\"blaze-monitor\",cpu=\"0\"",
    ] {
        assert!(page.contains(series), "{series} is not on the page:\n{page}");
    }
    assert_eq!(page.matches("# TYPE blaze_build_info ").count(), 1);
    assert_eq!((robot.problems(), cloud.problems()), (vec![], vec![]));
    Ok(())
}

#[test]
fn what_is_broken_is_named_and_over_when_it_is_mended() -> anyhow::Result<()> {
    let mut pair = Pair::start()?;
    let robot = MonitorProcess::beside(&pair.robot, SECTION)?;
    let advertise = |kind: &str| json!({"op":"advertise","topic":"scan","service":"lidar","ttl_s":0,"type":kind});
    let request = json!({"op":"request","topic":"scan","service":"log","ttl_s":0,"type":"b/msg/B"});
    pair.tell("cloud-1", &request)?;
    pair.tell("robot-1", &advertise("a/msg/A"))?;
    robot.wait_problem("type_mismatch", true, NAMED)?;
    pair.tell("robot-1", &advertise("b/msg/B"))?;
    robot.wait_problem("type_mismatch", false, OVER)?;
    pair.cloud.kill()?;
    robot.wait_problem("peer_down", true, NAMED)?;
    pair.cloud.relaunch()?;
    robot.wait_problem("peer_down", false, OVER)?;
    pair.server.kill()?;
    robot.wait_problem("flow_not_ready", true, NAMED)?;
    pair.server.restart()?;
    robot.wait_problem("flow_not_ready", false, OVER)?;
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_main_service_has_the_state_of_a_node_that_reports() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let main = MainService::start(folder.path(), &MainStore::Sqlite)?;
    let api = main.api()?;
    api.apply(&[
        json!({"kind": "Layer", "name": "edge", "spec": {"kind": "edge"}}),
        json!({"kind": "Node", "name": "robot-1", "spec": {"layer": "edge"}}),
    ])
    .await?;
    let pair = tokio::task::spawn_blocking(Pair::start).await??;
    let reporting = format!("{SECTION}config: {{ server: \"{}\" }}\n", main.server());
    let robot = MonitorProcess::beside(&pair.robot, &reporting)?;
    let reports = || robot.admin().metric("blaze_monitor_report_connected", &[]) == Some(1.0);
    let waiting = async {
        while !reports() {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    };
    tokio::time::timeout(SOON, waiting).await?;
    let health = api.get("/series?node=robot-1&names=").await?;
    assert_eq!((&health["layer"], &health["node"]), (&json!("edge"), &json!("robot-1")));
    let request = json!({"op":"request","topic":"scan","service":"log","ttl_s":0,"type":"b/msg/B"});
    let offer = json!({"op":"advertise","topic":"scan","service":"a","ttl_s":0,"type":"a/msg/A"});
    pair.tell("cloud-1", &request)?;
    pair.tell("robot-1", &offer)?;
    let problem = async {
        loop {
            let problems = api.get("/problems").await?;
            let rows = problems["items"].as_array().cloned().unwrap_or_default();
            match rows.into_iter().find(|row| row["code"] == "type_mismatch") {
                Some(row) => return anyhow::Ok(row),
                None => tokio::time::sleep(Duration::from_millis(100)).await,
            }
        }
    };
    let row = tokio::time::timeout(NAMED, problem).await??;
    assert_eq!(
        (&row["layer"], &row["node"], &row["name"]),
        (&json!("edge"), &json!("robot-1"), &json!("scan"))
    );
    let why = api.get("/why?topic=scan&from=edge/robot-1&to=cloud").await?;
    assert_eq!(
        (&why["verdict"], &why["code"]),
        (&json!("not_flowing"), &json!("type_mismatch")),
        "{why}"
    );
    Ok(())
}
