//! `blaze demo` with options, recordings and ends that nobody wishes for.

use std::process::Command;
use std::time::{Duration, Instant};

use blaze_tests::flow::free_domain;
use blaze_tests::process::{Process, binary};
use blaze_tests::within;

use super::node_file::text;
use super::random::Random;

const DEADLINE: Duration = Duration::from_secs(30);

/// Exit code and stderr without what the nodes say of their ports.
fn demo(arguments: &[&str]) -> (Option<i32>, String) {
    let output = Command::new(binary("blaze").unwrap())
        .arg("demo")
        .args(arguments)
        .output()
        .unwrap();
    let told = text(&output.stderr);
    let lines = told
        .lines()
        .filter(|line| !line.starts_with("admin listening") && !line.starts_with("ready "));
    (output.status.code(), lines.collect::<Vec<_>>().join("\n"))
}

#[test]
fn wrong_options_exit_with_2_and_say_which() {
    for (arguments, named) in [
        (&["--set", "x"][..], "--set"),
        (&["--set", "nonsense=1"], "nonsense"),
        (&["--set", "flow.bandwidth.limit_mbps=-1"], "limit_mbps"),
        (&["--set", "admin.flow=127.0.0.1:80x"], "admin.flow"),
        (&["--duration", "0s"], "--duration"),
        (&["--duration", "25h"], "--duration"),
        (&["--duration", "soon"], "--duration"),
        (&["--only", "mars"], "--only"),
        (&["--listen", "::1"], "::1"),
        (&["--listen", "0.0.0.0"], "--listen"),
        // An address of another host (documentation range of RFC 5737).
        (&["--listen", "192.0.2.1"], "--listen 192.0.2.1"),
        (&["--only", "fog-1", "--listen", "192.0.2.1"], "--listen 192.0.2.1"),
        (&["--peer", "x"], "--peer"),
        (&["--brokers", "redis"], "--brokers"),
        (&["-o", "yaml"], "YAML"),
    ] {
        let (code, told) = demo(arguments);
        assert_eq!(code, Some(2), "{arguments:?}: {told}");
        assert!(told.contains(named), "{arguments:?}: {told}");
    }
}

#[test]
fn recordings_that_are_none_exit_with_1_and_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, content: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, content).unwrap();
        path.display().to_string()
    };
    let good = include_bytes!("../../../../demo/data/jackal.mcap");
    let mut random = Random::new(9);
    let mut files = vec![
        file("empty", b""),
        file("text", b"not a recording"),
        file("cut", &good[..20_000]),
        file("magic", &good[..8]),
        file("noise", &random.bytes(5000)),
        folder.path().display().to_string(),
        folder.path().join("missing").display().to_string(),
    ];
    let mut flipped = good.to_vec();
    for _ in 0..200 {
        let at = random.below(flipped.len());
        flipped[at] = random.bytes(1)[0];
    }
    files.push(file("flipped", &flipped));
    for path in files {
        let (code, told) = demo(&["--only", "robot-1", "--duration", "1s", "--record", &path]);
        assert_eq!(code, Some(1), "{path}: {told}");
        assert_eq!(told.lines().count(), 1, "{path}: {told}");
        assert!(told.starts_with(&format!("blaze: {path}: ")), "{told}");
    }
}

#[test]
fn signals_end_a_run_at_once_with_its_summary() {
    for signal in ["INT", "TERM"] {
        let set = format!("brokers.inter.dds.domain={}", free_domain().unwrap());
        let arguments = [
            "demo",
            "--only",
            "robot-1,fog-1",
            "--duration",
            "10m",
            "-o",
            "json",
            "--set",
            &set,
        ];
        let mut demo = Process::start("blaze", &arguments, None).unwrap();
        // The first row comes when it has begun: before that there is nothing to sum up.
        let begun = || demo.stdout().first().is_some_and(|line| line.contains("\"row\""));
        blaze_tests::wait::until("the first row", DEADLINE, begun, || demo.tail()).unwrap();
        let begin = Instant::now();
        super::signals::send(&demo, signal);
        let code = demo.exit(DEADLINE).unwrap();
        assert!(
            begin.elapsed() < within(Duration::from_secs(4)),
            "SIG{signal}: {:?}",
            begin.elapsed()
        );
        // The last line is the summary, and the code is what it says.
        let ok = |line: &String| {
            let summary: serde_json::Value = serde_json::from_str(line).ok()?;
            (summary["kind"] == "summary")
                .then(|| summary["ok"].as_bool())
                .flatten()
        };
        let told = blaze_tests::wait::until_some(
            "a summary",
            DEADLINE,
            || demo.stdout().last().and_then(ok),
            || demo.tail(),
        );
        assert_eq!(code, Some(i32::from(!told.unwrap())), "{}", demo.tail());
    }
}
