//! Three flows with one seed meet, whichever starts first.

use std::time::{Duration, Instant};

use blaze_tests::network::{Lan, check_rights};
use blaze_tests::{long, wait, within};

use super::support::{Launch, Node, START, free_domain};

/// From the moment when the last is ready to the moment when everybody knows everybody.
const MEET: Duration = Duration::from_secs(2);
const NODES: [(&str, &str); 3] = [
    ("robot-1", "edge/robot-1"),
    ("fog-1", "fog/fog-1"),
    ("cloud-1", "cloud/cloud-1"),
];
/// Its address is the only one that anybody is told.
const SEED: usize = 1;

fn orders() -> Vec<[usize; 3]> {
    let all = [[0, 1, 2], [2, 0, 1], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 1, 0]];
    all[..if long() { 6 } else { 2 }].to_vec()
}

fn everybody_else(node: usize) -> Vec<String> {
    let others = (0..3).filter(|other| *other != node);
    let mut names: Vec<String> = others.map(|other| NODES[other].1.to_owned()).collect();
    names.sort();
    names
}

/// Starts in this order, each when the one before is ready; gives the time to the meeting after the last is.
fn meet(order: [usize; 3], launch: impl Fn(usize) -> Launch) -> anyhow::Result<Duration> {
    let mut running: Vec<(usize, Node)> = Vec::new();
    let mut ready = Instant::now();
    for index in order {
        let mut node = launch(index).start()?;
        wait::until("ready", START, || node.poll_ready(), String::new)
            .map_err(|error| error.context(node.process.tail()))?;
        ready = Instant::now();
        running.push((index, node));
    }
    let known = || {
        let mut nodes = running.iter();
        nodes.all(|(index, node)| node.peers_up() == everybody_else(*index))
    };
    wait::until("all flows know each other", within(MEET), known, || {
        let lists = running
            .iter()
            .map(|(_, node)| format!("{} knows {:?}\n{}", node.name, node.peers_up(), node.process.tail()));
        lists.collect::<Vec<_>>().join("\n")
    })?;
    Ok(ready.elapsed())
}

fn meet_in_all_orders(what: &str, launch: impl Fn(usize) -> Launch) -> anyhow::Result<()> {
    for order in orders() {
        let names = order.map(|index| NODES[index].0);
        let took = meet(order, &launch).map_err(|error| error.context(format!("{what}, {names:?}")))?;
        println!("meeting, {what}: {names:?}: everybody known {took:.0?} after the last was ready");
        anyhow::ensure!(took <= within(MEET), "{what}, {names:?}: {took:?}");
    }
    Ok(())
}

fn over_loopback() -> anyhow::Result<()> {
    let domain = free_domain()?;
    meet_in_all_orders("loopback", |index| Launch {
        peer: (index != SEED).then(|| "127.0.0.1".to_owned()),
        ..Launch::local(NODES[index].0, domain)
    })
}

/// Three hosts without multicast: robot and cloud are told of the fog only, and learn of each other from it.
fn between_hosts() -> anyhow::Result<()> {
    check_rights()?;
    let lan = Lan::new(3)?;
    meet_in_all_orders("three hosts", |index| Launch {
        listen: lan.addresses[index].clone(),
        peer: (index != SEED).then(|| lan.addresses[SEED].clone()),
        namespace: Some(lan.names[index].clone()),
        ..Launch::local(NODES[index].0, 62)
    })
}

#[test]
fn flows_of_one_host_meet_whichever_starts_first() {
    over_loopback().unwrap_or_else(|error| panic!("{error:#}"));
}

#[test]
fn flows_of_three_hosts_meet_whichever_starts_first() {
    between_hosts().unwrap_or_else(|error| panic!("{error:#}"));
}
