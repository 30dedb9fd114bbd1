//! What may go to each peer: the limit of its layer, and what its link was seen to carry.
//!
//! The pacer of the process keeps the limit of all links together; these keep that of a single one,
//! so that a slow destination makes only its own messages wait. LinkControl is never held back: it
//! may put a link into debt, which messages then wait off.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_domain::LayerName;

use crate::limit::capacity::{Capacity, Seen, State};
use crate::limit::pacer::{BURST_DATAGRAMS, Pacer};

/// What a datagram becomes on the wire. Sizes are in bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PacketSize {
    /// Put before a datagram.
    pub prefix: usize,
    /// Both together are filled up to a multiple of this.
    pub align: usize,
    /// With its prefix a datagram up to this size goes as one packet …
    pub whole: usize,
    /// … with headers of this size.
    pub whole_header: usize,
    /// Of a larger one so much goes in one packet at most, …
    pub last_part: usize,
    /// … so much in each packet before that, …
    pub part: usize,
    /// … each with headers of this size.
    pub part_header: usize,
}

impl PacketSize {
    /// Bytes of all IP packets of a datagram.
    #[must_use]
    pub fn wire_bytes(self, datagram_bytes: usize) -> usize {
        let content = self.prefix + datagram_bytes;
        let filled = content.next_multiple_of(self.align.max(1));
        if content <= self.whole {
            return self.whole_header + filled;
        }
        let packets = 1 + content.saturating_sub(self.last_part).div_ceil(self.part.max(1));
        packets * self.part_header + filled
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
    pub(crate) fn set(&mut self, now: Instant, budgets: LinkBudgets, max_datagram: usize) {
        let burst = burst_bytes(budgets.packets, max_datagram);
        self.layers.retain(|layer, _| budgets.layers.contains_key(layer));
        for (layer, limit) in &budgets.layers {
            let pacer = self.layers.entry(layer.clone());
            let pacer = pacer.or_insert_with(|| Pacer::new(*limit, burst, now));
            pacer.set_limit(*limit, now);
            pacer.set_burst(burst);
        }
        self.set = Some(budgets);
    }

    pub(crate) fn packets(&self) -> Option<PacketSize> {
        self.set.as_ref().map(|set| set.packets)
    }

    fn limit(&self, layer: &LayerName) -> Option<f64> {
        let set = self.set.as_ref()?;
        let own = set.layers.get(layer).copied().unwrap_or(f64::INFINITY);
        Some(set.limit_bytes_per_s.min(own))
    }

    /// Whether a peer of the layer may be sent to; else it is noted when.
    pub(crate) fn may_send(
        &mut self,
        now: Instant,
        layer: &LayerName,
        path: &mut PathBudget,
    ) -> bool {
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
    pub(crate) fn spend(
        &mut self,
        now: Instant,
        layer: &LayerName,
        path: &mut PathBudget,
        datagram_bytes: usize,
    ) {
        let Some(packets) = self.packets() else { return };
        let wire_bytes = packets.wire_bytes(datagram_bytes);
        if let Some(pacer) = self.layers.get_mut(layer) {
            pacer.spend(wire_bytes, now);
        }
        path.spend(now, wire_bytes);
    }

    /// Nothing is to be sent to a peer; `of_layer`: nor to any other of its layer.
    pub(crate) fn rest(
        &mut self,
        now: Instant,
        layer: &LayerName,
        path: &mut PathBudget,
        of_layer: bool,
    ) {
        if of_layer && let Some(pacer) = self.layers.get_mut(layer) {
            pacer.rest(now);
        }
        if let Some(follow) = &mut path.follow {
            follow.pacer.rest(now);
        }
    }

    /// Whether the links to a layer have a limit of their own.
    pub(crate) fn has_limit(&self, layer: &LayerName) -> bool {
        self.layers.contains_key(layer)
    }

    /// Makes a peer's budget as it is set now.
    pub(crate) fn fit(
        &self,
        now: Instant,
        layer: &LayerName,
        max_datagram: usize,
        path: &mut PathBudget,
    ) {
        let adaptive = self.set.as_ref().filter(|set| set.adaptive);
        match adaptive.zip(self.limit(layer)) {
            Some((set, limit)) => path.adapt(now, limit, burst_bytes(set.packets, max_datagram)),
            None => path.follow = None,
        }
    }
}

fn burst_bytes(packets: PacketSize, max_datagram: usize) -> usize {
    BURST_DATAGRAMS * packets.wire_bytes(max_datagram)
}

/// What may go to one peer.
#[derive(Debug, Default)]
pub(crate) struct PathBudget {
    follow: Option<Follow>,
    /// What is small needs so much, in wire bytes per second.
    needed: f64,
}

#[derive(Debug)]
struct Follow {
    capacity: Capacity,
    pacer: Pacer,
}

impl PathBudget {
    fn adapt(&mut self, now: Instant, limit: f64, burst_bytes: usize) {
        match &mut self.follow {
            Some(follow) => {
                follow.capacity.set_limit(limit, now);
                follow.pacer.set_burst(burst_bytes);
            }
            None => {
                let mut capacity = Capacity::new(limit, now);
                capacity.set_needed(self.needed, now);
                self.follow = Some(Follow { capacity, pacer: Pacer::new(limit, burst_bytes, now) });
            }
        }
        self.pace(now);
    }

    /// So much is needed for what is small, in wire bytes per second.
    pub(crate) fn set_needed(&mut self, now: Instant, wire_bytes_per_s: f64) {
        self.needed = wire_bytes_per_s;
        if let Some(follow) = &mut self.follow {
            follow.capacity.set_needed(wire_bytes_per_s, now);
            self.pace(now);
        }
    }

    fn pace(&mut self, now: Instant) {
        if let Some(Follow { capacity, pacer }) = &mut self.follow {
            pacer.set_limit(capacity.bytes_per_s(), now);
        }
    }

    fn wait(&mut self, now: Instant) -> Duration {
        self.follow.as_mut().map_or(Duration::ZERO, |follow| follow.pacer.wait(now))
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
        })
    }
}

/// Those of DDS over Ethernet.
#[cfg(test)]
pub(super) const ETHERNET: PacketSize = PacketSize {
    prefix: 8,
    align: 4,
    whole: 1_404,
    whole_header: 72,
    last_part: 1_396,
    part: 1_280,
    part_header: 84,
};

#[cfg(test)]
mod tests {
    use super::ETHERNET as PACKETS;
    use super::*;

    fn budgets(
        limit_bytes_per_s: f64,
        layers: &[(&LayerName, f64)],
        adaptive: bool,
        packets: PacketSize,
    ) -> LinkBudgets {
        LinkBudgets {
            limit_bytes_per_s,
            layers: layers.iter().map(|(layer, limit)| ((*layer).clone(), *limit)).collect(),
            adaptive,
            packets,
        }
    }

    /// Datagrams that may leave at once after a pause.
    fn burst(link: &mut Budgets, now: Instant, layer: &LayerName, path: &mut PathBudget) -> usize {
        let mut datagrams = 0;
        while datagrams < 100 && link.may_send(now, layer, path) {
            link.spend(now, layer, path, 1_296);
            datagrams += 1;
        }
        datagrams
    }

    #[test]
    fn bursts_are_as_long_as_packets_are_large() {
        const SECOND: Duration = Duration::from_secs(1);
        let start = Instant::now();
        let cloud: LayerName = "cloud".parse().unwrap();
        let narrow = PacketSize { whole_header: 0, prefix: 0, ..PACKETS };
        // The limit is that of the layer, and then that of the path.
        for (layers, adaptive) in [(&[(&cloud, 1e6)][..], false), (&[][..], true)] {
            let (mut link, mut path) = (Budgets::default(), PathBudget::default());
            // So many small ones, before it is known how large they are.
            link.set(start, budgets(1e6, layers, adaptive, narrow), 100);
            link.fit(start, &cloud, 100, &mut path);
            assert_eq!(burst(&mut link, start + SECOND, &cloud, &mut path), 1);
            link.set(start + SECOND, budgets(1e6, layers, adaptive, PACKETS), 1_296);
            link.fit(start + SECOND, &cloud, 1_296, &mut path);
            link.rest(start + SECOND, &cloud, &mut path, true);
            assert_eq!(
                burst(&mut link, start + SECOND * 2, &cloud, &mut path),
                3,
                "two, and one into debt"
            );
        }
    }
}
