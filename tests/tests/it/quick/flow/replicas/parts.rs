//! The parts of the simulated system: what brokers keep, what flies, who lives.

use std::collections::{BTreeMap, VecDeque};
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
use rand::RngExt;
use rand::rngs::StdRng;

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
    /// Written to Kafka behind a newer one.
    pub(crate) late_up: usize,
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

/// A server that keeps a log, and stands still at times: then what is written waits with whoever
/// writes it.
#[derive(Clone, Default)]
pub(crate) struct Server {
    pub(crate) log: Log,
    state: Arc<Mutex<Standing>>,
}

#[derive(Default)]
struct Standing {
    frozen_since: Option<Instant>,
    /// By flow and number of the writer: channel and record, oldest first.
    waiting: BTreeMap<(usize, u64), VecDeque<(String, Record)>>,
    writers: u64,
}

impl Server {
    pub(crate) fn writer(
        &self,
        flow: usize,
        channel: String,
        clock: &Arc<Mutex<Instant>>,
    ) -> LogWriter {
        let mut state = self.state.lock();
        state.writers += 1;
        LogWriter {
            server: self.clone(),
            key: (flow, state.writers),
            channel,
            clock: Arc::clone(clock),
        }
    }

    pub(crate) fn freeze(&self, now: Instant) {
        self.state.lock().frozen_since = Some(now);
    }

    /// What waited is written: each writer's in order, those of several in any.
    pub(crate) fn thaw(&self, now: Instant, random: &mut StdRng) {
        let mut state = self.state.lock();
        state.frozen_since = None;
        let mut log = self.log.lock();
        while !state.waiting.is_empty() {
            let at = random.random_range(0..state.waiting.len());
            let Some(key) = state.waiting.keys().nth(at).copied() else {
                break;
            };
            match state.waiting.get_mut(&key).and_then(VecDeque::pop_front) {
                Some((channel, record)) => {
                    log.entry(channel).or_default().push(Record { at: now, ..record });
                }
                None => drop(state.waiting.remove(&key)),
            }
        }
    }

    /// What waited with a flow that was killed is lost.
    pub(crate) fn forget(&self, flow: usize) {
        self.state.lock().waiting.retain(|key, _| key.0 != flow);
    }

    /// Until when what was written can be read now.
    pub(crate) fn readable(&self, now: Instant) -> Instant {
        self.state.lock().frozen_since.unwrap_or(now)
    }
}

pub(crate) struct LogWriter {
    server: Server,
    key: (usize, u64),
    channel: String,
    clock: Arc<Mutex<Instant>>,
}

impl Publisher for LogWriter {
    fn publish(&self, frame: &Frame, _: Option<Instant>) -> PublishOutcome {
        let record = Record {
            content: Content::Frame(frame.clone()),
            at: *self.clock.lock(),
            by: usize::MAX,
        };
        let (channel, mut state) = (self.channel.clone(), self.server.state.lock());
        if state.frozen_since.is_some() {
            state.waiting.entry(self.key).or_default().push_back((channel, record));
        } else {
            self.server.log.lock().entry(channel).or_default().push(record);
        }
        PublishOutcome::Taken
    }
    fn publish_bare(&self, _: &Bytes, _: Option<Instant>) -> PublishOutcome {
        PublishOutcome::Taken
    }
    fn later(&self) -> Later {
        let queued = self.server.state.lock().waiting.get(&self.key).map_or(0, VecDeque::len);
        Later { queued: queued as u64, ..Later::default() }
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
    /// Its reader of Kafka stands still.
    pub(crate) deaf: bool,
    /// What it says to other replicas gets lost.
    pub(crate) mute: bool,
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
        Scope::Node | Scope::Ros2 | Scope::Inter => format!("{index}/{topic}"),
    }
}
