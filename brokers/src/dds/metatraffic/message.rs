//! Announcements as RustDDS gets them, and what RustDDS sends as others get it.

use std::collections::HashSet;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::time::Duration;

use bytes::BufMut;

use super::GuidPrefix;
use crate::dds::rtps::{
    Data, FLAG_INLINE_QOS, FLAG_KEY, FLAG_LITTLE_ENDIAN, INFO_DST, INFO_SRC, Message, SPDP_WRITER,
    Submessage, after_parameters, read_u32,
};

/// Writers of discovery: of participants, writers and readers.
const WRITERS: [[u8; 4]; 3] = [SPDP_WRITER, [0, 0, 3, 0xc2], [0, 0, 4, 0xc2]];
const PID_LEASE: u16 = 0x0002;
const PID_METATRAFFIC_UNICAST: u16 = 0x0032;
const PID_METATRAFFIC_MULTICAST: u16 = 0x0033;
const PID_PARTICIPANT_GUID: u16 = 0x0050;
const PID_ENDPOINT_GUID: u16 = 0x005a;
const PID_KEY_HASH: u16 = 0x0070;
const PID_SENTINEL: u16 = 0x0001;
const LOCATOR_UDP_V4: u32 = 1;
const LOCATOR_LENGTH: u16 = 24;
const PID_STATUS_INFO: u16 = 0x0071;
/// Disposed and unregistered, in any byte order.
const DISPOSED: [u8; 4] = [0, 0, 0, 3];
/// RustDDS keeps what it has told of all of them. Further ones are there for late joiners until
/// they hear the contrary.
const MAX_GONE: usize = 100_000;
/// Where nothing is told.
const DEFAULT_LEASE: Duration = Duration::from_secs(100);

/// What a participant announces.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Announced {
    pub(super) lease: Duration,
    /// Where it takes metatraffic.
    pub(super) addresses: Vec<SocketAddrV4>,
}

/// A message with an announcement, or a good-bye.
pub(super) struct Spdp<'a> {
    message: Message<'a>,
    submessages: Vec<Submessage<'a>>,
    pub(super) prefix: GuidPrefix,
    /// `None`: a good-bye.
    pub(super) announced: Option<Announced>,
}

impl<'a> Spdp<'a> {
    /// `None` for all else, and for what is malformed.
    pub(super) fn parse(datagram: &'a [u8]) -> Option<Self> {
        let message = Message::parse(datagram)?;
        let submessages: Vec<_> = message.submessages().collect::<Option<_>>()?;
        let mut data = submessages.iter().filter_map(Submessage::data);
        let spdp = data.rfind(|it| it.writer == SPDP_WRITER)?;
        let announced = match spdp.is_announcement() {
            true => Some(Announced::read(&spdp)?),
            false => None,
        };
        Some(Self { message, submessages, prefix: message.prefix(), announced })
    }

    /// The same, for RustDDS. `sender`: who it is to be of, `None` its true one; what is in it is
    /// of the true one in any case. `metatraffic`: where the participant shall take metatraffic.
    pub(super) fn repeated(
        &self,
        sender: Option<GuidPrefix>,
        metatraffic: Option<SocketAddrV4>,
    ) -> Option<Vec<u8>> {
        let header = self.message.header;
        let mut out = Vec::with_capacity(1024);
        out.put_slice(&header[..8]);
        out.put_slice(&sender.unwrap_or(self.prefix).0);
        out.put_slice(&[INFO_SRC, FLAG_LITTLE_ENDIAN, 20, 0, 0, 0, 0, 0]);
        out.put_slice(&header[4..]);
        for submessage in &self.submessages {
            match (submessage.data().filter(Data::is_announcement), metatraffic) {
                (Some(data), Some(to)) if data.writer == SPDP_WRITER => {
                    let payload = with_metatraffic(&data, to)?;
                    put(&mut out, *submessage, &[data.head, data.inline, &payload])?;
                }
                _ => out.put_slice(submessage.whole),
            }
        }
        Some(out)
    }
}

impl Announced {
    fn read(data: &Data<'_>) -> Option<Self> {
        let (mut locators, mut lease) = (Vec::new(), None);
        let is_little = data.visit_payload(|id, value| match id {
            PID_METATRAFFIC_UNICAST => locators.push(value),
            PID_LEASE => lease = Some(value),
            _ => {}
        })?;
        let lease = lease.and_then(|value| read_u32(value, is_little));
        Some(Self {
            lease: lease.map_or(DEFAULT_LEASE, |seconds| Duration::from_secs(seconds.into())),
            addresses: locators.into_iter().filter_map(|it| address(it, is_little)).collect(),
        })
    }

    /// Where it is best reached. `from`: where the announcement came from.
    pub(super) fn reached_at(&self, from: Ipv4Addr) -> Vec<SocketAddrV4> {
        let is_here = from.is_loopback();
        let only = |wanted: &dyn Fn(&SocketAddrV4) -> bool| -> Vec<SocketAddrV4> {
            self.addresses.iter().copied().filter(wanted).collect()
        };
        let loopback = only(&|it| is_here && it.ip().is_loopback());
        let source = only(&|it| !is_here && *it.ip() == from);
        let others = only(&|it| !it.ip().is_loopback());
        let best = [loopback, source, others].into_iter().find(|it| !it.is_empty());
        best.unwrap_or_default()
    }
}

/// An address that one participant can have.
fn address(locator: &[u8], is_little: bool) -> Option<SocketAddrV4> {
    let ip = Ipv4Addr::from(*locator.get(20..)?.first_chunk::<4>()?);
    let port = u16::try_from(read_u32(&locator[4..], is_little)?).ok()?;
    let is_one = !(ip.is_unspecified() || ip.is_multicast() || ip.is_broadcast() || port == 0);
    (is_one && read_u32(locator, is_little)? == LOCATOR_UDP_V4)
        .then_some(SocketAddrV4::new(ip, port))
}

/// The payload of an announcement with one place for metatraffic.
fn with_metatraffic(data: &Data<'_>, to: SocketAddrV4) -> Option<Vec<u8>> {
    let is_little = data.payload.get(1)? & 1 != 0;
    let mut locator = Vec::with_capacity(LOCATOR_LENGTH.into());
    put_u32(&mut locator, LOCATOR_UDP_V4, is_little);
    put_u32(&mut locator, to.port().into(), is_little);
    locator.put_bytes(0, 12);
    locator.put_slice(&to.ip().octets());
    let mut payload = data.payload[..4].to_vec();
    put_parameter(&mut payload, PID_METATRAFFIC_UNICAST, &locator, is_little)?;
    let mut whole = Some(());
    data.visit_payload(|id, value| {
        if !matches!(id, PID_METATRAFFIC_UNICAST | PID_METATRAFFIC_MULTICAST) {
            whole = whole.and_then(|()| put_parameter(&mut payload, id, value, is_little));
        }
    })?;
    whole?;
    put_parameter(&mut payload, PID_SENTINEL, &[], is_little)?;
    Some(payload)
}

/// What RustDDS sends to the metatraffic of others.
pub(super) struct Outgoing {
    pub(super) datagram: Vec<u8>,
    /// To which of them it goes; empty: to all.
    pub(super) to: Vec<GuidPrefix>,
}

/// Own participants, readers and writers that have ceased.
#[derive(Default)]
pub(super) struct Gone(HashSet<[u8; 16]>);

impl Outgoing {
    /// Adds the hashes of keys where something ceases, and lets what has ceased cease again where
    /// RustDDS tells late joiners that it was there. `None` for what is not of `own`, and for what
    /// is malformed.
    pub(super) fn amend(datagram: &[u8], own: GuidPrefix, gone: &mut Gone) -> Option<Self> {
        let message = Message::parse(datagram).filter(|it| it.prefix() == own)?;
        let submessages: Vec<_> = message.submessages().collect::<Option<_>>()?;
        let mut to = Vec::new();
        for submessage in &submessages {
            if submessage.kind == INFO_DST {
                to.push(GuidPrefix(*submessage.body.first_chunk()?));
            }
            gone.0.extend(key(submessage).filter(|(data, _)| data.is_end()).map(|(_, key)| key));
        }
        if gone.0.len() > MAX_GONE {
            gone.0.clear();
        }
        let mut out = Vec::with_capacity(datagram.len() + 256);
        out.put_slice(message.header);
        for submessage in &submessages {
            match amended(submessage, gone) {
                Some(amended) => out.put_slice(&amended),
                None => out.put_slice(submessage.whole),
            }
        }
        Some(Self { datagram: out, to })
    }
}

/// What a DATA of discovery is about.
fn key<'a>(submessage: &Submessage<'a>) -> Option<(Data<'a>, [u8; 16])> {
    let data = submessage.data().filter(|it| WRITERS.contains(&it.writer))?;
    let wanted = if data.writer == SPDP_WRITER { PID_PARTICIPANT_GUID } else { PID_ENDPOINT_GUID };
    let mut key = None;
    // RustDDS leaves the end of this list out where something ceases.
    let _ = data.visit_payload(|id, value| {
        if id == wanted {
            key = value.try_into().ok();
        }
    });
    key.map(|key| (data, key))
}

/// The submessage as it is to be, if it changes.
fn amended(submessage: &Submessage<'_>, gone: &Gone) -> Option<Vec<u8>> {
    let is_little = submessage.is_little();
    let (data, key) = key(submessage)?;
    let (mut inline, mut out) = (Vec::new(), Vec::new());
    put_parameter(&mut inline, PID_KEY_HASH, &key, is_little)?;
    if data.is_end() {
        let mut has_hash = false;
        after_parameters(data.inline, is_little, |id, _| has_hash |= id == PID_KEY_HASH)?;
        if has_hash {
            return None;
        }
        inline.put_slice(data.inline);
        put(&mut out, *submessage, &[data.head, &inline, data.payload])?;
    } else if gone.0.contains(&key) {
        put_parameter(&mut inline, PID_STATUS_INFO, &DISPOSED, is_little)?;
        put_parameter(&mut inline, PID_SENTINEL, &[], is_little)?;
        let mut payload = data.payload.get(..4)?.to_vec();
        let is_little = payload[1] & 1 != 0;
        put_parameter(&mut payload, PID_ENDPOINT_GUID, &key, is_little)?;
        put_parameter(&mut payload, PID_SENTINEL, &[], is_little)?;
        let flags = submessage.flags & FLAG_LITTLE_ENDIAN | FLAG_INLINE_QOS | FLAG_KEY;
        put(&mut out, Submessage { flags, ..*submessage }, &[data.head, &inline, &payload])?;
    } else {
        return None;
    }
    Some(out)
}

/// Puts a submessage with another body; `None` where it would be too long.
fn put(out: &mut Vec<u8>, like: Submessage<'_>, body: &[&[u8]]) -> Option<()> {
    let length = u16::try_from(body.iter().map(|part| part.len()).sum::<usize>()).ok()?;
    out.put_slice(&[like.kind, like.flags]);
    put_u16(out, length, like.is_little());
    body.iter().for_each(|part| out.put_slice(part));
    Some(())
}

fn put_parameter(out: &mut Vec<u8>, id: u16, value: &[u8], is_little: bool) -> Option<()> {
    put_u16(out, id, is_little);
    put_u16(out, u16::try_from(value.len()).ok()?, is_little);
    out.put_slice(value);
    Some(())
}

fn put_u16(out: &mut Vec<u8>, value: u16, is_little: bool) {
    if is_little { out.put_u16_le(value) } else { out.put_u16(value) }
}

fn put_u32(out: &mut Vec<u8>, value: u32, is_little: bool) {
    if is_little { out.put_u32_le(value) } else { out.put_u32(value) }
}
