//! The thread that lets datagrams out: the only one that sends on the inter scope.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use blaze_domain::{LayerName, Priority};
use parking_lot::Mutex;

use super::inter::InterScope;
use super::plane::{Next, Plane};
use crate::lane::measure::RateMeter;
use crate::limit::pacer::{BURST_DATAGRAMS, Pacer};
use crate::limit::wire_factor::MAX_LAYERS;
use crate::link::transport::SendOutcome;

/// The pacer wakes at least that often, to notice a new limit or the end.
const IDLE: Duration = Duration::from_millis(100);
/// A debt from which on LinkControl is let out all the same; shorter ones delay it by no more than
/// this.
const LONG_DEBT: Duration = Duration::from_millis(10);

/// What the pacer shares with admin and metrics.
pub struct Egress {
    /// Budget in wire bytes per second, as the bits of an `f64`.
    budget: AtomicU64,
    stop: AtomicBool,
    traffic: Mutex<Traffic>,
}

/// Wire bytes that have left.
#[derive(Debug, Clone, Default)]
pub struct Traffic {
    /// All of them, since the start.
    pub wire_bytes: u64,
    /// Of those, what carried no user message.
    pub control_bytes: u64,
    /// To single layers, [`MAX_LAYERS`] at most.
    pub by_layer: BTreeMap<LayerName, LayerTraffic>,
    /// Datagrams that the transport did not take.
    pub not_sent: u64,
}

/// Wire bytes to the flows of one layer.
#[derive(Debug, Clone)]
pub struct LayerTraffic {
    /// Since the start, per class in the order of [`Priority::ALL`].
    pub wire_bytes: [u64; 3],
    /// Of those, what carried no user message.
    pub control_bytes: u64,
    /// Bytes per second.
    pub rate: RateMeter,
}

impl Egress {
    /// An egress with a budget in wire bytes per second.
    #[must_use]
    pub fn new(bytes_per_s: f64) -> Arc<Self> {
        Arc::new(Self {
            budget: AtomicU64::new(bytes_per_s.to_bits()),
            stop: AtomicBool::new(false),
            traffic: Mutex::default(),
        })
    }

    /// The budget in wire bytes per second.
    #[must_use]
    pub fn budget(&self) -> f64 {
        f64::from_bits(self.budget.load(Ordering::Relaxed))
    }

    /// Changes the budget; the pacer follows at once.
    pub fn set_budget(&self, bytes_per_s: f64) {
        self.budget.store(bytes_per_s.to_bits(), Ordering::Relaxed);
    }

    /// What has left so far.
    #[must_use]
    pub fn traffic(&self) -> Traffic {
        self.traffic.lock().clone()
    }

    /// Ends the pacer's thread soon.
    pub fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// The thread: sends until it is stopped.
    pub(super) fn run(&self, plane: &Plane, inter: &InterScope) {
        let start = Instant::now();
        let wire = inter.wire();
        let burst = BURST_DATAGRAMS * wire.bytes(wire.max_datagram_bytes());
        let mut pacer = Pacer::new(self.budget(), burst, start);
        while !self.stop.load(Ordering::Relaxed) {
            let now = Instant::now();
            let budget = self.budget();
            if (budget - pacer.limit()).abs() > f64::EPSILON {
                pacer.set_limit(budget, now);
            }
            let wait = pacer.wait(now);
            // Data waits off a debt. LinkControl does not, where that is long: peers would think
            // this flow dead.
            let transmit = if wait.is_zero() {
                match plane.next_transmit(IDLE) {
                    Next::Datagram(transmit) => Some(transmit),
                    Next::HeldBack => None,
                    Next::Nothing => {
                        pacer.rest(now);
                        None
                    }
                }
            } else {
                let control = if wait > LONG_DEBT { plane.next_control() } else { None };
                if control.is_none() {
                    std::thread::sleep(wait.min(IDLE));
                }
                control
            };
            let Some(transmit) = transmit else { continue };
            let wire_bytes = wire.bytes(transmit.datagram.len());
            let outcome = inter.send(&transmit.to, transmit.class, &transmit.datagram);
            let now = Instant::now();
            pacer.spend(wire_bytes, now);
            let mut traffic = self.traffic.lock();
            traffic.add(
                now,
                &transmit.to.flow.layer,
                transmit.class,
                wire_bytes as u64,
                transmit.control,
            );
            if outcome == SendOutcome::NotSent {
                traffic.not_sent += 1;
            }
        }
    }
}

impl Traffic {
    fn add(
        &mut self,
        now: Instant,
        to: &LayerName,
        class: Priority,
        wire_bytes: u64,
        control: bool,
    ) {
        let control_bytes = if control { wire_bytes } else { 0 };
        self.wire_bytes += wire_bytes;
        self.control_bytes += control_bytes;
        if !self.by_layer.contains_key(to) {
            if self.by_layer.len() >= MAX_LAYERS {
                return;
            }
            self.by_layer.insert(to.clone(), LayerTraffic::new(now));
        }
        if let Some(layer) = self.by_layer.get_mut(to) {
            layer.wire_bytes[class as usize] += wire_bytes;
            layer.control_bytes += control_bytes;
            layer.rate.add(now, wire_bytes);
        }
    }
}

impl LayerTraffic {
    fn new(now: Instant) -> Self {
        Self { wire_bytes: [0; 3], control_bytes: 0, rate: RateMeter::new(now) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layers_beyond_the_bound_count_together_with_all() {
        let now = Instant::now();
        let mut traffic = Traffic::default();
        for layer in 0..MAX_LAYERS + 10 {
            let to: LayerName = format!("layer-{layer}").parse().unwrap();
            traffic.add(now, &to, Priority::State, 100, false);
            traffic.add(now, &to, Priority::Control, 10, true);
        }
        assert_eq!(traffic.by_layer.len(), MAX_LAYERS);
        let all = (MAX_LAYERS + 10) as u64;
        assert_eq!((traffic.wire_bytes, traffic.control_bytes), (all * 110, all * 10));
        let first: LayerName = "layer-0".parse().unwrap();
        let first = &traffic.by_layer[&first];
        assert_eq!((first.wire_bytes, first.control_bytes), ([10, 100, 0], 10));
    }
}
