//! A robot and a cloud with a flow each, on the ROS 2 networks of their hosts.

use std::time::Duration;

use blaze_tests::flow::{FlowProcess, FlowSpec};
use blaze_tests::network::{Host, Plan, Topology};
use blaze_tests::ros2::{End, Peer, Quality, Release, open_loopback};
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

/// Two hosts and the link between them; dropped in this order.
pub(super) struct Pair {
    pub(super) edge: FlowProcess,
    pub(super) cloud: FlowProcess,
    network: Topology,
}

impl Pair {
    /// Both flows are ready, and have met.
    pub(super) fn start() -> anyhow::Result<Self> {
        let network = Topology::build(&Plan::two_hosts("robot", "cloud", Shape::to_cloud()))?;
        let (robot, cloud) = (network.host("robot")?, network.host("cloud")?);
        for host in [robot, cloud] {
            open_loopback(host)?;
        }
        let flow = |layer, node, host: &Host, peers: &[_]| {
            let spec = FlowSpec::new(layer, node).on_ros2(DOMAIN).joined(LINK_DOMAIN);
            FlowProcess::launch(spec.inside(host, peers))
        };
        let mut edge = flow("edge", "robot-1", robot, &[cloud.address])?;
        let mut cloud = flow("cloud", "cloud-1", cloud, &[])?;
        edge.wait_ready()?;
        cloud.wait_ready()?;
        Ok(Self { edge, cloud, network })
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
        let topic = topic.trim_start_matches('/');
        let of = |flow: &FlowProcess| {
            let why =
                flow.why(topic, None).map_or_else(|error| error.to_string(), |why| why.to_string());
            format!("{}: {:?} {why}\n{}", flow.spec.layer, flow.bridges_up(), flow.tail())
        };
        format!("{}\n{}", of(&self.edge), of(&self.cloud))
    }
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
