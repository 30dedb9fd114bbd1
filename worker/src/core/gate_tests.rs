use std::time::Duration;

use blaze_domain::config::Document;
use serde_json::{Value, json};

use super::super::served_target::Source;
use super::super::testing::{document, labelled, place, site, state};
use super::*;

fn rollout(target: &str, max_unhealthy: u64, phase: &str) -> Document {
    let spec = json!({"target": {"kind": "Service", "name": target}, "patch": {"config": {"rate_hz": 5}},
        "canary": {"node_selector": "canary=true"},
        "gate": {"window_s": 60, "max_unhealthy": max_unhealthy}});
    let mut out = document(&format!("Rollout/{target}-slower"), 9, spec);
    out.status = Some(json!({ "phase": phase }));
    out
}

fn documents(rollouts: Vec<Document>) -> Vec<Document> {
    let on = |node: &str| -> Value { json!({ "node": node }) };
    let mut out = vec![
        document("Layer/edge", 1, json!({})),
        labelled("Node/robot-1", 2, json!({"layer": "edge"}), ("canary", "true")),
        labelled("Node/robot-2", 2, json!({"layer": "edge"}), ("canary", "true")),
        document("Service/nav", 3, json!({"config": {"rate_hz": 30}})),
        document("Service/slam", 3, json!({"config": {"rate_hz": 30}})),
        document("Instance/nav/0", 4, on("robot-1")),
        document("Instance/slam/0", 4, on("robot-1")),
        document("Instance/slam/1", 4, on("robot-1")),
        // What it says itself is stronger than what is tried.
        document("Instance/slam/own", 4, json!({"node": "robot-1", "config": {"rate_hz": 1}})),
        document("Instance/slam/2", 4, on("robot-2")),
    ];
    out.extend(rollouts);
    out
}

struct World {
    served: Served,
    gate: Gate,
    start: Instant,
}

fn world(node: Option<&str>, rollouts: Vec<Document>) -> World {
    let (mut served, mut gate, start) = (Served::new(site(node)), Gate::default(), Instant::now());
    served.load(state(10, documents(rollouts)), Source::Copy);
    served.flush(start);
    gate.follow(&served);
    gate.open(Some(10), start);
    World { served, gate, start }
}

fn complaint(text: &str, trouble: Trouble) -> Complaint {
    Complaint { place: place(text), trouble, hash: None, revision: None, detail: String::new() }
}

impl World {
    fn hears(&mut self, complaint: &Complaint, seconds: u64) -> Vec<Failure> {
        let now = self.start + Duration::from_secs(seconds);
        self.gate.complain(&self.served, complaint, now)
    }

    /// Node and phase of each, in order.
    fn phases(&self) -> Vec<(String, &'static str)> {
        let states = self.gate.states(|_| true);
        states.iter().map(|state| (state.node.to_string(), state.phase.as_str())).collect()
    }
}

fn named(phases: &[(&str, &'static str)]) -> Vec<(String, &'static str)> {
    phases.iter().map(|(node, phase)| ((*node).to_owned(), *phase)).collect()
}

#[test]
fn any_trouble_of_a_place_that_it_changed_fails_it_and_none_of_others_does() {
    for trouble in [Trouble::Rejected, Trouble::Unhealthy, Trouble::Lost] {
        let mut w = world(Some("robot-1"), vec![rollout("slam", 0, "canary")]);
        assert_eq!(w.phases(), named(&[("robot-1", "applied")]));
        for other in
            ["nav/0@robot-1", "slam/own@robot-1", "slam/2@robot-2", "slam/9@robot-1", "slam/0"]
        {
            assert_eq!(w.hears(&complaint(other, trouble), 1), [], "{other}");
        }
        let failures = w.hears(&complaint("slam/0@robot-1", trouble), 60);
        assert_eq!(failures.len(), 1);
        assert_eq!(failures[0].uid, "Rollout/slam-slower");
        assert!(failures[0].reason.contains("slam/0 at robot-1"), "{}", failures[0].reason);
        assert_eq!(w.phases(), named(&[("robot-1", "failed")]));
        assert_eq!(w.hears(&complaint("slam/1@robot-1", trouble), 60), [], "it fails once");
    }
}

#[test]
fn as_many_as_may_be_in_trouble_are_counted_once_each() {
    let mut w = world(Some("robot-1"), vec![rollout("slam", 1, "canary")]);
    for _ in 0..3 {
        assert_eq!(w.hears(&complaint("slam/0@robot-1", Trouble::Unhealthy), 5), []);
    }
    assert_eq!(w.hears(&complaint("slam/1@robot-1", Trouble::Lost), 50).len(), 1);
}

#[test]
fn after_the_window_nothing_fails_any_more() {
    let mut w = world(Some("robot-1"), vec![rollout("slam", 0, "canary")]);
    assert_eq!(w.hears(&complaint("slam/0@robot-1", Trouble::Rejected), 61), []);
    assert_eq!(w.phases(), named(&[("robot-1", "applied")]));
}

#[test]
fn a_window_opens_when_services_were_told_and_before_only_who_names_the_configuration_counts() {
    let mut w = world(Some("robot-1"), vec![rollout("slam", 0, "canary")]);
    w.gate = Gate::default();
    w.gate.follow(&w.served);
    for told in [None, Some(9)] {
        assert!(!w.gate.open(told, w.start));
        assert_eq!(w.phases(), named(&[("robot-1", "pending")]));
    }
    assert_eq!(w.hears(&complaint("slam/0@robot-1", Trouble::Lost), 1), []);
    let later = w.start + Duration::from_secs(600);
    assert!(w.gate.open(Some(10), later) && !w.gate.open(Some(11), later));
    assert_eq!(w.phases(), named(&[("robot-1", "applied")]));
    assert_eq!(w.hears(&complaint("slam/0@robot-1", Trouble::Lost), 660).len(), 1);

    w.gate = Gate::default();
    w.gate.follow(&w.served);
    let of_it = Complaint {
        hash: w.served.told_to(&place("slam/0@robot-1")).unwrap().hash.clone(),
        ..complaint("slam/0@robot-1", Trouble::Rejected)
    };
    assert_eq!(w.hears(&of_it, 1).len(), 1, "it has asked");
}

#[test]
fn what_is_said_of_the_configuration_before_does_not_count() {
    let mut w = world(Some("robot-1"), vec![rollout("slam", 0, "canary")]);
    let told = w.served.told_to(&place("slam/0@robot-1")).unwrap().clone();
    let of = |hash: Option<&str>, revision: Option<u64>| Complaint {
        hash: hash.map(str::to_owned),
        revision,
        ..complaint("slam/0@robot-1", Trouble::Rejected)
    };
    assert_eq!(w.hears(&of(Some("sha256:before"), Some(4)), 1), []);
    assert_eq!(w.hears(&of(None, Some(told.revision - 1)), 1), []);
    assert_eq!(
        w.hears(&of(told.hash.as_deref(), Some(4)), 1).len(),
        1,
        "its hash says which one it is"
    );
}

#[test]
fn on_the_broker_of_a_layer_each_node_is_judged_and_one_that_fails_undoes_it_for_all() {
    let mut w = world(None, vec![rollout("nav", 0, "canary"), rollout("slam", 1, "canary")]);
    // One on each node: on neither there are more than one.
    assert_eq!(w.hears(&complaint("slam/0@robot-1", Trouble::Lost), 1), []);
    assert_eq!(w.hears(&complaint("slam/2@robot-2", Trouble::Lost), 1), []);
    assert_eq!(w.hears(&complaint("slam/1@robot-1", Trouble::Lost), 1).len(), 1);
    let states = w.gate.states(|_| true);
    let of_slam: Vec<_> =
        states.iter().filter(|state| state.name.as_str() == "slam-slower").collect();
    assert_eq!((of_slam[0].phase, of_slam[0].node.as_str()), (RolloutPhase::Failed, "robot-1"));
    assert_eq!(
        (of_slam[1].phase, of_slam[1].reason.as_str()),
        (RolloutPhase::Pending, "undone: it failed on robot-1")
    );
    assert_eq!(states.iter().filter(|state| state.phase == RolloutPhase::Applied).count(), 2);
    let of_two = w.gate.states(|node| node.as_str() == "robot-2");
    assert!(of_two.len() == 2 && of_two.iter().all(|state| state.node.as_str() == "robot-2"));
}

#[test]
fn one_that_has_ended_is_forgotten() {
    let mut w = world(Some("robot-1"), vec![rollout("slam", 0, "canary")]);
    assert!(!w.gate.follow(&w.served), "nothing is new");
    w.served.load(state(11, documents(vec![rollout("slam", 0, "promoted")])), Source::Copy);
    w.served.flush(w.start);
    assert!(w.gate.follow(&w.served));
    assert_eq!(w.phases(), []);
}

#[test]
fn a_change_of_one_node_is_tried_there_alone() {
    let mut of_node = rollout("slam", 0, "canary");
    let spec = json!({"target": {"kind": "Node", "name": "robot-2"}, "patch": {"config": {"rate_hz": 5}},
        "canary": {"node_selector": "canary=true"}, "gate": {}});
    of_node.spec = std::sync::Arc::new(spec);
    assert_eq!(world(Some("robot-1"), vec![of_node.clone()]).phases(), []);
    assert_eq!(world(None, vec![of_node.clone()]).phases(), named(&[("robot-2", "applied")]));
    // Of a mounted file nobody knows which one it is.
    of_node.uid = String::new();
    assert_eq!(world(None, vec![of_node]).phases(), []);
}
