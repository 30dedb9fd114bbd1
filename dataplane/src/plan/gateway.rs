//! Which flows of a large group are on the inter scope for the others.
//!
//! ```text
//! up to 16 flows:  each is on the inter scope            above: four are, and stay while they live
//!   a ═══ inter        `gateway: true` always is,          a, b, c, d ═══ inter
//!   b ═══ inter        `gateway: false` never              e … z ── layer scope ── a, b, c, d
//! ```
//!
//! The choice is a pure function of what a flow hears on the channel of its layer broker. Flows
//! that hear the same choose the same; where they do not, there are a few more gateways than
//! needed, or the next look makes up for it.

use blaze_domain::FlowId;
use blaze_domain::node_file::AutoBool;

use super::{Group, rendezvous};
use crate::world::{FlowState, FlowView, Reach, Role, World};

/// Up to this many flows of a group are on the inter scope all.
pub const ALL_UP_TO: usize = 16;
/// So many are in a larger group …
pub const GATEWAYS: usize = 4;
/// … and none that is one gives it up while there are no more than this.
pub const MOST_GATEWAYS: usize = 8;

/// Whether a flow is to be on the inter scope for its group.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Choice {
    /// It is needed there, or the node file says so.
    Needed,
    /// The group is small enough for all, though others would do.
    Welcome,
    /// Others are, or the node file says no.
    No,
}

/// Whether the flow `world.me` is to be on the inter scope.
#[must_use]
pub fn choose(world: &World) -> Choice {
    let Some(own) = world.own() else {
        return Choice::No;
    };
    match own.gateway {
        // Nobody is there to do it for a flow that shares nothing.
        _ if own.layer_scope.is_none() => return Choice::Needed,
        AutoBool::Yes => return Choice::Needed,
        AutoBool::No => return Choice::No,
        AutoBool::Auto => {}
    }
    let group: Vec<(&FlowId, &FlowView)> = living(world).collect();
    let of = |setting: AutoBool| group.iter().filter(move |(_, view)| view.gateway == setting);
    let always = of(AutoBool::Yes).count();
    let (now, others): (Vec<_>, Vec<_>) =
        of(AutoBool::Auto).partition(|(_, view)| view.role.is_gateway());
    let wanted = GATEWAYS.saturating_sub(always);
    let key = world.me.layer.as_str();
    let among = |flows: &[&(&FlowId, &FlowView)], places: usize| {
        let ids = flows.iter().map(|(id, _)| *id);
        rendezvous::best(key, ids, places).contains(&&world.me)
    };
    let needed = if own.role.is_gateway() {
        always + now.len() <= MOST_GATEWAYS || among(&now, wanted)
    } else {
        among(&others, wanted.saturating_sub(now.len()))
    };
    match (needed, group.len() <= ALL_UP_TO) {
        (true, _) => Choice::Needed,
        (false, true) => Choice::Welcome,
        (false, false) => Choice::No,
    }
}

/// Flows of the own group, itself among them, that are on the inter scope for it and carry topics.
pub fn gateways(world: &World) -> impl Iterator<Item = &FlowId> {
    let carries =
        |(_, view): &(&FlowId, &FlowView)| view.role.is_gateway() && view.state == FlowState::Ready;
    living(world).filter(carries).map(|(id, _)| id)
}

/// Flows of the own group, itself among them, that are not on the inter scope and carry topics
/// within the layer.
pub fn members(world: &World) -> impl Iterator<Item = &FlowId> {
    let carries = |(_, view): &(&FlowId, &FlowView)| {
        view.role == Role::Member && view.state == FlowState::Ready
    };
    living(world).filter(carries).map(|(id, _)| id)
}

/// Whether the own flow speaks for flows that are not on the inter scope.
pub(crate) fn speaks_for_others(world: &World) -> bool {
    world.own().is_some_and(|own| own.role.is_gateway()) && members(world).next().is_some()
}

/// Flows of the own group that live and are not going away.
fn living(world: &World) -> impl Iterator<Item = (&FlowId, &FlowView)> {
    let own = world.flows.get_key_value(&world.me);
    let group = own.map(|(id, view)| Group::of(id, view));
    world.flows.iter().filter(move |(id, view)| {
        Some(Group::of(id, view)) == group
            && (**id == world.me
                || (view.reach != Reach::Down && view.state != FlowState::Draining))
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use blaze_domain::node_file::AccessRules;

    use super::*;
    use crate::plan::tests::worlds::flow;

    /// A group of so many flows, all of which hear each other, none on the inter scope.
    fn group(count: usize) -> BTreeMap<FlowId, FlowView> {
        let name = |n: usize| format!("cloud/c-{n}").parse().unwrap();
        let view = || FlowView { role: Role::Member, ..flow(Some(1)) };
        (0..count).map(|n| (name(n), view())).collect()
    }

    fn choices(flows: &BTreeMap<FlowId, FlowView>) -> BTreeMap<FlowId, Choice> {
        let choice = |me: &FlowId| {
            choose(&World { me: me.clone(), flows: flows.clone(), access: AccessRules::default() })
        };
        flows.keys().map(|me| (me.clone(), choice(me))).collect()
    }

    /// Every flow does what it chose; who joins is counted.
    fn follow(flows: &mut BTreeMap<FlowId, FlowView>) -> usize {
        let mut changes = 0;
        for (flow, choice) in choices(flows) {
            let role = match choice {
                Choice::No => Role::Member,
                Choice::Needed | Choice::Welcome => Role::Gateway,
            };
            let view = flows.get_mut(&flow).unwrap();
            changes += usize::from(view.role != role);
            view.role = role;
        }
        changes
    }

    fn gateways_of(flows: &BTreeMap<FlowId, FlowView>) -> Vec<FlowId> {
        let are = flows.iter().filter(|(_, view)| view.role.is_gateway());
        are.map(|(id, _)| id.clone()).collect()
    }

    #[test]
    fn small_groups_are_on_the_inter_scope_all_and_of_large_ones_four() {
        for count in [1, 2, 16, 17, 20, 100, 1000] {
            let mut flows = group(count);
            follow(&mut flows);
            let expected = if count <= ALL_UP_TO { count } else { GATEWAYS };
            assert_eq!(gateways_of(&flows).len(), expected, "{count} flows");
            assert_eq!(follow(&mut flows), 0, "{count} flows: what is chosen stays");
        }
    }

    #[test]
    fn one_that_goes_is_replaced_and_the_others_stay() {
        let mut flows = group(20);
        follow(&mut flows);
        for _ in 0..16 {
            let before = gateways_of(&flows);
            let victim = before[0].clone();
            flows.get_mut(&victim).unwrap().reach = Reach::Down;
            flows.get_mut(&victim).unwrap().role = Role::Member;
            let alive: BTreeMap<_, _> = flows.clone();
            let changed = choices(&alive);
            let stay = before[1..].iter().all(|flow| changed[flow] == Choice::Needed);
            assert!(stay, "a gateway that lives was given up");
            for (flow, choice) in changed {
                let lives = flows[&flow].reach != Reach::Down;
                if lives && choice == Choice::Needed {
                    flows.get_mut(&flow).unwrap().role = Role::Gateway;
                }
            }
            assert_eq!(gateways_of(&flows).len(), GATEWAYS);
        }
    }

    #[test]
    fn a_group_that_grows_keeps_four_and_those_between_four_and_eight_stay() {
        let mut flows = group(16);
        follow(&mut flows);
        let mut grown = group(17);
        grown.append(&mut flows);
        let mut flows = grown;
        follow(&mut flows);
        assert_eq!((flows.len(), gateways_of(&flows).len()), (17, GATEWAYS));
        for extra in 0..4 {
            let member =
                flows.iter().find(|(_, view)| view.role == Role::Member).unwrap().0.clone();
            flows.get_mut(&member).unwrap().role = Role::Gateway;
            assert_eq!(follow(&mut flows), 0, "{} gateways are no more than eight", extra + 5);
        }
    }

    #[test]
    fn what_the_node_file_says_holds_in_groups_of_any_size() {
        for count in [2, 30] {
            let mut flows = group(count);
            for view in flows.values_mut() {
                view.gateway = AutoBool::No;
            }
            assert!(choices(&flows).values().all(|choice| *choice == Choice::No), "nobody may");
            let first = flows.keys().next().unwrap().clone();
            flows.get_mut(&first).unwrap().gateway = AutoBool::Yes;
            follow(&mut flows);
            assert_eq!(gateways_of(&flows), [first]);
        }
        let mut flows = group(20);
        for view in flows.values_mut().take(6) {
            view.gateway = AutoBool::Yes;
        }
        follow(&mut flows);
        assert_eq!(gateways_of(&flows).len(), 6, "with six that always are no other is needed");
    }

    #[test]
    fn a_flow_that_shares_no_broker_is_not_concerned() {
        let mut flows = group(1);
        let (id, view) = flows.pop_first().unwrap();
        let view = FlowView { layer_scope: None, gateway: AutoBool::No, ..view };
        flows.insert(id.clone(), view);
        assert_eq!(choices(&flows)[&id], Choice::Needed);
    }
}
