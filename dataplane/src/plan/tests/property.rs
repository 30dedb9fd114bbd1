//! What must hold in every system: each requester gets each matching message once, over one path,
//! and nothing is made that carries nothing.

use std::collections::BTreeMap;

use blaze_domain::FlowId;

use super::generate::System;
use super::simulate::{Intake, Simulation, is_live};
use super::worlds::topic;
use crate::plan::{PlanRules, Survey, Target, TopicPlan, plan_topic, plan_within};
use crate::testing::Random;

type Plans = BTreeMap<FlowId, TopicPlan>;

/// 2,000 worlds, or 10,000 with `BLAZE_LONG=1`.
#[allow(clippy::disallowed_methods, reason = "a test has no configuration loader")]
fn worlds() -> u64 {
    if std::env::var("BLAZE_LONG").is_ok_and(|long| long == "1") { 10_000 } else { 2_000 }
}

/// Plans of all flows that live, in the view that all share. A plan of many topics is the same.
fn plans(system: &System, previous: &Plans) -> Plans {
    let rules = PlanRules::default();
    let live = system.world.flows.iter().filter(|(_, view)| is_live(view));
    live.map(|(id, _)| {
        let (world, topic, previous) = (system.known_to(id), topic(), previous.get(id));
        let plan = plan_topic(&world, &topic, &rules, previous);
        assert_eq!(plan_within(&Survey::of_all(&world), &topic, &rules, previous), plan);
        (id.clone(), plan)
    })
    .collect()
}

#[test]
fn each_message_reaches_each_requester_once_over_one_path() {
    let mut carried = 0;
    let mut bridges = 0;
    for seed in 0..worlds() {
        let system = System::random(&mut Random(seed));
        let plans = plans(&system, &Plans::new());
        for intake in [Intake::Bridges, Intake::Delivery] {
            let mut simulation = Simulation::new(&system, &plans, intake);
            if let Err(fault) = simulation.run() {
                panic!("seed {seed} ({intake:?}): {fault}\n{plans:#?}\n{:#?}", system.world);
            }
            carried += simulation.carried;
        }
        bridges += plans.values().map(|plan| plan.bridges.len()).sum::<usize>();
    }
    // The worlds are not empty ones.
    let worlds = usize::try_from(worlds()).unwrap();
    assert!(carried > 10 * worlds && bridges > 5 * worlds, "{carried} messages, {bridges} bridges");
    println!("{worlds} worlds, {bridges} bridges, {carried} messages carried");
}

/// Of each group some flows are on the inter scope for the others, of one with more than 16.
#[test]
fn behind_gateways_each_message_reaches_each_requester_once_over_one_path() {
    let (mut carried, mut over_gateways) = (0, 0);
    let worlds = worlds() / 8;
    for seed in 0..worlds {
        let mut dice = Random(seed ^ 0x6A7E);
        let mut system = System::with_gateways(&mut dice);
        let mut past = Plans::new();
        for step in 0..3 {
            let plans = plans(&system, &past);
            let intakes: &[Intake] =
                if step == 0 { &[Intake::Bridges, Intake::Delivery] } else { &[Intake::Delivery] };
            for intake in intakes {
                let mut simulation = Simulation::new(&system, &plans, *intake);
                if let Err(fault) = simulation.run() {
                    panic!(
                        "seed {seed} step {step} ({intake:?}): {fault}\n{plans:#?}\n{:#?}",
                        system.world
                    );
                }
                carried += simulation.carried;
                over_gateways += simulation.relayed;
            }
            past = plans;
            system.change(&mut dice);
            system.tell_precisely();
        }
    }
    let worlds = usize::try_from(worlds).unwrap();
    assert!(
        carried > 10 * worlds && over_gateways > worlds,
        "{carried} messages, {over_gateways} relayed"
    );
    println!(
        "{worlds} worlds, {carried} messages carried, {over_gateways} over a gateway for another \
         flow"
    );
}

#[test]
fn it_stays_so_while_the_system_changes_and_receivers_stay() {
    for seed in 0..worlds() / 8 {
        let mut dice = Random(seed ^ 0xC0FFEE);
        let mut system = System::random(&mut dice);
        let mut past = plans(&system, &Plans::new());
        for step in 0..8 {
            system.change(&mut dice);
            let next = plans(&system, &past);
            if let Err(fault) = Simulation::new(&system, &next, Intake::Delivery).run() {
                panic!("seed {seed} step {step}: {fault}\n{next:#?}\n{:#?}", system.world);
            }
            past = next;
        }
    }
}

#[test]
fn nothing_moves_without_a_reason() {
    let mut kept = 0;
    for seed in 0..worlds() / 4 {
        let mut dice = Random(seed ^ 0xBEEF);
        let mut system = System::random(&mut dice);
        let past = plans(&system, &Plans::new());
        assert_eq!(past, plans(&system, &past), "seed {seed}: the same world, the same plan");
        system.change(&mut dice);
        let fresh = plans(&system, &Plans::new());
        for (flow, plan) in plans(&system, &past) {
            let Some(before) = past.get(&flow) else { continue };
            for bridge in &before.bridges {
                let Target::Inter { receiver, .. } = &bridge.to else {
                    continue;
                };
                let wanted = |plan: &TopicPlan| {
                    plan.bridges.iter().any(|b| (b.from, &b.to) == (bridge.from, &bridge.to))
                };
                // Where a fresh plan would choose it, or it is still a candidate, it is kept.
                assert!(
                    !wanted(&fresh[&flow]) || wanted(&plan),
                    "seed {seed}: {flow} left {receiver}"
                );
                kept += usize::from(wanted(&plan) && !wanted(&fresh[&flow]));
            }
        }
    }
    assert!(kept > 0, "no world where a receiver stayed though a fresh plan would move it");
}

#[test]
fn equal_worlds_give_equal_plans_in_one_order() {
    for seed in 0..200 {
        let system = System::random(&mut Random(seed));
        let first = plans(&system, &Plans::new());
        assert_eq!(first, plans(&System::random(&mut Random(seed)), &Plans::new()));
        for plan in first.values() {
            let keys: Vec<_> =
                plan.bridges.iter().map(|bridge| (bridge.from, &bridge.to)).collect();
            assert!(keys.is_sorted() && keys.windows(2).all(|pair| pair[0] != pair[1]));
            let blocked: Vec<_> =
                plan.blocked.iter().map(|blocked| (&blocked.to, blocked.code)).collect();
            assert!(blocked.is_sorted() && blocked.windows(2).all(|pair| pair[0] != pair[1]));
        }
    }
}

/// A topic's plan depends on its own entries alone, and only flows with an entry for it matter.
#[test]
fn what_happens_elsewhere_changes_nothing() {
    for seed in 0..200 {
        let mut dice = Random(seed);
        let mut system = System::random(&mut dice);
        let before = plans(&system, &Plans::new());
        let other = "other/topic".parse::<blaze_domain::TopicName>().unwrap();
        let stranger = System::random(&mut dice);
        for (id, view) in &stranger.world.flows {
            let entry = view.topics[&topic()].clone();
            if let Some(view) = system.world.flows.get_mut(id) {
                view.topics.insert(other.clone(), entry);
            }
            let mut view = view.clone();
            view.topics = [(other.clone(), view.topics[&topic()].clone())].into();
            system.world.flows.insert(format!("far-{id}").parse().unwrap(), view);
        }
        let mut after = plans(&system, &Plans::new());
        after.retain(|id, _| before.contains_key(id));
        assert_eq!(before, after, "seed {seed}");
    }
}

/// A thousand robots that each publish and request one topic, two fog replicas that want all of it.
#[test]
fn a_topic_of_a_thousand_flows_is_planned_soon() {
    let robot = |n: usize| format!("edge/robot-{n}@{} node+ node-", n / 10);
    let mut lines: Vec<String> = (0..1000).map(robot).collect();
    lines.extend(["fog/a@1 layer- layer+".to_owned(), "fog/b@1 layer- layer+".to_owned()]);
    let lines: Vec<&str> = lines.iter().map(String::as_str).collect();
    let world = super::worlds::world(&lines);
    // Other tests run beside: not each time.
    let timed = || {
        let started = std::time::Instant::now();
        let plan = plan_topic(&world, &topic(), &PlanRules::default(), None);
        (started.elapsed(), plan)
    };
    let (took, plan) = (0..3).map(|_| timed()).min_by_key(|(took, _)| *took).unwrap();
    println!("{} bridges in {took:?}", plan.bridges.len());
    // Its own layer, 99 others at the edge, the fog, and what comes in: to the layer, or by it, to
    // the node.
    assert!((102..106).contains(&plan.bridges.len()), "{}", plan.bridges.len());
    assert!(took.as_millis() < 1000, "{took:?}");
}
