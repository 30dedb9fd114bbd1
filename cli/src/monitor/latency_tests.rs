//! Tables and choice of rows of `blaze latency`.

use serde_json::json;

use super::*;
use crate::args::Command;
use crate::args::tests::parse;
use crate::config::stub::{Reply, Stub};

fn options(line: &str) -> LatencyOptions {
    match parse(line).unwrap().command {
        Command::Latency(options) => options,
        other => panic!("{other:?}"),
    }
}

fn answer() -> Value {
    let row = |topic: &str, from: &str| {
        json!({"topic": topic, "from": from, "observe": "flow", "stamp": "publish",
            "method": "age", "messages": 312, "latency_ms": {"p50": 28.2, "p99": 38.5},
            "error_ms": 25.1, "unknown": 0, "lost": null, "hops": [
                {"where": "flow edge/robot-1", "p50_ms": 1.2, "p99_ms": 3.4},
                {"where": "link cloud/cloud-1", "p50_ms": 25, "p99_ms": 30.1},
                {"where": "brokers", "p50_ms": 2, "p99_ms": 5}]})
    };
    json!({"layer": "cloud", "node": "cloud-1", "topics": [
        row("imu/data", "edge/robot-1"), row("imu/data", "edge/robot-2"),
        row("odom", "edge/robot-1")]})
}

#[test]
fn files_and_counts_are_for_subscribers() {
    let options = options("latency imu/data --from edge/robot-1 --subscribe --csv a --count 3");
    assert!(options.subscribe && options.csv.is_some());
    for (line, why) in [
        ("latency", "<TOPIC>"),
        ("latency imu/data --csv a", "--subscribe"),
        ("latency imu/data --count 3", "--subscribe"),
        ("latency imu/data --from robot-1", "no LAYER/NODE"),
        ("latency /imu/data", "did you mean imu/data?"),
    ] {
        let error = parse(line).unwrap_err();
        assert!(error.to_string().contains(why), "{line}: {error}");
    }
}

#[test]
fn rows_of_the_topic_and_node_are_a_table_with_their_parts() {
    let mut value = answer();
    keep(&mut value, "imu/data", None);
    assert_eq!(value["topics"].as_array().unwrap().len(), 2);
    keep(&mut value, "imu/data", Some(&"edge/robot-1".parse().unwrap()));
    assert_eq!(
        table(&Latency::deserialize(&value).unwrap(), None),
        "FROM          MESSAGES  p50/ms  p99/ms    ±/ms  BY   UNKNOWN  LOST\n\
         edge/robot-1       312   28.20   38.50  25.100  age        0     -\n\
         edge/robot-1, p50 and p99 in ms: flow edge/robot-1 1.20/3.40 + link cloud/cloud-1 \
         25.00/30.10 + brokers 2.00/5.00\n"
    );
}

#[tokio::test]
async fn a_topic_that_is_not_measured_is_not_found() {
    let stub = Stub::start(|_, _| Reply::json(&answer())).await;
    let run_for = async |topic: &str| {
        run(&options(&format!("latency {topic} --monitor {}", stub.admin())), Format::Table)
            .await
            .unwrap()
    };
    assert_eq!(run_for("odom").await, Exit::Done);
    assert_eq!(run_for("odomm").await, Exit::NotFound);
    let known = Latency::deserialize(answer()).unwrap();
    let text = not_measured("odomm", &known);
    assert!(text.contains("Did you mean odom?") && text.contains("latency_topics"), "{text}");
}
