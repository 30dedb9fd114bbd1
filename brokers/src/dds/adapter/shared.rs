//! What the threads of one broker share.

use std::collections::HashMap;
use std::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::Thread;
use std::time::{Duration, Instant};

use parking_lot::{Mutex, RwLock};

use super::channel::Channels;
use super::presence::{Clock, Clocks};
use super::send::{Sender, Target};
use super::slot::Slots;
use super::{DdsCounts, Dialect};
use crate::dds::EndpointId;
use crate::dds::writer::participant_of;
use crate::outbox::{Outbox, OutboxLimits};
use crate::port::{BrokerError, Health, StatusCell};

/// Most bytes that wait for the network, of one publisher and of all together.
pub const MAX_QUEUE_BYTES: usize = 64 * 1024 * 1024;

/// A participant that died is built anew in less.
const REBUILD: Duration = Duration::from_secs(5);

const LIMITS: OutboxLimits = OutboxLimits {
    lane_messages: 16_384,
    lane_bytes: MAX_QUEUE_BYTES,
    total_bytes: MAX_QUEUE_BYTES,
};

/// What a writer offers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct WriterFacts {
    pub(super) reliable: bool,
    pub(super) durable: bool,
    /// Of this participant.
    pub(super) own: bool,
    /// Its participant sends signs of life.
    pub(super) signs: bool,
    /// When it was found last.
    pub(super) found: Instant,
}

pub(crate) struct Shared {
    pub(super) dialect: Arc<dyn Dialect>,
    pub(super) domain: u16,
    pub(super) address: Ipv4Addr,
    pub(super) status: StatusCell,
    was_up: AtomicBool,
    pub(super) outbox: Arc<Outbox<Target>>,
    pub(super) sender: Mutex<Sender>,
    /// Messages that the sender holds, because their writer cannot take them now.
    pub(super) held: AtomicUsize,
    pub(super) slots: Slots,
    pub(super) channels: Channels,
    /// What the writers that are known offer, our own included.
    pub(super) writers: RwLock<HashMap<EndpointId, WriterFacts>>,
    /// By topic: the kinds of writers that other participants have.
    pub(super) offered: RwLock<HashMap<String, [bool; 3]>>,
    pub(super) clocks: RwLock<Clocks>,
    pub(super) counts: Mutex<DdsCounts>,
    pub(super) closing: AtomicBool,
    pub(super) stop: AtomicBool,
    pub(super) lifecycle: OnceLock<Thread>,
    #[cfg(feature = "fault-injection")]
    pub(super) fault: Mutex<Option<crate::dds::Fault>>,
}

impl Shared {
    pub(super) fn new(dialect: Arc<dyn Dialect>, domain: u16, address: Ipv4Addr) -> Arc<Self> {
        Arc::new(Self {
            dialect,
            domain,
            address,
            status: StatusCell::new(Health::Connecting, String::new()),
            was_up: AtomicBool::new(false),
            outbox: Outbox::new(LIMITS),
            sender: Mutex::new(Sender::new()),
            held: AtomicUsize::new(0),
            slots: Slots::default(),
            channels: Channels::default(),
            writers: RwLock::default(),
            offered: RwLock::default(),
            clocks: RwLock::default(),
            counts: Mutex::default(),
            closing: AtomicBool::new(false),
            stop: AtomicBool::new(false),
            lifecycle: OnceLock::new(),
            #[cfg(feature = "fault-injection")]
            fault: Mutex::default(),
        })
    }

    /// What a writer offers, if it is known.
    pub(super) fn facts_of(&self, writer: &EndpointId) -> Option<WriterFacts> {
        self.writers.read().get(writer).copied()
    }

    /// What is known of a writer's clock.
    pub(super) fn clock_of(&self, writer: EndpointId, facts: Option<WriterFacts>) -> Clock {
        if facts.is_some_and(|facts| facts.own) {
            return Clock::Behind(0);
        }
        match self.clocks.read().behind_ns(participant_of(&writer)) {
            Some(behind_ns) => Clock::Behind(behind_ns),
            None if facts.is_some_and(|facts| facts.signs) => Clock::Awaited,
            None => Clock::Unknown,
        }
    }

    pub(super) fn wake_lifecycle(&self) {
        if let Some(thread) = self.lifecycle.get() {
            thread.unpark();
        }
    }

    pub(super) fn set_status(&self, health: Health, detail: &str) {
        if self.status.set(health, detail) == Some(true) && health == Health::Up {
            self.was_up.store(true, Ordering::Relaxed);
        }
    }

    pub(super) fn is_up(&self) -> bool {
        self.status.borrow().health == Health::Up
    }

    /// Why nothing can be written or read now.
    pub(super) fn away(&self) -> BrokerError {
        let status = self.status.borrow();
        match status.health {
            Health::Closed => BrokerError::Closed,
            Health::Connecting | Health::Up | Health::Down | Health::InUse => {
                BrokerError::Away(status.detail.clone())
            }
        }
    }

    /// Whether what is published is dropped at once. While it starts for the first time or is built
    /// anew, messages wait.
    pub(super) fn is_down(&self) -> bool {
        let status = self.status.borrow();
        match status.health {
            Health::Closed => true,
            Health::Down => {
                !self.was_up.load(Ordering::Relaxed) || status.since.elapsed() > REBUILD
            }
            Health::Connecting | Health::Up | Health::InUse => false,
        }
    }

    /// Whether nothing waits to be written.
    pub(super) fn is_drained(&self) -> bool {
        self.outbox.is_empty() && self.held.load(Ordering::Acquire) == 0
    }

    /// Ends what can be ended without waiting; the threads follow.
    pub(super) fn end(&self) {
        self.outbox.close();
        self.set_status(Health::Closed, "closed");
        self.channels.close();
        self.stop.store(true, Ordering::Release);
        self.wake_lifecycle();
    }
}
