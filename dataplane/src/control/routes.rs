//! What other flows are told of this flow's routes, for their `why`.

use blaze_domain::{FlowId, Scope, WhyCode};
use blaze_proto::link::link_control::RouteState;

use super::ScopeHealth;
use crate::plan::{Bridge, Destination, Target, TopicPlan};

/// What this flow does for a topic.
pub(super) fn route_states(
    me: &FlowId,
    plan: &TopicPlan,
    health: impl Fn(Scope) -> ScopeHealth,
) -> Vec<RouteState> {
    let carried = plan.bridges.iter().map(|bridge| {
        let (to_layer, receiver) = match &bridge.to {
            Target::Inter { layer, receiver } => (layer.to_string(), receiver.to_string()),
            Target::Node(_) | Target::Layer { .. } | Target::Ros2 => {
                (me.layer.to_string(), me.to_string())
            }
        };
        let (step, code) = state_of(bridge, &health);
        RouteState {
            to_layer,
            receiver,
            step: step.to_owned(),
            ok: code == WhyCode::Ok,
            code: code.as_str().to_owned(),
            next_offset: 0,
        }
    });
    let blocked = plan.blocked.iter().map(|blocked| {
        let (to_layer, receiver) = match &blocked.to {
            Destination::Flow(flow) => (flow.layer.to_string(), flow.to_string()),
            Destination::Layer(layer) => (layer.to_string(), String::new()),
        };
        RouteState {
            to_layer,
            receiver,
            step: "plan".to_owned(),
            ok: false,
            code: blocked.code.as_str().to_owned(),
            next_offset: 0,
        }
    });
    let mut states: Vec<RouteState> = carried.chain(blocked).collect();
    // Where there are too many, what fails is told first.
    states.sort_by_key(|state| state.ok);
    states
}

/// The step that a bridge is at, and what is wrong with it.
fn state_of(bridge: &Bridge, health: impl Fn(Scope) -> ScopeHealth) -> (&'static str, WhyCode) {
    let target = bridge.to.scope();
    let step = if target == Scope::Inter { "bridge" } else { "deliver" };
    match (health(bridge.from).fault(), health(target).fault()) {
        (Some(code), _) => ("bridge", code),
        (None, Some(code)) => (step, code),
        (None, None) => (step, WhyCode::Ok),
    }
}
