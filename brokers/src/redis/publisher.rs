//! What publishers hand over, as the commands that are sent.
//!
//! ```text
//! publisher ─► Gate: outbox ─► Writer: batches of PUBLISH, some under way at once ─► answers settle messages
//! ```
//!
//! What was handed to the server once is never sent again: unanswered when the connection is lost,
//! it counts as dropped.

use std::sync::Arc;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use blaze_domain::DropReason;
use blaze_domain::names::ChannelName;
use blaze_proto::Frame;
use bytes::Bytes;
use redis::{Cmd, RedisWrite, ToRedisArgs};

use super::kept::{KeptFrame, Mirror};
use super::settings::Names;
use super::state::Line;
use crate::outbox::{Body, Fate, Receipt, Waiting};
use crate::port::PublisherOptions;

/// Where a publisher's messages go.
#[derive(Debug)]
pub(super) struct Target {
    channel: Arc<str>,
    kept: Option<KeptTarget>,
}

#[derive(Debug)]
struct KeptTarget {
    hash: Arc<str>,
    depth: usize,
}

impl Target {
    pub(super) fn new(names: &Names, channel: &ChannelName, options: PublisherOptions) -> Self {
        Self {
            channel: names.channel(channel),
            kept: (options.depth > 0).then(|| KeptTarget {
                hash: names.last(channel),
                depth: usize::try_from(options.depth).unwrap_or(usize::MAX),
            }),
        }
    }
}

/// Head and payload as one argument: the only copy between the queue and the library.
struct TwoParts<'a>(&'a [u8], &'a [u8]);

impl ToRedisArgs for TwoParts<'_> {
    fn write_redis_args<W: ?Sized + RedisWrite>(&self, out: &mut W) {
        use std::io::Write as _;
        let mut argument = out.writer_for_next_arg();
        // Writing to memory cannot fail.
        let _ = argument.write_all(self.0);
        let _ = argument.write_all(self.1);
    }
}

fn publish_command(channel: &str, head: &[u8], payload: &[u8]) -> Cmd {
    const NAME: &str = "PUBLISH";
    let mut command =
        Cmd::with_capacity(3, NAME.len() + channel.len() + head.len() + payload.len());
    command.arg(NAME).arg(channel).arg(TwoParts(head, payload));
    command
}

pub(super) fn hset_command<V: ToRedisArgs>(hash: &str, field: &str, value: V, size: usize) -> Cmd {
    const NAME: &str = "HSET";
    let mut command = Cmd::with_capacity(4, NAME.len() + hash.len() + field.len() + size);
    command.arg(NAME).arg(hash).arg(field).arg(value);
    command
}

/// Commands that are sent together.
pub(super) struct Batch {
    pub(super) pipeline: redis::Pipeline,
    /// Which answer settles which message.
    pub(super) receipts: Vec<(usize, Receipt)>,
    pub(super) bytes: usize,
}

impl Batch {
    pub(super) fn with_capacity(commands: usize) -> Self {
        Self {
            pipeline: redis::Pipeline::with_capacity(commands),
            receipts: Vec::with_capacity(commands),
            bytes: 0,
        }
    }

    fn add(&mut self, command: Cmd, bytes: usize) {
        self.pipeline.add_command(command);
        self.bytes += bytes;
    }

    /// Adds a message: what is kept of its writer first, then the message itself.
    pub(super) fn publish(&mut self, waiting: Waiting<Target>, keeper: &Keeper<'_>, now: Instant) {
        let to = Arc::clone(&waiting.to);
        match &waiting.body {
            Body::Bare(payload) => {
                self.add(publish_command(&to.channel, &[], payload), payload.len());
            }
            Body::Frame(frame) => {
                let frame = Waiting::<Target>::aged(frame, waiting.since, now);
                let head = frame.head_to_write();
                if let Some(kept) = &to.kept {
                    self.keep(keeper, &to, kept, &head, &frame);
                }
                let command = publish_command(&to.channel, &head, frame.payload());
                self.add(command, head.len() + frame.payload().len());
            }
        }
        self.receipts.push((self.pipeline.len() - 1, waiting.into_receipt()));
    }

    fn keep(
        &mut self,
        keeper: &Keeper<'_>,
        to: &Arc<Target>,
        kept: &KeptTarget,
        head: &Bytes,
        frame: &Frame,
    ) {
        let key = (Arc::clone(&kept.hash), frame.writer());
        let newest = KeptFrame {
            written_ns: unix_time_ns(),
            head: head.clone(),
            payload: frame.payload().clone(),
            line: keeper.line,
            publisher: Arc::downgrade(to),
        };
        let mut mirror = keeper.mirror.lock();
        if let Some(field) = mirror.keep(&key, newest, kept.depth) {
            let size = field.size();
            self.add(hset_command(&kept.hash, &frame.writer().to_string(), field, size), size);
        }
    }

    /// Adds a field that the server has lost. Returns whether there was one.
    pub(super) fn rewrite(&mut self, keeper: &Keeper<'_>) -> bool {
        let mut mirror = keeper.mirror.lock();
        let Some(((hash, writer), field)) = mirror.next_to_rewrite(keeper.line) else {
            return false;
        };
        let size = field.size();
        self.add(hset_command(&hash, &writer.to_string(), field, size), size);
        true
    }

    /// Settles the messages by the answers. Returns what the server said no to, and why.
    pub(super) fn settle(self, answers: &[redis::Value]) -> Refusals {
        let mut refusals = Refusals::default();
        for (index, receipt) in self.receipts {
            match answers.get(index) {
                Some(redis::Value::ServerError(_)) | None => {
                    receipt.settle(Fate::Dropped(DropReason::BrokerError));
                }
                Some(_) => receipt.settle(Fate::Delivered),
            }
        }
        for answer in answers {
            if let redis::Value::ServerError(error) = answer {
                refusals.count += 1;
                refusals.last.get_or_insert_with(|| error.to_string());
            }
        }
        refusals
    }
}

/// What the server said no to.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Refusals {
    pub(super) count: u64,
    pub(super) last: Option<String>,
}

/// Where what is kept for late joiners is remembered.
pub(super) struct Keeper<'a> {
    pub(super) mirror: &'a parking_lot::Mutex<Mirror>,
    pub(super) line: Line,
}

/// The clock of this host, which is that of all clients of a node's broker.
pub(super) fn unix_time_ns() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    use super::super::kept::read_field;
    use crate::outbox::{Outbox, OutboxLimits};
    use blaze_domain::{Origin, WriterId};
    use blaze_proto::Header;
    use parking_lot::Mutex;

    const LIMITS: OutboxLimits =
        OutboxLimits { lane_messages: 100, lane_bytes: 100_000, total_bytes: 100_000 };

    fn frame(sequence: u64) -> Frame {
        let header = Header::new("t", Origin::default(), WriterId([1; 16]), sequence, 0);
        Frame::new(&header, Bytes::from_static(b"payload")).unwrap()
    }

    fn target(depth: u32) -> Target {
        let options = PublisherOptions { depth, ..PublisherOptions::default() };
        Target::new(&Names::new("p:"), &"t".parse().unwrap(), options)
    }

    fn arguments(command: &Cmd) -> Vec<Vec<u8>> {
        command
            .args_iter()
            .map(|argument| match argument {
                redis::Arg::Simple(bytes) => bytes.to_vec(),
                _ => Vec::new(),
            })
            .collect()
    }

    #[test]
    fn a_message_is_one_argument_with_the_age_it_has_when_written() {
        let outbox = Outbox::new(LIMITS);
        let lane = outbox.lane(target(0), None);
        lane.push(Body::Frame(frame(7).with_hops_and_age(2, 1_000)), None);
        let mut taken = Vec::new();
        outbox.take(Instant::now(), 10, 10_000, &mut taken);
        let waiting = taken.pop().unwrap();
        let later = waiting.since + Duration::from_millis(5);
        let mirror = Mutex::new(Mirror::default());
        let keeper = Keeper { mirror: &mirror, line: Line::PublishSmall };
        let mut batch = Batch::with_capacity(1);
        batch.publish(waiting, &keeper, later);
        let commands: Vec<_> = batch.pipeline.cmd_iter().map(arguments).collect();
        assert_eq!(commands.len(), 1);
        assert_eq!((&commands[0][0][..], &commands[0][1][..]), (&b"PUBLISH"[..], &b"p:t"[..]));
        let written = Frame::parse(Bytes::from(commands[0][2].clone())).unwrap();
        assert_eq!((written.sequence(), written.hops(), written.age_us()), (7, 2, 6_000));
        assert_eq!(written.payload(), frame(7).payload());
    }

    #[test]
    fn what_is_kept_is_written_before_the_message_and_answers_settle_the_right_ones() {
        let outbox = Outbox::new(LIMITS);
        let (keeping, plain) = (outbox.lane(target(2), None), outbox.lane(target(0), None));
        let before = unix_time_ns();
        keeping.push(Body::Frame(frame(1)), None);
        plain.push(Body::Bare(Bytes::from_static(b"x")), None);
        let mut taken = Vec::new();
        outbox.take(Instant::now(), 10, 10_000, &mut taken);
        let mirror = Mutex::new(Mirror::default());
        let keeper = Keeper { mirror: &mirror, line: Line::PublishSmall };
        let mut batch = Batch::with_capacity(3);
        for waiting in taken {
            batch.publish(waiting, &keeper, Instant::now());
        }
        let names: Vec<_> =
            batch.pipeline.cmd_iter().map(|command| arguments(command)[0].clone()).collect();
        assert_eq!(names, [b"HSET".to_vec(), b"PUBLISH".to_vec(), b"PUBLISH".to_vec()]);
        let field = batch.pipeline.cmd_iter().next().map(arguments).unwrap()[3].clone();
        let (kept, _) = read_field(Bytes::from(field), WriterId([1; 16]));
        assert!((before..=unix_time_ns()).contains(&kept[0].0), "late joiners sort by it");
        let no: redis::Value = redis::parse_redis_value(b"-NOPERM no\r\n").unwrap();
        let refusals = batch.settle(&[redis::Value::Int(1), redis::Value::Int(0), no]);
        assert_eq!(refusals.count, 1);
        assert!(refusals.last.unwrap().contains("no"));
        assert_eq!((keeping.later().queued, keeping.later().dropped()), (0, 0));
        assert_eq!((plain.later().queued, plain.later().broker_error), (0, 1));
    }
}
