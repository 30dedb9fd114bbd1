//! What the tests of several modules share.

use std::time::{Duration, Instant};

use blaze_domain::FlowId;
use blaze_domain::node_file::{AccessRules, NodeFile};
use blaze_proto::link::link_control::{Delta, Entry, Hello, Kind, State};
use serde_json::{Value, json};

use crate::codec::pool::Spawner;

/// Random numbers from a seed (SplitMix64, public domain, Vigna): the same everywhere.
#[derive(Debug, Clone)]
pub(crate) struct Random(pub(crate) u64);

impl Random {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// A number below `end`; 0 if that is 0.
    pub(crate) fn below(&mut self, end: u64) -> u64 {
        self.next().checked_rem(end).unwrap_or(0)
    }

    /// The same for places in a list.
    pub(crate) fn index(&mut self, length: usize) -> usize {
        self.below(length as u64) as usize
    }

    pub(crate) fn pick<'a, T>(&mut self, from: &'a [T]) -> &'a T {
        &from[self.index(from.len())]
    }

    pub(crate) fn byte(&mut self) -> u8 {
        self.next().to_le_bytes()[0]
    }

    pub(crate) fn bytes(&mut self, count: usize) -> Vec<u8> {
        (0..count).map(|_| self.byte()).collect()
    }

    /// From 0 to 1.
    pub(crate) fn share(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    pub(crate) fn chance(&mut self, share: f64) -> bool {
        self.share() < share
    }

    pub(crate) fn percent(&mut self, chance: u64) -> bool {
        self.below(100) < chance
    }

    pub(crate) fn duration(&mut self, end: Duration) -> Duration {
        Duration::from_nanos(self.below(u64::try_from(end.as_nanos()).unwrap()))
    }
}

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
