//! Which readers other participants have.

use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::thread;
use std::time::{Duration, Instant};

use futures::Stream;
use rustdds::{DomainParticipant, DomainParticipantStatusEvent as Event, StatusEvented};

use super::participant::prefix_of;
use super::reader::{StoppableThread, unpark_waker};
use super::{DdsError, GuidPrefix};

/// RustDDS drops events when its queue of 2048 is full, so all readers are looked at once in this time.
const RECONCILE: Duration = Duration::from_secs(1);

/// A reader of another participant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RemoteReader {
    /// Its participant.
    pub participant: GuidPrefix,
    /// Its topic.
    pub topic: String,
    /// Where it takes data.
    pub addresses: Vec<IpAddr>,
}

/// Watches until it is dropped.
pub struct ReaderWatch {
    _thread: StoppableThread,
}

impl ReaderWatch {
    pub(super) fn start(
        participant: DomainParticipant,
        own: GuidPrefix,
        topics: String,
        sink: Box<dyn Fn(Vec<RemoteReader>) + Send>,
        failed: Arc<AtomicBool>,
    ) -> Result<Self, DdsError> {
        let thread = StoppableThread::start("dds-watch", failed, move |stop| {
            watch(&participant, stop, || {
                sink(remote_readers(&participant, own, &topics));
            });
        })?;
        Ok(Self { _thread: thread })
    }
}

fn watch(participant: &DomainParticipant, stop: &AtomicBool, look: impl Fn()) {
    let listener = participant.status_listener();
    let mut events = listener.as_async_status_stream();
    let waker = unpark_waker();
    let mut context = Context::from_waker(&waker);
    let mut next_look = Instant::now();
    while !stop.load(Ordering::Relaxed) {
        let mut changed = false;
        while let Poll::Ready(event) = Pin::new(&mut events).poll_next(&mut context) {
            match event {
                Some(Event::ReaderDetected { .. } | Event::ReaderLost { .. } | Event::ParticipantLost { .. }) => {
                    changed = true;
                }
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

fn remote_readers(participant: &DomainParticipant, own: GuidPrefix, topics: &str) -> Vec<RemoteReader> {
    participant
        .discovered_readers()
        .iter()
        .filter(|reader| reader.subscription_topic_data.topic_name().starts_with(topics))
        .map(|reader| RemoteReader {
            participant: prefix_of(reader.reader_proxy.remote_reader_guid),
            topic: reader.subscription_topic_data.topic_name().clone(),
            addresses: reader
                .reader_proxy
                .unicast_locator_list
                .iter()
                .filter(|locator| locator.is_udp())
                .map(|locator| SocketAddr::from(*locator).ip())
                .collect(),
        })
        .filter(|reader| reader.participant != own)
        .collect()
}
