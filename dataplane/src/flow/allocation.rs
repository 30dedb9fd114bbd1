//! The allocation of a running flow: what was measured goes to the limiter, and its rates to the lanes.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_domain::LayerName;
use blaze_domain::node_file::BandwidthSection;

use super::Shared;
use crate::limit::capacity::State;
use crate::limit::limiter::Measured;
use crate::limit::wire_factor::Totals;
use crate::link::{LinkBudgets, PacketSize, PeerInfo, PeerState};

impl Shared {
    /// Works out the rates of lanes where something has changed that they depend on; to be called every few milliseconds. The work is
    /// done outside of the lock of the message path, which is taken for reading what there is and for setting the rates.
    pub(super) fn allocate(&self, now: Instant) {
        let mut limiter = self.limiter.lock();
        if limiter.is_time_to_look(now) {
            let seconds = limiter.bandwidth().size_window_s;
            let window = (seconds > 0).then(|| Duration::from_secs(seconds.into()));
            let (moved, sent) = self.plane.read(|state| {
                let moved = state.core.look_at_rates(now, window);
                (moved, state.core.sent_payload())
            });
            if moved {
                limiter.touch();
            }
            if let Some(pool) = self.plane.codec() {
                let threads = pool.counters().threads;
                self.plane.read(|state| state.core.share_pool(now, threads));
            }
            let (all, links) = self.totals(&sent);
            let measured = self.capacities();
            limiter.look(now, all, &links, measured);
        }
        if self.plane.read(|state| state.core.take_allocation_due()) {
            limiter.touch();
        }
        if !limiter.is_due(now) {
            return;
        }
        let wanted = self.plane.read(|state| state.core.wanted(now));
        let rates = limiter.run(now, &wanted.demands());
        self.plane.read(|state| state.core.set_rates(now, &wanted, rates));
    }

    /// Takes what the node file says now: the pacer follows at once, the rates of lanes in a moment.
    pub(super) fn set_bandwidth(&self, now: Instant, bandwidth: &BandwidthSection) {
        self.egress.set_budget(bandwidth.limit_bytes_per_s());
        self.limiter.lock().set_bandwidth(bandwidth.clone());
        let budgets = self.inter.as_ref().map(|inter| link_budgets(bandwidth, inter.packets()));
        self.plane.with(|state| {
            state.core.set_large_bytes(bandwidth.large_bytes.into());
            if let Some((engine, budgets)) = state.engine.as_mut().zip(budgets) {
                engine.set_budgets(now, budgets);
            }
        });
    }

    /// What the links to each layer can carry, for those where one of them was seen to carry less than its limit.
    fn capacities(&self) -> Measured {
        let peers = self
            .plane
            .read(|state| state.engine.as_ref().map(crate::link::Engine::peers).unwrap_or_default());
        let mut capacity: BTreeMap<LayerName, (f64, bool)> = BTreeMap::new();
        for PeerInfo { flow, capacity: link, .. } in peers.into_iter().filter(|peer| peer.state == PeerState::Up) {
            let Some(link) = link else { continue };
            let sum = capacity.entry(flow.layer).or_default();
            // The rate of the moment dips when the estimate is tried out; images need not follow that.
            sum.0 += link.measured_bytes_per_s.unwrap_or(link.bytes_per_s);
            sum.1 |= link.state != State::Unknown;
        }
        let limited = capacity.into_iter().filter(|(_, (_, limited))| *limited);
        Measured {
            capacity_bytes_per_s: limited.map(|(layer, (sum, _))| (layer, sum)).collect(),
        }
    }

    /// What has left since the start: of all links, and of those to each layer.
    fn totals(&self, sent: &BTreeMap<LayerName, u64>) -> (Totals, BTreeMap<LayerName, Totals>) {
        let mut links: BTreeMap<LayerName, Totals> = BTreeMap::new();
        for destination in self.egress.traffic().by_destination {
            let link = links.entry(destination.flow.layer).or_default();
            let wire: u64 = destination.wire_bytes.iter().sum();
            link.control_wire += destination.control_bytes;
            link.user_wire += wire - destination.control_bytes;
        }
        for (layer, payload) in sent {
            links.entry(layer.clone()).or_default().payload += payload;
        }
        let all = links.values().fold(Totals::default(), |all, link| Totals {
            user_wire: all.user_wire + link.user_wire,
            control_wire: all.control_wire + link.control_wire,
            payload: all.payload + link.payload,
        });
        (all, links)
    }
}

/// The budgets of the links, as the node file gives them.
pub(super) fn link_budgets(bandwidth: &BandwidthSection, packets: PacketSize) -> LinkBudgets {
    let layers = bandwidth.links.keys();
    LinkBudgets {
        limit_bytes_per_s: bandwidth.limit_bytes_per_s(),
        layers: layers
            .filter_map(|layer| Some((layer.clone(), bandwidth.link_limit_bytes_per_s(layer)?)))
            .collect(),
        adaptive: bandwidth.adaptive,
        packets,
    }
}
