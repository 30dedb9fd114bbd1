//! The peers without a flow: what they exchange among themselves.

use std::time::Duration;

use blaze_tests::network::{Plan, Topology};
use blaze_tests::ros2::{Peer, Quality, Release, Stream, open_loopback};
use blaze_tests::wan::Shape;

const MEET: Duration = Duration::from_secs(20);
const ARRIVE: Duration = Duration::from_secs(20);

#[test]
fn peers_of_all_releases_exchange_messages() -> anyhow::Result<()> {
    const DOMAIN: u16 = 7;
    let topics =
        [("/text", "std_msgs/msg/String", 100), ("/image", "sensor_msgs/msg/Image", 1_000_000)];
    // Nobody is at the other end of the link.
    let network = Topology::build(&Plan::two_hosts("robot", "nobody", Shape::default()))?;
    let host = network.host("robot")?;
    open_loopback(host)?;
    let peers: Vec<Peer> = Release::ALL
        .iter()
        .map(|release| Peer::start_untyped(*release, host, DOMAIN))
        .collect::<anyhow::Result<_>>()?;
    // Without it Cyclone passes over the first sample of Fast DDS, if that comes in fragments.
    let quality = Quality { durable: true, ..Quality::default() };
    for peer in &peers {
        peer.node("peer")?;
    }
    for (topic, kind, size) in topics {
        for from in &peers {
            let topic = format!("{topic}_of_{:?}", from.release);
            let publisher = from.publisher("peer", &topic, kind, quality)?;
            let subscriptions =
                peers.iter().map(|to| to.subscription("peer", &topic, kind, quality));
            let subscriptions = subscriptions.collect::<anyhow::Result<Vec<_>>>()?;
            publisher.wait_matched(peers.len() as u64, MEET)?;
            for subscription in &subscriptions {
                subscription.wait_matched(1, MEET)?;
            }
            let sent = publisher.publish_all(Stream { count: 5, size, hz: 10.0, seed: 1 })?;
            for (to, subscription) in peers.iter().zip(&subscriptions) {
                let received = subscription.received(sent.len(), ARRIVE)?;
                assert_eq!(received, sent, "{topic} at {:?}", to.release);
            }
        }
    }
    peers.into_iter().try_for_each(Peer::finish)
}
