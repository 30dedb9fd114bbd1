//! The quality of one direction of a link.

use std::time::Duration;

use serde::{Deserialize, Serialize};

/// The quality of one direction of a link. The default is a wire: no delay, no loss, no limit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shape {
    /// One way.
    pub delay: Duration,
    /// The delay wanders by as much to both sides; never below zero.
    pub jitter: Duration,
    /// Probability that a packet is lost, 0 to 1.
    pub loss: f64,
    /// Bit/s of IP packets, 1 k = 1000; `None` = as fast as the machine.
    pub rate: Option<u64>,
    /// Bytes that may wait for the rate; what comes beyond them is dropped.
    pub queue: u64,
    /// Larger packets are dropped without a word, as a router behind a firewall does. Bytes, IP
    /// header included.
    pub mtu: u32,
}

impl Default for Shape {
    fn default() -> Self {
        Self {
            delay: Duration::ZERO,
            jitter: Duration::ZERO,
            loss: 0.0,
            rate: None,
            queue: 1_000_000,
            mtu: 1500,
        }
    }
}

impl Shape {
    /// A link to a cloud: 25 ± 5 ms, 0.01 % loss, 160 Mbit/s with a queue of 250 kB.
    #[must_use]
    pub fn to_cloud() -> Self {
        Self {
            delay: Duration::from_millis(25),
            jitter: Duration::from_millis(5),
            loss: 0.000_1,
            rate: Some(160_000_000),
            queue: 250_000,
            ..Self::default()
        }
    }

    /// All of it as changes, so that it can be told in words.
    #[must_use]
    pub fn changes(&self) -> Vec<Change> {
        vec![
            Change::Delay(self.delay),
            Change::Jitter(self.jitter),
            Change::Loss(self.loss),
            Change::Rate(self.rate),
            Change::Queue(self.queue),
            Change::Mtu(self.mtu),
        ]
    }

    /// The same with one thing changed.
    #[must_use]
    pub fn with(mut self, change: Change) -> Self {
        match change {
            Change::Delay(delay) => self.delay = delay,
            Change::Jitter(jitter) => self.jitter = jitter,
            Change::Loss(loss) => self.loss = loss,
            Change::Rate(rate) => self.rate = rate,
            Change::Queue(queue) => self.queue = queue,
            Change::Mtu(mtu) => self.mtu = mtu,
        }
        self
    }
}

/// One thing about a direction that changes while it runs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Change {
    /// [`Shape::delay`]
    Delay(Duration),
    /// [`Shape::jitter`]
    Jitter(Duration),
    /// [`Shape::loss`]
    Loss(f64),
    /// [`Shape::rate`]
    Rate(Option<u64>),
    /// [`Shape::queue`]
    Queue(u64),
    /// [`Shape::mtu`]
    Mtu(u32),
}
