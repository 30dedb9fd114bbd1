//! What the rules share: names, frames, waiting.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use blaze_domain::names::ChannelName;
use blaze_domain::{Origin, WriterId};
use blaze_proto::{Frame, Header};
use bytes::Bytes;

use super::Fixture;
use blaze_brokers::port::{
    Broker, Content, Health, PublishOutcome, Publisher, PublisherOptions, Received,
    SubscribeOptions, Subscription,
};

/// What a rule gives: nothing, or what is wrong.
pub(super) type Outcome<T = ()> = Result<T, String>;

/// How long a condition may take to come true; generous, because it is only spent where a rule is
/// broken.
pub(super) const DEADLINE: Duration = Duration::from_secs(20);
/// How long silence must last to count as silence.
pub(super) const SILENCE: Duration = Duration::from_millis(300);

const PROBE_WRITER: WriterId = WriterId([0xFF; 16]);
const PROBE_JSON: &[u8] = br#"{"conformance":"probe"}"#;

/// A channel that no other test uses.
pub(super) fn channel(base: &str) -> Outcome<ChannelName> {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let text = format!("{base}/{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
    text.parse().map_err(|error| format!("channel name {text:?}: {error}"))
}

/// A writer's identity that differs for each number below 255.
pub(super) fn writer(number: u8) -> WriterId {
    WriterId([number; 16])
}

/// A frame with all that must survive.
pub(super) fn frame(
    channel: &ChannelName,
    writer: WriterId,
    sequence: u64,
    payload: Bytes,
) -> Outcome<Frame> {
    frame_to_keep(channel, writer, sequence, payload, 0)
}

/// A frame of a writer that keeps the last `depth`.
fn frame_to_keep(
    channel: &ChannelName,
    writer: WriterId,
    sequence: u64,
    payload: Bytes,
    depth: u32,
) -> Outcome<Frame> {
    let origin = Origin {
        layer: "edge".to_owned(),
        node: "robot-1".to_owned(),
        service: "tester".to_owned(),
        instance: "0".to_owned(),
        epoch: 7,
    };
    let header = Header {
        encoding: "application/octet-stream".to_owned(),
        depth,
        ..Header::new(channel.as_str(), origin, writer, sequence, 1_700_000_000_000_000_000)
    };
    Frame::new(&header, payload).map_err(|error| format!("cannot make a frame: {error}"))
}

/// A small frame whose payload is its sequence.
pub(super) fn numbered(channel: &ChannelName, writer: WriterId, sequence: u64) -> Outcome<Frame> {
    frame(channel, writer, sequence, Bytes::from(sequence.to_string()))
}

/// As [`numbered`], of a writer that keeps the last `depth`.
pub(super) fn numbered_to_keep(
    channel: &ChannelName,
    writer: WriterId,
    sequence: u64,
    depth: u32,
) -> Outcome<Frame> {
    frame_to_keep(channel, writer, sequence, Bytes::from(sequence.to_string()), depth)
}

/// Bytes that look like no frame, differ at each place, and differ for each seed.
pub(super) fn pattern(length: usize, seed: u32) -> Bytes {
    let mut state = seed | 1;
    let mut bytes = Vec::with_capacity(length);
    while bytes.len() < length {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        bytes.push((state >> 24) as u8);
    }
    if let Some(first) = bytes.first_mut() {
        *first = b'x';
    }
    Bytes::from(bytes)
}

/// Waits until a condition holds.
pub(super) async fn eventually(what: &str, holds: impl FnMut() -> bool) -> Outcome {
    eventually_within(DEADLINE, what, holds).await
}

/// As [`eventually`], within a time.
pub(super) async fn eventually_within(
    time: Duration,
    what: &str,
    mut holds: impl FnMut() -> bool,
) -> Outcome {
    let until = Instant::now() + time;
    while !holds() {
        if Instant::now() > until {
            return Err(format!("{what}: not within {} s", time.as_secs()));
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    Ok(())
}

/// Waits for something that may never come.
pub(super) async fn within<F: Future>(what: &str, future: F) -> Outcome<F::Output> {
    tokio::time::timeout(DEADLINE, future)
        .await
        .map_err(|_| format!("{what}: not within {} s", DEADLINE.as_secs()))
}

/// A client that is connected.
pub(super) async fn connected(fixture: &dyn Fixture) -> Outcome<Arc<dyn Broker>> {
    let broker = fixture.broker().await?;
    wait_for_health(broker.as_ref(), Health::Up).await?;
    Ok(broker)
}

/// Waits until a client's status is as given.
pub(super) async fn wait_for_health(broker: &dyn Broker, health: Health) -> Outcome {
    let mut status = broker.status();
    let what = format!("the status of the {} broker becomes {health:?}", broker.kind());
    let seen = within(&what, status.wait_for(|status| status.health == health)).await?.map(|_| ());
    seen.map_err(|_| format!("{what}: the adapter dropped its status before"))
}

pub(super) fn open_publisher(
    broker: &dyn Broker,
    channel: &ChannelName,
) -> Outcome<Arc<dyn Publisher>> {
    open_publisher_with(broker, channel, PublisherOptions::default())
}

pub(super) fn open_publisher_with(
    broker: &dyn Broker,
    channel: &ChannelName,
    options: PublisherOptions,
) -> Outcome<Arc<dyn Publisher>> {
    broker
        .publisher(channel, options)
        .map_err(|error| format!("no publisher for {channel}: {error}"))
}

/// Publishes and insists that it is taken.
pub(super) fn publish(publisher: &dyn Publisher, frame: &Frame) -> Outcome {
    match publisher.publish(frame, None) {
        PublishOutcome::Taken => Ok(()),
        other => Err(format!(
            "message {} of {} was {other:?}, though the server is up",
            frame.sequence(),
            frame.topic()
        )),
    }
}

/// A subscription with deadlines. It leaves out the probes of [`Reader::meet`].
pub(super) struct Reader {
    subscription: Subscription,
    waiting: VecDeque<Received>,
}

impl Reader {
    pub(super) async fn open(broker: &dyn Broker, channel: &ChannelName) -> Outcome<Self> {
        Self::open_with(broker, channel, SubscribeOptions::default()).await
    }

    pub(super) async fn open_with(
        broker: &dyn Broker,
        channel: &ChannelName,
        options: SubscribeOptions,
    ) -> Outcome<Self> {
        let what = format!("subscribing to {channel}");
        let subscription = within(&what, broker.subscribe(channel, options))
            .await?
            .map_err(|error| format!("{what}: {error}"))?;
        Ok(Self { subscription, waiting: VecDeque::new() })
    }

    /// Makes sure that a publisher has found this reader, where that takes time.
    pub(super) async fn meet(
        &mut self,
        fixture: &dyn Fixture,
        publisher: &dyn Publisher,
        bare: bool,
    ) -> Outcome {
        if !fixture.capabilities().finds_readers_late {
            return Ok(());
        }
        let channel = channel("probe")?;
        let until = Instant::now() + DEADLINE;
        for sequence in 1.. {
            if bare {
                publisher.publish_bare(&Bytes::from_static(PROBE_JSON), None);
            } else {
                publisher.publish(&numbered(&channel, PROBE_WRITER, sequence)?, None);
            }
            let mut batch = Vec::new();
            let wait = self.subscription.receive(&mut batch, 64);
            let _ = tokio::time::timeout(Duration::from_millis(50), wait).await;
            if batch.iter().any(is_probe) {
                return self.meet_last(batch, sequence).await;
            }
            // Of another publisher.
            self.waiting.append(&mut VecDeque::from(batch));
            if Instant::now() > until {
                break;
            }
        }
        Err("a publisher never found its reader".to_owned())
    }

    /// Takes the probes by which other readers of the channel met its publishers.
    pub(super) async fn skip_probes(&mut self, fixture: &dyn Fixture) {
        let late = fixture.capabilities().finds_readers_late;
        let mut batch = Vec::new();
        while late
            && tokio::time::timeout(SILENCE, self.subscription.receive(&mut batch, 64))
                .await
                .is_ok_and(|count| count > 0)
        {
            self.waiting.extend(batch.drain(..).filter(|message| !is_probe(message)));
        }
    }

    /// Takes the probes that are still under way: up to the last one, or until there is silence
    /// where they have no number.
    async fn meet_last(&mut self, mut batch: Vec<Received>, last: u64) -> Outcome {
        loop {
            let is_last = |message: &Received| match &message.content {
                Content::Frame(frame) => is_probe(message) && frame.sequence() >= last,
                Content::Bare { .. } | Content::Malformed { .. } => false,
            };
            let ends = batch.iter().any(is_last);
            self.waiting.extend(batch.drain(..).filter(|message| !is_probe(message)));
            let more = self.subscription.receive(&mut batch, 64);
            if ends || tokio::time::timeout(SILENCE, more).await.is_err() {
                return Ok(());
            }
        }
    }

    /// The next message; `None` = the subscription ended.
    pub(super) async fn next_or_end(&mut self, what: &str) -> Outcome<Option<Received>> {
        loop {
            if let Some(message) = self.waiting.pop_front() {
                return Ok(Some(message));
            }
            let mut batch = Vec::new();
            if within(what, self.subscription.receive(&mut batch, 64)).await? == 0 {
                return Ok(None);
            }
            self.waiting.extend(batch.into_iter().filter(|message| !is_probe(message)));
        }
    }

    /// The next message.
    pub(super) async fn next(&mut self, what: &str) -> Outcome<Received> {
        self.next_or_end(what).await?.ok_or_else(|| format!("{what}: the subscription ended"))
    }

    /// The next message, which must be a frame.
    pub(super) async fn next_frame(&mut self, what: &str) -> Outcome<Frame> {
        match self.next(what).await?.content {
            Content::Frame(frame) => Ok(frame),
            other => Err(format!("{what}: a frame was expected, but it was {}", describe(&other))),
        }
    }

    /// The next message, which must be a bare payload.
    pub(super) async fn next_bare(&mut self, what: &str) -> Outcome<Bytes> {
        match self.next(what).await?.content {
            Content::Bare { payload, .. } => Ok(payload),
            other => {
                Err(format!("{what}: a bare payload was expected, but it was {}", describe(&other)))
            }
        }
    }

    /// A message that comes within a moment, if one does.
    pub(super) async fn next_soon(&mut self) -> Outcome<Option<Received>> {
        if self.waiting.is_empty() {
            let mut batch = Vec::new();
            let _ = tokio::time::timeout(SILENCE, self.subscription.receive(&mut batch, 64)).await;
            self.waiting.extend(batch.into_iter().filter(|message| !is_probe(message)));
        }
        Ok(self.waiting.pop_front())
    }

    pub(super) fn take_dropped(&self) -> u64 {
        self.subscription.take_dropped()
    }
}

fn is_probe(message: &Received) -> bool {
    match &message.content {
        Content::Frame(frame) => frame.writer() == PROBE_WRITER,
        Content::Bare { payload, .. } => &payload[..] == PROBE_JSON,
        Content::Malformed { .. } => false,
    }
}

/// What a message is, without its payload.
pub(super) fn describe(content: &Content) -> String {
    match content {
        Content::Frame(frame) => format!("frame {} of writer {}", frame.sequence(), frame.writer()),
        Content::Bare { payload, .. } => format!("a bare payload of {} bytes", payload.len()),
        Content::Malformed { error, bytes } => format!("malformed ({error}), {bytes} bytes"),
    }
}

/// A payload that tells how much memory lives on, wherever it is kept.
pub(super) fn tracked(payload: Vec<u8>, alive: &Arc<AtomicUsize>) -> Bytes {
    struct Tracked(Vec<u8>, Arc<AtomicUsize>);
    impl AsRef<[u8]> for Tracked {
        fn as_ref(&self) -> &[u8] {
            &self.0
        }
    }
    impl Drop for Tracked {
        fn drop(&mut self) {
            self.1.fetch_sub(self.0.len(), Ordering::SeqCst);
        }
    }
    alive.fetch_add(payload.len(), Ordering::SeqCst);
    Bytes::from_owner(Tracked(payload, Arc::clone(alive)))
}
