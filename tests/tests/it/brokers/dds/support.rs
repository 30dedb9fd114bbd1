//! Domains, participants, and plain DDS programs.

use std::net::Ipv4Addr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use blaze_brokers::dds::layer::{DdsBroker, MAX_QUEUE_BYTES};
use blaze_brokers::{Broker, Health};
use blaze_conformance::broker::{Capabilities, Fixture};
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::DdsLayerBroker as Section;
use blaze_proto::Frame;
use blaze_tests::flow::free_domain;

pub(super) use super::super::support::{DEADLINE, WITH_KEPT, eventually, wait_for};

/// A DDS domain on loopback that no other test uses now.
pub(super) struct Domain {
    pub(super) id: u16,
    /// Threads of participants that other tests made hang.
    before: Vec<String>,
}

impl Domain {
    pub(super) fn start() -> Self {
        Self { id: free_domain().unwrap(), before: own_threads() }
    }

    pub(super) fn section(&self) -> Section {
        Section { domain: self.id, interface: Ipv4Addr::LOCALHOST }
    }

    /// A participant that stands.
    pub(super) async fn open(&self) -> DdsBroker {
        let broker = DdsBroker::open(&self.section()).unwrap();
        wait_for(&broker, Health::Up).await;
        broker
    }
}

#[async_trait]
impl Fixture for Domain {
    fn capabilities(&self) -> Capabilities {
        Capabilities {
            // There is no server that could go away.
            outage: false,
            finds_readers_late: true,
            clocks_apart: Duration::from_millis(30),
            queue_bytes: MAX_QUEUE_BYTES,
            channels: 100,
            // A best-effort sample of more fragments is lost as a whole too often on a busy
            // machine.
            largest_payload: 8_000_000,
            ..Capabilities::default()
        }
    }

    async fn broker(&self) -> Result<Arc<dyn Broker>, String> {
        match DdsBroker::open(&self.section()) {
            Ok(broker) => Ok(Arc::new(broker)),
            Err(error) => Err(error.to_string()),
        }
    }

    async fn stop_server(&self) -> Result<(), String> {
        Err("there is no server".to_owned())
    }

    async fn start_server(&self) -> Result<(), String> {
        Err("there is no server".to_owned())
    }

    async fn leftovers(&self) -> Vec<String> {
        let until = Instant::now() + DEADLINE;
        loop {
            let mut threads = own_threads();
            threads.retain(|thread| !self.before.contains(thread));
            if threads.is_empty() || Instant::now() > until {
                return threads;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }
}

/// Threads of participants in this process: number and name.
fn own_threads() -> Vec<String> {
    let names = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    names
        .filter_map(|task| {
            let name = std::fs::read_to_string(task.path().join("comm")).ok()?;
            let is_ours = name.starts_with("dds-") || name.starts_with("RustDDS");
            is_ours.then(|| format!("{} {}", task.file_name().display(), name.trim()))
        })
        .collect()
}

pub(super) fn frame(channel: &ChannelName, writer: u8, sequence: u64, bytes: usize) -> Frame {
    super::super::support::frame(channel.as_str(), writer, sequence, bytes)
}
