//! What the tests of several modules share.

use std::time::{Duration, Instant};

use blaze_domain::FlowId;
use blaze_domain::node_file::{AccessRules, NodeFile};
use blaze_proto::link::link_control::{Delta, Entry, Hello, Kind, State};
use serde_json::{Value, json};

use crate::codec::pool::Spawner;

mod random;
pub(crate) use random::Random;

/// Waits until something holds, 20 s at most.
pub(crate) fn eventually(mut holds: impl FnMut() -> bool) {
    let until = Instant::now() + Duration::from_secs(20);
    while !holds() {
        assert!(Instant::now() < until, "not within 20 s");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Starts plain threads.
pub(crate) fn on_threads() -> Spawner {
    Box::new(|name, run| std::thread::Builder::new().name(name).spawn(run).map(|_| ()))
}

/// What a node file with these rules in `flow.access` says.
pub(crate) fn access(rules: &Value) -> AccessRules {
    let file = json!({
        "layer": {
            "name": "edge",
            "kind": "edge",
        }, "node": {"name": "robot-1"}, "brokers": {"node": {"memory": {}}},
        "flow": {"access": rules},
    });
    NodeFile::read(&file).unwrap().0.flow.access
}

/// The changes of one version, in one part.
pub(crate) fn delta(to_version: u64, entries: Vec<Entry>) -> Delta {
    Delta { from_version: to_version - 1, to_version, part: 0, parts: 1, entries }
}

/// What a flow that is ready, and has announced nothing, says in its first life.
pub(crate) fn hello_of(flow: &FlowId, kind: Kind) -> Hello {
    Hello {
        layer: flow.layer.to_string(),
        node: flow.node.to_string(),
        kind: kind.into(),
        epoch: 1,
        state: State::Ready.into(),
        ..Hello::default()
    }
}
