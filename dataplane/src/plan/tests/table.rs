//! One row per rule.

use blaze_domain::node_file::{TopicRule, TopicValues};
use blaze_domain::{Durability, Priority, Reliability, Scope, WhyCode};

use super::worlds::{ask, entry, filter, id, list, offer, rows, topic, ways, world};
use crate::plan::{
    Delivery, Destination, Form, PlanRules, Target, TopicPlan, delivery, owner, plan_topic,
};
use crate::world::{Reach, Source, World};

fn plan(world: &World) -> TopicPlan {
    plan_topic(world, &topic(), &PlanRules::default(), None)
}

/// Rows: a rule | flows | bridges of the first one.
const RULES: &str = "
    a pair on one node needs no bridge | e/a node+ node- |
    a bare request on the same node gets a copy | e/a node+ node-b | node>bare
    a pair on the layer scope needs no bridge | e/a@1 layer+ layer- |
    an advertisement alone makes nothing | e/a@1 node+, c/b@1 |
    a request alone makes nothing | e/a@1 node-, c/b@1 |
    node to layer for a service there | e/a@1 node+ layer- | node>layer
    node to layer for another node of the layer | e/a@1 node+, e/b@1 node- | node>layer
    that node takes it from the layer | e/b@1 node-, e/a@1 node+ | layer>node
    layer to node for what the layer publishes | e/a@1 layer+ node- | layer>node
    bare from the layer | e/a@1 layer+ node-b | layer>bare
    node to another layer | e/a@1 node+, c/b node- | node>c/b
    that layer takes it to its node | c/b node-, e/a@1 node+ | inter>node
    that layer takes it to its bare node | c/b node-b, e/a@1 node+ | inter>bare
    that layer takes it to its layer scope | c/b@1 layer-, e/a@1 node+ | inter>layer
    node and layer of the receiver | c/b@1 node- layer-, e/a node+ | inter>node, inter>layer
    the layer publishes for another layer | e/a@1 layer+, c/b node- | layer>c/b
    one copy per layer that asks | e/a node+, c/b@1 layer-, f/c node- | node>c/b, node>f/c
    no layer broker in common: over the inter scope | e/a@1 node+, e/b@2 node- | node>e/b
    no layer broker at all: over the inter scope | e/a node+, e/b node-, e/c node- | node>e/b, node>e/c
    same broker number in another layer is another broker | e/a@1 node+, c/b@1 node- | node>c/b
    a flow that is down receives nothing | e/a node+, c/b@1 down node- |
    a suspect one stays a receiver | e/a node+, c/b@1 suspect node- | node>c/b
    a starting one is no receiver | e/a node+, c/b@1 starting node- |
    a draining one is no receiver | e/a node+, c/b@1 draining node- |
    nothing while starting | e/a@1 starting node+ node-b layer-, c/b node- |
    nothing while draining | e/a@1 draining node+ layer-, c/b node- node+ |
    a draining publisher sends nothing to take in | c/b node-, e/a draining node+ |
    what was told of oneself does not count | e/a down node+, c/b node- | node>c/b
    a requester of the own layer is no way out | e/a@1 node-, e/b@1 layer-, c/c@1 layer- |
";

#[test]
fn bridges_of_each_rule() {
    for [rule, lines, expected] in rows(RULES) {
        assert_eq!(ways(&plan(&world(&list(lines)))), list(expected), "{rule}: {lines}");
    }
}

/// The same world as another flow sees it.
fn seen_by(world: &World, flow: &str) -> World {
    World { me: id(flow), ..world.clone() }
}

#[test]
fn one_replica_owns_a_topic_of_the_layer_and_one_receives_it() {
    let world = world(&["f/a@1 layer+", "f/b@1 layer+", "c/x@1 layer-", "c/y@1 layer-"]);
    let all: Vec<_> =
        ["f/a", "f/b", "c/x", "c/y"].map(|flow| ways(&plan(&seen_by(&world, flow)))).concat();
    assert_eq!(all.len(), 2, "one sends, one receives: {all:?}");
    let receiver = all[0].strip_prefix("layer>").unwrap();
    assert_eq!(ways(&plan(&seen_by(&world, receiver))), ["inter>layer"]);
    let owner = owner(&world, &topic()).unwrap();
    assert_eq!(ways(&plan(&seen_by(&world, &owner.to_string()))).len(), 1);
}

#[test]
fn a_flow_with_a_requester_of_its_own_receives_for_the_layer() {
    let with_request = world(&["e/a node+", "c/u@1", "c/v@1", "c/w@1 node-", "c/x@1", "c/y@1"]);
    assert_eq!(ways(&plan(&with_request)), ["node>c/w"]);
    let mut two = world(&["e/a node+", "c/v@1 node-", "c/w@1 node-"]);
    let chosen = ways(&plan(&two))[0].clone();
    let (receiver, other) = if chosen == "node>c/v" { ("c/v", "c/w") } else { ("c/w", "c/v") };
    // The receiver keeps the way from the layer too: a sender with an earlier choice may stay with
    // the other one.
    assert_eq!(ways(&plan(&seen_by(&two, receiver))), ["layer>node", "inter>node", "inter>layer"]);
    assert_eq!(ways(&plan(&seen_by(&two, other))), ["layer>node"]);
    // Only the other one asks for this publisher: it is the receiver.
    ask(&mut two, receiver, "node").from = vec![filter("c/*/*")];
    assert_eq!(ways(&plan(&two)), [format!("node>{other}")]);
}

#[test]
fn a_receiver_stays_when_a_better_one_joins() {
    let mut world = world(&["e/a node+", "c/v@1 node-", "c/w@1 node-"]);
    let chosen = plan(&world).bridges[0].to.clone();
    let Target::Inter { receiver, .. } = &chosen else { panic!("{chosen:?}") };
    let best = world.flows.remove(receiver).unwrap();
    let second = plan(&world);
    world.flows.insert(receiver.clone(), best);
    let again = |world: &World| plan_topic(world, &topic(), &PlanRules::default(), Some(&second));
    assert_eq!(again(&world), second, "the flow that joins takes nothing over");
    let Target::Inter { receiver: other, .. } = &second.bridges[0].to else { panic!("{second:?}") };
    world.flows.get_mut(other).unwrap().reach = Reach::Down;
    assert_eq!(again(&world).bridges[0].to, chosen, "a receiver that is down is left");
    world.flows.get_mut(other).unwrap().reach = Reach::Up;
    world.flows.get_mut(other).unwrap().topics.clear();
    assert_eq!(again(&world).bridges[0].to, chosen, "so is one that has no requester any more");
}

#[test]
fn filters_decide_who_is_connected() {
    // filter of c/b, listed service, more than that, node that the layer's source names, connected
    let rows = [
        ("*/*/*", "driver", false, "", true),
        ("e/*/*", "driver", false, "", true),
        ("f/*/*", "driver", true, "", false),
        ("*/a/*", "driver", false, "a", true),
        ("*/b/*", "driver", false, "a", false),
        ("*/*/driver", "driver", false, "", true),
        ("*/*/other", "driver", false, "", false),
        ("*/*/other", "driver", true, "", true),
        ("e/a/driver", "driver", false, "a", true),
    ];
    for (text, service, more_sources, node, connected) in rows {
        for scope in ["node", "layer"] {
            let mut world = world(&["e/a@1 node+ layer+", "c/b node-"]);
            entry(&mut world, "e/a", if scope == "node" { "layer" } else { "node" }).advertise =
                None;
            let offer = offer(&mut world, "e/a", scope);
            offer.more_sources = more_sources;
            offer.sources = vec![Source { node: node.to_owned(), service: service.to_owned() }];
            ask(&mut world, "c/b", "node").from = vec![filter("nowhere/*/*"), filter(text)];
            let plan = plan(&world);
            assert_eq!(plan.bridges.len(), usize::from(connected), "{text} {scope}");
            let codes: Vec<_> = plan.blocked.iter().map(|blocked| blocked.code).collect();
            assert_eq!(
                codes,
                vec![WhyCode::NoMatchingOrigin; usize::from(!connected)],
                "{text} {scope}"
            );
        }
    }
}

#[test]
fn a_layer_service_without_a_node_matches_no_filter_by_node() {
    let mut world = world(&["e/a@1 layer+", "c/b node-"]);
    ask(&mut world, "c/b", "node").from = vec![filter("e/a/*")];
    assert!(plan(&world).bridges.is_empty());
}

#[test]
fn filters_hold_inside_a_layer_too_and_lanes_carry_their_union() {
    let mut world = world(&["e/a@1 node+", "e/b@1 node-", "e/c@1 node- layer-"]);
    ask(&mut world, "e/b", "node").from = vec![filter("e/b/*")];
    assert!(ways(&plan(&seen_by(&world, "e/b"))).is_empty(), "its filter matches nobody");
    ask(&mut world, "e/b", "node").from = vec![filter("e/a/*"), filter("c/*/*")];
    ask(&mut world, "e/c", "node").from = vec![filter("e/*/*")];
    ask(&mut world, "e/c", "layer").from = vec![filter("e/a/*")];
    let plan = plan(&world);
    assert_eq!(plan.bridges[0].lane.from, [filter("c/*/*"), filter("e/*/*"), filter("e/a/*")]);
    ask(&mut world, "e/c", "layer").from.clear();
    assert_eq!(super::table::plan(&world).bridges[0].lane.from, []);
}

#[test]
fn types_that_both_give_must_agree() {
    for (offered, asked, connected) in [
        ("", "", true),
        ("a/A", "", true),
        ("", "a/A", true),
        ("a/A", "a/A", true),
        ("a/A", "b/B", false),
    ] {
        for hash in [false, true] {
            let mut world = world(&["e/a node+", "c/b node-"]);
            let (offer_type, ask_type) = (offered.to_owned(), asked.to_owned());
            if hash {
                offer(&mut world, "e/a", "node").type_hash = offer_type;
                ask(&mut world, "c/b", "node").type_hash = ask_type;
            } else {
                offer(&mut world, "e/a", "node").type_name = offer_type;
                ask(&mut world, "c/b", "node").type_name = ask_type;
            }
            for flow in ["e/a", "c/b"] {
                let plan = plan(&seen_by(&world, flow));
                assert_eq!(plan.bridges.len(), usize::from(connected));
                assert_eq!(plan.blocked.len(), usize::from(!connected));
                for blocked in &plan.blocked {
                    assert_eq!(
                        (blocked.code, &blocked.to),
                        (WhyCode::TypeMismatch, &Destination::Flow(id("c/b")))
                    );
                    assert_eq!(blocked.detail, "e/a advertises a/A, c/b requests b/B");
                }
            }
        }
    }
}

#[test]
fn who_is_blocked_is_said_once_by_those_who_have_a_part_in_it() {
    let mut world = world(&["e/a node+", "c/b@1 layer-", "c/d down node-", "f/f node+"]);
    ask(&mut world, "c/b", "layer").from = vec![filter("x/*/*")];
    let codes = |flow: &str| -> Vec<_> {
        let plan = plan(&seen_by(&world, flow));
        plan.blocked.into_iter().map(|blocked| (blocked.to, blocked.code)).collect()
    };
    let layer = Destination::Layer("c".parse().unwrap());
    let flow = Destination::Flow(id("c/d"));
    assert_eq!(
        codes("e/a"),
        [(flow, WhyCode::PeerDown), (layer.clone(), WhyCode::NoMatchingOrigin)]
    );
    assert_eq!(codes("c/b"), [(layer, WhyCode::NoMatchingOrigin)]);
}

#[test]
fn reliable_and_durable_need_both_sides() {
    use {Durability as D, Reliability as R};
    for (offered, asked, carried) in [
        (R::BestEffort, R::BestEffort, false),
        (R::Reliable, R::BestEffort, false),
        (R::Reliable, R::Reliable, true),
        (R::BestEffort, R::Reliable, false),
    ] {
        let mut world = world(&["e/a node+", "c/b node-"]);
        offer(&mut world, "e/a", "node").reliability = offered;
        ask(&mut world, "c/b", "node").reliability = asked;
        let lane = plan(&world).bridges[0].lane.clone();
        assert_eq!((lane.reliable, lane.durable), (carried, false));

        let durability = |r| {
            if r == R::Reliable { D::TransientLocal } else { D::Volatile }
        };
        let mut world = super::worlds::world(&["e/a node+", "c/b node-"]);
        offer(&mut world, "e/a", "node").durability = durability(offered);
        ask(&mut world, "c/b", "node").durability = durability(asked);
        let lane = plan(&world).bridges[0].lane.clone();
        assert_eq!((lane.reliable, lane.durable), (false, carried));
    }
}

#[test]
fn a_lane_carries_the_most_that_anybody_behind_it_asks_for() {
    let mut world = world(&["e/a node+", "c/b@1 node-", "c/c@1 node-"]);
    offer(&mut world, "e/a", "node").depth = 5;
    for (rates, lane) in [((Some(10.0), Some(5.0)), Some(10.0)), ((Some(10.0), None), None)] {
        ask(&mut world, "c/b", "node").max_rate_hz = rates.0;
        ask(&mut world, "c/c", "node").max_rate_hz = rates.1;
        assert_eq!(plan(&world).bridges[0].lane.max_rate_hz, lane);
    }
    for (offered, asked, lane) in [
        (0, (0, 0), 0),
        (0, (100, 500), 500),
        (300, (100, 500), 300),
        (300, (100, 200), 200),
        (300, (100, 0), 300),
        (0, (100, 0), 0),
    ] {
        offer(&mut world, "e/a", "node").lifespan_ms = offered;
        ask(&mut world, "c/b", "node").lifespan_ms = asked.0;
        ask(&mut world, "c/c", "node").lifespan_ms = asked.1;
        assert_eq!(plan(&world).bridges[0].lane.lifespan_ms, lane, "{offered} {asked:?}");
    }
    for (asked, lane) in [((1, 1), 1), ((1, 3), 3), ((9, 3), 5), ((0, 0), 1)] {
        ask(&mut world, "c/b", "node").depth = asked.0;
        ask(&mut world, "c/c", "node").depth = asked.1;
        assert_eq!(plan(&world).bridges[0].lane.depth, lane, "{asked:?}");
    }
}

#[test]
fn a_request_lowers_the_class_and_never_raises_it() {
    use Priority::{Bulk, Control, State};
    for (offered, asked, lane) in [
        (None, (None, None), None),
        (None, (Some(Control), Some(Control)), None),
        (None, (Some(Bulk), Some(Bulk)), Some(Bulk)),
        (Some(Control), (None, None), Some(Control)),
        (Some(Control), (Some(Bulk), None), Some(Control)),
        (Some(Control), (Some(Bulk), Some(State)), Some(State)),
        (Some(State), (Some(Control), Some(Bulk)), Some(State)),
        (Some(Bulk), (Some(Control), Some(Control)), Some(Bulk)),
    ] {
        let mut world = world(&["e/a node+", "c/b@1 node-", "c/c@1 node-"]);
        offer(&mut world, "e/a", "node").priority = offered;
        ask(&mut world, "c/b", "node").priority = asked.0;
        ask(&mut world, "c/c", "node").priority = asked.1;
        assert_eq!(plan(&world).bridges[0].lane.priority, lane, "{offered:?} {asked:?}");
    }
}

#[test]
fn the_operator_bounds_rate_and_lifespan_and_sets_the_class() {
    let mut world = world(&["e/a node+", "c/b node-"]);
    let rule = |pattern: &str, values: TopicValues| TopicRule {
        pattern: pattern.parse().unwrap(),
        values,
    };
    let fast = TopicValues {
        priority: Some(Priority::State),
        max_rate_hz: Some(100.0),
        ..TopicValues::default()
    };
    let imu = TopicValues {
        priority: Some(Priority::Control),
        max_rate_hz: Some(15.0),
        ..TopicValues::default()
    };
    let short = TopicValues { lifespan_ms: Some(500), ..TopicValues::default() };
    // What one rule leaves open, a later one that matches too may say.
    let rules = PlanRules {
        topics: vec![
            rule("camera/**", fast),
            rule("imu/*", imu),
            rule("**", short),
            rule("imu/**", fast),
        ],
    };
    for (rate, lifespan, expected) in
        [(None, 0, (15.0, 500)), (Some(20.0), 900, (15.0, 500)), (Some(5.0), 100, (5.0, 100))]
    {
        let request = ask(&mut world, "c/b", "node");
        (request.max_rate_hz, request.lifespan_ms, request.priority) =
            (rate, lifespan, Some(Priority::Bulk));
        let lane = plan_topic(&world, &topic(), &rules, None).bridges[0].lane.clone();
        assert_eq!((lane.max_rate_hz, lane.lifespan_ms), (Some(expected.0), expected.1));
        assert_eq!(lane.priority, Some(Priority::Control));
    }
}

#[test]
fn what_arrives_is_delivered_whether_chosen_or_not() {
    let world = world(&["e/a node+", "c/v@1 node-", "c/w@1 node-b"]);
    let at = |flow: &str| -> Delivery {
        delivery(&seen_by(&world, flow), &topic(), &PlanRules::default())
    };
    let there = |d: &Delivery| -> Vec<Target> { d.keys().cloned().collect() };
    let layer = || Target::Layer { json: false };
    assert_eq!(there(&at("c/v")), [Target::Node(Form::Framed), layer()]);
    assert_eq!(there(&at("c/w")), [Target::Node(Form::Bare), layer()]);
    assert!(at("e/a").is_empty());
    for flow in ["c/v", "c/w"] {
        for bridge in
            plan(&seen_by(&world, flow)).bridges.iter().filter(|bridge| bridge.from == Scope::Inter)
        {
            assert_eq!(
                at(flow).get(&bridge.to),
                Some(&bridge.lane),
                "a bridge is what is delivered anyway"
            );
        }
    }
}

#[test]
fn a_world_without_its_own_flow_plans_nothing() {
    let mut world = world(&["e/a node+", "c/b node-"]);
    world.me = id("x/y");
    assert_eq!(plan(&world), TopicPlan::default());
    assert_eq!(delivery(&world, &topic(), &PlanRules::default()), Delivery::default());
    assert_eq!(owner(&world, &topic()), None);
}
