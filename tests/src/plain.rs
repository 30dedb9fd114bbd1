//! Clients that know nothing of BlazeAIoT: what any service with a Kafka or Redis library does.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use anyhow::Context;
use parking_lot::Mutex;
use rdkafka::admin::{AdminClient, AdminOptions, NewTopic, TopicReplication};
use rdkafka::client::DefaultClientContext;
use rdkafka::consumer::{BaseConsumer, Consumer as _};
use rdkafka::error::KafkaError;
use rdkafka::message::{Header, Headers as _, Message as _, OwnedHeaders};
use rdkafka::producer::{BaseProducer, BaseRecord, DeliveryResult, Producer as _, ProducerContext};
use rdkafka::topic_partition_list::{Offset, TopicPartitionList};
use rdkafka::types::RDKafkaErrorCode;
use rdkafka::{ClientConfig, ClientContext};
use redis::{IntoConnectionInfo as _, ProtocolVersion, PushKind};
use serde_json::Value;

/// How long a Redis may take to answer on a busy machine.
const ANSWER: Duration = Duration::from_secs(10);

/// A record as a plain consumer sees it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Record {
    /// The value.
    pub payload: Vec<u8>,
    /// The key.
    pub key: Vec<u8>,
    /// Headers as text.
    pub headers: BTreeMap<String, String>,
    /// Place in the topic.
    pub offset: i64,
}

impl Record {
    /// The value as text.
    #[must_use]
    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.payload).into_owned()
    }

    /// A header, or an empty text.
    #[must_use]
    pub fn header(&self, name: &str) -> &str {
        self.headers.get(name).map_or("", String::as_str)
    }
}

/// A plain consumer of one partition, without a group.
pub struct KafkaReader {
    consumer: BaseConsumer,
}

impl KafkaReader {
    /// Reads a topic from its end, once the topic is there.
    ///
    /// # Errors
    /// When the topic is not there within ten seconds.
    pub fn from_end(bootstrap: &str, topic: &str) -> anyhow::Result<Self> {
        Self::open(bootstrap, topic, |_, end| end)
    }

    /// Reads a topic from what it still has, once it is there.
    ///
    /// # Errors
    /// As [`KafkaReader::from_end`].
    pub fn from_beginning(bootstrap: &str, topic: &str) -> anyhow::Result<Self> {
        Self::open(bootstrap, topic, |beginning, _| beginning)
    }

    fn open(bootstrap: &str, topic: &str, start: fn(i64, i64) -> i64) -> anyhow::Result<Self> {
        let consumer: BaseConsumer = client(bootstrap)
            .set("group.id", "plain")
            .set("enable.auto.commit", "false")
            .set("fetch.wait.max.ms", "50")
            .set("fetch.message.max.bytes", "17825792")
            .set("reconnect.backoff.max.ms", "200")
            .create()?;
        let until = Instant::now() + Duration::from_secs(10);
        let offset = loop {
            match consumer.fetch_watermarks(topic, 0, Duration::from_secs(2)) {
                Ok((beginning, end)) => break start(beginning, end),
                Err(error) if Instant::now() > until => {
                    return Err(error).context(topic.to_owned());
                }
                Err(_) => std::thread::sleep(Duration::from_millis(20)),
            }
        };
        let mut partitions = TopicPartitionList::new();
        partitions.add_partition_offset(topic, 0, Offset::Offset(offset))?;
        consumer.assign(&partitions)?;
        Ok(Self { consumer })
    }

    /// The next record within a time. Errors of a broker that is away are waited out.
    #[must_use]
    pub fn next(&self, within: Duration) -> Option<Record> {
        let until = Instant::now() + within;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            match self
                .consumer
                .poll(left.min(Duration::from_millis(50)).max(Duration::from_millis(1)))
            {
                Some(Ok(message)) => {
                    let mut headers = BTreeMap::new();
                    for header in message.headers().into_iter().flat_map(|headers| headers.iter()) {
                        let value =
                            String::from_utf8_lossy(header.value.unwrap_or_default()).into_owned();
                        headers.insert(header.key.to_owned(), value);
                    }
                    return Some(Record {
                        payload: message.payload().unwrap_or_default().to_vec(),
                        key: message.key().unwrap_or_default().to_vec(),
                        headers,
                        offset: message.offset(),
                    });
                }
                Some(Err(_)) | None if left.is_zero() => return None,
                Some(Err(_)) | None => {}
            }
        }
    }
}

/// A plain connection to Redis.
///
/// # Errors
/// When the server does not answer within ten seconds.
pub fn connect(url: &str) -> anyhow::Result<redis::Connection> {
    Ok(redis::Client::open(url)?.get_connection_with_timeout(ANSWER)?)
}

/// Publishes on a Redis channel, as `redis-cli publish` does. Gives how many heard it.
///
/// # Errors
/// When the server does not answer within ten seconds.
pub fn publish(url: &str, channel: &str, payload: &[u8]) -> anyhow::Result<i64> {
    let mut command = redis::cmd("PUBLISH");
    Ok(command.arg(channel).arg(payload).query(&mut connect(url)?)?)
}

/// A control message to the flow on a node's Redis.
///
/// # Errors
/// As [`publish`], and when others than the flow alone hear it.
pub fn tell_redis(url: &str, prefix: &str, message: &Value) -> anyhow::Result<()> {
    let heard =
        publish(url, &format!("{prefix}blaze/flow/control"), message.to_string().as_bytes())?;
    anyhow::ensure!(heard == 1, "{heard} heard a control message instead of the flow alone");
    Ok(())
}

/// A control message to the flows on a layer's Kafka.
///
/// # Errors
/// As [`KafkaWriter::produce`].
pub fn tell_kafka(writer: &KafkaWriter, prefix: &str, message: &Value) -> anyhow::Result<()> {
    writer.produce(&format!("{prefix}blaze.flow.control"), message.to_string().as_bytes())
}

/// A subscriber of one Redis channel that knows nothing of frames.
pub struct RedisReader {
    connection: redis::Connection,
}

impl RedisReader {
    /// Subscribes to a channel, prefix included.
    ///
    /// # Errors
    /// When the server does not answer within ten seconds.
    pub fn new(url: &str, channel: &str) -> anyhow::Result<Self> {
        let info = url.into_connection_info()?;
        // In RESP2 the client library takes a message for the late answer to a read that timed out,
        // and skips it.
        let settings = info.redis_settings().clone().set_protocol(ProtocolVersion::RESP3);
        let client = redis::Client::open(info.set_redis_settings(settings))?;
        let mut connection = client.get_connection_with_timeout(ANSWER)?;
        connection.set_read_timeout(Some(ANSWER))?;
        connection
            .send_packed_command(&redis::cmd("SUBSCRIBE").arg(channel).get_packed_command())?;
        connection.recv_response()?;
        connection.set_read_timeout(Some(Duration::from_millis(50)))?;
        Ok(Self { connection })
    }

    /// The next payload; `None` if none comes within 50 ms.
    ///
    /// # Errors
    /// When the connection is lost.
    pub fn poll(&mut self) -> anyhow::Result<Option<Vec<u8>>> {
        loop {
            match self.connection.recv_response() {
                Ok(redis::Value::Push { kind: PushKind::Message, data }) => {
                    if let Some(redis::Value::BulkString(payload)) = data.into_iter().nth(1) {
                        return Ok(Some(payload));
                    }
                }
                Ok(_) => {}
                Err(error) if error.is_timeout() => return Ok(None),
                Err(error) => return Err(error.into()),
            }
        }
    }

    /// The next payload within a time.
    ///
    /// # Errors
    /// As [`RedisReader::poll`].
    pub fn next(&mut self, within: Duration) -> anyhow::Result<Option<Vec<u8>>> {
        let until = Instant::now() + within;
        loop {
            let payload = self.poll()?;
            if payload.is_some() || Instant::now() >= until {
                return Ok(payload);
            }
        }
    }

    /// The next payload as JSON.
    ///
    /// # Errors
    /// When none comes in time, or something else.
    pub fn next_json(&mut self, within: Duration) -> anyhow::Result<serde_json::Value> {
        let payload =
            self.next(within)?.with_context(|| format!("nothing came within {within:?}"))?;
        Ok(serde_json::from_slice(&payload)?)
    }
}

/// A plain producer.
pub struct KafkaWriter {
    producer: BaseProducer<Deliveries>,
}

/// Notes the last record that did not arrive.
#[derive(Default)]
struct Deliveries {
    failed: Mutex<Option<KafkaError>>,
}

impl ClientContext for Deliveries {}

impl ProducerContext for Deliveries {
    type DeliveryOpaque = ();

    fn delivery(&self, result: &DeliveryResult<'_>, (): ()) {
        if let Err((error, _)) = result {
            *self.failed.lock() = Some(error.clone());
        }
    }
}

impl KafkaWriter {
    /// Connects.
    ///
    /// # Errors
    /// When the client library refuses.
    pub fn new(bootstrap: &str) -> anyhow::Result<Self> {
        let producer = client(bootstrap)
            .set("linger.ms", "0")
            .set("message.max.bytes", "17825792")
            // A server that makes many topics at once takes seconds for a record.
            .set("message.timeout.ms", "20000")
            .set("reconnect.backoff.max.ms", "200")
            .create_with_context(Deliveries::default())?;
        Ok(Self { producer })
    }

    /// Produces a value and waits until it is there.
    ///
    /// # Errors
    /// When it is not acknowledged in time.
    pub fn produce(&self, topic: &str, payload: &[u8]) -> anyhow::Result<()> {
        self.produce_later(topic, payload)?;
        self.delivered()
    }

    fn delivered(&self) -> anyhow::Result<()> {
        self.producer.flush(Duration::from_secs(25))?;
        match self.producer.context().failed.lock().take() {
            None => Ok(()),
            Some(error) => Err(error).context("a record was not taken by Kafka"),
        }
    }

    /// Produces a value with headers and waits until it is there.
    ///
    /// # Errors
    /// As [`KafkaWriter::produce`].
    pub fn produce_with(
        &self,
        topic: &str,
        payload: &[u8],
        headers: &[(&str, &[u8])],
    ) -> anyhow::Result<()> {
        let mut all = OwnedHeaders::new();
        for (key, value) in headers {
            all = all.insert(Header { key, value: Some(*value) });
        }
        self.producer
            .send(BaseRecord::<'_, (), [u8]>::to(topic).payload(payload).headers(all))
            .map_err(|(error, _)| error)?;
        self.delivered()
    }

    /// Produces a value and does not wait.
    ///
    /// # Errors
    /// When the client's queue is full.
    pub fn produce_later(&self, topic: &str, payload: &[u8]) -> anyhow::Result<()> {
        self.producer
            .send(BaseRecord::<'_, (), [u8]>::to(topic).payload(payload))
            .map_err(|(error, _)| error)?;
        self.producer.poll(Duration::ZERO);
        Ok(())
    }
}

/// Makes a topic of one partition, with these settings.
///
/// # Errors
/// When the broker refuses; a topic that is there already is no error.
pub fn make_topic(bootstrap: &str, topic: &str, settings: &[(&str, &str)]) -> anyhow::Result<()> {
    let admin: AdminClient<DefaultClientContext> = client(bootstrap).create()?;
    let new = NewTopic::new(topic, 1, TopicReplication::Fixed(1));
    let new = settings.iter().fold(new, |new, (key, value)| new.set(key, value));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let made = runtime.block_on(admin.create_topics(&[new], &AdminOptions::new()))?;
    match made.into_iter().next().context("no answer")? {
        Ok(_) | Err((_, RDKafkaErrorCode::TopicAlreadyExists)) => Ok(()),
        Err((topic, code)) => anyhow::bail!("{topic}: {code}"),
    }
}

/// Deletes a topic.
///
/// # Errors
/// When the broker refuses.
pub fn delete_topic(bootstrap: &str, topic: &str) -> anyhow::Result<()> {
    let admin: AdminClient<DefaultClientContext> = client(bootstrap).create()?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let deleted = runtime.block_on(admin.delete_topics(&[topic], &AdminOptions::new()))?;
    match deleted.into_iter().next().context("no answer")? {
        Ok(_) => Ok(()),
        Err((topic, code)) => anyhow::bail!("{topic}: {code}"),
    }
}

fn client(bootstrap: &str) -> ClientConfig {
    let mut config = ClientConfig::new();
    config
        .set("bootstrap.servers", bootstrap)
        .set("reconnect.backoff.ms", "50")
        .set("log_level", "2");
    config
}
