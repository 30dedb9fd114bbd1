//! Two robots on one switch: their flows see one ROS 2 network and share its work. And a cloud that
//! is on it by mistake.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_tests::flow::{FlowProcess, FlowSpec};
use blaze_tests::network::{Plan, Topology};
use blaze_tests::ros2::{End, Message, Peer, Quality, Release, Stream, open_loopback, open_switch};
use blaze_tests::wan::Shape;
use blaze_tests::{wait, within};

use super::support::{ARRIVE, DOMAIN, LINK_DOMAIN, MEET, NODE};

const KIND: &str = "std_msgs/msg/String";
const ROBOTS: [&str; 2] = ["robot-1", "robot-2"];
const DEEP: Quality = Quality { depth: 10_000, ..super::support::DEEP };
/// For the flow of one robot to take over what that of the other one carried.
const TAKES_OVER: Duration = Duration::from_secs(5);

/// Dropped in this order.
struct Site {
    robots: Vec<FlowProcess>,
    cloud: FlowProcess,
    network: Topology,
}

impl Site {
    /// All flows are ready.
    fn start() -> anyhow::Result<Self> {
        let network = Topology::build(
            &Plan::new().with_hosts(&["robot-1", "robot-2", "cloud"]).with_lan(&ROBOTS).with_link(
                "robot-1",
                "cloud",
                Shape::to_cloud(),
            ),
        )?;
        let cloud = network.host("cloud")?;
        open_loopback(cloud)?;
        let mut robots = Vec::new();
        for name in ROBOTS {
            let host = network.host(name)?;
            open_switch(host)?;
            let spec = FlowSpec::new("edge", name).on_ros2_of(host, DOMAIN).joined(LINK_DOMAIN);
            robots.push(FlowProcess::launch(spec.inside(host, &[cloud.address]))?);
        }
        let spec = FlowSpec::new("cloud", "cloud-1").on_ros2(DOMAIN).joined(LINK_DOMAIN);
        let mut cloud = FlowProcess::launch(spec.inside(cloud, &[]))?;
        for flow in robots.iter_mut().chain([&mut cloud]) {
            flow.wait_ready()?;
        }
        Ok(Self { robots, cloud, network })
    }

    fn on_robot(&self, robot: usize, release: Release) -> anyhow::Result<Peer> {
        let peer = Peer::start_on_switch(release, self.network.host(ROBOTS[robot])?, DOMAIN)?;
        peer.node(NODE)?;
        Ok(peer)
    }

    fn in_cloud(&self, release: Release) -> anyhow::Result<Peer> {
        let peer = Peer::start(release, self.network.host("cloud")?, DOMAIN)?;
        peer.node(NODE)?;
        Ok(peer)
    }

    /// What all flows say of a topic.
    fn state(&self, topic: &str) -> String {
        let of = |flow: &FlowProcess| {
            let why = flow.why(topic, None).unwrap_or_default();
            format!("{}: {:?} {why}\n{}\n", flow.spec.node, flow.bridges(), flow.tail())
        };
        self.robots.iter().chain([&self.cloud]).map(of).collect()
    }
}

/// Publishes until a message arrives: all ends have met then.
fn meet(from: &End<'_>, to: &[&End<'_>], state: &dyn Fn() -> String) -> anyhow::Result<()> {
    /// No two messages are equal.
    static SEED: AtomicU64 = AtomicU64::new(1_000);
    let mut all = Vec::new();
    let arrives = || {
        let seed = SEED.fetch_add(1, Ordering::Relaxed);
        let stream = Stream { count: 1, size: 50, hz: 0.0, seed };
        all.extend(from.publish_all(stream).unwrap_or_default());
        let reached = |end: &&End<'_>| {
            end.log().is_ok_and(|log| all.iter().any(|message| log.contains(message)))
        };
        to.iter().all(reached)
    };
    wait::until("a message arrives everywhere", MEET, arrives, state)?;
    Ok(())
}

/// Waits until all of these have arrived, and checks that no message at all has come twice.
fn each_once(end: &End<'_>, sent: &[Message], state: &dyn Fn() -> String) -> anyhow::Result<()> {
    let counts = || {
        let mut counts: HashMap<Message, usize> = HashMap::new();
        for message in end.log().unwrap_or_default() {
            *counts.entry(message).or_default() += 1;
        }
        counts
    };
    let missing = || {
        let counts = counts();
        sent.iter().filter(|message| !counts.contains_key(message)).count()
    };
    wait::until(
        "all messages arrive",
        ARRIVE,
        || missing() == 0,
        || format!("{} of {} are missing\n{}", missing(), sent.len(), state()),
    )?;
    let twice = counts().into_values().filter(|count| *count > 1).count();
    anyhow::ensure!(twice == 0, "{twice} messages came twice\n{}", state());
    Ok(())
}

#[test]
fn two_flows_of_one_network_carry_each_writer_once() -> anyhow::Result<()> {
    let site = Site::start()?;
    let state = || site.state("text");
    let (first, second) = (site.on_robot(0, Release::Jazzy)?, site.on_robot(1, Release::Kilted)?);
    let cloud = site.in_cloud(Release::Jazzy)?;
    let publishers = [&first, &second].map(|peer| peer.publisher(NODE, "/text", KIND, DEEP));
    let publishers = publishers.into_iter().collect::<anyhow::Result<Vec<_>>>()?;
    let native = second.subscription(NODE, "/text", KIND, DEEP)?;
    let remote = cloud.subscription(NODE, "/text", KIND, DEEP)?;
    let mut sent = Vec::new();
    for publisher in &publishers {
        meet(publisher, &[&native, &remote], &state)?;
    }
    for (seed, publisher) in (0..).zip(&publishers) {
        sent.extend(publisher.publish_all(Stream { count: 50, size: 50, hz: 200.0, seed })?);
    }
    for end in [&native, &remote] {
        each_once(end, &sent, &state)?;
    }
    // Each flow carries the writer of its own host, to the cloud alone.
    for (flow, publisher) in site.robots.iter().zip(&publishers) {
        assert_eq!(flow.bridges_up(), ["text|ros2>inter|cloud"], "{}", state());
        let published = publisher.log()?.len() as u64;
        // Counters are read now and then.
        let carries = || (50..=published).contains(&flow.delivered());
        let what = format!("at most {published} messages are carried");
        wait::until(&what, MEET, carries, state)?;
        let why = flow.why("text", Some("edge"))?;
        assert_eq!((&why["verdict"], &why["code"]), (&"flowing".into(), &"native_path".into()));
        let why = flow.why("text", Some("cloud"))?;
        assert_eq!((&why["verdict"], &why["code"]), (&"flowing".into(), &"ok".into()), "{why}");
    }
    let arrived = remote.log()?.len() as u64;
    let counts = || site.cloud.delivered() == arrived;
    wait::until(&format!("{arrived} messages are counted in the cloud"), MEET, counts, state)?;
    // The other way round one of them writes for both hosts.
    let commands = cloud.publisher(NODE, "/commands", KIND, DEEP)?;
    let heard = [&first, &second].map(|peer| peer.subscription(NODE, "/commands", KIND, DEEP));
    let heard = heard.into_iter().collect::<anyhow::Result<Vec<_>>>()?;
    let state = || site.state("commands");
    meet(&commands, &heard.iter().collect::<Vec<_>>(), &state)?;
    let sent = commands.publish_all(Stream { count: 50, size: 50, hz: 200.0, seed: 2 })?;
    for end in &heard {
        each_once(end, &sent, &state)?;
    }
    Ok(())
}

#[test]
fn a_flow_that_is_killed_is_replaced_by_the_other_one() -> anyhow::Result<()> {
    let mut site = Site::start()?;
    let (robot, cloud) = (site.on_robot(0, Release::Jazzy)?, site.in_cloud(Release::Kilted)?);
    let publisher = robot.publisher(NODE, "/text", KIND, DEEP)?;
    let remote = cloud.subscription(NODE, "/text", KIND, DEEP)?;
    meet(&publisher, &[&remote], &|| site.state("text"))?;
    publisher.publish(Stream { count: 2_000, size: 50, hz: 100.0, seed: 1 })?;
    let more = |site: &Site, what: &str| {
        let before = remote.log()?.len();
        let grows = || remote.log().is_ok_and(|log| log.len() > before + 5);
        wait::until(what, ARRIVE, grows, || {
            let on_other = site.robots[1].why("text", None).unwrap_or_default();
            format!("{on_other}\n{}\n{}", site.robots[1].tail(), site.cloud.tail())
        })
    };
    more(&site, "messages arrive")?;
    assert!(site.robots[1].bridges_up().is_empty(), "{}", site.state("text"));
    site.robots[0].kill()?;
    let killed = Instant::now();
    // What is on the way still arrives.
    let carries = || site.robots[1].bridges_up() == ["text|ros2>inter|cloud"];
    let tail = || site.robots[1].tail();
    wait::until("the other flow has a bridge", within(TAKES_OVER), carries, tail)?;
    more(&site, "messages arrive again")?;
    let took = killed.elapsed();
    println!("messages of the robot whose flow was killed flow again after {took:?}");
    assert!(took <= within(TAKES_OVER), "{took:?}");
    // It comes back, and takes its writer again.
    site.robots[0].relaunch()?;
    site.robots[0].wait_ready()?;
    let owns = || site.robots[1].bridges_up().is_empty() && !site.robots[0].bridges_up().is_empty();
    wait::until("the flow has its writer again", ARRIVE, owns, || site.state("text"))?;
    more(&site, "messages arrive still")?;
    let log = remote.log()?;
    let mut unique = log.clone();
    unique.sort_by(|a, b| a.1.cmp(&b.1));
    unique.dedup();
    assert_eq!(unique.len(), log.len(), "messages came twice\n{}", site.state("text"));
    Ok(())
}

#[test]
fn a_cloud_on_the_network_of_the_robot_leaves_it_alone() -> anyhow::Result<()> {
    let network = Topology::build(
        &Plan::new().with_hosts(&["robot", "cloud"]).with_lan(&["robot", "cloud"]),
    )?;
    let (robot, cloud) = (network.host("robot")?, network.host("cloud")?);
    let flow = |layer: &str, node: &str, host, peers: &[_]| {
        open_switch(host)?;
        let spec = FlowSpec::new(layer, node).on_ros2_of(host, DOMAIN).joined(LINK_DOMAIN);
        FlowProcess::launch(spec.inside(host, peers))
    };
    let mut edge = flow("edge", "robot-1", robot, &[])?;
    edge.wait_ready()?;
    let from = Peer::start_on_switch(Release::Jazzy, robot, DOMAIN)?;
    let to = Peer::start_on_switch(Release::Kilted, cloud, DOMAIN)?;
    for peer in [&from, &to] {
        peer.node(NODE)?;
    }
    let publisher = from.publisher(NODE, "/text", KIND, DEEP)?;
    let native = to.subscription(NODE, "/text", KIND, DEEP)?;
    let state = || edge.tail();
    meet(&publisher, &[&native], &state)?;
    // From before the second flow comes until it knows better.
    let before = publisher.log()?.len();
    publisher.publish(Stream { count: 500, size: 50, hz: 100.0, seed: 1 })?;
    let mut second = flow("cloud", "cloud-1", cloud, &[robot.address])?;
    let admin = second.listening()?;
    let answer = || admin.json("/v1/ros2").unwrap_or_default();
    let ready = || admin.get("/readyz").unwrap_or_default();
    let left = || {
        let (status, checks) = ready();
        answer()["state"] == "in_use" && status == 503 && checks.contains("scope_in_use")
    };
    wait::until("the second flow has left the network", ARRIVE, left, || {
        format!("{}\n{:?}\n{}", answer(), ready(), second.tail())
    })?;
    let detail = answer()["detail"].as_str().context("no detail")?.to_owned();
    assert!(detail.contains("scope_in_use") && detail.contains("edge/robot-1"), "{detail}");
    let all = || publisher.log().is_ok_and(|log| log.len() == before + 500);
    wait::until("all is published", ARRIVE, all, state)?;
    each_once(&native, &publisher.log()?[before..], &state)?;
    assert_eq!((edge.bridges_up(), second.bridges_up()), (vec![], vec![]));
    Ok(())
}
