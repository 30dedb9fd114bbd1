//! Clients that know nothing of BlazeAIoT: what any service with a Kafka or Redis library does.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use anyhow::Context;
use rdkafka::ClientConfig;
use rdkafka::admin::{AdminClient, AdminOptions};
use rdkafka::client::DefaultClientContext;
use rdkafka::consumer::{BaseConsumer, Consumer as _};
use rdkafka::message::{Header, Headers as _, Message as _, OwnedHeaders};
use rdkafka::producer::{BaseProducer, BaseRecord, Producer as _};
use rdkafka::topic_partition_list::{Offset, TopicPartitionList};

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
        let consumer: BaseConsumer = client(bootstrap)
            .set("group.id", "plain")
            .set("enable.auto.commit", "false")
            .set("fetch.wait.max.ms", "50")
            .set("fetch.message.max.bytes", "17825792")
            .set("reconnect.backoff.max.ms", "200")
            .create()?;
        let until = Instant::now() + Duration::from_secs(10);
        let end = loop {
            match consumer.fetch_watermarks(topic, 0, Duration::from_secs(2)) {
                Ok((_, end)) => break end,
                Err(error) if Instant::now() > until => return Err(error).context(topic.to_owned()),
                Err(_) => std::thread::sleep(Duration::from_millis(20)),
            }
        };
        let mut partitions = TopicPartitionList::new();
        partitions.add_partition_offset(topic, 0, Offset::Offset(end))?;
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
                        let value = String::from_utf8_lossy(header.value.unwrap_or_default()).into_owned();
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

/// A plain producer.
pub struct KafkaWriter {
    producer: BaseProducer,
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
            .set("message.timeout.ms", "5000")
            .set("reconnect.backoff.max.ms", "200")
            .create()?;
        Ok(Self { producer })
    }

    /// Produces a value and waits until it is there.
    ///
    /// # Errors
    /// When it is not acknowledged in time.
    pub fn produce(&self, topic: &str, payload: &[u8]) -> anyhow::Result<()> {
        self.produce_later(topic, payload)?;
        self.producer.flush(Duration::from_secs(10))?;
        Ok(())
    }

    /// Produces a value with headers and waits until it is there.
    ///
    /// # Errors
    /// As [`KafkaWriter::produce`].
    pub fn produce_with(&self, topic: &str, payload: &[u8], headers: &[(&str, &[u8])]) -> anyhow::Result<()> {
        let mut all = OwnedHeaders::new();
        for (key, value) in headers {
            all = all.insert(Header {
                key,
                value: Some(*value),
            });
        }
        self.producer
            .send(BaseRecord::<'_, (), [u8]>::to(topic).payload(payload).headers(all))
            .map_err(|(error, _)| error)?;
        self.producer.flush(Duration::from_secs(10))?;
        Ok(())
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

/// Deletes topics.
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
