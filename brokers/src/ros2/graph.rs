//! The graph of ROS 2 nodes: topic `ros_discovery_info`, on which each participant tells its nodes
//! and which readers and writers are theirs.
//!
//! The type is `rmw_dds_common/msg/ParticipantEntitiesInfo`: a gid, and for each node its namespace,
//! its name, the gids of its readers and those of its writers. A gid has 16 bytes, in Humble 24, of
//! which the last eight are 0.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::{BufMut, BytesMut};

use crate::dds::{Cdr, EndpointId, GuidPrefix, participant_of};

/// The DDS topic, and its type.
pub(super) const GRAPH_TOPIC: (&str, &str) =
    ("ros_discovery_info", "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_");

/// Encapsulation of little-endian CDR. Its four bytes do not change what is aligned to four.
const LITTLE: [u8; 4] = [0x00, 0x01, 0x00, 0x00];

/// Bytes of a gid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GidLength {
    /// In Humble.
    Long,
    /// Since Iron.
    Short,
}

impl GidLength {
    fn bytes(self) -> usize {
        match self {
            Self::Long => 24,
            Self::Short => 16,
        }
    }
}

/// Nodes of one participant, readers and writers of one node, and bytes of a name, at most.
const MAX_NODES: usize = 1024;
const MAX_ENDPOINTS: usize = 10_000;
const MAX_NAME: usize = 256;
/// Bytes of a sample: what a participant with 10,000 endpoints tells.
const MAX_BYTES: usize = 256 * 1024;

/// One node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Node {
    /// Begins with a slash.
    pub(super) namespace: String,
    pub(super) name: String,
    pub(super) readers: Vec<EndpointId>,
    pub(super) writers: Vec<EndpointId>,
}

impl Node {
    /// `/arm/talker` of namespace `/arm`, name `talker`.
    pub(super) fn full_name(&self) -> String {
        format!("{}/{}", self.namespace.trim_end_matches('/'), self.name)
    }
}

/// What one participant tells.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ParticipantNodes {
    pub(super) participant: EndpointId,
    pub(super) nodes: Vec<Node>,
}

impl ParticipantNodes {
    /// Reads a sample; gids have the one length or the other. `None` where it is no such message, or
    /// beyond the limits.
    pub(super) fn read(cdr: &Cdr) -> Option<Self> {
        let is_big = cdr.is_big_endian().filter(|_| cdr.body().len() <= MAX_BYTES)?;
        let read = |gid| Input { bytes: cdr.body(), at: 0, is_big, gid }.participant();
        read(GidLength::Short).or_else(|| read(GidLength::Long))
    }

    /// The sample.
    pub(super) fn write(&self, gid: GidLength) -> Option<Cdr> {
        let mut out = Output { bytes: BytesMut::from(&LITTLE[..]), gid };
        out.gid(&self.participant);
        out.length(self.nodes.len());
        for node in &self.nodes {
            out.text(&node.namespace);
            out.text(&node.name);
            for endpoints in [&node.readers, &node.writers] {
                out.length(endpoints.len());
                endpoints.iter().for_each(|endpoint| out.gid(endpoint));
            }
        }
        Cdr::little(out.bytes.freeze())
    }

    /// The full name of the node of each reader and writer that its participant can have.
    pub(super) fn owners(&self, from: GuidPrefix) -> HashMap<EndpointId, Arc<str>> {
        let mut owners = HashMap::new();
        for node in &self.nodes {
            let name: Arc<str> = node.full_name().into();
            let own = |id: &&EndpointId| participant_of(id) == from;
            for id in node.readers.iter().chain(&node.writers).filter(own) {
                if owners.len() < MAX_ENDPOINTS {
                    owners.insert(*id, Arc::clone(&name));
                }
            }
        }
        owners
    }
}

struct Input<'a> {
    bytes: &'a [u8],
    at: usize,
    is_big: bool,
    gid: GidLength,
}

impl Input<'_> {
    fn participant(mut self) -> Option<ParticipantNodes> {
        let participant = self.gid()?;
        let nodes = self.sequence(MAX_NODES, |input| {
            Some(Node {
                namespace: input.text()?,
                name: input.text()?,
                readers: input.sequence(MAX_ENDPOINTS, Self::gid)?,
                writers: input.sequence(MAX_ENDPOINTS, Self::gid)?,
            })
        })?;
        // Up to three bytes of padding follow.
        (self.bytes.len() - self.at < 4).then_some(ParticipantNodes { participant, nodes })
    }

    fn take(&mut self, count: usize) -> Option<&[u8]> {
        let end = self.at.checked_add(count)?;
        let taken = self.bytes.get(self.at..end)?;
        self.at = end;
        Some(taken)
    }

    fn length(&mut self) -> Option<usize> {
        self.at = self.at.next_multiple_of(4);
        let is_big = self.is_big;
        let length = *self.take(4)?.first_chunk::<4>()?;
        let length = if is_big { u32::from_be_bytes(length) } else { u32::from_le_bytes(length) };
        usize::try_from(length).ok()
    }

    fn sequence<T>(
        &mut self,
        limit: usize,
        element: impl Fn(&mut Self) -> Option<T>,
    ) -> Option<Vec<T>> {
        let length = self.length().filter(|length| *length <= limit)?;
        // Not reserved: a length is quickly said.
        (0..length).map(|_| element(self)).collect()
    }

    fn text(&mut self) -> Option<String> {
        let length = self.length().filter(|length| *length <= MAX_NAME)?;
        let (end, text) = self.take(length)?.split_last()?;
        (*end == 0).then(|| String::from_utf8_lossy(text).into_owned())
    }

    fn gid(&mut self) -> Option<EndpointId> {
        let count = self.gid.bytes();
        let (id, rest) = self.take(count)?.split_first_chunk::<16>()?;
        rest.iter().all(|byte| *byte == 0).then_some(*id)
    }
}

struct Output {
    bytes: BytesMut,
    gid: GidLength,
}

impl Output {
    fn length(&mut self, length: usize) {
        self.bytes.put_bytes(0, self.bytes.len().next_multiple_of(4) - self.bytes.len());
        self.bytes.put_u32_le(u32::try_from(length).unwrap_or(u32::MAX));
    }

    fn text(&mut self, text: &str) {
        self.length(text.len() + 1);
        self.bytes.put_slice(text.as_bytes());
        self.bytes.put_u8(0);
    }

    fn gid(&mut self, id: &EndpointId) {
        self.bytes.put_slice(id);
        self.bytes.put_bytes(0, self.gid.bytes() - id.len());
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn nodes() -> ParticipantNodes {
        let node = |namespace: &str, name: &str, first: u8| Node {
            namespace: namespace.to_owned(),
            name: name.to_owned(),
            readers: vec![[first; 16], [first + 1; 16]],
            writers: vec![[first + 2; 16]],
        };
        ParticipantNodes {
            participant: [1; 16],
            nodes: vec![node("/", "talker", 10), node("/arm", "a", 20)],
        }
    }

    fn little(body: &[u8]) -> Cdr {
        Cdr::little([&LITTLE, body].concat().into()).unwrap()
    }

    #[test]
    fn nodes_survive_with_gids_of_either_length() {
        for gid in [GidLength::Short, GidLength::Long] {
            let sample = nodes().write(gid).unwrap();
            assert_eq!(ParticipantNodes::read(&sample), Some(nodes()), "{gid:?}");
        }
        let mut all = HashMap::new();
        for number in [11, 22] {
            let owners = nodes().owners(GuidPrefix([number; 12]));
            assert_eq!(owners.len(), 1, "only what its participant can have");
            all.extend(owners);
        }
        assert_eq!((&*all[&[11; 16]], &*all[&[22; 16]]), ("/talker", "/arm/a"));
        let none = ParticipantNodes { participant: [7; 16], nodes: Vec::new() };
        let sample = none.write(GidLength::Short).unwrap();
        let padded = little(&[sample.body(), &[0xff; 3]].concat());
        assert_eq!(ParticipantNodes::read(&padded), Some(none));
    }

    #[test]
    fn what_is_too_much_is_refused() {
        let is_read = |nodes: &ParticipantNodes| {
            ParticipantNodes::read(&nodes.write(GidLength::Short).unwrap()).is_some()
        };
        let mut many = nodes();
        many.nodes = vec![many.nodes[0].clone(); MAX_NODES + 1];
        assert!(!is_read(&many));
        many.nodes.pop();
        assert!(is_read(&many));
        let mut long = nodes();
        long.nodes[0].name = "n".repeat(MAX_NAME);
        assert!(!is_read(&long));
        let mut large = nodes();
        large.nodes = vec![large.nodes[0].clone(); 5];
        large.nodes[0].readers = vec![[1; 16]; MAX_ENDPOINTS];
        assert!(is_read(&large));
        large.nodes[1].readers = vec![[1; 16]; MAX_ENDPOINTS];
        assert!(!is_read(&large));
    }

    proptest! {
        #[test]
        fn nothing_that_comes_panics(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
            ParticipantNodes::read(&little(&bytes));
        }

        #[test]
        fn one_that_is_damaged_does_not_panic(at in 0_usize..200, with in any::<u8>()) {
            let mut body = nodes().write(GidLength::Short).unwrap().body().to_vec();
            let at = at % body.len();
            body[at] = with;
            ParticipantNodes::read(&little(&body));
        }
    }
}
