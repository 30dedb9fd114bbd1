//! The DDS link between network namespaces: discovery with one seed, nothing but unicast, bytes on the wire.
//!
//! Runs `blaze-testbed link-peer` inside the namespaces.

use std::process::{Child, Output, Stdio};

use blaze_tests::network::{Host, Plan, Topology, program};
use blaze_tests::process::binary;

/// Hosts on one switch, without multicast.
fn lan(hosts: &[&str]) -> Topology {
    Topology::build(&Plan::new().with_hosts(hosts).with_unicast_lan(hosts)).unwrap()
}

/// One end of the link on a host of the network; its name is that of a flow.
fn start(host: &Host, arguments: &str) -> Child {
    program(Some(&host.namespace), binary("blaze-testbed").unwrap())
        .arg("link-peer")
        .arg(format!("listen={}", host.address))
        .args(arguments.split_whitespace())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap()
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
    let network = lan(&["robot", "fog", "cloud"]);
    let host = |name| network.host(name).unwrap();
    let seed = host("fog").address;
    // Two know the third; they must learn of each other from it.
    let fog = start(host("fog"), "name=fog/b seconds=5");
    let robot = start(host("robot"), &format!("name=edge/a seconds=5 peers={seed}"));
    let cloud = start(host("cloud"), &format!("name=cloud/c seconds=5 peers={seed}"));
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
    let network = lan(&["robot", "fog"]);
    let host = |name| network.host(name).unwrap();
    let seed = host("fog").address;
    let fog = start(host("fog"), "name=fog/b seconds=7");
    let robot = start(
        host("robot"),
        &format!("name=edge/a seconds=6 peers={seed} interface=v0 send=1296x2000@1000"),
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
