//! One DDS participant on one interface.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, UdpSocket};
use std::ops::Deref;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::{thread, time};

use rustdds::policy::{Deadline, Durability, History, Lifespan, Liveliness, ResourceLimits};
use rustdds::{
    DomainParticipant, DomainParticipantBuilder, Duration, Publisher, QosPolicies,
    QosPolicyBuilder, RTPSEntity, Subscriber, Topic, TopicKind, no_key,
};

use super::filter::{self, Attached, FilterError, Samples};
use super::metatraffic::{Metatraffic, Sockets};
use super::own_readers::{OwnReader, OwnReaders};
use super::pulse::port_is_free;
use super::reader::{OctetsSink, Reader, SampleSink, of_octets};
use super::sample::{Cdr, CdrAdapter};
use super::watch::{EndpointWatch, Endpoints};
use super::writer::{Writer, endpoint_of, participant_of};
use super::{DdsError, FRAME_TYPE, LOCAL_SLOTS, announcement_port, create_error, multicast_port};

/// RustDDS hangs when it takes longer to make an endpoint; else it takes some milliseconds.
const HANG: time::Duration = time::Duration::from_secs(2);

/// Identity of one participant on the wire; a rebuilt one has a new identity.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct GuidPrefix(pub [u8; 12]);

impl fmt::Display for GuidPrefix {
    /// 24 lower-case hexadecimal digits.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for GuidPrefix {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// Where a participant lives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ParticipantConfig {
    /// DDS domain.
    pub domain: u16,
    /// Address of the one interface that it announces. Never unspecified.
    pub address: Ipv4Addr,
    /// Send buffer of the socket in bytes: what can queue in the system behind the application's
    /// pacing.
    pub send_buffer_bytes: usize,
    /// Bytes of the largest sample that comes in fragments. RustDDS takes memory for a whole sample
    /// when the first fragment comes, from any sender, so larger ones (than the next power of two)
    /// are dropped before it sees them.
    pub largest_sample: u32,
    /// Whether single fragments of such samples are asked for again, as readers of reliable writers
    /// do.
    pub repairs_fragments: bool,
    /// Whether other implementations of DDS take part: their fragments have other sizes, and they
    /// pack other submessages into one datagram.
    pub any_vendor: bool,
}

impl ParticipantConfig {
    /// A participant with RustDDS' receive buffer, a send buffer of 64 KiB and fragmented samples
    /// up to 64 KiB.
    #[must_use]
    pub fn new(domain: u16, address: Ipv4Addr) -> Self {
        Self {
            domain,
            address,
            send_buffer_bytes: 64 * 1024,
            largest_sample: 64 * 1024,
            repairs_fragments: false,
            any_vendor: false,
        }
    }

    fn samples(&self) -> Samples {
        Samples {
            largest: self.largest_sample,
            repaired: self.repairs_fragments,
            any_vendor: self.any_vendor,
            repeated: false,
        }
    }

    fn check(&self) -> Result<(), DdsError> {
        let address = IpAddr::V4(self.address);
        super::check(self.domain, address)?;
        // RustDDS would announce no address at all and stay invisible.
        match UdpSocket::bind((self.address, 0)) {
            Ok(_) => Ok(()),
            Err(error) => Err(DdsError::AddressMissing { address, error: error.to_string() }),
        }
    }
}

/// Seconds of the Lifespan that marks the endpoints of flows: 67.7 years. Readers announce one, too,
/// and nobody else asks for this one.
const MARK_SECONDS: i32 = 0x7F4C_5A00;

/// The mark is a nanosecond longer. On the wire that are 4.3 units of 1/2³² s: five, since four are
/// read as no nanosecond.
fn mark() -> Duration {
    Duration::from_secs(MARK_SECONDS) + Duration::from_secs(5) / (1 << 32)
}

/// As RTPS has it: from 68 years on without end.
fn duration(time: time::Duration) -> Duration {
    match i32::try_from(time.as_secs()) {
        Ok(seconds) if seconds < i32::MAX => Duration::from_std(time),
        _ => Duration::INFINITE,
    }
}

/// Whether a Lifespan is the mark. It may have been rounded.
pub(super) fn is_mark(lifespan: Duration) -> bool {
    let difference = lifespan.to_nanoseconds() - mark().to_nanoseconds();
    (-1..=1).contains(&difference)
}

/// Quality of service of a writer or reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Profile {
    /// RTPS repairs losses. A write to a full window is refused, it never waits.
    pub reliable: bool,
    /// Writers: samples that may wait for the event loop, and with `transient_local` those kept for
    /// late joiners. Readers: samples that may wait for the sink.
    pub depth: u16,
    /// Late joiners get the last `depth` samples.
    pub transient_local: bool,
    /// Reliable writers: samples that may be under way at once, acknowledged by some readers and
    /// not by others; at least `depth`. RustDDS keeps them, and those of the last six seconds, in
    /// memory.
    pub window: u16,
    /// Deadline, liveliness lease, mark of flows.
    pub timing: TimingQos,
}

/// Deadline and liveliness lease of a writer or reader, and the Lifespan that marks those of flows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct TimingQos {
    /// Whether it is marked as an endpoint of a flow, for other flows.
    pub marked: bool,
    /// A writer offers a sample at least this often; a reader asks for that.
    pub deadline: Option<time::Duration>,
    /// A writer tells this often that it lives; a reader asks for that.
    pub lease: Option<time::Duration>,
    /// It tells so by writing (MANUAL_BY_TOPIC), else by itself.
    pub manual: bool,
}

impl TimingQos {
    /// An endpoint of a flow, without deadline and lease.
    pub const MARKED: Self = Self { marked: true, deadline: None, lease: None, manual: false };
}

impl Profile {
    /// Best effort with room for `depth` samples.
    #[must_use]
    pub fn best_effort(depth: u16) -> Self {
        Self {
            reliable: false,
            depth,
            transient_local: false,
            window: 0,
            timing: TimingQos::default(),
        }
    }

    fn qos(self) -> QosPolicies {
        let depth = i32::from(self.depth.max(1));
        let samples = depth.max(i32::from(self.window));
        let durability =
            if self.transient_local { Durability::TransientLocal } else { Durability::Volatile };
        let mut builder = QosPolicyBuilder::new()
            .durability(durability)
            .history(History::KeepLast { depth })
            .resource_limits(ResourceLimits {
                max_samples: samples,
                max_instances: 1,
                max_samples_per_instance: samples,
            });
        if let Some(deadline) = self.timing.deadline {
            builder = builder.deadline(Deadline(duration(deadline)));
        }
        let lease_duration = self.timing.lease.map_or(Duration::INFINITE, duration);
        if self.timing.manual {
            builder = builder.liveliness(Liveliness::ManualByTopic { lease_duration });
        } else if self.timing.lease.is_some() {
            builder = builder.liveliness(Liveliness::Automatic { lease_duration });
        }
        if self.timing.marked {
            builder = builder.lifespan(Lifespan { duration: mark() });
        }
        if self.reliable {
            builder.reliable(Duration::ZERO).build()
        } else {
            builder.best_effort().build()
        }
    }
}

/// A reader that nobody empties yet.
pub(crate) struct RawReader {
    reader: no_key::SimpleDataReader<Cdr, CdrAdapter>,
    /// As long as the reader stands, it is acknowledged in its name where RustDDS does not reach it.
    _own: Option<OwnReader>,
}

impl Deref for RawReader {
    type Target = no_key::SimpleDataReader<Cdr, CdrAdapter>;

    fn deref(&self) -> &Self::Target {
        &self.reader
    }
}

/// One participant. Dropping it says good-bye to the others and ends its threads, which may take a
/// while when one of them hangs: drop it where that does not matter.
pub struct Participant {
    dds: DomainParticipant,
    publisher: Publisher,
    subscriber: Subscriber,
    config: ParticipantConfig,
    prefix: GuidPrefix,
    port: u16,
    filter: Result<Attached, FilterError>,
    /// Those that RustDDS does not reach.
    own_readers: Option<Arc<OwnReaders>>,
    failed: Arc<AtomicBool>,
    /// Carries the good-bye of RustDDS, so it drops last.
    metatraffic: Option<Metatraffic>,
}

impl Drop for Participant {
    fn drop(&mut self) {
        if let Some(metatraffic) = &self.metatraffic {
            metatraffic.note_end();
        }
    }
}

impl fmt::Debug for Participant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Participant {} on {} port {}", self.prefix, self.config.address, self.port)
    }
}

impl Participant {
    /// Starts a participant. It announces itself to the other participants of this host; a
    /// [`super::Relay`] does so to other hosts.
    ///
    /// # Errors
    /// [`DdsError`] when the configuration is not possible here or now, or RustDDS cannot start.
    pub fn start(config: ParticipantConfig) -> Result<Self, DdsError> {
        config.check()?;
        let qos = Profile::best_effort(1).qos();
        let (dds, publisher, subscriber, id) = contain("participant", || {
            let dds = DomainParticipantBuilder::new(config.domain)
                .with_only_networks([IpAddr::V4(config.address)])
                .socket_send_buffer_size(config.send_buffer_bytes)
                .build()?;
            let publisher = dds.create_publisher(&qos)?;
            let subscriber = dds.create_subscriber(&qos)?;
            let id = dds.participant_id();
            Ok((dds, publisher, subscriber, id))
        })?;
        if id >= LOCAL_SLOTS {
            tracing::warn!(
                slot = id,
                domain = config.domain,
                "too many DDS participants on this host: others here do not see this one"
            );
        }
        let (prefix, failed) = (prefix_of(dds.guid()), Arc::default());
        let port = announcement_port(config.domain, id);
        let multicast = multicast_port(config.domain);
        let sockets = config.any_vendor.then(|| Sockets::open(config.domain, config.address, port));
        let sockets = sockets.and_then(|opened| opened.inspect_err(warn_of_ghosts).ok());
        let samples = Samples { repeated: sockets.is_some(), ..config.samples() };
        let filter = filter::attach(&[port, port + 1, multicast, multicast + 1], samples);
        warn_once(&filter);
        let own_readers = OwnReaders::unreached(config.address, port + 1, prefix)
            .map_err(create_error("socket"))?
            .map(Arc::new);
        let start = |sockets| Metatraffic::start(sockets, prefix, Arc::clone(&failed));
        let metatraffic = sockets.map(start).transpose()?;
        Ok(Self {
            prefix,
            port,
            filter,
            own_readers,
            dds,
            publisher,
            subscriber,
            config,
            failed,
            metatraffic,
        })
    }

    /// Its identity on the wire.
    #[must_use]
    pub fn prefix(&self) -> GuidPrefix {
        self.prefix
    }

    /// The UDP port on which it takes announcements; user data come on the next one.
    #[must_use]
    pub fn port(&self) -> u16 {
        self.port
    }

    /// Address of its interface.
    pub(super) fn address(&self) -> Ipv4Addr {
        self.config.address
    }

    /// Why hostile datagrams may reach RustDDS, or harmless ones may not; `None` when all is well.
    #[must_use]
    pub fn filter_weakness(&self) -> Option<String> {
        weakness(&self.filter)
    }

    /// Datagrams that the kernel dropped at its sockets: hostile ones, and those for which no room
    /// was left. With them what is malformed of discovery that goes through this process.
    #[must_use]
    pub fn dropped_by_kernel(&self) -> u64 {
        self.filter.as_ref().map_or(0, Attached::dropped)
            + self.metatraffic.as_ref().map_or(0, Metatraffic::dropped)
    }

    /// Makes a writer of a topic of [`FRAME_TYPE`].
    ///
    /// # Errors
    /// [`DdsError`] when RustDDS refuses or has died.
    pub fn writer(&self, topic: &str, profile: Profile) -> Result<Writer, DdsError> {
        self.typed_writer((topic, FRAME_TYPE), profile)
    }

    /// Makes a writer of a topic, given with its type.
    ///
    /// # Errors
    /// [`DdsError`] when RustDDS refuses or has died.
    pub fn typed_writer(&self, topic: (&str, &str), profile: Profile) -> Result<Writer, DdsError> {
        let publisher = self.publisher.clone();
        let writer = self.make("writer", topic, profile, move |topic| {
            publisher.create_datawriter_no_key::<Cdr, CdrAdapter>(topic, Some(profile.qos()))
        })?;
        let own_readers = self.own_readers.clone().filter(|_| profile.reliable);
        let own_readers = own_readers.map(|readers| (topic.0.to_owned(), readers));
        Ok(Writer::new(writer, profile.transient_local, own_readers, Arc::clone(&self.failed)))
    }

    /// Makes a reader of a topic of [`FRAME_TYPE`], and the thread that hands its samples to `sink`.
    ///
    /// # Errors
    /// [`DdsError`] when RustDDS refuses or has died.
    pub fn reader(
        &self,
        topic: &str,
        profile: Profile,
        sink: OctetsSink,
    ) -> Result<Reader, DdsError> {
        self.typed_reader((topic, FRAME_TYPE), profile, of_octets(sink))
    }

    /// The same of a topic given with its type. RustDDS looks at names alone: samples of other
    /// types on the topic come as well.
    ///
    /// # Errors
    /// [`DdsError`] when RustDDS refuses or has died.
    pub fn typed_reader(
        &self,
        topic: (&str, &str),
        profile: Profile,
        sink: SampleSink,
    ) -> Result<Reader, DdsError> {
        Reader::start(self.raw_reader(topic, profile)?, sink, Arc::clone(&self.failed))
    }

    /// Calls `sink` with the readers and writers of other participants whose topics begin with
    /// `topics`, whenever one comes or goes, and once a second.
    ///
    /// # Errors
    /// [`DdsError`] when there is no thread for it.
    pub fn watch_endpoints(
        &self,
        topics: &'static str,
        sink: Box<dyn Fn(Endpoints) + Send>,
    ) -> Result<EndpointWatch, DdsError> {
        EndpointWatch::start(self.dds.clone(), self.prefix, topics, sink, Arc::clone(&self.failed))
    }

    /// Whether its threads are alive, as far as that shows without traffic: no panic was seen, no
    /// endpoint took too long to make, the event loop holds its port, the discovery thread takes
    /// commands.
    #[must_use]
    pub fn is_alive(&self) -> bool {
        if self.failed.load(Ordering::Relaxed) {
            return false;
        }
        let commands = catch_unwind(AssertUnwindSafe(|| self.dds.assert_liveliness().is_ok()))
            .unwrap_or(false);
        // That of announcements is held by others beside RustDDS.
        !port_is_free(self.port + 1) && commands
    }

    /// Ends or blocks the event loop of RustDDS, which then panics or hangs, for tests of those who
    /// must notice.
    ///
    /// # Errors
    /// [`DdsError`] when RustDDS refuses or has died.
    #[cfg(feature = "fault-injection")]
    pub fn inject(&self, fault: super::Fault) -> Result<(), DdsError> {
        super::fault::inject(self, fault)
    }

    /// Makes a reader of a topic, given with its type. It has no thread that empties it.
    pub(crate) fn raw_reader(
        &self,
        topic: (&str, &str),
        profile: Profile,
    ) -> Result<RawReader, DdsError> {
        let subscriber = self.subscriber.clone();
        let reader = self.make("reader", topic, profile, move |topic| {
            subscriber.create_simple_datareader_no_key(topic, Some(profile.qos()))
        })?;
        let own_readers = self.own_readers.clone().filter(|_| profile.reliable);
        let _own = own_readers.map(|readers| readers.add(topic.0, &endpoint_of(reader.guid())));
        Ok(RawReader { reader, _own })
    }

    /// Makes an endpoint, in a thread of its own that can be left behind.
    ///
    /// RustDDS 0.15 can stand still for good here: its discovery holds the table of endpoints while
    /// it tells the event loop of those on the topic of a new one, for which there is room for 32;
    /// when the next endpoint waits for the table, the event loop does not get at it either, and
    /// takes nothing any more.
    fn make<T: Send + 'static>(
        &self,
        what: &'static str,
        (name, type_name): (&str, &str),
        profile: Profile,
        make: impl FnOnce(&Topic) -> rustdds::dds::CreateResult<T> + Send + 'static,
    ) -> Result<T, DdsError> {
        let (dds, name, kind) = (self.dds.clone(), name.to_owned(), type_name.to_owned());
        let (tell, made) = sync_channel(1);
        let making = move || {
            let made = contain(what, || {
                make(&dds.create_topic(name, kind, &profile.qos(), TopicKind::NoKey)?)
            });
            // One that nobody waits for any more is dropped.
            let _ = tell.send(made);
        };
        let thread = thread::Builder::new().name("dds-make".to_owned());
        thread.spawn(making).map_err(create_error("thread"))?;
        let made = match made.recv_timeout(HANG) {
            Ok(made) => made,
            Err(RecvTimeoutError::Timeout) => Err(DdsError::Hangs(what)),
            Err(RecvTimeoutError::Disconnected) => Err(DdsError::Panicked(what)),
        };
        made.inspect_err(|error| {
            if matches!(error, DdsError::Panicked(_) | DdsError::Hangs(_)) {
                self.failed.store(true, Ordering::Relaxed);
            }
        })
    }
}

fn weakness(filter: &Result<Attached, FilterError>) -> Option<String> {
    match filter {
        Ok(attached) if !attached.is_small => None,
        Ok(_) => Some("the packet filter is a small one: set net.core.optmem_max to 131072".into()),
        Err(error) => {
            Some(format!("no packet filter, so any sender can exhaust the memory: {error}"))
        }
    }
}

fn warn_of_ghosts(error: &FilterError) {
    tracing::warn!(%error, "Fast DDS will not see what is gone here");
}

fn warn_once(filter: &Result<Attached, FilterError>) {
    static WARNED: AtomicBool = AtomicBool::new(false);
    if let Some(weakness) = weakness(filter)
        && !WARNED.swap(true, Ordering::Relaxed)
    {
        tracing::warn!("{weakness}");
    }
}

fn contain<T>(
    what: &'static str,
    make: impl FnOnce() -> rustdds::dds::CreateResult<T>,
) -> Result<T, DdsError> {
    match catch_unwind(AssertUnwindSafe(make)) {
        Ok(Ok(made)) => Ok(made),
        Ok(Err(error)) => Err(DdsError::Create { what, error: error.to_string() }),
        Err(_) => Err(DdsError::Panicked(what)),
    }
}

pub(crate) fn prefix_of(guid: rustdds::GUID) -> GuidPrefix {
    participant_of(&endpoint_of(guid))
}
