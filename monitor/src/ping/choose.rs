//! Which of the known nodes are asked.
//!
//! Up to 64 known nodes: all. Above: a share of each layer by rendezvous hashing, so that a node
//! asks the same ones as long as they exist, and all nodes together ask each one equally often.

use std::collections::{BTreeMap, BTreeSet};

use blaze_domain::FlowId;

use super::limits::{ALL_ASKED, IN_ALL, PER_LAYER};

/// The nodes that `own` asks.
pub(super) fn choose<'a>(
    own: &FlowId,
    known: impl Iterator<Item = &'a FlowId>,
) -> BTreeSet<FlowId> {
    let known: Vec<&FlowId> = known.collect();
    if known.len() <= ALL_ASKED {
        return known.into_iter().cloned().collect();
    }
    let mut layers: BTreeMap<&str, Vec<(u64, &FlowId)>> = BTreeMap::new();
    let seed = hashed(FNV, own);
    for node in &known {
        layers.entry(node.layer.as_str()).or_default().push((mixed(hashed(seed, node)), node));
    }
    let mut ranked: Vec<(usize, u64, &FlowId)> = Vec::new();
    for nodes in layers.values_mut() {
        let share = (ALL_ASKED * nodes.len()).div_ceil(known.len()).min(PER_LAYER);
        nodes.sort_unstable();
        ranked.extend(nodes.iter().take(share).enumerate().map(|(rank, (w, n))| (rank, *w, *n)));
    }
    // The first of each layer before the second of any: each layer is measured.
    ranked.sort_unstable();
    ranked.into_iter().take(IN_ALL).map(|(_, _, node)| node.clone()).collect()
}

const FNV: u64 = 0xCBF2_9CE4_8422_2325;

/// FNV-1a over `layer 0xFF node 0xFF`, as in the flow's rendezvous hashing.
fn hashed(start: u64, node: &FlowId) -> u64 {
    let parts = [node.layer.as_str(), node.node.as_str()];
    let bytes = parts.iter().flat_map(|part| part.bytes().chain([0xFF]));
    bytes.fold(start, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01B3))
}

/// Finaliser of SplitMix64: FNV alone leaves the high bits of similar names alike.
fn mixed(mut hash: u64) -> u64 {
    hash = (hash ^ (hash >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    hash = (hash ^ (hash >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    hash ^ (hash >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn nodes(layer: &str, count: usize) -> Vec<FlowId> {
        (0..count).map(|n| format!("{layer}/{layer}-{n}").parse().unwrap()).collect()
    }

    fn of_layer(asked: &BTreeSet<FlowId>, layer: &str) -> usize {
        asked.iter().filter(|node| node.layer.as_str() == layer).count()
    }

    #[test]
    fn up_to_64_known_nodes_are_all_asked_and_above_a_share_of_each_layer() {
        let own: FlowId = "edge/own".parse().unwrap();
        let mut known = nodes("edge", 64);
        assert_eq!(choose(&own, known.iter()).len(), 64);
        known.extend(nodes("fog", 3));
        let asked = choose(&own, known.iter());
        // 64 · 64 / 67 is above 8; 64 · 3 / 67 rounds up to 3.
        assert_eq!((of_layer(&asked, "edge"), of_layer(&asked, "fog")), (8, 3));
        for layer in ["a", "b", "c", "d"] {
            known.extend(nodes(layer, 20));
        }
        let asked = choose(&own, known.iter());
        assert_eq!(asked.len(), IN_ALL);
        assert!(["edge", "fog", "a", "b", "c", "d"].iter().all(|l| of_layer(&asked, l) >= 2));
    }

    #[test]
    fn a_node_that_goes_is_replaced_and_the_others_stay() {
        let own: FlowId = "edge/own".parse().unwrap();
        let known = nodes("edge", 500);
        let before = choose(&own, known.iter());
        let gone = before.first().unwrap();
        let after = choose(&own, known.iter().filter(|node| *node != gone));
        assert_eq!(after.intersection(&before).count(), before.len() - 1);
    }

    #[test]
    fn nodes_are_asked_equally_often() {
        let known = nodes("edge", 500);
        let mut asked: BTreeMap<FlowId, usize> = BTreeMap::new();
        for own in &known {
            for node in choose(own, known.iter().filter(|node| *node != own)) {
                *asked.entry(node).or_default() += 1;
            }
        }
        let most = asked.values().max().unwrap();
        assert!(*most <= 20, "one node is asked by {most}, 8 in the mean");
    }
}
