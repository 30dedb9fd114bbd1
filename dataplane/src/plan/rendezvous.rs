//! Rendezvous hashing: all flows that see the same candidates choose the same one, without talking
//! to each other.
//!
//! When a candidate goes, only its topics move; when one comes, it takes its share and nothing else
//! moves.

use blaze_domain::FlowId;

/// The candidate with the largest weight for a key, which is the topic unless said otherwise; of
/// equal weights the smaller name. `None` without candidates.
pub(crate) fn choose<'a>(
    key: &str,
    candidates: impl Iterator<Item = &'a FlowId>,
) -> Option<&'a FlowId> {
    candidates.max_by(|a, b| weight(key, a).cmp(&weight(key, b)).then_with(|| b.cmp(a)))
}

/// The candidates with the largest weights for a key, at most so many, best first.
pub(crate) fn best<'a>(
    key: &str,
    candidates: impl Iterator<Item = &'a FlowId>,
    most: usize,
) -> Vec<&'a FlowId> {
    if most == 0 {
        return Vec::new();
    }
    let mut ranked: Vec<(u64, &FlowId)> =
        candidates.map(|flow| (weight(key, flow), flow)).collect();
    ranked.sort_by(|a, b| b.0.cmp(&a.0).then_with(|| a.1.cmp(b.1)));
    ranked.truncate(most);
    ranked.into_iter().map(|(_, flow)| flow).collect()
}

/// Of `topic 0xFF layer 0xFF node`.
fn weight(key: &str, flow: &FlowId) -> u64 {
    let parts = [key, flow.layer.as_str(), flow.node.as_str()];
    stable_hash(parts.iter().flat_map(|part| part.bytes().chain([0xFF])))
}

/// FNV-1a (64 bits), then the finaliser of SplitMix64, because FNV alone leaves the high bits of
/// similar names alike, and sums of its values share their weak low bits. It is part of what flows
/// agree on: a change of it moves topics between versions.
pub(crate) fn stable_hash(bytes: impl Iterator<Item = u8>) -> u64 {
    let mut hash = bytes.fold(0xCBF2_9CE4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01B3)
    });
    hash = (hash ^ (hash >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    hash = (hash ^ (hash >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    hash ^ (hash >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;
    use blaze_domain::TopicName;

    fn flows(count: usize) -> Vec<FlowId> {
        (0..count).map(|n| format!("fog/fog-{n}").parse().unwrap()).collect()
    }

    #[test]
    fn topics_are_spread_evenly() {
        let flows = flows(4);
        let mut wins = [0; 4];
        for n in 0..4000 {
            let topic: TopicName = format!("robot-{n}/imu").parse().unwrap();
            let chosen = choose(topic.as_str(), flows.iter()).unwrap();
            wins[flows.iter().position(|flow| flow == chosen).unwrap()] += 1;
        }
        assert!(wins.iter().all(|wins| (900..1100).contains(wins)), "{wins:?}");
    }

    #[test]
    fn a_flow_that_goes_moves_only_its_own_topics() {
        let flows = flows(5);
        for n in 0..1000 {
            let topic: TopicName = format!("t{n}").parse().unwrap();
            let before = choose(topic.as_str(), flows.iter()).unwrap();
            let after = choose(topic.as_str(), flows[1..].iter()).unwrap();
            assert!(after == before || *before == flows[0]);
        }
    }

    #[test]
    fn the_choice_is_the_same_on_every_machine_and_in_every_version() {
        let topic: TopicName = "imu/data".parse().unwrap();
        let flow: FlowId = "edge/robot-1".parse().unwrap();
        assert_eq!(weight(topic.as_str(), &flow), 0xA5AC_9753_F95C_C1E3);
    }
}
