//! Nodes and endpoints that come and go: nothing is doubled, no route stays, and a flow holds what
//! it held before.

use std::time::Duration;

use anyhow::Context as _;
use blaze_tests::process::Usage;
use blaze_tests::ros2::{Release, Stream};
use blaze_tests::wait;

use super::support::{ARRIVE, DEEP, MEET, NODE, Pair};

const KIND: &str = "std_msgs/msg/String";
/// For what a flow holds to be as before: samples and ends of endpoints are kept for seconds.
const SETTLES: Duration = Duration::from_secs(40);
/// What a flow may hold beyond what it held before.
const MORE: Usage = Usage { resident_kib: 32 * 1024, threads: 4, descriptors: 16 };

/// What each flow holds.
fn usage(pair: &Pair) -> anyhow::Result<[Usage; 2]> {
    Ok([pair.edge.usage()?, pair.cloud.usage()?])
}

/// Waits until no topic is bridged, no endpoint of the peers is known but `left` per network, and
/// the flows hold what they held before.
fn settle(pair: &Pair, before: &[Usage; 2], left: usize) -> anyhow::Result<()> {
    let own = |endpoint: &serde_json::Value| {
        !endpoint["topic"].is_null() && endpoint["code"] != "access_denied"
    };
    let counts = || -> anyhow::Result<[usize; 2]> {
        let mut counts = [0; 2];
        for (count, flow) in counts.iter_mut().zip([&pair.edge, &pair.cloud]) {
            let answer = flow.admin().json("/v1/ros2")?;
            let all = answer["endpoints"].as_array().context("no endpoints")?;
            *count = all.iter().filter(|endpoint| own(endpoint)).count();
        }
        Ok(counts)
    };
    let state = || {
        let up = [pair.edge.bridges_up(), pair.cloud.bridges_up()];
        format!("endpoints {:?}, bridges {up:?}, {:?} after {before:?}", counts(), usage(pair))
    };
    let holds = || {
        counts().is_ok_and(|counts| counts == [left; 2])
            && pair.edge.bridges_up().is_empty()
            && pair.cloud.bridges_up().is_empty()
            && usage(pair).is_ok_and(|now| {
                now.iter().zip(before).all(|(now, before)| now.exceeds_by_at_most(before, &MORE))
            })
    };
    let took = wait::until("the flows hold what they held before", SETTLES, holds, state)?;
    println!("settled after {took:?}: {}", state());
    Ok(())
}

/// A node of one name that is started again and again, each time with three messages as soon as its
/// publisher has met a subscription. `kills`: every fifth time its process is killed.
pub(super) fn restart(rounds: usize, kills: bool) -> anyhow::Result<()> {
    let pair = Pair::start()?;
    let (mut robot, cloud) = (pair.on_robot(Release::Jazzy)?, pair.in_cloud(Release::Kilted)?);
    cloud.node("recorder")?;
    let before = usage(&pair)?;
    let subscription = cloud.subscription("recorder", "/again", KIND, DEEP)?;
    let mut sent = Vec::new();
    for seed in 0..rounds as u64 {
        robot.node("driver")?;
        let publisher = robot.publisher("driver", "/again", KIND, DEEP)?;
        publisher.wait_matched(1, MEET).with_context(|| pair.state("/again"))?;
        sent.extend(publisher.publish_all(Stream { count: 3, size: 50, hz: 0.0, seed })?);
        let received = subscription.received(sent.len(), ARRIVE);
        received.with_context(|| format!("round {seed}\n{}", pair.state("/again")))?;
        if kills && seed % 5 == 4 {
            robot = pair.on_robot(Release::Jazzy)?;
        } else {
            robot.end_node("driver")?;
        }
    }
    assert_eq!(subscription.log()?, sent);
    cloud.end_node("recorder")?;
    settle(&pair, &before, 0)
}

/// Subscriptions to ten topics of the robot that come and go.
pub(super) fn subscribe(rounds: usize) -> anyhow::Result<()> {
    const TOPICS: usize = 10;
    let pair = Pair::start()?;
    let (robot, cloud) = (pair.on_robot(Release::Jazzy)?, pair.in_cloud(Release::Kilted)?);
    robot.node("driver")?;
    let publishers = (0..TOPICS)
        .map(|number| robot.publisher("driver", &format!("/often/t{number}"), KIND, DEEP));
    let publishers = publishers.collect::<anyhow::Result<Vec<_>>>()?;
    let before = usage(&pair)?;
    for round in 0..rounds {
        let topic = format!("/often/t{}", round % TOPICS);
        let subscription = cloud.subscription(NODE, &topic, KIND, DEEP)?;
        // Some are met by the publisher, others end before.
        if round % 7 == 0 {
            let publisher = &publishers[round % TOPICS];
            pair.wait_route(&topic, publisher, &subscription)?;
            let sent = publisher.publish_all(Stream { count: 1, size: 50, hz: 0.0, seed: 1 })?;
            assert_eq!(subscription.received(1, ARRIVE)?, sent, "{topic}");
        }
        subscription.destroy()?;
    }
    let routes = || pair.edge.bridges_up().len() + pair.cloud.bridges_up().len();
    wait::until("no route is left", MEET, || routes() == 0, || pair.state("/often/t0"))?;
    for publisher in &publishers {
        publisher.wait_matched(0, MEET)?;
    }
    robot.end_node("driver")?;
    settle(&pair, &before, 0)
}

/// Many nodes at once, each with a participant and a topic of its own, and one for all.
pub(super) fn crowd(nodes: usize) -> anyhow::Result<()> {
    let pair = Pair::start()?;
    let (robot, cloud) = (pair.on_robot(Release::Kilted)?, pair.in_cloud(Release::Jazzy)?);
    cloud.node("recorder")?;
    let before = usage(&pair)?;
    let shared = cloud.subscription("recorder", "/crowd", KIND, DEEP)?;
    let (mut own, mut publishers) = (Vec::new(), Vec::new());
    for number in 0..nodes {
        let (node, topic) = (format!("driver_{number}"), format!("/crowd/t{number}"));
        robot.node(&node)?;
        own.push(cloud.subscription("recorder", &topic, KIND, DEEP)?);
        publishers.push((
            robot.publisher(&node, &topic, KIND, DEEP)?,
            robot.publisher(&node, "/crowd", KIND, DEEP)?,
        ));
    }
    let mut all = Vec::new();
    for ((number, (publisher, common)), own) in (0..).zip(&publishers).zip(&own) {
        let topic = format!("/crowd/t{number}");
        pair.wait_route(&topic, publisher, own)?;
        pair.wait_route("/crowd", common, &shared)?;
        let stream = Stream { count: 3, size: 50, hz: 0.0, seed: number };
        let sent = publisher.publish_all(stream)?;
        assert_eq!(own.received(sent.len(), ARRIVE)?, sent, "{topic}");
        all.extend(common.publish_all(stream)?);
        let received = shared.received(all.len(), ARRIVE);
        assert_eq!(received.with_context(|| pair.state("/crowd"))?, all, "{topic}");
    }
    for number in 0..nodes {
        robot.end_node(&format!("driver_{number}"))?;
    }
    cloud.end_node("recorder")?;
    settle(&pair, &before, 0)
}

#[test]
fn a_node_that_restarts_is_one_source() -> anyhow::Result<()> {
    restart(5, false)
}

#[test]
fn subscriptions_that_come_and_go_leave_nothing() -> anyhow::Result<()> {
    subscribe(70)
}

#[test]
fn thirteen_nodes_at_once_are_all_bridged() -> anyhow::Result<()> {
    crowd(13)
}
