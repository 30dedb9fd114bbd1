//! Readers of a participant that read what it writes itself, on loopback.
//!
//! RustDDS 0.15 matches a writer with readers of its own participant that are there before it is,
//! but sends them nothing where there is no multicast: it takes an address on loopback only of those
//! from whom datagrams came, and passes over its own. Nor do they hear of the writer. So they would
//! acknowledge nothing, and a reliable writer stand still for good as soon as its window is full.
//! Here it is acknowledged in their name. What a participant writes it does not need from its
//! readers.

use std::collections::HashMap;
use std::io;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicI32, Ordering};

use bytes::BufMut;
use nix::ifaddrs::getifaddrs;
use nix::net::if_::InterfaceFlags;
use nix::sys::socket::SockaddrIn;
use parking_lot::Mutex;

use super::GuidPrefix;
use super::rtps::{FLAG_LITTLE_ENDIAN, OWN_HEADER};
use super::writer::EndpointId;

const ACKNACK: u8 = 0x06;
/// No answer is needed.
const FLAG_FINAL: u8 = 0x02;
const ACKNACK_LENGTH: u16 = 24;

/// Identity of a reader or writer within its participant.
type EntityId = [u8; 4];

/// Reliable readers of one participant.
#[derive(Debug)]
pub(super) struct OwnReaders {
    socket: UdpSocket,
    /// Where the participant takes data.
    to: SocketAddrV4,
    prefix: GuidPrefix,
    /// RustDDS passes over an acknowledgement with the number of the one before.
    number: AtomicI32,
    by_topic: Mutex<HashMap<String, Vec<EntityId>>>,
}

/// Ends when its reader does.
#[derive(Debug)]
pub(crate) struct OwnReader {
    all: Arc<OwnReaders>,
    topic: String,
    id: EntityId,
}

impl Drop for OwnReader {
    fn drop(&mut self) {
        let mut by_topic = self.all.by_topic.lock();
        if let Some(readers) = by_topic.get_mut(&self.topic) {
            readers.retain(|id| *id != self.id);
            if readers.is_empty() {
                by_topic.remove(&self.topic);
            }
        }
    }
}

impl OwnReaders {
    /// `None` where RustDDS reaches them.
    pub(super) fn unreached(
        address: Ipv4Addr,
        port: u16,
        prefix: GuidPrefix,
    ) -> io::Result<Option<Self>> {
        if !address.is_loopback() || has_multicast(address) {
            return Ok(None);
        }
        let socket = UdpSocket::bind((address, 0))?;
        socket.set_nonblocking(true)?;
        let (to, number) = (SocketAddrV4::new(address, port), AtomicI32::new(0));
        Ok(Some(Self { socket, to, prefix, number, by_topic: Mutex::default() }))
    }

    /// Adds a reader.
    pub(super) fn add(self: Arc<Self>, topic: &str, reader: &EndpointId) -> OwnReader {
        let (topic, id) = (topic.to_owned(), entity(reader));
        self.by_topic.lock().entry(topic.clone()).or_default().push(id);
        OwnReader { all: self, topic, id }
    }

    /// Acknowledges what a writer has written, in the name of all readers of its topic. RustDDS
    /// passes over those that it has not matched with the writer.
    pub(super) fn acknowledge(&self, topic: &str, writer: &EndpointId, last: i64) {
        let by_topic = self.by_topic.lock();
        for reader in by_topic.get(topic).into_iter().flatten() {
            let number = self.number.fetch_add(1, Ordering::Relaxed);
            let message = acknowledgement(self.prefix, *reader, entity(writer), last, number);
            // One that is lost is followed by the next.
            let _ = self.socket.send_to(&message, self.to);
        }
    }
}

fn entity(endpoint: &EndpointId) -> EntityId {
    let [.., a, b, c, d] = *endpoint;
    [a, b, c, d]
}

fn has_multicast(address: Ipv4Addr) -> bool {
    getifaddrs().is_ok_and(|mut interfaces| {
        interfaces.any(|it| {
            let own = it.address.and_then(|address| address.as_sockaddr_in().map(SockaddrIn::ip));
            own == Some(address) && it.flags.contains(InterfaceFlags::IFF_MULTICAST)
        })
    })
}

fn acknowledgement(
    prefix: GuidPrefix,
    reader: EntityId,
    writer: EntityId,
    last: i64,
    number: i32,
) -> Vec<u8> {
    let mut message = Vec::with_capacity(48);
    message.put_slice(&OWN_HEADER);
    message.put_slice(&prefix.0);
    message.put_u8(ACKNACK);
    message.put_u8(FLAG_LITTLE_ENDIAN | FLAG_FINAL);
    message.put_u16_le(ACKNACK_LENGTH);
    message.put_slice(&reader);
    message.put_slice(&writer);
    // The first one that is not acknowledged; its upper word stands before the lower one.
    message.put_u64_le(last.saturating_add(1).cast_unsigned().rotate_left(32));
    // None is asked for again.
    message.put_u32_le(0);
    message.put_i32_le(number);
    message
}

#[cfg(test)]
mod tests {
    use std::thread;
    use std::time::{Duration, Instant};

    use rustdds::WriteOptionsBuilder;

    use super::*;
    use crate::dds::{Cdr, FRAME_TYPE, Participant, ParticipantConfig, Profile, Written};

    const DOMAIN: u16 = 37;
    const DEADLINE: Duration = Duration::from_secs(30);

    fn eventually(what: &str, mut is_so: impl FnMut() -> bool) {
        let until = Instant::now() + DEADLINE;
        while !is_so() {
            assert!(Instant::now() < until, "{what}: not within {DEADLINE:?}");
            thread::sleep(Duration::from_millis(2));
        }
    }

    #[test]
    fn a_writer_is_not_held_up_by_a_reader_of_its_participant() {
        let config = ParticipantConfig::new(DOMAIN, Ipv4Addr::LOCALHOST);
        let participant = Participant::start(config).unwrap();
        let profile = Profile { reliable: true, window: 32, ..Profile::best_effort(16) };
        let topic = format!("own/{}", participant.prefix());
        // RustDDS matches both when the reader is there before the writer is.
        let reader = participant.raw_reader((&topic, FRAME_TYPE), profile).unwrap();
        let writer = participant.writer(&topic, profile).unwrap();
        eventually("matched", || writer.is_matched());
        for number in 0..100 {
            let cdr = || Cdr::little(vec![0, 1, 0, 0, number].into()).unwrap();
            let write = || writer.write_cdr(cdr(), WriteOptionsBuilder::new());
            eventually("written", || matches!(write(), Written::Taken(_)));
        }
        eventually("acknowledged", || writer.is_acknowledged());
        drop(reader);
    }

    #[test]
    fn an_acknowledgement_names_the_first_that_is_missing() {
        let prefix = GuidPrefix(*b"abcdefghijkl");
        let message = acknowledgement(prefix, *b"read", *b"writ", (3 << 32) + 7, 5);
        assert_eq!(message.len(), 24 + usize::from(ACKNACK_LENGTH));
        assert_eq!(&message[8..20], b"abcdefghijkl");
        assert_eq!(&message[24..32], b"readwrit");
        assert_eq!(&message[32..40], &[3, 0, 0, 0, 8, 0, 0, 0]);
        assert_eq!(&message[40..], &[0, 0, 0, 0, 5, 0, 0, 0]);
    }

    #[test]
    fn a_reader_that_has_gone_acknowledges_nothing() {
        let all = OwnReaders::unreached(Ipv4Addr::LOCALHOST, 9, GuidPrefix([0; 12])).unwrap();
        let all = Arc::new(all.expect("loopback has no multicast"));
        let [one, other] = [1, 2].map(|id| Arc::clone(&all).add("a", &[id; 16]));
        drop(one);
        assert_eq!(all.by_topic.lock()["a"], [[2; 4]]);
        drop(other);
        assert!(all.by_topic.lock().is_empty());
    }
}
