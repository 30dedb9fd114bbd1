//! Keeps `/readyz` true to brokers and link, and does what is due every few seconds.

use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::Health;
use blaze_domain::Scope;
use blaze_runtime::admin::{CheckStatus, Gate, Readiness};
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

use super::{LocalBrokers, Shared};

/// `why` looks at what happened during the last one to two of these.
const MARK: Duration = Duration::from_secs(2);
/// How often the health of brokers and link is looked at.
const HEALTH: Duration = Duration::from_millis(200);

/// The checks of a flow, all of which fail at first.
pub(super) fn readiness(brokers: &LocalBrokers, inter: bool) -> Readiness {
    let readiness = Readiness::new();
    let there = [
        ("node_broker", brokers.node.is_some()),
        ("layer_broker", brokers.layer.is_some()),
        ("inter", inter),
    ];
    for (check, _) in there.into_iter().filter(|(_, there)| *there) {
        readiness.add(check, Gate::Decides, CheckStatus::Failed, "starting");
    }
    readiness.add("config", Gate::Shows, CheckStatus::Ok, "");
    readiness
}

/// Keeps the checks of `/readyz` true to brokers and link, until the process ends.
pub(super) async fn watch_health(shared: Arc<Shared>, ready: Arc<Notify>, stop: CancellationToken) {
    let mut listened = false;
    let mut marked = Instant::now();
    loop {
        if marked.elapsed() >= MARK {
            marked = Instant::now();
            let forgotten = shared.plane.read(|state| {
                state.core.mark();
                state.core.forget_unused(marked)
            });
            if forgotten > 0 {
                tracing::debug!(forgotten, "topics that nobody uses");
            }
            shared.tell_link();
        }
        for (check, scope) in [("node_broker", Scope::Node), ("layer_broker", Scope::Layer)] {
            let Some(broker) = shared.brokers.of(scope) else {
                continue;
            };
            let status = broker.status().borrow().clone();
            let (state, detail) = match status.health {
                Health::Up if shared.control.lock().is_reading_leases(scope) => {
                    (CheckStatus::Failed, format!("{}: reading leases", status.detail))
                }
                // A control message that is sent to a flow that is ready is heard.
                Health::Up if !shared.hears(scope) => (
                    CheckStatus::Failed,
                    format!("{}: control channel not read yet", status.detail),
                ),
                Health::Up => (CheckStatus::Ok, status.detail),
                _ => (CheckStatus::Failed, status.detail),
            };
            shared.readiness.set(check, state, detail);
        }
        if let Some(transport) = &shared.transport {
            let status = transport.status();
            let (state, detail) = match (status.ready, listened) {
                (true, true) => (CheckStatus::Ok, status.detail),
                (true, false) => (CheckStatus::Failed, "listening for other flows".to_owned()),
                (false, _) => (CheckStatus::Failed, status.detail),
            };
            shared.readiness.set("inter", state, detail);
        }
        tokio::select! {
            () = stop.cancelled() => return,
            () = tokio::time::sleep(HEALTH) => {}
            () = ready.notified() => listened = true,
        }
    }
}
