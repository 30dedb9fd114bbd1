//! The allocation of a running flow: what was measured goes to the limiter, and its rates to the
//! lanes.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_domain::LayerName;
use blaze_domain::node_file::BandwidthSection;

use super::Shared;
use crate::lane::allocation::Reckoned;
use crate::limit::capacity::State;
use crate::limit::limiter::LinkRate;
use crate::limit::wire_factor::Totals;
use crate::link::{Engine, LinkBudgets, LinkCapacity, PacketSize};

impl Shared {
    /// Works out the rates of lanes where something has changed that they depend on; to be called
    /// with each tick of the control task. The work is done outside of the lock of the message
    /// path, which is taken for reading what there is and for setting the rates.
    pub(super) fn allocate(&self, now: Instant) {
        let mut limiter = self.limiter.lock();
        if limiter.is_time_to_look(now) {
            let seconds = limiter.bandwidth().size_window_s;
            let window = (seconds > 0).then(|| Duration::from_secs(seconds.into()));
            let (moved, reckoned, capacities) = self.plane.read(|state| {
                let moved = state.core.look_at_rates(now, window);
                let capacities = state.engine.as_ref().map(Engine::capacities);
                let being_sent = state.engine.iter().flat_map(Engine::begun);
                (moved, state.core.reckoned(being_sent), capacities.unwrap_or_default())
            });
            if moved {
                limiter.touch();
            }
            if let Some(pool) = self.plane.codec() {
                let threads = pool.counters().threads;
                self.plane.read(|state| state.core.share_pool(now, threads));
            }
            let (all, links) = self.totals(&reckoned);
            let rates = capacities.into_iter().map(|(flow, capacity)| (flow, rate_of(capacity)));
            limiter.look(now, all, &links, rates.collect());
        }
        let (grown, changed) = self
            .plane
            .read(|state| (state.core.take_allocation_due(), state.core.take_lanes_changed()));
        if grown {
            limiter.size_grown();
        }
        if changed {
            limiter.touch();
        }
        if !limiter.is_due(now) {
            return;
        }
        let wanted = self.plane.read(|state| state.core.wanted(now));
        let rates = limiter.run(now, &wanted.demands());
        self.plane.read(|state| state.core.set_rates(now, &wanted, rates));
        let needed = limiter.standard_wire_bytes_per_s();
        self.plane.read(|state| {
            if let Some(engine) = &mut state.engine {
                engine.set_needed(now, needed);
            }
        });
    }

    /// Takes what the node file says now: the pacer follows at once, the rates of lanes in a
    /// moment.
    pub(super) fn set_bandwidth(&self, now: Instant, bandwidth: &BandwidthSection) {
        self.egress.set_budget(bandwidth.limit_bytes_per_s());
        self.limiter.lock().set_bandwidth(bandwidth.clone());
        let budgets =
            self.inter.as_ref().map(|inter| link_budgets(bandwidth, inter.wire().packets()));
        self.plane.with(|state| {
            state.core.set_large_bytes(bandwidth.large_bytes.into());
            if let Some((engine, budgets)) = state.engine.as_mut().zip(budgets) {
                engine.set_budgets(now, budgets);
            }
        });
    }

    /// What has left since the start: of all links, and of those to each layer.
    fn totals(&self, reckoned: &Reckoned) -> (Totals, BTreeMap<LayerName, Totals>) {
        let traffic = self.egress.traffic();
        let all = Totals {
            user_wire: traffic.wire_bytes - traffic.control_bytes,
            control_wire: traffic.control_bytes,
            reckoned: reckoned.all,
        };
        let links = traffic.by_layer.into_iter().map(|(layer, link)| {
            let wire: u64 = link.wire_bytes.iter().sum();
            let totals = Totals {
                user_wire: wire - link.control_bytes,
                control_wire: link.control_bytes,
                reckoned: reckoned.by_layer.get(&layer).copied().unwrap_or(0),
            };
            (layer, totals)
        });
        (all, links.collect())
    }
}

/// What the allocation makes of what is known of a link.
fn rate_of(capacity: LinkCapacity) -> LinkRate {
    // The rate of the moment dips when the estimate is tried out; images need not follow that.
    match (capacity.measured_bytes_per_s, capacity.state) {
        (Some(carries), _) => LinkRate::Carries(carries),
        (None, State::Unknown) => LinkRate::Free,
        (None, State::SlowStart | State::Steady | State::BackingOff) => {
            LinkRate::Ramping(capacity.bytes_per_s)
        }
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
