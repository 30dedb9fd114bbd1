//! The thread that owns the participant: it makes writers and readers, watches over RustDDS and
//! over those who have gone, and builds everything anew when RustDDS dies.

use std::net::UdpSocket;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Receiver;
use std::thread;
use std::time::{Duration, Instant};

use super::make::Generation;
use super::presence::SILENT;
use super::shared::Shared;
use super::slot::Slot;
use crate::dds::reader::StoppableThread;
use crate::dds::{DdsError, lay_aside};
use crate::port::Health;

const TICK: Duration = Duration::from_millis(100);
const RETRY: Duration = Duration::from_secs(1);
const GOOD_BYE: Duration = Duration::from_secs(1);
/// How often it is looked whether the interface still has its address.
const INTERFACE: Duration = Duration::from_secs(1);
/// After standing still for so long this participant may have been forgotten.
const FORGOTTEN: Duration = Duration::from_secs(20);
/// How long writers and readers are made before the others have their turn.
const MAKING: Duration = Duration::from_millis(100);
/// A window that is full for a moment is the network's pace.
const PRESSURE: Duration = Duration::from_millis(50);

pub(super) fn start(shared: &Arc<Shared>) -> Result<StoppableThread, DdsError> {
    let shared = Arc::clone(shared);
    let failed = Arc::<AtomicBool>::default();
    StoppableThread::start("dds-layer", failed, move |stop| {
        let _ = shared.lifecycle.set(thread::current());
        Lifecycle::new(shared).run(stop);
    })
}

struct Lifecycle {
    shared: Arc<Shared>,
    generation: Option<Generation>,
    next_attempt: Instant,
    /// When the last participant was built.
    built: Instant,
    had_life: bool,
    next_look: Instant,
    /// When the last tick ended.
    last_tick: Instant,
}

impl Lifecycle {
    fn new(shared: Arc<Shared>) -> Self {
        let now = Instant::now();
        Self {
            shared,
            generation: None,
            next_attempt: now,
            built: now,
            had_life: false,
            next_look: now + INTERFACE,
            last_tick: now,
        }
    }

    fn run(mut self, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) && !self.shared.stop.load(Ordering::Acquire) {
            // A panic of RustDDS in this thread is one more way of its death.
            let is_behind = catch_unwind(AssertUnwindSafe(|| self.tick())).unwrap_or_else(|_| {
                self.bury("RustDDS panicked in a call");
                false
            });
            // What took long itself is no pause.
            self.last_tick = Instant::now();
            if !is_behind {
                thread::park_timeout(TICK);
            }
        }
        // Others are told of the end, unless RustDDS hangs.
        if let Some(done) = self.lay_aside() {
            let _ = done.recv_timeout(GOOD_BYE);
        }
    }

    /// Returns whether there is more to do at once.
    fn tick(&mut self) -> bool {
        let now = Instant::now();
        let paused = now.saturating_duration_since(self.last_tick);
        #[cfg(feature = "fault-injection")]
        if let Some(fault) = self.shared.fault.lock().take()
            && let Some(generation) = &self.generation
        {
            generation.participant.inject(fault).ok();
        }
        if let Some(reason) = self.illness(now) {
            self.bury(&reason);
        }
        if self.generation.is_none() && now >= self.next_attempt {
            self.give_birth(now);
        }
        let Some(generation) = &mut self.generation else { return false };
        if paused > SILENT / 2 {
            generation.presence.lock().excuse(now);
        }
        let age = now.saturating_duration_since(self.built);
        let given_up = generation.tick(&self.shared, now) && age > SILENT;
        let reason = if given_up {
            Some("others had given this participant up")
        } else if paused > FORGOTTEN {
            Some("this process stood still for long")
        } else if generation.has_missed_one() {
            Some("a participant came back after it was lost")
        } else {
            None
        };
        if let Some(reason) = reason {
            self.bury(reason);
            return false;
        }
        let is_behind = make_missing(&self.shared, generation, now + MAKING);
        let slots = self.shared.slots.live();
        generation.expel(&self.shared, now, &full(&slots, now));
        for writer in self.shared.slots.take_gone(now) {
            generation.forget_writer(&self.shared, writer.id());
        }
        for channel in self.shared.channels.take_unused() {
            generation.forget_channel(&self.shared, &channel);
        }
        let others = generation.presence.lock().count();
        let detail = format!(
            "DDS domain {} on {}, {others} other participants with readers",
            self.shared.domain, self.shared.address
        );
        self.shared.set_status(Health::Up, &detail);
        is_behind
    }

    /// Why the participant must be replaced, if so.
    fn illness(&mut self, now: Instant) -> Option<String> {
        let generation = self.generation.as_mut()?;
        if let Some(illness) = generation.illness() {
            return Some(illness.to_string());
        }
        if now >= self.next_look {
            self.next_look = now + INTERFACE;
            let address = self.shared.address;
            if let Err(error) = UdpSocket::bind((address, 0)) {
                return Some(format!("no interface has {address} any more: {error}"));
            }
        }
        None
    }

    fn bury(&mut self, reason: &str) {
        tracing::error!(
            domain = self.shared.domain,
            reason,
            "DDS participant ended, building a new one"
        );
        self.shared.set_status(Health::Down, reason);
        self.lay_aside();
        // One that dies at once is not built in a tight circle.
        self.next_attempt = self.built + RETRY;
    }

    /// Drops the participant and all that belongs to it.
    fn lay_aside(&mut self) -> Option<Receiver<()>> {
        let writers = self.shared.slots.take_all();
        let readers = self.shared.channels.take_readers();
        self.shared.writers.write().clear();
        self.shared.offered.write().clear();
        lay_aside((writers, readers, self.generation.take()), || {})
    }

    fn give_birth(&mut self, now: Instant) {
        match Generation::start(&self.shared, now) {
            Ok(generation) => {
                tracing::info!(
                    domain = self.shared.domain,
                    participant = ?generation.participant,
                    "DDS participant started",
                );
                if let Some(weakness) = generation.participant.filter_weakness() {
                    tracing::debug!(weakness, "hostile datagrams may reach RustDDS");
                }
                self.generation = Some(generation);
                self.built = now;
                if std::mem::replace(&mut self.had_life, true) {
                    self.shared.counts.lock().rebuilds += 1;
                }
            }
            Err(error) => {
                tracing::warn!(
                    domain = self.shared.domain,
                    %error,
                    "DDS participant cannot start, trying again",
                );
                self.shared.set_status(Health::Down, &error.to_string());
                self.next_attempt = now + RETRY;
            }
        }
    }
}

/// Topics whose window is full, and since when.
fn full(slots: &[Arc<Slot>], now: Instant) -> Vec<(&str, Instant)> {
    let since = |slot: &Arc<Slot>| {
        slot.full_since().filter(|since| now.saturating_duration_since(*since) >= PRESSURE)
    };
    let full = slots.iter().filter_map(|slot| Some((&*slot.key.topic.name, since(slot)?)));
    full.collect()
}

/// Makes the writers and readers that are wanted and missing, until its time is over. Returns
/// whether it made some and others may be left.
fn make_missing(shared: &Arc<Shared>, generation: &mut Generation, until: Instant) -> bool {
    let before = generation.changes();
    let mut refused = None;
    let mut is_over = false;
    for slot in shared.slots.live() {
        is_over = Instant::now() >= until;
        if is_over {
            break;
        }
        if slot.needs_writer() {
            refused = generation.fill(shared, &slot).err().or(refused);
        }
    }
    for channel in shared.channels.list() {
        is_over = is_over || Instant::now() >= until;
        if is_over {
            break;
        }
        let offered = shared.offered.read().get(&*channel.topic.name).copied().unwrap_or_default();
        refused = generation.open(shared, &channel, channel.wanted(offered)).err().or(refused);
    }
    // The next may be made all the same.
    if let Some(error) = refused {
        tracing::warn!(domain = shared.domain, %error, "RustDDS refuses");
    }
    is_over && generation.changes() != before
}
