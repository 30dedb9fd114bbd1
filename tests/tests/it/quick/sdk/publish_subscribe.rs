//! Publishing and subscribing through the SDK on a memory hub.

use std::collections::HashMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, mpsc};
use std::time::{Duration, Instant, SystemTime};

use blaze_brokers::memory::MemoryHub;
use blaze_brokers::{Broker as _, PublisherOptions};
use blaze_domain::names::ChannelName;
use blaze_domain::{Origin, Scope, TopicName, WriterId};
use blaze_proto::{Frame, Header};
use blaze_runtime::Supervisor;
use blaze_sdk::{
    Message, PublishOptions, PublishOutcome, SdkError, ServiceManager, ServiceOptions,
    SubscribeOptions, Subscription,
};
use bytes::Bytes;

const DEADLINE: Duration = Duration::from_secs(20);

async fn service(hub: &MemoryHub, name: &str, pool_threads: usize) -> ServiceManager {
    let options = ServiceOptions {
        pool_threads,
        ..ServiceOptions::new(
            "edge".parse().unwrap(),
            name.parse().unwrap(),
            Arc::new(hub.broker()),
            Scope::Node,
        )
    };
    let options = options.on_node("robot-1".parse().unwrap());
    ServiceManager::start(options).await.unwrap()
}

fn topic(name: &str) -> TopicName {
    name.parse().unwrap()
}

async fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let until = Instant::now() + DEADLINE;
    while !holds() {
        assert!(Instant::now() < until, "{what}: not within {DEADLINE:?}");
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
}

/// A subscription whose callback hands messages on.
async fn listen(
    service: &ServiceManager,
    name: &str,
    options: SubscribeOptions,
) -> (Subscription, mpsc::Receiver<Message>) {
    let (sender, receiver) = mpsc::sync_channel(100_000);
    let subscription = service
        .broker()
        .subscribe(&topic(name), options, move |message| {
            sender.try_send(message).unwrap();
        })
        .await
        .unwrap();
    (subscription, receiver)
}

/// Callbacks wait here until it is opened, which also happens when the test ends.
struct Gate(Arc<(Mutex<bool>, Condvar)>);

impl Gate {
    fn closed() -> Self {
        Self(Arc::default())
    }

    fn waiter(&self) -> impl Fn() + Send + Sync + 'static {
        let shared = Arc::clone(&self.0);
        move || {
            let is_open = shared.0.lock().unwrap();
            drop(shared.1.wait_while(is_open, |is_open| !*is_open).unwrap());
        }
    }

    fn open(&self) {
        *self.0.0.lock().unwrap() = true;
        self.0.1.notify_all();
    }
}

impl Drop for Gate {
    fn drop(&mut self) {
        self.open();
    }
}

/// Publishes frames with any header on a hub.
struct Raw {
    to: Arc<dyn blaze_brokers::Publisher>,
    topic: String,
    _client: blaze_brokers::memory::MemoryBroker,
}

impl Raw {
    fn new(hub: &MemoryHub, name: &str) -> Self {
        let client = hub.broker();
        let channel: ChannelName = name.parse().unwrap();
        Self {
            to: client.publisher(&channel, PublisherOptions::default()).unwrap(),
            topic: name.to_owned(),
            _client: client,
        }
    }

    fn send(&self, writer: u8, sequence: u64, edit: impl FnOnce(&mut Header)) {
        let mut header =
            Header::new(&self.topic, Origin::default(), WriterId([writer; 16]), sequence, now_ns());
        edit(&mut header);
        let frame = Frame::new(&header, Bytes::from(sequence.to_string())).unwrap();
        assert_eq!(self.to.publish(&frame, None), PublishOutcome::Taken);
    }
}

fn now_ns() -> u64 {
    u64::try_from(SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap().as_nanos())
        .unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_message_tells_who_published_it_when_and_what_it_is() {
    let hub = MemoryHub::new("t");
    let (sender, receiver) = (service(&hub, "driver", 2).await, service(&hub, "logger", 2).await);
    let (_subscription, heard) = listen(&receiver, "imu/data", SubscribeOptions::default()).await;
    let options = PublishOptions {
        encoding: "application/json".to_owned(),
        priority: Some(blaze_domain::Priority::Control),
        lifespan: Duration::from_secs(60),
        ..PublishOptions::default()
    };
    let publisher = sender.broker().publisher(&topic("imu/data"), &options).unwrap();
    let measured = SystemTime::now() - Duration::from_secs(3);
    assert_eq!(publisher.publish_at(Bytes::from_static(b"{}"), measured), PublishOutcome::Taken);
    let message = heard.recv_timeout(DEADLINE).unwrap();
    let origin = message.origin();
    assert_eq!(
        (origin.layer.as_str(), origin.node.as_str(), origin.service.as_str()),
        ("edge", "robot-1", "driver")
    );
    assert_eq!(origin.epoch, sender.identity().epoch);
    assert_eq!(message.writer(), Some(publisher.writer()));
    assert_eq!((message.sequence(), message.hops()), (Some(1), 0));
    assert_eq!(message.encoding(), "application/json");
    assert_eq!(message.priority(), Some(blaze_domain::Priority::Control));
    assert_eq!(&message.payload()[..], b"{}");
    assert_eq!(message.publish_time(), Some(measured));
    let age = message.age();
    assert!(age >= Duration::from_secs(3) && age < Duration::from_secs(23), "{age:?}");
    let other = sender.broker().publisher(&topic("imu/data"), &options).unwrap();
    assert_ne!(other.writer(), publisher.writer());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_of_each_writer_come_one_at_a_time_and_in_order() {
    const MESSAGES: u64 = 2_000;
    let hub = MemoryHub::new("t");
    let service = service(&hub, "s", 4).await;
    type Seen = HashMap<WriterId, (bool, u64)>;
    let seen: Arc<Mutex<Seen>> = Arc::default();
    let wrong = Arc::new(AtomicUsize::new(0));
    let (noted, errors) = (Arc::clone(&seen), Arc::clone(&wrong));
    let options = SubscribeOptions { max_messages: 10_000, ..SubscribeOptions::default() };
    let subscription = service
        .broker()
        .subscribe(&topic("t"), options, move |message| {
            let writer = message.writer().unwrap();
            let ok = {
                let mut seen = noted.lock().unwrap();
                let (busy, last) = seen.entry(writer).or_default();
                let ok = !*busy && message.sequence() == Some(*last + 1);
                (*busy, *last) = (true, message.sequence().unwrap());
                ok
            };
            std::thread::yield_now();
            noted.lock().unwrap().entry(writer).or_default().0 = false;
            errors.fetch_add(usize::from(!ok), Ordering::Relaxed);
        })
        .await
        .unwrap();
    let publishers: Vec<_> = (0..3)
        .map(|_| service.broker().publisher(&topic("t"), &PublishOptions::default()).unwrap())
        .collect();
    for _ in 0..MESSAGES {
        for publisher in &publishers {
            publisher.publish(Bytes::from_static(b"x"));
        }
    }
    eventually("all messages are delivered", || subscription.stats().delivered == 3 * MESSAGES)
        .await;
    subscription.close().await;
    assert_eq!(wrong.load(Ordering::Relaxed), 0);
    assert!(seen.lock().unwrap().values().all(|(_, last)| *last == MESSAGES));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn concurrency_runs_callbacks_of_one_writer_at_the_same_time() {
    let hub = MemoryHub::new("t");
    let service = service(&hub, "s", 4).await;
    let options = SubscribeOptions { concurrency: 3, ..SubscribeOptions::default() };
    // Each callback waits for the two others: with fewer at once, none would ever end.
    let together = Arc::new(std::sync::Barrier::new(3));
    let meet = Arc::clone(&together);
    let (done, ended) = mpsc::sync_channel(3);
    let _subscription = service
        .broker()
        .subscribe(&topic("t"), options, move |_| {
            meet.wait();
            done.try_send(()).unwrap();
        })
        .await
        .unwrap();
    let publisher = service.broker().publisher(&topic("t"), &PublishOptions::default()).unwrap();
    for _ in 0..3 {
        publisher.publish(Bytes::new());
    }
    for _ in 0..3 {
        ended.recv_timeout(DEADLINE).unwrap();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn slow_callbacks_do_not_hold_up_others_even_if_there_are_more_than_threads() {
    let hub = MemoryHub::new("t");
    let service = service(&hub, "s", 2).await;
    let gate = Gate::closed();
    let mut slow = Vec::new();
    let entered = Arc::new(AtomicUsize::new(0));
    for number in 0..5 {
        let (wait, entered) = (gate.waiter(), Arc::clone(&entered));
        let name = topic(&format!("slow/{number}"));
        let subscription = service
            .broker()
            .subscribe(&name, SubscribeOptions::default(), move |_| {
                entered.fetch_add(1, Ordering::SeqCst);
                wait();
            })
            .await
            .unwrap();
        let publisher = service.broker().publisher(&name, &PublishOptions::default()).unwrap();
        for _ in 0..3 {
            publisher.publish(Bytes::new());
        }
        slow.push((subscription, publisher));
    }
    eventually("all five slow callbacks run", || entered.load(Ordering::SeqCst) == 5).await;
    let (_quick, heard) = listen(&service, "quick", SubscribeOptions::default()).await;
    let publisher =
        service.broker().publisher(&topic("quick"), &PublishOptions::default()).unwrap();
    for sequence in 1..=100 {
        publisher.publish(Bytes::new());
        assert_eq!(heard.recv_timeout(DEADLINE).unwrap().sequence(), Some(sequence));
    }
    assert_eq!(entered.load(Ordering::SeqCst), 5, "the slow ones still wait");
    gate.open();
    eventually("the slow ones go on", || entered.load(Ordering::SeqCst) == 15).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_subscription_never_takes_all_threads() {
    let hub = MemoryHub::new("t");
    let service = service(&hub, "s", 3).await;
    let gate = Gate::closed();
    let entered = Arc::new(AtomicUsize::new(0));
    let (wait, count) = (gate.waiter(), Arc::clone(&entered));
    let slow = service
        .broker()
        .subscribe(&topic("slow"), SubscribeOptions::default(), move |_| {
            count.fetch_add(1, Ordering::SeqCst);
            wait();
        })
        .await
        .unwrap();
    let raw = Raw::new(&hub, "slow");
    for writer in 1..=10 {
        raw.send(writer, 1, |_| {});
    }
    eventually("two callbacks run", || entered.load(Ordering::SeqCst) == 2).await;
    let (_quick, heard) = listen(&service, "quick", SubscribeOptions::default()).await;
    let quick = Raw::new(&hub, "quick");
    quick.send(1, 1, |_| {});
    heard.recv_timeout(DEADLINE).unwrap();
    assert_eq!(entered.load(Ordering::SeqCst), 2);
    gate.open();
    eventually("all ten writers are served", || slow.stats().delivered == 10).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_full_queue_drops_the_oldest_and_counts_them() {
    let hub = MemoryHub::new("t");
    let service = service(&hub, "s", 2).await;
    let gate = Gate::closed();
    let (sender, heard) = mpsc::sync_channel(1_000);
    let wait = gate.waiter();
    let options = SubscribeOptions { max_messages: 10, ..SubscribeOptions::default() };
    let subscription = service
        .broker()
        .subscribe(&topic("t"), options, move |message| {
            sender.try_send(message.sequence().unwrap()).unwrap();
            wait();
        })
        .await
        .unwrap();
    let raw = Raw::new(&hub, "t");
    raw.send(1, 1, |_| {});
    assert_eq!(heard.recv_timeout(DEADLINE).unwrap(), 1);
    for sequence in 2..=100 {
        raw.send(1, sequence, |_| {});
    }
    eventually("all arrived", || subscription.stats().queue_dropped == 89).await;
    gate.open();
    let kept: Vec<u64> = (0..10).map(|_| heard.recv_timeout(DEADLINE).unwrap()).collect();
    assert_eq!(kept, (91..=100).collect::<Vec<_>>());
    assert_eq!(subscription.stats().delivered, 11);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_panicking_callback_is_counted_and_the_next_message_comes() {
    let hub = MemoryHub::new("t");
    let service = service(&hub, "s", 2).await;
    let (sender, heard) = mpsc::sync_channel(10);
    let subscription = service
        .broker()
        .subscribe(&topic("t"), SubscribeOptions::default(), move |message| {
            let sequence = message.sequence().unwrap();
            assert!(sequence > 5, "this panic is part of the test");
            sender.try_send(sequence).unwrap();
        })
        .await
        .unwrap();
    let raw = Raw::new(&hub, "t");
    for sequence in 1..=6 {
        raw.send(1, sequence, |_| {});
    }
    assert_eq!(heard.recv_timeout(DEADLINE).unwrap(), 6);
    assert_eq!(subscription.stats().panicked, 5);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_that_grow_old_in_the_queue_are_left_out() {
    let hub = MemoryHub::new("t");
    let service = service(&hub, "s", 2).await;
    let gate = Gate::closed();
    let (sender, heard) = mpsc::sync_channel(10);
    let wait = gate.waiter();
    let subscription = service
        .broker()
        .subscribe(&topic("t"), SubscribeOptions::default(), move |message| {
            sender.try_send(message.sequence().unwrap()).unwrap();
            wait();
        })
        .await
        .unwrap();
    let raw = Raw::new(&hub, "t");
    raw.send(1, 1, |_| {});
    assert_eq!(heard.recv_timeout(DEADLINE).unwrap(), 1);
    let sent = Instant::now();
    raw.send(1, 2, |header| (header.lifespan_ms, header.hops) = (500, 1));
    raw.send(1, 3, |_| {});
    eventually("the messages arrived and the second one grew old", || {
        subscription.stats().received == 3 && sent.elapsed() > Duration::from_millis(600)
    })
    .await;
    gate.open();
    assert_eq!(heard.recv_timeout(DEADLINE).unwrap(), 3);
    assert_eq!(subscription.stats().expired, 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn bare_messages_come_and_malformed_ones_are_counted() {
    let hub = MemoryHub::new("t");
    let service = service(&hub, "s", 2).await;
    let (subscription, heard) = listen(&service, "t", SubscribeOptions::default()).await;
    let raw = Raw::new(&hub, "t");
    raw.to.publish_bare(&Bytes::from_static(b"BLZ1 is no frame"), None);
    raw.to.publish_bare(&Bytes::from_static(b"bare"), None);
    let bare = heard.recv_timeout(DEADLINE).unwrap();
    assert_eq!((&bare.payload()[..], bare.sequence()), (&b"bare"[..], None));
    let stats = subscription.stats();
    assert_eq!((stats.received, stats.delivered, stats.malformed), (2, 1, 1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn late_joiners_get_what_is_kept_and_repeats_once() {
    let hub = MemoryHub::new("t");
    let service = service(&hub, "s", 2).await;
    let options = PublishOptions { depth: 2, ..PublishOptions::default() };
    let publisher = service.broker().publisher(&topic("map"), &options).unwrap();
    for _ in 0..5 {
        publisher.publish(Bytes::new());
    }
    let options = SubscribeOptions { with_kept: true, ..SubscribeOptions::default() };
    let (_subscription, heard) = listen(&service, "map", options).await;
    publisher.publish(Bytes::new());
    let found: Vec<_> = (0..3).map(|_| heard.recv_timeout(DEADLINE).unwrap().sequence()).collect();
    assert_eq!(found, [Some(4), Some(5), Some(6)]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn bad_options_are_refused_with_their_name() {
    let hub = MemoryHub::new("t");
    let service = service(&hub, "s", 2).await;
    let refused = |options| {
        let broker = service.broker().clone();
        async move {
            match broker.subscribe(&topic("t"), options, |_| {}).await {
                Err(SdkError::Option { option, .. }) => option,
                other => panic!("{other:?}"),
            }
        }
    };
    for rate in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let options = SubscribeOptions { max_rate_hz: Some(rate), ..SubscribeOptions::default() };
        assert_eq!(refused(options).await, "max_rate_hz");
    }
    let options = SubscribeOptions { concurrency: 0, ..SubscribeOptions::default() };
    assert_eq!(refused(options).await, "concurrency");
    let options = PublishOptions { encoding: "x".repeat(201), ..PublishOptions::default() };
    assert!(service.broker().publisher(&topic("t"), &options).is_err());
    let publisher = service.broker().publisher(&topic("t"), &PublishOptions::default()).unwrap();
    let large = Bytes::from(vec![0; blaze_domain::MAX_PAYLOAD_BYTES + 1]);
    assert_eq!(publisher.publish(large), PublishOutcome::TooLarge);
    assert_eq!(publisher.sequence(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn dropping_a_subscription_ends_it_at_the_broker() {
    let hub = MemoryHub::new("t");
    let service = service(&hub, "s", 2).await;
    let (subscription, heard) = listen(&service, "t", SubscribeOptions::default()).await;
    let raw = Raw::new(&hub, "t");
    raw.send(1, 1, |_| {});
    heard.recv_timeout(DEADLINE).unwrap();
    subscription.close().await;
    let channel: ChannelName = "t".parse().unwrap();
    eventually("the broker has no reader", || hub.subscriptions_of(&channel) == 0).await;
    raw.send(1, 2, |_| {});
    let end = heard.recv_timeout(DEADLINE);
    assert_eq!(end.unwrap_err(), mpsc::RecvTimeoutError::Disconnected, "the callback is gone");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn shutdown_leaves_no_task_and_no_reader() {
    let hub = MemoryHub::new("t");
    let tasks = || tokio::runtime::Handle::current().metrics().num_alive_tasks();
    let before = tasks();
    for graceful in [true, false] {
        let service = service(&hub, "s", 3).await;
        let (_one, heard) = listen(&service, "t", SubscribeOptions::default()).await;
        let _two = listen(&service, "u", SubscribeOptions::default()).await;
        Raw::new(&hub, "t").send(1, 1, |_| {});
        heard.recv_timeout(DEADLINE).unwrap();
        let broker = service.broker().clone();
        if graceful {
            service.shutdown().await;
            // The runtime strikes a task off a moment after it has told its end.
            eventually("all tasks end", || tasks() == before).await;
            assert_eq!(hub.stats().subscriptions, 0);
        } else {
            drop(service);
            eventually("all tasks end", || tasks() == before).await;
            eventually("all readers end", || hub.stats().subscriptions == 0).await;
        }
        let refused = broker.subscribe(&topic("t"), SubscribeOptions::default(), |_| {}).await;
        assert!(matches!(refused, Err(SdkError::ShutDown)), "{refused:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_service_runs_under_the_supervisor_that_it_is_given_and_ends_with_it() {
    let hub = MemoryHub::new("t");
    let process = Supervisor::new("process");
    let options = ServiceOptions::new(
        "edge".parse().unwrap(),
        "s".parse().unwrap(),
        Arc::new(hub.broker()),
        Scope::Node,
    );
    let options = ServiceOptions { supervisor: Some(process.clone()), pool_threads: 2, ..options };
    let service = ServiceManager::start(options).await.unwrap();
    let (_subscription, heard) = listen(&service, "t", SubscribeOptions::default()).await;
    Raw::new(&hub, "t").send(1, 1, |_| {});
    heard.recv_timeout(DEADLINE).unwrap();
    let running = process.running();
    for (name, thread) in [
        ("s-0/leases", false),
        ("s-0/subscription t", false),
        ("s-0/blaze-cb-0", true),
        ("s-0/blaze-cb-1", true),
    ] {
        assert!(
            running.iter().any(|task| task.name == name && task.thread == thread),
            "{name}: {running:?}"
        );
    }
    let report = process.shutdown(DEADLINE).await;
    assert!(report.is_clean(), "{report:?}");
    assert_eq!((hub.stats().subscriptions, process.running()), (0, Vec::new()));
    let refused =
        service.broker().subscribe(&topic("t"), SubscribeOptions::default(), |_| {}).await;
    assert!(matches!(refused, Err(SdkError::ShutDown)), "{refused:?}");
}
