use std::time::Duration;

use blaze_domain::config::{Document, Timestamp};
use serde_json::{Value, json};
use tokio::time::Instant;

use super::*;
use crate::status::picture::{self, Filter};

fn document(key: &str, spec: Value) -> Document {
    Document {
        key: key.parse().unwrap(),
        uid: String::new(),
        revision: 1,
        create_time: Timestamp::default(),
        update_time: Timestamp::default(),
        updated_by: String::new(),
        labels: [("site".to_owned(), "lab".to_owned())].into_iter().collect(),
        annotations: Default::default(),
        spec: Arc::new(spec),
        status: None,
    }
}

fn state(revision: u64, nodes: &[(&str, &str)]) -> State {
    let layers = ["edge", "cloud"];
    let layers = layers.map(|name| document(&format!("Layer/{name}"), json!({ "kind": name })));
    let nodes = nodes
        .iter()
        .map(|(name, layer)| document(&format!("Node/{name}"), json!({ "layer": layer })));
    State::new(revision, layers.into_iter().chain(nodes))
}

const NODES: &[(&str, &str)] =
    &[("robot-1", "edge"), ("robot-2", "edge"), ("cloud-1", "cloud"), ("spare", "edge")];

struct World {
    fleet: Fleet,
    start: Instant,
    second: u64,
}

impl World {
    fn new() -> Self {
        let mut world = Self { fleet: Fleet::default(), start: Instant::now(), second: 0 };
        world.fleet.configure(&state(1, NODES), world.now());
        world
    }

    fn now(&self) -> Now {
        Now {
            at: self.start + Duration::from_secs(self.second),
            time: Timestamp::from_millis(i64::try_from(self.second * 1000).unwrap()),
        }
    }

    fn report(&mut self, node: &str, summary: &Value) {
        let (node, now) = (node.parse().unwrap(), self.now());
        let layer = self.fleet.layer_of(&node).unwrap().clone();
        self.fleet.enter(&node, &layer, format!("{node}:9103"), now).unwrap();
        let report = Report::read(summary.to_string(), now).unwrap();
        assert!(self.fleet.report(&node, report));
    }

    /// Up to a second, with summaries every 10 s.
    fn until(&mut self, second: u64, reporting: &[(&str, Value)]) {
        while self.second < second {
            self.second += 1;
            if self.second.is_multiple_of(10) {
                reporting.iter().for_each(|(node, summary)| self.report(node, summary));
            }
            self.fleet.tick(self.now());
        }
    }

    fn node(&self, node: &str) -> Health {
        self.fleet.entry(&node.parse().unwrap()).map_or(Health::Unknown, Entry::health)
    }

    fn layer(&self, layer: &str) -> Health {
        self.fleet.layer(&layer.parse().unwrap()).unwrap().state()
    }

    fn codes(&self) -> Vec<(String, String)> {
        let (items, _) = picture::problems(&self.fleet, &Filter::default(), None);
        let text = |item: &Value, name: &str| item[name].as_str().unwrap().to_owned();
        items.iter().map(|item| (text(item, "code"), text(item, "name"))).collect()
    }
}

fn summary(flow: &str, state: &str, links: &[(&str, &str)]) -> Value {
    let links: Vec<Value> = links
        .iter()
        .map(|(flow, state)| json!({ "flow": flow, "state": state, "rtt_ms": 50.2, "dropped": 3 }))
        .collect();
    json!({
        "health": { "state": state, "since": "2026-01-01T00:00:00.000Z", "problems": [] },
        "node": { "cpu_ratio": 0.123_456, "memory_ratio": 0.5, "celsius": null },
        "flows": [{
            "flow": flow, "state": "ready", "topics": { "flowing": 12, "no_request": 3 },
            "in": { "messages": 100, "bytes": 1 }, "out": { "messages": 90, "bytes": 1 },
            "dropped": { "max_rate": 10 }, "links": links,
        }],
    })
}

fn pairs(codes: &[(&str, &str)]) -> Vec<(String, String)> {
    codes.iter().map(|(code, name)| ((*code).to_owned(), (*name).to_owned())).collect()
}

#[test]
fn a_monitor_that_is_missing_is_not_a_node_that_is_gone() {
    let mut world = World::new();
    let robot = |n: u8| summary(&format!("edge/robot-{n}"), "ok", &[("cloud/cloud-1", "up")]);
    let cloud = |second: &str| {
        summary("cloud/cloud-1", "ok", &[("edge/robot-1", "up"), ("edge/robot-2", second)])
    };
    let all = [("robot-1", robot(1)), ("robot-2", robot(2)), ("cloud-1", cloud("up"))];
    world.until(30, &all);
    assert_eq!((world.node("robot-1"), world.layer("edge")), (Health::Ok, Health::Ok));
    assert_eq!(world.node("spare"), Health::Unknown, "it never reported, and is no problem");
    assert!(world.codes().is_empty());

    // The monitor of robot-1 is killed, robot-2 loses its power: both spoke last at 30 s.
    let rest = [("cloud-1", cloud("down"))];
    world.until(74, &rest);
    assert!(world.codes().is_empty(), "{:?}", world.codes());
    world.until(75, &rest);
    assert_eq!(
        world.codes(),
        pairs(&[("node_gone", "robot-2"), ("monitor_silent", "robot-1"), ("nodes_down", "edge")])
    );
    assert_eq!((world.node("robot-1"), world.node("robot-2")), (Health::Degraded, Health::Down));
    world.until(82, &rest);
    // A flow that others see is ready, as far as anybody knows.
    assert_eq!(world.layer("edge"), Health::Degraded);

    // Both are back.
    world.until(89, &rest);
    world.until(104, &all);
    assert_eq!(world.node("robot-2"), Health::Down, "better counts after 15 s");
    world.until(130, &all);
    assert_eq!((world.node("robot-2"), world.layer("edge")), (Health::Ok, Health::Ok));
    assert!(world.codes().is_empty());
}

#[test]
fn where_nobody_could_see_the_node_only_its_monitor_is_missing() {
    let mut world = World::new();
    world.until(10, &[("robot-1", summary("edge/robot-1", "ok", &[]))]);
    world.until(60, &[]);
    assert_eq!(world.codes(), pairs(&[("monitor_silent", "robot-1")]));
}

#[test]
fn a_layer_without_a_ready_flow_is_down() {
    let mut world = World::new();
    let good = [("robot-1", summary("edge/robot-1", "ok", &[]))];
    world.until(20, &good);
    let mut bad = summary("edge/robot-1", "degraded", &[]);
    bad["flows"][0]["state"] = json!("starting");
    let bad = [("robot-1", bad)];
    world.until(34, &bad);
    assert_eq!(world.layer("edge"), Health::Ok);
    world.until(36, &bad);
    assert_eq!((world.layer("edge"), world.layer("cloud")), (Health::Down, Health::Unknown));
    assert_eq!(world.codes(), pairs(&[("no_ready_flow", "edge")]));
    world.until(60, &good);
    assert_eq!(world.layer("edge"), Health::Ok);
}

#[test]
fn what_the_configuration_does_not_have_is_forgotten() {
    let mut world = World::new();
    world.until(10, &[("robot-1", summary("edge/robot-1", "ok", &[]))]);
    let moved = [("robot-1", "cloud"), ("robot-2", "edge")];
    world.fleet.configure(&state(2, &moved), world.now());
    assert!(world.fleet.entry(&"robot-1".parse().unwrap()).is_none());
    assert_eq!(world.fleet.layer_of(&"robot-1".parse().unwrap()).unwrap().as_str(), "cloud");
}

#[test]
fn the_picture_has_rates_links_and_no_unknown_values() {
    let mut world = World::new();
    let mut robot = summary("edge/robot-1", "ok", &[("cloud/cloud-1", "up")]);
    world.until(10, &[("robot-1", robot.clone())]);
    let show = |world: &World, filter: &Filter| {
        picture::fleet(&world.fleet, filter, 7, &|_| Some((6, false)), world.now())
    };
    show(&world, &Filter::default());
    robot["flows"][0]["in"]["messages"] = json!(1100);
    robot["flows"][0]["links"][0]["dropped"] = json!(23);
    world.until(20, &[("robot-1", robot)]);
    let shown = show(&world, &Filter::default());
    let row = &shown["nodes"]["robot-1"];
    let expected = json!({
        "layer": "edge", "labels": { "site": "lab" }, "state": "ok", "age_s": 0, "problems": 0,
        "topics": 15, "cpu_ratio": 0.123, "memory_ratio": 0.5, "in_hz": 100, "out_hz": 0,
        "dropped_hz": 0, "revision": 6, "in_sync": false,
    });
    assert_eq!(*row, expected);
    let link = json!({ "state": "up", "rtt_ms": 50.2, "dropped_hz": 2.0 });
    assert_eq!(shown["links"]["edge/robot-1>cloud/cloud-1"], link);
    assert_eq!(shown["layers"]["edge"], json!({ "kind": "edge", "state": "ok" }));
    assert_eq!(shown["missing"], json!([]));

    // Of other layers nothing but name and state.
    let bound = Filter { bound: Some("cloud".parse().unwrap()), ..Filter::default() };
    let shown = show(&world, &bound);
    assert_eq!(shown["layers"]["edge"], json!({ "state": "ok" }));
    assert_eq!(shown["nodes"].as_object().unwrap().keys().collect::<Vec<_>>(), ["cloud-1"]);
    assert_eq!(shown["links"], json!({}));
}

#[test]
fn targets_are_those_that_can_be_scraped() {
    let mut world = World::new();
    world.until(10, &[("robot-1", summary("edge/robot-1", "ok", &[]))]);
    let expected = json!([{
        "targets": ["robot-1:9103"],
        "labels": { "layer": "edge", "node": "robot-1", "__param_all": "1" },
    }]);
    assert_eq!(picture::targets(&world.fleet, &Filter::default()), expected);
}

#[test]
fn a_flood_of_problems_is_cut_and_counted() {
    let problems: Vec<Value> = (0..1000)
        .map(|n| {
            json!({
                "code": "topic_silent", "scope": "topic", "name": format!("t/{n}"),
                "state": if n == 999 { "down" } else { "degraded" }, "since": "",
                "detail": "x".repeat(100), "remedy": "",
            })
        })
        .collect();
    let mut world = World::new();
    let mut flooded = summary("edge/robot-1", "degraded", &[]);
    flooded["health"]["problems"] = json!(problems);
    world.report("robot-1", &flooded);
    let (items, total) = picture::problems(&world.fleet, &Filter::default(), None);
    assert_eq!((items.len(), total), (200, 200));
    assert_eq!(items[0]["name"], "t/999", "the worst are kept");
    let shown = picture::fleet(&world.fleet, &Filter::default(), 1, &|_| None, world.now());
    assert_eq!(shown["nodes"]["robot-1"]["problems"], 1000, "all are counted");
}

#[test]
fn what_is_no_summary_is_refused() {
    let now = World::new().now();
    for bad in ["", "[]", "{}", "{\"health\":{}}", "{\"health\":{\"state\":1}}"] {
        assert!(Report::read(bad.to_owned(), now).is_err(), "{bad}");
    }
    let odd = json!({
        "health": { "state": "fine", "problems": [1, {}], "services": [null, { "service": "a" }] },
        "flows": [null, { "flow": "nowhere", "links": [{ "flow": "x", "state": "up" }] }],
    });
    let report = Report::read(odd.to_string(), now).unwrap();
    assert_eq!((report.head.state, report.head.flows), (Health::Unknown, 1));
    let detail = report.detail(&"edge".parse().unwrap());
    assert_eq!((detail.problems.len(), detail.services.len(), detail.links.len()), (0, 1, 0));
    assert_eq!(report.seen_up().len(), 1);
}
