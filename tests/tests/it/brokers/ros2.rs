//! The adapter of ROS 2, with participants on RustDDS in the place of nodes.

use std::net::Ipv4Addr;
use std::time::Duration;

use blaze_brokers::dds::{Cdr, EndpointId, Participant, ParticipantConfig, Profile, Writer, Written};
use blaze_brokers::ros2::{GidLength, Network, Ros2Broker, Ros2Config};
use blaze_brokers::{
    Broker, Content, Health, PublisherOptions, Received, SubscribeOptions, Subscription,
};
use blaze_domain::{Origin, WriterId};
use blaze_proto::{Frame, Header};
use blaze_tests::flow::free_domain;
use rustdds::WriteOptionsBuilder;

use super::support::{DEADLINE, WITH_KEPT, eventually, wait_for};

/// The type of all topics: a message of one byte.
const TYPE: &str = "std_msgs::msg::dds_::UInt8_";
const ENCODING: &str = "application/cdr; type=std_msgs/msg/UInt8";

const RELIABLE: PublisherOptions = PublisherOptions { depth: 0, reliable: true, large: false };

fn reliable(depth: u16) -> Profile {
    Profile { reliable: true, window: 4096, ..Profile::best_effort(depth) }
}

fn keeping(depth: u16) -> Profile {
    Profile { transient_local: true, ..reliable(depth) }
}

fn cdr(number: u8) -> Vec<u8> {
    vec![0, 1, 0, 0, number]
}

/// A flow's adapter in a domain of its own.
struct Net {
    domain: u16,
    broker: Ros2Broker,
}

impl Net {
    async fn start() -> Self {
        let domain = free_domain().unwrap();
        let broker = Ros2Broker::open(Ros2Config {
            flow: "edge/robot-1".parse().unwrap(),
            domain,
            interface: Ipv4Addr::LOCALHOST,
            namespace: String::new(),
            peers: Vec::new(),
            gid: GidLength::Short,
        })
        .unwrap();
        wait_for(&broker, Health::Up).await;
        Self { domain, broker }
    }

    fn node(&self) -> Participant {
        Participant::start(ParticipantConfig::new(self.domain, Ipv4Addr::LOCALHOST)).unwrap()
    }

    /// Waits until the network is as wanted.
    async fn network(&self, what: &str, is_so: impl Fn(&Network) -> bool) {
        let mut network = self.broker.network();
        let waited = tokio::time::timeout(DEADLINE, network.wait_for(|network| is_so(network)));
        assert!(waited.await.is_ok(), "{what}: {:?}", self.broker.network().borrow());
    }

    /// Waits until writers are found, and takes their messages.
    async fn own(&self, writers: &[EndpointId]) {
        let has = |network: &Network, id| network.endpoints.iter().any(|it| it.id == id);
        self.network("found", |network| writers.iter().all(|id| has(network, *id))).await;
        self.broker.set_owned(writers.iter().map(|id| (*id, true)).collect());
    }

    async fn read(&self, topic: &str, options: SubscribeOptions) -> Subscription {
        self.broker.subscribe(&topic.parse().unwrap(), options).await.unwrap()
    }
}

fn put(writer: &Writer, number: u8) {
    let written = writer.write_cdr(Cdr::little(cdr(number).into()).unwrap(), WriteOptionsBuilder::new());
    assert!(matches!(written, Written::Taken(_)), "{written:?}");
}

fn frame(topic: &str, writer: u8, number: u8) -> Frame {
    let header = Header {
        encoding: ENCODING.to_owned(),
        ..Header::new(topic, Origin::default(), WriterId([writer; 16]), number.into(), 0)
    };
    Frame::new(&header, cdr(number).into()).unwrap()
}

fn number(received: &Received) -> u8 {
    match &received.content {
        Content::Frame(frame) => frame.payload()[4],
        other => panic!("{other:?}"),
    }
}

/// Reads until a message with this number came.
async fn until(subscription: &mut Subscription, last: u8) -> Vec<u8> {
    let mut found = Vec::new();
    let read = async {
        while found.last().map(number) != Some(last) {
            assert!(subscription.receive(&mut found, usize::MAX).await > 0);
        }
    };
    let waited = tokio::time::timeout(DEADLINE, read).await;
    let numbers = found.iter().map(number).collect();
    assert!(waited.is_ok(), "{last} has not come: {numbers:?}");
    numbers
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_the_flow_writes_leaves_room_for_samples_that_wait_for_an_owner() {
    let net = Net::start().await;
    let node = net.node();
    let writer = node.typed_writer(("rt/a", TYPE), reliable(16)).unwrap();
    let _reader = node.typed_reader(("rt/a", TYPE), reliable(64), Box::new(|_| true)).unwrap();
    let mut subscription = net.read("a", SubscribeOptions::default()).await;
    net.network("both", |network| network.endpoints.len() == 2).await;
    let publisher = net.broker.publisher(&"a".parse().unwrap(), RELIABLE).unwrap();
    eventually("matched", || writer.is_matched().then_some(())).await;
    tokio::time::sleep(Duration::from_millis(200)).await;
    put(&writer, 1);
    for _ in 0..3_000 {
        publisher.publish(&frame("a", 7, 9), None);
    }
    eventually("written", || (publisher.later().queued == 0).then_some(())).await;
    put(&writer, 2);
    tokio::time::sleep(Duration::from_millis(300)).await;
    net.own(&[writer.id()]).await;
    assert_eq!(until(&mut subscription, 2).await, [1, 2]);
    assert_eq!(subscription.take_dropped(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_kept_is_read_beside_other_writers_of_the_topic() {
    let net = Net::start().await;
    let node = net.node();
    let kept = node.typed_writer(("rt/map", TYPE), keeping(3)).unwrap();
    (1..=3).for_each(|number| put(&kept, number));
    net.own(&[kept.id()]).await;
    let mut subscription = net.read("map", WITH_KEPT).await;
    assert_eq!(until(&mut subscription, 3).await, [1, 2, 3]);
    // Writers that keep nothing come later; they are read, too.
    let reliable = node.typed_writer(("rt/map", TYPE), reliable(8)).unwrap();
    let best_effort = node.typed_writer(("rt/map", TYPE), Profile::best_effort(8)).unwrap();
    net.own(&[kept.id(), reliable.id(), best_effort.id()]).await;
    for (writer, number) in [(&reliable, 4), (&best_effort, 5), (&kept, 6)] {
        eventually("matched", || writer.is_matched().then_some(())).await;
        tokio::time::sleep(Duration::from_millis(200)).await;
        put(writer, number);
        assert_eq!(until(&mut subscription, number).await, [number]);
    }
    assert_eq!(subscription.take_dropped(), 0);
}
