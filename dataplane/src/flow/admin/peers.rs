//! `GET /v1/peers`: the other flows, over the inter scope and on the layer broker.

use std::time::{Duration, Instant};

use axum::Json;
use axum::extract::State;
use blaze_domain::FlowId;
use blaze_domain::node_file::AutoBool;
use serde_json::{Value, json};

use super::super::inter::InterScope;
use super::{App, answer, rounded};
use crate::control::ControlCore;
use crate::link::MAX_PEERS;
use crate::world::{Carrying, Reach};

pub(super) async fn peers(State(shared): App) -> Json<Value> {
    let now = Instant::now();
    let (peers, refused) = shared.plane.read(|state| {
        let engine = state.engine.as_ref();
        engine.map(|engine| (engine.peers(), engine.waiting_peers())).unwrap_or_default()
    });
    let control = shared.control.lock();
    let rows: Vec<Value> = peers
        .iter()
        .map(|peer| {
            json!({
                "flow": peer.flow, "layer": peer.flow.layer, "kind": peer.kind, "epoch": peer.epoch,
                "version": peer.version, "state": peer.state,
                "last_heard_ms": peer.last_heard
                    .map(|at| rounded(now.saturating_duration_since(at).as_secs_f64() * 1e3)),
                "rtt_ms": peer.rtt.map(|rtt| rounded(rtt.as_secs_f64() * 1e3)),
                "clock_offset_ms": peer.clock_offset_ns.map(|ns| rounded(ns as f64 / 1e6)),
                "clock_error_ms": peer.clock_error.map(|error| rounded(error.as_secs_f64() * 1e3)),
                "loss": rounded(peer.loss), "address": control.address_of(&peer.flow),
                "in_step": control.registry().is_in_step_with(&peer.flow),
                "outstanding_bytes": peer.outstanding_bytes, "window_bytes": peer.window_bytes,
                "queue_bytes": peer.queue_bytes,
                "receiving_bytes_per_s": peer.receiving_bytes_per_s.round(),
                "queueing_delay_ms": rounded(peer.queueing_delay.as_secs_f64() * 1e3),
                "capacity": peer.capacity.map(|capacity| json!({
                    "state": capacity.state, "bytes_per_s": capacity.bytes_per_s.round(),
                    "measured_bytes_per_s": capacity.measured_bytes_per_s.map(f64::round),
                })),
            })
        })
        .collect();
    let replicas: Vec<Value> =
        control.registry().replicas(now).map(|row| replica_row(&control, row)).collect();
    let gateways: Vec<&FlowId> = control.gateways().collect();
    let own = control.world().own();
    let gateway = json!({
        "setting": own.map(|own| setting(own.gateway)), "stage": control.stage().as_str(),
        "gateways": gateways,
    });
    drop(control);
    let status = shared.inter.as_ref().and_then(InterScope::status);
    let link = status.map(|status| {
        json!({
            "endpoints": status.endpoints, "addresses": status.addresses,
            "participants_rebuilt": status.rebuilds,
            "most_peers": MAX_PEERS, "refused": refused,
        })
    });
    answer(&shared, json!({"peers": rows, "replicas": replicas, "gateway": gateway, "link": link}))
}

/// A flow that shares the layer broker, as it is heard there.
fn replica_row(control: &ControlCore, (flow, silent): (&FlowId, Duration)) -> Value {
    let view = control.world().flows.get(flow);
    let state = view.map(|view| match view.reach {
        Reach::Down => json!("down"),
        Reach::Up | Reach::Suspect => json!(view.state),
    });
    let parts = view.iter().flat_map(|view| view.parts.values());
    let carries = parts.filter(|part| part.carrying == Carrying::Carries).count();
    json!({
        "flow": flow, "epoch": view.map(|view| view.epoch), "state": state,
        "settled": view.is_some_and(|view| view.settled),
        "last_heard_ms": rounded(silent.as_secs_f64() * 1e3),
        "in_step": control.registry().is_in_step_with(flow), "carries": carries,
        "load": control.registry().load_of(flow).map(|load| json!({
            "out_bytes_per_s": load.out_bytes_per_s, "in_bytes_per_s": load.in_bytes_per_s,
            "limit_bytes_per_s": (load.limit_bytes_per_s > 0).then_some(load.limit_bytes_per_s),
        })),
        "role": view.map(|view| if view.role.is_gateway() { "gateway" } else { "member" }),
        "gateway": view.map(|view| setting(view.gateway)),
    })
}

/// As it stands in the node file.
fn setting(gateway: AutoBool) -> Value {
    match gateway {
        AutoBool::Auto => json!("auto"),
        AutoBool::Yes => json!(true),
        AutoBool::No => json!(false),
    }
}
