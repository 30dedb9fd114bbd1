//! A service beside a worker of this process that says when it hears of what.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_sdk::{ConfigListener, ServiceManager, ServiceOptions};
use serde_json::Value;
use tokio::sync::mpsc;

use super::Worker;

/// Changes that wait for whoever looks at them.
const WAITING: usize = 4096;

/// A change that a service's callback was given.
#[derive(Debug, Clone)]
pub struct Heard {
    /// When.
    pub at: Instant,
    /// Of what it is now.
    pub revision: u64,
    /// What it is now; `None`: the service was deleted.
    pub config: Option<Arc<Value>>,
}

/// A service with a callback for its configuration. It ends when it is dropped.
pub struct Listener {
    service: ServiceManager,
    /// The first configuration is not among them.
    heard: mpsc::Receiver<Heard>,
    _callback: ConfigListener,
}

impl Listener {
    /// Starts a service on the broker of a worker; it has its configuration on return.
    ///
    /// # Errors
    /// When the worker gives it none in time.
    pub async fn start(
        worker: &Worker,
        service: &str,
        instance: &str,
        limit: Duration,
    ) -> anyhow::Result<Self> {
        let broker = worker.open_broker()?;
        let options =
            ServiceOptions::new(worker.layer().clone(), service.parse()?, broker, worker.scope());
        let options = ServiceOptions {
            instance: instance.parse()?,
            ..options.on_node(worker.node().clone())
        };
        let service = ServiceManager::start(options).await?;
        let config = service.config();
        config.ready(limit).await.with_context(|| format!("at {}", worker.node()))?;
        let first = config.revision().unwrap_or_default();
        let (tell, heard) = mpsc::channel(WAITING);
        let callback = config.on_change(move |change| {
            let heard =
                Heard { at: Instant::now(), revision: change.revision, config: change.new.clone() };
            // The first configuration may be told of only now.
            if change.revision > first {
                // Whoever does not look at 4,096 changes has gone.
                let _ = tell.try_send(heard);
            }
        });
        Ok(Self { service, heard, _callback: callback })
    }

    /// The next change.
    ///
    /// # Errors
    /// When none comes in time.
    pub async fn next(&mut self, limit: Duration) -> anyhow::Result<Heard> {
        let next = tokio::time::timeout(limit, self.heard.recv()).await;
        let who = self.service.identity();
        next.ok().flatten().with_context(|| {
            let node = who.node.as_ref().map(ToString::to_string).unwrap_or_default();
            format!("{} {} at {node:?} heard nothing within {limit:?}", who.service, who.instance)
        })
    }

    /// What has come and was not looked at.
    pub fn rest(&mut self) -> Vec<Heard> {
        std::iter::from_fn(|| self.heard.try_recv().ok()).collect()
    }

    /// The service.
    #[must_use]
    pub fn service(&self) -> &ServiceManager {
        &self.service
    }
}
