//! `blaze echo`, `pub` and `demo` beside ROS 2 nodes.

use std::time::Duration;

use blaze_tests::flow::{FlowProcess, FlowSpec};
use blaze_tests::network::{Plan, Topology};
use blaze_tests::process::Process;
use blaze_tests::ros2::{Peer, Quality, Release, Stream, open_loopback};
use blaze_tests::wait;
use blaze_tests::wan::Shape;
use serde_json::{Value, json};

use super::support::{ARRIVE, DOMAIN, MEET, NODE, redis};

const TWIST: &str = "geometry_msgs/msg/Twist";

#[test]
fn messages_of_nodes_are_printed_and_json_is_published_for_them() -> anyhow::Result<()> {
    let network = Topology::build(&Plan::two_hosts("robot", "other", Shape::default()))?;
    let host = network.host("robot")?;
    open_loopback(host)?;
    let redis = redis(host)?;
    let spec = FlowSpec::new("edge", "robot-1").on_ros2(DOMAIN).on_redis(&redis.url(), "");
    let flow = FlowProcess::start(spec.inside(host, &[]))?;
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("blaze.yaml");
    std::fs::write(&file, flow.spec.to_yaml(folder.path()))?;
    let blaze = |line: &[&str]| {
        let config = ["--config", &file.to_string_lossy()].map(str::to_owned);
        let line: Vec<String> = line.iter().map(|word| (*word).to_owned()).chain(config).collect();
        let line: Vec<&str> = line.iter().map(String::as_str).collect();
        Process::start("blaze", &line, Some(&host.namespace))
    };
    let peer = Peer::start(Release::Jazzy, host, DOMAIN)?;
    peer.node(NODE)?;

    let publisher = peer.publisher(NODE, "/cmd_vel", TWIST, Quality::default())?;
    let mut echo = blaze(&["echo", "cmd_vel", "--count", "1", "-o", "json"])?;
    let printed = || {
        let stream = Stream { count: 1, size: 0, hz: 0.0, seed: 1 };
        let _ = publisher.publish_all(stream);
        echo.stdout().first().cloned()
    };
    let line = wait::until_some("a message is printed", MEET, printed, || echo.tail())?;
    let printed: Value = serde_json::from_str(&line)?;
    assert_eq!(printed["type"], TWIST);
    assert!(printed["message"]["linear"]["x"].is_number(), "{printed}");
    assert_eq!(printed["payload_base64"], Value::Null);
    assert_eq!(echo.exit(ARRIVE)?, Some(0), "{}", echo.tail());

    let subscription =
        peer.subscription(NODE, "/speed", "std_msgs/msg/Float64", Quality::default())?;
    let publish = |payload: &str| {
        let mut publish = blaze(&["pub", "speed", payload, "--type", "std_msgs/msg/Float64"])?;
        Ok::<_, anyhow::Error>((publish.exit(ARRIVE)?, publish.tail()))
    };
    let (code, said) = publish(r#"{"data":"fast"}"#)?;
    assert!(code == Some(7) && said.contains("/data: expected a number, found text"), "{said}");
    let (code, said) = publish(r#"{"data":0.5}"#)?;
    assert_eq!(code, Some(0), "{said}");
    subscription.received(1, ARRIVE)?;
    Ok(())
}

#[test]
fn the_demo_shows_its_topics_to_nodes() -> anyhow::Result<()> {
    const TOPICS: [(&str, &str); 3] = [
        ("/imu/data", "sensor_msgs/msg/Imu"),
        ("/jackal_velocity_controller/odom", "nav_msgs/msg/Odometry"),
        ("/camera/image_raw", "sensor_msgs/msg/Image"),
    ];
    let network = Topology::build(&Plan::two_hosts("here", "other", Shape::default()))?;
    let host = network.host("here")?;
    open_loopback(host)?;
    let domain = DOMAIN.to_string();
    let line = ["demo", "--ros2", &domain, "--duration", "10m", "-o", "json"];
    let demo = Process::start("blaze", &line, Some(&host.namespace))?;
    let peer = Peer::start(Release::Kilted, host, DOMAIN)?;
    peer.node(NODE)?;
    let asked = || peer.ask(&json!({ "op": "topics", "node": NODE })).unwrap_or_default();
    let shows = || TOPICS.iter().all(|(topic, kind)| asked()["topics"][topic] == json!([kind]));
    wait::until("all topics show", 2 * MEET, shows, || format!("{}\n{}", asked(), demo.tail()))?;
    for (topic, kind) in TOPICS {
        let count = if kind.ends_with("Image") { 2 } else { 20 };
        let quality = Quality { reliable: false, ..Quality::default() };
        let subscription = peer.subscription(NODE, topic, kind, quality)?;
        let received = subscription.received(count, Duration::from_secs(60));
        received.map_err(|error| anyhow::anyhow!("{topic}: {error:#}\n{}", demo.tail()))?;
    }
    Ok(())
}
