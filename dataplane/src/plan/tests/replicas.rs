//! Who of the flows that share a layer broker carries a topic out of the layer, and who takes in
//! what others send: when one joins, leaves, dies, or two think that it is theirs.

use std::collections::BTreeSet;

use super::worlds::{id, list, rows, topic, world};
use crate::plan::{PlanRules, Target, TopicPlan, owner, plan_topic};
use crate::world::{Carrying, FlowState, FlowView, Handover, Hold, Reach, World};
use blaze_domain::FlowId;

const FLOWS: [&str; 3] = ["f/a", "f/b", "f/c"];

/// Three flows of the fog on one broker where services publish, and a robot that asks for it.
fn fog() -> World {
    world(&["f/a@1 layer+", "f/b@1 layer+", "f/c@1 layer+", "e/r node-"])
}

/// The same with a robot that publishes what services of the fog ask for.
fn fog_that_listens() -> World {
    world(&["e/r node+", "f/a@1 layer-", "f/b@1 layer-", "f/c@1 layer-"])
}

/// The flows in the order in which hashing prefers them.
fn preferred() -> [FlowId; 3] {
    let mut left = fog();
    [(); 3].map(|()| {
        let found = owner(&left, &topic()).unwrap();
        left.flows.remove(&found);
        let next = left.flows.keys().find(|flow| flow.layer == found.layer);
        left.me = next.unwrap_or(&found).clone();
        found
    })
}

fn view<'a>(world: &'a mut World, flow: &FlowId) -> &'a mut FlowView {
    world.flows.get_mut(flow).unwrap()
}

fn set(world: &mut World, flow: &FlowId, carrying: Carrying) {
    view(world, flow).parts.entry(topic()).or_default().carrying = carrying;
}

fn plan_of(world: &World, flow: &FlowId, previous: Option<&TopicPlan>) -> TopicPlan {
    let seen = World { me: flow.clone(), ..world.clone() };
    plan_topic(&seen, &topic(), &PlanRules::default(), previous)
}

/// Who carries the topic to the robot, as each plans for itself.
fn carriers(world: &World) -> Vec<FlowId> {
    let all = FLOWS.map(id).into_iter();
    all.filter(|flow| world.flows.contains_key(flow) && plan_of(world, flow, None).carries_out())
        .collect()
}

#[test]
fn a_topic_that_nobody_carries_is_taken_at_once_by_one() {
    let [best, second, _] = preferred();
    let mut world = fog();
    assert_eq!(carriers(&world), std::slice::from_ref(&best));
    assert_eq!(plan_of(&world, &second, None).carrier, Some(best.clone()));
    assert_eq!(plan_of(&world, &best, None).carrier, None);
    view(&mut world, &best).reach = Reach::Down;
    set(&mut world, &best, Carrying::Carries);
    // Its own view knows that it lives.
    assert_eq!(plan_of(&world, &second, None).carrier, None);
    assert!(
        plan_of(&world, &second, None).carries_out(),
        "what a flow carried that is gone counts no more"
    );
}

#[test]
fn whoever_carries_a_topic_keeps_it_until_a_better_one_has_settled() {
    let [best, second, third] = preferred();
    let mut world = fog();
    set(&mut world, &second, Carrying::Carries);
    assert_eq!(
        carriers(&world),
        std::slice::from_ref(&second),
        "the better one has only just come"
    );
    view(&mut world, &third).settled = true;
    assert_eq!(
        carriers(&world),
        std::slice::from_ref(&second),
        "one that is not better changes nothing"
    );
    view(&mut world, &best).settled = true;
    assert_eq!(carriers(&world), [], "it gives up, and the other waits for that");
    assert_eq!(plan_of(&world, &second, None).carrier, Some(best.clone()));
    set(&mut world, &second, Carrying::HandedOver([7].into()));
    assert_eq!(carriers(&world), [best]);
}

fn hold(world: &mut World, flow: &FlowId, hold: Hold) {
    view(world, flow).parts.entry(topic()).or_default().hold = hold;
}

#[test]
fn what_was_placed_by_load_stays_though_a_better_one_has_settled() {
    let [best, second, _] = preferred();
    let mut world = fog();
    set(&mut world, &second, Carrying::Carries);
    view(&mut world, &best).settled = true;
    hold(&mut world, &second, Hold::Stays);
    assert_eq!(carriers(&world), std::slice::from_ref(&second));
    set(&mut world, &best, Carrying::Carries);
    assert_eq!(carriers(&world), [best], "of two the better one has it all the same");
}

#[test]
fn a_topic_is_given_to_whom_its_handover_names_and_else_to_whom_hashing_chooses() {
    let [best, second, third] = preferred();
    let mut world = fog();
    set(&mut world, &second, Carrying::Carries);
    hold(&mut world, &second, Hold::GivesTo(third.clone()));
    assert_eq!(carriers(&world), [], "the others wait until it has said where");
    assert_eq!(plan_of(&world, &second, None).carrier, Some(third.clone()));
    let mut gone = world.clone();
    view(&mut gone, &third).reach = Reach::Down;
    assert_eq!(carriers(&gone), std::slice::from_ref(&second), "it keeps what it cannot give");
    let handover = Handover { to: Some(third.clone()), ..[7].into() };
    set(&mut world, &second, Carrying::HandedOver(handover));
    assert_eq!(carriers(&world), std::slice::from_ref(&third));
    for flow in [&best, &second] {
        assert_eq!(plan_of(&world, flow, None).carrier, Some(third.clone()), "all agree");
    }
    let mut gone = world.clone();
    view(&mut gone, &third).reach = Reach::Down;
    for flow in [&best, &second] {
        let carries = plan_of(&gone, flow, None).carries_out();
        assert_eq!(carries, flow == &best, "it died before it began: {flow}");
    }
    view(&mut world, &third).state = FlowState::Draining;
    assert_eq!(carriers(&world), [best]);
}

#[test]
fn of_two_that_carry_it_the_better_one_stays() {
    let [best, second, third] = preferred();
    let mut world = fog();
    set(&mut world, &second, Carrying::Carries);
    set(&mut world, &third, Carrying::Carries);
    assert_eq!(carriers(&world), std::slice::from_ref(&second));
    set(&mut world, &best, Carrying::Carries);
    assert_eq!(carriers(&world), [best]);
}

#[test]
fn a_flow_that_goes_is_waited_for_until_it_has_said_where_it_stopped() {
    let [best, second, _] = preferred();
    let mut world = fog();
    set(&mut world, &best, Carrying::Carries);
    view(&mut world, &best).state = FlowState::Draining;
    assert_eq!(carriers(&world), []);
    assert_eq!(
        plan_of(&world, &best, None).carrier,
        Some(second.clone()),
        "so it knows that somebody is to be told"
    );
    let mut gone = world.clone();
    view(&mut gone, &best).reach = Reach::Down;
    assert_eq!(carriers(&gone), std::slice::from_ref(&second), "it died before it said so");
    gone.flows.remove(&best);
    assert_eq!(carriers(&gone), std::slice::from_ref(&second), "it said good-bye");
    set(&mut world, &best, Carrying::HandedOver([7].into()));
    assert_eq!(carriers(&world), [second]);
}

#[test]
fn what_nobody_asks_for_is_handed_to_nobody() {
    let [best, second, _] = preferred();
    let mut world = fog();
    set(&mut world, &best, Carrying::Carries);
    view(&mut world, &id("e/r")).topics.clear();
    view(&mut world, &best).state = FlowState::Draining;
    assert_eq!(carriers(&world), []);
    assert_eq!([&best, &second].map(|flow| plan_of(&world, flow, None).carrier), [None, None]);
}

/// The receiver in a plan of the robot.
fn receiver(plan: &TopicPlan) -> FlowId {
    match &plan.bridges[..] {
        [bridge] => bridge.to.receiver().unwrap().clone(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_sender_goes_back_to_a_better_receiver_that_has_settled() {
    let mut world = fog_that_listens();
    let robot = id("e/r");
    let best = receiver(&plan_of(&world, &robot, None));
    view(&mut world, &best).reach = Reach::Down;
    let second = plan_of(&world, &robot, None);
    let other = receiver(&second);
    view(&mut world, &best).reach = Reach::Up;
    assert_eq!(
        receiver(&plan_of(&world, &robot, Some(&second))),
        other,
        "it has only just come back"
    );
    view(&mut world, &best).settled = true;
    assert_eq!(receiver(&plan_of(&world, &robot, Some(&second))), best);
}

#[test]
fn whoever_a_sender_has_chosen_takes_it_in_and_so_does_the_one_that_it_will_choose() {
    let mut world = fog_that_listens();
    let robot = id("e/r");
    let best = receiver(&plan_of(&world, &robot, None));
    let other = FLOWS.map(id).into_iter().find(|flow| *flow != best).unwrap();
    let takes = |world: &World, flow: &FlowId| {
        plan_of(world, flow, None).bridges.iter().any(|b| b.to == Target::Layer { json: false })
    };
    assert!(takes(&world, &best) && !takes(&world, &other));
    view(&mut world, &robot).parts.entry(topic()).or_default().receivers = vec![other.clone()];
    assert!(takes(&world, &best) && takes(&world, &other));
    view(&mut world, &other).state = FlowState::Draining;
    assert!(takes(&world, &best) && !takes(&world, &other));
}

#[test]
fn who_has_lost_the_layer_broker_is_not_sent_to_while_another_one_has_it() {
    let mut world = fog_that_listens();
    let robot = id("e/r");
    let first = plan_of(&world, &robot, None);
    let best = receiver(&first);
    view(&mut world, &best).layer_away = true;
    let second = plan_of(&world, &robot, Some(&first));
    assert_ne!(receiver(&second), best);
    for flow in FLOWS.map(id) {
        view(&mut world, &flow).layer_away = true;
    }
    assert_eq!(receiver(&plan_of(&world, &robot, Some(&first))), best, "it is away for all");
    for flow in FLOWS.map(id) {
        view(&mut world, &flow).layer_away = false;
    }
    let back = plan_of(&world, &robot, Some(&second));
    assert_eq!(receiver(&back), receiver(&second), "it has only just come back");
    view(&mut world, &best).settled = true;
    assert_eq!(receiver(&plan_of(&world, &robot, Some(&second))), best);
}

#[test]
fn of_more_receivers_than_a_sender_can_name_each_that_could_be_one_takes_it_in() {
    let mut world = fog_that_listens();
    let robot = id("e/r");
    let best = receiver(&plan_of(&world, &robot, None));
    let takes = |world: &World, flow: &FlowId| {
        plan_of(world, flow, None).bridges.iter().any(|b| b.to == Target::Layer { json: false })
    };
    let others = || FLOWS.map(id).into_iter().filter(|flow| *flow != best);
    assert!(others().all(|flow| !takes(&world, &flow)));
    let part = view(&mut world, &robot).parts.entry(topic()).or_default();
    part.more_receivers = true;
    assert!(takes(&world, &best) && others().all(|flow| takes(&world, &flow)));
}

/// Missing layers, and two layers of one kind: the flows | the sender | its copies | layers that
/// they go to | name.
const SYSTEMS: &str = "
    e/r node+, c/a@1 layer- | e/r | 1 | 1 | no fog: the robot sends to the cloud
    e/r node+, c/a@1 layer-, c/b@1 layer- | e/r | 1 | 1 | no fog, two in the cloud: one copy
    e/r@1 node+, e/s@1 node- | e/r | 0 | 0 | edge alone, one layer broker: no way out
    e/r node+, e/s node-, e/t node- | e/r | 2 | 1 | edge alone, no layer broker: to each that asks
    f/a@1 layer+, f/b@1 layer- | f/a | 0 | 0 | fog alone: nothing leaves it
    f/a@1 layer+, e/r node-, e/s node- | f/a | 2 | 1 | fog and edge: the fog to each robot
    e/r node+, f/a@1 layer-, g/a@1 layer- | e/r | 2 | 2 | two fogs of their own: a copy each
    e/r node+, f/a@1 layer-, f/b@1 layer-, g/a@1 layer-, g/b@1 layer- | e/r | 2 | 2 | with two flows each, too
    f/a@1 layer+, g/a@1 layer-, g/b@1 layer- | f/a | 1 | 1 | from one fog to another, over the inter scope
    f/a@1 layer+ layer-, g/a@1 layer+ layer- | f/a | 1 | 1 | one Kafka and one prefix do not make one layer of two
";

#[test]
fn incomplete_systems_and_doubled_layers() {
    for [lines, sender, copies, layers, rule] in rows(SYSTEMS) {
        let plan = plan_of(&world(&list(lines)), &id(sender), None);
        let found: Vec<_> = plan.bridges.iter().filter_map(|bridge| bridge.to.receiver()).collect();
        let reached: BTreeSet<_> = found.iter().map(|flow| &flow.layer).collect();
        let counts = [found.len(), reached.len()].map(|count| count.to_string());
        assert_eq!(counts, [copies, layers], "{rule}: {found:?}");
    }
}

/// However the claims lie: at most one of the living ends up with it, and after each has done what
/// it plans exactly one.
#[test]
fn any_claims_end_with_one_carrier() {
    for seed in 0..3_u32.pow(3) * 2_u32.pow(3) {
        let mut world = fog();
        let mut rest = seed;
        for flow in FLOWS.map(id) {
            let claim = match rest % 3 {
                0 => Carrying::No,
                1 => Carrying::Carries,
                _ => Carrying::HandedOver([7].into()),
            };
            set(&mut world, &flow, claim);
            rest /= 3;
            view(&mut world, &flow).settled = rest % 2 == 1;
            rest /= 2;
        }
        for _ in 0..4 {
            // Each in turn does what it plans, and tells.
            for flow in FLOWS.map(id) {
                let carries = plan_of(&world, &flow, None).carries_out();
                let held = view(&mut world, &flow).parts[&topic()].carrying.clone();
                let next = match (held, carries) {
                    (_, true) => Carrying::Carries,
                    (Carrying::Carries, false) => Carrying::HandedOver([9].into()),
                    (held, false) => held,
                };
                set(&mut world, &flow, next);
            }
        }
        assert_eq!(carriers(&world).len(), 1, "seed {seed}: {:?}", carriers(&world));
        let claims = FLOWS
            .map(id)
            .iter()
            .filter(|flow| world.flows[*flow].parts[&topic()].carrying == Carrying::Carries)
            .count();
        assert_eq!(claims, 1, "seed {seed}");
    }
}

#[test]
fn owner_is_what_the_planner_says() {
    let world = fog();
    let [best, ..] = preferred();
    assert_eq!(owner(&world, &topic()), Some(best));
}
