//! What rclpy sees of the other side before anybody asks for it.

use std::time::Duration;

use anyhow::Context as _;
use blaze_tests::ros2::{Peer, Quality, Release};
use blaze_tests::{wait, within};
use serde_json::{Value, json};

use super::support::{MEET, NODE, Pair};

const TOPICS: [(&str, &str); 3] = [
    ("/imu", "sensor_msgs/msg/Imu"),
    ("/scan", "sensor_msgs/msg/LaserScan"),
    ("/tf", "tf2_msgs/msg/TFMessage"),
];
/// For a subscription to get from one network to the other, and for its end.
const FOLLOWS: Duration = Duration::from_secs(3);

/// The nodes that publish a topic, as a peer sees it, and the hashes of their types.
fn publishers(peer: &Peer, topic: &str) -> anyhow::Result<Vec<(Value, Value)>> {
    let answer = peer.ask(&json!({ "op": "endpoints", "node": NODE, "topic": topic }))?;
    let all = answer["publishers"].as_array().context("no publishers")?;
    Ok(all.iter().map(|each| (each["node"].clone(), each["hash"].clone())).collect())
}

#[test]
fn the_cloud_shows_the_topics_of_the_robot_before_anybody_subscribes() -> anyhow::Result<()> {
    let pair = Pair::start()?;
    let robot = pair.on_robot(Release::Jazzy)?;
    let made = TOPICS.map(|(topic, kind)| robot.publisher(NODE, topic, kind, Quality::default()));
    let made = made.into_iter().collect::<anyhow::Result<Vec<_>>>()?;
    for release in [Release::Jazzy, Release::Kilted] {
        let cloud = pair.in_cloud(release)?;
        let asked = || cloud.ask(&json!({ "op": "topics", "node": NODE })).unwrap_or_default();
        let shows = || {
            let topics = &asked()["topics"];
            TOPICS.iter().all(|(topic, kind)| topics[topic] == json!([kind]))
        };
        wait::until("all topics show", MEET, shows, || {
            format!("{} {}", asked(), pair.state("/imu"))
        })?;
        let nodes = || cloud.ask(&json!({ "op": "nodes", "node": NODE })).unwrap_or_default();
        let has_flow = || nodes()["nodes"].to_string().contains("\"/blaze/cloud_cloud_1\"");
        wait::until("the node of the flow shows", MEET, has_flow, || nodes().to_string())?;
        for (topic, _) in TOPICS {
            let own = publishers(&robot, topic)?;
            let (_, hash) = own.first().with_context(|| format!("{topic} on the robot"))?;
            let named = || {
                let shown = publishers(&cloud, topic).unwrap_or_default();
                let is_it = |(node, _): &(Value, Value)| node == "/blaze/cloud_cloud_1";
                shown.len() == 1 && shown.iter().all(is_it)
            };
            let state = || format!("{:?}", publishers(&cloud, topic));
            wait::until(&format!("{topic} is of the flow's node"), MEET, named, state)?;
            let shown = publishers(&cloud, topic)?;
            // RustDDS sends no user data, so there is no hash to show.
            println!("{release:?} sees {topic} as {}, on the robot {hash}", shown[0].1);
        }
        // Nobody has asked for anything: the robot need not publish.
        for ((topic, kind), publisher) in TOPICS.iter().zip(&made) {
            assert_eq!(publisher.matched()?, 0, "{topic}");
            let subscription = cloud.subscription(NODE, topic, kind, Quality::default())?;
            publisher.wait_matched(1, within(FOLLOWS))?;
            subscription.destroy()?;
            publisher.wait_matched(0, within(FOLLOWS))?;
        }
        cloud.finish()?;
    }
    Ok(())
}

#[test]
fn topics_and_nodes_that_end_are_shown_no_longer() -> anyhow::Result<()> {
    let pair = Pair::start()?;
    let (robot, cloud) = (pair.on_robot(Release::Jazzy)?, pair.in_cloud(Release::Kilted)?);
    robot.node("driver")?;
    robot.publisher("driver", "/imu", "sensor_msgs/msg/Imu", Quality::default())?;
    let shown = |count: usize| {
        let holds = || publishers(&cloud, "/imu").is_ok_and(|found| found.len() == count);
        let state = || format!("{:?} {}", publishers(&cloud, "/imu"), pair.state("/imu"));
        wait::until(&format!("{count} publishers of /imu"), MEET, holds, state)
    };
    shown(1)?;
    robot.end_node("driver")?;
    let took = shown(0)?;
    println!("/imu went {took:?} after its node");
    Ok(())
}
