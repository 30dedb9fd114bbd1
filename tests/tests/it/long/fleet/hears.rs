//! Of a change hear those whose own configuration is another one by it, and nobody else.

use blaze_tests::fleet::{Listener, MainService, MainStore, wait_equal};
use serde_json::{Value, json};

use super::{LAYER, PATIENCE, make_nodes, node, service, start_workers};

/// Nodes, each with a worker and four listeners.
const NODES: usize = 3;
/// Services and instances that listen on each node.
const LISTENERS: [(&str, &str); 4] = [("slam", "0"), ("slam", "1"), ("nav", "0"), ("log", "0")];

/// Who listens: node, service, instance.
type Who = (usize, &'static str, &'static str);

/// A write, and who must hear of it.
struct Case {
    what: &'static str,
    path: &'static str,
    spec: Value,
    hears: fn(&Who) -> bool,
}

fn cases() -> Vec<Case> {
    let case = |what, path, spec, hears| Case {
        what,
        path,
        spec,
        hears,
    };
    vec![
        case(
            "an override of one node for one service",
            "/nodes/robot-1",
            json!({ "layer": LAYER, "overrides": { "slam": { "rate_hz": 5 } } }),
            |(node, service, _)| *node == 1 && *service == "slam",
        ),
        case(
            "the default of a service, which one node overrides",
            "/services/slam",
            json!({ "config": { "verbosity": "info", "rate_hz": 20, "gain": 1 } }),
            |(node, service, _)| *node != 1 && *service == "slam",
        ),
        case(
            "another description",
            "/services/slam",
            json!({ "config": { "verbosity": "info", "rate_hz": 20, "gain": 1 }, "description": "localisation" }),
            |_| false,
        ),
        case(
            "one instance, wherever it runs",
            "/services/slam/instances/1",
            json!({ "node": node(0), "config": { "gain": 2 } }),
            |(_, service, instance)| (*service, *instance) == ("slam", "1"),
        ),
        case(
            "a configuration of the layer that all have already, and an override for nobody",
            "/layers/edge",
            json!({ "kind": "edge", "config": { "verbosity": "info" }, "overrides": { "other": { "x": 1 } } }),
            |_| false,
        ),
        case(
            "a configuration of the layer",
            "/layers/edge",
            json!({ "kind": "edge", "config": { "verbosity": "debug" } }),
            |_| true,
        ),
        case(
            "an override of the layer for one service",
            "/layers/edge",
            json!({ "kind": "edge", "config": { "verbosity": "debug" }, "overrides": { "nav": { "speed": 2 } } }),
            |(_, service, _)| *service == "nav",
        ),
        case(
            "a configuration of one node",
            "/nodes/robot-2",
            json!({ "layer": LAYER, "config": { "verbosity": "trace" } }),
            |(node, _, _)| *node == 2,
        ),
        case(
            "what the layer says and one node overrides",
            "/layers/edge",
            json!({ "kind": "edge", "config": { "verbosity": "warn" }, "overrides": { "nav": { "speed": 2 } } }),
            |(node, _, _)| *node != 2,
        ),
    ]
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_each_change_hear_those_whose_configuration_is_another_one_by_it() {
    let folder = tempfile::tempdir().unwrap();
    let main = MainService::start(folder.path(), &MainStore::Sqlite).unwrap();
    let api = main.api().unwrap();
    make_nodes(&api, (0..NODES).map(node)).await;
    let info = |more: Value| {
        let mut config = json!({ "verbosity": "info" });
        config
            .as_object_mut()
            .unwrap()
            .extend(more.as_object().unwrap().clone());
        config
    };
    let documents = [
        service("slam", &info(json!({ "rate_hz": 30, "gain": 1 }))),
        service("nav", &info(json!({ "speed": 1 }))),
        service("log", &info(json!({}))),
        json!({ "kind": "Instance", "service": "slam", "name": "1", "spec": { "node": node(0) } }),
    ];
    api.apply(&documents).await.unwrap();
    let workers = start_workers(&main, folder.path(), NODES).await;
    wait_equal(&api, &workers, PATIENCE).await.unwrap();
    let mut listeners: Vec<(Who, Listener)> = Vec::new();
    for (number, worker) in workers.iter().enumerate() {
        for (service, instance) in LISTENERS {
            let listener = Listener::start(worker, service, instance, PATIENCE).await.unwrap();
            listeners.push(((number, service, instance), listener));
        }
    }
    let mut expected: Vec<Vec<(u64, &str)>> = vec![Vec::new(); listeners.len()];
    for case in cases() {
        let revision = api.replace(case.path, case.spec).await.unwrap();
        // Two changes within 20 ms may be told as one, so that each is waited for; who should not hear has no time by which
        // it would have, and is looked at in the end.
        for ((who, listener), expected) in listeners.iter_mut().zip(&mut expected) {
            if (case.hears)(who) {
                expected.push((revision, case.what));
                let heard = listener.next(PATIENCE).await.unwrap();
                assert_eq!(heard.revision, revision, "{who:?} was to hear of {}", case.what);
            }
        }
        wait_equal(&api, &workers, PATIENCE).await.unwrap();
    }
    // Everybody hears of this; whatever was told before it has come before it.
    let revision = api
        .replace("/layers/edge", json!({ "kind": "edge", "config": { "end": true } }))
        .await
        .unwrap();
    for ((who, listener), expected) in &mut listeners.iter_mut().zip(&expected) {
        let next = listener.next(PATIENCE).await.unwrap();
        assert_eq!(
            next.revision, revision,
            "{who:?} heard of what does not concern it, after {expected:?}"
        );
        assert_eq!(next.config.unwrap()["end"], true);
    }
}
