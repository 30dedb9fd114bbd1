use super::*;
use crate::demo::board::LatencyMs;

/// A row as it should be: 1,000 messages of a 50 Hz topic.
pub(in crate::demo) fn good_row(topic: &str, node: DemoNode, service: &'static str) -> TopicRow {
    let large = topic.starts_with("camera");
    TopicRow {
        topic: topic.to_owned(),
        from: "edge/robot-1".to_owned(),
        to: Some(node.flow()),
        service: Some(service),
        route: ["node:memory", "inter:dds", "layer:memory"].map(str::to_owned).to_vec(),
        rate_in_hz: Some(50.0),
        rate_out_hz: 49.9,
        bytes_per_s: 16_450.0,
        sent: Some(1_000),
        received: 998,
        lost: 0,
        duplicated: 0,
        reordered: 0,
        dropped: BTreeMap::new(),
        latency_ms: LatencyMs { p50: Some(1.25), p99: Some(4.5) },
        large,
        active: true,
        due: true,
        silent: Some(Duration::from_millis(20)),
    }
}

pub(in crate::demo) fn good_outcome() -> Outcome {
    let mut topics = Vec::new();
    for (node, service) in [
        (DemoNode::Edge2, "monitor"),
        (DemoNode::Fog1, "dashboard"),
        (DemoNode::Cloud1, "recorder"),
    ] {
        for topic in ["imu/data", "jackal_velocity_controller/odom", "camera/image_raw"] {
            topics.push(good_row(topic, node, service));
        }
    }
    Outcome {
        nodes: DemoNode::ALL.to_vec(),
        duration: Duration::from_secs(30),
        interrupted: false,
        faults: Vec::new(),
        first_message_s: BTreeMap::from([("edge", 0.4), ("fog", 1.2), ("cloud", 1.3)]),
        moved: Some(Move {
            service: "analytics",
            from: "fog/fog-1".to_owned(),
            to: "cloud/cloud-1".to_owned(),
            gap_ms: 0.0,
        }),
        topics,
        plan: Some(ChangePlan { limit_mbps: 160.0, with_pictures: true, limit_binds: true }),
        changes: Changes {
            made: vec![good_change("results", 1.0, 5.0), good_change(PICTURES, 12.0, 3.0)],
            problems: Vec::new(),
        },
    }
}

/// A change that did what it should.
fn good_change(effect: &'static str, before_per_s: f64, after_per_s: f64) -> Change {
    Change {
        document: "service/analytics".to_owned(),
        setting: "window",
        from: 50.0,
        to: 10.0,
        at: "fog/fog-1".to_owned(),
        service: "analytics",
        revision: 9,
        accepted_ms: 1.25,
        callback_ms: 2.5,
        effect,
        before_per_s,
        after_per_s,
    }
}

#[test]
fn a_good_run_is_ok() {
    let summary = judge(good_outcome());
    assert!(summary.ok, "{:?}", summary.problems);
}

#[test]
fn each_fault_is_found() {
    type Fault = fn(&mut Outcome);
    let cases: [(Fault, &str); 16] = [
        (
            |outcome| outcome.topics[0].lost = 1,
            "imu/data to edge/edge-2 (monitor): 1 messages were lost",
        ),
        (|outcome| outcome.topics[1].duplicated = 2, "2 messages arrived twice"),
        (|outcome| outcome.topics[1].reordered = 3, "3 messages arrived out of order"),
        (|outcome| outcome.topics[2].duplicated = 1, "1 messages arrived twice"),
        (|outcome| outcome.topics[2].lost = 5, "a reason is known for 0"),
        (
            |outcome| {
                outcome.topics[2].lost = 5;
                outcome.topics[2].dropped =
                    BTreeMap::from([("echo".to_owned(), 9), ("lifespan".to_owned(), 4)]);
            },
            "a reason is known for 4",
        ),
        (|outcome| outcome.topics[8].received = 0, "no message arrived"),
        (|outcome| outcome.topics[8].silent = Some(Duration::from_secs(4)), "in the last 4.0 s"),
        (|outcome| *outcome.first_message_s.get_mut("cloud").unwrap() = 10.5, "after 10.5 s"),
        (|outcome| outcome.moved = None, "did not move"),
        (
            |outcome| {
                outcome.moved = None;
                outcome.interrupted = true;
            },
            "it was stopped before",
        ),
        (|outcome| outcome.faults.push("a flow ended".to_owned()), "a flow ended"),
        (
            |outcome| outcome.changes.made.truncate(1),
            "1 of 2 changes of the configuration were made in time",
        ),
        (
            |outcome| outcome.changes.made[0].after_per_s = 1.0,
            "window of analytics did not do what it should: 1.0 → 1.0 results a second",
        ),
        (|outcome| outcome.changes.made[1].after_per_s = 12.5, "12.0 → 12.5 pictures a second"),
        (
            |outcome| {
                outcome.changes.made.truncate(1);
                outcome.changes.problems.push("it did not come".to_owned());
            },
            "it did not come",
        ),
    ];
    for (change, expected) in cases {
        let mut outcome = good_outcome();
        change(&mut outcome);
        let summary = judge(outcome);
        assert!(!summary.ok);
        assert_eq!(summary.problems.len(), 1, "{:?}", summary.problems);
        assert!(
            summary.problems[0].contains(expected),
            "{:?} instead of {expected}",
            summary.problems
        );
    }
}

#[test]
fn what_was_not_published_need_not_arrive() {
    let mut outcome = good_outcome();
    outcome.topics[0] = TopicRow { received: 0, due: false, ..outcome.topics[0].clone() };
    let mut joined = good_row("imu/data", MOVES_TO, MOVING_SERVICE);
    (joined.received, joined.due) = (0, false);
    outcome.topics.push(joined);
    outcome.moved = None;
    outcome.plan = None;
    outcome.changes = Changes::default();
    assert_eq!(judge(outcome).problems, [""; 0]);
}

#[test]
fn pictures_with_a_reason_may_be_missing() {
    let mut outcome = good_outcome();
    outcome.topics[2].lost = 400;
    outcome.topics[2].reordered = 1;
    outcome.topics[2].dropped = BTreeMap::from([("rate_limit".to_owned(), 401)]);
    assert!(judge(outcome).ok);
}

#[test]
fn a_part_of_the_demo_answers_for_itself_alone() {
    let mut outcome = good_outcome();
    outcome.nodes = vec![DemoNode::Cloud1];
    outcome.topics.retain(|row| row.to.as_deref() == Some("cloud/cloud-1"));
    outcome.topics[2].lost = 400;
    outcome.moved = None;
    outcome.topics[0].sent = None;
    outcome.topics[0].silent = Some(Duration::from_secs(9));
    outcome.first_message_s = BTreeMap::from([("cloud", 40.0)]);
    outcome.plan = None;
    outcome.changes = Changes::default();
    assert!(judge(outcome).ok, "when the others start, and why they drop, is not known here");
}
