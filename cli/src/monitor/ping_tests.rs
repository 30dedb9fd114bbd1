//! Tables, files and questions of `blaze ping`.

use super::*;
use crate::args::Command;
use crate::args::tests::parse;
use crate::config::stub::{Reply, Stub};

fn options(line: &str) -> PingOptions {
    match parse(line).unwrap().command {
        Command::Ping(options) => options,
        other => panic!("{other:?}"),
    }
}

fn node() -> FlowId {
    "fog/fog-1".parse().unwrap()
}

#[test]
fn options_are_those_of_the_contract() {
    let options = options("ping fog/fog-1 --count 10 --interval 1s --monitor robot:9103");
    assert_eq!(options.to, Some(node()));
    assert_eq!((options.count, options.interval), (10, Duration::from_secs(1)));
    assert_eq!(options.target.monitor.to_string(), "robot:9103");
    for (line, why) in [
        ("ping fog-1", "no LAYER/NODE"),
        ("ping fog/fog-1 --count 101", "101"),
        ("ping fog/fog-1 --interval 20ms", "50 ms to 60 s"),
        ("ping --count 3", "LAYER/NODE"),
        ("ping --csv file", "LAYER/NODE"),
        ("ping --monitor robot", "did you mean robot:9103?"),
    ] {
        let error = parse(line).unwrap_err();
        assert!(error.to_string().contains(why), "{line}: {error}");
    }
}

#[test]
fn the_matrix_is_a_table() {
    let matrix = json!({"layer": "edge", "node": "robot-1", "period_s": 60.0, "nodes": [
        {"layer": "fog", "node": "fog-1", "latency_ms": {"last": 10.111, "p50": 10.0, "p99": 12.5},
            "sent": 20, "lost": 1, "clock_offset_ms": -2999.9876, "clock_error_ms": 0.412,
            "clock_source": "ping", "last_ago_s": 3.4},
        {"layer": "cloud", "node": "cloud-1",
            "latency_ms": {"last": null, "p50": null, "p99": null}, "sent": 1, "lost": 0, "clock_offset_ms": null, "clock_error_ms": null,
            "clock_source": null, "last_ago_s": null}]});
    assert_eq!(
        matrix_table(&Matrix::deserialize(&matrix).unwrap(), None),
        "monitor edge/robot-1, a ping every 60 s\n\
         NODE           LAST/ms  p50/ms  p99/ms  SENT  LOST   CLOCK/ms   ±/ms  BY    ANSWERED\n\
         fog/fog-1        10.11   10.00   12.50    20     1  -2999.988  0.412  ping   3 s ago\n\
         cloud/cloud-1        -       -       -     1     0          -      -  -            -\n"
    );
    let alone = json!({"layer": "edge", "node": "robot-1", "period_s": 0, "nodes": []});
    let text = matrix_table(&Matrix::deserialize(&alone).unwrap(), None);
    assert!(text.contains("pings are off") && text.contains("No other node"), "{text}");
}

#[tokio::test]
async fn a_node_is_pinged_and_samples_are_written() {
    let stub = Stub::start(|_, _| {
        Reply::json(&json!({"samples": [
            {"latency_ms": 10.25, "offset_ms": 2.0, "error_ms": 0.3}, {"lost": true}]}))
    })
    .await;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("ping.csv");
    let line = format!(
        "ping fog/fog-1 --count 2 --interval 100ms --csv {} --monitor {}",
        path.display(),
        stub.admin()
    );
    assert_eq!(run(&options(&line), Format::Json).await.unwrap(), Exit::Done);
    let asked = stub.asked();
    assert_eq!(asked[0].line(), "POST /v1/ping");
    assert_eq!(asked[0].json(), json!({"to": "fog/fog-1", "count": 2, "interval_ms": 100}));
    assert_eq!(asked[0].header("content-type"), Some("application/json"));
    let text = std::fs::read_to_string(path).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines[0], "time,to,latency_ms,offset_ms,error_ms,lost");
    assert!(lines[1].ends_with("Z,fog/fog-1,10.250,2.000,0.300,false"), "{text}");
    assert!(lines[2].ends_with("Z,fog/fog-1,,,,true"), "{text}");
}

#[tokio::test]
async fn all_lost_is_a_failure_and_an_unknown_node_not_found() {
    let stub = Stub::start(|_, before| match before {
        0 => Reply::json(&json!({"samples": [{"lost": true}]})),
        _ => Reply::Full(404, Vec::new(), json!({"error": {"detail": "unknown"}}).to_string()),
    })
    .await;
    let options = options(&format!("ping fog/fog-1 --count 1 --monitor {}", stub.admin()));
    assert_eq!(run(&options, Format::Table).await.unwrap(), Exit::Failed);
    let error = run(&options, Format::Table).await.unwrap_err();
    assert_eq!(error.exit(), Exit::NotFound);
    assert!(error.to_string().contains("needs a blaze-monitor"), "{error}");
}

#[tokio::test]
async fn without_a_monitor_the_command_says_how_to_start_one() {
    // A port that was free a moment ago.
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let error = run(&options(&format!("ping --monitor {port}")), Format::Table).await.unwrap_err();
    assert_eq!(error.exit(), Exit::CannotConnect);
    let text = error.to_string();
    assert!(text.contains(&format!("no monitor answers at {port}")), "{text}");
    assert!(text.contains("blaze-monitor --config FILE") && text.contains("--monitor"), "{text}");
}

#[test]
fn samples_are_a_table_with_a_sum() {
    let samples = [
        Sample { latency_ms: Some(12.0), offset_ms: Some(-3.0), error_ms: Some(0.5), lost: false },
        Sample { lost: true, ..Sample::default() },
        Sample { latency_ms: Some(10.0), ..Sample::default() },
    ];
    assert_eq!(
        samples_table(&node(), &samples, None),
        "PING  LATENCY/ms  CLOCK/ms   ±/ms\n   1       12.00    -3.000  0.500\n   2        lost         -      -\n   3       10.00         -      -\n\
         fog/fog-1: 3 pings, 1 lost, latency min 10.00 p50 12.00 max 12.00 ms\n"
    );
}
