//! Which readers and writers other participants have.

use std::collections::HashSet;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::thread;
use std::time::{Duration, Instant};

use futures::Stream;
use rustdds::discovery::{DiscoveredReaderData, DiscoveredWriterData};
use rustdds::policy::Durability;
use rustdds::{
    DomainParticipant, DomainParticipantStatusEvent as Event, QosPolicies, StatusEvented,
};

use super::participant::{is_mark, prefix_of};
use super::reader::StoppableThread;
use super::writer::{EndpointId, endpoint_of, participant_of};
use super::{DdsError, GuidPrefix};
use crate::wake::unpark_waker;

/// RustDDS drops events when its queue of 2048 is full, so all readers are looked at once in this
/// time.
const RECONCILE: Duration = Duration::from_secs(1);

/// A reader or writer of another participant, of any topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundEndpoint {
    /// Its identity.
    pub id: EndpointId,
    /// Its topic.
    pub topic: String,
    /// The type of the topic, as it names it.
    pub type_name: String,
    /// What it offers or asks for.
    pub qos: QosPolicies,
    /// QoS USER_DATA.
    pub user_data: Vec<u8>,
    /// Where it takes data or acknowledgements; empty where it does so at no UDP address.
    pub sockets: Vec<SocketAddr>,
}

impl FoundEndpoint {
    /// Its participant.
    #[must_use]
    pub fn participant(&self) -> GuidPrefix {
        participant_of(&self.id)
    }

    /// Whether a writer repairs losses, or a reader acknowledges. A writer that says nothing does,
    /// and a reader does not: Cyclone leaves out what is the default of DDS.
    #[must_use]
    pub fn is_reliable(&self) -> bool {
        let is_writer = rustdds::GUID::from_bytes(self.id).entity_id.kind().is_writer();
        self.qos.reliability().map_or(is_writer, |_| self.qos.is_reliable())
    }

    /// Whether it belongs to a flow.
    #[must_use]
    pub fn is_marked(&self) -> bool {
        self.qos.lifespan().is_some_and(|lifespan| is_mark(lifespan.duration))
    }

    /// Whether a writer keeps samples for late joiners, or a reader asks for them.
    #[must_use]
    pub fn is_durable(&self) -> bool {
        self.qos.durability().is_some_and(|durability| durability != Durability::Volatile)
    }
}

/// All that other participants have.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Endpoints {
    /// Their readers.
    pub readers: Vec<FoundEndpoint>,
    /// Their writers.
    pub writers: Vec<FoundEndpoint>,
}

/// Participants that were lost and are remembered, to know them again.
const MAX_LOST: usize = 1024;

/// Least time between two participants of which the first ends because of others: who comes and
/// goes all the time must not keep this one from working.
const LIFE: Duration = Duration::from_secs(10);

/// Watches all endpoints until it is dropped.
pub struct EndpointWatch {
    _thread: StoppableThread,
    returned: Arc<AtomicBool>,
    started: Instant,
}

impl EndpointWatch {
    pub(super) fn start(
        participant: DomainParticipant,
        own: GuidPrefix,
        topics: &'static str,
        sink: Box<dyn Fn(Endpoints) + Send>,
        failed: Arc<AtomicBool>,
    ) -> Result<Self, DdsError> {
        let returned = Arc::<AtomicBool>::default();
        let tell = Arc::clone(&returned);
        let thread = StoppableThread::start("dds-watch", failed, move |stop| {
            watch(&participant, stop, &tell, || sink(endpoints(&participant, own, topics)));
        })?;
        Ok(Self { _thread: thread, returned, started: Instant::now() })
    }

    /// Whether a participant came back that was lost before. RustDDS does not ask it for its
    /// readers and writers again, so that this one must begin anew to meet it: not in its first ten
    /// seconds.
    #[must_use]
    pub fn has_returned(&self) -> bool {
        self.returned.load(Ordering::Relaxed) && self.started.elapsed() > LIFE
    }
}

fn watch(
    participant: &DomainParticipant,
    stop: &AtomicBool,
    returned: &AtomicBool,
    look: impl Fn(),
) {
    let listener = participant.status_listener();
    let mut events = listener.as_async_status_stream();
    let waker = unpark_waker();
    let mut context = Context::from_waker(&waker);
    let mut next_look = Instant::now();
    let mut lost = HashSet::new();
    while !stop.load(Ordering::Relaxed) {
        let mut changed = false;
        while let Poll::Ready(event) = Pin::new(&mut events).poll_next(&mut context) {
            match event {
                Some(Event::ParticipantLost { id, .. }) => {
                    if lost.len() >= MAX_LOST {
                        lost.clear();
                    }
                    lost.insert(id);
                    changed = true;
                }
                Some(Event::ParticipantDiscovered { dpd }) if lost.remove(&dpd.guid.prefix) => {
                    returned.store(true, Ordering::Relaxed);
                }
                Some(
                    Event::ReaderDetected { .. }
                    | Event::ReaderLost { .. }
                    | Event::WriterDetected { .. }
                    | Event::WriterLost { .. },
                ) => changed = true,
                Some(_) => {}
                // Both threads of RustDDS have gone; whoever watches the participant sees that too.
                None => return,
            }
        }
        let now = Instant::now();
        if changed || now >= next_look {
            look();
            next_look = now + RECONCILE;
        } else {
            thread::park_timeout(next_look - now);
        }
    }
}

fn endpoints(participant: &DomainParticipant, own: GuidPrefix, topics: &str) -> Endpoints {
    let is_foreign =
        |guid: rustdds::GUID| guid.entity_id.kind().is_user_defined() && prefix_of(guid) != own;
    let readers = participant.discovered_readers().into_iter().filter(|reader| {
        is_foreign(reader.reader_proxy.remote_reader_guid)
            && reader.subscription_topic_data.topic_name().starts_with(topics)
    });
    let writers = participant.discovered_writers().into_iter().filter(|writer| {
        is_foreign(writer.writer_proxy.remote_writer_guid)
            && writer.publication_topic_data.topic_name.starts_with(topics)
    });
    Endpoints { readers: readers.map(reader).collect(), writers: writers.map(writer).collect() }
}

fn reader(found: DiscoveredReaderData) -> FoundEndpoint {
    let topic = &found.subscription_topic_data;
    let locators = found.reader_proxy.unicast_locator_list.iter().filter(|it| it.is_udp());
    FoundEndpoint {
        id: endpoint_of(found.reader_proxy.remote_reader_guid),
        topic: topic.topic_name().clone(),
        type_name: topic.type_name().clone(),
        qos: topic.qos(),
        user_data: found.user_data,
        sockets: locators.map(|locator| (*locator).into()).collect(),
    }
}

fn writer(found: DiscoveredWriterData) -> FoundEndpoint {
    let qos = found.publication_topic_data.qos();
    let locators = found.writer_proxy.unicast_locator_list.iter().filter(|it| it.is_udp());
    FoundEndpoint {
        id: endpoint_of(found.writer_proxy.remote_writer_guid),
        topic: found.publication_topic_data.topic_name,
        type_name: found.publication_topic_data.type_name,
        qos,
        user_data: found.user_data,
        sockets: locators.map(|locator| (*locator).into()).collect(),
    }
}
