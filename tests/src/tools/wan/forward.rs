//! The threads of one direction.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use anyhow::Context as _;
use blaze_tests::wan::{Change, Direction, DirectionStats, Shape};
use parking_lot::{Condvar, Mutex};

use super::device::Tun;

/// The largest IP packet.
const MAX_PACKET: usize = 65_535;
/// Packets that are written between two looks at the clock and the other thread's work.
const BATCH: usize = 32;

type Packet = Box<[u8]>;

/// One direction between two devices.
pub(crate) struct Line {
    from: Arc<Tun>,
    to: Arc<Tun>,
    direction: Mutex<Direction<Packet>>,
    /// Something is due earlier than it was.
    changed: Condvar,
    refused: AtomicU64,
}

impl Line {
    pub(crate) fn new(from: Arc<Tun>, to: Arc<Tun>, shape: Shape, seed: u64) -> Self {
        Self {
            from,
            to,
            direction: Mutex::new(Direction::new(shape, seed)),
            changed: Condvar::new(),
            refused: AtomicU64::new(0),
        }
    }

    /// Takes packets in until the device goes.
    pub(crate) fn read(&self) -> anyhow::Result<()> {
        let mut buffer = vec![0; MAX_PACKET];
        loop {
            let length = match self.from.recv(&mut buffer) {
                Ok(length) => length,
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => continue,
                Err(error) => return Err(error).context("reading a TUN device"),
            };
            let packet = Packet::from(&buffer[..length]);
            self.update(|direction| direction.offer(Instant::now(), length as u64, packet));
        }
    }

    /// Gives packets out when they are due.
    pub(crate) fn write(&self) {
        let mut batch = Vec::with_capacity(BATCH);
        loop {
            self.wait_for(&mut batch);
            for packet in batch.drain(..) {
                // A namespace that is going, or an interface that somebody set down: the packet is
                // lost there.
                if self.to.send(&packet).is_err() {
                    self.refused.fetch_add(1, Ordering::Relaxed);
                }
            }
        }
    }

    fn wait_for(&self, batch: &mut Vec<Packet>) {
        let mut direction = self.direction.lock();
        loop {
            let now = Instant::now();
            while batch.len() < BATCH
                && let Some(packet) = direction.pop(now)
            {
                batch.push(packet);
            }
            if !batch.is_empty() {
                return;
            }
            match direction.next_due() {
                Some(due) => {
                    self.changed.wait_until(&mut direction, due);
                }
                None => self.changed.wait(&mut direction),
            }
        }
    }

    pub(crate) fn change(&self, changes: &[Change]) {
        self.update(|direction| direction.change(Instant::now(), changes));
    }

    pub(crate) fn cut(&self) {
        self.direction.lock().cut();
    }

    pub(crate) fn heal(&self) {
        self.direction.lock().heal();
    }

    pub(crate) fn stats(&self) -> anyhow::Result<DirectionStats> {
        let missed = self.from.missed()?;
        let counted = self.direction.lock().stats();
        Ok(DirectionStats { refused: self.refused.load(Ordering::Relaxed), missed, ..counted })
    }

    fn update(&self, act: impl FnOnce(&mut Direction<Packet>)) {
        let mut direction = self.direction.lock();
        let before = direction.next_due();
        act(&mut direction);
        let after = direction.next_due();
        drop(direction);
        let earlier = match (before, after) {
            (Some(before), Some(after)) => after < before,
            (None, after) => after.is_some(),
            (Some(_), None) => false,
        };
        if earlier {
            self.changed.notify_one();
        }
    }
}
