//! What the rules `flow.access` of one flow mean for services of others.

use blaze_domain::WhyCode;
use serde_json::{Value, json};

use super::worlds::{entry, id, offer, request, rules, topic, world};
use crate::plan::{Destination, PlanRules, Target, TopicPlan, plan_topic};
use crate::world::{Source, World};

fn plan(world: &World) -> TopicPlan {
    plan_topic(world, &topic(), &PlanRules::default(), None)
}

/// `node>layer`, `inter>node`, `node>cloud/c`: the bridges of a plan.
fn ways(plan: &TopicPlan) -> Vec<String> {
    let way = |bridge: &crate::plan::Bridge| match &bridge.to {
        Target::Node { .. } => format!("{}>node", bridge.from),
        Target::Layer => format!("{}>layer", bridge.from),
        Target::Inter { receiver, .. } => format!("{}>{receiver}", bridge.from),
    };
    plan.bridges.iter().map(way).collect()
}

/// Flows, and layers, that the rules leave without the topic.
fn denied(plan: &TopicPlan) -> Vec<String> {
    let to = |to: &Destination| match to {
        Destination::Flow(flow) => flow.to_string(),
        Destination::Layer(layer) => layer.to_string(),
    };
    let denied = plan
        .blocked
        .iter()
        .filter(|blocked| blocked.code == WhyCode::AccessDenied);
    denied.map(|blocked| to(&blocked.to)).collect()
}

fn request_rule(deny: &[&str]) -> Value {
    json!({"request": {"deny": deny}})
}

fn advertise_rule(deny: &[&str]) -> Value {
    json!({"advertise": {"deny": deny}})
}

/// A case: its name, the rules of the first flow, the flows, its bridges, whom the rules leave without the topic.
type Row<'a> = (&'a str, Value, &'a [&'a str], &'a [&'a str], &'a [&'a str]);

fn check(rows: &[Row<'_>]) {
    for (name, rule, lines, expected, left) in rows {
        let mut world = world(lines);
        world.access = rules(rule.clone());
        let plan = plan(&world);
        assert_eq!(ways(&plan), *expected, "{name}: {lines:?}");
        assert_eq!(denied(&plan), *left, "{name}: {lines:?} {:?}", plan.blocked);
    }
}

#[test]
fn requesters_of_other_flows_that_the_rules_refuse_are_not_served() {
    check(&[
        (
            "a node of another layer",
            request_rule(&["c"]),
            &["e/a@1 node+", "c/b node-"],
            &[],
            &["c/b"],
        ),
        (
            "services of another layer",
            request_rule(&["c"]),
            &["e/a node+", "c/b@1 layer-"],
            &[],
            &["c"],
        ),
        (
            "one of two layers",
            request_rule(&["c"]),
            &["e/a node+", "c/b node-", "f/c node-"],
            &["node>f/c"],
            &["c/b"],
        ),
        (
            "only one layer is allowed",
            json!({"request": {"allow": ["f"]}}),
            &["e/a node+", "c/b node-", "f/c node-"],
            &["node>f/c"],
            &["c/b"],
        ),
        (
            "one of two nodes that share nothing",
            request_rule(&["c/b"]),
            &["e/a node+", "c/b node-", "c/d node-"],
            &["node>c/d"],
            &["c/b"],
        ),
        (
            "one of two nodes that share a broker: the other one receives, and everybody there may read it",
            request_rule(&["c/b"]),
            &["e/a node+", "c/b@1 node-", "c/d@1 node-"],
            &["node>c/d"],
            &[],
        ),
        (
            "what the layer publishes",
            request_rule(&["c"]),
            &["e/a@1 layer+", "c/b node-"],
            &[],
            &["c/b"],
        ),
        (
            "a node of the own layer",
            request_rule(&["e/b"]),
            &["e/a@1 node+", "e/b@1 node-"],
            &[],
            &["e/b"],
        ),
        (
            "a member that the gateway takes in for",
            request_rule(&["e/b"]),
            &["e/a@1", "e/b@1 member node-", "c/x node+"],
            &[],
            &["e/b"],
        ),
        (
            "nobody tells services, so a rule against one of another flow fits none",
            request_rule(&["c/b/spy"]),
            &["e/a node+", "c/b node-"],
            &["node>c/b"],
            &[],
        ),
        (
            "nor does one that allows a service",
            json!({"request": {"allow": ["c/b/logger"]}}),
            &["e/a node+", "c/b node-"],
            &[],
            &["c/b"],
        ),
        (
            "a service of the own layer that another flow granted and this one did not",
            request_rule(&["e/*/logger"]),
            &["e/a@1 node+", "e/b@1 layer-"],
            &[],
            &["e"],
        ),
        (
            "a service of the own layer that this one granted, too",
            request_rule(&["e/*/logger"]),
            &["e/a@1 node+ layer-", "e/b@1 layer-"],
            &["node>layer"],
            &[],
        ),
    ]);
}

/// Others choose who receives without knowing the rules, so a refused requester still counts among those who could.
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
    for (rule, served) in [
        (request_rule(&["c"]), true),
        (json!({"request": {"allow": ["e", "c"]}}), false),
    ] {
        let mut world = world(&["e/a@1 member node+", "e/g@1"]);
        let told = world
            .flows
            .get_mut(&id("e/g"))
            .unwrap()
            .topics
            .entry(topic())
            .or_default();
        told.outside.request = Some(request());
        world.access = rules(rule);
        let plan = plan(&world);
        assert_eq!(plan.bridges.len(), usize::from(served));
        assert_eq!(denied(&plan).len(), usize::from(!served));
    }
}

#[test]
fn who_is_reached_by_none_but_refused_publishers_is_told() {
    let allow = |service: &str| json!({"advertise": {"allow": [format!("*/*/{service}")]}});
    check(&[
        (
            "a publisher of another layer; what it sends all the same is dropped where it comes in",
            advertise_rule(&["c"]),
            &["f/a node-", "c/x node+"],
            &["inter>node"],
            &["f/a"],
        ),
        (
            "for services of the layer",
            advertise_rule(&["c"]),
            &["f/a@1 layer-", "c/x@1 layer+"],
            &["inter>layer"],
            &["f"],
        ),
        (
            "one of two publishers",
            advertise_rule(&["c"]),
            &["f/a node-", "c/x node+", "e/y node+"],
            &["inter>node"],
            &[],
        ),
        (
            "the own node publishes, too",
            advertise_rule(&["c"]),
            &["f/a node+ node-", "c/x node+"],
            &["inter>node"],
            &[],
        ),
        (
            "a service that is allowed",
            allow("driver"),
            &["f/a node-", "c/x node+"],
            &["inter>node"],
            &[],
        ),
        (
            "another one is allowed",
            allow("joystick"),
            &["f/a node-", "c/x node+"],
            &["inter>node"],
            &["f/a"],
        ),
    ]);
}

#[test]
fn of_publishers_that_are_not_all_named_nobody_says_that_they_are_refused() {
    let source = |service: &str| Source {
        node: String::new(),
        service: service.to_owned(),
    };
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
