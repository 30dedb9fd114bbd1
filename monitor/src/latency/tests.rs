use std::time::{Duration, Instant};

use blaze_domain::WriterId;
use prometheus::proto::LabelPair;
use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;

const T0_NS: i64 = 1_767_225_600_000_000_000;
const MS: i64 = 1_000_000;

fn rule(pattern: &str, observe: Observe, stamp: Stamp) -> LatencyRule {
    LatencyRule { pattern: pattern.parse().unwrap(), observe, max_rate_hz: None, stamp }
}

fn subscribed() -> Latency {
    Latency::new(vec![rule("**", Observe::Subscribe, Stamp::Publish)]).unwrap()
}

/// Topic and publisher of messages.
struct Pair(TopicName, FlowId);

impl Pair {
    fn new(topic: &str, from: &str) -> Self {
        Self(topic.parse().unwrap(), from.parse().unwrap())
    }

    /// Published at `T0_NS` by its clock, received so many ns later by ours.
    fn message(&self, later_ns: i64) -> Message<'_> {
        Message {
            topic: &self.0,
            from: &self.1,
            writer: WriterId([1; 16]),
            sequence: 1,
            stamp_ns: Some(T0_NS),
            published_ns: Some(T0_NS),
            received_ns: T0_NS + later_ns,
            age_ns: None,
            offset: None,
        }
    }
}

fn offset(offset_s: f64, error_s: f64) -> Option<Offset> {
    Some(Offset { offset_s, error_s })
}

fn flow_figures(rtt_ms: f64) -> FlowFigures {
    FlowFigures {
        flow: "cloud/cloud-1".parse().unwrap(),
        is_here: true,
        bridges: Vec::new(),
        links: serde_json::from_value(json!([
            { "flow": "edge/robot-1", "state": "up", "rtt_ms": rtt_ms },
            { "flow": "edge/robot-2", "state": "up", "rtt_ms": 90.0 },
        ]))
        .unwrap(),
        publishers: [("imu/data".to_owned(), vec!["edge/robot-1".parse().unwrap()])].into(),
    }
}

/// An item of `/v1/bridges`.
fn bridge(topic: &str, from: &str, to: &Value, time: &Value, age: &Value) -> Bridge {
    serde_json::from_value(json!({
        "id": "", "topic": topic, "from": {"scope": from, "broker": "dds"}, "to": to,
        "state": "up", "in": {"messages": 455, "bytes": 1}, "out": {"messages": 455, "bytes": 1},
        "dropped": {}, "latency_ms": time, "age_ms": age,
    }))
    .unwrap()
}

/// The robot sends over the link, the cloud delivers to its layer.
fn both_flows() -> Vec<FlowFigures> {
    let mut here = flow_figures(20.0);
    let to_layer = json!({"scope": "layer", "broker": "kafka", "flow": "cloud/cloud-1"});
    let time = json!({"p50": 0.5, "p99": 1.5});
    let age = json!({"p50": 14.0, "p99": 30.0});
    here.bridges = vec![bridge("imu/data", "inter", &to_layer, &time, &age)];
    let to_cloud = json!({"scope": "inter", "broker": "dds", "flow": "cloud/cloud-1"});
    let time = json!({"p50": 1.0, "p99": 2.0});
    let sender = FlowFigures {
        flow: "edge/robot-1".parse().unwrap(),
        is_here: false,
        bridges: vec![bridge("imu/data", "node", &to_cloud, &time, &Value::Null)],
        links: Vec::new(),
        publishers: Default::default(),
    };
    vec![sender, here]
}

proptest! {
    /// Whatever the clocks say: the true latency is within the stated error, and never below 0.
    #[test]
    fn the_true_latency_is_within_the_error(
        true_ns in 0..10_000_000_000_i64,
        clock_ns in -3_000_000_000..3_000_000_000_i64,
        error_ns in 0..50_000_000_i64,
        part in -1.0..1.0_f64,
    ) {
        let pair = Pair::new("t", "edge/robot-1");
        // Their clock is `clock_ns` ahead; the estimate is off by a part of its bound.
        let offset_s = (clock_ns as f64 + part * error_ns as f64) / 1e9;
        let message = Message {
            offset: offset(offset_s, error_ns as f64 / 1e9),
            ..pair.message(true_ns - clock_ns)
        };
        let outcome = subscribed().message(Instant::now(), &message);
        prop_assert!(!outcome.drop_offset);
        if let Some(Measured { latency_s, error_s, method }) = outcome.measured {
            prop_assert_eq!(method, Method::Clock);
            prop_assert!(latency_s >= 0.0);
            prop_assert!((latency_s - true_ns as f64 / 1e9).abs() <= error_s + 1e-6);
            prop_assert!(error_s <= 0.001_f64.max(latency_s / 2.0));
        } else {
            prop_assert!(error_ns > 1_000_000, "an error of 1 ms is always good enough");
        }
    }

    #[test]
    fn no_message_panics_or_gives_nonsense(
        stamps in any::<[Option<i64>; 2]>(),
        received_ns in any::<i64>(),
        age_ns in any::<Option<u64>>(),
        offset in prop::option::of(any::<(f64, f64)>()),
        sequence in any::<u64>(),
        is_header in any::<bool>(),
    ) {
        let stamp = if is_header { Stamp::Header } else { Stamp::Publish };
        let mut latency = Latency::new(vec![rule("t", Observe::Subscribe, stamp)]).unwrap();
        let pair = Pair::new("t", "a/b");
        let message = Message {
            stamp_ns: stamps[0],
            published_ns: stamps[1],
            received_ns,
            age_ns,
            offset: offset.map(|(offset_s, error_s)| Offset { offset_s, error_s }),
            sequence,
            ..pair.message(0)
        };
        for sequence in [sequence, u64::MAX, 0] {
            let outcome = latency.message(Instant::now(), &Message { sequence, ..message.clone() });
            if let Some(measured) = outcome.measured {
                prop_assert!((0.0..=3_600.0).contains(&measured.latency_s));
            }
        }
        let rows = latency.body().topics;
        prop_assert_eq!(rows[0].messages, 3);
    }
}

#[test]
fn within_the_error_it_is_zero_and_beyond_the_offset_is_dropped() {
    let (mut latency, pair) = (subscribed(), Pair::new("t", "edge/robot-1"));
    let mut measure = |later_ns: i64, age_ns| {
        let message = Message { offset: offset(0.0, 0.001), age_ns, ..pair.message(later_ns) };
        let outcome = latency.message(Instant::now(), &message);
        let got = outcome.measured.map(|measured| (measured.latency_s, measured.method));
        (got, outcome.drop_offset)
    };
    assert_eq!(measure(-MS, None), (Some((0.0, Method::Clock)), false));
    assert_eq!(measure(-2 * MS, None), (None, true));
    assert_eq!(measure(-2 * MS, Some(3_000_000)), (Some((0.003, Method::Age)), true));
    let row = &latency.body().topics[0];
    assert_eq!((row.messages, row.unknown), (3, 1));
}

#[test]
fn a_bad_clock_gives_way_to_the_age_with_half_the_round_trip_as_error() {
    let (mut latency, pair) = (subscribed(), Pair::new("t", "edge/robot-1"));
    latency.observe(vec![flow_figures(20.0)]);
    let bad = Message { offset: offset(0.0, 0.006), ..pair.message(10 * MS) };
    assert_eq!(latency.message(Instant::now(), &bad).measured, None);
    let aged = Message { age_ns: Some(12_000_000), ..bad };
    let measured = latency.message(Instant::now(), &aged).measured.unwrap();
    let want = Measured { latency_s: 0.012, error_s: 0.01, method: Method::Age };
    assert_eq!(measured, want);
    let good = Message { offset: offset(0.0, 0.005), ..aged };
    let measured = latency.message(Instant::now(), &good).measured.unwrap();
    assert_eq!((measured.latency_s, measured.method), (0.01, Method::Clock));
}

#[test]
fn the_age_of_a_header_counts_from_its_stamp() {
    let rules = vec![rule("t", Observe::Subscribe, Stamp::Header)];
    let mut latency = Latency::new(rules).unwrap();
    let pair = Pair::new("t", "edge/robot-1");
    let message = Message {
        published_ns: Some(T0_NS + 30 * MS),
        age_ns: Some(12_000_000),
        ..pair.message(0)
    };
    let measured = latency.message(Instant::now(), &message).measured.unwrap();
    assert!((measured.latency_s - 0.042).abs() < 1e-9, "30 ms to publish, 12 ms on the way");
    // A stamp of a recording or a simulation, by far too old.
    let recorded = Message { stamp_ns: Some(5), offset: offset(0.0, 0.0), ..message };
    assert_eq!(latency.message(Instant::now(), &recorded).measured, None);
}

#[test]
fn losses_are_the_gaps_of_each_writer_and_late_messages_fill_them() {
    let (mut latency, pair) = (subscribed(), Pair::new("t", "edge/robot-1"));
    let numbers = [(1, 10), (2, 1), (1, 11), (1, 15), (1, 13), (2, 2), (2, 5), (1, 15)];
    for (writer, sequence) in numbers {
        let writer = WriterId([writer; 16]);
        latency.message(Instant::now(), &Message { writer, sequence, ..pair.message(0) });
    }
    assert_eq!(latency.body().topics[0].lost, Some(4), "12 and 14 of one, 3 and 4 of the other");

    let thinned =
        LatencyRule { max_rate_hz: Some(1.0), ..rule("t", Observe::Subscribe, Stamp::Publish) };
    let mut latency = Latency::new(vec![thinned]).unwrap();
    for sequence in [1, 50, 100] {
        latency.message(Instant::now(), &Message { sequence, ..pair.message(0) });
    }
    assert_eq!(latency.body().topics[0].lost, None, "gaps are made on purpose");
}

#[test]
fn writers_are_bounded_and_the_one_that_is_silent_for_longest_is_forgotten() {
    let (mut writers, start) = (Writers::default(), Instant::now());
    let writer = |n: usize| WriterId((n as u128).to_be_bytes());
    let at = |n: usize| start + Duration::from_millis(n as u64);
    for n in 0..limits::MAX_WRITERS {
        writers.note(writer(n), 1, at(n));
    }
    writers.note(writer(0), 2, at(10_000));
    assert_eq!(writers.note(writer(9_999), 7, at(10_001)), 0);
    assert_eq!(writers.forgotten, 1);
    assert_eq!(writers.note(writer(0), 5, at(10_002)), 2, "still known");
    assert_eq!(writers.note(writer(1), 9, at(10_003)), 0, "begins anew");
}

#[test]
fn the_quantiles_are_of_the_last_values() {
    let (mut latency, pair) = (subscribed(), Pair::new("t", "edge/robot-1"));
    for n in 0..(limits::WINDOW as i64 + 100) {
        let later = if n < 100 { 900 } else { n - 99 };
        let message = Message { offset: offset(0.0, 0.0001), ..pair.message(later * MS) };
        latency.message(Instant::now(), &message);
    }
    let row = &latency.body().topics[0];
    assert_eq!(row.latency_ms, Quantiles { p50: Some(128.0), p99: Some(254.0) });
    assert_eq!((row.error_ms, row.method), (Some(0.1), Some(Method::Clock)));
}

#[test]
fn labels_and_pairs_are_bounded_and_idle_pairs_give_their_places() {
    let (mut latency, start) = (subscribed(), Instant::now());
    let send = |latency: &mut Latency, topic: usize, node: usize, at: Instant| {
        let pair = Pair::new(&format!("t/{topic}"), &format!("edge/n{node}"));
        let message = Message { offset: offset(0.0, 0.0), ..pair.message(MS) };
        latency.message(at, &message);
    };
    for n in 0..400 {
        send(&mut latency, n, 0, start);
        send(&mut latency, 0, n, start);
    }
    let labels = |latency: &Latency| {
        let topics: BTreeSet<String> = latency.rows.iter().map(|(k, _)| k.topic.clone()).collect();
        let nodes: BTreeSet<String> = latency.rows.iter().map(|(k, _)| k.node.clone()).collect();
        (topics.len(), nodes.len())
    };
    assert_eq!(labels(&latency), (256, 256));
    for n in 0..4_000 {
        send(&mut latency, n % 63, n / 63, start);
    }
    assert_eq!(latency.rows.iter().count(), limits::MAX_PAIRS);
    assert_eq!(labels(&latency), (256, 256));
    let all: u64 = latency.rows.iter().map(|(_, row)| row.messages).sum();
    assert_eq!(all, 4_800, "what has no row of its own is in `_other`");
    send(&mut latency, 9_999, 0, start + limits::IDLE);
    let rows = latency.body().topics;
    assert_eq!((rows.len(), &*rows[0].topic), (1, "t/9999"));
    let families = latency.metrics();
    let series = families.iter().find(|family| family.name() == SECONDS.name).unwrap();
    assert_eq!(series.get_metric().len(), 1, "series leave with their rows");
}

#[test]
fn a_passive_topic_has_a_row_from_the_flows_figures() {
    let mut latency = Latency::new(vec![rule("imu/*", Observe::Flow, Stamp::Publish)]).unwrap();
    latency.observe(both_flows());
    assert_eq!(
        serde_json::to_value(latency.body()).unwrap(),
        json!({"left_out": 0, "topics": [{
        "topic": "imu/data", "from": "edge/robot-1", "observe": "flow", "stamp": "publish",
        "method": "age", "messages": 455, "latency_ms": {"p50": 14.0, "p99": 30.0},
        "error_ms": 10.0, "unknown": 0, "lost": null,
        "hops": [
            {"where": "flow edge/robot-1", "p50_ms": 1.0, "p99_ms": 2.0},
            {"where": "link edge/robot-1", "p50_ms": 10.0, "p99_ms": 10.0},
            {"where": "flow cloud/cloud-1", "p50_ms": 0.5, "p99_ms": 1.5},
            {"where": "brokers", "p50_ms": 2.5, "p99_ms": 16.5},
        ]}]})
    );
    let message = latency.message(Instant::now(), &Pair::new("imu/data", "a/b").message(MS));
    assert_eq!(message, Outcome::default(), "it has no subscriber");
    latency.observe(Vec::new());
    assert_eq!(latency.body().topics, []);
}

#[test]
fn parts_that_are_not_known_are_named_with_the_rest_and_no_part_is_negative() {
    let mut latency = Latency::new(vec![rule("**", Observe::Flow, Stamp::Publish)]).unwrap();
    let mut flows = both_flows();
    flows.remove(0);
    latency.observe(flows.clone());
    let rest = |latency: &Latency| latency.body().topics[0].hops.last().cloned().unwrap();
    assert_eq!(rest(&latency).place, "brokers and flow edge/robot-1");
    // The round trip grew since: the parts are more than the whole.
    flows[0].links[0].rtt_ms = Some(60.0);
    latency.observe(flows.clone());
    let hop = rest(&latency);
    assert_eq!((hop.p50_ms, hop.p99_ms), (0.0, 0.0));
    // Two publishers: their messages are counted together, over the slowest link at worst.
    let publishers = vec!["edge/robot-1".parse().unwrap(), "edge/robot-2".parse().unwrap()];
    flows[0].publishers.insert("imu/data".to_owned(), publishers);
    latency.observe(flows);
    let row = &latency.body().topics[0];
    assert_eq!((row.from.clone(), row.error_ms), (None, Some(45.0)));
    assert_eq!(row.hops.len(), 2);
}

#[test]
fn a_subscribed_topic_is_split_by_hop_and_begins_anew_with_another_rule() {
    let mut latency = subscribed();
    latency.observe(both_flows());
    let pair = Pair::new("imu/data", "edge/robot-1");
    let message = Message { offset: offset(0.0, 0.0005), ..pair.message(20 * MS) };
    latency.message(Instant::now(), &message);
    let hops = latency.body().topics[0].hops.clone();
    let sum: f64 = hops.iter().map(|hop| hop.p50_ms).sum();
    assert!((sum - 20.0).abs() < 1e-6 && hops.len() == 4, "{hops:?}");
    latency.set_rules(vec![rule("**", Observe::Subscribe, Stamp::Publish)]);
    assert_eq!(latency.body().topics[0].messages, 1);
    latency.set_rules(vec![rule("**", Observe::Subscribe, Stamp::Header)]);
    assert_eq!(latency.body().topics, []);
}

#[test]
fn raw_samples_are_kept_if_asked_for_and_bounded() {
    let (mut latency, pair) = (subscribed(), Pair::new("t", "edge/robot-1"));
    let message = Message { offset: offset(0.0, 0.0), ..pair.message(MS) };
    latency.message(Instant::now(), &message);
    assert_eq!(latency.take_samples(), (Vec::new(), 0));
    latency.keep_samples(true);
    for sequence in 0..(limits::MAX_SAMPLES as u64 + 5) {
        latency.message(Instant::now(), &Message { sequence, ..message.clone() });
    }
    let (samples, dropped) = latency.take_samples();
    assert_eq!((samples.len(), dropped, samples[0].sequence), (limits::MAX_SAMPLES, 5, 5));
    assert_eq!((samples[0].latency_s, samples[0].method), (Some(0.001), Some(Method::Clock)));
    assert_eq!(latency.take_samples(), (Vec::new(), 0));
}

#[test]
fn the_metrics_are_those_of_the_table() {
    let (mut latency, pair) = (subscribed(), Pair::new("t", "edge/robot-1"));
    let unknown = pair.message(MS);
    latency.message(Instant::now(), &unknown);
    latency.message(Instant::now(), &Message { offset: offset(0.0, 0.0005), ..unknown });
    let families = latency.metrics();
    let names: Vec<&str> = families.iter().map(MetricFamily::name).collect();
    assert_eq!(names, METRICS.iter().map(|metric| metric.name).collect::<Vec<_>>());
    for (family, metric) in families.iter().zip(METRICS) {
        let [series] = family.get_metric() else { panic!("{}", metric.name) };
        let labels: BTreeSet<&str> = series.get_label().iter().map(LabelPair::name).collect();
        assert_eq!(labels, metric.labels.iter().copied().collect(), "{}", metric.name);
    }
    assert_eq!(families[0].get_metric()[0].get_histogram().get_sample_count(), 1);
    assert!((families[1].get_metric()[0].get_gauge().get_value() - 0.0005).abs() < 1e-6);
    assert!((families[2].get_metric()[0].get_counter().get_value() - 1.0).abs() < 1e-9);
}
