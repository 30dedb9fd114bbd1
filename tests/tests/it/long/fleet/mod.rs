//! Many workers at once: what becomes of all of them while parts are killed, and how they come
//! back.
//!
//! Needs `cargo build --workspace` and `scripts/services install`.

mod kills;
mod restarts;
mod writer;

use std::path::Path;
use std::time::Duration;

use blaze_tests::fleet::{Api, MainService, Worker, WorkerSpec};
use serde_json::{Value, json};

/// The layer that all are of.
const LAYER: &str = "edge";
/// What is waited for, at most.
const PATIENCE: Duration = Duration::from_secs(60);

/// The full number, or a small one.
fn count(full: usize, small: usize) -> usize {
    if blaze_tests::long() { full } else { small }
}

fn node(number: usize) -> String {
    format!("robot-{number}")
}

/// A layer with its nodes.
async fn make_nodes(api: &Api, names: impl IntoIterator<Item = String>) {
    let mut documents = vec![json!({ "kind": "Layer", "name": LAYER, "spec": { "kind": "edge" } })];
    documents.extend(
        names
            .into_iter()
            .map(|name| json!({ "kind": "Node", "name": name, "spec": { "layer": LAYER } })),
    );
    api.apply(&documents).await.unwrap();
}

fn service(name: &str, config: &Value) -> Value {
    json!({ "kind": "Service", "name": name, "spec": { "config": config } })
}

/// Workers of the first nodes, with a copy in a file each and a broker in memory.
async fn start_workers(main: &MainService, folder: &Path, count: usize) -> Vec<Worker> {
    let mut workers = Vec::with_capacity(count);
    for number in 0..count {
        let node = node(number);
        let spec = WorkerSpec::on_memory(LAYER, &node, &main.server()).kept_in(folder.join(&node));
        workers.push(Worker::start(&spec).await.unwrap());
    }
    workers
}
