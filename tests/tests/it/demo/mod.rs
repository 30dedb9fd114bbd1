//! `blaze demo` as a newcomer runs it: one process, nothing installed.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, Instant};

use blaze_tests::flow::free_domain;
use blaze_tests::process::{Process, Signal};
use blaze_tests::{wait, within};
use serde_json::Value;

const DEADLINE: Duration = Duration::from_secs(30);
const TOPICS: [&str; 3] = ["imu/data", "jackal_velocity_controller/odom", "camera/image_raw"];

struct Run {
    code: Option<i32>,
    rows: Vec<Value>,
    summary: Value,
    tail: String,
}

fn demo(arguments: &[&str]) -> Run {
    let mut command = vec!["demo", "-o", "json"];
    command.extend(arguments);
    let mut process = Process::start("blaze", &command, None).unwrap();
    let code = process.exit(Duration::from_secs(120)).unwrap();
    let lines: Vec<Value> =
        process.stdout().iter().map(|line| serde_json::from_str(line).unwrap()).collect();
    let (summaries, rows): (Vec<Value>, Vec<Value>) =
        lines.into_iter().partition(|line| line["kind"] == "summary");
    let summary = summaries.first().cloned().unwrap_or_default();
    Run { code, rows, summary, tail: process.tail() }
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("a number: {value}"))
}

fn milliseconds(value: &Value) -> Duration {
    Duration::from_secs_f64(number(value) / 1e3)
}

#[test]
fn recorded_data_finds_its_way_from_the_edge_to_the_cloud() {
    // Ten seconds are the shortest with changes of the configuration.
    let seconds = if blaze_tests::long() { "30s" } else { "10s" };
    let run = demo(&["--duration", seconds]);
    assert_eq!(run.summary["ok"], true, "{}\n{}", run.summary["problems"], run.tail);
    assert_eq!(run.code, Some(0), "{}", run.tail);
    for layer in ["fog", "cloud"] {
        let first = number(&run.summary["first_message_s"][layer]);
        assert!(first <= 10.0, "first message in {layer} after {first} s");
    }
    for topic in TOPICS {
        for layer in ["edge/", "fog/", "cloud/"] {
            let live = run.rows.iter().filter(|row| {
                row["topic"] == topic
                    && row["to"].as_str().is_some_and(|to| to.starts_with(layer))
                    && row["rate_out_hz"].as_f64().is_some_and(|rate| rate > 1.0)
            });
            assert!(live.count() >= 5, "{topic} is live in {layer}: {}", run.tail);
        }
    }
    for row in run.summary["topics"].as_array().unwrap() {
        assert_eq!(row["duplicated"], 0, "{row}");
        if row["topic"] != "camera/image_raw" {
            assert_eq!(
                (&row["lost"], &row["reordered"]),
                (&Value::from(0), &Value::from(0)),
                "{row}"
            );
            assert!(
                milliseconds(&row["latency_ms"]["p99"]) < within(Duration::from_millis(100)),
                "{row}"
            );
        } else if number(&row["lost"]) > 0.0 {
            let dropped = row["dropped"].as_object().unwrap();
            assert!(!dropped.is_empty(), "camera drops carry a reason: {row}");
        }
    }
    let cloud = run.summary["topics"].as_array().unwrap().iter();
    let routes: Vec<&Value> =
        cloud.filter(|row| row["to"] == "cloud/cloud-1").map(|row| &row["route"]).collect();
    assert!(
        routes.contains(&&serde_json::json!(["node:memory", "inter:dds", "layer:memory"])),
        "{routes:?}"
    );
    let moved = &run.summary["moves"][0];
    assert_eq!(
        (&moved["from"], &moved["to"]),
        (&Value::from("fog/fog-1"), &Value::from("cloud/cloud-1"))
    );
    let changes = run.summary["changes"].as_array().unwrap();
    let of = |document: &str| changes.iter().find(|change| change["document"] == document).unwrap();
    let (service, link) = (of("service/analytics"), of("node/robot-1"));
    assert_eq!(
        (&service["at"], &link["at"]),
        (&Value::from("fog/fog-1"), &Value::from("edge/robot-1"))
    );
    for change in [service, link] {
        assert!(
            milliseconds(&change["callback_ms"]) < within(Duration::from_secs(1)),
            "a change comes within a second: {change}"
        );
    }
    assert!(number(&service["after_per_s"]) > 2.0 * number(&service["before_per_s"]), "{service}");
    assert!(number(&link["after_per_s"]) < number(&link["before_per_s"]), "{link}");
    println!("{}", run.summary);
}

#[test]
fn a_part_of_the_nodes_and_a_short_run_change_nothing_and_say_so() {
    // A part of the nodes looks for the others, and those of another demo on this host have the
    // same names.
    let domain = format!("brokers.inter.dds.domain={}", free_domain().unwrap());
    for (arguments, why) in [
        (
            &["--only", "robot-1", "--duration", "1s", "--set", &domain][..],
            "all nodes in one process",
        ),
        (&["--duration", "2s"], "--duration 10s"),
    ] {
        let run = demo(arguments);
        assert_eq!(run.summary["changes"], serde_json::json!([]), "{}", run.summary);
        assert!(run.tail.contains(why), "{why}: {}", run.tail);
    }
}

/// Another recording: text and numbers as ROS 2 CDR, two topics, LZ4 chunks.
fn write_recording(path: &Path) {
    let file = std::fs::File::create(path).unwrap();
    let options =
        mcap::WriteOptions::new().profile("ros2").compression(Some(mcap::Compression::Lz4));
    let mut writer = options.create(std::io::BufWriter::new(file)).unwrap();
    let mut channels = Vec::new();
    for (topic, kind) in
        [("/chatter", "std_msgs/msg/String"), ("/scan", "sensor_msgs/msg/LaserScan")]
    {
        let schema = writer.add_schema(kind, "ros2msg", b"string data").unwrap();
        channels.push(writer.add_channel(schema, topic, "cdr", &BTreeMap::new()).unwrap());
    }
    for n in 0..100u64 {
        for (index, channel) in channels.iter().enumerate() {
            let mut data = vec![0, 1, 0, 0];
            data.extend(vec![u8::try_from(n).unwrap(); 40 + index * 2000]);
            let at = 1_000_000_000 + n * 50_000_000;
            let header = mcap::records::MessageHeader {
                channel_id: *channel,
                sequence: u32::try_from(n).unwrap(),
                log_time: at,
                publish_time: at,
            };
            writer.write_to_known_channel(&header, &data).unwrap();
        }
    }
    writer.finish().unwrap();
}

#[test]
fn another_recording_works_alike() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("other.mcap");
    write_recording(&path);
    let path: Cow<'_, str> = path.to_string_lossy();
    let run = demo(&["--duration", "6s", "--record", &path]);
    assert_eq!(run.code, Some(0), "{}", run.tail);
    let topics = run.summary["topics"].as_array().unwrap();
    for topic in ["chatter", "scan"] {
        let to_cloud =
            topics.iter().find(|row| row["topic"] == topic && row["to"] == "cloud/cloud-1");
        let row = to_cloud.unwrap_or_else(|| panic!("{topic} to the cloud: {}", run.summary));
        assert!(number(&row["received"]) > 50.0, "{row}");
        assert_eq!((&row["lost"], &row["duplicated"]), (&Value::from(0), &Value::from(0)), "{row}");
    }
}

#[test]
fn what_cannot_be_played_ends_with_its_code_and_reason() {
    for (arguments, code, why) in [
        (&["--listen", "192.0.2.1"][..], 2, "--listen 192.0.2.1"),
        // What the node file refuses: a key, and values.
        (&["--set", "nonsense=1"], 2, "nonsense"),
        (&["--set", "flow.bandwidth.limit_mbps=-1"], 2, "limit_mbps"),
        (&["--set", "admin.flow=127.0.0.1:80x"], 2, "admin.flow"),
        (&["--only", "robot-1", "--record", "/no/such/file"], 1, "/no/such/file: "),
    ] {
        let mut process =
            Process::start("blaze", &[&["demo"][..], arguments].concat(), None).unwrap();
        assert_eq!(process.exit(DEADLINE).unwrap(), Some(code), "{}", process.tail());
        assert!(process.tail().contains(why), "{}", process.tail());
    }
}

#[test]
fn signals_end_a_run_at_once_with_its_summary() {
    for signal in [Signal::INT, Signal::TERM] {
        let set = format!("brokers.inter.dds.domain={}", free_domain().unwrap());
        let arguments =
            ["demo", "--only", "robot-1,fog-1", "--duration", "10m", "-o", "json", "--set", &set];
        let mut demo = Process::start("blaze", &arguments, None).unwrap();
        // The first row comes when it has begun: before that there is nothing to sum up.
        let begun = || demo.stdout().first().is_some_and(|line| line.contains("\"row\""));
        wait::until("the first row", DEADLINE, begun, || demo.tail()).unwrap();
        let begin = Instant::now();
        demo.signal(signal).unwrap();
        let code = demo.exit(DEADLINE).unwrap();
        assert!(
            begin.elapsed() < within(Duration::from_secs(4)),
            "{signal:?}: {:?}",
            begin.elapsed()
        );
        // The last line is the summary, and the code is what it says.
        let lines = demo.stdout();
        let summary: Value = serde_json::from_str(lines.last().unwrap()).unwrap();
        assert_eq!(summary["kind"], "summary", "{}", demo.tail());
        assert_eq!(code, Some(i32::from(summary["ok"] != true)), "{}", demo.tail());
    }
}
