//! Plain UDP between hosts of a network, and what goes into a link.

use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::{Host, Link, inside};
use crate::process::hurry;

/// How long a reader waits before it looks whether it shall end.
const READ: Duration = Duration::from_millis(50);
/// For the whole flight of a window of packets.
const BUFFER: usize = 4 << 20;

/// A socket on a host, on any free port.
///
/// # Errors
/// When the system gives none.
pub fn socket(host: &Host) -> anyhow::Result<UdpSocket> {
    inside(&host.namespace, || {
        let socket = socket2::Socket::new(socket2::Domain::IPV4, socket2::Type::DGRAM, None)?;
        // What the system does not give is missing in a burst only.
        let _ = socket.set_recv_buffer_size(BUFFER);
        socket.bind(&SocketAddr::from((host.address, 0)).into())?;
        let socket = UdpSocket::from(socket);
        socket.set_read_timeout(Some(READ))?;
        Ok(socket)
    })
}

/// Takes packets on a host until it is dropped.
pub struct Sink {
    /// Where it listens.
    pub address: SocketAddr,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Sink {
    /// Sends each packet back, if wanted.
    ///
    /// # Errors
    /// As [`socket`].
    pub fn start(host: &Host, echo: bool) -> anyhow::Result<Self> {
        let socket = socket(host)?;
        let address = socket.local_addr()?;
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let thread = std::thread::spawn(move || {
            hurry();
            let mut buffer = [0; 2_000];
            while !stopped.load(Ordering::Relaxed) {
                if let Ok((length, from)) = socket.recv_from(&mut buffer)
                    && echo
                {
                    let _ = socket.send_to(&buffer[..length], from);
                }
            }
        });
        Ok(Self { address, stop, thread: Some(thread) })
    }

    /// Sends packets of so many payload bytes from a socket, at a pace.
    ///
    /// # Errors
    /// When the system refuses a packet.
    pub fn send(
        &self,
        from: &UdpSocket,
        count: u64,
        bytes: usize,
        gap: Duration,
    ) -> anyhow::Result<()> {
        hurry();
        let (begin, payload) = (Instant::now(), vec![0; bytes]);
        for number in 0..count {
            let due = begin + gap.mul_f64(number as f64);
            // Shorter waits than the system keeps are made up for by several packets at once.
            let left = due.saturating_duration_since(Instant::now());
            if left > Duration::from_micros(500) {
                std::thread::sleep(left);
            }
            from.send_to(&payload, self.address)?;
        }
        Ok(())
    }
}

impl Drop for Sink {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Sorted round trips of small packets to a host that echoes, one after another; those that do not
/// come back are left out.
///
/// # Errors
/// As [`Sink::send`].
pub fn ping(from: &UdpSocket, to: &Sink, count: usize) -> anyhow::Result<Vec<Duration>> {
    let mut trips = Vec::new();
    hurry();
    from.set_read_timeout(Some(Duration::from_millis(500)))?;
    for _ in 0..count {
        let mut buffer = [0; 100];
        let begin = Instant::now();
        from.send_to(&[0; 64], to.address)?;
        if from.recv(&mut buffer).is_ok() {
            trips.push(begin.elapsed());
        }
    }
    trips.sort_unstable();
    Ok(trips)
}

/// What has gone into a link in one direction, at some moment between two.
#[derive(Debug, Clone, Copy)]
pub struct Reading {
    from: Instant,
    to: Instant,
    bytes: u64,
}

impl Reading {
    /// Of what goes forward.
    ///
    /// # Errors
    /// When the emulator does not answer.
    pub fn of(link: &Link<'_>) -> anyhow::Result<Self> {
        let from = Instant::now();
        let bytes = link.stats()?.forward.taken.bytes;
        Ok(Self { from, to: Instant::now(), bytes })
    }

    /// Bytes per second up to a later one.
    #[must_use]
    pub fn rate_to(&self, later: &Self) -> f64 {
        (later.bytes - self.bytes) as f64 / (later.from - self.from).as_secs_f64().max(1e-3)
    }

    /// The same, at least: no more time can have passed.
    fn least_rate_to(&self, later: &Self) -> f64 {
        (later.bytes - self.bytes) as f64 / (later.to - self.from).as_secs_f64().max(1e-3)
    }
}

/// Bytes per second of the busiest second, at least. How long it takes to ask is no excuse and no
/// fault.
#[must_use]
pub fn busiest(readings: &[Reading]) -> f64 {
    let seconds = readings.iter().enumerate().filter_map(|(index, first)| {
        let last =
            readings[index..].iter().find(|last| last.to - first.from >= Duration::from_secs(1))?;
        Some(first.least_rate_to(last))
    });
    seconds.fold(0.0, f64::max)
}
