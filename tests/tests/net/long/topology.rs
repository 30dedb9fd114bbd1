//! Networks of namespaces: everybody reaches everybody, multicast stays where it belongs, and
//! nothing is left behind.

use std::net::{Ipv4Addr, UdpSocket};
use std::process::{Command, Stdio};
use std::time::Duration;

use blaze_tests::network::{Host, Plan, Topology, inside, run};
use blaze_tests::wait;
use blaze_tests::wan::{Change, Shape};

use crate::support::reaches;

const MULTICAST: Ipv4Addr = Ipv4Addr::new(239, 255, 0, 1);

/// Two robots and a router on one switch, a fog of two behind another router, and a cloud on two
/// links.
fn plan() -> Plan {
    let delay = |ms| Shape::default().with(Change::Delay(Duration::from_millis(ms)));
    Plan::new()
        .with_hosts(&["robot-1", "robot-2", "edge", "fog-1", "fog-2", "fog", "cloud"])
        .with_lan(&["robot-1", "robot-2", "edge"])
        .with_unicast_lan(&["fog-1", "fog-2", "fog"])
        .with_link("edge", "fog", delay(2))
        .with_link("edge", "cloud", delay(10))
        .with_link("fog", "cloud", delay(8))
}

fn namespaces() -> anyhow::Result<String> {
    run("ip netns list")
}

#[test]
fn every_host_reaches_every_other_one_from_its_own_address() -> anyhow::Result<()> {
    let plan = plan();
    // The second one has the same addresses.
    let networks = [Topology::build(&plan)?, Topology::build(&plan)?];
    for network in &networks {
        for from in &plan.hosts {
            for to in plan.hosts.iter().filter(|to| *to != from) {
                let (from, to) = (network.host(from)?, network.host(to)?);
                let seen = reaches(from, to)?;
                assert!(seen.is_some(), "{} does not reach {}", from.name, to.name);
                // A router speaks to neighbours with the address that it has on their network.
                if !["edge", "fog", "cloud"].contains(&from.name.as_str()) {
                    assert_eq!(seen, Some(from.address), "{} to {}", from.name, to.name);
                }
            }
        }
    }
    Ok(())
}

/// Whether a multicast datagram from one host reaches another that has joined the group.
fn hears(from: &Host, to: &Host) -> anyhow::Result<bool> {
    let receiver = inside(&to.namespace, || {
        let socket = UdpSocket::bind("0.0.0.0:7400")?;
        socket.join_multicast_v4(&MULTICAST, &to.address)?;
        Ok(socket)
    })?;
    receiver.set_read_timeout(Some(Duration::from_millis(300)))?;
    let sender = inside(&from.namespace, || Ok(UdpSocket::bind((from.address, 0))?))?;
    socket2::SockRef::from(&sender).set_multicast_if_v4(&from.address)?;
    sender.send_to(b"hello", (MULTICAST, 7400))?;
    Ok(receiver.recv(&mut [0; 10]).is_ok())
}

#[test]
fn multicast_stays_on_segments_that_carry_it() -> anyhow::Result<()> {
    let network = Topology::build(&plan())?;
    let host = |name: &str| network.host(name);
    assert!(hears(host("robot-1")?, host("robot-2")?)?);
    assert!(hears(host("robot-2")?, host("edge")?)?);
    assert!(!hears(host("fog-1")?, host("fog-2")?)?, "the switch drops it");
    assert!(!hears(host("robot-1")?, host("fog-1")?)?, "routers do not pass it on");
    assert!(reaches(host("fog-1")?, host("fog-2")?)?.is_some());
    Ok(())
}

/// Not a test: builds a network, says so, and waits to be killed by the test below.
#[test]
#[ignore = "is started by another test"]
fn a_network_that_waits() -> anyhow::Result<()> {
    let network = Topology::build(&Plan::two_hosts("a", "b", Shape::default()))?;
    for name in ["a", "b"] {
        println!("namespace {}", network.host(name)?.namespace);
    }
    std::io::stdin().read_line(&mut String::new())?;
    Ok(())
}

#[test]
fn nothing_is_left_of_a_process_that_was_killed() -> anyhow::Result<()> {
    use std::io::{BufRead as _, BufReader};

    let mut child = Command::new(std::env::current_exe()?)
        .args(["long::topology::a_network_that_waits", "--exact", "--ignored", "--nocapture"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()?;
    let output = child.stdout.take().ok_or_else(|| anyhow::anyhow!("no pipe"))?;
    let lines = BufReader::new(output).lines().map_while(Result::ok);
    let names =
        lines.filter_map(|line| line.split_once("namespace ").map(|(_, name)| name.to_owned()));
    let names: Vec<String> = names.take(2).collect();
    assert_eq!(names.len(), 2);
    assert!(
        names.iter().all(|name| namespaces().is_ok_and(|there| there.contains(name))),
        "{names:?}"
    );
    child.kill()?;
    child.wait()?;
    let gone = || namespaces().is_ok_and(|there| names.iter().all(|name| !there.contains(name)));
    wait::until("the namespaces have gone", Duration::from_secs(10), gone, || {
        format!("{:?}", namespaces())
    })?;
    Ok(())
}
