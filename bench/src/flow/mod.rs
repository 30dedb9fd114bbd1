//! What a hop costs: Redis alone, Kafka alone, Redis to Kafka on one flow, Redis over DDS to Kafka
//! on two flows, the same where the limit leaves room for some of the messages only, all in one run
//! on one machine.
//!
//! ```text
//! source (plain client) ─► server ─► blaze-flow … ─► server ─► sink (plain client): latency, loss, rate
//!                                        └─ CPU time of the flow's process, from /proc
//! ```
//!
//! Needs `scripts/services start` (or `--redis` and `--kafka`), and is meant for release builds:
//! `cargo build --release --workspace && target/release/blaze-bench flow`.

mod clients;
mod flows;
mod load;
mod plan;

use std::time::Duration;

use anyhow::Context;
use blaze_tests::plain::{RedisReader, make_topic};
use blaze_tests::servers;
use clap::Parser;

use self::clients::{KafkaSink, KafkaSource, RedisSink, RedisSource, Sink, Source};
use self::flows::{Flows, Route};
use self::load::{Figures, Load};

/// Measures what a hop costs.
#[derive(Parser)]
pub(crate) struct Arguments {
    /// Redis server; else BLAZE_TEST_REDIS_URL of .services/env
    #[arg(long, value_name = "URL")]
    redis: Option<String>,
    /// Kafka broker; else BLAZE_TEST_KAFKA_CLOUD of .services/env
    #[arg(long, value_name = "HOST:PORT")]
    kafka: Option<String>,
    /// Measure instead what a fleet costs one flow in planning; no server is needed
    #[arg(long)]
    plan: bool,
    /// Seconds per measurement
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    /// Only paths whose name contains this
    #[arg(long, default_value = "")]
    only: String,
    /// Only loads whose name contains this
    #[arg(long, default_value = "")]
    load: String,
}

/// What is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PathKind {
    RedisAlone,
    KafkaAlone,
    OneFlow,
    TwoFlows,
    Limited,
}

/// What no load here reaches.
const UNLIMITED_MBPS: f64 = 20_000.0;
/// Where there is a limit: payload bytes that it leaves room for, of those that are published.
const ROOM: f64 = 0.6;

impl PathKind {
    const ALL: [Self; 5] =
        [Self::RedisAlone, Self::KafkaAlone, Self::OneFlow, Self::TwoFlows, Self::Limited];

    /// Whether it can be measured under a load: a limit is one of a rate.
    fn takes(self, load: Load) -> bool {
        self != Self::Limited || load.rate_hz().is_some_and(|rate| rate * load.bytes() as f64 > 1e6)
    }

    fn limit_mbps(self, load: Load) -> f64 {
        match (self, load.rate_hz()) {
            (Self::Limited, Some(rate)) => rate * load.bytes() as f64 * ROOM * 8.0 / 1_048_576.0,
            _ => UNLIMITED_MBPS,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::RedisAlone => "redis",
            Self::KafkaAlone => "kafka",
            Self::OneFlow => "redis>flow>kafka",
            Self::TwoFlows => "redis>flow>dds>flow>kafka",
            Self::Limited => "… with a limit",
        }
    }
}

pub(crate) fn run(arguments: Arguments) -> anyhow::Result<()> {
    if arguments.plan {
        return plan::run();
    }
    let redis = match arguments.redis {
        Some(url) => url,
        None => servers::address("BLAZE_TEST_REDIS_URL").context("no --redis")?,
    };
    let kafka = match arguments.kafka {
        Some(address) => address,
        None => servers::address("BLAZE_TEST_KAFKA_CLOUD").context("no --kafka")?,
    };
    let run = format!("bench-{}", std::process::id());
    let duration = Duration::from_secs_f64(arguments.seconds);
    println!(
        "{:<27} {:<25} {:>9} {:>8} {:>9} {:>9} {:>9} {:>13}  DROPPED",
        "PATH", "LOAD", "SENT", "LOST", "MSG/S", "p50/ms", "p99/ms", "FLOW us/MSG"
    );
    for kind in PathKind::ALL.into_iter().filter(|kind| kind.name().contains(&arguments.only)) {
        for load in Load::all()
            .into_iter()
            .filter(|load| kind.takes(*load) && load.name().contains(&arguments.load))
        {
            let name = format!("{run}-{kind:?}");
            let (figures, dropped) = measure(kind, &name, load, duration, &redis, &kafka)?;
            print_row(kind, load, &figures, &dropped);
        }
    }
    Ok(())
}

fn measure(
    kind: PathKind,
    run: &str,
    load: Load,
    duration: Duration,
    redis: &str,
    kafka: &str,
) -> anyhow::Result<(Figures, String)> {
    let topic = format!("bench/{}", load.name().replace([' ', '/', ','], "-"));
    let (redis_prefix, kafka_prefix) = (format!("{run}:"), format!("{run}."));
    let redis_channel = format!("{redis_prefix}{topic}");
    let kafka_topic = format!("{kafka_prefix}{}", topic.replace('/', "."));
    let flows = match kind {
        PathKind::RedisAlone => None,
        PathKind::KafkaAlone => {
            let settings = [
                ("max.message.bytes", "17825792"),
                ("retention.bytes", "268435456"),
                ("segment.bytes", "67108864"),
            ];
            make_topic(kafka, &kafka_topic, &settings)?;
            None
        }
        PathKind::OneFlow | PathKind::TwoFlows | PathKind::Limited => Some(Flows::start(&Route {
            two: kind != PathKind::OneFlow,
            limit_mbps: kind.limit_mbps(load),
            redis,
            redis_prefix: &redis_prefix,
            kafka,
            kafka_prefix: &kafka_prefix,
            topic: &topic,
            rate_hz: load.rate_hz(),
            bytes: load.bytes(),
        })?),
    };
    let mut source: Box<dyn Source> = match kind {
        PathKind::KafkaAlone => Box::new(KafkaSource::new(kafka, &kafka_topic)?),
        _ => Box::new(RedisSource::new(redis, &redis_channel, load.together())?),
    };
    let sink: Box<dyn Sink> = match kind {
        PathKind::RedisAlone => Box::new(RedisSink(RedisReader::new(redis, &redis_channel)?)),
        _ => Box::new(KafkaSink::new(kafka, &kafka_topic)?),
    };
    let cpu = || flows.as_ref().map_or(Ok(Duration::ZERO), Flows::cpu);
    let figures = load::run(load, duration, source.as_mut(), sink, &cpu)?;
    let dropped = flows.as_ref().map_or_else(|| Ok(String::new()), Flows::dropped)?;
    Ok((figures, dropped))
}

fn print_row(kind: PathKind, load: Load, figures: &Figures, dropped: &str) {
    let cpu = if matches!(kind, PathKind::OneFlow | PathKind::TwoFlows | PathKind::Limited) {
        format!("{:.1}", figures.flow_cpu_us_per_message)
    } else {
        "-".to_owned()
    };
    println!(
        "{:<27} {:<25} {:>9} {:>8} {:>9.0} {:>9.3} {:>9.3} {:>13}  {dropped}",
        kind.name(),
        load.name(),
        figures.sent,
        figures.lost,
        figures.rate_hz,
        figures.p50_ms,
        figures.p99_ms,
        cpu
    );
}
