//! What other flows say on the channel of the layer broker.

use blaze_proto::link::LinkControl;
use blaze_proto::link::link_control::{Channel, Delta, Entry, Gateway, Hello, Kind, Request, State};
use prost::Message as _;

use super::*;
use crate::registry::entry_hash;

fn entry(topic: &str) -> Entry {
    Entry {
        topic: topic.to_owned(),
        node_request: Some(Request::default()),
        ..Entry::default()
    }
}

/// `fog/fog-2`, which is not on the inter scope and asks for these topics.
fn said(body: Body) -> LinkControl {
    LinkControl {
        body: Some(body),
        channel: Some(Channel {
            from: "fog/fog-2".to_owned(),
            epoch: 1,
            began: 1,
            to: String::new(),
        }),
    }
}

fn member(version: u64, entries: &[Entry]) -> LinkControl {
    said(Body::Hello(Hello {
        layer: "fog".to_owned(),
        node: "fog-2".to_owned(),
        kind: Kind::Fog.into(),
        epoch: 1,
        state: State::Ready.into(),
        gateway: Gateway::Never.into(),
        layer_scope_id: LayerScopeId::kafka("").0,
        registry_version: version,
        registry_digest: entries.iter().map(entry_hash).fold(0, u64::wrapping_add),
        ..Hello::default()
    }))
}

impl Bench {
    fn hear(&mut self, message: &LinkControl) -> bool {
        let read = read_replica_message(&message.encode_to_vec());
        self.core.replica_message(self.now, read, None)
    }

    /// A gateway and a member that asks for three topics.
    fn with_member() -> (Self, [Entry; 3]) {
        let (mut bench, entries) = (Self::inside(), ["a", "b", "c"].map(entry));
        bench.hear(&member(0, &[]));
        let delta = Delta {
            from_version: 0,
            to_version: 1,
            part: 0,
            parts: 1,
            entries: entries.clone().into(),
        };
        assert!(bench.hear(&said(Body::Delta(delta))));
        (bench, entries)
    }
}

#[test]
fn a_sign_of_life_that_says_nothing_new_is_no_reason_to_work() {
    let (mut bench, entries) = Bench::with_member();
    assert!(!bench.hear(&member(1, &entries)));
    let mut leaving = member(1, &entries);
    if let Some(Body::Hello(hello)) = &mut leaving.body {
        hello.state = State::Draining.into();
    }
    assert!(bench.hear(&leaving), "it goes");
}

#[test]
fn what_cannot_be_read_is_counted_and_does_no_harm() {
    let mut bench = Bench::inside();
    for payload in [&b"\xff\xff\xff"[..], b"{}", &[0; 100_000]] {
        assert!(
            !bench
                .core
                .replica_message(bench.now, read_replica_message(payload), None)
        );
    }
    assert_eq!(bench.core.refused_replica_messages(), 3);
    assert!(!bench.hear(&LinkControl::default()));
}

#[test]
fn a_gateway_does_not_reckon_anew_what_has_not_changed() {
    let (mut bench, entries) = Bench::with_member();
    let quiet = SETTLED_AFTER + 2 * RECONCILE;
    let mut reckoned = Vec::new();
    let start = bench.now;
    while bench.now < start + 2 * quiet {
        bench.hear(&member(1, &entries));
        bench.step(20);
        if bench.core.registry().has_unannounced() {
            reckoned.push(bench.now - start);
        }
    }
    assert!(!reckoned.is_empty(), "at first it tells what the member asks for");
    assert!(reckoned.iter().all(|at| *at < quiet), "{reckoned:?}");
    assert_eq!(bench.core.registry().announced().0, 1);
}
