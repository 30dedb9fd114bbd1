//! A flow that is stopped lets out what is queued before it says Goodbye.

use std::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use blaze_brokers::memory::MemoryHub;
use blaze_domain::node_file::{BandwidthSection, Chunking, FlowSection};
use blaze_domain::{FlowId, LayerKind, Reliability, Scope, TopicName};
use blaze_flow::flow::settings::{FlowSettings, InterSettings, LiveSettings};
use blaze_flow::flow::{FlowOptions, LayerBroker, RunningFlow};
use blaze_flow::world::LayerScopeId;
use blaze_runtime::Supervisor;
use blaze_sdk::{
    Advertise, PublishOptions, Request, ServiceManager, ServiceOptions, SubscribeOptions,
};
use blaze_tests::admin::Admin;
use blaze_tests::flow::free_domain;
use blaze_tests::wait;
use bytes::Bytes;

/// At 8 Mbit/s (1 MiB/s) these take 0.3 s, half of what a flow has to drain.
const MESSAGES: usize = 30;
const BYTES: usize = 10_000;
const LIMIT_MBPS: f64 = 8.0;

async fn flow(
    name: &str,
    kind: LayerKind,
    domain: u16,
    hub: &MemoryHub,
    all: &Supervisor,
) -> anyhow::Result<RunningFlow> {
    let me: FlowId = name.parse()?;
    let settings = FlowSettings {
        gateway: blaze_domain::node_file::AutoBool::Auto,
        me: me.clone(),
        kind,
        admin: (Ipv4Addr::LOCALHOST, 0).into(),
        inter: Some(InterSettings {
            domain,
            listen: Ipv4Addr::LOCALHOST,
            peers: Vec::new(),
            peer_slots: 4,
            mtu: 1500,
            chunking: Chunking::Mtu,
        }),
        ros2: None,
        live: LiveSettings::from(&FlowSection {
            bandwidth: BandwidthSection { limit_mbps: LIMIT_MBPS, ..BandwidthSection::default() },
            ..FlowSection::default()
        }),
    };
    let layer = LayerBroker { broker: Arc::new(hub.broker()), id: LayerScopeId::private() };
    let options = FlowOptions { settings, node: None, layer: Some(layer), state_dir: None };
    let flow = blaze_flow::flow::start(options, all.child(name)).await?;
    tokio::time::timeout(Duration::from_secs(30), flow.ready()).await?;
    Ok(flow)
}

async fn service(
    name: &str,
    flow: &RunningFlow,
    hub: &MemoryHub,
) -> anyhow::Result<ServiceManager> {
    let options = ServiceOptions::new(
        flow.id().layer.clone(),
        name.parse()?,
        Arc::new(hub.broker()),
        Scope::Layer,
    );
    Ok(ServiceManager::start(options).await?)
}

/// Messages that the flow's bridges to the inter scope have taken in.
fn taken(admin: &Admin) -> u64 {
    let bridges = admin.json("/v1/bridges").unwrap_or_default();
    let rows = bridges["bridges"].as_array().cloned().unwrap_or_default();
    let to_inter = rows.iter().filter(|row| row["to"]["scope"] == "inter");
    to_inter.filter_map(|row| row["in"]["messages"].as_u64()).sum()
}

#[test]
fn what_is_queued_arrives_before_the_goodbye() -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let stopped = runtime.block_on(stop_with_a_full_queue());
    // All has ended that was to end; a thread that hangs is not waited for.
    runtime.shutdown_background();
    stopped
}

async fn stop_with_a_full_queue() -> anyhow::Result<()> {
    let domain = free_domain()?;
    let all = Supervisor::new("drain");
    let (edge_hub, cloud_hub) = (MemoryHub::new("edge"), MemoryHub::new("cloud"));
    let edge = flow("edge/leaves", LayerKind::Edge, domain, &edge_hub, &all).await?;
    let cloud = flow("cloud/stays", LayerKind::Cloud, domain, &cloud_hub, &all).await?;
    let talker = service("talker", &edge, &edge_hub).await?;
    let listener = service("listener", &cloud, &cloud_hub).await?;
    let topic: TopicName = "work".parse()?;

    let received = Arc::new(AtomicUsize::new(0));
    let count = Arc::clone(&received);
    let heard = move |_| {
        count.fetch_add(1, Ordering::Relaxed);
    };
    let _ear = listener.broker().subscribe(&topic, SubscribeOptions::default(), heard).await?;
    let request = Request { reliability: Reliability::Reliable, ..Request::new(topic.clone()) };
    let _wants = listener.flow().request(request).await?;
    let advertise =
        Advertise { reliability: Reliability::Reliable, ..Advertise::new(topic.clone()) };
    let _has = talker.flow().advertise(advertise).await?;
    let reliable =
        PublishOptions { reliability: Reliability::Reliable, ..PublishOptions::default() };
    let publisher = talker.broker().publisher(&topic, &reliable)?;

    let admin = Admin { address: edge.admin(), namespace: None };
    let payload = Bytes::from(vec![1; BYTES]);
    let flows = || {
        publisher.publish(payload.clone());
        received.load(Ordering::Relaxed) > 0
    };
    wait::until("the route", Duration::from_secs(20), flows, || {
        format!("{:?}", admin.json("/v1/bridges"))
    })?;

    let before = taken(&admin);
    for _ in 0..MESSAGES {
        publisher.publish(payload.clone());
    }
    let all_in = || taken(&admin) >= before + MESSAGES as u64;
    wait::until("all messages to be taken in", Duration::from_secs(5), all_in, || {
        format!("{}", taken(&admin))
    })?;
    let expected = usize::try_from(taken(&admin))?;
    edge.drain().await;

    let state = || format!("{} of {expected} arrived", received.load(Ordering::Relaxed));
    wait::until(
        "everything that was queued when the flow was stopped",
        Duration::from_secs(5),
        || received.load(Ordering::Relaxed) >= expected,
        state,
    )?;
    cloud.shutdown().await;
    all.shutdown(Duration::from_secs(5)).await;
    Ok(())
}
