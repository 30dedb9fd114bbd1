//! Against the server that the client library simulates. The test polls in place of the thread, so that it decides what happens
//! between polling and handing out.

use std::future::Future as _;
use std::pin::pin;
use std::task::{Context, Waker};
use std::time::Instant;

use blaze_domain::TopicName;
use bytes::Bytes;
use rdkafka::ClientConfig;
use rdkafka::message::{BorrowedMessage, Message as _};
use rdkafka::mocking::MockCluster;
use rdkafka::producer::{BaseProducer, BaseRecord, DefaultProducerContext, Producer as _};

use super::*;
use crate::kafka::directory::Marks;
use crate::kafka::settings::tests::section_at;
use crate::port::{Content, Place, SubscribeOptions, Subscription, subscription};

const TOPIC: &str = "fog.imu.data";
const INFO: TopicInfo = TopicInfo {
    uuid: None,
    partitions: 1,
};

struct Bench {
    consumer: Consumer,
    client: Arc<Client>,
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
        let producer: BaseProducer = ClientConfig::new()
            .set("bootstrap.servers", &bootstrap)
            .create()
            .unwrap();
        for _ in 0..records {
            let record = BaseRecord::<(), str>::to(TOPIC).partition(0).payload("bare");
            producer.send(record).map_err(|(error, _)| error).unwrap();
        }
        producer.flush(Duration::from_secs(10)).unwrap();
        let settings = Settings::new(&section_at(&bootstrap, "{}")).unwrap();
        let clock = Arc::new(Mutex::new(BrokerClock::new(Instant::now())));
        let consumer = Consumer::new(false, "fog", &settings, &clock, &Arc::default()).unwrap();
        let client = consumer.client.lock().clone().unwrap();
        let channel = ChannelName::from(&"imu/data".parse::<TopicName>().unwrap());
        Self {
            consumer,
            client,
            source: Source {
                channel,
                topic: TOPIC.into(),
                stays_open: false,
            },
            server,
        }
    }

    fn add(&self, start: i64, join: Join<'_>) -> Offsets {
        let (sender, subscription) = subscription(SubscribeOptions::default());
        self.consumer
            .add(&self.source, &INFO, vec![start], sender, join)
            .unwrap();
        Offsets {
            subscription,
            got: Vec::new(),
        }
    }

    /// Polls a record without handing it out.
    fn poll(&self) -> BorrowedMessage<'_> {
        let until = Instant::now() + Duration::from_secs(20);
        while Instant::now() < until {
            match self.client.poll(POLL) {
                Some(Ok(message)) => return message,
                other => self.consumer.hand_out(other),
            }
        }
        panic!("nothing came");
    }

    /// Hands records out until a reader has got the one at `last`.
    fn hand_out_until(&self, reader: &mut Offsets, last: i64) {
        while reader.take().last() != Some(&last) {
            let message = self.poll();
            self.consumer.hand_out(Some(Ok(message)));
        }
    }
}

#[test]
fn a_record_that_waited_while_a_reader_came_does_not_hide_what_is_read_again() {
    let bench = Bench::new(6);
    let mut first = bench.add(0, Join::Following);
    bench.hand_out_until(&mut first, 2);
    let waiting = bench.poll();
    assert_eq!(waiting.offset(), 3);
    let mut second = bench.add(0, Join::Rewinding);
    bench.consumer.hand_out(Some(Ok(waiting)));
    bench.hand_out_until(&mut second, 5);
    assert_eq!(second.take(), [0, 1, 2, 3, 4, 5]);
    assert_eq!(first.take(), [0, 1, 2, 3, 4, 5]);
}

#[test]
fn a_record_that_was_polled_after_a_reader_came_is_not_lost() {
    let bench = Bench::new(6);
    let mut first = bench.add(0, Join::Following);
    bench.hand_out_until(&mut first, 3);
    let mut second = bench.add(1, Join::Rewinding);
    let fresh = bench.poll();
    assert_eq!(fresh.offset(), 1, "the client reads from there already");
    bench.consumer.hand_out(Some(Ok(fresh)));
    bench.hand_out_until(&mut second, 5);
    assert_eq!(second.take(), [1, 2, 3, 4, 5]);
    assert_eq!(first.take(), [0, 1, 2, 3, 4, 5]);
}

#[test]
fn a_reader_gets_all_that_is_kept_though_it_is_more_than_may_wait() {
    let bench = Bench::new(1);
    let kept_records = i64::try_from(SubscribeOptions::default().max_messages).unwrap() + 100;
    let received = |offset: i64| Received {
        place: Some(Place {
            partition: 0,
            offset,
            appended_ms: None,
        }),
        kept: true,
        ..Received::live(Content::from_bytes(Bytes::from_static(b"kept")), Instant::now())
    };
    let mut kept = || -> Vec<Received> { (0..kept_records).map(received).collect() };
    let mut reader = bench.add(1, Join::AfterKept(&mut kept));
    while reader.take().last() != Some(&(kept_records - 1)) {}
    assert_eq!(reader.take(), (0..kept_records).collect::<Vec<i64>>());
    assert_eq!(reader.subscription.take_dropped(), 0);
}

#[test]
fn readers_that_come_while_records_flow_get_each_once_and_in_order() {
    let bench = Bench::new(40);
    let mut readers = vec![bench.add(0, Join::Following)];
    for at in [7, 19, 31] {
        bench.hand_out_until(&mut readers[0], at);
        let waiting = bench.poll();
        readers.push(bench.add(at / 2, Join::Rewinding));
        bench.consumer.hand_out(Some(Ok(waiting)));
    }
    for (reader, start) in readers.iter_mut().zip([0, 3, 9, 15]) {
        bench.hand_out_until(reader, 39);
        assert!(
            reader.take().iter().copied().eq(start..40),
            "from {start}: {:?}",
            reader.got
        );
    }
}

#[test]
fn a_client_that_is_made_anew_reads_on_where_the_old_one_stood() {
    let mut bench = Bench::new(20);
    let mut reader = bench.add(0, Join::Following);
    bench.hand_out_until(&mut reader, 6);
    // It was polled and not handed out.
    let waiting = bench
        .client
        .poll(Duration::from_secs(10))
        .map(|polled| polled.map(|message| message.detach()));
    assert!(matches!(&waiting, Some(Ok(message)) if message.offset() == 7));
    let settings = Settings::new(&section_at(&bench.server.bootstrap_servers(), "{}")).unwrap();
    bench.consumer.remake(&settings).unwrap();
    bench.client = bench.consumer.client.lock().clone().unwrap();
    bench.hand_out_until(&mut reader, 19);
    assert!(reader.take().iter().copied().eq(0..20), "{:?}", reader.got);
}

/// It stood still, leads its partitions again, and names the end that it knew long ago.
#[test]
fn an_end_before_what_was_read_is_not_believed_at_once() {
    let bench = Bench::new(20);
    let mut reader = bench.add(0, Join::Following);
    bench.hand_out_until(&mut reader, 9);
    let next = || bench.consumer.state.lock().topics[TOPIC].partitions[0].next;
    let info = TopicInfo {
        uuid: bench.consumer.state.lock().topics[TOPIC].uuid.clone(),
        ..INFO
    };
    let begun = Instant::now();
    let check = |after_ms: u64, high: i64| {
        let now = begun + Duration::from_millis(after_ms);
        bench
            .consumer
            .check_positions(now, TOPIC, &info, &[Marks { low: 0, high }]);
        (next(), bench.consumer.take_lost_position())
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
    let next = || bench.consumer.state.lock().topics[TOPIC].partitions[0].next;
    let info = TopicInfo {
        uuid: bench.consumer.state.lock().topics[TOPIC].uuid.clone(),
        ..INFO
    };
    let begun = Instant::now();
    let check = |after_ms: u64, low: i64| {
        let now = begun + Duration::from_millis(after_ms);
        let marks = [Marks { low, high: 20 }];
        bench.consumer.check_positions(now, TOPIC, &info, &marks);
        (next(), bench.consumer.take_lost_position())
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
    let marks = [Marks { low: 0, high: 20 }];
    let resume = || {
        let info = TopicInfo {
            uuid: bench.consumer.state.lock().topics[TOPIC].uuid.clone(),
            ..INFO
        };
        bench.consumer.resume(TOPIC, &info, &marks, || true);
    };
    // As after an attempt that failed.
    if let Some(topic) = bench.consumer.state.lock().topics.get_mut(TOPIC) {
        topic.unassign(&bench.client);
    }
    resume();
    bench.hand_out_until(&mut reader, 14);
    assert!(reader.take().iter().copied().eq(0..15), "{:?}", reader.got);
    bench.consumer.stand_back();
    resume();
    let next = bench.consumer.state.lock().topics[TOPIC].partitions[0].next;
    assert_eq!(next, 20, "what was written meanwhile was another's");
}

#[test]
fn a_reader_that_comes_while_the_client_is_made_anew_reads_with_the_new_one() {
    let mut bench = Bench::new(10);
    let (sender, subscription) = subscription(SubscribeOptions::default());
    let mut reader = Offsets {
        subscription,
        got: Vec::new(),
    };
    let settings = Settings::new(&section_at(&bench.server.bootstrap_servers(), "{}")).unwrap();
    // It waits for an answer about its topic meanwhile.
    bench.server.broker_down(1).unwrap();
    std::thread::scope(|scope| {
        let add = scope.spawn(|| {
            let join = Join::Following;
            bench.consumer.add(&bench.source, &INFO, vec![0], sender, join)
        });
        while Arc::strong_count(&bench.client) < 3 && !add.is_finished() {
            std::thread::yield_now();
        }
        bench.consumer.remake(&settings).unwrap();
        bench.server.broker_up(1).unwrap();
        add.join().unwrap().unwrap();
    });
    bench.client = bench.consumer.client.lock().clone().unwrap();
    bench.hand_out_until(&mut reader, 9);
    assert!(reader.take().iter().copied().eq(0..10), "{:?}", reader.got);
}
