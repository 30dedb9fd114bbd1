//! The rules for all adapters.

use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use blaze_brokers::conformance::{Capabilities, Fixture, run_all};
use blaze_brokers::{Broker, Role};
use blaze_tests::servers::KafkaServer;

use super::{Flow, Prepared, open, start_server};

struct Kafka {
    server: KafkaServer,
    flow: Flow,
}

/// Threads of the adapter and of its client library, beside those of the flow's client, which stays.
fn threads() -> Vec<String> {
    let tasks = std::fs::read_dir("/proc/self/task").unwrap();
    let names = tasks.filter_map(|task| std::fs::read_to_string(task.ok()?.path().join("comm")).ok());
    names
        .map(|name| name.trim().to_owned())
        .filter(|name| name.starts_with("rdk:") || name.starts_with("kafka-") || name.starts_with("admin client"))
        .collect()
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
        // Threads end a moment after their tasks. The flow's client has: keeper, admin, sender; and librdkafka's own.
        let until = Instant::now() + Duration::from_secs(5);
        loop {
            let services: Vec<String> = threads()
                .into_iter()
                .filter(|name| name.starts_with("kafka-read") || name == "kafka-send")
                .collect();
            let keepers = threads().iter().filter(|name| *name == "kafka-keeper").count();
            if services.is_empty() && keepers <= 1 {
                return Vec::new();
            }
            if Instant::now() > until {
                return threads();
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn kafka_follows_the_rules() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    let failures = run_all(&Kafka { server, flow }).await;
    assert!(failures.is_empty(), "{failures:#?}");
}
