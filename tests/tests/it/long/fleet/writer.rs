//! Somebody who changes documents of every kind: creates, updates, deletes, and makes anew under
//! the same name at once.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use blaze_tests::fleet::{Api, Told};
use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use reqwest::Method;
use serde_json::{Value, json};

use super::{LAYER, service};

/// Services of one writer.
pub(super) const SERVICES: usize = 6;
/// Nodes of one writer on which no worker runs.
const NODES: usize = 3;
/// Before a writer tries again that was not told yes.
const PAUSE: Duration = Duration::from_millis(20);

/// Counts writes for all writers.
#[derive(Debug)]
pub(super) struct Progress {
    done: AtomicUsize,
    unknown: AtomicUsize,
    refused: AtomicUsize,
    goal: usize,
    /// Why a write was refused that must not be; then all end.
    fault: OnceLock<String>,
}

impl Progress {
    pub(super) fn new(goal: usize) -> Self {
        Self {
            done: AtomicUsize::new(0),
            unknown: AtomicUsize::new(0),
            refused: AtomicUsize::new(0),
            goal,
            fault: OnceLock::new(),
        }
    }

    /// Why a write was refused that must not be.
    pub(super) fn fault(&self) -> Option<&String> {
        self.fault.get()
    }

    /// Writes that took effect, of those known to have.
    pub(super) fn done(&self) -> usize {
        self.done.load(Ordering::Acquire)
    }

    /// Writes of which nobody knows, and those that made no sense any more after one of them.
    pub(super) fn others(&self) -> (usize, usize) {
        (self.unknown.load(Ordering::Acquire), self.refused.load(Ordering::Acquire))
    }
}

/// A writer. Nobody else changes its services and nodes; overrides of nodes with workers are shared
/// out.
pub(super) struct Writer {
    api: Api,
    number: usize,
    /// Nodes with workers whose overrides it changes.
    nodes: Vec<String>,
    progress: Arc<Progress>,
    random: StdRng,
    count: u64,
}

impl Writer {
    pub(super) fn new(
        api: Api,
        number: usize,
        nodes: Vec<String>,
        progress: Arc<Progress>,
    ) -> Self {
        Self {
            api,
            number,
            nodes,
            progress,
            random: StdRng::seed_from_u64(number as u64),
            count: 0,
        }
    }

    /// Writes until all writers together have written enough.
    pub(super) async fn run(mut self) {
        while self.progress.done() < self.progress.goal && self.progress.fault().is_none() {
            self.write().await;
        }
    }

    async fn write(&mut self) {
        self.count += 1;
        let count = self.count;
        let name = service_name(self.number, self.random.random_range(0..SERVICES));
        let node = self.nodes[self.random.random_range(0..self.nodes.len())].clone();
        match self.random.random_range(0..100) {
            0..35 => self.apply(&[service(&name, &json!({ "count": count }))]).await,
            35..55 => {
                let spec = json!({ "node": node, "config": { "of_instance": count } });
                let instance =
                    json!({ "kind": "Instance", "service": name, "name": "0", "spec": spec });
                // The service may be away.
                self.apply(&[service(&name, &json!({ "with": count })), instance]).await;
            }
            55..70 => {
                let spec = json!({ "layer": LAYER, "overrides": { name: { "of_node": count } } });
                self.apply(&[json!({ "kind": "Node", "name": node, "spec": spec })]).await;
            }
            70..78 => {
                let spec = json!({
                    "kind": "edge",
                    "config": { "of_layer": format!("{}-{count}", self.number) },
                });
                self.apply(&[json!({ "kind": "Layer", "name": LAYER, "spec": spec })]).await;
            }
            78..84 => {
                let name = format!("spare-{}-{}", self.number, self.random.random_range(0..NODES));
                if self.random.random_bool(0.5) {
                    let spec = json!({ "layer": LAYER, "config": { "spare": count } });
                    self.apply(&[json!({ "kind": "Node", "name": name, "spec": spec })]).await;
                } else {
                    self.delete(&format!("/nodes/{name}")).await;
                }
            }
            84..92 => self.delete(&format!("/services/{name}?cascade=true")).await,
            _ => {
                self.delete(&format!("/services/{name}?cascade=true")).await;
                self.apply(&[service(&name, &json!({ "anew": count }))]).await;
            }
        }
    }

    async fn apply(&self, documents: &[Value]) {
        let body = Value::Array(documents.to_vec());
        self.insist(Method::POST, "/apply", Some(&body)).await;
    }

    /// What is not there counts as a write that made no sense.
    async fn delete(&self, path: &str) {
        self.insist(Method::DELETE, path, None).await;
    }

    /// Tries until it is done, or nobody knows whether it is.
    async fn insist(&self, method: Method, path: &str, body: Option<&Value>) {
        loop {
            match self.api.send(method.clone(), path, body).await {
                Told::Done(_) => {
                    self.progress.done.fetch_add(1, Ordering::AcqRel);
                    return;
                }
                Told::Unknown(_) => {
                    self.progress.unknown.fetch_add(1, Ordering::AcqRel);
                    tokio::time::sleep(PAUSE).await;
                    return;
                }
                // It is deleted already.
                Told::Refused { status: 404 | 412, .. } if method == Method::DELETE => {
                    self.progress.refused.fetch_add(1, Ordering::AcqRel);
                    return;
                }
                Told::NotNow(_) => tokio::time::sleep(PAUSE).await,
                refused @ Told::Refused { .. } => {
                    self.progress.fault.get_or_init(|| format!("{method} {path}: {refused:?}"));
                    return;
                }
            }
        }
    }
}

/// The n-th service of a writer.
pub(super) fn service_name(writer: usize, number: usize) -> String {
    format!("w{writer}-{number}")
}
