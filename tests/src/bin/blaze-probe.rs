//! One flow with one service on it, which publishes or listens: what `blaze demo` does not play. Tests run two of them
//! on one machine in two network namespaces; since they share a clock, the latencies are true.

use std::net::Ipv4Addr;
use std::str::FromStr;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use anyhow::Context;
use blaze_brokers::memory::MemoryHub;
use blaze_domain::node_file::{AccessRules, Chunking};
use blaze_domain::{FlowId, LayerKind, Reliability, Scope, TopicName};
use blaze_flow::flow::settings::{FlowSettings, InterSettings, LiveSettings};
use blaze_flow::flow::{FlowOptions, LayerBroker, RunningFlow};
use blaze_flow::plan::PlanRules;
use blaze_flow::world::LayerScopeId;
use blaze_runtime::Supervisor;
use blaze_sdk::{
    Advertise, Lease, Message, PublishOptions, Publisher, Request, ServiceManager, ServiceOptions, SubscribeOptions,
    Subscription,
};
use bytes::Bytes;
use clap::{Parser, ValueEnum};
use parking_lot::Mutex;

/// Latencies that are kept between two lines of output.
const MAX_LATENCIES: usize = 10_000;
/// From this size on a topic is large.
const LARGE_BYTES: usize = 65_536;

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Role {
    /// edge/probe-1
    Publish,
    /// cloud/probe-2
    Listen,
}

#[derive(Debug, Clone, Parser)]
struct Options {
    role: Role,
    /// Address of the one interface that is used
    #[arg(long)]
    listen: Ipv4Addr,
    /// The other host
    #[arg(long)]
    peer: Option<Ipv4Addr>,
    #[arg(long)]
    domain: u16,
    #[arg(long, default_value_t = 160.0)]
    limit_mbps: f64,
    /// NAME,reliable|best_effort,HZ,BYTES,LIFESPAN_MS
    #[arg(long, required = true)]
    topic: Vec<Topic>,
    /// Seconds
    #[arg(long, default_value_t = 60)]
    duration: u64,
}

#[derive(Debug, Clone)]
struct Topic {
    name: TopicName,
    reliability: Reliability,
    hz: f64,
    bytes: usize,
    lifespan: Duration,
}

impl FromStr for Topic {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Self> {
        let parts: Vec<&str> = text.split(',').collect();
        let [name, reliability, hz, bytes, lifespan] = parts[..] else {
            anyhow::bail!("{text}: NAME,reliable|best_effort,HZ,BYTES,LIFESPAN_MS is expected")
        };
        Ok(Self {
            name: name.parse()?,
            reliability: match reliability {
                "reliable" => Reliability::Reliable,
                "best_effort" => Reliability::BestEffort,
                other => anyhow::bail!("{other}: reliable or best_effort is expected"),
            },
            hz: hz.parse()?,
            bytes: bytes.parse()?,
            lifespan: Duration::from_millis(lifespan.parse()?),
        })
    }
}

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let options = Options::parse();
    let supervisor = Supervisor::new("probe");
    let hub = MemoryHub::new("probe");
    let flow = start_flow(&options, &hub, &supervisor).await?;
    let id = flow.id().clone();
    let service = ServiceOptions::new(id.layer.clone(), "probe".parse()?, Arc::new(hub.broker()), Scope::Layer);
    let service = ServiceManager::start(service.on_node(id.node.clone())).await?;
    eprintln!("ready node={} admin={}", id.node, flow.admin());
    match options.role {
        Role::Publish => publish(&service, &options).await?,
        Role::Listen => listen(&service, &options).await?,
    }
    service.shutdown().await;
    flow.shutdown().await;
    supervisor.shutdown(Duration::from_secs(1)).await;
    Ok(())
}

async fn start_flow(options: &Options, hub: &MemoryHub, supervisor: &Supervisor) -> anyhow::Result<RunningFlow> {
    let (layer, kind, node) = match options.role {
        Role::Publish => ("edge", LayerKind::Edge, "probe-1"),
        Role::Listen => ("cloud", LayerKind::Cloud, "probe-2"),
    };
    let settings = FlowSettings {
        me: FlowId::new(layer.parse()?, node.parse()?),
        kind,
        admin: (Ipv4Addr::LOCALHOST, 0).into(),
        inter: Some(InterSettings {
            domain: options.domain,
            listen: options.listen,
            peers: options.peer.into_iter().collect(),
            peer_slots: 4,
            mtu: 1500,
            chunking: Chunking::Auto,
        }),
        live: LiveSettings {
            limit_mbps: options.limit_mbps,
            large_bytes: LARGE_BYTES as u64,
            rules: PlanRules::default(),
            access: AccessRules::default(),
        },
    };
    let flow = FlowOptions {
        settings,
        node: None,
        layer: Some(LayerBroker {
            broker: Arc::new(hub.broker()),
            id: LayerScopeId::private(),
        }),
        state_dir: None,
    };
    let flow = blaze_flow::flow::start(flow, supervisor.child(node)).await?;
    tokio::time::timeout(Duration::from_secs(30), flow.ready())
        .await
        .context("the flow is not ready after 30 s")?;
    Ok(flow)
}

/// One topic that is published.
struct Source {
    publisher: Publisher,
    payload: Bytes,
    period: Duration,
    due: Instant,
    _lease: Lease,
}

async fn publish(service: &ServiceManager, options: &Options) -> anyhow::Result<()> {
    let mut sources = Vec::new();
    for topic in &options.topic {
        let terms = PublishOptions {
            reliability: topic.reliability,
            lifespan: topic.lifespan,
            large: topic.bytes >= LARGE_BYTES,
            ..PublishOptions::default()
        };
        let advertise = Advertise {
            rate_hz: Some(topic.hz),
            max_bytes: Some(topic.bytes as u64),
            reliability: topic.reliability,
            lifespan: topic.lifespan,
            ..Advertise::new(topic.name.clone())
        };
        sources.push(Source {
            publisher: service.broker().publisher(&topic.name, &terms)?,
            payload: Bytes::from(vec![7; topic.bytes]),
            period: Duration::from_secs_f64(1.0 / topic.hz),
            due: Instant::now(),
            _lease: service.flow().advertise(advertise).await?,
        });
    }
    let end = Instant::now() + Duration::from_secs(options.duration);
    while Instant::now() < end {
        let Some(next) = sources.iter_mut().min_by_key(|source| source.due) else {
            break;
        };
        tokio::time::sleep_until(next.due.into()).await;
        next.publisher.publish(next.payload.clone());
        next.due += next.period;
    }
    Ok(())
}

async fn listen(service: &ServiceManager, options: &Options) -> anyhow::Result<()> {
    let mut ears = Vec::new();
    for topic in &options.topic {
        ears.push(Ear::open(service, topic).await?);
    }
    for _ in 0..options.duration {
        tokio::time::sleep(Duration::from_secs(1)).await;
        let topics: Vec<_> = ears.iter().map(Ear::row).collect();
        println!("{}", serde_json::json!({ "kind": "row", "topics": topics }));
    }
    Ok(())
}

/// One topic that is listened to.
struct Ear {
    topic: TopicName,
    subscription: Subscription,
    latencies_us: Arc<Mutex<Vec<u64>>>,
    _lease: Lease,
}

impl Ear {
    async fn open(service: &ServiceManager, topic: &Topic) -> anyhow::Result<Self> {
        let latencies_us = Arc::new(Mutex::new(Vec::new()));
        let kept = Arc::clone(&latencies_us);
        let subscribe = SubscribeOptions {
            large: topic.bytes >= LARGE_BYTES,
            ..SubscribeOptions::default()
        };
        let heard = move |message: Message| {
            let mut kept = kept.lock();
            if kept.len() < MAX_LATENCIES {
                kept.extend(latency_us(&message));
            }
        };
        let subscription = service.broker().subscribe(&topic.name, subscribe, heard).await?;
        let request = Request {
            reliability: topic.reliability,
            lifespan: topic.lifespan,
            ..Request::new(topic.name.clone())
        };
        Ok(Self {
            topic: topic.name.clone(),
            subscription,
            latencies_us,
            _lease: service.flow().request(request).await?,
        })
    }

    /// Totals, and the latencies since the last call.
    fn row(&self) -> serde_json::Value {
        let stats = self.subscription.stats();
        serde_json::json!({
            "topic": self.topic.as_str(),
            "received": stats.delivered,
            "lost": stats.lost,
            "duplicated": stats.duplicated,
            "reordered": stats.reordered,
            "latencies_us": std::mem::take(&mut *self.latencies_us.lock()),
        })
    }
}

fn latency_us(message: &Message) -> Option<u64> {
    let on_the_way = SystemTime::now().duration_since(message.publish_time()?).ok()?;
    u64::try_from(on_the_way.as_micros()).ok()
}
