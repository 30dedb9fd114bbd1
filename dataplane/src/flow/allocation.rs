//! The allocation of a running flow: what was measured goes to the limiter, and its rates to the lanes.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_domain::LayerName;

use super::Shared;
use crate::limit::limiter::Measured;
use crate::limit::wire_factor::Totals;

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
            let (all, links) = self.totals(&sent);
            limiter.look(now, all, &links, Measured::default());
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
