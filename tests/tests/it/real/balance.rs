//! A second cloud flow comes to one that carries eight topics of unequal weight to a robot: they share them by measured load,
//! and no message is lost, repeated or overtaken.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use blaze_proto::Frame;
use blaze_tests::flow::{FlowProcess, FlowSpec, free_domain};
use blaze_tests::ledger::{Fate, Ledger};
use blaze_tests::plain::{self, KafkaReader, KafkaWriter, RedisReader};
use blaze_tests::servers::{shared_kafka, shared_redis, unique_name};
use blaze_tests::wait;
use bytes::Bytes;
use parking_lot::Mutex;
use serde_json::{Value, json};

use crate::real::support::SOON;

/// Bytes of a message and messages per second: 20 to 160 KiB/s, 600 KiB/s in all.
const STREAMS: [(usize, u32); 8] = [
    (8192, 20),
    (4096, 30),
    (4096, 20),
    (4096, 20),
    (2048, 30),
    (2048, 20),
    (2048, 20),
    (1024, 20),
];
/// Until they have shared the topics: 5 s until the new one has settled, 13 s for each move, on a busy machine.
const EVEN_WITHIN: Duration = Duration::from_secs(120);
/// So long nothing moves any more.
const QUIET: Duration = Duration::from_secs(20);

/// A thread that publishes all streams, and one for each that listens.
struct Streams {
    logs: Vec<Arc<Mutex<Ledger>>>,
    publishing: Arc<AtomicBool>,
    listening: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Streams {
    fn start(kafka: &str, kafka_prefix: &str, redis: &str, redis_prefix: &str) -> anyhow::Result<Self> {
        let logs: Vec<Arc<Mutex<Ledger>>> = STREAMS.iter().map(|_| Arc::default()).collect();
        let (publishing, listening) = (Arc::new(AtomicBool::new(true)), Arc::new(AtomicBool::new(true)));
        let mut threads = Vec::new();
        for (number, log) in logs.iter().enumerate() {
            let mut reader = RedisReader::new(redis, &format!("{redis_prefix}{}", topic(number)))?;
            let (log, listening) = (Arc::clone(log), Arc::clone(&listening));
            threads.push(std::thread::spawn(move || {
                while listening.load(Ordering::Relaxed) {
                    if let Ok(Some(payload)) = reader.poll()
                        && let Ok(frame) = Frame::parse(Bytes::from(payload))
                    {
                        let identity = (frame.writer().to_string(), frame.sequence());
                        log.lock().take(identity, frame.payload(), Instant::now());
                    }
                }
            }));
        }
        let names: Vec<String> = (0..STREAMS.len())
            .map(|number| format!("{kafka_prefix}{}", topic(number).replace('/', ".")))
            .collect();
        for name in &names {
            // Made by the flow when the advertise was accepted.
            drop(KafkaReader::from_end(kafka, name)?);
        }
        let writer = KafkaWriter::new(kafka)?;
        let (sinks, on) = (logs.clone(), Arc::clone(&publishing));
        threads.push(std::thread::spawn(move || {
            let begin = Instant::now();
            while on.load(Ordering::Relaxed) {
                for ((name, log), (bytes, hz)) in names.iter().zip(&sinks).zip(STREAMS) {
                    let due = (begin.elapsed().as_secs_f64() * f64::from(hz)) as u64;
                    let mut log = log.lock();
                    while log.last_published().unwrap_or(0) < due {
                        let number = log.last_published().unwrap_or(0) + 1;
                        let payload = format!("{number} {}", ".".repeat(bytes));
                        if writer.produce_later(name, payload.as_bytes()).is_err() {
                            break;
                        }
                        log.publish(number, Instant::now());
                    }
                }
                std::thread::sleep(Duration::from_millis(5));
            }
        }));
        Ok(Self {
            logs,
            publishing,
            listening,
            threads,
        })
    }

    /// Waits until what was published up to now has come on every stream.
    fn wait_fresh(&self) -> anyhow::Result<()> {
        let wanted: Vec<Option<u64>> = self.logs.iter().map(|log| log.lock().last_published()).collect();
        let behind = || {
            let pairs = self.logs.iter().zip(&wanted);
            pairs
                .filter(|(log, wanted)| log.lock().last_arrived() <= **wanted)
                .count()
        };
        wait::until(
            "all streams arrive",
            SOON,
            || behind() == 0,
            || format!("{} do not", behind()),
        )?;
        Ok(())
    }

    /// Stops publishing, waits for the last message, and counts from each stream's first on.
    fn finish(&self) -> anyhow::Result<Vec<Fate>> {
        self.publishing.store(false, Ordering::Relaxed);
        let ends = || -> Vec<(Option<u64>, Option<u64>)> {
            let of = |log: &Arc<Mutex<Ledger>>| {
                let log = log.lock();
                (log.last_published(), log.last_arrived())
            };
            self.logs.iter().map(of).collect()
        };
        wait::until(
            "the last messages arrive",
            SOON,
            || ends().iter().all(|(published, arrived)| published == arrived),
            || format!("{:?}", ends()),
        )?;
        let fate = |log: &Arc<Mutex<Ledger>>| {
            let log = log.lock();
            let first = log.arrived().first().map_or(1, |(number, _)| *number);
            log.fate(|number, _| number >= first)
        };
        Ok(self.logs.iter().map(fate).collect())
    }
}

impl Drop for Streams {
    fn drop(&mut self) {
        self.publishing.store(false, Ordering::Relaxed);
        self.listening.store(false, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

fn topic(number: usize) -> String {
    format!("stream/{number}")
}

/// What a flow says of its own load and moves.
fn balance(flow: &FlowProcess) -> Value {
    let listed = flow.admin().json("/v1/bridges").unwrap_or_default();
    listed["balance"].clone()
}

fn out(flow: &FlowProcess) -> u64 {
    balance(flow)["out_bytes_per_s"].as_u64().unwrap_or(0)
}

fn moves(flow: &FlowProcess) -> [u64; 3] {
    let moves = &balance(flow)["moves"];
    ["load", "settled", "taken_back"].map(|reason| moves[reason].as_u64().unwrap_or(0))
}

/// Streams that a flow carries out of the cloud.
fn carried(flow: &FlowProcess) -> BTreeSet<usize> {
    let up = flow.bridges_up();
    let carries = |number: &usize| {
        let start = format!("{}|layer>inter|edge", topic(*number));
        up.iter().any(|id| id.starts_with(&start))
    };
    (0..STREAMS.len()).filter(carries).collect()
}

/// What these streams weigh, in bytes per second.
fn weight(streams: &BTreeSet<usize>) -> u64 {
    let weigh = |(bytes, hz): (usize, u32)| bytes as u64 * u64::from(hz);
    streams.iter().map(|number| weigh(STREAMS[*number])).sum()
}

#[test]
fn a_second_flow_gets_its_share_of_the_load() -> anyhow::Result<()> {
    let (redis, kafka) = (shared_redis()?, shared_kafka()?);
    let run = unique_name("balance");
    let (redis_prefix, kafka_prefix) = (format!("{run}:"), format!("{run}."));
    let domain = free_domain()?;
    let cloud = |node: &str| {
        FlowSpec::new("cloud", node)
            .on_kafka(&kafka, &kafka_prefix)
            .joined(domain)
    };
    let robot = FlowSpec::new("edge", "robot-1")
        .on_redis(&redis, &redis_prefix)
        .joined(domain);
    let (mut robot, mut first) = (FlowProcess::launch(robot)?, FlowProcess::launch(cloud("cloud-1"))?);
    robot.wait_ready()?;
    first.wait_ready()?;
    let lease = |op: &str, number: usize| json!({"op":op,"topic":topic(number),"service":"test","reliability":"reliable","ttl_s":0});
    let writer = KafkaWriter::new(&kafka)?;
    for number in 0..STREAMS.len() {
        plain::tell_redis(&redis, &redis_prefix, &lease("request", number))?;
        plain::tell_kafka(&writer, &kafka_prefix, &lease("advertise", number))?;
    }
    wait::until(
        "one flow carries all",
        SOON,
        || carried(&first).len() == STREAMS.len(),
        || format!("{:?}", first.bridges()),
    )?;
    let streams = Streams::start(&kafka, &kafka_prefix, &redis, &redis_prefix)?;
    streams.wait_fresh()?;
    let total = weight(&(0..STREAMS.len()).collect());
    wait::until(
        "its load is measured",
        SOON,
        || out(&first) > total * 8 / 10,
        || format!("{} of {total}", out(&first)),
    )?;

    let mut second = FlowProcess::launch(cloud("cloud-2"))?;
    second.wait_ready()?;
    let state = || {
        format!(
            "{:?} {:?}\n{}\n{}",
            carried(&first),
            carried(&second),
            first.tail(),
            second.tail()
        )
    };
    let even = || {
        let (one, other) = (carried(&first), carried(&second));
        let (most, least) = (weight(&one).max(weight(&other)), weight(&one).min(weight(&other)));
        one.len() + other.len() == STREAMS.len() && (most * 8 <= total * 5 || most - least <= 64 * 1024)
    };
    let took = wait::until("the load is shared", EVEN_WITHIN, even, state)?;
    let before = [moves(&first), moves(&second)];
    let until = Instant::now() + QUIET;
    wait::until(
        "nothing moves any more",
        SOON + QUIET,
        || Instant::now() > until,
        String::new,
    )?;
    let measured = [out(&first), out(&second)];
    println!(
        "even after {took:?}: moves {before:?}, weights {} and {}, measured {measured:?}",
        weight(&carried(&first)),
        weight(&carried(&second))
    );
    assert_eq!(
        [moves(&first), moves(&second)].map(|moves| moves[0]),
        before.map(|moves| moves[0]),
        "{}",
        state()
    );
    assert!(before[0][0] >= 1 && before[1][0] == 0, "{before:?}");
    // Measured: not above a quarter more than the mean, give or take what a busy machine does to rates.
    let (most, mean) = (measured[0].max(measured[1]), (measured[0] + measured[1]) / 2);
    assert!(most * 10 <= mean * 14, "{measured:?}");
    let last = balance(&first)["last_move"].clone();
    assert_eq!(
        (&last["to"], &last["reason"]),
        (&json!("cloud/cloud-2"), &json!("load")),
        "{last}"
    );
    let fates = streams.finish()?;
    println!("{fates:?}");
    for fate in fates {
        let sent = fate.sent;
        assert_eq!(
            fate,
            Fate {
                sent,
                ..Fate::default()
            },
            "{}",
            state()
        );
    }
    Ok(())
}
