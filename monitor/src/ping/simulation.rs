//! Simulations: 64 nodes with a complete matrix, 1,000 nodes with a bounded share.

use std::collections::BTreeSet;

use blaze_domain::FlowId;
use rand::RngExt;

use super::testing::{Delay, MS, Net, Received, S, TestClock, node};

const SEED: u64 = 30;

/// 1 to 30 ms.
fn delays() -> Delay {
    Box::new(|_, rng| Some(rng.random_range(MS..30 * MS)))
}

fn nodes(layer: &str, count: usize) -> Vec<FlowId> {
    (0..count).map(|n| node(&format!("{layer}/{layer}-{n}"))).collect()
}

/// A network whose clocks are wrong by up to 3 s.
fn network(ids: Vec<FlowId>) -> Net {
    let mut clocks = vec![TestClock::default(); ids.len()];
    for (clock, n) in clocks.iter_mut().zip(0..) {
        clock.course += (n * 37 % 61 - 30) * 100 * MS;
    }
    Net::new(ids, clocks, SEED, delays())
}

fn series(net: &Net, n: usize) -> BTreeSet<FlowId> {
    let view = net.engines[n].view(net.now(n));
    view.nodes.into_iter().map(|row| FlowId::new(row.layer, row.node)).collect()
}

/// Messages that each node receives from now on in some seconds: most pings and most pongs a second
/// at one node, and the means of all nodes.
fn rates(net: &mut Net, seconds: i64) -> (f64, f64) {
    net.received.fill(Received::default());
    net.run_until(net.at + seconds * S);
    let rate = |count: u64| count as f64 / seconds as f64;
    let most = |count: fn(&Received) -> u64| net.received.iter().map(count).max().unwrap_or(0);
    let mean = |count: fn(&Received) -> u64| {
        rate(net.received.iter().map(count).sum()) / net.received.len() as f64
    };
    let (pings, pongs) = (rate(most(|r| r.pings)), rate(most(|r| r.pongs)));
    println!(
        "{} nodes, {seconds} s: a node receives at most {pings:.2} pings/s and {pongs:.2} pongs/s, \
         in the mean {:.2} and {:.2}",
        net.ids.len(),
        mean(|r| r.pings),
        mean(|r| r.pongs),
    );
    assert!(net.received.iter().all(|r| r.longest <= 1_200));
    (pings, pongs)
}

#[test]
fn the_matrix_of_64_nodes_is_complete_in_two_periods() {
    let ids = [nodes("edge", 48), nodes("fog", 10), nodes("cloud", 6)].concat();
    let mut net = network(ids);
    let (pings, pongs) = rates(&mut net, 20);
    // The 8 pings at the start of all at once: 63 nodes, each a second; answers share messages.
    assert!(pings <= 30.0 && pongs <= 240.0, "at the start {pings} and {pongs} a second");
    net.run_until(120 * S);
    for n in 0..64 {
        let view = net.engines[n].view(net.now(n));
        assert_eq!(view.nodes.len(), 63);
        for row in &view.nodes {
            let to = net.ids.iter().position(|id| id.node == row.node).unwrap();
            let truth = net.clocks[n].true_offset_s(&net.clocks[to], net.at) * 1e3;
            let (offset, error) = (row.clock_offset_ms.unwrap(), row.clock_error_ms.unwrap());
            assert!((offset - truth).abs() <= error, "{offset} ± {error} ms, true {truth} ms");
            assert!(row.latency_ms.last.is_some_and(|ms| (1.0..=30.0).contains(&ms)));
            assert!(row.lost == 0 && row.sent >= 9, "{row:?}");
        }
    }
    let (pings, pongs) = rates(&mut net, 120);
    // 63 pings a minute; 63 nodes that answer at most once a second.
    assert!(pings <= 1.2 && pongs <= 63.0, "{pings} and {pongs} a second");
}

fn thousand(edge_layers: usize) -> Vec<FlowId> {
    let robot = |n: usize| node(&format!("edge-{}/robot-{n}", n % edge_layers));
    let robots: Vec<FlowId> = (0..985).map(robot).collect();
    [robots, nodes("fog", 8), nodes("cloud", 7)].concat()
}

/// The limits hold for robots of one layer; of nine layers a node hears twice as many pongs. Every
/// node asks the same ones at the end.
fn thousand_nodes(edge_layers: usize, seconds: i64) {
    let mut net = network(thousand(edge_layers));
    net.run_until(S);
    let before: Vec<_> = (0..1_000).map(|n| series(&net, n)).collect();
    let most = before.iter().map(BTreeSet::len).max().unwrap();
    assert!(most <= 24 && before.iter().all(|series| series.len() >= 10));
    let layers: BTreeSet<_> = before[0].iter().map(|node| node.layer.clone()).collect();
    assert_eq!(layers.len(), edge_layers + 2);
    // The start of all at once is no flood either.
    let (pings, pongs) = rates(&mut net, 20);
    let most_pongs = if edge_layers == 1 { 6.0 } else { 12.0 };
    assert!(pings <= 16.0 && pongs <= most_pongs, "at the start {pings} and {pongs} a second");
    let (pings, pongs) = rates(&mut net, seconds);
    assert!(pings <= 12.0 && pongs <= most_pongs, "{pings} and {pongs} a second");
    for (n, before) in before.iter().enumerate() {
        assert_eq!(series(&net, n), *before, "node {n} asks others");
    }
    let rows: Vec<_> = (0..1_000).flat_map(|n| net.engines[n].view(net.now(n)).nodes).collect();
    println!("{edge_layers} edge layers: at most {most} nodes asked, {} pairs", rows.len());
    assert!(rows.iter().all(|row| row.lost == 0 && row.clock_offset_ms.is_some()));
}

/// An hour with `BLAZE_LONG`, else a period of 100 s with its jitter and more.
fn seconds() -> i64 {
    if std::env::var_os("BLAZE_LONG").is_some() { 3_600 } else { 120 }
}

#[test]
fn a_thousand_nodes_receive_few_messages() {
    thousand_nodes(1, seconds());
}

mod long {
    #[test]
    fn a_thousand_nodes_in_many_layers_receive_few_messages() {
        super::thousand_nodes(9, super::seconds());
    }
}
