//! The thread that lets datagrams out: the only one that sends on the inter scope.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use blaze_domain::{FlowId, Priority};
use parking_lot::Mutex;

use super::plane::Plane;
use crate::lane::measure::RateMeter;
use crate::limit::pacer::Pacer;
use crate::link::transport::Transport;

/// The pacer wakes at least that often, to notice a new limit or the end.
const IDLE: Duration = Duration::from_millis(100);
/// A debt from which on LinkControl is let out all the same; shorter ones delay it by no more than this.
const LONG_DEBT: Duration = Duration::from_millis(10);
/// A burst is at most this many datagrams.
const BURST_DATAGRAMS: usize = 2;

/// What the pacer shares with admin and metrics.
pub struct Egress {
    /// Budget in wire bytes per second, as the bits of an `f64`.
    budget: AtomicU64,
    stop: AtomicBool,
    traffic: Mutex<Traffic>,
}

/// Wire bytes that have left.
#[derive(Debug, Clone)]
pub struct Traffic {
    /// All of them, since the start.
    pub wire_bytes: u64,
    /// Of those, what carried no user message.
    pub control_bytes: u64,
    /// Per destination and class.
    pub by_destination: Vec<DestinationTraffic>,
    /// Datagrams that the transport did not take.
    pub not_sent: u64,
}

/// Wire bytes to one flow.
#[derive(Debug, Clone)]
pub struct DestinationTraffic {
    /// The destination.
    pub flow: FlowId,
    /// Since the start, per class in the order of [`Priority::ALL`].
    pub wire_bytes: [u64; 3],
    /// Of those, what carried no user message.
    pub control_bytes: u64,
    /// Bytes per second.
    pub rate: RateMeter,
}

/// Destinations that are counted one by one. At a time there are no more than [`MAX_PEERS`](crate::link::MAX_PEERS).
const MAX_DESTINATIONS: usize = 1024;

impl Egress {
    /// An egress with a budget in wire bytes per second.
    #[must_use]
    pub fn new(bytes_per_s: f64) -> Arc<Self> {
        Arc::new(Self {
            budget: AtomicU64::new(bytes_per_s.to_bits()),
            stop: AtomicBool::new(false),
            traffic: Mutex::new(Traffic {
                wire_bytes: 0,
                control_bytes: 0,
                by_destination: Vec::new(),
                not_sent: 0,
            }),
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
    pub fn run(&self, plane: &Plane, transport: &dyn Transport) {
        let start = Instant::now();
        let burst = BURST_DATAGRAMS * transport.wire_bytes(transport.max_datagram_bytes());
        let mut pacer = Pacer::new(self.budget(), burst, start);
        while !self.stop.load(Ordering::Relaxed) {
            let now = Instant::now();
            let budget = self.budget();
            if (budget - pacer.limit()).abs() > f64::EPSILON {
                pacer.set_limit(budget, now);
            }
            let wait = pacer.wait(now);
            // Data waits off a debt. LinkControl does not, where that is long: peers would think this flow dead.
            let transmit = if wait.is_zero() {
                plane.next_transmit(IDLE)
            } else {
                let control = if wait > LONG_DEBT { plane.next_control() } else { None };
                if control.is_none() {
                    std::thread::sleep(wait.min(IDLE));
                }
                control
            };
            let Some(transmit) = transmit else { continue };
            let wire_bytes = transport.wire_bytes(transmit.datagram.len());
            let outcome = transport.send(&transmit.to, transmit.class, transmit.datagram);
            let now = Instant::now();
            pacer.spend(wire_bytes, now);
            let mut traffic = self.traffic.lock();
            traffic.add(
                now,
                &transmit.to.flow,
                transmit.class,
                wire_bytes as u64,
                transmit.control,
            );
            if outcome == crate::link::transport::SendOutcome::NotSent {
                traffic.not_sent += 1;
            }
        }
    }
}

impl Traffic {
    fn add(&mut self, now: Instant, to: &FlowId, class: Priority, wire_bytes: u64, control: bool) {
        self.wire_bytes += wire_bytes;
        if control {
            self.control_bytes += wire_bytes;
        }
        let place = match self.by_destination.iter().position(|d| d.flow == *to) {
            Some(place) => place,
            None if self.by_destination.len() < MAX_DESTINATIONS => {
                let rate = RateMeter::new(now);
                self.by_destination.push(DestinationTraffic {
                    flow: to.clone(),
                    wire_bytes: [0; 3],
                    control_bytes: 0,
                    rate,
                });
                self.by_destination.len() - 1
            }
            None => return,
        };
        let destination = &mut self.by_destination[place];
        destination.wire_bytes[class as usize] += wire_bytes;
        if control {
            destination.control_bytes += wire_bytes;
        }
        destination.rate.add(now, wire_bytes);
    }
}
