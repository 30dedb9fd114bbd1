//! The adapter of ROS 2, with participants on RustDDS in the place of nodes.

use std::net::Ipv4Addr;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use blaze_brokers::dds::{
    Cdr, EndpointId, Participant, ParticipantConfig, Profile, Reader, Sample, TimingQos, Writer,
    Written,
};
use blaze_brokers::ros2::{GidLength, Network, Ros2Broker, Ros2Config, Shown};
use blaze_brokers::{
    Broker, Content, Health, PublisherOptions, Received, SubscribeOptions, Subscription,
};
use blaze_domain::{Origin, TopicName, WriterId};
use blaze_proto::{Frame, Header};
use blaze_tests::flow::free_domain;
use parking_lot::Mutex;
use rustdds::{SampleIdentity, Timestamp, WriteOptionsBuilder};

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
    let written = write(writer, number);
    assert!(matches!(written, Written::Taken(_)), "{written:?}");
}

fn write(writer: &Writer, number: u8) -> Written {
    writer.write_cdr(Cdr::little(cdr(number).into()).unwrap(), WriteOptionsBuilder::new())
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

/// What writers write until a reader gets it: it may know its writer later than that knows it.
const GREETING: u8 = 0;

/// Waits until a subscription gets what is written.
async fn meet(writer: &Writer, subscription: &mut Subscription) {
    let meet = async {
        let (mut found, pause) = (Vec::new(), Duration::from_millis(50));
        while found.is_empty() {
            // Without a reader, or with a full window, it is tried again.
            write(writer, GREETING);
            let received = subscription.receive(&mut found, usize::MAX);
            let _ = tokio::time::timeout(pause, received).await;
        }
    };
    assert!(tokio::time::timeout(DEADLINE, meet).await.is_ok(), "they have not met");
    eventually("acknowledged", || writer.is_acknowledged().then_some(())).await;
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
    let numbers = found.iter().map(number).filter(|number| *number != GREETING).collect();
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
    let waits = || (net.broker.counts().undecided_bytes > 0).then_some(());
    eventually("a sample waits", || {
        write(&writer, GREETING);
        waits()
    })
    .await;
    eventually("acknowledged", || writer.is_acknowledged().then_some(())).await;
    put(&writer, 1);
    for _ in 0..3_000 {
        publisher.publish(&frame("a", 7, 9), None);
    }
    eventually("written", || (publisher.later().queued == 0).then_some(())).await;
    put(&writer, 2);
    eventually("acknowledged", || writer.is_acknowledged().then_some(())).await;
    net.own(&[writer.id()]).await;
    assert_eq!(until(&mut subscription, 2).await, [1, 2]);
    assert_eq!(subscription.take_dropped(), 0);
}

/// More than may be under way at once.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_topic_that_the_flow_reads_itself_is_written_without_end() {
    let net = Net::start().await;
    let node = net.node();
    let writer = node.typed_writer(("rt/a", TYPE), reliable(16)).unwrap();
    let guest = net.node();
    let reads = Reads::start(&guest, "rt/a", reliable(256));
    net.own(&[writer.id()]).await;
    let mut subscription = net.read("a", SubscribeOptions::default()).await;
    meet(&writer, &mut subscription).await;
    net.network("both", |network| network.endpoints.len() == 2).await;
    let large = PublisherOptions { large: true, ..RELIABLE };
    let publisher = net.broker.publisher(&"a".parse().unwrap(), large).unwrap();
    for number in 1..=200 {
        publisher.publish(&frame("a", 7, number), None);
        eventually("written", || (publisher.later().queued == 0).then_some(())).await;
    }
    reads.until(200).await;
    assert_eq!(net.broker.counts().expelled, 0);
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
        meet(writer, &mut subscription).await;
        put(writer, number);
        assert_eq!(until(&mut subscription, number).await, [number]);
    }
    assert_eq!(subscription.take_dropped(), 0);
}

/// A reader on a node: all that came, by number.
struct Reads {
    found: Arc<Mutex<Vec<u8>>>,
    _reader: Reader,
}

impl Reads {
    fn start(node: &Participant, topic: &str, profile: Profile) -> Self {
        let found = Arc::<Mutex<Vec<u8>>>::default();
        let sink = Arc::clone(&found);
        let reader = node.typed_reader(
            (topic, TYPE),
            profile,
            Box::new(move |sample| {
                sink.lock().push(sample.sample.body()[0]);
                true
            }),
        );
        Self { found, _reader: reader.unwrap() }
    }

    async fn until(&self, last: u8) -> Vec<u8> {
        let found = || Some(self.found.lock().clone()).filter(|it| it.contains(&last));
        eventually("read", found).await
    }
}

fn with_timing(profile: Profile, deadline_s: Option<u64>, manual: bool) -> Profile {
    let deadline = deadline_s.map(Duration::from_secs);
    Profile { timing: TimingQos { deadline, manual, ..TimingQos::default() }, ..profile }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_message_comes_once_while_readers_with_other_demands_come_and_go() {
    let net = Net::start().await;
    // All readers of a participant share what it received.
    let (node, guest) = (net.node(), net.node());
    let steady = Reads::start(&node, "rt/a", reliable(256));
    net.network("the reader", |network| network.endpoints.len() == 1).await;
    let publisher = net.broker.publisher(&"a".parse().unwrap(), RELIABLE).unwrap();
    let mut other = None;
    for number in 1..=250 {
        // Twice others come, and go after a while.
        match number {
            20 | 130 => {
                let profile = with_timing(reliable(256), Some(10), number == 130);
                other = Some(Reads::start(&guest, "rt/a", profile));
            }
            90 | 200 => drop(other.take()),
            _ => {}
        }
        publisher.publish(&frame("a", 7, number), None);
        let later = publisher.later();
        assert_eq!(later.dropped(), 0);
        tokio::time::sleep(Duration::from_millis(10)).await;
        if number == 85 || number == 195 {
            let other = other.as_ref().unwrap();
            let last = *other.until(number).await.last().unwrap();
            assert_eq!(last, number, "it is served");
        }
    }
    assert_eq!(steady.until(250).await, (1..=250).collect::<Vec<u8>>());
    eventually("all is written", || (publisher.later().queued == 0).then_some(())).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_was_published_for_late_joiners_survives_other_writers() {
    let net = Net::start().await;
    let (node, guest) = (net.node(), net.node());
    let options = PublisherOptions { depth: 2, ..RELIABLE };
    let publisher = net.broker.publisher(&"map".parse().unwrap(), options).unwrap();
    let early = Reads::start(&node, "rt/map", keeping(16));
    for (writer, number) in [(1, 1), (1, 2), (2, 3), (1, 4)] {
        publisher.publish(&frame("map", writer, number), None);
    }
    let mut found = early.until(4).await;
    found.sort_unstable();
    assert!(found.ends_with(&[2, 3, 4]), "{found:?}");
    let late = Reads::start(&guest, "rt/map", with_timing(keeping(16), Some(10), false));
    eventually("what was kept", || {
        let mut found = late.found.lock().clone();
        found.sort_unstable();
        (found == [2, 3, 4]).then_some(())
    })
    .await;
    publisher.publish(&frame("map", 1, 5), None);
    assert_eq!(late.until(5).await.len(), 4);
    let news = early.until(5).await.iter().filter(|number| **number == 5).count();
    assert_eq!(news, 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_reader_that_asks_for_more_than_is_published_is_served() {
    let net = Net::start().await;
    let (node, guest) = (net.node(), net.node());
    let publisher =
        net.broker.publisher(&"a".parse().unwrap(), PublisherOptions::default()).unwrap();
    let readers = [
        Reads::start(&node, "rt/a", keeping(16)),
        Reads::start(&guest, "rt/a", with_timing(Profile::best_effort(16), None, true)),
    ];
    net.network("the readers", |network| network.endpoints.len() == 2).await;
    let until = Instant::now() + DEADLINE;
    while !readers.iter().all(|reads| reads.found.lock().contains(&1)) {
        assert!(Instant::now() < until, "{:?}", readers.map(|it| it.found.lock().clone()));
        publisher.publish(&frame("a", 1, 1), None);
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_message_of_a_writer_that_leaves_at_once_is_read() {
    let net = Net::start().await;
    let mut subscription = net.read("a", SubscribeOptions::default()).await;
    let steady = net.node();
    let other = steady.typed_writer(("rt/a", TYPE), reliable(8)).unwrap();
    net.own(&[other.id()]).await;
    eventually("matched", || other.is_matched().then_some(())).await;
    let node = net.node();
    let reader = node.typed_reader(("rt/b", TYPE), reliable(8), Box::new(|_| true)).unwrap();
    net.network("its reader", |network| network.endpoints.iter().any(|it| !it.is_writer)).await;
    let writer = node.typed_writer(("rt/a", TYPE), reliable(8)).unwrap();
    let id = writer.id();
    eventually("matched", || writer.is_matched().then_some(())).await;
    put(&writer, 1);
    // RustDDS acknowledges before it is taken, and has lost what was not once its writer left.
    let has_come = || (net.broker.counts().undecided_bytes > 0).then_some(());
    eventually("it waits for a decision", has_come).await;
    drop((writer, reader, node));
    net.network("it has left", |network| network.endpoints.iter().all(|it| it.is_writer)).await;
    net.own(&[other.id(), id]).await;
    assert_eq!(until(&mut subscription, 1).await, [1]);
    assert_eq!(subscription.take_dropped(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_nobody_decides_about_counts_as_lost() {
    let net = Net::start().await;
    let mut subscription = net.read("a", SubscribeOptions::default()).await;
    let node = net.node();
    let [owned, nobodys] =
        [(); 2].map(|()| node.typed_writer(("rt/a", TYPE), reliable(8)).unwrap());
    net.own(&[owned.id()]).await;
    for writer in [&owned, &nobodys] {
        eventually("matched", || writer.is_matched().then_some(())).await;
    }
    tokio::time::sleep(Duration::from_millis(300)).await;
    put(&nobodys, 1);
    put(&nobodys, 2);
    let dropped = || Some(subscription.take_dropped()).filter(|dropped| *dropped > 0);
    assert_eq!(eventually("lost", dropped).await, 2);
    put(&owned, 3);
    assert_eq!(until(&mut subscription, 3).await, [3]);
}

/// Writes with a time of writing that lies so many seconds ahead, or behind.
fn put_at(writer: &Writer, number: u8, seconds_ahead: i32) {
    let ahead = rustdds::Duration::from_secs(seconds_ahead.abs());
    let now = Timestamp::now();
    let written = if seconds_ahead < 0 { now - ahead } else { now + ahead };
    let options = WriteOptionsBuilder::new().source_timestamp(written);
    let written = writer.write_cdr(Cdr::little(cdr(number).into()).unwrap(), options);
    assert!(matches!(written, Written::Taken(_)), "{written:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_writer_whose_clock_is_ahead_is_read_from_its_first_message() {
    let net = Net::start().await;
    let mut subscription = net.read("a", SubscribeOptions::default()).await;
    let node = net.node();
    let writer = node.typed_writer(("rt/a", TYPE), keeping(8)).unwrap();
    net.own(&[writer.id()]).await;
    eventually("matched", || writer.is_matched().then_some(())).await;
    tokio::time::sleep(Duration::from_millis(300)).await;
    for number in 1..=3 {
        put_at(&writer, number, 3_600);
    }
    assert_eq!(until(&mut subscription, 3).await, [1, 2, 3]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_age_of_what_is_kept_counts_once() {
    let net = Net::start().await;
    let node = net.node();
    let writer = node.typed_writer(("rt/a", TYPE), keeping(8)).unwrap();
    put_at(&writer, 1, -100);
    put_at(&writer, 2, -50);
    net.own(&[writer.id()]).await;
    let mut subscription = net.read("a", WITH_KEPT).await;
    let mut found = Vec::new();
    while found.len() < 2 {
        assert!(subscription.receive(&mut found, usize::MAX).await > 0);
    }
    let age_s = |received: &Received| match &received.content {
        Content::Frame(frame) => (frame.age_us() + received.broker_age_us) / 1_000_000,
        other => panic!("{other:?}"),
    };
    let ages: Vec<u64> = found.iter().map(age_s).collect();
    assert!((100..110).contains(&ages[0]) && (50..60).contains(&ages[1]), "{ages:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn types_of_one_topic_are_read_apart_and_no_gap_of_one_counts_for_another() {
    let net = Net::start().await;
    let node = net.node();
    let mut subscription = net.read("a", SubscribeOptions::default()).await;
    let types = [TYPE, "std_msgs::msg::dds_::Int8_"];
    let writers = types.map(|it| node.typed_writer(("rt/a", it), reliable(8)).unwrap());
    net.own(&writers.each_ref().map(Writer::id)).await;
    for writer in &writers {
        meet(writer, &mut subscription).await;
    }
    for (round, number) in [(0, 1), (1, 2), (0, 3)] {
        put(&writers[round], number);
        assert_eq!(until(&mut subscription, number).await, [number]);
    }
    // Another flow takes what comes next, and gives it back.
    let [first, second] = writers.each_ref().map(Writer::id);
    net.broker.set_owned([(first, false), (second, true)].into());
    (10..20).for_each(|number| put(&writers[0], number));
    eventually("acknowledged", || writers[0].is_acknowledged().then_some(())).await;
    tokio::time::sleep(Duration::from_millis(300)).await;
    net.broker.set_owned([(first, true), (second, true)].into());
    put(&writers[0], 20);
    assert_eq!(until(&mut subscription, 20).await, [20]);
    assert_eq!(subscription.take_dropped(), 0);
    drop(writers);
    net.network("no writers", |network| network.endpoints.is_empty()).await;
    // Readers of a type end some seconds after its last writer, and begin again with the next.
    tokio::time::sleep(Duration::from_secs(5)).await;
    let writer = node.typed_writer(("rt/a", TYPE), reliable(8)).unwrap();
    net.own(&[writer.id()]).await;
    meet(&writer, &mut subscription).await;
    put(&writer, 30);
    assert_eq!(until(&mut subscription, 30).await, [30]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_subscription_without_writers_ends_with_the_broker() {
    let net = Net::start().await;
    let [mut closed, mut dropped] = [net.read("a", SubscribeOptions::default()).await, {
        let other = Net::start().await;
        other.read("a", SubscribeOptions::default()).await
    }];
    net.broker.close().await;
    for subscription in [&mut closed, &mut dropped] {
        let mut none = Vec::new();
        let end = subscription.receive(&mut none, usize::MAX);
        assert_eq!(tokio::time::timeout(DEADLINE, end).await, Ok(0));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn requests_wait_until_their_replies_can_be_read() {
    const CLIENTS: u8 = 16;
    let net = Net::start().await;
    let node = net.node();
    // The server answers at once, and cannot before it has met a reader.
    let (answers, executed) = (Arc::<OnceLock<Writer>>::default(), Arc::<AtomicUsize>::default());
    let (writes, count) = (Arc::clone(&answers), Arc::clone(&executed));
    let serve = move |sample: Sample| {
        count.fetch_add(1, Ordering::Relaxed);
        let (writer_guid, sequence_number) = (sample.writer_guid, sample.sequence_number);
        let related = SampleIdentity { writer_guid, sequence_number };
        let options = WriteOptionsBuilder::new().related_sample_identity(related);
        let reply = sample.sample.payload().clone();
        writes.get().map(|writer| writer.write_cdr(Cdr::little(reply).unwrap(), options));
        true
    };
    let _server =
        node.typed_reader(("rq/addRequest", TYPE), reliable(64), Box::new(serve)).unwrap();
    net.network("the server", |network| network.endpoints.len() == 1).await;
    let requests = net.broker.publisher(&"add/_request".parse().unwrap(), RELIABLE).unwrap();
    for client in 1..=CLIENTS {
        requests.publish(&frame("add/_request", client, client), None);
    }
    // Its other half comes late, and so does the flow's.
    tokio::time::sleep(Duration::from_millis(500)).await;
    let writer = node.typed_writer(("rr/addReply", TYPE), reliable(64)).unwrap();
    net.own(&[writer.id()]).await;
    answers.set(writer).ok().unwrap();
    let mut subscription = net.read("add/_reply", SubscribeOptions::default()).await;
    let mut replies = Vec::new();
    let read = async {
        while replies.len() < CLIENTS.into() {
            assert!(subscription.receive(&mut replies, usize::MAX).await > 0);
        }
    };
    let waited = tokio::time::timeout(DEADLINE, read).await;
    let executed = executed.load(Ordering::Relaxed);
    assert!(waited.is_ok(), "{} replies to {executed} requests", replies.len());
    assert_eq!(executed, usize::from(CLIENTS));
    for reply in &replies {
        let Content::Frame(frame) = &reply.content else { panic!("{:?}", reply.content) };
        let client = number(reply);
        assert_eq!(frame.related(), Some((WriterId([client; 16]), client.into())));
    }
    assert_eq!(net.broker.requests(), (0, 0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_request_to_a_server_that_only_shows_waits_until_somebody_reads_it() {
    let net = Net::start().await;
    let node = net.node();
    let topic: TopicName = "add/_request".parse().unwrap();
    let type_name = "std_msgs/msg/UInt8".to_owned();
    let shown = Shown { type_name, reliable: true, durable: false };
    assert_eq!(net.broker.show([(topic.clone(), Some(shown))]), 0);
    let client = node.typed_writer(("rq/addRequest", TYPE), reliable(8)).unwrap();
    net.own(&[client.id()]).await;
    eventually("matched", || client.is_matched().then_some(())).await;
    put(&client, 1);
    let waits = || (net.broker.counts().undecided_bytes > 0).then_some(());
    eventually("it waits", waits).await;
    let mut subscription = net.read("add/_request", SubscribeOptions::default()).await;
    assert_eq!(until(&mut subscription, 1).await, [1]);
    put(&client, 2);
    assert_eq!(until(&mut subscription, 2).await, [2]);
    drop(subscription);
    assert!(client.is_matched(), "it shows still");
    net.broker.show([(topic, None)]);
    eventually("it has gone", || (!client.is_matched()).then_some(())).await;
}
