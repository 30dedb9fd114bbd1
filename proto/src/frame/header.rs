//! What a publisher says of a message, before it is encoded.

use blaze_domain::{Origin, Priority, WriterId};
use bytes::Bytes;

use crate::{priority_to_wire, v1};

/// What a publisher says of a message; [`Frame::new`](super::Frame::new) encodes it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Header {
    /// User topic.
    pub topic: String,
    /// Where it was born.
    pub origin: Origin,
    /// Publisher.
    pub writer: WriterId,
    /// 1, 2, 3 … per writer.
    pub sequence: u64,
    /// The origin's clock, nanoseconds since 1970.
    pub publish_time_ns: u64,
    /// Media type of the payload.
    pub encoding: String,
    /// Milliseconds after which it is of no use; 0 = none.
    pub lifespan_ms: u32,
    /// Class on the inter scope; absent = not said.
    pub priority: Option<Priority>,
    /// RIHS01 hash of the ROS type, or empty.
    pub type_hash: String,
    /// Flows that wrote it so far.
    pub hops: u32,
    /// Microseconds since it was published, as far as the flows could tell.
    pub age_us: u64,
    /// W3C trace context, or empty.
    pub traceparent: String,
    /// The publisher advertised it as reliable.
    pub reliable: bool,
    /// Samples kept per writer; 0 = volatile.
    pub depth: u32,
    /// Of a reply: writer and sequence of the request that it answers.
    pub related: Option<(WriterId, u64)>,
    /// The flow, `layer/node`, that alone writes it to ROS 2, or empty.
    pub to: String,
}

impl Header {
    /// A header with the parts that every message has; the rest is empty, absent or zero.
    #[must_use]
    pub fn new(
        topic: &str,
        origin: Origin,
        writer: WriterId,
        sequence: u64,
        publish_time_ns: u64,
    ) -> Self {
        Self {
            topic: topic.to_owned(),
            origin,
            writer,
            sequence,
            publish_time_ns,
            encoding: String::new(),
            lifespan_ms: 0,
            priority: None,
            type_hash: String::new(),
            hops: 0,
            age_us: 0,
            traceparent: String::new(),
            reliable: false,
            depth: 0,
            related: None,
            to: String::new(),
        }
    }

    pub(super) fn to_wire(&self) -> v1::MessageHeader {
        let bytes = |writer: &WriterId| Bytes::copy_from_slice(&writer.0);
        v1::MessageHeader {
            topic: self.topic.clone(),
            origin: Some(v1::Origin {
                layer: self.origin.layer.clone(),
                node: self.origin.node.clone(),
                service: self.origin.service.clone(),
                instance: self.origin.instance.clone(),
                epoch: self.origin.epoch,
            }),
            writer: bytes(&self.writer),
            sequence: self.sequence,
            publish_time_ns: self.publish_time_ns,
            encoding: self.encoding.clone(),
            compression: 0,
            uncompressed_bytes: 0,
            lifespan_ms: self.lifespan_ms,
            priority: self.priority.map_or(0, priority_to_wire),
            type_hash: self.type_hash.clone(),
            hops: self.hops,
            age_us: self.age_us,
            traceparent: self.traceparent.clone(),
            reliable: self.reliable,
            depth: self.depth,
            related_writer: self.related.map(|(writer, _)| bytes(&writer)).unwrap_or_default(),
            related_sequence: self.related.map_or(0, |(_, sequence)| sequence),
            to: self.to.clone(),
        }
    }
}
