//! Datagrams from flow to flow over DDS.
//!
//! ```text
//! send ──► writer of (endpoint, class) ──► RustDDS ──► UDP ──► RustDDS ──► reader thread ──► sink(Received)
//! connect / disconnect ──► wanted writers ──► lifecycle thread makes and drops them
//! ```
//!
//! A flow reads three topics of its own, `blaze/link/<layer>/<node>/<epoch>/<class>`. Others find
//! them by discovery and write to them, best effort: the link repairs itself, and a lost packet
//! must hold back nobody. One thread (`lifecycle`) owns the participant, makes all writers, tells
//! the relay which hosts answer, and builds everything anew with a new epoch when RustDDS dies.

mod lifecycle;
mod wire;

use std::collections::{BTreeMap, HashMap};
use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use blaze_brokers::dds::{DdsError, GuidPrefix, Profile, Relay, RelayConfig, Writer};
use blaze_domain::node_file::Chunking;
use blaze_domain::{FlowId, Priority};
use parking_lot::{Mutex, RwLock};

use super::namesakes::{Life, NameConflict, conflicts};
use super::transport::{Endpoint, SendOutcome, TransportEvent};
pub(crate) use wire::Wire;

/// Most endpoints that are written to at a time.
const MAX_ENDPOINTS: usize = 1024;
const _: () = assert!(MAX_ENDPOINTS >= 2 * super::MAX_PEERS, "each peer, and its life before");
/// Most participants whose last datagram is remembered.
const MAX_HEARD: usize = 1024;
/// First part of all link topics.
const TOPIC_PREFIX: &str = "blaze/link/";
const CLASSES: usize = Priority::ALL.len();

/// Called with everything that happens. It runs in the threads of the transport and must not wait
/// for long.
pub type EventSink = Arc<dyn Fn(TransportEvent) + Send + Sync>;

/// What a [`DdsTransport`] needs to know.
#[derive(Clone)]
pub struct DdsConfig {
    /// DDS domain, of which the inter scope is the only user.
    pub domain: u16,
    /// Address of the one interface to be used; 127.0.0.1 for flows of one host.
    pub listen: IpAddr,
    /// Other hosts, as address or name; one seed on one side is enough.
    pub peers: Vec<String>,
    /// DDS participants that may live on one peer, 1 to 12.
    pub peer_slots: u16,
    /// Bytes of the largest IP packet on the way to any peer.
    pub mtu: usize,
    /// Size of datagrams.
    pub chunking: Chunking,
    /// This flow and its epoch.
    pub local: Endpoint,
    /// Gives the epoch of the next life, after a rebuild.
    pub next_epoch: Arc<dyn Fn() -> u64 + Send + Sync>,
    /// Where events go.
    pub sink: EventSink,
}

/// What a transport says of itself.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct DdsStatus {
    /// Whether a participant runs.
    pub ready: bool,
    /// Whether a standstill of RustDDS would be noticed; so within a second after the start.
    pub watched: bool,
    /// For people: what is wrong or unusual; empty when nothing is.
    pub detail: String,
    /// How often RustDDS died and was built anew.
    pub rebuilds: u64,
    /// Dead participants whose threads have not ended: they hang, and may hold or take memory until
    /// the process ends.
    pub remains: usize,
    /// Datagrams that were not handed to the network: no writer, no reader there yet, or too large.
    pub not_sent: u64,
    /// Datagrams of readers that were not a sequence of octets.
    pub malformed: u64,
    /// Datagrams that the kernel dropped at the receive sockets: hostile ones, and those for which
    /// no room was left. Counted once a second.
    pub dropped_by_kernel: u64,
    /// Endpoints of other flows that can be written to.
    pub endpoints: usize,
    /// Hosts to which announcements go or went.
    pub addresses: usize,
}

type Writers = [Option<Arc<Writer>>; CLASSES];

/// What all threads of one transport share.
struct Shared {
    config: DdsConfig,
    address: Ipv4Addr,
    wire: Wire,
    relay: Relay,
    /// Writers that are wanted; the lifecycle thread makes them.
    wanted: Mutex<BTreeMap<Endpoint, [bool; CLASSES]>>,
    writers: RwLock<HashMap<Endpoint, Writers>>,
    /// Writers that were taken out and wait to be dropped, which can take 20 ms each.
    discarded: Mutex<Vec<Arc<Writer>>>,
    /// When each participant was last heard on a link topic.
    heard: Mutex<HashMap<GuidPrefix, Instant>>,
    /// Programs whose flow's name another one has, too, or this one.
    namesakes: Mutex<Vec<Life>>,
    /// This program, and since when it is there.
    own: Mutex<Life>,
    /// Where each participant lives.
    homes: Mutex<HashMap<GuidPrefix, Vec<Ipv4Addr>>>,
    status: Mutex<DdsStatus>,
    not_sent: AtomicU64,
    remains: AtomicUsize,
    stop: AtomicBool,
    #[cfg(test)]
    fault: Mutex<Option<blaze_brokers::dds::Fault>>,
}

/// The DDS transport of one flow. Dropping it says good-bye to the others.
pub struct DdsTransport {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

/// Time between two announcements to a host without a live flow.
const ANNOUNCE: Duration = Duration::from_millis(500);

impl DdsTransport {
    /// Starts it. A missing interface or taken ports are no error: it tries again each second, and
    /// [`DdsTransport::status`] says so.
    ///
    /// # Errors
    /// [`DdsError`] when the configuration can never work, or there is no thread.
    pub fn start(config: DdsConfig) -> Result<Self, DdsError> {
        let address = blaze_brokers::dds::check(config.domain, config.listen)?;
        let relay = Relay::start(RelayConfig {
            domain: config.domain,
            address,
            peers: config.peers.clone(),
            slots: config.peer_slots,
            own_slots: 0,
            holds_multicast: true,
            repeat: ANNOUNCE,
        })?;
        let shared = Arc::new(Shared {
            wire: Wire::new(config.mtu, config.chunking, address.is_loopback()),
            address,
            relay,
            wanted: Mutex::default(),
            writers: RwLock::default(),
            discarded: Mutex::default(),
            heard: Mutex::default(),
            namesakes: Mutex::default(),
            own: Mutex::new(Life {
                endpoint: config.local.clone(),
                addresses: vec![address],
                since: Instant::now(),
            }),
            homes: Mutex::default(),
            status: Mutex::default(),
            not_sent: AtomicU64::new(0),
            remains: AtomicUsize::new(0),
            stop: AtomicBool::new(false),
            #[cfg(test)]
            fault: Mutex::default(),
            config,
        });
        let thread = lifecycle::start(Arc::clone(&shared))?;
        Ok(Self { shared, thread: Some(thread) })
    }

    /// What it says of itself.
    #[must_use]
    pub fn status(&self) -> DdsStatus {
        let relay = self.shared.relay.status();
        let mut status = self.shared.status.lock().clone();
        status.not_sent = self.shared.not_sent.load(Ordering::Relaxed);
        status.remains = self.shared.remains.load(Ordering::Relaxed);
        status.addresses = relay.addresses;
        let mut details = Vec::new();
        if !status.detail.is_empty() {
            details.push(std::mem::take(&mut status.detail));
        }
        if relay.announces_multicast {
            details.push(
                "multicast addresses are announced, since another program holds the ports of \
                    the domain"
                    .into(),
            );
        }
        if !relay.listening {
            details.push("no free participant slot: other hosts are not told of this flow".into());
        }
        if !relay.unresolved.is_empty() {
            details.push(format!("peers without an address: {}", relay.unresolved.join(", ")));
        }
        if status.remains > 0 {
            details.push(format!(
                "{} dead DDS participants hang: restart this process if they stay",
                status.remains
            ));
        }
        status.detail = details.join("; ");
        status
    }

    /// Names of flows that several programs have.
    #[must_use]
    pub fn name_conflicts(&self) -> Vec<NameConflict> {
        let others = self.shared.namesakes.lock();
        if others.is_empty() {
            return Vec::new();
        }
        let mut found = conflicts(&self.shared.own.lock(), &others, Instant::now());
        if self.shared.remains.load(Ordering::Relaxed) > 0 {
            // What is left of an own participant that hangs may still announce itself.
            let own = &self.shared.config.local.flow;
            found.retain(|conflict| conflict.is_refused || conflict.flow != *own);
        }
        found
    }

    /// Sends one datagram to one endpoint on the topic of a class. Never waits.
    #[must_use]
    pub fn send(&self, to: &Endpoint, class: Priority, datagram: &[u8]) -> SendOutcome {
        let fits = datagram.len() <= self.shared.wire.max_datagram_bytes();
        let sent = fits
            && self
                .shared
                .writers
                .read()
                .get(to)
                .and_then(|writers| writers[class as usize].as_ref())
                .is_some_and(|writer| writer.write(datagram));
        if sent {
            SendOutcome::Sent
        } else {
            self.shared.not_sent.fetch_add(1, Ordering::Relaxed);
            SendOutcome::NotSent
        }
    }

    /// Makes writers to an endpoint, if there are none.
    pub fn connect(&self, to: &Endpoint) {
        {
            let mut wanted = self.shared.wanted.lock();
            if wanted.len() >= MAX_ENDPOINTS && !wanted.contains_key(to) {
                return;
            }
            let classes = wanted.entry(to.clone()).or_default();
            if *classes == [true; CLASSES] {
                return;
            }
            *classes = [true; CLASSES];
        }
        self.wake();
    }

    /// Drops the writers of some classes to an endpoint, with what they hold.
    pub fn disconnect(&self, to: &Endpoint, classes: &[Priority]) {
        {
            let mut wanted = self.shared.wanted.lock();
            if let Some(flags) = wanted.get_mut(to) {
                classes.iter().for_each(|class| flags[*class as usize] = false);
                if *flags == [false; CLASSES] {
                    wanted.remove(to);
                }
            }
        }
        {
            let mut writers = self.shared.writers.write();
            if let Some(slots) = writers.get_mut(to) {
                let taken = classes.iter().filter_map(|class| slots[*class as usize].take());
                self.shared.discarded.lock().extend(taken);
                if slots.iter().all(Option::is_none) {
                    writers.remove(to);
                }
            }
        }
        self.wake();
    }

    /// Other hosts where flows may be, as learnt from other flows; in the form of
    /// [`DdsTransport::addresses`].
    pub fn learn_addresses(&self, addresses: &[String]) {
        self.shared.relay.learn(addresses.iter().filter_map(|address| address.parse().ok()));
    }

    /// The addresses where this flow can be found.
    #[must_use]
    pub fn addresses(&self) -> Vec<String> {
        vec![self.shared.address.to_string()]
    }

    /// Bytes that a datagram of that length takes on the wire: Ethernet payload, that is IP packets
    /// with their headers.
    #[must_use]
    pub fn wire_bytes(&self, datagram_bytes: usize) -> usize {
        self.shared.wire.bytes(datagram_bytes)
    }

    fn wake(&self) {
        if let Some(thread) = &self.thread {
            thread.thread().unpark();
        }
    }
}

impl Drop for DdsTransport {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        self.wake();
        if let Some(thread) = self.thread.take()
            && thread.thread().id() != std::thread::current().id()
        {
            // Its panics are caught inside.
            let _ = thread.join();
        }
    }
}

fn topic(endpoint: &Endpoint, class: Priority) -> String {
    format!("{TOPIC_PREFIX}{}/{}/{class}", endpoint.flow, endpoint.epoch)
}

fn parse_topic(topic: &str) -> Option<(Endpoint, Priority)> {
    let mut parts = topic.strip_prefix(TOPIC_PREFIX)?.split('/');
    let flow = FlowId::new(parts.next()?.parse().ok()?, parts.next()?.parse().ok()?);
    let epoch = parts.next()?.parse().ok()?;
    let class = parts.next()?.parse().ok()?;
    parts.next().is_none().then_some((Endpoint { flow, epoch }, class))
}

/// Room for a class in writers and readers: enough for the event loop's and the sink's pauses,
/// bounded in bytes, since RustDDS keeps that many samples whether they wait or not.
fn profile(class: Priority, datagram_bytes: usize) -> Profile {
    let bytes = match class {
        Priority::Control => 256 << 10,
        Priority::State => 1 << 20,
        Priority::Bulk => 2 << 20,
    };
    let samples = (bytes / datagram_bytes.max(1)).clamp(128, 8192);
    Profile::best_effort(u16::try_from(samples).unwrap_or(u16::MAX))
}

#[cfg(test)]
mod hostile_tests;
#[cfg(test)]
mod tests;
