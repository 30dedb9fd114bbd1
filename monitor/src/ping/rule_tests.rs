//! Each rule of pings by itself.

use std::time::Duration;

use blaze_domain::FlowId;
use serde_json::{Value as Json, json};

use super::testing::{MS, Net, S, TestClock, at, node};
use super::*;
use crate::metric::Kind;

fn engine(period_s: u64) -> Engine {
    let settings = Settings { period: Duration::from_secs(period_s) };
    Engine::new(node("edge/robot-1"), settings, 7, at(0))
}

fn ping(from: &str, id: u64, to: Option<&[&str]>, clock: i64) -> Vec<u8> {
    let mut ping = json!({"id": id, "from": from, "t1": 0, "clock": clock});
    if let Some(to) = to {
        ping["to"] = json!(to);
    }
    ping.to_string().into_bytes()
}

/// An answer whose sender's clock is ahead by some milliseconds of the time of `now`.
fn pong(now: Now, id: &Json, from: &str, ahead_ms: i64, clock: i64) -> Vec<u8> {
    let t3 = now.wall_ns + ahead_ms * MS;
    let answer =
        json!({"to": "edge/robot-1", "id": id, "t2": t3, "t3": t3, "hold_ns": 0, "sync": true});
    json!({"from": from, "answers": [answer], "clock": clock}).to_string().into_bytes()
}

fn body(output: &Output) -> Json {
    serde_json::from_slice(&output.payload()).unwrap()
}

fn pings(outputs: &[Output]) -> Vec<Json> {
    let pings = outputs.iter().filter(|o| o.topic().as_str().starts_with("blaze/ping/"));
    pings.map(body).collect()
}

fn pongs(outputs: &[Output]) -> Vec<Json> {
    let pongs = outputs.iter().filter(|o| o.topic().as_str().starts_with("blaze/pong/"));
    pongs.map(body).collect()
}

/// Polls at each deadline up to a time, in milliseconds; outputs with their times.
fn run(engine: &mut Engine, from: i64, until: i64) -> Vec<(i64, Output)> {
    let mut outputs = Vec::new();
    for ms in from..until {
        if engine.next_deadline(at(ms)) <= at(ms).monotonic {
            outputs.extend(engine.poll(at(ms)).into_iter().map(|output| (ms, output)));
        }
    }
    outputs
}

#[test]
fn bad_messages_are_ignored_and_counted() {
    let mut engine = engine(60);
    let fog = node("fog/fog-1");
    for (reason, origin, payload) in [
        (Ignored::Malformed, &fog, b"{".to_vec()),
        (Ignored::Malformed, &fog, br#"{"id":-1,"from":"fog/fog-1","t1":0}"#.to_vec()),
        (Ignored::TooLarge, &fog, [ping("fog/fog-1", 1, None, 1), vec![b' '; 1_200]].concat()),
        (Ignored::Own, &node("edge/robot-1"), ping("edge/robot-1", 1, None, 1)),
        (Ignored::ForeignName, &fog, ping("fog/fog-2", 1, None, 1)),
    ] {
        let before = engine.ignored(reason);
        engine.ping_received(at(1), origin, &payload);
        assert_eq!(engine.ignored(reason), before + 1, "{reason:?}");
        if reason != Ignored::Malformed {
            continue;
        }
        engine.pong_received(at(1), origin, &payload);
        assert_eq!(engine.ignored(reason), before + 2, "{reason:?}");
    }
    let unknown = pong(at(1), &json!(1), "fog/fog-1", 0, 1);
    engine.pong_received(at(1), &node("fog/fog-2"), &unknown);
    assert_eq!(engine.ignored(Ignored::ForeignName), 2);
    engine.pong_received(at(1), &fog, &unknown);
    assert_eq!(engine.ignored(Ignored::NotAwaited), 1);
    assert!(pongs(&engine.poll(at(2_000))).is_empty());
}

#[test]
fn answers_wait_for_a_random_time_and_those_of_a_second_share_a_message() {
    let mut engine = engine(0);
    let fog = node("fog/fog-1");
    engine.ping_received(at(0), &fog, &ping("fog/fog-1", 1, None, 1));
    engine.ping_received(at(0), &fog, &ping("fog/fog-1", 2, Some(&["edge/robot-2"]), 1));
    let first = run(&mut engine, 0, 1_000);
    let [(sent, output)] = first.as_slice() else { panic!("{first:?}") };
    assert!(*sent <= 101, "{sent}");
    let body = body(output);
    let answer = &body["answers"][0];
    assert_eq!((&body["from"], &answer["to"]), (&json!("edge/robot-1"), &json!("fog/fog-1")));
    assert_eq!((&answer["id"], &answer["sync"]), (&json!(1), &json!(true)));
    assert_eq!(answer["t2"], json!(at(0).wall_ns));
    assert_eq!(answer["t3"], json!(at(*sent).wall_ns));
    assert_eq!(answer["hold_ns"], json!(sent * MS));
    // Asked more than once a second: the next message comes a second after the last one.
    for id in 3..23 {
        engine.ping_received(at(sent + 1), &fog, &ping("fog/fog-1", id, None, 1));
    }
    let second = run(&mut engine, sent + 1, sent + 3_000);
    assert!(second.iter().all(|(time, _)| *time == sent + 1_000), "{second:?}");
    assert!(second.iter().all(|(_, output)| output.payload().len() <= 1_200));
    let outputs: Vec<Output> = second.into_iter().map(|(_, output)| output).collect();
    let answers = |pong: &Json| pong["answers"].as_array().unwrap().len();
    assert_eq!(pongs(&outputs).iter().map(answers).sum::<usize>(), 20);
    assert_eq!(outputs.len(), 2, "20 answers of some 110 bytes");
    // A flood of one node is bounded.
    for id in 0..100 {
        engine.ping_received(at(9_000), &fog, &ping("fog/fog-1", id, None, 1));
    }
    assert_eq!(engine.ignored(Ignored::TooManyPings), 68);
}

#[test]
fn late_and_second_answers_are_ignored_and_lost_pings_are_counted() {
    let mut engine = engine(600);
    let fog = node("fog/fog-1");
    engine.set_requesters(at(0), [fog.clone()]);
    let sent = run(&mut engine, 0, 7_100);
    let ids: Vec<_> =
        sent.iter().map(|(time, output)| (*time, body(output)["id"].clone())).collect();
    assert_eq!(ids.len(), 7);
    let now = at(7_100);
    let second = pong(now, &ids[5].1, "fog/fog-1", 0, 1);
    engine.pong_received(now, &fog, &second);
    assert_eq!(engine.ignored(Ignored::NotAwaited), 0);
    engine.pong_received(now, &fog, &second);
    let late = pong(now, &ids[0].1, "fog/fog-1", 0, 1);
    engine.pong_received(now, &fog, &late);
    assert_eq!(engine.ignored(Ignored::NotAwaited), 2);
    run(&mut engine, 7_100, 30_000);
    let row = engine.view(at(30_000)).nodes.remove(0);
    assert_eq!((row.sent, row.lost), (8, 7));
}

#[test]
fn an_answer_held_longer_than_its_round_trip_is_ignored() {
    let mut engine = engine(60);
    let fog = node("fog/fog-1");
    engine.set_requesters(at(0), [fog.clone()]);
    let (time, output) = run(&mut engine, 0, 1_100).remove(0);
    let now = at(time + 5);
    let mut bad: Json =
        serde_json::from_slice(&pong(now, &body(&output)["id"], "fog/fog-1", 0, 1)).unwrap();
    bad["answers"][0]["hold_ns"] = json!(6 * MS);
    engine.pong_received(now, &fog, bad.to_string().as_bytes());
    assert_eq!(engine.ignored(Ignored::Negative), 1);
    assert_eq!(engine.offset(&fog, now), None);
}

/// Two nodes, 5 ms apart.
fn pair() -> Net {
    let ids = vec![node("edge/robot-1"), node("fog/fog-1")];
    Net::new(ids, vec![TestClock::default(); 2], 1, Box::new(|_, _| Some(5 * MS)))
}

fn offset_ms(net: &Net) -> Option<f64> {
    let offset = net.engines[0].offset(&net.ids[1], net.now(0))?;
    assert_eq!(offset.source, Source::Ping);
    Some(offset.offset_s * 1e3)
}

fn is_about(value: Option<f64>, expected: f64) -> bool {
    value.is_some_and(|value| (value - expected).abs() < 0.01)
}

fn sent(net: &Net) -> u64 {
    net.engines[0].view(net.now(0)).nodes[0].sent
}

#[test]
fn eight_pings_start_a_node_and_follow_a_step_of_either_clock() {
    let mut net = pair();
    net.run_until(9 * S);
    let at_start = sent(&net);
    assert!((8..=9).contains(&at_start), "{at_start}");
    assert!(is_about(offset_ms(&net), 0.0));
    for (stepping, offset) in [(0, -1_000.0), (1, 0.0)] {
        net.run_until(net.at + 20 * S);
        let before = sent(&net);
        net.clocks[stepping].course += S;
        net.poll(stepping);
        if stepping == 0 {
            assert_eq!(offset_ms(&net), None);
        }
        net.run_until(net.at + 3 * S);
        assert!(is_about(offset_ms(&net), offset), "{:?}", offset_ms(&net));
        net.run_until(net.at + 8 * S);
        assert!((8..=9).contains(&(sent(&net) - before)));
    }
}

#[test]
fn a_small_correction_of_the_own_clock_spoils_no_sample() {
    let mut net = pair();
    net.run_until(20 * S);
    net.clocks[0].course += 4 * MS;
    net.poll(0);
    assert!(is_about(offset_ms(&net), -4.0), "{:?}", offset_ms(&net));
}

#[test]
fn a_message_overtaken_by_one_after_a_step_is_ignored() {
    let mut engine = engine(60);
    let fog = node("fog/fog-1");
    engine.set_requesters(at(0), [fog.clone()]);
    let (time, output) = run(&mut engine, 0, 1_100).remove(0);
    let now = at(time + 5);
    engine.ping_received(now, &fog, &ping("fog/fog-1", 1, None, 100));
    engine.ping_received(now, &fog, &ping("fog/fog-1", 2, None, 101));
    engine.pong_received(now, &fog, &pong(now, &body(&output)["id"], "fog/fog-1", 0, 100));
    assert_eq!(engine.ignored(Ignored::Overtaken), 1);
    assert_eq!(engine.offset(&fog, now), None);
}

#[test]
fn samples_that_contradict_a_newer_one_are_dropped() {
    let mut engine = engine(60);
    let fog = node("fog/fog-1");
    engine.set_requesters(at(0), [fog.clone()]);
    let outputs = run(&mut engine, 0, 3_100);
    // The second is on its way for longer, so its error is larger.
    for ((time, output), ahead_ms) in outputs.iter().zip([3_000, 0]) {
        let now = at(if ahead_ms == 0 { 3_100 } else { time + 2 });
        engine.pong_received(now, &fog, &pong(now, &body(output)["id"], "fog/fog-1", ahead_ms, 1));
    }
    let offset = engine.offset(&fog, at(3_100)).unwrap();
    assert!(offset.offset_s < 1.5 && offset.error_s > 0.4, "{offset:?}");
}

#[test]
fn nodes_are_known_by_requests_and_messages_and_forgotten_after_three_periods() {
    let mut engine = engine(60);
    let names = |topics: &[blaze_domain::TopicName]| {
        topics.iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    engine.poll(at(0));
    let topics = engine.take_topics();
    assert_eq!(names(&topics.request), ["blaze/ping/edge"]);
    assert_eq!(names(&topics.advertise), ["blaze/pong/edge/robot-1"]);
    engine.set_requesters(at(1), [node("fog/fog-1"), node("edge/robot-1")]);
    engine.ping_received(at(1), &node("edge/robot-2"), &ping("edge/robot-2", 1, None, 1));
    engine.poll(at(1));
    let topics = engine.take_topics();
    assert_eq!(names(&topics.request), ["blaze/pong/edge/robot-2", "blaze/pong/fog/fog-1"]);
    assert_eq!(names(&topics.advertise), ["blaze/ping/edge", "blaze/ping/fog"]);
    assert_eq!(engine.take_topics(), TopicChanges::default());
    run(&mut engine, 2, 179_000);
    assert_eq!(engine.take_topics(), TopicChanges::default());
    run(&mut engine, 179_000, 195_000);
    let topics = engine.take_topics();
    assert_eq!(names(&topics.release), ["blaze/pong/edge/robot-2"]);
    assert_eq!(names(&topics.withdraw), ["blaze/ping/edge"]);
    engine.set_period(at(195_000), Duration::ZERO);
    engine.poll(at(195_000));
    let topics = engine.take_topics();
    assert_eq!(names(&topics.release), ["blaze/pong/fog/fog-1"]);
    assert!(pings(&engine.poll(at(900_000))).is_empty());
}

#[test]
fn the_period_grows_with_the_nodes_and_differs_by_a_tenth() {
    let mut engine = engine(10);
    let fogs = |count: usize| (0..count).map(|n| node(&format!("fog/fog-{n}")));
    engine.set_requesters(at(0), fogs(50));
    engine.poll(at(0));
    assert!((engine.view(at(0)).period_s - 10.0).abs() < 1e-9);
    engine.set_requesters(at(0), fogs(300));
    let times: Vec<i64> = run(&mut engine, 0, 400_000).into_iter().map(|(time, _)| time).collect();
    assert!((engine.view(at(0)).period_s - 30.0).abs() < 1e-9);
    // No eight pings at the start of many nodes.
    assert!((12..=15).contains(&times.len()), "{times:?}");
    let gaps: Vec<i64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    assert!(gaps.iter().all(|gap| (27_000..=33_001).contains(gap)), "{gaps:?}");
    assert!(gaps.iter().max() > gaps.iter().min());
}

#[test]
fn pings_name_some_of_many_nodes_and_none_of_few() {
    let mut engine = engine(60);
    let long = |n: usize| node(&format!("fog-{0}/{n:0>63}", "x".repeat(59)));
    engine.set_requesters(at(0), (0..20).map(long));
    let few = run(&mut engine, 0, 1_100);
    assert_eq!(few.len(), 1);
    assert_eq!(body(&few[0].1).get("to"), None);
    let measured: Vec<FlowId> = (0..20).map(long).collect();
    engine.set_measured(at(2_000), measured.clone());
    engine.set_requesters(at(2_000), (0..200).map(long));
    let many = run(&mut engine, 2_000, 30_000);
    assert!(many.iter().all(|(_, output)| output.payload().len() <= 1_200));
    let asked: Vec<String> = many
        .iter()
        .flat_map(|(_, output)| body(output)["to"].as_array().unwrap().clone())
        .map(|name| name.as_str().unwrap().to_owned())
        .collect();
    assert!((20..=28).contains(&asked.len()), "{} names", asked.len());
    assert!(measured.iter().all(|node| asked.contains(&node.to_string())));
}

#[test]
fn the_offset_with_the_least_error_counts() {
    let mut net = pair();
    net.run_until(10 * S);
    let [own, fog] = [0, 1].map(|n| net.ids[n].clone());
    let cloud = node("cloud/cloud-1");
    let link = |offset_s, error_s| LinkOffset { offset_s, error_s };
    let now = net.now(0);
    let engine = &mut net.engines[0];
    let source = |engine: &Engine, node| engine.offset(node, now).map(|offset| offset.source);
    assert_eq!(source(engine, &fog), Some(Source::Ping));
    engine.set_links(now, [(fog.clone(), link(0.001, 0.001))]);
    assert_eq!(source(engine, &fog), Some(Source::Link));
    assert_eq!(source(engine, &cloud), None);
    let unsound = link(f64::NAN, 0.0);
    let relayed = [(fog.clone(), vec![(cloud.clone(), link(2.0, 0.003)), (own, unsound)])];
    engine.set_relayed(now, relayed);
    let via = engine.offset(&cloud, now).unwrap();
    assert_eq!(via.source, Source::Via);
    assert!((via.offset_s - 2.001).abs() < 1e-9 && (via.error_s - 0.004).abs() < 1e-9, "{via:?}");
    engine.set_links(now, [(fog.clone(), link(0.001, 0.5))]);
    assert_eq!(source(engine, &fog), Some(Source::Ping));
    // It ages.
    let later = Now { monotonic: now.monotonic + Duration::from_secs(100), ..now };
    let later = Now { wall_ns: later.wall_ns + 100 * S, ..later };
    assert!(engine.offset(&cloud, later).unwrap().error_s > via.error_s + 0.01);
}

#[test]
fn a_request_for_pings_gives_a_sample_for_each() {
    let mut net = pair();
    net.run_until(10 * S);
    let (now, fog) = (net.now(0), net.ids[1].clone());
    let fast = Duration::from_millis(50);
    let engine = &mut net.engines[0];
    for (count, interval) in [(0, 50), (101, 50), (1, 49), (1, 60_001)] {
        let order = engine.order(now, fog.clone(), count, Duration::from_millis(interval));
        assert_eq!(order, Err(OrderError::Invalid));
    }
    let unknown = node("fog/fog-9");
    assert_eq!(engine.order(now, unknown.clone(), 1, fast), Err(OrderError::Unknown(unknown)));
    let cancelled = engine.order(now, fog.clone(), 100, fast).unwrap();
    assert_eq!(engine.order(now, fog.clone(), 1, fast), Err(OrderError::Busy));
    engine.cancel_order(cancelled);
    let id = engine.order(now, fog.clone(), 100, fast).unwrap();
    net.poll(0);
    net.run_until(15 * S);
    assert_eq!(net.engines[0].take_samples(id), None);
    net.run_until(17 * S);
    assert_eq!(net.engines[0].take_samples(cancelled), None);
    let samples = net.engines[0].take_samples(id).unwrap();
    assert_eq!(samples.len(), 100);
    for sample in samples {
        let PingSample::Answered { latency_ms, error_ms, .. } = sample else { panic!("lost") };
        assert!((latency_ms - 5.0).abs() < 0.01 && error_ms >= 5.0, "{sample:?}");
    }
    assert_eq!(net.engines[0].take_samples(id), None);
}

#[test]
fn a_request_waits_for_the_way_of_the_answers_and_counts_lost_pings() {
    let mut net = pair();
    net.delay = Box::new(|_, _| None);
    let now = net.now(0);
    let fog = net.ids[1].clone();
    let id = net.engines[0].order(now, fog.clone(), 2, Duration::from_millis(50)).unwrap();
    net.poll(0);
    net.run_until(9 * S);
    assert_eq!(net.engines[0].take_samples(id), None);
    net.run_until(11 * S);
    let samples = net.engines[0].take_samples(id).unwrap();
    assert_eq!(serde_json::to_value(samples).unwrap(), json!([{"lost": true}, {"lost": true}]));
    // The first answer ends the wait, so that no sample is lost.
    net.delay = Box::new(|_, _| Some(5 * MS));
    net.engines[0].set_period(net.clocks[0].now(net.at), Duration::ZERO);
    net.poll(0);
    let now = net.now(0);
    let id = net.engines[0].order(now, fog, 1, Duration::from_millis(50)).unwrap();
    net.poll(0);
    net.run_until(14 * S);
    let samples = net.engines[0].take_samples(id).unwrap();
    assert!(matches!(samples[..], [PingSample::Answered { .. }]), "{samples:?}");
}

#[test]
fn the_view_and_the_metrics_are_those_of_the_contract() {
    let mut net = pair();
    net.run_until(20 * S);
    let now = net.now(0);
    let view = serde_json::to_value(net.engines[0].view(now)).unwrap();
    let row = &view["nodes"][0];
    let keys: Vec<&String> = row.as_object().unwrap().keys().collect();
    let of_contract = [
        "layer",
        "node",
        "latency_ms",
        "sent",
        "lost",
        "clock_offset_ms",
        "clock_error_ms",
        "clock_source",
        "last_ago_s",
    ];
    assert_eq!(keys, of_contract);
    assert_eq!((&view["period_s"], &row["clock_source"]), (&json!(60.0), &json!("ping")));
    for quantile in ["last", "p50", "p99"] {
        assert!((row["latency_ms"][quantile].as_f64().unwrap() - 5.0).abs() < 0.01);
    }
    let readings: Vec<Reading> = net.engines[0].metrics(now).collect();
    for metric in METRICS {
        let reading = readings.iter().find(|reading| reading.metric.name == metric.name).unwrap();
        assert!(reading.labels.iter().map(|(name, _)| name).eq(metric.labels), "{reading:?}");
        let is_histogram = matches!(reading.value, Value::Histogram(_));
        assert_eq!(is_histogram, metric.kind == Kind::Histogram);
    }
    let histogram = readings.iter().find_map(|reading| match &reading.value {
        Value::Histogram(histogram) => Some(histogram),
        Value::Number(_) => None,
    });
    let histogram = histogram.unwrap();
    let (count, sent) = (histogram.count(), sent(&net));
    assert_eq!(count, sent);
    assert!((histogram.sum() - count as f64 * 0.005).abs() < 1e-4);
    let up_to = |bound: f64| histogram.buckets().find(|(upper, _)| *upper >= bound).unwrap().1;
    assert_eq!((up_to(0.002), up_to(0.01)), (0, count));
}

#[test]
fn known_nodes_are_bounded() {
    let mut engine = engine(60);
    engine.set_requesters(at(0), (0..10_002).map(|n| node(&format!("edge/r-{n}"))));
    assert_eq!(engine.ignored(Ignored::TooMany), 2);
    engine.ping_received(at(1), &node("fog/fog-1"), &ping("fog/fog-1", 1, None, 1));
    assert_eq!(engine.ignored(Ignored::TooMany), 3);
}
