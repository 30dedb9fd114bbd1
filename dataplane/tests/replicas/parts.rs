//! The parts of the simulated system: what brokers keep, what flies, who lives.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::{Content, Later, PublishOutcome, Publisher};
use blaze_domain::{FlowId, Priority, Scope, TopicName};
use blaze_flow::control::ControlCore;
use blaze_flow::flow::plane::PlaneState;
use blaze_flow::link::transport::Endpoint;
use blaze_proto::Frame;
use bytes::Bytes;
use parking_lot::Mutex;

/// How a replica ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum End {
    Stopped,
    Killed,
}

/// What came of all messages.
#[derive(Debug, Default)]
pub(crate) struct Found {
    pub(crate) sent_up: usize,
    pub(crate) sent_down: usize,
    pub(crate) lost_up: usize,
    pub(crate) lost_down: usize,
    /// Written twice under one identity.
    pub(crate) twice_up: usize,
    pub(crate) twice_down: usize,
    /// Repeats that the robot's flow dropped.
    pub(crate) repeats_down: u64,
    /// Replicas that carry the topic to the robot now.
    pub(crate) carriers: usize,
    pub(crate) handed_over: u64,
    /// What services on the replicas' own nodes missed or got twice while their flow lived.
    pub(crate) holes: usize,
}

/// A record on Kafka or a message on Redis.
#[derive(Clone)]
pub(crate) struct Record {
    pub(crate) content: Content,
    pub(crate) at: Instant,
    /// The flow that wrote it, on the channel of flows.
    pub(crate) by: usize,
}

/// Channels that keep what is written.
pub(crate) type Log = Arc<Mutex<BTreeMap<String, Vec<Record>>>>;

pub(crate) struct LogWriter {
    pub(crate) log: Log,
    pub(crate) channel: String,
    pub(crate) clock: Arc<Mutex<Instant>>,
}

impl Publisher for LogWriter {
    fn publish(&self, frame: &Frame, _: Option<Instant>) -> PublishOutcome {
        let record = Record {
            content: Content::Frame(frame.clone()),
            at: *self.clock.lock(),
            by: usize::MAX,
        };
        self.log.lock().entry(self.channel.clone()).or_default().push(record);
        PublishOutcome::Taken
    }
    fn publish_bare(&self, _: &Bytes, _: Option<Instant>) -> PublishOutcome {
        PublishOutcome::Taken
    }
    fn later(&self) -> Later {
        Later::default()
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Life {
    Alive,
    /// It takes in nothing more, since then.
    Draining(Instant),
    /// It has said good-bye, then.
    Gone(Instant),
    Dead,
}

pub(crate) struct Flow {
    pub(crate) id: FlowId,
    pub(crate) epoch: u64,
    pub(crate) life: Life,
    pub(crate) control: ControlCore,
    pub(crate) plane: PlaneState,
    /// Position of the next message, of each topic that is read.
    pub(crate) reads: BTreeMap<(TopicName, Scope), usize>,
    pub(crate) peers: usize,
    /// On the inter scope.
    pub(crate) inside: bool,
    pub(crate) was_inside: bool,
    /// When it has said good-bye there.
    pub(crate) leaves: Option<Instant>,
    /// When it was last measured what it carries.
    pub(crate) measured: Instant,
}

/// A topic of the cloud that the robot asks for.
pub(crate) struct Stream {
    pub(crate) topic: TopicName,
    pub(crate) bytes: usize,
    pub(crate) period: Duration,
    pub(crate) next: Instant,
    pub(crate) sent: u64,
}

pub(crate) struct Packet {
    pub(crate) to: Endpoint,
    pub(crate) class: Priority,
    pub(crate) datagram: Bytes,
}

/// The channel of a topic: each flow has a node scope of its own, and the replicas share Kafka.
pub(crate) fn channel(index: usize, scope: Scope, topic: &str) -> String {
    match scope {
        Scope::Layer => topic.to_owned(),
        Scope::Node | Scope::Inter => format!("{index}/{topic}"),
    }
}
