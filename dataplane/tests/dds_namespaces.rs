//! The DDS link between network namespaces: discovery with one seed, nothing but unicast, bytes on the wire.
//!
//! Needs root and `ip`; without them the tests say so and pass. Runs `examples/link_peer` inside the namespaces.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test")]

use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::sync::{Mutex, PoisonError};

/// Held by the test that runs now: what it sends must not wait for the processor.
static TURN: Mutex<()> = Mutex::new(());

/// Namespaces on one bridge, 10.9.0.1, 10.9.0.2 …; removed at the end.
struct Bed {
    names: Vec<String>,
}

fn ip(arguments: &str) -> bool {
    let output = Command::new("ip")
        .args(arguments.split_whitespace())
        .stderr(Stdio::null())
        .status();
    output.is_ok_and(|status| status.success())
}

impl Bed {
    /// `None` where namespaces cannot be made.
    fn new(label: &str, hosts: usize) -> Option<Self> {
        let name = |host: usize| format!("blz-{label}-{}-{host}", std::process::id());
        let bed = Self {
            names: (0..=hosts).map(name).collect(),
        };
        if !ip(&format!("netns add {}", bed.names[0])) {
            eprintln!("SKIPPED: network namespaces need root and ip(8); nothing was tested");
            return None;
        }
        let switch = &bed.names[0];
        assert!(ip(&format!("-n {switch} link add br0 type bridge")));
        assert!(ip(&format!("-n {switch} link set br0 up")));
        for (host, name) in bed.names.iter().enumerate().skip(1) {
            assert!(ip(&format!("netns add {name}")));
            assert!(ip(&format!("-n {name} link set lo up")));
            assert!(ip(&format!(
                "-n {name} link add eth0 type veth peer name port{host} netns {switch}"
            )));
            assert!(ip(&format!("-n {name} addr add 10.9.0.{host}/24 dev eth0")));
            assert!(ip(&format!("-n {name} link set eth0 up")));
            assert!(ip(&format!("-n {switch} link set port{host} master br0")));
            assert!(ip(&format!("-n {switch} link set port{host} up")));
        }
        Some(bed)
    }

    fn start(&self, host: usize, arguments: &str) -> Child {
        Command::new("ip")
            .args(["netns", "exec", &self.names[host]])
            .arg(link_peer())
            .arg(format!("listen=10.9.0.{host}"))
            .args(arguments.split_whitespace())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap()
    }
}

impl Drop for Bed {
    fn drop(&mut self) {
        for name in &self.names {
            ip(&format!("netns del {name}"));
        }
    }
}

/// Cargo builds the examples of a package with its tests, beside them.
fn link_peer() -> PathBuf {
    let tests = std::env::current_exe().unwrap();
    let path = tests.ancestors().nth(2).unwrap().join("examples/link_peer");
    assert!(path.exists(), "{} is missing: cargo build --examples", path.display());
    path
}

fn text(output: Output) -> String {
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// Milliseconds until a line `discovered <endpoint> after <n> ms`.
fn discovered_after(log: &str, endpoint: &str) -> u64 {
    let line = log
        .lines()
        .find_map(|line| line.strip_prefix(&format!("discovered {endpoint} after ")));
    let millis = line
        .and_then(|rest| rest.strip_suffix(" ms"))
        .unwrap_or_else(|| panic!("no {endpoint} in:\n{log}"));
    millis.parse().unwrap()
}

/// The number behind a word.
fn number(log: &str, word: &str) -> f64 {
    let mut words = log.split_whitespace().skip_while(|found| *found != word).skip(1);
    words
        .next()
        .and_then(|text| text.parse().ok())
        .unwrap_or_else(|| panic!("no {word} in:\n{log}"))
}

#[test]
fn three_flows_meet_with_one_seed() {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let Some(bed) = Bed::new("seed", 3) else { return };
    // Two know the third; they must learn of each other from it.
    let fog = bed.start(2, "name=fog/b seconds=5");
    let robot = bed.start(1, "name=edge/a seconds=5 peers=10.9.0.2");
    let cloud = bed.start(3, "name=cloud/c seconds=5 peers=10.9.0.2");
    let logs = [robot, fog, cloud].map(|child| text(child.wait_with_output().unwrap()));
    let names = ["edge/a/1", "fog/b/1", "cloud/c/1"];
    for (place, log) in logs.iter().enumerate() {
        for other in (0..3).filter(|other| *other != place) {
            let millis = discovered_after(log, names[other]);
            assert!(
                millis <= 3000,
                "{} found {} after {millis} ms",
                names[place],
                names[other]
            );
        }
    }
}

#[test]
fn computed_bytes_are_those_of_the_interface_and_nothing_fragments() {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let Some(bed) = Bed::new("wire", 2) else { return };
    let fog = bed.start(2, "name=fog/b seconds=7");
    let robot = bed.start(
        1,
        "name=edge/a seconds=6 peers=10.9.0.2 interface=eth0 send=1296x2000@1000",
    );
    let (robot, fog) = (
        text(robot.wait_with_output().unwrap()),
        text(fog.wait_with_output().unwrap()),
    );
    assert!(discovered_after(&robot, "fog/b/1") <= 3000, "{robot}");
    let (computed, counted) = (number(&robot, "computed"), number(&robot, "counted"));
    assert!((computed / counted - 1.0).abs() < 0.03, "{robot}");
    let packets = number(&robot, "packets");
    assert!((2000.0..2040.0).contains(&packets), "{robot}");
    assert!(fog.contains("received bulk 2000 datagrams 2592000 bytes"), "{fog}");
}
