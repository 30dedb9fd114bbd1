//! What the rules `flow.access` of one flow mean for services of others.

use blaze_domain::WhyCode;
use serde_json::{Value, json};

use super::worlds::{entry, id, list, offer, request, rows, rules, topic, ways, world};
use crate::plan::{Destination, PlanRules, TopicPlan, plan_topic};
use crate::world::{Source, World};

fn plan(world: &World) -> TopicPlan {
    plan_topic(world, &topic(), &PlanRules::default(), None)
}

/// Flows, and layers, that the rules leave without the topic.
fn denied(plan: &TopicPlan) -> Vec<String> {
    let to = |to: &Destination| match to {
        Destination::Flow(flow) => flow.to_string(),
        Destination::Layer(layer) => layer.to_string(),
    };
    let denied = plan.blocked.iter().filter(|blocked| blocked.code == WhyCode::AccessDenied);
    denied.map(|blocked| to(&blocked.to)).collect()
}

fn request_rule(deny: &[&str]) -> Value {
    json!({"request": {"deny": deny}})
}

fn advertise_rule(deny: &[&str]) -> Value {
    json!({"advertise": {"deny": deny}})
}

/// Rows: the rule of the first flow | the flows | bridges of the first | whom the rule leaves
/// without the topic | name.
fn check(text: &str) {
    for [rule, lines, expected, left, name] in rows(text) {
        let words: Vec<&str> = rule.split(' ').collect();
        let mut world = world(&list(lines));
        world.access = rules(json!({words[0]: {words[1]: words[2..]}}));
        let plan = plan(&world);
        assert_eq!(ways(&plan), list(expected), "{name}: {lines}");
        assert_eq!(denied(&plan), list(left), "{name}: {lines} {:?}", plan.blocked);
    }
}

/// Leases of services are not announced: a rule that names a service fits none of another flow.
#[test]
fn requesters_of_other_flows_that_the_rules_refuse_are_not_served() {
    check(
        "
        request deny c | e/a@1 node+, c/b node- | | c/b | a node of another layer
        request deny c | e/a node+, c/b@1 layer- | | c | services of another layer
        request deny c | e/a node+, c/b node-, f/c node- | node>f/c | c/b | one of two layers
        request allow f | e/a node+, c/b node-, f/c node- | node>f/c | c/b | only one layer is allowed
        request deny c/b | e/a node+, c/b node-, c/d node- | node>c/d | c/b | one of two nodes that share nothing
        request deny c/b | e/a node+, c/b@1 node-, c/d@1 node- | node>c/d | | of one broker the other node receives
        request deny c | e/a@1 layer+, c/b node- | | c/b | what the layer publishes
        request deny e/b | e/a@1 node+, e/b@1 node- | | e/b | a node of the own layer
        request deny e/b | e/a@1, e/b@1 member node-, c/x node+ | | e/b | a member behind the gateway
        request deny c/b/spy | e/a node+, c/b node- | node>c/b | | a service of another flow
        request allow c/b/logger | e/a node+, c/b node- | | c/b | an allowed service of another flow
        request deny e/*/logger | e/a@1 node+, e/b@1 layer- | | e | a lease that only another flow granted
        request deny e/*/logger | e/a@1 node+ layer-, e/b@1 layer- | node>layer | | one that this flow granted, too
        ",
    );
}

/// Others choose who receives without knowing the rules, so a refused requester still counts among
/// those who could.
#[test]
fn a_refused_node_of_the_layer_may_be_the_one_that_receives() {
    let mut world = world(&["e/a@1 node-", "e/b@1 node-", "c/x node+"]);
    let open = ways(&plan(&world));
    world.access = rules(request_rule(&["e/b"]));
    let closed = ways(&plan(&world));
    assert!(
        closed.contains(&"layer>node".to_owned()),
        "where the other one receives, it comes from there: {closed:?}"
    );
    let expected: Vec<String> = open.into_iter().filter(|way| way != "inter>layer").collect();
    assert_eq!(closed, expected, "nothing is written for the other one");
}

/// A flow that is not on the inter scope hears that somebody outside asks, not who.
#[test]
fn to_a_member_the_origin_of_requests_from_outside_is_unknown() {
    for (rule, served) in
        [(request_rule(&["c"]), true), (json!({"request": {"allow": ["e", "c"]}}), false)]
    {
        let mut world = world(&["e/a@1 member node+", "e/g@1"]);
        let told = world.flows.get_mut(&id("e/g")).unwrap().topics.entry(topic()).or_default();
        told.outside.request = Some(request());
        world.access = rules(rule);
        let plan = plan(&world);
        assert_eq!(plan.bridges.len(), usize::from(served));
        assert_eq!(denied(&plan).len(), usize::from(!served));
    }
}

/// What a refused publisher sends all the same is dropped where it comes in.
#[test]
fn who_is_reached_by_none_but_refused_publishers_is_told() {
    check(
        "
        advertise deny c | f/a node-, c/x node+ | inter>node | f/a | a publisher of another layer
        advertise deny c | f/a@1 layer-, c/x@1 layer+ | inter>layer | f | for services of the layer
        advertise deny c | f/a node-, c/x node+, e/y node+ | inter>node | | one of two publishers
        advertise deny c | f/a node+ node-, c/x node+ | inter>node | | the own node publishes, too
        advertise allow */*/driver | f/a node-, c/x node+ | inter>node | | a service that is allowed
        advertise allow */*/joystick | f/a node-, c/x node+ | inter>node | f/a | another one is allowed
        ",
    );
}

#[test]
fn of_publishers_that_are_not_all_named_nobody_says_that_they_are_refused() {
    let source = |service: &str| Source { node: String::new(), service: service.to_owned() };
    let mut world = world(&["f/a node-", "c/x node+"]);
    world.access = rules(advertise_rule(&["c/x/driver", "c/x/filter"]));
    assert_eq!(denied(&plan(&world)), ["f/a"]);
    offer(&mut world, "c/x", "node").more_sources = true;
    assert_eq!(denied(&plan(&world)), [""; 0]);
    let told = offer(&mut world, "c/x", "node");
    (told.more_sources, told.sources) = (false, vec![source("driver"), source("filter")]);
    assert_eq!(
        denied(&plan(&world)),
        [""; 0],
        "without a header it is not known which of them it was"
    );
    entry(&mut world, "c/x", "node").advertise = None;
    assert_eq!(denied(&plan(&world)), [""; 0]);
}
