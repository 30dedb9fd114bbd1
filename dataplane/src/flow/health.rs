//! Keeps `/readyz` true to brokers and link, and does what is due every few seconds.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use blaze_brokers::{Broker as _, Health};
use blaze_domain::Scope;
use blaze_runtime::admin::{CheckStatus, Gate, Readiness};
use blaze_runtime::{BEAT, ticks};
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

use super::inter::InterScope;
use super::plane::wall_ms;
use super::ros2::Ros2Scope;
use super::{LocalBrokers, Shared};
use crate::control::Stage;
use crate::link::{Engine, MAX_PEERS, NameConflict};
use crate::world::FlowState;

/// `why` looks at what happened during the last one to two of these.
const MARK: Duration = Duration::from_secs(2);
/// How often the health of brokers and link is looked at.
const HEALTH: Duration = BEAT.saturating_mul(3);

/// The checks of a flow, all of which fail at first.
pub(super) fn readiness(brokers: &LocalBrokers, inter: bool) -> Readiness {
    let readiness = Readiness::new();
    let there = [
        ("node_broker", brokers.node.is_some()),
        ("layer_broker", brokers.layer.is_some()),
        ("ros2", brokers.ros2.is_some()),
        ("inter", inter),
    ];
    for (check, _) in there.into_iter().filter(|(_, there)| *there) {
        readiness.add(check, Gate::Decides, CheckStatus::Failed, "starting");
    }
    readiness.add("config", Gate::Shows, CheckStatus::Ok, "");
    readiness
}

/// Keeps the checks of `/readyz` true to brokers and link, until the process ends. `in_doubt`:
/// the next life could have the same epoch.
pub(super) async fn watch_health(
    shared: Arc<Shared>,
    ready: Arc<Notify>,
    mut in_doubt: bool,
    stop: CancellationToken,
) {
    let mut listened = false;
    let mut marked = Instant::now();
    let mut conflicts = Vec::new();
    let mut looks = ticks(HEALTH);
    loop {
        if marked.elapsed() >= MARK {
            marked = Instant::now();
            let forgotten = shared.plane.read(|state| {
                state.core.mark();
                if let Some(engine) = &state.engine {
                    state.core.keep_totals_of(|flow| engine.peer(flow).is_some());
                }
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
        if let Some(ros2) = &shared.ros2 {
            let (state, detail) = ros2_check(&shared, ros2);
            shared.readiness.set("ros2", state, detail);
        }
        show_conflicts(&shared, &mut conflicts);
        if in_doubt && wall_ms() > shared.epoch.load(Ordering::Relaxed) {
            // The next life has another epoch, whether this one is kept or not.
            in_doubt = false;
            shared.readiness.set("epoch", CheckStatus::Ok, "");
        }
        if let Some(inter) = &shared.inter {
            let (state, detail) = inter_check(&shared, inter, listened);
            shared.readiness.set("inter", state, detail);
        }
        tokio::select! {
            () = stop.cancelled() => return,
            _ = looks.tick() => {}
            () = ready.notified() => listened = true,
        }
    }
}

/// Shows flows whose name several programs have; `before` is what was shown last.
fn show_conflicts(shared: &Shared, before: &mut Vec<NameConflict>) {
    let conflicts = shared.name_conflicts();
    if conflicts == *before {
        return;
    }
    for conflict in conflicts.iter().filter(|conflict| !before.contains(conflict)) {
        tracing::warn!(conflict = conflict.detail, "give each flow a name of its own");
    }
    let is_refused = conflicts.iter().any(|conflict| conflict.is_refused);
    let state = if is_refused { CheckStatus::Failed } else { CheckStatus::Ok };
    let details: Vec<&str> = conflicts.iter().map(|conflict| conflict.detail.as_str()).collect();
    shared.readiness.set("name", state, details.join("; "));
    *before = conflicts;
}

/// What the transport says, and how many flows found no place among the peers.
fn with_refused(shared: &Shared, detail: String) -> String {
    let waiting = shared.plane.read(|state| state.engine.as_ref().map_or(0, Engine::waiting_peers));
    if waiting == 0 {
        return detail;
    }
    let refused = format!("{waiting} more flows are not reached: {MAX_PEERS} peers are the most");
    if detail.is_empty() { refused } else { format!("{detail}; {refused}") }
}

/// Whether the ROS 2 network can be used, and belongs to this layer.
fn ros2_check(shared: &Shared, ros2: &Ros2Scope) -> (CheckStatus, String) {
    if let Some(detail) = ros2.in_use(&shared.control.lock()) {
        return (CheckStatus::Failed, detail);
    }
    let status = ros2.broker.status().borrow().clone();
    let is_up = status.health == Health::Up;
    (if is_up { CheckStatus::Ok } else { CheckStatus::Failed }, status.detail)
}

/// Whether flows of other groups are reached, on the inter scope or over a gateway.
fn inter_check(shared: &Shared, inter: &InterScope, listened: bool) -> (CheckStatus, String) {
    let (stage, state, gateways) = {
        let control = shared.control.lock();
        let gateways: Vec<String> = control.gateways().map(ToString::to_string).collect();
        (control.stage(), control.state(), gateways)
    };
    let apart = !matches!(stage, Stage::Gateway | Stage::Leaving { .. });
    match inter.status().filter(|_| !apart) {
        Some(status) if status.ready && listened => {
            (CheckStatus::Ok, with_refused(shared, status.detail))
        }
        Some(status) if status.ready => {
            (CheckStatus::Failed, "listening for other flows".to_owned())
        }
        Some(status) => (CheckStatus::Failed, status.detail),
        None if state == FlowState::Starting && stage == Stage::Listening => {
            (CheckStatus::Failed, "listening for flows on the layer broker".to_owned())
        }
        None if state == FlowState::Starting => {
            let trouble = inter.trouble();
            let waits =
                if trouble.is_empty() { "listening for other flows".to_owned() } else { trouble };
            (CheckStatus::Failed, waits)
        }
        None if gateways.is_empty() => {
            let detail = "no gateway of this group lives: of the flows that share the layer broker \
                none is on the inter scope";
            (CheckStatus::Failed, detail.to_owned())
        }
        None => (CheckStatus::Ok, format!("over {}", gateways.join(", "))),
    }
}
