//! Lets other implementations see that readers, writers and the participant are gone.
//!
//! RustDDS tells it by a key of 24 bytes. Fast DDS, the default of ROS 2, passes over keys of more
//! than 16 bytes that come without their hash, and it keeps what is gone for ever. So what RustDDS
//! sends to the discovery of others goes through here, and the hash is put in:
//!
//! ```text
//! others ── announcements ──► here ── with the address of here for metatraffic ──► RustDDS
//! RustDDS ── metatraffic ──► here ── with hashes ──► others
//! ```
//!
//! RustDDS gets the announcements of others from here alone: the packet filter cuts off those that
//! come by multicast, and the kernel steers those that come to RustDDS' own port here. All other
//! metatraffic of others, and all user data, go directly. At the end the good-bye of RustDDS is
//! repeated as Fast DDS takes it: for the reader of announcements, not for any reader.

mod message;
#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::io::{self, ErrorKind};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use socket2::{Domain, SockRef, Socket, Type};

use super::filter::{FilterError, keep_announcements, steer};
use super::reader::StoppableThread;
use super::{DdsError, GuidPrefix, create_error, farewell, multicast_port};
use message::{Gone, Outgoing, Spdp};

/// Where participants announce themselves.
const GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 0, 1);
/// Participants that are sent to. RustDDS reaches further ones by itself.
const MAX_PARTICIPANTS: usize = 1024;
/// Places of one participant that are sent to.
const MAX_ADDRESSES: usize = 4;
/// How long one is sent to at least that announces itself no more. Some do so less often than their
/// lease asks for.
const SILENCE: Duration = Duration::from_secs(120);
/// How soon the end is noticed, and silence looked for.
const LISTEN: u8 = 50;
/// RustDDS hangs that does not end so soon.
const HANG: Duration = Duration::from_millis(500);
/// Number of the good-bye.
const FAREWELL: u32 = u32::MAX;
/// Datagrams that are taken of one socket before the others have their turn.
const AT_ONCE: usize = 64;
/// For bursts: RustDDS sends all readers and writers at once.
const BUFFER: usize = 1 << 20;

/// The sockets, all of which do not wait.
pub(super) struct Sockets {
    /// Takes announcements by multicast.
    multicast: UdpSocket,
    /// Takes those that are sent to RustDDS' port.
    unicast: UdpSocket,
    /// Takes the metatraffic of RustDDS, and sends all.
    metatraffic: UdpSocket,
    here: SocketAddrV4,
    /// Where RustDDS takes announcements.
    rustdds: SocketAddrV4,
}

impl Sockets {
    /// Opens them beside RustDDS, which listens on a port.
    pub(super) fn open(domain: u16, address: Ipv4Addr, port: u16) -> Result<Self, FilterError> {
        let failed = |error| FilterError::System { what: "metatraffic", error };
        let multicast = listen(multicast_port(domain), address).map_err(failed)?;
        keep_announcements(&multicast)?;
        let metatraffic = UdpSocket::bind((address, 0)).map_err(failed)?;
        let _ = SockRef::from(&metatraffic).set_recv_buffer_size(BUFFER);
        let here = metatraffic.local_addr().map_err(failed)?.port();
        let sockets = Self {
            multicast: multicast.into(),
            unicast: steer(port)?,
            metatraffic,
            here: SocketAddrV4::new(address, here),
            rustdds: SocketAddrV4::new(address, port),
        };
        for socket in sockets.all() {
            socket.set_nonblocking(true).map_err(failed)?;
        }
        Ok(sockets)
    }

    fn all(&self) -> [&UdpSocket; 3] {
        [&self.multicast, &self.unicast, &self.metatraffic]
    }
}

/// Bound to the group, so that it is told from RustDDS' socket of that port.
fn listen(port: u16, address: Ipv4Addr) -> io::Result<Socket> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, None)?;
    socket.set_reuse_address(true)?;
    socket.set_reuse_port(true)?;
    socket.bind(&SocketAddrV4::new(GROUP, port).into())?;
    if let Err(error) = socket.join_multicast_v4(&GROUP, &address) {
        tracing::debug!(%address, %error, "no multicast");
    }
    Ok(socket)
}

/// Works until it is dropped, after which the good-bye of RustDDS has left. Drop it last.
pub(super) struct Metatraffic {
    dropped: Arc<AtomicU64>,
    ends: Arc<AtomicBool>,
    _thread: StoppableThread,
}

impl Metatraffic {
    /// `own`: the participant of RustDDS, whose sockets have their filters by now.
    pub(super) fn start(
        sockets: Sockets,
        own: GuidPrefix,
        failed: Arc<AtomicBool>,
    ) -> Result<Self, DdsError> {
        // It has that of RustDDS' port.
        keep_announcements(&SockRef::from(&sockets.unicast))
            .map_err(|error| create_error("filter")(io::Error::other(error)))?;
        let dropped = Arc::<AtomicU64>::default();
        let mut worker = Worker {
            sockets,
            own,
            participants: HashMap::new(),
            gone: Gone::default(),
            dropped: Arc::clone(&dropped),
            buffer: vec![0; 65_536],
        };
        let ends = Arc::<AtomicBool>::default();
        let ends_now = Arc::clone(&ends);
        let thread = StoppableThread::start("dds-metatraffic", failed, move |stop| {
            let mut ends_since = None;
            while !stop.load(Ordering::Relaxed) {
                worker.wait();
                let now = Instant::now();
                worker.turn(now);
                if ends_now.load(Ordering::Relaxed)
                    && now.duration_since(*ends_since.get_or_insert(now)) > HANG
                {
                    ends_now.store(false, Ordering::Relaxed);
                    worker.say_good_bye();
                }
            }
            worker.turn(Instant::now());
            worker.say_good_bye();
        })?;
        Ok(Self { dropped, ends, _thread: thread })
    }

    /// RustDDS is being ended, and may hang: the good-bye waits a moment for it.
    pub(super) fn note_end(&self) {
        self.ends.store(true, Ordering::Relaxed);
    }

    /// Datagrams that were malformed, or could not be sent on.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

/// A participant that is sent to.
struct Remote {
    addresses: Vec<SocketAddrV4>,
    until: Instant,
}

struct Worker {
    sockets: Sockets,
    own: GuidPrefix,
    participants: HashMap<GuidPrefix, Remote>,
    gone: Gone,
    dropped: Arc<AtomicU64>,
    buffer: Vec<u8>,
}

impl Worker {
    /// Waits for a datagram, or for a moment.
    fn wait(&self) {
        let mut sockets = self.sockets.all().map(|it| PollFd::new(it.as_fd(), PollFlags::POLLIN));
        if poll(&mut sockets, PollTimeout::from(LISTEN)).is_err() {
            thread::sleep(Duration::from_millis(LISTEN.into()));
        }
    }

    fn turn(&mut self, now: Instant) {
        let mut buffer = std::mem::take(&mut self.buffer);
        for at in 0..self.sockets.all().len() {
            for _ in 0..AT_ONCE {
                let (length, from) = match self.sockets.all()[at].recv_from(&mut buffer) {
                    Ok((length, SocketAddr::V4(from))) => (length, from),
                    Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                    // An error of what was sent shows here, too.
                    _ => continue,
                };
                let datagram = &buffer[..length];
                let done = match at {
                    2 if from == self.sockets.here => None,
                    2 => self.send(datagram),
                    _ => self.announce(datagram, *from.ip(), now),
                };
                if done.is_none() {
                    self.dropped.fetch_add(1, Ordering::Relaxed);
                }
            }
        }
        self.buffer = buffer;
        self.participants.retain(|_, remote| now < remote.until);
    }

    /// Repeats an announcement to RustDDS.
    fn announce(&mut self, datagram: &[u8], from: Ipv4Addr, now: Instant) -> Option<()> {
        let spdp = Spdp::parse(datagram)?;
        let is_kept = spdp.prefix != self.own && self.note(&spdp, from, now);
        // RustDDS learns from datagrams of a participant whether it is on this host. On loopback
        // all are; elsewhere what is sent from here must not tell.
        let sender = (!self.sockets.here.ip().is_loopback()).then_some(self.own);
        let repeated = spdp.repeated(sender, is_kept.then_some(self.sockets.here))?;
        self.send_to(&repeated, self.sockets.rustdds)
    }

    /// Keeps where a participant is; returns whether it can be sent to.
    fn note(&mut self, spdp: &Spdp<'_>, from: Ipv4Addr, now: Instant) -> bool {
        let Some(announced) = &spdp.announced else {
            self.participants.remove(&spdp.prefix);
            return false;
        };
        let mut addresses = announced.reached_at(from);
        addresses.retain(|it| *it != self.sockets.here);
        addresses.truncate(MAX_ADDRESSES);
        let has_room = self.participants.len() < MAX_PARTICIPANTS
            || self.participants.contains_key(&spdp.prefix);
        let is_kept = has_room && !addresses.is_empty();
        if is_kept {
            let until = now + announced.lease.max(SILENCE);
            self.participants.insert(spdp.prefix, Remote { addresses, until });
        }
        is_kept
    }

    /// RustDDS has not counted as far, so it is new.
    fn say_good_bye(&mut self) {
        self.send(&farewell::datagram(self.own, FAREWELL));
    }

    /// Sends on what RustDDS sends.
    fn send(&mut self, datagram: &[u8]) -> Option<()> {
        let outgoing = Outgoing::amend(datagram, self.own, &mut self.gone)?;
        let is_meant = |it: &GuidPrefix| outgoing.to.is_empty() || outgoing.to.contains(it);
        let meant = self.participants.iter().filter(|(prefix, _)| is_meant(prefix));
        let sent = meant
            .flat_map(|(_, remote)| &remote.addresses)
            .map(|to| self.send_to(&outgoing.datagram, *to));
        sent.fold(Some(()), Option::and)
    }

    fn send_to(&self, datagram: &[u8], to: SocketAddrV4) -> Option<()> {
        self.sockets.metatraffic.send_to(datagram, to).ok().map(|_| ())
    }
}
