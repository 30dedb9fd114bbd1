//! The end of a `blaze-flow`, orderly and not.

use std::process::Command;
use std::time::{Duration, Instant};

use blaze_tests::process::Process;
use blaze_tests::{wait, within};

use super::node_file::{DEADLINE, small_file, started};

/// Sends a signal to a process of this test.
pub(crate) fn send(process: &Process, signal: &str) {
    let status = Command::new("kill")
        .args([&format!("-{signal}"), &process.id().to_string()])
        .status()
        .unwrap();
    assert!(status.success());
}

/// A node file with an inter scope on loopback.
fn file_with_inter(state: &std::path::Path) -> String {
    let domain = blaze_tests::flow::free_domain().unwrap();
    small_file(state, "40").replace(
        "brokers: { node: { memory: {} } }",
        &format!(
            "brokers: {{ node: {{ memory: {{}} }}, inter: {{ dds: {{ domain: {domain}, listen: 127.0.0.1 }} }} }}"
        ),
    )
}

#[test]
fn sigterm_and_sigint_drain_and_exit_with_0_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("blaze.yaml");
    std::fs::write(&file, file_with_inter(folder.path())).unwrap();
    for signal in ["TERM", "INT"] {
        let (mut process, admin) = started(&["--config", &file.display().to_string()]);
        assert!(admin.ready());
        let begin = Instant::now();
        send(&process, signal);
        assert_eq!(process.exit(DEADLINE).unwrap(), Some(0), "{}", process.tail());
        let took = begin.elapsed();
        // Nothing is queued, so only the good-bye takes time; the deadline of a shutdown is 5 s.
        assert!(
            took < within(Duration::from_secs(3)),
            "SIG{signal}: {took:?}\n{}",
            process.tail()
        );
        assert_eq!(process.stdout().len(), 1, "{:?}", process.stdout());
        let deadline = |line: &String| line.contains("reached its deadline");
        assert!(!process.stderr().iter().any(deadline), "{}", process.tail());
    }
}

#[test]
fn a_second_signal_exits_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("blaze.yaml");
    std::fs::write(&file, file_with_inter(folder.path())).unwrap();
    let (mut process, _) = started(&["--config", &file.display().to_string()]);
    // Both before it runs again, so that the second one comes during the shutdown for sure.
    send(&process, "STOP");
    send(&process, "TERM");
    send(&process, "INT");
    send(&process, "CONT");
    let begin = Instant::now();
    let code = process.exit(DEADLINE).unwrap();
    assert!(
        begin.elapsed() < within(Duration::from_secs(2)),
        "{:?}",
        begin.elapsed()
    );
    assert!(matches!(code, Some(130 | 143)), "{code:?}: {}", process.tail());
}

#[test]
fn a_port_that_is_taken_is_one_line_and_exit_code_1() {
    let folder = tempfile::tempdir().unwrap();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap();
    let file = folder.path().join("blaze.yaml");
    std::fs::write(&file, small_file(folder.path(), "40")).unwrap();
    let set = format!("admin.flow={port}");
    let mut process = Process::start(
        "blaze-flow",
        &["--config", &file.display().to_string(), "--set", &set],
        None,
    )
    .unwrap();
    assert_eq!(process.exit(DEADLINE).unwrap(), Some(1));
    let why = |line: &String| line.starts_with("blaze-flow failed: ") && line.contains(&port.to_string());
    wait::until(
        "the reason",
        DEADLINE,
        || process.stderr().iter().any(why),
        || process.tail(),
    )
    .unwrap();
}
