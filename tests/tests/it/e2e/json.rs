//! CDR of one layer is JSON in another.

use std::time::Duration;

use blaze_brokers::memory::MemoryHub;
use blaze_brokers::{Broker, Content, PublisherOptions, SubscribeOptions, Subscription};
use blaze_domain::LayerKind;
use blaze_runtime::Supervisor;
use blaze_tests::flow::free_domain;
use serde_json::json;

use super::drain::flow;

const DEADLINE: Duration = Duration::from_secs(20);

/// The CDR of a `std_msgs/msg/String`.
fn string(text: &str) -> Vec<u8> {
    let mut cdr = vec![0, 1, 0, 0];
    cdr.extend((text.len() as u32 + 1).to_le_bytes());
    cdr.extend(text.as_bytes());
    cdr.push(0);
    cdr
}

fn send(hub: &MemoryHub, channel: &str, payload: impl Into<bytes::Bytes>) -> anyhow::Result<()> {
    let client = hub.broker();
    let publisher = client.publisher(&channel.parse()?, PublisherOptions::default())?;
    publisher.publish_bare(&payload.into(), None);
    Ok(())
}

/// The next text, if it comes in time.
async fn next(copies: &mut Subscription, time: Duration) -> Option<String> {
    let mut batch = Vec::new();
    tokio::time::timeout(time, copies.receive(&mut batch, 1)).await.ok()?;
    match batch.pop()?.content {
        Content::Bare { payload, .. } => String::from_utf8(payload.to_vec()).ok(),
        _ => None,
    }
}

#[test]
fn cdr_of_one_layer_is_json_in_another() -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let done = runtime.block_on(convert_over_the_link());
    runtime.shutdown_background();
    done
}

async fn convert_over_the_link() -> anyhow::Result<()> {
    let domain = free_domain()?;
    let all = Supervisor::new("json");
    let (edge_hub, cloud_hub) = (MemoryHub::new("edge"), MemoryHub::new("cloud"));
    let edge = flow("edge/e", LayerKind::Edge, domain, &edge_hub, &all).await?;
    let cloud = flow("cloud/c", LayerKind::Cloud, domain, &cloud_hub, &all).await?;
    let client = cloud_hub.broker();
    let channel = "blaze/json/log".parse()?;
    let mut copies = client.subscribe(&channel, SubscribeOptions::default()).await?;
    let advertise = json!({
        "op": "advertise", "topic": "log", "service": "talker", "ttl_s": 0,
        "encoding": "application/cdr; type=std_msgs/msg/String", "reliability": "reliable",
    });
    let request = json!({
        "op": "request", "topic": "log", "service": "web", "ttl_s": 0, "json": true,
        "reliability": "reliable",
    });
    send(&edge_hub, "blaze/flow/control", advertise.to_string())?;
    send(&cloud_hub, "blaze/flow/control", request.to_string())?;
    let began = std::time::Instant::now();
    loop {
        send(&edge_hub, "log", string("first \"\u{e9}\""))?;
        if let Some(text) = next(&mut copies, Duration::from_millis(100)).await {
            assert_eq!(text, "{\"data\":\"first \\\"\u{e9}\\\"\"}");
            break;
        }
        anyhow::ensure!(began.elapsed() < DEADLINE, "no route");
    }
    // Small ones are converted at once; large ones cross the link in parts, and by the pools.
    let long =
        |n: usize| format!("{n} {}", "abc ".repeat(if n.is_multiple_of(3) { 40_000 } else { 1 }));
    for n in 0..30 {
        send(&edge_hub, "log", string(&long(n)))?;
    }
    let mut n = 0;
    while n < 30 {
        let text = next(&mut copies, DEADLINE).await;
        let text = text.ok_or_else(|| anyhow::anyhow!("{n} of 30 came"))?;
        if !text.starts_with("{\"data\":\"first") {
            assert_eq!(text, format!("{{\"data\":\"{}\"}}", long(n)));
            n += 1;
        }
    }
    edge.shutdown().await;
    cloud.shutdown().await;
    all.shutdown(Duration::from_secs(5)).await;
    Ok(())
}
