//! A reader that dies or stands still never holds the others up.

use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::dds::layer::DdsBroker;
use blaze_brokers::{Broker, PublishOutcome, Publisher, PublisherOptions};
use blaze_domain::names::ChannelName;
use blaze_tests::machine::Idler;
use blaze_tests::process::Process;
use blaze_tests::within;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use super::support::{DEADLINE, Domain, eventually, frame};

/// The longest time that others may receive nothing. Beyond it counts what was not sent, and what
/// the machine had nobody do anything.
const LONGEST_GAP: Duration = Duration::from_millis(300);
const RELIABLE: PublisherOptions = PublisherOptions { depth: 0, reliable: true, large: false };

/// A reader in a process of its own.
struct Peer {
    process: Process,
    name: &'static str,
}

impl Peer {
    fn start(domain: &Domain, name: &'static str, topic: &ChannelName, more: &[&str]) -> Self {
        let id = domain.id.to_string();
        let kind = name.split_once(' ').unwrap().0;
        let arguments = [&[kind, "--domain", &id, "--topic", topic.as_str()], more].concat();
        Self { process: Process::tool("dds-peer", &arguments, None).unwrap(), name }
    }

    fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(i32::try_from(self.process.id()).unwrap()).unwrap();
        kill_process(pid, signal).unwrap();
    }

    /// Its newest report.
    fn report(&self) -> Value {
        let lines = self.process.stdout();
        let newest = lines.iter().rev().find_map(|line| serde_json::from_str(line).ok());
        newest.unwrap_or(Value::Null)
    }

    fn number(&self, field: &str) -> u64 {
        self.report()[field].as_u64().unwrap_or(0)
    }

    async fn receives(&self) {
        eventually(&format!("{} receives", self.name), || {
            (self.number("received") > 0).then_some(())
        })
        .await;
    }

    /// Everything arrived, in order, once, and without a long gap.
    async fn has_all(&self, source: &Source) {
        let report = self.has_all_in_the_end(source.sequence).await;
        let gap = Duration::from_secs_f64(report["gap_ms"].as_f64().unwrap() / 1e3);
        let (pause, late) = (source.longest_pause, source.idler.latest());
        assert!(
            gap < within(LONGEST_GAP) + pause + late,
            "{}: {report}; the source paused for {pause:?}, the machine was late by {late:?}",
            self.name
        );
    }

    /// Everything arrived, in order, once.
    async fn has_all_in_the_end(&self, last: u64) -> Value {
        eventually(&format!("{} has message {last}: {}", self.name, self.report()), || {
            (self.number("last") == last).then_some(())
        })
        .await;
        let report = self.report();
        let count = |field: &str| report[field].as_u64().unwrap();
        let faults = (count("lost"), count("reordered"), count("malformed"));
        assert_eq!(faults, (0, 0, 0), "{report}");
        assert_eq!(count("received"), last + 1 - count("first"), "{report}");
        report
    }
}

/// Publishes at a rate, in real time, until told.
struct Source {
    publisher: Arc<dyn Publisher>,
    topic: ChannelName,
    period: Duration,
    bytes: usize,
    sequence: u64,
    due: Instant,
    sent: Option<Instant>,
    longest_pause: Duration,
    idler: Idler,
}

impl Source {
    fn new(
        broker: &DdsBroker,
        topic: &ChannelName,
        hz: f64,
        bytes: usize,
        options: PublisherOptions,
    ) -> Self {
        Self {
            publisher: broker.publisher(topic, options).unwrap(),
            topic: topic.clone(),
            period: Duration::from_secs_f64(1.0 / hz),
            bytes,
            sequence: 0,
            due: Instant::now(),
            sent: None,
            longest_pause: Duration::ZERO,
            idler: Idler::start(),
        }
    }

    async fn run(&mut self, time: Duration) {
        let end = Instant::now() + time;
        self.until(|| Instant::now() >= end).await;
    }

    async fn until(&mut self, mut ends: impl FnMut() -> bool) {
        // What was not due meanwhile is not made up for.
        self.due = self.due.max(Instant::now());
        while !ends() {
            while self.due <= Instant::now() {
                self.sequence += 1;
                let frame = frame(&self.topic, 1, self.sequence, self.bytes);
                // Without the call itself, which must not wait for any reader.
                let pause = self.sent.map_or(Duration::ZERO, |sent| sent.elapsed());
                self.longest_pause = self.longest_pause.max(pause);
                assert_eq!(self.publisher.publish(&frame, None), PublishOutcome::Taken);
                self.sent = Some(Instant::now());
                self.due += self.period;
            }
            tokio::time::sleep_until(self.due.into()).await;
        }
    }

    /// Publishes on until all have met the writer.
    async fn meet(&mut self, peers: &[&Peer]) {
        let until = Instant::now() + DEADLINE;
        let met = || peers.iter().all(|peer| peer.number("received") > 0);
        self.until(|| met() || Instant::now() > until).await;
        for peer in peers {
            peer.receives().await;
        }
    }
}

fn topic(name: &str) -> ChannelName {
    name.parse().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_reader_holds_nobody_up() {
    let domain = Domain::start();
    let broker = domain.open().await;
    for (victim, large) in
        [("adapter victim", false), ("plain victim", false), ("adapter victim", true)]
    {
        let topic = topic(&format!("killed/{}-{large}", victim.replace(' ', "-")));
        let flags: &[&str] = if large { &["--reliable", "--large"] } else { &["--reliable"] };
        let [victim, one, other] = [victim, "adapter witness", "plain witness"]
            .map(|name| Peer::start(&domain, name, &topic, flags));
        let options = PublisherOptions { large, ..RELIABLE };
        // For large messages a writer has a window of 64, and a reader that is late keeps the last
        // 32.
        let (rate_hz, bytes) = if large { (200.0, 4_000) } else { (500.0, 200) };
        let mut source = Source::new(&broker, &topic, rate_hz, bytes, options);
        source.meet(&[&victim, &one, &other]).await;
        source.run(Duration::from_secs(1)).await;
        let expelled = broker.counts().expelled;
        victim.signal(Signal::KILL);
        source.run(Duration::from_secs(4)).await;
        one.has_all(&source).await;
        other.has_all(&source).await;
        let later = source.publisher.later();
        assert_eq!((later.queued, later.dropped()), (0, 0), "{later:?}");
        assert_eq!(broker.counts().expelled, expelled + 1, "good-bye was said once");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_reader_that_stands_still_holds_nobody_up_and_comes_back() {
    let domain = Domain::start();
    let broker = domain.open().await;
    let topic = topic("stalled/small");
    let [victim, one, other] = ["adapter victim", "adapter witness", "plain witness"]
        .map(|name| Peer::start(&domain, name, &topic, &["--reliable"]));
    // The window of 8,192 samples is full after four seconds.
    let mut source = Source::new(&broker, &topic, 2_000.0, 200, RELIABLE);
    source.meet(&[&victim, &one, &other]).await;
    source.run(Duration::from_secs(1)).await;
    victim.signal(Signal::STOP);
    source.run(Duration::from_secs(7)).await;
    one.has_all(&source).await;
    other.has_all(&source).await;
    let later = source.publisher.later();
    assert_eq!((later.queued, later.dropped()), (0, 0), "{later:?}");
    assert_eq!(broker.counts().expelled, 1);
    victim.signal(Signal::CONT);
    let goal = source.sequence + 1;
    let until = Instant::now() + DEADLINE;
    source.until(|| victim.number("last") > goal || Instant::now() > until).await;
    assert!(victim.number("last") > goal, "it receives again: {}", victim.report());
    one.has_all(&source).await;
    other.has_all(&source).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_reader_that_starts_anew_receives_at_once() {
    let domain = Domain::start();
    let broker = domain.open().await;
    let topic = topic("restarted");
    let mut source = Source::new(&broker, &topic, 500.0, 200, RELIABLE);
    for _ in 0..4 {
        let peer = Peer::start(&domain, "adapter reader", &topic, &[]);
        let start = Instant::now();
        source.meet(&[&peer]).await;
        println!("received after {:?}", start.elapsed());
        assert!(start.elapsed() < Duration::from_secs(5), "{:?}", start.elapsed());
        peer.signal(Signal::KILL);
    }
    assert_eq!(source.publisher.later().dropped(), 0);
}

/// Thousands of fragments each; lost ones are asked for again, which takes its time.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn large_messages_reach_a_plain_program() {
    let domain = Domain::start();
    let broker = domain.open().await;
    let topic = topic("large");
    let reader = Peer::start(&domain, "plain reader", &topic, &["--reliable"]);
    let options = PublisherOptions { large: true, ..RELIABLE };
    let mut source = Source::new(&broker, &topic, 5.0, 1_000, options);
    source.meet(&[&reader]).await;
    source.bytes = 8_000_000;
    source.run(Duration::from_millis(600)).await;
    reader.has_all_in_the_end(source.sequence).await;
    assert_eq!(source.publisher.later().dropped(), 0);
}
