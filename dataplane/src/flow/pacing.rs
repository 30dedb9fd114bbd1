//! Lets datagrams out on the inter scope, within the budget.
//!
//! Whoever brings a message sends it, too, where nothing waits and the budget allows it. What has to
//! wait is sent by the pacer, a thread. Only who holds the pacer's lock sends, so that datagrams
//! leave in the order in which they were made.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use blaze_domain::{LayerName, Priority};
use parking_lot::Mutex;

use super::inter::InterScope;
use super::plane::{Next, Plane};
use crate::lane::measure::RateMeter;
use crate::limit::pacer::{BURST_DATAGRAMS, Pacer};
use crate::limit::wire_factor::MAX_LAYERS;
use crate::link::Transmit;
use crate::link::dds::Wire;
use crate::link::transport::SendOutcome;

/// Datagrams that leave in one turn, so that nobody sends for others for long.
const TURN: usize = 32;
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
    sender: Mutex<Sender>,
}

/// Who holds it sends.
struct Sender {
    pacer: Pacer,
    /// When the pacer's thread comes back by itself.
    comes_back: Instant,
}

/// When there is something to do again.
enum Pause {
    /// When a debt is paid, or a little later.
    Debt(Instant),
    /// Then, or when something else is to be sent.
    Idle(Instant),
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
    /// An egress with a budget in wire bytes per second, for datagrams of this size.
    #[must_use]
    pub(super) fn new(bytes_per_s: f64, wire: Option<Wire>) -> Arc<Self> {
        let now = Instant::now();
        let largest = wire.map_or(0, |wire| wire.bytes(wire.max_datagram_bytes()));
        let pacer = Pacer::new(bytes_per_s, BURST_DATAGRAMS * largest, now);
        Arc::new(Self {
            budget: AtomicU64::new(bytes_per_s.to_bits()),
            stop: AtomicBool::new(false),
            traffic: Mutex::default(),
            sender: Mutex::new(Sender { pacer, comes_back: now }),
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
        plane.pace_by_this_thread();
        while !self.stop.load(Ordering::Relaxed) {
            let pause = {
                let mut sender = self.sender.lock();
                let pause = self.turn(&mut sender.pacer, plane, inter);
                sender.comes_back = pause.until();
                pause
            };
            let time = pause.until().saturating_duration_since(Instant::now());
            match pause {
                // What comes meanwhile has to wait all the same.
                Pause::Debt(_) => thread::sleep(time),
                Pause::Idle(_) => thread::park_timeout(time),
            }
        }
    }

    /// Sends what may leave now, if nobody else does. Returns whether the pacer must come back
    /// earlier than it would.
    pub(super) fn send_at_once(&self, plane: &Plane, inter: &InterScope) -> bool {
        self.sender.try_lock().is_none_or(|mut sender| {
            let pause = self.turn(&mut sender.pacer, plane, inter);
            pause.until() < sender.comes_back
        })
    }

    /// Sends what may leave now, at most [`TURN`] datagrams.
    fn turn(&self, pacer: &mut Pacer, plane: &Plane, inter: &InterScope) -> Pause {
        for _ in 0..TURN {
            let now = Instant::now();
            let budget = self.budget();
            if (budget - pacer.limit()).abs() > f64::EPSILON {
                pacer.set_limit(budget, now);
            }
            let debt = pacer.wait(now);
            // Data waits off a debt. LinkControl does not, where that is long: peers would think
            // this flow dead.
            let next = if debt.is_zero() {
                plane.next_transmit()
            } else if debt > LONG_DEBT {
                plane.next_control()
            } else {
                return Pause::Debt(now + debt);
            };
            match next {
                Next::Datagram(transmit) => self.send(pacer, &transmit, inter),
                Next::Nothing { .. } if !debt.is_zero() => {
                    return Pause::Debt(now + debt.min(IDLE));
                }
                Next::Nothing { due, is_held_back } => {
                    if !is_held_back {
                        pacer.rest(now);
                    }
                    return Pause::Idle(due.into_iter().fold(now + IDLE, Instant::min));
                }
            }
        }
        Pause::Idle(Instant::now())
    }

    fn send(&self, pacer: &mut Pacer, transmit: &Transmit, inter: &InterScope) {
        let wire_bytes = inter.wire().bytes(transmit.datagram.len());
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

impl Pause {
    fn until(&self) -> Instant {
        let (Self::Debt(until) | Self::Idle(until)) = *self;
        until
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
