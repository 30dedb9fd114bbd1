//! Follows the broker of one local scope: whether it is there, whose it is, and the leases that it
//! keeps.

use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::{Broker, BrokerStatus, FlowSide, Health};
use blaze_domain::Scope;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::Shared;
use crate::control::ScopeHealth;

/// Between attempts to read leases of a broker that does not answer.
const RETRY: Duration = Duration::from_millis(250);

/// Tells the control core of one scope's broker.
pub(super) struct ScopeTask {
    pub(super) shared: Arc<Shared>,
    pub(super) scope: Scope,
    pub(super) broker: Arc<dyn Broker>,
    /// Becomes true when it is known whether another layer has the scope; leases are not read
    /// before.
    pub(super) listened: watch::Receiver<bool>,
    pub(super) stop: CancellationToken,
}

impl ScopeTask {
    pub(super) async fn run(mut self) {
        let mut status = self.broker.status();
        let side = self.broker.flow_side();
        loop {
            let health = status.borrow_and_update().health;
            let reading = {
                let mut control = self.shared.control.lock();
                control.set_scope_health(Instant::now(), self.scope, scope_health(health));
                control.is_reading_leases(self.scope)
            };
            let load =
                load(side.as_ref().filter(|_| reading && health == Health::Up), &mut self.listened);
            tokio::select! {
                () = self.stop.cancelled() => return,
                () = changed(&mut status) => {}
                kept = load => {
                    let restored =
                        self.shared.control.lock()
                        .restore_leases(Instant::now(), self.scope, &kept);
                    let (restored, newer, foreign, skipped) =
                        (restored.restored, restored.newer, restored.foreign, restored.skipped);
                    tracing::info!(
                        scope = %self.scope,
                        restored,
                        newer,
                        foreign,
                        skipped,
                        "kept leases are read",
                    );
                }
            }
        }
    }
}

/// A change of the status; a broker that is gone changes no more.
async fn changed(status: &mut watch::Receiver<BrokerStatus>) {
    if status.changed().await.is_err() {
        std::future::pending::<()>().await;
    }
}

/// The leases that a broker keeps, however long it takes; never without a broker that keeps any.
async fn load(
    side: Option<&Arc<dyn FlowSide>>,
    listened: &mut watch::Receiver<bool>,
) -> Vec<(String, bytes::Bytes)> {
    let Some(side) = side else {
        return std::future::pending().await;
    };
    if listened.wait_for(|listened| *listened).await.is_err() {
        return std::future::pending().await;
    }
    let mut reported = false;
    loop {
        match side.load_leases().await {
            Ok(kept) => return kept,
            Err(error) if !reported => {
                reported = true;
                tracing::warn!(%error, "cannot read the kept leases, trying on");
            }
            Err(_) => {}
        }
        tokio::time::sleep(RETRY).await;
    }
}

fn scope_health(health: Health) -> ScopeHealth {
    match health {
        Health::Up => ScopeHealth::Up,
        Health::Connecting | Health::Down | Health::Closed => ScopeHealth::Away,
        Health::InUse => ScopeHealth::InUse,
    }
}
