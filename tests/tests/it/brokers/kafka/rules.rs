//! The rules for all adapters.

use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use blaze_brokers::{Broker, Role};
use blaze_conformance::broker::{Capabilities, Fixture, run_all};
use blaze_tests::servers::KafkaServer;

use super::{Flow, Prepared, eventually, open, start_server};

struct Kafka {
    server: KafkaServer,
    flow: Flow,
    /// They stay.
    threads_of_flow: Vec<String>,
}

/// Threads of the adapter, and the main one of each client of the client library.
fn threads() -> Vec<String> {
    let tasks = std::fs::read_dir("/proc/self/task").unwrap();
    let names =
        tasks.filter_map(|task| std::fs::read_to_string(task.ok()?.path().join("comm")).ok());
    let mut names: Vec<String> = names
        .map(|name| name.trim().to_owned())
        .filter(|name| name == "rdk:main" || name.starts_with("kafka-"))
        .collect();
    names.sort_unstable();
    names
}

#[async_trait]
impl Fixture for Kafka {
    fn capabilities(&self) -> Capabilities {
        Capabilities {
            malformed: false,
            keeps_while_away: true,
            channels: 50,
            ..Capabilities::default()
        }
    }

    async fn broker(&self) -> Result<Arc<dyn Broker>, String> {
        Ok(Arc::new(Prepared {
            client: open(&self.server, &Role::Service),
            side: Arc::clone(&self.flow.side),
        }))
    }

    async fn stop_server(&self) -> Result<(), String> {
        self.server.kill().map_err(|error| format!("{error:#}"))
    }

    async fn start_server(&self) -> Result<(), String> {
        self.server.restart().map_err(|error| format!("{error:#}"))
    }

    async fn leftovers(&self) -> Vec<String> {
        // Threads end a moment after their tasks.
        let until = Instant::now() + Duration::from_secs(5);
        while threads() != self.threads_of_flow {
            if Instant::now() > until {
                return threads();
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        Vec::new()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn kafka_follows_the_rules() {
    let server = start_server();
    eventually("the clients of other tests are gone", async || threads().is_empty()).await;
    let flow = Flow::open(&server).await;
    let fixture = Kafka { server, flow, threads_of_flow: threads() };
    let failures = run_all(&fixture).await;
    assert!(failures.is_empty(), "{failures:#?}");
}
