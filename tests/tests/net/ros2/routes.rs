//! Messages from a node of the robot to one in the cloud, over flows and a link: the same bytes, in
//! order, once.

use anyhow::Context as _;
use blaze_tests::ros2::{Quality, Release, Stream};

use super::support::{ARRIVE, DEEP, NODE, Pair, ends};

const STATIC: &str = "/tf_static";
const TRANSFORMS: &str = "tf2_msgs/msg/TFMessage";

/// Topic, type, bytes of a message, how many of them, and how many a second.
type Topic = (&'static str, &'static str, usize, usize, f64);

const TEXT: Topic = ("/text", "std_msgs/msg/String", 101, 50, 50.0);
/// Its type does not tell that its messages are large, the first one does.
const LONG_TEXT: Topic = ("/long_text", "std_msgs/msg/String", 70_000, 150, 100.0);
const IMAGE: Topic = ("/image", "sensor_msgs/msg/Image", 1_000_000, 5, 2.0);
pub(super) const TOPICS: [Topic; 7] = [
    TEXT,
    ("/imu", "sensor_msgs/msg/Imu", 0, 50, 50.0),
    ("/odom", "nav_msgs/msg/Odometry", 0, 50, 50.0),
    ("/scan", "sensor_msgs/msg/LaserScan", 6_000, 20, 20.0),
    ("/tf", TRANSFORMS, 1_000, 20, 20.0),
    IMAGE,
    ("/large", "sensor_msgs/msg/Image", 6_000_000, 2, 0.5),
];

/// Some topics from one release to another.
pub(super) fn carry(
    pair: &Pair,
    from: Release,
    to: Release,
    topics: &[Topic],
) -> anyhow::Result<()> {
    let (talker, listener) = (pair.on_robot(from)?, pair.in_cloud(to)?);
    for &(topic, kind, size, count, hz) in topics {
        let name = format!("{topic}/{from:?}/{to:?}").to_lowercase();
        let (publisher, subscription) = ends(&talker, &listener, &name, kind, DEEP)?;
        pair.wait_route(&name, &publisher, &subscription)?;
        let sent = publisher.publish_all(Stream { count, size, hz, seed: 1 })?;
        let received = subscription.received(sent.len(), ARRIVE);
        let received = received.with_context(|| format!("{name}\n{}", pair.state(&name)))?;
        assert_eq!(received, sent, "{name}");
    }
    talker.finish()?;
    listener.finish()
}

#[test]
fn messages_arrive_in_the_cloud_as_they_were_published() -> anyhow::Result<()> {
    use Release::{Cyclone, FastDds, Jazzy, Kilted};
    let pair = Pair::start()?;
    for (from, to) in [(Jazzy, Kilted), (Kilted, Cyclone), (Cyclone, Jazzy)] {
        carry(&pair, from, to, &TOPICS)?;
    }
    for (from, to) in [(FastDds, Kilted), (Jazzy, FastDds)] {
        carry(&pair, from, to, &[TEXT, IMAGE])?;
    }
    carry(&pair, Jazzy, Kilted, &[LONG_TEXT])
}

#[test]
fn late_joiners_get_the_static_transforms_of_all_robots_nodes() -> anyhow::Result<()> {
    let pair = Pair::start()?;
    let durable = Quality { durable: true, depth: 1, ..Quality::default() };
    let mut sent = Vec::new();
    let writers = Release::ALL.map(|release| pair.on_robot(release));
    let writers = writers.into_iter().collect::<anyhow::Result<Vec<_>>>()?;
    for (seed, writer) in (1..).zip(&writers) {
        let publisher = writer.publisher(NODE, STATIC, TRANSFORMS, durable)?;
        sent.extend(publisher.publish_all(Stream { count: 1, size: 500, hz: 0.0, seed })?);
    }
    sent.sort_by(|a, b| a.1.cmp(&b.1));
    for release in Release::ALL {
        let joiner = pair.in_cloud(release)?;
        let all = Quality { durable: true, ..DEEP };
        let subscription = joiner.subscription(NODE, STATIC, TRANSFORMS, all)?;
        let received = subscription.received(sent.len(), ARRIVE);
        let mut received =
            received.with_context(|| format!("{release:?}\n{}", pair.state(STATIC)))?;
        received.sort_by(|a, b| a.1.cmp(&b.1));
        assert_eq!(received, sent, "{release:?}");
    }
    Ok(())
}
