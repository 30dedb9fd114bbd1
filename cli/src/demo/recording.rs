//! Reads ROS 2 recordings: MCAP files with CDR messages.
//!
//! ```text
//! FILE.mcap ──► messages in the order of their log time, CDR as recorded
//!          └──► camera: CompressedImage with JPEG ──► RGB, decoded at once or just before it is due
//! ```

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use std::time::Duration;

use blaze_domain::media::cdr_of;
use blaze_domain::{Durability, MAX_PAYLOAD_BYTES, NameError, TopicName};
use bytes::Bytes;
use mcap::McapError;
use mcap::io::MessageReader;
use mcap::sans_io::LinearReaderOptions;

use super::camera::{self, Pictures};

/// Largest file, and most bytes of messages, that are kept in memory (2 GiB).
pub const MAX_RECORDING_BYTES: u64 = 2 * 1024 * 1024 * 1024;
/// Most messages of a recording.
pub const MAX_MESSAGES: usize = 10_000_000;
/// Most topics of a recording.
pub const MAX_TOPICS: usize = 1_000;
/// Largest record of an MCAP file, chunks included, compressed or not.
const MAX_RECORD_BYTES: usize = 256 * 1024 * 1024;
/// Longest time without a message while playing: one that is longer in the recording is shortened
/// to it.
pub const MAX_GAP: Duration = Duration::from_secs(10);
/// Loop period of a recording whose messages all have one time.
const SINGLE_PERIOD: Duration = Duration::from_secs(1);

/// Why a file cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// It cannot be opened or read.
    #[error("{}: {error}", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// What the system says.
        error: std::io::Error,
    },
    /// It is larger than what is kept in memory.
    #[error("{}: {bytes} bytes, at most {MAX_RECORDING_BYTES} are played", path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Bytes of the file, or of its messages.
        bytes: u64,
    },
    /// More messages than are kept in memory.
    #[error("{}: more than {MAX_MESSAGES} messages", path.display())]
    TooManyMessages {
        /// The file.
        path: PathBuf,
    },
    /// It is something else.
    #[error("{}: {found}", path.display())]
    NotMcap {
        /// The file.
        path: PathBuf,
        /// What it seems to be, and what to do.
        found: &'static str,
    },
    /// It is an MCAP file with a fault before its first message.
    #[error("{}: {fault}", path.display())]
    Broken {
        /// The file.
        path: PathBuf,
        /// What is wrong, and where.
        fault: Fault,
    },
    /// Nothing in it can be played.
    #[error("{}: nothing to play{}", path.display(), skipped_text(skipped))]
    Empty {
        /// The file.
        path: PathBuf,
        /// What is in it, and why it is not played.
        skipped: Vec<Skipped>,
    },
}

/// Where reading ended before the end of a recording. What was read before is played.
#[derive(Debug, thiserror::Error)]
#[error("after byte {offset} and {messages} messages: {error}")]
pub struct Fault {
    /// Bytes that were read before the fault was seen.
    pub offset: u64,
    /// Messages that were read before it.
    pub messages: usize,
    /// What is wrong.
    pub error: McapError,
}

fn skipped_text(skipped: &[Skipped]) -> String {
    if skipped.is_empty() {
        return ": it holds no messages".to_owned();
    }
    skipped.iter().map(|skipped| format!("\n  {}: {}", skipped.topic, skipped.reason)).collect()
}

/// A topic that is in the file and not played.
#[derive(Debug, Clone, PartialEq)]
pub struct Skipped {
    /// Its name in the file.
    pub topic: String,
    /// Why it is not played.
    pub reason: SkipReason,
}

/// Why a topic is not played.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SkipReason {
    /// Recorded by ROS 1.
    #[error("is a ROS 1 topic; convert the recording: rosbags-convert --src FILE --dst FILE.mcap")]
    Ros1,
    /// Neither CDR nor ROS 1.
    #[error("message encoding {0:?}, only cdr is played")]
    Encoding(String),
    /// No topic of BlazeAIoT may be called so.
    #[error("the name {0}")]
    Name(NameError),
    /// Another topic is played under this name.
    #[error("{0} is played already")]
    Taken(TopicName),
    /// More topics than are played.
    #[error("more than {MAX_TOPICS} topics")]
    TooMany,
}

/// A topic of a recording.
#[derive(Debug, Clone)]
pub struct RecordedTopic {
    /// Name under which it is played: no leading slash; without `/compressed` if it is decoded.
    pub name: TopicName,
    /// ROS type, for example `sensor_msgs/msg/Imu`; empty if the file does not say.
    pub type_name: String,
    /// Media type of the payload.
    pub encoding: String,
    /// Messages of one loop.
    pub messages: usize,
    /// Largest payload, in bytes; for pictures that are decoded while playing, of the first.
    pub max_bytes: usize,
    /// Mean rate over one loop.
    pub rate_hz: f64,
    /// Whether its publisher kept messages for those who came later, as the file says.
    pub durability: Durability,
    /// Mean time between messages.
    mean_gap: Duration,
}

/// One message of a recording.
#[derive(Debug, Clone)]
pub struct RecordedMessage {
    /// Index into [`Recording::topics`].
    pub topic: usize,
    /// When it is due, from the start of the loop.
    pub offset: Duration,
    /// Its payload.
    pub body: Body,
}

/// Payload of a recorded message.
#[derive(Debug, Clone)]
pub enum Body {
    /// As it is published.
    Ready(Bytes),
    /// A JPEG picture, to be decoded just before it is due.
    Jpeg(Bytes),
}

/// A recording that can be played in a loop.
#[derive(Debug, Clone)]
pub struct Recording {
    /// Its file.
    pub path: PathBuf,
    /// Its topics, at least one.
    pub topics: Vec<RecordedTopic>,
    /// Its messages in the order of their offsets, at least one; the first is at 0.
    pub messages: Vec<RecordedMessage>,
    /// Length of one loop: from the first to the last message and one mean gap.
    pub period: Duration,
    /// Topics of the file that are not played.
    pub skipped: Vec<Skipped>,
    /// Messages that are larger than a message may be, or pictures that do not decode.
    pub unusable_messages: u64,
    /// Why the rest of the file is missing, for people.
    pub cut: Option<String>,
    /// Times without a message that were shortened, and the longest.
    pub shortened: (u64, Duration),
    /// The form of its pictures.
    pub pictures: Pictures,
}

/// The recordings that the program carries with it.
const BUILT_IN: [(&str, &[u8]); 2] = [
    ("jackal.mcap", include_bytes!("../../../demo/data/jackal.mcap")),
    ("camera.mcap", include_bytes!("../../../demo/data/camera.mcap")),
];

/// Reads the recordings that the program carries with it: IMU and odometry of a robot, and a
/// camera.
///
/// # Errors
/// None as long as they are whole; they are part of the program.
pub fn load_built_in(pictures: Pictures) -> Result<Vec<Recording>, RecordingError> {
    let mut budget = camera::Budget::default();
    BUILT_IN
        .into_iter()
        .map(|(name, bytes)| {
            let path = Path::new(name);
            let raw = read_records(path, bytes, &[])?;
            raw.prepare(path, pictures, &[], &mut budget)
        })
        .collect()
}

/// Reads recordings that are played together.
///
/// # Errors
/// [`RecordingError`] for the first file that cannot be played.
pub fn load_all(paths: &[PathBuf], pictures: Pictures) -> Result<Vec<Recording>, RecordingError> {
    let mut taken = Vec::new();
    let mut budget = camera::Budget::default();
    let mut recordings = Vec::with_capacity(paths.len());
    for path in paths {
        let raw = read_file(path, &taken)?;
        let recording = raw.prepare(path, pictures, &taken, &mut budget)?;
        taken.extend(recording.topics.iter().map(|topic| topic.name.clone()));
        recordings.push(recording);
    }
    Ok(recordings)
}

/// What a file holds, before pace and pictures are looked at.
#[derive(Debug, Default)]
pub(super) struct RawRecording {
    pub(super) topics: Vec<RawTopic>,
    /// Topic, log time in nanoseconds, payload.
    pub(super) messages: Vec<(usize, u64, Body)>,
    skipped: Vec<Skipped>,
    unusable: u64,
    cut: Option<String>,
}

#[derive(Debug)]
pub(super) struct RawTopic {
    pub(super) name: TopicName,
    pub(super) type_name: String,
    pub(super) encoding: String,
    durability: Durability,
    /// Payload size where it is not yet known from the messages.
    pub(super) decoded_bytes: Option<usize>,
}

/// Counts what has been read, to say where a fault is.
struct Counting<R> {
    inner: R,
    count: u64,
}

impl<R: Read> Read for &mut Counting<R> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let count = self.inner.read(buffer)?;
        self.count += count as u64;
        Ok(count)
    }
}

fn read_file(path: &Path, taken: &[TopicName]) -> Result<RawRecording, RecordingError> {
    let open_error = |error| RecordingError::Open { path: path.to_owned(), error };
    let file = File::open(path).map_err(open_error)?;
    let bytes = file.metadata().map_err(open_error)?.len();
    if bytes > MAX_RECORDING_BYTES {
        return Err(RecordingError::TooLarge { path: path.to_owned(), bytes });
    }
    read_records(path, BufReader::with_capacity(1 << 20, file), taken)
}

fn read_records(
    path: &Path,
    source: impl Read,
    taken: &[TopicName],
) -> Result<RawRecording, RecordingError> {
    let mut source = Counting { inner: source, count: 0 };
    check_magic(path, &mut source.inner)?;
    let options = LinearReaderOptions::default()
        .with_record_length_limit(MAX_RECORD_BYTES)
        .with_skip_start_magic(true);
    let mut reader = MessageReader::new_with_options(&mut source, options);
    let mut raw = RawRecording::default();
    let mut places: HashMap<u16, Option<usize>> = HashMap::new();
    let mut total_bytes = 0u64;
    let fault = loop {
        let message = match reader.next() {
            None => return Ok(raw),
            Some(Err(error)) => break error,
            Some(Ok(message)) => message,
        };
        let place = *places
            .entry(message.channel.id)
            .or_insert_with(|| raw.add_channel(&message.channel, taken));
        let Some(topic) = place else { continue };
        if message.data.len() > MAX_PAYLOAD_BYTES {
            raw.unusable += 1;
            continue;
        }
        total_bytes += message.data.len() as u64;
        if total_bytes > MAX_RECORDING_BYTES {
            return Err(RecordingError::TooLarge { path: path.to_owned(), bytes: total_bytes });
        }
        if raw.messages.len() >= MAX_MESSAGES {
            return Err(RecordingError::TooManyMessages { path: path.to_owned() });
        }
        let body = Body::Ready(Bytes::from(message.data.into_owned()));
        raw.messages.push((topic, message.log_time, body));
    };
    drop(reader);
    let fault = Fault {
        offset: source.count + mcap::MAGIC.len() as u64,
        messages: raw.messages.len(),
        error: fault,
    };
    if raw.messages.is_empty() {
        return Err(RecordingError::Broken { path: path.to_owned(), fault });
    }
    // A recorder that loses power leaves no end.
    raw.cut = Some(fault.to_string());
    Ok(raw)
}

/// What a recorder of ROS 2 noted of the publishers of a channel: whether one of them kept messages
/// for those who came later. It writes the number or, since ROS 2 Iron, the word.
fn durability(channel: &mcap::Channel<'_>) -> Durability {
    let profiles = channel.metadata.get("offered_qos_profiles").map_or("", String::as_str);
    let is_kept = profiles.lines().any(|line| {
        let line = line.trim_start_matches([' ', '-']);
        let value = line.strip_prefix("durability:").map(str::trim);
        matches!(value, Some("1" | "transient_local"))
    });
    if is_kept { Durability::TransientLocal } else { Durability::Volatile }
}

/// Reads the first bytes and says what the file is, if it is not MCAP.
fn check_magic(path: &Path, source: &mut impl Read) -> Result<(), RecordingError> {
    let mut magic = Vec::new();
    source
        .take(mcap::MAGIC.len() as u64)
        .read_to_end(&mut magic)
        .map_err(|error| RecordingError::Open { path: path.to_owned(), error })?;
    let found = match magic.as_slice() {
        found if found == mcap::MAGIC => return Ok(()),
        b"" => "the file is empty",
        found if found.starts_with(b"#ROSBAG") => {
            "is a ROS 1 bag; convert it: rosbags-convert --src FILE.bag --dst FILE.mcap"
        }
        found if found.starts_with(b"SQLite ") => {
            "is a rosbag2 SQLite file; convert it to MCAP: ros2 bag convert"
        }
        _ => "is no MCAP file",
    };
    Err(RecordingError::NotMcap { path: path.to_owned(), found })
}

impl RawRecording {
    /// The topic of a channel: a new one, that of an earlier channel of the same name, or none,
    /// with a note why.
    fn add_channel(&mut self, channel: &mcap::Channel<'_>, taken: &[TopicName]) -> Option<usize> {
        let schema_encoding = channel.schema.as_ref().map_or("", |schema| schema.encoding.as_str());
        let reason = match (channel.message_encoding.as_str(), schema_encoding) {
            ("ros1", _) | (_, "ros1msg") => Err(SkipReason::Ros1),
            ("cdr", _) => channel.topic.trim_start_matches('/').parse().map_err(SkipReason::Name),
            (other, _) => Err(SkipReason::Encoding(other.to_owned())),
        };
        let type_name = channel.schema.as_ref().map_or("", |schema| schema.name.as_str());
        let outcome: Result<usize, SkipReason> = reason.and_then(|name: TopicName| {
            let known = self.topics.iter().position(|topic| topic.name == name);
            match known {
                Some(index) if self.topics[index].type_name == type_name => Ok(index),
                Some(_) => Err(SkipReason::Taken(name)),
                None if taken.contains(&name) => Err(SkipReason::Taken(name)),
                None if self.topics.len() >= MAX_TOPICS => Err(SkipReason::TooMany),
                None => {
                    let encoding = match type_name {
                        "" => "application/cdr".to_owned(),
                        type_name => cdr_of(type_name),
                    };
                    self.topics.push(RawTopic {
                        name,
                        type_name: type_name.to_owned(),
                        encoding,
                        durability: durability(channel),
                        decoded_bytes: None,
                    });
                    Ok(self.topics.len() - 1)
                }
            }
        });
        outcome
            .map_err(|reason| {
                if self.skipped.len() < MAX_TOPICS {
                    self.skipped.push(Skipped { topic: channel.topic.clone(), reason });
                }
            })
            .ok()
    }

    /// Decodes pictures, orders the messages and works out the pace.
    fn prepare(
        mut self,
        path: &Path,
        pictures: Pictures,
        taken: &[TopicName],
        budget: &mut camera::Budget,
    ) -> Result<Recording, RecordingError> {
        self.unusable += camera::decode_topics(&mut self, pictures, taken, budget);
        if self.messages.is_empty() {
            return Err(RecordingError::Empty { path: path.to_owned(), skipped: self.skipped });
        }
        Ok(self.finish(path, pictures))
    }

    /// Orders the messages and works out the pace.
    fn finish(mut self, path: &Path, pictures: Pictures) -> Recording {
        self.messages.sort_by_key(|(_, time, _)| *time);
        let first = self.messages.first().map_or(0, |(_, time, _)| *time);
        let mut paces: BTreeMap<usize, Pace> = BTreeMap::new();
        let (mut before, mut played) = (first, Duration::ZERO);
        let mut shortened = (0, Duration::ZERO);
        let messages: Vec<RecordedMessage> = self
            .messages
            .into_iter()
            .map(|(topic, time, body)| {
                let gap = Duration::from_nanos(time - std::mem::replace(&mut before, time));
                if gap > MAX_GAP {
                    shortened = (shortened.0 + 1, gap.max(shortened.1));
                }
                played += gap.min(MAX_GAP);
                let offset = played;
                let (Body::Ready(bytes) | Body::Jpeg(bytes)) = &body;
                paces.entry(topic).or_default().add(offset, bytes.len());
                RecordedMessage { topic, offset, body }
            })
            .collect();
        let duration = messages.last().map_or(Duration::ZERO, |message| message.offset);
        // Every topic keeps at least its own gap between the last message of a loop and the first
        // of the next.
        let gap = paces.values().filter_map(Pace::mean_gap).max().unwrap_or(SINGLE_PERIOD);
        let gap = gap.min(MAX_GAP);
        let period = duration + gap;
        let topics = self
            .topics
            .into_iter()
            .enumerate()
            .map(|(index, topic)| {
                let pace = paces.get(&index).copied().unwrap_or_default();
                RecordedTopic {
                    name: topic.name,
                    type_name: topic.type_name,
                    encoding: topic.encoding,
                    messages: pace.count,
                    max_bytes: topic.decoded_bytes.unwrap_or(pace.max_bytes),
                    rate_hz: pace.count as f64 / period.as_secs_f64(),
                    durability: topic.durability,
                    mean_gap: pace.mean_gap().unwrap_or(period),
                }
            })
            .collect();
        Recording {
            path: path.to_owned(),
            topics,
            messages,
            period,
            skipped: self.skipped,
            unusable_messages: self.unusable,
            cut: self.cut,
            shortened,
            pictures,
        }
    }
}

impl RecordedTopic {
    /// Mean time between messages.
    #[must_use]
    pub fn mean_gap(&self) -> Duration {
        self.mean_gap
    }
}

/// First and last time, count and largest size of the messages of a topic.
#[derive(Debug, Clone, Copy, Default)]
struct Pace {
    first: Duration,
    last: Duration,
    count: usize,
    max_bytes: usize,
}

impl Pace {
    fn add(&mut self, offset: Duration, bytes: usize) {
        if self.count == 0 {
            self.first = offset;
        }
        self.last = offset;
        self.count += 1;
        self.max_bytes = self.max_bytes.max(bytes);
    }

    /// `None` for a single message, or several at one time.
    fn mean_gap(&self) -> Option<Duration> {
        let gaps = u32::try_from(self.count.checked_sub(1)?).ok()?;
        (self.last - self.first).checked_div(gaps).filter(|gap| !gap.is_zero())
    }
}

#[cfg(test)]
#[path = "recording_tests.rs"]
mod tests;
