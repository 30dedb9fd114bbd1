//! Three flows with one seed meet, whichever starts first.

use std::time::{Duration, Instant};

use blaze_tests::{long, wait};

use super::support::{Launch, Node, START, turn};

const DOMAIN: u16 = 61;
/// From the moment when the last is ready to the moment when everybody knows everybody.
const MEET: Duration = Duration::from_secs(2);
/// Between two starts, so that the first is there before the last begins.
const NODES: [(&str, &str); 3] = [
    ("robot-1", "edge/robot-1"),
    ("fog-1", "fog/fog-1"),
    ("cloud-1", "cloud/cloud-1"),
];

fn orders() -> Vec<[usize; 3]> {
    let all = [[0, 1, 2], [2, 1, 0], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1]];
    all[..if long() { 6 } else { 2 }].to_vec()
}

fn everybody_else(node: usize) -> Vec<String> {
    let others = (0..3).filter(|other| *other != node);
    let mut names: Vec<String> = others.map(|other| NODES[other].1.to_owned()).collect();
    names.sort();
    names
}

/// Starts in this order, each when the one before is ready; gives the time to the meeting after the last is.
fn meet(order: [usize; 3]) -> anyhow::Result<Duration> {
    let mut running: Vec<(usize, Node)> = Vec::new();
    let mut ready = Instant::now();
    for (place, index) in order.into_iter().enumerate() {
        // The seed: only the one that starts in the middle names a peer.
        let peer = (place == 1).then(|| "127.0.0.1".to_owned());
        let launch = Launch {
            peer,
            ..Launch::local(NODES[index].0, DOMAIN)
        };
        let mut node = launch.start()?;
        wait::until("ready", START, || node.poll_ready(), String::new)
            .map_err(|error| error.context(node.process.tail()))?;
        ready = Instant::now();
        running.push((index, node));
    }
    let known = || {
        running
            .iter()
            .all(|(index, node)| node.peers_up() == everybody_else(*index))
    };
    wait::until("all flows know each other", MEET, known, || {
        let lists = running
            .iter()
            .map(|(_, node)| format!("{} knows {:?}\n{}", node.name, node.peers_up(), node.process.tail()));
        lists.collect::<Vec<_>>().join("\n")
    })?;
    Ok(ready.elapsed())
}

#[test]
fn flows_meet_whichever_starts_first() {
    let _turn = turn();
    for order in orders() {
        let names = order.map(|index| NODES[index].0);
        let took = meet(order).unwrap_or_else(|error| panic!("{names:?}: {error:#}"));
        println!("meeting: {names:?}: everybody known {took:.0?} after the last was ready");
        assert!(took <= MEET, "{names:?}: {took:?}");
    }
}
