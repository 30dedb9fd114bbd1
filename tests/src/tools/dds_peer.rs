//! A reader of one topic of a DDS domain in a process of its own, which tests kill or hold still:
//! either with the product's adapter, or as a plain DDS program that knows nothing but
//! `brokers/idl/blaze_frame.idl`.

use std::net::Ipv4Addr;
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use blaze_brokers::dds::layer::DdsBroker;
use blaze_brokers::{Broker, Content, Health, SubscribeOptions};
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::DdsLayerBroker;
use bytes::Bytes;
use clap::{Parser, ValueEnum};
use parking_lot::Mutex;
use rustdds::policy::{History, Reliability, ResourceLimits};
use rustdds::{DomainParticipantBuilder, QosPolicyBuilder, TopicKind};
use serde::{Deserialize, Serialize};

/// Between two lines of output.
const REPORT: Duration = Duration::from_millis(100);
/// Samples that a plain reader keeps until they are taken: older ones give way, also reliable ones,
/// so it is as many as a writer keeps. On a busy machine 512 of them, sent 2,000 times a second,
/// are not enough.
const DEPTH: i32 = 8192;

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Kind {
    /// The product's adapter.
    Adapter,
    /// A plain DDS program.
    Plain,
}

#[derive(Debug, Clone, Parser)]
pub(crate) struct Options {
    kind: Kind,
    /// Domain, on loopback
    #[arg(long)]
    domain: u16,
    #[arg(long)]
    topic: ChannelName,
    /// Messages may be large
    #[arg(long)]
    large: bool,
    /// A plain program asks for reliable writers
    #[arg(long)]
    reliable: bool,
}

/// `module blaze { module v1 { @final struct Frame { sequence<octet> data; }; }; };`
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Frame {
    #[serde(with = "serde_bytes")]
    data: Vec<u8>,
}

/// What was received of the one writer.
#[derive(Debug, Default)]
struct Seen {
    received: u64,
    first: u64,
    last: u64,
    lost: u64,
    reordered: u64,
    malformed: u64,
    at: Option<Instant>,
    longest_gap: Duration,
}

impl Seen {
    fn take(&mut self, content: &Content) {
        let now = Instant::now();
        let Content::Frame(frame) = content else {
            self.malformed += 1;
            return;
        };
        let sequence = frame.sequence();
        self.received += 1;
        if let Some(at) = self.at.replace(now) {
            self.longest_gap = self.longest_gap.max(now.duration_since(at));
        }
        if self.first == 0 {
            self.first = sequence;
        } else if sequence <= self.last {
            self.reordered += 1;
        } else {
            self.lost += sequence - self.last - 1;
        }
        self.last = self.last.max(sequence);
    }

    fn line(&self) -> String {
        serde_json::json!({
            "received": self.received, "first": self.first, "last": self.last, "lost": self.lost,
            "reordered": self.reordered, "malformed": self.malformed,
            "gap_ms": self.longest_gap.as_secs_f64() * 1e3,
        })
        .to_string()
    }
}

#[tokio::main]
pub(crate) async fn run(options: &Options) -> anyhow::Result<()> {
    let seen = Arc::<Mutex<Seen>>::default();
    let told = Arc::clone(&seen);
    thread::Builder::new().name("report".into()).spawn(move || {
        loop {
            println!("{}", told.lock().line());
            thread::sleep(REPORT);
        }
    })?;
    match options.kind {
        Kind::Adapter => adapter(options, &seen).await,
        Kind::Plain => plain(options, &seen),
    }
}

async fn adapter(options: &Options, seen: &Mutex<Seen>) -> anyhow::Result<()> {
    let broker = DdsBroker::open(&DdsLayerBroker {
        domain: options.domain,
        interface: Ipv4Addr::LOCALHOST,
    })?;
    broker.status().wait_for(|status| status.health == Health::Up).await?;
    let subscribe = SubscribeOptions { large: options.large, ..SubscribeOptions::default() };
    let mut subscription = broker.subscribe(&options.topic, subscribe).await?;
    let mut batch = Vec::new();
    while subscription.receive(&mut batch, 64).await > 0 {
        let mut seen = seen.lock();
        for received in batch.drain(..) {
            seen.take(&received.content);
        }
    }
    Ok(())
}

fn plain(options: &Options, seen: &Mutex<Seen>) -> anyhow::Result<()> {
    let reliability = if options.reliable {
        Reliability::Reliable { max_blocking_time: rustdds::Duration::ZERO }
    } else {
        Reliability::BestEffort
    };
    let qos = QosPolicyBuilder::new()
        .reliability(reliability)
        .history(History::KeepLast { depth: DEPTH })
        .resource_limits(ResourceLimits {
            max_samples: DEPTH,
            max_instances: 1,
            max_samples_per_instance: DEPTH,
        })
        .build();
    let participant = DomainParticipantBuilder::new(options.domain)
        .with_only_networks([Ipv4Addr::LOCALHOST])
        .build()?;
    let name = if options.topic.is_reserved() {
        options.topic.to_string()
    } else {
        format!("bt/{}", options.topic)
    };
    let topic =
        participant.create_topic(name, "blaze::v1::Frame".to_owned(), &qos, TopicKind::NoKey)?;
    let mut reader = participant
        .create_subscriber(&qos)?
        .create_datareader_no_key_cdr::<Frame>(&topic, Some(qos))?;
    loop {
        while let Some(sample) = reader.take_next_sample()? {
            let data = sample.into_value().data;
            seen.lock().take(&Content::from_bytes(Bytes::from(data)));
        }
        thread::sleep(Duration::from_millis(1));
    }
}
