//! Discovery over unicast.
//!
//! RustDDS knows no initial peers. It does announce itself (SPDP) to the twelve participant slots
//! of its own host, so the relay sits in one of them and repeats the announcement to the hosts that
//! it knows, and to higher slots of its own. Between flows it also holds the two multicast ports of
//! the domain, because RustDDS sends user data to a peer's multicast address as soon as the peer
//! has one, and multicast does not cross routers.

use std::collections::{BTreeSet, HashSet, VecDeque};
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, ToSocketAddrs, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use parking_lot::Mutex;

use super::announcement::Announcement;
use super::reader::StoppableThread;
use super::{DdsError, GuidPrefix, LOCAL_SLOTS, SLOTS, announcement_port, multicast_port};

/// Most addresses that are announced to.
const MAX_ADDRESSES: usize = 256;
/// Announcements of other local participants that are kept until it is known which one is ours.
const MAX_HEARD: usize = 16;
const RETRY: Duration = Duration::from_secs(1);
const RESOLVE: Duration = Duration::from_secs(10);
/// How soon a new address is announced to, at the latest.
const LISTEN: Duration = Duration::from_millis(50);

/// Where a relay works.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RelayConfig {
    /// DDS domain.
    pub domain: u16,
    /// The participant's address: announcements leave from it.
    pub address: Ipv4Addr,
    /// Addresses or names of other hosts. Those of this host are passed over.
    pub peers: Vec<String>,
    /// DDS participants that may live on one other host.
    pub slots: u16,
    /// Participants of the own host that RustDDS does not announce itself to, because their slots
    /// are too high, are announced to below this one.
    pub own_slots: u16,
    /// Whether the multicast ports of the domain are held, so that nothing goes by multicast.
    pub holds_multicast: bool,
    /// Time between two announcements to the same participant.
    pub repeat: Duration,
}

/// What a relay does, for people.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RelayStatus {
    /// Whether a slot was free, so that the relay works.
    pub listening: bool,
    /// Whether this process holds the multicast ports; another one of this host may.
    pub holds_multicast_ports: bool,
    /// Whether the participant announces multicast addresses all the same.
    pub announces_multicast: bool,
    /// Addresses that are known.
    pub addresses: usize,
    /// Names that do not resolve.
    pub unresolved: Vec<String>,
}

#[derive(Default)]
struct State {
    own: Option<GuidPrefix>,
    heard: VecDeque<(GuidPrefix, Vec<u8>)>,
    configured: BTreeSet<Ipv4Addr>,
    learnt: VecDeque<Ipv4Addr>,
    live: HashSet<Ipv4Addr>,
    told: HashSet<Ipv4Addr>,
    status: RelayStatus,
}

/// Repeats the announcement of one participant to other hosts until it is dropped.
pub struct Relay {
    state: Arc<Mutex<State>>,
    config: Arc<RelayConfig>,
    _threads: Vec<StoppableThread>,
}

impl Relay {
    /// Holds the ports and starts to listen. Do this before the participant starts, or its first
    /// announcement is missed and the next comes ten seconds later.
    ///
    /// # Errors
    /// [`DdsError`] when there is no thread for it. Ports that are taken are no error: they are
    /// tried again each second.
    pub fn start(config: RelayConfig) -> Result<Self, DdsError> {
        let state = Arc::<Mutex<State>>::default();
        let config = Arc::new(config);
        let mut ports = Ports::default();
        ports.take(&config, &state);
        let names: Vec<String> = note_addresses(&config, &state);
        let mut threads = Vec::new();
        let failed = Arc::<AtomicBool>::default();
        let (shared, settings) = (Arc::clone(&state), Arc::clone(&config));
        threads.push(StoppableThread::start("dds-relay", Arc::clone(&failed), move |stop| {
            run(&settings, &shared, ports, stop);
        })?);
        if !names.is_empty() {
            let (shared, settings) = (Arc::clone(&state), Arc::clone(&config));
            let resolver = StoppableThread::start("dds-resolve", failed, move |stop| {
                while !stop.load(Ordering::Relaxed) {
                    let all = resolve(&settings, &shared, &names);
                    thread::park_timeout(if all { RESOLVE } else { RETRY });
                }
            })?;
            threads.push(resolver.unwaited());
        }
        Ok(Self { state, config, _threads: threads })
    }

    /// Whose announcement it is to repeat from now on.
    pub fn set_participant(&self, own: GuidPrefix) {
        let mut state = self.state.lock();
        state.own = Some(own);
        state.told.clear();
    }

    /// Adds hosts; those of this host are passed over. The one that was named least recently gives
    /// way beyond 256.
    pub fn learn(&self, addresses: impl IntoIterator<Item = Ipv4Addr>) {
        let mut state = self.state.lock();
        for address in addresses {
            if !is_foreign(address, self.config.address) || state.configured.contains(&address) {
                continue;
            }
            if let Some(place) = state.learnt.iter().position(|known| *known == address) {
                state.learnt.remove(place);
            }
            state.learnt.push_back(address);
            while state.learnt.len() + state.configured.len() > MAX_ADDRESSES
                && state.learnt.len() > 1
            {
                state.learnt.pop_front();
            }
        }
    }

    /// Hosts where a flow answers: nothing is repeated to them.
    pub fn set_live(&self, addresses: impl IntoIterator<Item = Ipv4Addr>) {
        self.state.lock().live = addresses.into_iter().collect();
    }

    /// What it does.
    #[must_use]
    pub fn status(&self) -> RelayStatus {
        let state = self.state.lock();
        RelayStatus {
            addresses: state.configured.len() + state.learnt.len(),
            ..state.status.clone()
        }
    }
}

/// Whether announcements to an address can reach another host.
fn is_foreign(address: Ipv4Addr, own: Ipv4Addr) -> bool {
    address != own
        && !own.is_loopback()
        && !address.is_loopback()
        && !address.is_unspecified()
        && !address.is_multicast()
        && !address.is_broadcast()
}

/// Takes the configured addresses over; returns the names that must be resolved.
fn note_addresses(config: &RelayConfig, state: &Mutex<State>) -> Vec<String> {
    let mut names = Vec::new();
    let mut state = state.lock();
    for peer in &config.peers {
        match peer.parse::<IpAddr>() {
            Ok(IpAddr::V4(address)) if is_foreign(address, config.address) => {
                if state.configured.len() < MAX_ADDRESSES {
                    state.configured.insert(address);
                }
            }
            Ok(_) => {}
            Err(_) => names.push(peer.clone()),
        }
    }
    names
}

/// Adds the addresses of names; returns whether all have some.
fn resolve(config: &RelayConfig, state: &Mutex<State>, names: &[String]) -> bool {
    let mut unresolved = Vec::new();
    for name in names {
        match (name.as_str(), 0).to_socket_addrs() {
            Ok(found) => {
                let mut state = state.lock();
                for address in found {
                    if let SocketAddr::V4(address) = address
                        && is_foreign(*address.ip(), config.address)
                        && state.configured.len() < MAX_ADDRESSES
                    {
                        state.configured.insert(*address.ip());
                    }
                }
            }
            Err(_) => unresolved.push(name.clone()),
        }
    }
    let all = unresolved.is_empty();
    state.lock().status.unresolved = unresolved;
    all
}

/// The sockets of a relay, as far as the system gave them.
#[derive(Default)]
struct Ports {
    held: [Option<UdpSocket>; 2],
    slot: Option<UdpSocket>,
    sender: Option<UdpSocket>,
}

impl Ports {
    /// Tries to get what is missing.
    fn take(&mut self, config: &RelayConfig, state: &Mutex<State>) {
        for (socket, port) in self.held.iter_mut().zip(multicast_port(config.domain)..) {
            if socket.is_none() && config.holds_multicast {
                *socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port)).ok();
            }
        }
        if self.slot.is_none() {
            // From above, since participants take the lowest free slot. The lowest is left to a
            // participant.
            self.slot = (1..LOCAL_SLOTS).rev().find_map(|slot| listen(config.domain, slot).ok());
        }
        if self.sender.is_none() {
            self.sender = UdpSocket::bind((config.address, 0)).ok();
            if let Some(sender) = &self.sender {
                // A full buffer must not hold the relay up; what it drops is repeated.
                let _ = sender.set_nonblocking(true);
            }
        }
        let status = &mut state.lock().status;
        status.listening = self.slot.is_some() && self.sender.is_some();
        status.holds_multicast_ports = self.held.iter().all(Option::is_some);
    }

    fn complete(&self, config: &RelayConfig) -> bool {
        let holds = self.held.iter().all(Option::is_some) || !config.holds_multicast;
        holds && self.slot.is_some() && self.sender.is_some()
    }
}

fn listen(domain: u16, slot: u16) -> io::Result<UdpSocket> {
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, announcement_port(domain, slot)))?;
    socket.set_read_timeout(Some(LISTEN))?;
    Ok(socket)
}

fn run(config: &RelayConfig, state: &Mutex<State>, mut ports: Ports, stop: &AtomicBool) {
    let mut buffer = vec![0; 65_536];
    let mut next_repeat = Instant::now();
    let mut next_take = Instant::now() + RETRY;
    while !stop.load(Ordering::Relaxed) {
        match &ports.slot {
            Some(slot) => {
                if let Ok((length, _)) = slot.recv_from(&mut buffer) {
                    hear(state, &buffer[..length]);
                }
            }
            None => thread::park_timeout(LISTEN),
        }
        let now = Instant::now();
        if now >= next_take && !ports.complete(config) {
            ports.take(config, state);
            next_take = now + RETRY;
        }
        let repeat = now >= next_repeat;
        if repeat {
            next_repeat = now + config.repeat;
        }
        if let Some(sender) = &ports.sender {
            announce(config, state, sender, repeat);
        }
    }
}

/// Keeps an announcement.
fn hear(state: &Mutex<State>, datagram: &[u8]) {
    let Some(announcement) = Announcement::parse(datagram) else {
        return;
    };
    let mut state = state.lock();
    state.heard.retain(|(prefix, _)| *prefix != announcement.prefix);
    // Ours must not be driven out by a crowd of others.
    if state.heard.len() >= MAX_HEARD {
        let own = state.own;
        let victim = state.heard.iter().position(|(prefix, _)| Some(*prefix) != own);
        state.heard.remove(victim.unwrap_or(0));
    }
    state.heard.push_back((announcement.prefix, datagram.to_vec()));
    if state.own == Some(announcement.prefix) {
        state.status.announces_multicast = announcement.multicast;
    }
}

/// Sends the announcement to the hosts without a live flow: to all of them when `repeat`, else to
/// those that never got this one.
fn announce(config: &RelayConfig, state: &Mutex<State>, sender: &UdpSocket, repeat: bool) {
    static REFUSED: AtomicBool = AtomicBool::new(false);
    let (datagram, targets) = {
        let mut state = state.lock();
        let Some(own) = state.own else { return };
        let Some(datagram) =
            state.heard.iter().find(|(prefix, _)| *prefix == own).map(|(_, bytes)| bytes.clone())
        else {
            return;
        };
        let own_host = (config.own_slots > LOCAL_SLOTS).then_some(&config.address);
        let targets: Vec<Ipv4Addr> = state
            .configured
            .iter()
            .chain(&state.learnt)
            .chain(own_host)
            .filter(|address| !state.live.contains(*address))
            .filter(|address| repeat || !state.told.contains(*address))
            .copied()
            .collect();
        if targets.is_empty() {
            return;
        }
        state.told.extend(&targets);
        (datagram, targets)
    };
    for address in targets {
        let slots = if address == config.address {
            LOCAL_SLOTS..config.own_slots.min(SLOTS)
        } else {
            0..config.slots.min(SLOTS)
        };
        for slot in slots {
            let sent = sender.send_to(&datagram, (address, announcement_port(config.domain, slot)));
            if let Err(error) = sent
                && !REFUSED.swap(true, Ordering::Relaxed)
            {
                tracing::warn!(
                    %address,
                    %error,
                    "a DDS announcement could not be sent; announcements are repeated",
                );
            }
        }
    }
}

#[cfg(test)]
#[path = "relay_tests.rs"]
mod tests;
