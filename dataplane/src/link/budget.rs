//! What may go to each peer: the limit of its layer, and what its link was seen to carry.
//!
//! The pacer of the process keeps the limit of all links together; these keep that of a single one, so that a slow destination makes
//! only its own messages wait. LinkControl is never held back: it may put a link into debt, which messages then wait off.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_domain::LayerName;

use crate::limit::capacity::{Capacity, Seen, State};
use crate::limit::pacer::Pacer;

/// A burst is at most this many datagrams.
const BURST_DATAGRAMS: usize = 2;

/// What a datagram becomes on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PacketSize {
    /// Bytes of a datagram that one IP packet carries.
    pub content_bytes: usize,
    /// Bytes of headers in each packet.
    pub header_bytes: usize,
}

impl PacketSize {
    /// Bytes of all IP packets of a datagram.
    #[must_use]
    pub fn wire_bytes(self, datagram_bytes: usize) -> usize {
        datagram_bytes + self.header_bytes * datagram_bytes.div_ceil(self.content_bytes.max(1)).max(1)
    }
}

/// The budgets of an engine.
#[derive(Debug, Clone, PartialEq)]
pub struct LinkBudgets {
    /// The limit of all links together, in wire bytes per second: no link can do more.
    pub limit_bytes_per_s: f64,
    /// Limits of the links to single layers.
    pub layers: BTreeMap<LayerName, f64>,
    /// Whether the rate of each link follows what it was seen to carry.
    pub adaptive: bool,
    /// What datagrams become on the wire.
    pub packets: PacketSize,
}

/// What is known of the link to one peer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinkCapacity {
    /// What may be sent now, in wire bytes per second.
    pub bytes_per_s: f64,
    /// What the link carries, where that is known to be less than its limit.
    pub measured_bytes_per_s: Option<f64>,
    /// How it stands with the estimate.
    pub state: State,
    /// How much longer the newest round trip took than that of the empty path.
    pub queueing_delay: Duration,
    /// Share of bytes that was lost of late, 0 to 1.
    pub loss: f64,
}

/// The budgets as they stand: who may send when.
#[derive(Debug, Default)]
pub(crate) struct Budgets {
    set: Option<LinkBudgets>,
    layers: BTreeMap<LayerName, Pacer>,
    /// When the first of those may send that had something to send and might not.
    pub paced_until: Option<Instant>,
}

impl Budgets {
    pub(crate) fn set(&mut self, budgets: LinkBudgets, burst_bytes: usize, now: Instant) {
        self.layers.retain(|layer, _| budgets.layers.contains_key(layer));
        for (layer, limit) in &budgets.layers {
            self.layers
                .entry(layer.clone())
                .or_insert_with(|| Pacer::new(*limit, burst_bytes, now))
                .set_limit(*limit, now);
        }
        self.set = Some(budgets);
    }

    pub(crate) fn wire_bytes(&self, datagram_bytes: usize) -> Option<usize> {
        self.set.as_ref().map(|set| set.packets.wire_bytes(datagram_bytes))
    }

    fn limit(&self, layer: &LayerName) -> Option<f64> {
        let set = self.set.as_ref()?;
        let own = set.layers.get(layer).copied().unwrap_or(f64::INFINITY);
        Some(set.limit_bytes_per_s.min(own))
    }

    /// Whether a peer of the layer may be sent to; else it is noted when.
    pub(crate) fn may_send(&mut self, now: Instant, layer: &LayerName, path: &mut PathBudget) -> bool {
        let of_layer = self.layers.get_mut(layer).map_or(Duration::ZERO, |pacer| pacer.wait(now));
        let wait = of_layer.max(path.wait(now));
        if wait.is_zero() {
            return true;
        }
        let at = now + wait;
        self.paced_until = Some(self.paced_until.map_or(at, |until| until.min(at)));
        false
    }

    /// Counts a datagram that leaves.
    pub(crate) fn spend(&mut self, now: Instant, layer: &LayerName, path: &mut PathBudget, datagram_bytes: usize) {
        let Some(wire_bytes) = self.wire_bytes(datagram_bytes) else {
            return;
        };
        if let Some(pacer) = self.layers.get_mut(layer) {
            pacer.spend(wire_bytes, now);
        }
        path.spend(now, wire_bytes);
    }

    /// Makes a peer's budget as it is set now.
    pub(crate) fn fit(&self, now: Instant, layer: &LayerName, burst_bytes: usize, path: &mut PathBudget) {
        let adaptive = self.set.as_ref().is_some_and(|set| set.adaptive);
        match self.limit(layer).filter(|_| adaptive) {
            Some(limit) => path.adapt(now, limit, burst_bytes),
            None => path.follow = None,
        }
    }

    pub(crate) fn burst_bytes(&self, max_datagram: usize) -> usize {
        BURST_DATAGRAMS * self.wire_bytes(max_datagram).unwrap_or(max_datagram)
    }
}

/// What may go to one peer.
#[derive(Debug, Default)]
pub(crate) struct PathBudget {
    follow: Option<Follow>,
}

#[derive(Debug)]
struct Follow {
    capacity: Capacity,
    pacer: Pacer,
}

impl PathBudget {
    fn adapt(&mut self, now: Instant, limit: f64, burst_bytes: usize) {
        match &mut self.follow {
            Some(follow) => follow.capacity.set_limit(limit, now),
            None => {
                self.follow = Some(Follow {
                    capacity: Capacity::new(limit, now),
                    pacer: Pacer::new(limit, burst_bytes, now),
                });
            }
        }
        self.pace(now);
    }

    fn pace(&mut self, now: Instant) {
        if let Some(Follow { capacity, pacer }) = &mut self.follow {
            pacer.set_limit(capacity.bytes_per_s(), now);
        }
    }

    fn wait(&mut self, now: Instant) -> Duration {
        self.follow
            .as_mut()
            .map_or(Duration::ZERO, |follow| follow.pacer.wait(now))
    }

    fn spend(&mut self, now: Instant, wire_bytes: usize) {
        if let Some(follow) = &mut self.follow {
            follow.capacity.sent(now, wire_bytes);
            follow.pacer.spend(wire_bytes, now);
        }
    }

    /// Takes what a Feedback has settled.
    pub(crate) fn feedback(&mut self, now: Instant, seen: &Seen) {
        if let Some(follow) = &mut self.follow {
            follow.capacity.feedback(now, seen);
            self.pace(now);
        }
    }

    /// The peer is back: the way to it may be another one.
    pub(crate) fn outage(&mut self, now: Instant) {
        if let Some(follow) = &mut self.follow {
            follow.capacity.outage(now);
            self.pace(now);
        }
    }

    pub(crate) fn capacity(&self) -> Option<LinkCapacity> {
        let capacity = &self.follow.as_ref()?.capacity;
        Some(LinkCapacity {
            bytes_per_s: capacity.bytes_per_s(),
            measured_bytes_per_s: capacity.measured(),
            state: capacity.state(),
            queueing_delay: capacity.queueing_delay(),
            loss: capacity.loss(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PACKETS: PacketSize = PacketSize {
        content_bytes: 1_296,
        header_bytes: 80,
    };

    #[test]
    fn a_datagram_has_the_headers_of_all_its_packets() {
        assert_eq!(PACKETS.wire_bytes(1_296), 1_376);
        assert_eq!(PACKETS.wire_bytes(1_297), 1_297 + 160);
        assert_eq!(PACKETS.wire_bytes(0), 80);
    }

    /// Bytes that two peers of two layers send in ten seconds, as fast as they may.
    #[test]
    fn a_slow_link_holds_back_its_own_peers_alone() {
        let start = Instant::now();
        let (fog, cloud): (LayerName, LayerName) = ("fog".parse().unwrap(), "cloud".parse().unwrap());
        let mut budgets = Budgets::default();
        let set = LinkBudgets {
            limit_bytes_per_s: 1_000_000.0,
            layers: BTreeMap::from([(cloud.clone(), 100_000.0)]),
            adaptive: false,
            packets: PACKETS,
        };
        budgets.set(set, 2 * 1_376, start);
        let mut paths = [PathBudget::default(), PathBudget::default()];
        let mut sent = [0usize; 2];
        for tick in 0..10_000u32 {
            let now = start + Duration::from_millis(1) * tick;
            budgets.paced_until = None;
            for (at, layer) in [&fog, &cloud].into_iter().enumerate() {
                if budgets.may_send(now, layer, &mut paths[at]) {
                    budgets.spend(now, layer, &mut paths[at], 1_296);
                    sent[at] += 1_376;
                }
            }
            assert!(budgets.paced_until.is_none_or(|until| until > now));
        }
        assert_eq!(sent[0], 10_000 * 1_376, "nothing but the pacer of the process bounds the fog");
        assert!((970_000..=1_000_000).contains(&sent[1]), "{sent:?}");
    }

    #[test]
    fn without_budgets_nobody_waits() {
        let now = Instant::now();
        let layer = "fog".parse().unwrap();
        let mut budgets = Budgets::default();
        let mut path = PathBudget::default();
        for _ in 0..1_000 {
            assert!(budgets.may_send(now, &layer, &mut path));
            budgets.spend(now, &layer, &mut path, 60_000);
        }
    }
}
