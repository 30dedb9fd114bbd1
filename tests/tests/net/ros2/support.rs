//! A robot and a cloud with a flow each, on the ROS 2 networks of their hosts or other brokers.

use std::time::Duration;

use blaze_tests::flow::{FlowProcess, FlowSpec};
use blaze_tests::network::{Host, Plan, Topology, inside};
use blaze_tests::ros2::{End, Peer, Quality, Release, open_loopback};
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer};
use blaze_tests::wait;
use blaze_tests::wan::Shape;

/// `ROS_DOMAIN_ID` of both networks, which know nothing of each other.
pub(super) const DOMAIN: u16 = 7;
/// Domain of the link, within the namespaces.
pub(super) const LINK_DOMAIN: u16 = 50;
/// For endpoints to meet, on a busy machine.
pub(super) const MEET: Duration = Duration::from_secs(20);
/// For messages to arrive, on a busy machine.
pub(super) const ARRIVE: Duration = Duration::from_secs(30);
/// The node that each peer has.
pub(super) const NODE: &str = "peer";
/// Room for all messages at the listener, should it get no processor for a while.
pub(super) const DEEP: Quality = Quality {
    reliable: true,
    durable: false,
    depth: 1_000,
    deadline_ms: 0,
    lease_ms: 0,
    lifespan_ms: 0,
};

/// A Redis on a host.
pub(super) fn redis(host: &Host) -> anyhow::Result<RedisServer> {
    let options = RedisOptions { host: Some(host.clone()), ..RedisOptions::default() };
    RedisServer::start(RedisKind::Redis, options)
}

/// Two hosts, their brokers beside ROS 2, and the link between them; dropped in this order.
pub(super) struct Pair<B = ()> {
    pub(super) edge: FlowProcess,
    pub(super) cloud: FlowProcess,
    pub(super) brokers: B,
    pub(super) network: Topology,
}

impl Pair {
    /// Both flows are on ROS 2.
    pub(super) fn start() -> anyhow::Result<Self> {
        Self::on(|_, _| Ok(()), |(), edge, cloud| [edge.on_ros2(DOMAIN), cloud.on_ros2(DOMAIN)])
    }
}

impl<B> Pair<B> {
    /// Starts brokers on both hosts, and lets both flows use them. The flows are ready, and have
    /// met.
    pub(super) fn on(
        brokers: impl FnOnce(&Host, &Host) -> anyhow::Result<B>,
        flows: impl FnOnce(&B, FlowSpec, FlowSpec) -> [FlowSpec; 2],
    ) -> anyhow::Result<Self> {
        let network = Topology::build(&Plan::two_hosts("robot", "cloud", Shape::to_cloud()))?;
        let (robot, cloud) = (network.host("robot")?, network.host("cloud")?);
        for host in [robot, cloud] {
            open_loopback(host)?;
        }
        let brokers = brokers(robot, cloud)?;
        let spec = |layer, node| FlowSpec::new(layer, node).joined(LINK_DOMAIN);
        let [edge, there] = flows(&brokers, spec("edge", "robot-1"), spec("cloud", "cloud-1"));
        let mut edge = FlowProcess::launch(edge.inside(robot, &[cloud.address]))?;
        let mut cloud = FlowProcess::launch(there.inside(cloud, &[]))?;
        edge.wait_ready()?;
        cloud.wait_ready()?;
        Ok(Self { edge, cloud, brokers, network })
    }

    /// Does something on a host.
    pub(super) fn inside<T: Send>(
        &self,
        host: &str,
        act: impl FnOnce() -> anyhow::Result<T> + Send,
    ) -> anyhow::Result<T> {
        inside(&self.network.host(host)?.namespace, act)
    }

    /// A peer with a node beside the flow of the edge.
    pub(super) fn on_robot(&self, release: Release) -> anyhow::Result<Peer> {
        self.peer("robot", release)
    }

    /// A peer with a node beside the flow of the cloud.
    pub(super) fn in_cloud(&self, release: Release) -> anyhow::Result<Peer> {
        self.peer("cloud", release)
    }

    fn peer(&self, host: &str, release: Release) -> anyhow::Result<Peer> {
        let peer = Peer::start(release, self.network.host(host)?, DOMAIN)?;
        peer.node(NODE)?;
        Ok(peer)
    }

    /// Waits until messages of a topic get from one network to the other.
    pub(super) fn wait_route(
        &self,
        topic: &str,
        publisher: &End<'_>,
        subscription: &End<'_>,
    ) -> anyhow::Result<()> {
        let flowing = || {
            [&self.edge, &self.cloud].into_iter().all(|flow| {
                let start = format!("{}|", topic.trim_start_matches('/'));
                flow.bridges_up().iter().any(|id| id.starts_with(&start))
            }) && [publisher, subscription]
                .into_iter()
                .all(|end| end.matched().is_ok_and(|n| n > 0))
        };
        wait::until(&format!("{topic} flows"), MEET, flowing, || self.state(topic))?;
        Ok(())
    }

    /// What both flows say of a topic.
    pub(super) fn state(&self, topic: &str) -> String {
        format!("{}\n{}", state(&self.edge, topic), state(&self.cloud, topic))
    }
}

/// What a flow says of a topic.
pub(super) fn state(flow: &FlowProcess, topic: &str) -> String {
    let why = flow.why(topic.trim_start_matches('/'), None);
    let why = why.map_or_else(|error| error.to_string(), |why| why.to_string());
    format!("{}: {:?} {why}\n{}", flow.spec.layer, flow.bridges_up(), flow.tail())
}

/// A publisher and a subscription of one topic, with a quality for both.
pub(super) fn ends<'a>(
    from: &'a Peer,
    to: &'a Peer,
    topic: &str,
    kind: &str,
    quality: Quality,
) -> anyhow::Result<(End<'a>, End<'a>)> {
    Ok((from.publisher(NODE, topic, kind, quality)?, to.subscription(NODE, topic, kind, quality)?))
}
