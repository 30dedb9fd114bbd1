//! The DDS link between network namespaces: discovery with one seed, nothing but unicast, bytes on
//! the wire.
//!
//! Runs `blaze-testbed link-peer` inside the namespaces.

use std::process::{Child, Output, Stdio};
use std::time::Duration;

use blaze_tests::network::{Host, Plan, Topology, program};
use blaze_tests::process::{Process, binary};
use blaze_tests::{wait, within};

/// From the moment when the last is up to the moment when everybody knows everybody.
const MEET: Duration = Duration::from_secs(2);
/// Where a peer must be up, on a busy machine.
const START: Duration = Duration::from_secs(20);

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
    let line =
        log.lines().find_map(|line| line.strip_prefix(&format!("discovered {endpoint} after ")));
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

/// Two know the third, the seed; they must learn of each other from it. Each starts when the one
/// before is up.
#[test]
fn three_flows_meet_with_one_seed_whichever_starts_first() {
    const NAMES: [&str; 3] = ["edge/a", "fog/b", "cloud/c"];
    const SEED: usize = 1;
    let network = lan(&["robot", "fog", "cloud"]);
    let hosts = ["robot", "fog", "cloud"].map(|name| network.host(name).unwrap());
    let seed = hosts[SEED].address;
    for (domain, order) in (33..).zip([[1, 0, 2], [0, 1, 2], [0, 2, 1]]) {
        let mut peers: Vec<(usize, Process)> = Vec::new();
        for place in order {
            let host = hosts[place];
            let mut arguments = vec![
                format!("name={}", NAMES[place]),
                format!("listen={}", host.address),
                format!("domain={domain}"),
                // Longer than the test waits; it is killed then.
                "seconds=120".to_owned(),
            ];
            if place != SEED {
                arguments.push(format!("peers={seed}"));
            }
            let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
            let peer = Process::tool("link-peer", &arguments, Some(&host.namespace)).unwrap();
            let is_up = || peer.stdout().iter().any(|line| line.starts_with("up after"));
            wait::until("it is up", START, is_up, || peer.tail()).unwrap();
            peers.push((place, peer));
        }
        let knows_all = |(place, peer): &(usize, Process)| {
            let lines = peer.stdout();
            let mut others = (0..3).filter(|other| other != place);
            others.all(|other| {
                let found = format!("discovered {}/1 ", NAMES[other]);
                lines.iter().any(|line| line.starts_with(&found))
            })
        };
        let said = || {
            let said = peers.iter().map(|(place, peer)| (NAMES[*place], peer.stdout()));
            format!("started in the order {order:?}: {:?}", said.collect::<Vec<_>>())
        };
        let met = || peers.iter().all(knows_all);
        let took = wait::until("all know each other", within(MEET), met, said).unwrap();
        println!("started in the order {order:?}: all met {took:?} after the last was up");
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
    let (robot, fog) =
        (text(robot.wait_with_output().unwrap()), text(fog.wait_with_output().unwrap()));
    assert!(discovered_after(&robot, "fog/b/1") <= 3000, "{robot}");
    let (computed, counted) = (number(&robot, "computed"), number(&robot, "counted"));
    assert!((computed / counted - 1.0).abs() < 0.03, "{robot}");
    let packets = number(&robot, "packets");
    assert!((2000.0..2040.0).contains(&packets), "{robot}");
    assert!(fog.contains("received bulk 2000 datagrams 2592000 bytes"), "{fog}");
}
