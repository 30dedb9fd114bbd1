//! Against the server that the client library simulates. The test hands out in place of the thread,
//! one record at a time.

use std::future::Future as _;
use std::pin::pin;
use std::task::{Context, Waker};
use std::time::Instant;

use blaze_domain::TopicName;
use rdkafka::ClientConfig;
use rdkafka::mocking::MockCluster;
use rdkafka::producer::{BaseProducer, BaseRecord, DefaultProducerContext, Producer as _};

use super::*;
use crate::kafka::directory::Marks;
use crate::kafka::settings::tests::shared_at;
use crate::port::{SubscribeOptions, Subscription, subscription};

const TOPIC: &str = "fog.imu.data";
const INFO: TopicInfo = TopicInfo { uuid: None, partitions: 1 };

struct Bench {
    consumer: Consumer,
    source: Source,
    server: MockCluster<'static, DefaultProducerContext>,
}

/// A reader, and the offsets that it got.
struct Offsets {
    subscription: Subscription,
    got: Vec<i64>,
}

impl Offsets {
    fn take(&mut self) -> &[i64] {
        let mut batch = Vec::new();
        let mut context = Context::from_waker(Waker::noop());
        // Not ready = nothing in the batch.
        let _ = pin!(self.subscription.receive(&mut batch, 100)).poll(&mut context);
        let places = batch.iter().filter_map(|received| received.place);
        self.got.extend(places.map(|place| place.offset));
        &self.got
    }
}

impl Bench {
    /// A topic of one partition with so many records.
    fn new(records: usize) -> Self {
        let server = MockCluster::new(1).unwrap();
        server.create_topic(TOPIC, 1, 1).unwrap();
        let bootstrap = server.bootstrap_servers();
        let producer: BaseProducer =
            ClientConfig::new().set("bootstrap.servers", &bootstrap).create().unwrap();
        for _ in 0..records {
            let record = BaseRecord::<(), str>::to(TOPIC).partition(0).payload("bare");
            producer.send(record).map_err(|(error, _)| error).unwrap();
        }
        producer.flush(Duration::from_secs(10)).unwrap();
        let consumer = Consumer::new(false, "fog", &shared_at(&bootstrap)).unwrap();
        let channel = ChannelName::from(&"imu/data".parse::<TopicName>().unwrap());
        Self {
            consumer,
            source: Source { channel, topic: TOPIC.into(), stays_open: false },
            server,
        }
    }

    fn add(&self, start: i64, join: Join<'_>) -> Offsets {
        let (sender, subscription) = subscription(SubscribeOptions::default());
        self.consumer.add(&self.source, &INFO, vec![start], sender, join).unwrap();
        Offsets { subscription, got: Vec::new() }
    }

    /// Hands records out until a reader has got the one at `last`.
    fn hand_out_until(&self, reader: &mut Offsets, last: i64) {
        let client = self.consumer.client().unwrap();
        let mut stream = client.stream();
        let mut context = Context::from_waker(Waker::noop());
        let until = Instant::now() + Duration::from_secs(20);
        while reader.take().last() != Some(&last) {
            assert!(Instant::now() < until, "{:?}", reader.got);
            let _ = self.consumer.hand_out(&client, &mut stream, &mut context, 1);
        }
    }

    fn next(&self) -> i64 {
        self.consumer.state.lock().topics[TOPIC].partitions[0].next
    }

    /// As if the server had said so of the topic.
    fn follow(&self, now: Instant, marks: Marks, lost_position: bool) {
        let info =
            TopicInfo { uuid: self.consumer.state.lock().topics[TOPIC].uuid.clone(), ..INFO };
        self.consumer.follow(now, TOPIC, (&info, &[marks]), lost_position);
    }
}

#[test]
fn readers_that_come_while_records_flow_get_each_once_and_in_order() {
    let bench = Bench::new(40);
    let mut readers = vec![bench.add(0, Join::Following)];
    for at in [7, 19, 31] {
        // What the client has fetched beyond lies in its queue.
        bench.hand_out_until(&mut readers[0], at);
        readers.push(bench.add(at / 2, Join::Rewinding));
    }
    for (reader, start) in readers.iter_mut().zip([0, 3, 9, 15]) {
        bench.hand_out_until(reader, 39);
        assert!(reader.take().iter().copied().eq(start..40), "from {start}: {:?}", reader.got);
    }
}

#[test]
fn a_client_that_is_made_anew_reads_on_where_the_old_one_stood() {
    let bench = Bench::new(20);
    let mut reader = bench.add(0, Join::Following);
    bench.hand_out_until(&mut reader, 6);
    bench.consumer.remake().unwrap();
    bench.hand_out_until(&mut reader, 19);
    assert!(reader.take().iter().copied().eq(0..20), "{:?}", reader.got);
}

/// It stood still, leads its partitions again, and names the end that it knew long ago.
#[test]
fn an_end_before_what_was_read_is_not_believed_at_once() {
    let bench = Bench::new(20);
    let mut reader = bench.add(0, Join::Following);
    bench.hand_out_until(&mut reader, 9);
    let begun = Instant::now();
    let check = |after_ms: u64, high: i64| {
        bench.follow(begun + Duration::from_millis(after_ms), Marks { low: 0, high }, true);
        (bench.next(), bench.consumer.take_lost_position())
    };
    assert_eq!(check(0, 7), (10, true), "it is asked again");
    assert_eq!(check(2_900, 7), (10, true));
    assert_eq!(check(2_950, 20), (10, false));
    assert_eq!(check(3_100, 7), (10, true), "that is another time");
    assert_eq!(check(6_200, 7), (7, false), "it says so for long");
}

/// The same of its beginning: seen once, with a log that nothing had been taken from.
#[test]
fn a_beginning_behind_what_was_read_is_not_believed_at_once() {
    let bench = Bench::new(20);
    let mut reader = bench.add(0, Join::Following);
    bench.hand_out_until(&mut reader, 9);
    let begun = Instant::now();
    let check = |after_ms: u64, low: i64| {
        bench.follow(begun + Duration::from_millis(after_ms), Marks { low, high: 20 }, true);
        (bench.next(), bench.consumer.take_lost_position())
    };
    assert_eq!(check(0, 20), (10, true), "it is asked again");
    assert_eq!(check(500, 0), (10, false));
    assert_eq!(check(1_000, 12), (10, true));
    assert_eq!(check(4_100, 12), (12, false), "it says so for long");
}

#[test]
fn a_topic_that_the_client_did_not_take_is_read_on_where_it_stood() {
    let bench = Bench::new(20);
    let mut reader = bench.add(0, Join::Following);
    bench.hand_out_until(&mut reader, 9);
    let resume = || bench.follow(Instant::now(), Marks { low: 0, high: 20 }, false);
    // As after an attempt that failed.
    let client = bench.consumer.client().unwrap();
    if let Some(topic) = bench.consumer.state.lock().topics.get_mut(TOPIC) {
        topic.unassign(&client);
    }
    resume();
    bench.hand_out_until(&mut reader, 14);
    assert!(reader.take().iter().copied().eq(0..15), "{:?}", reader.got);
    bench.consumer.shared.gate.set_stood_back(true);
    bench.consumer.stand_back();
    resume();
    assert_eq!(bench.next(), 15, "the scope is another's");
    bench.consumer.shared.gate.set_stood_back(false);
    resume();
    assert_eq!(bench.next(), 20, "what was written meanwhile was another's");
}

#[test]
fn a_reader_that_comes_while_the_client_is_made_anew_reads_with_the_new_one() {
    let bench = Bench::new(10);
    let (sender, subscription) = subscription(SubscribeOptions::default());
    let mut reader = Offsets { subscription, got: Vec::new() };
    // It waits for an answer about its topic meanwhile.
    bench.server.broker_down(1).unwrap();
    let client = Arc::downgrade(&bench.consumer.client().unwrap());
    std::thread::scope(|scope| {
        let add = scope.spawn(|| {
            let join = Join::Following;
            bench.consumer.add(&bench.source, &INFO, vec![0], sender, join)
        });
        while client.strong_count() < 2 && !add.is_finished() {
            std::thread::yield_now();
        }
        bench.consumer.remake().unwrap();
        bench.server.broker_up(1).unwrap();
        add.join().unwrap().unwrap();
    });
    bench.hand_out_until(&mut reader, 9);
    assert!(reader.take().iter().copied().eq(0..10), "{:?}", reader.got);
}
