//! Which request of a service a reply answers.
//!
//! ```text
//! client ──request──► its flow ──► flow of the server ──request──► server
//!    ▲                asked                forwarded                 │
//!    └─────reply───── its flow ◄── flow of the server ◄────reply─────┘
//! ```
//!
//! Each implementation of DDS has its own way to tell: Fast DDS and others send the identity of the
//! request beside the reply, Cyclone has 16 bytes before the CDR. Between flows there is neither:
//! a reply names writer and number of the request.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::time::{Duration, Instant};

use blaze_domain::WriterId;
use bytes::{BufMut, Bytes, BytesMut};
use parking_lot::Mutex;
use rustdds::rpc::SampleIdentity;
use rustdds::{GUID, SequenceNumber};

use super::endpoint::Vendor;
use super::names::Carries;
use crate::dds::{EndpointId, Sample};

/// Requests of one client that wait for their replies; then the oldest is given up.
const MAX_OF_CLIENT: usize = 1024;
/// The same of all clients together.
const MAX_REQUESTS: usize = 65_536;
/// How long a reader of replies and the server's writer have to be known until the server has found
/// the reader, too.
const MEET_SERVER: Duration = Duration::from_millis(200);
/// How long requests wait for that at most.
const LONGEST_MEET: Duration = Duration::from_secs(5);
/// Requests that a server has not answered and that were written not long ago: servers of ROS 2 keep
/// ten, and lose the oldest of more. Those that waited here come at once: of 16, six were lost.
const MAX_BURST: usize = 8;
/// How long one that is not answered counts as written not long ago.
const BURST_PAUSE: Duration = Duration::from_millis(200);
/// Bytes of the encapsulation, and of what Cyclone puts before requests and replies: who asks, and
/// the number of the request.
const ENCAPSULATION: usize = 4;
const CYCLONE_HEADER: usize = 16;

/// A request: its client's writer, and its number.
pub(super) type Request = (WriterId, u64);

/// How a client or server knows a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum OnWire {
    /// As RTPS tells beside a sample: a reader or writer, and a number.
    Related(EndpointId, i64),
    /// As Cyclone tells before the CDR.
    Header([u8; CYCLONE_HEADER]),
}

/// What a DDS topic of ROS 2 carries.
pub(super) fn carries(dds_topic: &str) -> Carries {
    match dds_topic.get(..3) {
        Some("rq/") => Carries::Requests,
        Some("rr/") => Carries::Replies,
        _ => Carries::Messages,
    }
}

/// As a request names the reader of its reply.
pub(super) fn named(reader: EndpointId) -> SampleIdentity {
    let writer_guid = GUID::from_bytes(reader);
    SampleIdentity { writer_guid, sequence_number: SequenceNumber::UNKNOWN }
}

impl OnWire {
    /// How the client of this vendor knows its request, and the request as others send it. `None`
    /// where it is too short.
    pub(super) fn of_request(vendor: Vendor, sample: &Sample) -> Option<(Self, Bytes)> {
        let payload = sample.sample.payload();
        if vendor == Vendor::CycloneDds {
            return cut_header(payload).map(|(header, rest)| (Self::Header(header), rest));
        }
        // Fast DDS looks for its reader of replies, if the request names that.
        let named = sample.related_sample_identity().map(|related| related.writer_guid);
        let named = named.filter(|guid| *guid != GUID::GUID_UNKNOWN);
        let guid = named.unwrap_or(sample.writer_guid);
        Some((Self::Related(guid.to_bytes(), sample.sequence_number.into()), payload.clone()))
    }

    /// Which of our requests a server of this vendor answers, and the reply as others send it.
    pub(super) fn of_reply(vendor: Vendor, sample: &Sample) -> Option<(Self, Bytes)> {
        let payload = sample.sample.payload();
        if vendor == Vendor::CycloneDds {
            return cut_header(payload).map(|(header, rest)| (Self::Header(header), rest));
        }
        let related = sample.related_sample_identity()?;
        let number = related.sequence_number.into();
        Some((Self::Related(related.writer_guid.to_bytes(), number), payload.clone()))
    }

    /// A sample that says so: its payload, and its related identity.
    pub(super) fn put_on(self, payload: &Bytes) -> (Bytes, Option<SampleIdentity>) {
        match self {
            Self::Related(guid, number) => {
                let writer_guid = GUID::from_bytes(guid);
                let sequence_number = SequenceNumber::from(number);
                (payload.clone(), Some(SampleIdentity { writer_guid, sequence_number }))
            }
            Self::Header(header) => {
                let at = ENCAPSULATION.min(payload.len());
                let mut bytes = BytesMut::with_capacity(payload.len() + CYCLONE_HEADER);
                bytes.put_slice(&payload[..at]);
                bytes.put_slice(&header);
                bytes.put_slice(&payload[at..]);
                (bytes.freeze(), None)
            }
        }
    }
}

/// What stands before the CDR, and the sample without it: 16 bytes, so alignment stays.
fn cut_header(payload: &Bytes) -> Option<([u8; CYCLONE_HEADER], Bytes)> {
    let (encapsulation, body) = payload.split_at_checked(ENCAPSULATION)?;
    let (header, rest) = body.split_first_chunk::<CYCLONE_HEADER>()?;
    let mut bytes = BytesMut::with_capacity(ENCAPSULATION + rest.len());
    bytes.put_slice(encapsulation);
    bytes.put_slice(rest);
    Some((*header, bytes.freeze()))
}

/// Something for each of some requests, bounded by client.
#[derive(Debug)]
struct ByRequest<V> {
    all: BTreeMap<Request, V>,
    of_client: HashMap<WriterId, usize>,
}

impl<V> Default for ByRequest<V> {
    fn default() -> Self {
        Self { all: BTreeMap::new(), of_client: HashMap::new() }
    }
}

impl<V> ByRequest<V> {
    /// Puts in one. Returns those that gave way: the same before, and the oldest of its client.
    fn insert(&mut self, request: Request, value: V) -> Vec<V> {
        let mut gone: Vec<V> = self.remove(&request).into_iter().collect();
        let count = self.of_client.get(&request.0).copied().unwrap_or(0);
        if count >= MAX_OF_CLIENT {
            let of_client = (request.0, 0)..=(request.0, u64::MAX);
            let oldest = self.all.range(of_client).next().map(|(oldest, _)| *oldest);
            gone.extend(oldest.and_then(|oldest| self.remove(&oldest)));
        } else if self.all.len() >= MAX_REQUESTS {
            let other = self.all.keys().next().copied();
            gone.extend(other.and_then(|other| self.remove(&other)));
        }
        *self.of_client.entry(request.0).or_default() += 1;
        self.all.insert(request, value);
        gone
    }

    fn remove(&mut self, request: &Request) -> Option<V> {
        let value = self.all.remove(request)?;
        if let Some(count) = self.of_client.get_mut(&request.0) {
            *count -= 1;
            if *count == 0 {
                self.of_client.remove(&request.0);
            }
        }
        Some(value)
    }

    /// Forgets all requests of some clients. Returns what they had.
    fn retain(&mut self, keeps: impl Fn(&Request, &V) -> bool) -> Vec<V> {
        let gone: Vec<Request> = self
            .all
            .iter()
            .filter(|(request, value)| !keeps(request, value))
            .map(|it| *it.0)
            .collect();
        gone.iter().filter_map(|request| self.remove(request)).collect()
    }
}

/// A request that was written here for a client elsewhere.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Forwarded {
    pub(super) request: Request,
    /// The flow of its client.
    pub(super) flow: String,
}

/// A reader of the flow that gets the replies of a service.
struct ReplyReader {
    id: EndpointId,
    since: Instant,
    /// The writer whose requests name it: those of another one may have the same numbers.
    named_by: Option<EndpointId>,
}

/// The requests that wait for replies.
#[derive(Default)]
pub(super) struct Services {
    state: Mutex<State>,
}

#[derive(Default)]
pub(super) struct State {
    /// Of clients on this network: how they know their requests, and when those came.
    asked: ByRequest<(OnWire, Instant)>,
    /// Written here for clients elsewhere: how the server knows them, and on which DDS topic.
    forwarded: ByRequest<(OnWire, String)>,
    by_wire: HashMap<OnWire, Forwarded>,
    /// DDS topics whose requests somebody reads.
    read: BTreeSet<String>,
    /// Own readers of replies, by DDS topic.
    readers: HashMap<String, ReplyReader>,
    /// DDS topics whose requests wait until their replies can be read, and since when.
    waiting: HashMap<String, Instant>,
    /// By DDS topic: what was written last, and when.
    burst: HashMap<String, Vec<(Instant, OnWire)>>,
    /// Requests that were given up because there were too many.
    given_up: u64,
    /// The last number given to a server that wants one before the CDR.
    last: u64,
}

impl Services {
    /// To be held from before a request is written until it is [noted](State::note_forwarded): its
    /// reply may be read by then.
    pub(super) fn lock(&self) -> parking_lot::MutexGuard<'_, State> {
        self.state.lock()
    }
}

impl State {
    /// A client on this network asks.
    pub(super) fn note_asked(&mut self, now: Instant, request: Request, known_as: OnWire) {
        self.given_up += self.asked.insert(request, (known_as, now)).len() as u64;
    }

    /// How the client of a request knows it, and when it came; `None`: it is not waited for any
    /// more.
    pub(super) fn asked(&self, request: &Request) -> Option<(OnWire, Instant)> {
        self.asked.all.get(request).copied()
    }

    /// The reply has been written.
    pub(super) fn note_answered(&mut self, request: &Request) {
        self.asked.remove(request);
    }

    /// A number that no request had before, for a server that wants one before the CDR. `own`: the
    /// writer of requests.
    pub(super) fn next_header(&mut self, own: &EndpointId) -> OnWire {
        self.last += 1;
        let mut header = [0; CYCLONE_HEADER];
        // Another flow of this network has other bytes of chance there, another writer of this one
        // another entity.
        header[..4].copy_from_slice(&own[4..8]);
        header[4..8].copy_from_slice(&own[12..]);
        header[8..].copy_from_slice(&self.last.to_le_bytes());
        OnWire::Header(header)
    }

    /// Takes over the DDS topics whose requests somebody reads. Returns whether they are others.
    pub(super) fn set_read(&mut self, topics: impl Iterator<Item = String>) -> bool {
        let read = topics.collect();
        let before = std::mem::replace(&mut self.read, read);
        before != self.read
    }

    /// Whether somebody reads the requests of a DDS topic. Until then they wait.
    pub(super) fn is_read(&self, topic: &str) -> bool {
        self.read.contains(topic)
    }

    /// An own reader of replies stands, or no longer.
    pub(super) fn note_reader(&mut self, now: Instant, topic: &str, id: EndpointId, stands: bool) {
        if stands {
            let reader = ReplyReader { id, since: now, named_by: None };
            self.readers.insert(topic.to_owned(), reader);
        } else if self.readers.get(topic).is_some_and(|reader| reader.id == id) {
            self.readers.remove(topic);
        }
    }

    /// The own participant is another one: its readers have gone.
    pub(super) fn forget_readers(&mut self) {
        self.readers.clear();
    }

    /// Whether the replies to requests of a topic reach the own reader of `replies`, where its
    /// writer has been known for some time; also after a while in which that did not come about.
    pub(super) fn may_ask(
        &mut self,
        now: Instant,
        topic: &str,
        replies: &str,
        known_for: Option<Duration>,
    ) -> bool {
        let reader = self.readers.get(replies);
        let stands = reader.map(|reader| now.saturating_duration_since(reader.since));
        if stands.min(known_for).is_some_and(|both| both >= MEET_SERVER) {
            self.waiting.remove(topic);
            return true;
        }
        let since = self.waiting.entry(topic.to_owned()).or_insert(now);
        now.saturating_duration_since(*since) >= LONGEST_MEET
    }

    /// Whether a server takes one more request of a topic now.
    pub(super) fn has_room(&mut self, now: Instant, topic: &str) -> bool {
        let Some(burst) = self.burst.get_mut(topic) else { return true };
        burst.retain(|(at, known_as)| {
            now.saturating_duration_since(*at) < BURST_PAUSE && self.by_wire.contains_key(known_as)
        });
        burst.len() < MAX_BURST
    }

    /// The own reader of `replies`, as requests of a writer name it: servers of Fast DDS then wait
    /// until they have met it.
    pub(super) fn reader_to_name(
        &mut self,
        replies: &str,
        writer: EndpointId,
    ) -> Option<EndpointId> {
        let reader = self.readers.get_mut(replies)?;
        (*reader.named_by.get_or_insert(writer) == writer).then_some(reader.id)
    }

    /// A request was written here.
    pub(super) fn note_forwarded(
        &mut self,
        now: Instant,
        topic: &str,
        known_as: OnWire,
        of: Forwarded,
    ) {
        self.burst.entry(topic.to_owned()).or_default().push((now, known_as));
        let gone = self.forwarded.insert(of.request, (known_as, topic.to_owned()));
        self.given_up += gone.len() as u64;
        self.forget(gone);
        self.by_wire.insert(known_as, of);
    }

    /// Takes the request that a server answers.
    pub(super) fn take_forwarded(&mut self, known_as: &OnWire) -> Option<Forwarded> {
        let forwarded = self.by_wire.remove(known_as)?;
        self.forwarded.remove(&forwarded.request);
        Some(forwarded)
    }

    /// Forgets requests whose clients have gone, and those whose servers have: of no service whose
    /// requests are read.
    pub(super) fn retain(
        &mut self,
        is_client: impl Fn(&WriterId) -> bool,
        is_served: impl Fn(&str) -> bool,
    ) {
        self.asked.retain(|(client, _), _| is_client(client));
        self.waiting.retain(|topic, _| is_served(topic));
        self.burst.retain(|topic, _| is_served(topic));
        let gone = self.forwarded.retain(|_, (_, topic)| is_served(topic));
        self.forget(gone);
    }

    /// Requests that wait for replies, and those that were given up.
    pub(super) fn counts(&self) -> (usize, u64) {
        (self.asked.all.len() + self.forwarded.all.len(), self.given_up)
    }

    fn forget(&mut self, gone: Vec<(OnWire, String)>) {
        for (known_as, _) in gone {
            self.by_wire.remove(&known_as);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CLIENT: WriterId = WriterId([1; 16]);

    fn forwarded(number: u64) -> Forwarded {
        Forwarded { request: (CLIENT, number), flow: "edge/a".to_owned() }
    }

    #[test]
    fn what_stands_before_the_cdr_is_taken_off_and_put_on() {
        let plain = Bytes::from_static(&[0, 1, 0, 0, 9, 8, 7, 6]);
        let header = [5; CYCLONE_HEADER];
        let (with, related) = OnWire::Header(header).put_on(&plain);
        assert_eq!((with.len(), related), (24, None));
        assert_eq!(cut_header(&with), Some((header, plain.clone())));
        assert_eq!(cut_header(&plain), None);
        let (same, related) = OnWire::Related([3; 16], 7).put_on(&plain);
        let related = related.unwrap();
        assert_eq!(same, plain);
        assert_eq!(
            (related.writer_guid.to_bytes(), i64::from(related.sequence_number)),
            ([3; 16], 7)
        );
    }

    #[test]
    fn each_reply_finds_its_request_once() {
        let mut state = State::default();
        let wire = |number| OnWire::Related([9; 16], number);
        for number in 1..=3_u64 {
            let known_as = wire(number as i64);
            state.note_forwarded(Instant::now(), "rq/addRequest", known_as, forwarded(number));
        }
        assert_eq!(state.take_forwarded(&wire(2)), Some(forwarded(2)));
        assert_eq!(state.take_forwarded(&wire(2)), None, "a server may answer once");
        assert_eq!(state.take_forwarded(&OnWire::Related([8; 16], 1)), None);
        let headers = [state.next_header(&[7; 16]), state.next_header(&[7; 16])];
        assert_ne!(headers[0], headers[1]);
        let of_flow = |chance: u8| {
            let own = [1, 0x12, 0, 0, chance, 0, 0, 0, 0, 0, 0, 0, 0, 0, 5, 3];
            State::default().next_header(&own)
        };
        assert_ne!(of_flow(1), of_flow(2), "each flow has its own");
        assert_eq!(state.counts(), (2, 0));
        state.retain(|_| true, |topic| topic != "rq/addRequest");
        assert_eq!(state.counts(), (0, 0), "the server has gone");
        assert_eq!(state.take_forwarded(&wire(1)), None);
    }

    #[test]
    fn requests_wait_for_the_reader_of_their_replies_but_not_for_ever() {
        const TOPICS: [&str; 2] = ["rq/addRequest", "rr/addReply"];
        let (begin, mut state) = (Instant::now(), State::default());
        let may_ask = |state: &mut State, ms: u64, known_ms: Option<u64>| {
            let known_for = known_ms.map(Duration::from_millis);
            state.may_ask(begin + Duration::from_millis(ms), TOPICS[0], TOPICS[1], known_for)
        };
        assert!(!may_ask(&mut state, 0, Some(900)), "there is no reader");
        state.note_reader(begin, TOPICS[1], [1; 16], true);
        assert!(!may_ask(&mut state, 199, Some(900)) && !may_ask(&mut state, 900, Some(199)));
        assert!(!may_ask(&mut state, 900, None), "the server has no writer");
        assert!(may_ask(&mut state, 5_000, None), "for so long");
        assert!(may_ask(&mut state, 5_001, Some(200)));
        assert!(!may_ask(&mut state, 6_000, None), "of another server");
        state.note_reader(begin, TOPICS[1], [2; 16], false);
        assert_eq!(state.reader_to_name(TOPICS[1], [8; 16]), Some([1; 16]));
        assert_eq!(state.reader_to_name(TOPICS[1], [9; 16]), None, "numbers may be the same");
        assert_eq!(state.reader_to_name(TOPICS[1], [8; 16]), Some([1; 16]));
        state.note_reader(begin, TOPICS[1], [1; 16], false);
        assert_eq!(state.reader_to_name(TOPICS[1], [8; 16]), None);
    }

    #[test]
    fn a_server_gets_no_more_requests_at_once_than_it_keeps() {
        const TOPIC: &str = "rq/addRequest";
        let (begin, mut state) = (Instant::now(), State::default());
        let wire = |number| OnWire::Related([9; 16], number);
        for number in 1..=MAX_BURST as u64 {
            assert!(state.has_room(begin, TOPIC));
            state.note_forwarded(begin, TOPIC, wire(number as i64), forwarded(number));
        }
        assert!(!state.has_room(begin, TOPIC) && state.has_room(begin, "rq/otherRequest"));
        state.take_forwarded(&wire(3)).unwrap();
        assert!(state.has_room(begin, TOPIC), "one is answered");
        state.note_forwarded(begin, TOPIC, wire(20), forwarded(20));
        assert!(!state.has_room(begin, TOPIC));
        assert!(state.has_room(begin + BURST_PAUSE, TOPIC), "some take long");
        state.retain(|_| true, |_| false);
        assert!(state.burst.is_empty());
    }

    #[test]
    fn of_too_many_requests_of_a_client_the_oldest_is_given_up() {
        let mut state = State::default();
        for number in 1..=MAX_OF_CLIENT as u64 + 2 {
            state.note_asked(Instant::now(), (CLIENT, number), OnWire::Related([1; 16], 1));
        }
        assert_eq!(state.counts(), (MAX_OF_CLIENT, 2));
        assert_eq!(state.asked(&(CLIENT, 2)), None);
        assert!(state.asked(&(CLIENT, 3)).is_some(), "until its reply is written");
        state.note_answered(&(CLIENT, 3));
        assert_eq!(state.asked(&(CLIENT, 3)), None);
        state.note_asked(Instant::now(), (WriterId([2; 16]), 1), OnWire::Related([2; 16], 1));
        state.retain(|client| *client != CLIENT, |_| true);
        assert_eq!(state.counts(), (1, 2), "the client has gone");
        assert_eq!(state.asked.of_client.len(), 1);
    }
}
