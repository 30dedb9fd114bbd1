//! What the server says of itself and its topics.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use rdkafka::consumer::{BaseConsumer, Consumer as _};
use rdkafka::error::{KafkaError, RDKafkaErrorCode};
use rdkafka::metadata::{Metadata, MetadataTopic};
use rdkafka::{Offset, TopicPartitionList};

use super::context::ReadContext;
use super::identity::{Identities, TopicUuid};
use super::inner::Shared;

/// How often the log is looked at for an identity that is not there yet, and the pause between.
const IDENTITY_TURNS: usize = 10;
const IDENTITY_PAUSE: Duration = Duration::from_millis(1);
/// Lines of a client's log that are served at once, at most.
const LINES: usize = 100_000;
/// How long to wait before a question is asked again that could not be answered yet.
const AGAIN: Duration = Duration::from_millis(20);

/// A topic as the server has it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct TopicInfo {
    /// Its identity, where the server gives one.
    pub(super) uuid: Option<TopicUuid>,
    /// How many partitions it has.
    pub(super) partitions: usize,
}

/// Where a partition begins and ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Marks {
    /// Offset of the first record that is still there.
    pub(super) low: i64,
    /// Offset of the next record.
    pub(super) high: i64,
}

impl Marks {
    /// Whether a reader that is to read this record next can do so.
    pub(super) fn holds(&self, next: i64) -> bool {
        (self.low..=self.high.max(self.low)).contains(&next)
    }
}

/// Why there is no answer about a topic.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(super) enum LookupError {
    /// There is no such topic.
    #[error("there is no topic {0}")]
    Missing(String),
    /// The server did not answer, or not yet.
    #[error("{0}")]
    Away(String),
    /// The broker was closed by us.
    #[error("closed")]
    Closed,
}

impl From<KafkaError> for LookupError {
    fn from(error: KafkaError) -> Self {
        Self::Away(error.to_string())
    }
}

/// The server and all its topics, as one answer has them.
#[derive(Debug, Clone, Default)]
pub(super) struct Listing {
    /// Brokers of the cluster.
    pub(super) brokers: usize,
    /// Topics and their partitions; those that are asked for alone if not all were.
    pub(super) topics: HashMap<String, usize>,
}

type Client = BaseConsumer<ReadContext>;

/// A client that only asks, so that its answers never wait behind records.
pub(super) struct Directory {
    shared: Arc<Shared>,
    client: Mutex<Option<Arc<Client>>>,
    identities: Arc<Identities>,
    /// One look-up at a time: the log that holds the identity is read by one.
    turn: Mutex<()>,
}

impl Directory {
    pub(super) fn new(shared: &Arc<Shared>) -> Result<Self, KafkaError> {
        let directory = Self {
            shared: Arc::clone(shared),
            client: Mutex::default(),
            identities: Arc::default(),
            turn: Mutex::default(),
        };
        *directory.client.lock() = Some(directory.connect()?);
        Ok(directory)
    }

    fn connect(&self) -> Result<Arc<Client>, KafkaError> {
        let context = ReadContext::new(&self.identities, &self.shared.last_error);
        let made = self.shared.settings.questions().create_with_context(context);
        made.map(Arc::new)
    }

    /// Begins anew with a client that knows nothing. Blocks while the old one ends.
    pub(super) fn remake(&self) -> Result<(), KafkaError> {
        let made = self.connect()?;
        // Once closed it stays closed.
        let old = self.client.lock().as_mut().map(|client| std::mem::replace(client, made));
        drop(old);
        Ok(())
    }

    fn client(&self) -> Result<Arc<Client>, LookupError> {
        self.client.lock().clone().ok_or(LookupError::Closed)
    }

    /// Asks for all topics, or for one. Waits for the answer.
    pub(super) fn list(
        &self,
        topic: Option<&str>,
        timeout: Duration,
    ) -> Result<Listing, LookupError> {
        let client = self.client()?;
        let metadata = client.fetch_metadata(topic, timeout);
        serve(&client);
        let metadata = metadata?;
        let good =
            |topic: &&MetadataTopic| topic.error().is_none() && !topic.partitions().is_empty();
        let topics = metadata.topics().iter().filter(good);
        Ok(Listing {
            brokers: metadata.brokers().len(),
            topics: topics
                .map(|topic| (topic.name().to_owned(), topic.partitions().len()))
                .collect(),
        })
    }

    /// The identity of the cluster, if it is known soon.
    pub(super) fn cluster(&self) -> Option<String> {
        self.client().ok()?.client().fetch_cluster_id(Duration::from_millis(200))
    }

    /// Looks a topic up. Waits for the answer.
    pub(super) fn topic(&self, topic: &str, timeout: Duration) -> Result<TopicInfo, LookupError> {
        let client = self.client()?;
        let _turn = self
            .turn
            .try_lock_for(timeout)
            .ok_or_else(|| LookupError::Away("too many questions at once".to_owned()))?;
        let metadata = client.fetch_metadata(Some(topic), timeout)?;
        let partitions = partitions_of(&metadata, topic)?;
        // What the log says of the identity was queued before the answer.
        let mut turns = 0;
        loop {
            serve(&client);
            turns += 1;
            if self.identities.of(topic).is_some() || turns == IDENTITY_TURNS {
                break;
            }
            std::thread::sleep(IDENTITY_PAUSE);
        }
        Ok(TopicInfo { uuid: self.identities.of(topic), partitions })
    }

    /// What is known of a topic's identity without asking.
    pub(super) fn known_identity(&self, topic: &str) -> Option<TopicUuid> {
        self.identities.of(topic)
    }

    /// Where the partitions of a topic begin and end now. Waits for the answers.
    pub(super) fn marks(
        &self,
        topic: &str,
        partitions: usize,
        deadline: Instant,
    ) -> Result<Vec<Marks>, LookupError> {
        let client = self.client()?;
        let mark = |partition: usize| loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let number = i32::try_from(partition).unwrap_or(i32::MAX);
            match client.fetch_watermarks(topic, number, left.max(IDENTITY_PAUSE)) {
                Ok((low, high)) => return Ok(Marks { low, high }),
                Err(error) if is_passing(&error) && left > AGAIN => std::thread::sleep(AGAIN),
                Err(error) => return Err(error.into()),
            }
        };
        (0..partitions).map(mark).collect()
    }

    /// The first offset of each partition whose record the server took at that time of its clock,
    /// in milliseconds since 1970, or later; `None` where there is none. Waits for the answer.
    pub(super) fn since(
        &self,
        topic: &str,
        partitions: usize,
        appended_ms: i64,
        timeout: Duration,
    ) -> Result<Vec<Option<i64>>, LookupError> {
        let mut asked = TopicPartitionList::new();
        for partition in (0..).take(partitions) {
            asked.add_partition_offset(topic, partition, Offset::Offset(appended_ms))?;
        }
        let answer = self.client()?.offsets_for_times(asked, timeout)?;
        let offset = |partition: i32| match answer.find_partition(topic, partition)?.offset() {
            Offset::Offset(offset) => Some(offset),
            _ => None,
        };
        Ok((0..).take(partitions).map(offset).collect())
    }

    /// Ends it. Blocks while the client ends.
    pub(super) fn close(&self) {
        let client = self.client.lock().take();
        drop(client);
    }
}

/// Serves all that there is of a client's log and errors. Without a time to wait, the client serves
/// one line a call; with one, it spins through the last millisecond.
fn serve(client: &Client) {
    let context = client.context();
    for _ in 0..LINES {
        let before = context.served();
        client.poll(Duration::ZERO);
        if context.served() == before {
            break;
        }
    }
}

/// A topic that was just made has no leader for a moment.
pub(super) fn is_passing(error: &KafkaError) -> bool {
    matches!(
        error.rdkafka_error_code(),
        Some(
            RDKafkaErrorCode::NotLeaderForPartition
                | RDKafkaErrorCode::LeaderNotAvailable
                | RDKafkaErrorCode::UnknownTopicOrPartition
        )
    )
}

fn partitions_of(metadata: &Metadata, name: &str) -> Result<usize, LookupError> {
    let Some(topic) = metadata.topics().iter().find(|topic| topic.name() == name) else {
        return Err(LookupError::Missing(name.to_owned()));
    };
    match topic.error().map(RDKafkaErrorCode::from) {
        None if topic.partitions().is_empty() => Err(LookupError::Missing(name.to_owned())),
        None => Ok(topic.partitions().len()),
        Some(RDKafkaErrorCode::UnknownTopicOrPartition | RDKafkaErrorCode::UnknownTopic) => {
            Err(LookupError::Missing(name.to_owned()))
        }
        Some(error) => Err(LookupError::Away(format!("topic {name}: {error}"))),
    }
}
