use blaze_domain::Priority;
use blaze_proto::link::{LinkControl, link_control::Body};
use proptest::prelude::*;

use super::super::pieces::{MAX_LINK_CONTROL_BYTES, entry_hash, join, pack, pieces};
use super::*;

fn text(limit: usize) -> impl Strategy<Value = String> {
    proptest::collection::vec(b'a'..=b'z', 1..=limit)
        .prop_map(|bytes| String::from_utf8(bytes).unwrap_or_default())
}

fn any_advertise() -> impl Strategy<Value = Advertise> {
    let source = (text(63), text(63)).prop_map(|(node, service)| Source { node, service });
    (
        proptest::option::of(0.001..1e9_f64),
        proptest::option::of(1..u64::MAX),
        text(200),
        text(200),
        text(200),
        proptest::collection::btree_set(source, 1..20),
        any::<u32>(),
    )
        .prop_map(
            |(rate_hz, max_bytes, encoding, type_name, type_hash, sources, lifespan_ms)| {
                Advertise {
                    rate_hz,
                    max_bytes,
                    encoding,
                    type_name,
                    type_hash,
                    reliability: Reliability::Reliable,
                    durability: Durability::TransientLocal,
                    depth: 65_535,
                    priority: Some(Priority::Bulk),
                    lifespan_ms,
                    sources: sources.into_iter().collect(),
                    more_sources: false,
                }
            },
        )
}

fn any_request() -> impl Strategy<Value = Request> {
    let part = || proptest::option::of(text(63));
    let filter = (text(63), part(), part()).prop_map(|(layer, node, service)| OriginFilter {
        layer: Some(layer),
        node,
        service,
    });
    (
        proptest::option::of(0.001..1e9_f64),
        text(200),
        text(200),
        proptest::collection::btree_set(filter, 0..=MAX_FILTERS),
        any::<u32>(),
        (proptest::collection::btree_set((text(63), text(63)), 0..=MAX_REQUESTERS), any::<u32>()),
    )
        .prop_map(|(max_rate_hz, type_name, type_hash, from, lifespan_ms, who)| Request {
            max_rate_hz,
            lifespan_ms,
            reliability: Reliability::Reliable,
            durability: Durability::Volatile,
            depth: 1,
            priority: None,
            from: from.into_iter().collect(),
            type_name,
            type_hash,
            services: who.0.into_iter().map(|(node, service)| Source { node, service }).collect(),
            more_services: who.1,
            framed: who.1 % 2 == 0,
            bare: false,
            json: who.1 % 3 == 0,
        })
}

fn any_entry() -> impl Strategy<Value = (TopicName, TopicEntry, Vec<wire::RouteState>)> {
    let scope = || {
        (proptest::option::of(any_advertise()), proptest::option::of(any_request()))
            .prop_map(|(advertise, request)| ScopeEntry { advertise, request })
    };
    let route = (text(63), text(127), text(16), any::<bool>(), any::<u64>()).prop_map(
        |(to_layer, receiver, step, ok, next_offset)| wire::RouteState {
            to_layer,
            receiver,
            step,
            ok,
            code: "name_not_expressible".into(),
            next_offset,
        },
    );
    (
        text(200),
        scope(),
        scope(),
        scope(),
        scope(),
        proptest::collection::vec(route, 0..=MAX_ROUTES),
    )
        .prop_map(|(topic, node, layer, ros2, outside, routes)| {
            (topic.parse().unwrap(), TopicEntry { node, layer, ros2, outside }, routes)
        })
}

fn encoded(body: Body) -> usize {
    LinkControl::from(body).encoded_len()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn entries_of_any_size_fit_datagrams_and_come_back(entries in proptest::collection::vec(any_entry(), 1..5)) {
        let whole: Vec<_> =
            entries.iter().map(|(topic, entry, routes)| to_wire(topic, entry, routes)).collect();
        let parts = pack(whole.iter().cloned().flat_map(pieces));
        for entries in &parts {
            let largest = wire::Delta {
                from_version: u64::MAX, to_version: u64::MAX, part: u32::MAX, parts: u32::MAX,
                entries: entries.clone(),
            };
            prop_assert!(encoded(Body::Delta(largest)) <= MAX_LINK_CONTROL_BYTES);
            let largest =
                wire::Snapshot { version: u64::MAX, part: u32::MAX, parts: u32::MAX,
                entries: entries.clone() };
            prop_assert!(encoded(Body::Snapshot(largest)) <= MAX_LINK_CONTROL_BYTES);
        }
        let joined = join(parts.into_iter().flatten());
        for (whole, (topic, entry, _)) in whole.iter().zip(&entries).rev() {
            if whole.topic != topic.as_str()
                || entries.iter().filter(|(other, _, _)| other == topic).count() > 1 {
                continue;
            }
            let back = &joined[topic.as_str()];
            prop_assert_eq!(back, whole);
            prop_assert_eq!(entry_hash(back), entry_hash(whole));
            let (back_topic, back) = from_wire(back).unwrap();
            prop_assert_eq!(&back_topic, topic);
            // Only names of services may have been left out.
            let mut expected = entry.clone();
            let scopes = [
                (&mut expected.node, &back.node),
                (&mut expected.layer, &back.layer),
                (&mut expected.ros2, &back.ros2),
                (&mut expected.outside, &back.outside),
            ];
            for (expected, back) in scopes {
                if let (Some(expected), Some(back)) = (&mut expected.advertise, &back.advertise) {
                    prop_assert_eq!(back.more_sources, back.sources.len() < expected.sources.len());
                    prop_assert!(!back.sources.is_empty());
                    prop_assert!(expected.sources.starts_with(&back.sources));
                    expected.sources.clone_from(&back.sources);
                    expected.more_sources = back.more_sources;
                }
                if let (Some(expected), Some(back)) = (&mut expected.request, &back.request) {
                    prop_assert!(expected.services.starts_with(&back.services));
                    let left_out = expected.services.len() - back.services.len();
                    let left_out = u32::try_from(left_out).unwrap();
                    prop_assert_eq!(
                        back.more_services,
                        expected.more_services.saturating_add(left_out)
                    );
                    expected.services.clone_from(&back.services);
                    expected.more_services = back.more_services;
                }
            }
            prop_assert_eq!(back, expected);
        }
    }
}

#[test]
fn faulty_entries_are_named() {
    let good = wire::Entry { topic: "a".into(), ..wire::Entry::default() };
    let fault = |change: &dyn Fn(&mut wire::Entry)| {
        let mut entry = good.clone();
        change(&mut entry);
        from_wire(&entry).unwrap_err()
    };
    assert!(from_wire(&good).is_ok());
    assert_eq!(fault(&|entry| entry.topic = "a b".into()), EntryFault::Topic);
    assert_eq!(fault(&|entry| entry.topic = "blaze/flow/control".into()), EntryFault::Topic);
    let advertise = wire::Advertise { encoding: "e".repeat(201), ..wire::Advertise::default() };
    assert_eq!(
        fault(&|entry| entry.node_advertise = Some(advertise.clone())),
        EntryFault::TooLong("the encoding")
    );
    let request = wire::Request {
        from: vec![wire::From::default(); MAX_FILTERS + 1],
        ..wire::Request::default()
    };
    assert_eq!(
        fault(&|entry| entry.layer_request = Some(request.clone())),
        EntryFault::TooMany("origin filters")
    );
    assert_eq!(
        fault(&|entry| entry.route_state = vec![wire::RouteState::default(); MAX_ROUTES + 1]),
        EntryFault::TooMany("route states")
    );
}

#[test]
fn names_of_requesters_are_no_part_of_the_digest() {
    let entry = |services: Vec<wire::Source>, more_services| wire::Entry {
        topic: "a".into(),
        layer_request: Some(wire::Request { services, more_services, ..wire::Request::default() }),
        ..wire::Entry::default()
    };
    let named = wire::Source { node: String::new(), service: "dashboard".into() };
    assert_eq!(entry_hash(&entry(vec![named], 7)), entry_hash(&entry(Vec::new(), 0)));
}

/// Flows of earlier versions reckon it without them.
#[test]
fn what_is_told_of_ros2_and_json_is_no_part_of_the_digest() {
    let plain = wire::Entry {
        topic: "a".into(),
        layer_request: Some(wire::Request::default()),
        ..wire::Entry::default()
    };
    let request = wire::Request { json: true, unframed: true, ..wire::Request::default() };
    let more = wire::Entry {
        layer_request: Some(request),
        ros2_advertise: Some(wire::Advertise::default()),
        ros2_request: Some(wire::Request::default()),
        ..plain.clone()
    };
    assert_eq!(entry_hash(&plain), entry_hash(&more));
    assert_eq!(from_wire(&plain).unwrap().1.ros2, ScopeEntry::default());
}

#[test]
fn absurd_numbers_of_others_become_none() {
    for rate in [f64::NAN, f64::INFINITY, -1.0, 0.0] {
        let entry = wire::Entry {
            topic: "a".into(),
            node_advertise: Some(wire::Advertise {
                rate_hz: rate,
                priority: 99,
                ..wire::Advertise::default()
            }),
            ..wire::Entry::default()
        };
        let (_, merged) = from_wire(&entry).unwrap();
        let advertise = merged.node.advertise.unwrap();
        assert_eq!((advertise.rate_hz, advertise.priority, advertise.depth), (None, None, 1));
        assert_eq!(advertise.encoding, DEFAULT_ENCODING);
    }
}
