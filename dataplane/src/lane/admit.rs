//! The way in of a message from a local scope: its identity, its origin, whether it was seen
//! before, its age.

use std::time::Instant;

use blaze_brokers::{Content, Received};
use blaze_domain::{DropReason, Origin, Scope, WriterId};
use blaze_proto::frame::Compression;
use blaze_proto::{Frame, Header};
use bytes::Bytes;

use super::core::{DataConfig, DataCore};
use super::measure::micros;
use super::path::{TopicId, TopicPath};
use super::reading::For;
use super::window::DuplicateWindow;

/// Clients of one service whose server is remembered.
const MAX_CLIENTS: usize = 1024;

/// Why a message is not taken in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Refusal {
    /// It counts under this reason.
    Dropped(DropReason),
    /// The rules of `flow.access` do not let its origin publish it. It counts as one of a foreign
    /// origin; whoever asks why is told which of the two it was.
    Denied,
}

impl Refusal {
    /// What it counts as.
    pub(super) fn reason(self) -> DropReason {
        match self {
            Self::Dropped(reason) => reason,
            Self::Denied => DropReason::ForeignOrigin,
        }
    }
}

impl From<DropReason> for Refusal {
    fn from(reason: DropReason) -> Self {
        Self::Dropped(reason)
    }
}

/// Where a message stands when it reaches the bridges.
#[derive(Debug)]
pub(super) struct Admitted {
    /// As a broker gets it: with the hop that writing it is, and its age.
    pub(super) frame: Frame,
    /// Flows that wrote it so far, this one not among them.
    pub(super) hops: u32,
    pub(super) born_here: bool,
    pub(super) age_us: u64,
    /// Since it came to this flow.
    pub(super) here_us: u64,
    /// When its age was right.
    pub(super) came: Instant,
    /// Published before its bridges were there: only for those that take what was kept.
    pub(super) kept: bool,
    /// Which bridges it is for.
    pub(super) meant: For,
}

impl Admitted {
    pub(super) fn new(
        now: Instant,
        frame: Frame,
        born_here: bool,
        age_us: u64,
        here_us: u64,
    ) -> Self {
        let hops = frame.hops();
        Self {
            frame: frame.with_hops_and_age(hops.saturating_add(1), age_us),
            hops,
            born_here,
            age_us,
            here_us,
            came: now,
            kept: false,
            meant: For::All,
        }
    }

    /// The same so many microseconds later.
    pub(super) fn older(&self, by_us: u64) -> Self {
        let age_us = self.age_us.saturating_add(by_us);
        Self {
            frame: self.frame.clone().with_hops_and_age(self.frame.hops(), age_us),
            age_us,
            here_us: self.here_us.saturating_add(by_us),
            ..*self
        }
    }
}

impl DataCore {
    pub(super) fn check_local(
        &mut self,
        now: Instant,
        wall_ns: u64,
        topic: TopicId,
        from: Scope,
        received: Received,
        meant: For,
    ) -> Result<Admitted, Refusal> {
        let (at, kept) = (received.at, received.kept);
        let waited_us = received.broker_age_us + micros(now.saturating_duration_since(at));
        let (frame, bare) = match received.content {
            Content::Malformed { .. } => return Err(DropReason::DecodeError.into()),
            Content::Frame(frame) => (frame, false),
            Content::Bare { payload, identity } => (
                self.wrap(
                    wall_ns.saturating_sub(waited_us * 1000),
                    topic,
                    from,
                    payload,
                    identity,
                )?,
                true,
            ),
        };
        if frame.topic() != self.path(topic).name.as_str() {
            return Err(DropReason::DecodeError.into());
        }
        if frame.compression() != Compression::None {
            // Of the inter scope alone: no consumer of a broker would know what to do with it.
            return Err(DropReason::DecodeError.into());
        }
        let born_here = frame.hops() == 0;
        let of_flow = matches!(from, Scope::Node | Scope::Ros2);
        if of_flow && !born_here {
            // Only this flow writes to its node scope, and what it writes carries hops. Writers of
            // flows on the ROS 2 network are not read.
            return Err(DropReason::Echo.into());
        }
        let me = &self.config.me;
        let own_layer = frame.origin_layer() == me.layer.as_str();
        let own_node = frame.origin_node() == me.node.as_str();
        let foreign = match from {
            Scope::Node | Scope::Ros2 => !(own_layer && own_node),
            Scope::Layer | Scope::Inter => born_here && !own_layer,
        };
        // Before the window takes the number: a foreign message must not silence the writer whose
        // name it bears.
        if foreign {
            return Err(DropReason::ForeignOrigin.into());
        }
        if !self.path(topic).info.takes(&frame) {
            return Err(Refusal::Denied);
        }
        // What is read again was noted the first time; the flow that gets it drops what it had.
        if meant != For::Outside && !self.is_new(topic, &frame) {
            // What a flow has written carries hops; a publisher that repeats itself does not.
            let repeat = if born_here { DropReason::Duplicate } else { DropReason::Echo };
            return Err(repeat.into());
        }
        let frame = if born_here { self.addressed(topic, frame)? } else { frame };
        let mut age_us = frame.age_us().saturating_add(waited_us);
        if from == Scope::Node && !bare {
            // One host, one clock: the publisher's time tells what nobody could measure.
            age_us = age_us.max(wall_ns.saturating_sub(frame.publish_time_ns()) / 1000);
        }
        let path = &mut self.topics[topic.0 as usize];
        let bytes = frame.payload().len() as u64;
        path.largest_bytes = path.largest_bytes.max(bytes);
        path.in_rate.add(now, bytes);
        let here_us = micros(now.saturating_duration_since(at));
        Ok(Admitted { kept, meant, ..Admitted::new(now, frame, born_here, age_us, here_us) })
    }

    /// A request to a service is for the flow of one server.
    fn addressed(&mut self, topic: TopicId, frame: Frame) -> Result<Frame, DropReason> {
        let TopicPath { info, clients, .. } = self.path_mut(topic);
        if info.servers.is_empty() || !frame.to().is_empty() {
            return Ok(frame);
        }
        let client = frame.writer();
        let Some(server) = info.servers.choose(client, clients.get(&client)) else {
            return Ok(frame);
        };
        let to = server.to_string();
        if clients.len() >= MAX_CLIENTS {
            // They are chosen again, mostly as before.
            clients.clear();
        }
        clients.insert(client, server.clone());
        frame.with_to(&to).map_err(|_| DropReason::TooLarge)
    }

    /// Gives a bare payload its header.
    fn wrap(
        &mut self,
        publish_time_ns: u64,
        topic: TopicId,
        from: Scope,
        payload: Bytes,
        identity: Option<(WriterId, u64)>,
    ) -> Result<Frame, DropReason> {
        let config = &self.config;
        let path = &mut self.topics[topic.0 as usize];
        let (writer, sequence) = identity.unwrap_or_else(|| {
            let (writer, sequence) = path
                .bare
                .entry(from)
                .or_insert_with(|| (bare_writer(config, from, path.name.as_str(), path.life), 0));
            *sequence += 1;
            (*writer, *sequence)
        });
        let info = path.info.bare(from);
        let node = if from == Scope::Node { config.me.node.to_string() } else { String::new() };
        let origin = Origin {
            layer: config.me.layer.to_string(),
            node,
            service: info.service.clone(),
            instance: info.instance.clone(),
            epoch: config.epoch,
        };
        let header = Header {
            encoding: info.encoding.clone(),
            lifespan_ms: info.lifespan_ms,
            priority: info.priority,
            reliable: info.reliable,
            depth: info.depth,
            ..Header::new(path.name.as_str(), origin, writer, sequence, publish_time_ns)
        };
        Frame::new(&header, payload).map_err(|_| DropReason::TooLarge)
    }

    pub(super) fn is_new(&mut self, topic: TopicId, frame: &Frame) -> bool {
        self.note_sequence(topic, frame, DuplicateWindow::insert)
    }

    /// The same of a message that came over the link. One that is older than the newest of its
    /// writer comes too late, seen or not: it would be written behind newer ones. That is so where
    /// another flow begins to carry the topic, a second back so that nothing is missed, and sends
    /// what the one before it could not. It is not so of what is kept for late joiners.
    pub(super) fn is_new_here(&mut self, now: Instant, topic: TopicId, frame: &Frame) -> bool {
        if frame.depth() > 0 {
            // Its flow was away for so long that it counted as gone: those who join late would
            // never get what it sends again.
            if self.kept.takes_again(now, topic, frame.writer()) {
                self.windows.pop(&(topic, frame.writer()));
            }
            return self.is_new(topic, frame);
        }
        self.note_sequence(topic, frame, DuplicateWindow::insert_newer)
    }

    fn note_sequence(
        &mut self,
        topic: TopicId,
        frame: &Frame,
        insert: fn(&mut DuplicateWindow, u64) -> bool,
    ) -> bool {
        let key = (topic, frame.writer());
        if let Some(window) = self.windows.get_mut(&key) {
            return insert(window, frame.sequence());
        }
        if self.windows.len() == self.windows.cap().get() {
            self.evicted_writers += 1;
        }
        let mut window = DuplicateWindow::default();
        window.insert(frame.sequence());
        self.windows.put(key, window);
        true
    }
}

/// Writer of bare messages that this flow numbers: new at each start of the flow, and where a topic
/// is there again that was forgotten, as its numbers begin again.
fn bare_writer(config: &DataConfig, from: Scope, topic: &str, life: u64) -> WriterId {
    use sha2::{Digest, Sha256};
    let text = format!(
        "{from}|{}|{}|{topic}|{}|{}|{life}",
        config.me.layer, config.me.node, config.epoch, config.salt
    );
    let digest = Sha256::digest(text.as_bytes());
    let mut id = [0; 16];
    id.copy_from_slice(&digest[..16]);
    WriterId(id)
}
