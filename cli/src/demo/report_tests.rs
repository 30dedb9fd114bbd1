use std::collections::BTreeMap;

use serde_json::Value;

use super::*;
use crate::demo::options::DemoNode;
use crate::demo::verdict::judge;
use crate::demo::verdict::tests::{good_outcome, good_row};

fn report(style: Style) -> Report<Vec<u8>, Vec<u8>> {
    Report::new(style, Vec::new(), Vec::new())
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

fn rows() -> Vec<TopicRow> {
    let mut camera = good_row("camera/image_raw", DemoNode::Fog1, "dashboard");
    camera.rate_out_hz = 14.9;
    camera.bytes_per_s = 13_731_840.0;
    camera.dropped = BTreeMap::from([("rate_limit".to_owned(), 15)]);
    vec![good_row("imu/data", DemoNode::Cloud1, "recorder"), camera]
}

#[test]
fn plain_lines_come_every_few_seconds() {
    let mut report = report(Style::Lines);
    for second in 4..=6 {
        report.rows(Duration::from_secs(second), &rows()).unwrap();
    }
    report.event(Duration::from_millis(6_500), "something happened").unwrap();
    assert_eq!(
        text(&report.out),
        "  5.0 s  imu/data edge/robot-1 → cloud/cloud-1 recorder: 50.0 Hz in, 49.9 Hz out, 16.1 KiB/s, p50 1.2 ms, \
         p99 4.5 ms, dropped -\n\
         \x20 5.0 s  camera/image_raw edge/robot-1 → fog/fog-1 dashboard: 50.0 Hz in, 14.9 Hz out, \
         13.1 MiB/s, \
         p50 1.2 ms, p99 4.5 ms, dropped rate_limit 15\n\
         \x20 6.5 s  something happened\n"
    );
}

#[test]
fn the_live_table_is_drawn_in_place() {
    let mut report = report(Style::Live { width: 200 });
    report.rows(Duration::from_secs(1), &rows()).unwrap();
    assert_eq!(
        text(&report.out),
        "1 s, the last second:\n\
         TOPIC             FROM          TO                      ROUTE                               IN/Hz  OUT/Hz   \
         BYTES/s  p50/ms  p99/ms  DROPPED\n\
         imu/data          edge/robot-1  cloud/cloud-1 recorder  node:memory inter:dds layer:memory   50.0    49.9  \
         16.1 KiB     1.2     4.5  -\n\
         camera/image_raw  edge/robot-1  fog/fog-1 dashboard     node:memory inter:dds layer:memory   50.0    14.9  \
         13.1 MiB     1.2     4.5  rate_limit 15\n"
    );
    report.out.clear();
    report.rows(Duration::from_secs(2), &rows()).unwrap();
    assert!(
        text(&report.out).starts_with("\x1b[4A\r\x1b[0J2 s, the last second:\n"),
        "{}",
        text(&report.out)
    );
    // An event stands above the table, which stays.
    report.out.clear();
    report.event(Duration::from_secs(2), "moved").unwrap();
    let printed = text(&report.out);
    assert!(
        printed.starts_with("\x1b[4A\r\x1b[0J  2.0 s  moved\n2 s, the last second:\n"),
        "{printed}"
    );
    report.out.clear();
    report.rows(Duration::from_secs(3), &rows()).unwrap();
    assert!(text(&report.out).starts_with("\x1b[4A\r\x1b[0J3 s, the last second:\n"));
}

#[test]
fn a_narrow_terminal_is_respected() {
    for width in [60, 80, 120] {
        let table = live_table(Duration::from_secs(1), &rows(), width);
        let widest = table.lines().map(|line| line.chars().count()).max().unwrap();
        assert!(widest <= usize::from(width), "{width}: {table}");
    }
}

#[test]
fn many_rows_are_cut() {
    let rows = vec![good_row("imu/data", DemoNode::Cloud1, "recorder"); 50];
    let table = live_table(Duration::from_secs(1), &rows, 200);
    assert!(table.ends_with("… and 10 more\n"), "{table}");
    assert_eq!(table.lines().count(), 43);
}

#[test]
fn json_lines_are_those_of_the_contract() {
    let mut report = report(Style::Json);
    report.event(Duration::from_secs(1), "not for programs").unwrap();
    report.rows(Duration::from_secs(1), &rows()).unwrap();
    report.summary(&judge(good_outcome())).unwrap();
    let lines: Vec<Value> =
        text(&report.out).lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines.len(), 3);
    let row_keys = [
        "topic",
        "from",
        "to",
        "route",
        "rate_in_hz",
        "rate_out_hz",
        "bytes_per_s",
        "sent",
        "received",
        "lost",
        "duplicated",
        "reordered",
        "dropped",
        "latency_ms",
    ];
    for row in [&lines[0], &lines[2]["topics"][0]] {
        assert!(row_keys.iter().all(|key| row.get(key).is_some()), "{row}");
    }
    assert_eq!(lines[0]["kind"], "row");
    assert_eq!(lines[0]["to"], "cloud/cloud-1");
    assert_eq!(lines[1]["dropped"]["rate_limit"], 15);
    assert_eq!(lines[0]["latency_ms"]["p99"], 4.5);
    let summary = &lines[2];
    assert_eq!((&summary["kind"], &summary["ok"]), (&Value::from("summary"), &Value::from(true)));
    assert_eq!(summary["duration_s"], 30.0);
    assert_eq!(summary["first_message_s"]["cloud"], 1.3);
    assert_eq!(summary["moves"][0]["gap_ms"], 0.0);
    let changes = summary["changes"].as_array().unwrap();
    assert_eq!(
        (&changes[0]["callback_ms"], &changes[1]["after_per_s"]),
        (&Value::from(2.5), &Value::from(3.0))
    );
    assert_eq!(summary["topics"].as_array().unwrap().len(), 9);
    assert!(text(&report.err).contains("not for programs"));
}

#[test]
fn the_summary_says_what_was_wrong() {
    let mut outcome = good_outcome();
    outcome.topics.truncate(1);
    outcome.topics[0].lost = 2;
    outcome.changes.made.truncate(1);
    outcome.plan = None;
    let mut report = report(Style::Lines);
    report.summary(&judge(outcome)).unwrap();
    assert_eq!(
        text(&report.out),
        "\nAfter 30.0 s:\n\
         TOPIC     TO                   SENT  RECEIVED  LOST  TWICE  REORDERED  p50/ms  p99/ms  DROPPED\n\
         imu/data  edge/edge-2 monitor  1000       998     2      0          0    1.25    4.50  -\n\
         \n\
         First message after the start: cloud 1.3 s, edge 0.4 s, fog 1.2 s.\n\
         analytics moved from fog/fog-1 to cloud/cloud-1: 0 ms without a message.\n\
         PUT service/analytics (window 50 → 10): 2xx after 1.2 ms, the callback of analytics on \
         fog/fog-1 after 2.5 ms.\n\
         \x20 analytics: 1.0 → 5.0 results a second.\n\
         NOT OK:\n\
         \x20 - imu/data to edge/edge-2 (monitor): 2 messages were lost\n\
         `blaze why TOPIC --flow HOST:PORT` tells while the demo runs; its nodes name their ports \
         at the start.\n"
    );
}

#[test]
fn yaml_is_refused() {
    assert!(matches!(Style::choose(Format::Yaml), Err(CliError::Usage(_))));
    assert_eq!(Style::choose(Format::Json).unwrap(), Style::Json);
}
