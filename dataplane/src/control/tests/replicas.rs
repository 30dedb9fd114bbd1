//! What other flows say on the channel of the layer broker.

use blaze_proto::link::link_control::{Gateway, State};

use super::balance::said_by;
use super::*;
use crate::registry::entry_hash;

/// `fog/fog-2`, which is not on the inter scope, says Hello.
fn member(version: u64, entries: &[Entry]) -> Hello {
    Hello {
        gateway: Gateway::Never.into(),
        registry_version: version,
        registry_digest: entries.iter().map(entry_hash).fold(0, u64::wrapping_add),
        ..said_by(&FOG_2.parse().unwrap(), Kind::Fog)
    }
}

impl Bench {
    fn hear(&mut self, hello: Hello) -> bool {
        self.fog_2_says(Body::Hello(hello), None)
    }

    /// A gateway and a member that asks for three topics.
    fn with_member() -> (Self, [Entry; 3]) {
        let (mut bench, entries) = (Self::inside(), ["a", "b", "c"].map(asks_for));
        bench.hear(member(0, &[]));
        let delta = delta(1, entries.clone().into());
        assert!(bench.fog_2_says(Body::Delta(delta), None));
        (bench, entries)
    }
}

#[test]
fn a_sign_of_life_that_says_nothing_new_is_no_reason_to_work() {
    let (mut bench, entries) = Bench::with_member();
    assert!(!bench.hear(member(1, &entries)));
    let leaving = Hello { state: State::Draining.into(), ..member(1, &entries) };
    assert!(bench.hear(leaving), "it goes");
}

#[test]
fn a_program_with_the_own_name_is_named() {
    let mut bench = Bench::inside();
    let me = bench.core.config.me.clone();
    let own = bench.core.config.epoch;
    let mut hear = |began: u64, after_ms: u64| {
        let now = bench.now + Duration::from_millis(after_ms);
        let message = LinkControl {
            body: Some(Body::Hello(said_by(&me, Kind::Fog))),
            channel: Some(Channel { from: me.to_string(), epoch: began, began, to: String::new() }),
        };
        bench.core.replica_message(now, Some(message), None);
        bench.core.namesake(now).map(|conflict| conflict.is_refused)
    };
    assert_eq!(hear(own, 0), None, "that is this program");
    // An older one: its last words may come late.
    assert_eq!(hear(own - 1, 100), None);
    assert_eq!(hear(own - 1, 2_599), None);
    assert_eq!(hear(own - 1, 2_600), Some(false));
    assert_eq!(hear(own, 5_200), None, "it is silent");
    assert_eq!(hear(own + 1, 5_300), Some(true));
}

#[test]
fn what_cannot_be_read_is_counted_and_does_no_harm() {
    let mut bench = Bench::inside();
    for payload in [&b"\xff\xff\xff"[..], b"{}", &[0; 100_000]] {
        let read = read_replica_message(payload);
        assert!(!bench.core.replica_message(bench.now, read, None));
    }
    assert_eq!(bench.core.refused_replica_messages(), 3);
    assert!(!bench.core.replica_message(bench.now, Some(LinkControl::default()), None));
}

#[test]
fn a_gateway_does_not_reckon_anew_what_has_not_changed() {
    let (mut bench, entries) = Bench::with_member();
    let quiet = SETTLED_AFTER + 2 * RECONCILE;
    let mut reckoned = Vec::new();
    let start = bench.now;
    while bench.now < start + 2 * quiet {
        bench.hear(member(1, &entries));
        bench.step(20);
        if bench.core.registry().has_unannounced() {
            reckoned.push(bench.now - start);
        }
    }
    assert!(!reckoned.is_empty(), "at first it tells what the member asks for");
    assert!(reckoned.iter().all(|at| *at < quiet), "{reckoned:?}");
    assert_eq!(bench.core.registry().announced().0, 1);
}
