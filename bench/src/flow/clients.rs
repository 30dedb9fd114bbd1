//! Plain clients, as any service has them.

use std::time::Duration;

use blaze_tests::plain::RedisReader;
use rdkafka::ClientConfig;
use rdkafka::consumer::{BaseConsumer, Consumer as _};
use rdkafka::message::Message as _;
use rdkafka::producer::{BaseProducer, BaseRecord, Producer as _};
use rdkafka::topic_partition_list::{Offset, TopicPartitionList};
use rdkafka::util::Timeout;

/// Sends.
pub(crate) trait Source {
    fn send(&mut self, payload: &[u8]) -> anyhow::Result<()>;
    fn flush(&mut self) -> anyhow::Result<()>;
}

/// Receives.
pub(crate) trait Sink: Send {
    /// Gives what is there; waits some milliseconds for it.
    fn poll(&mut self, found: &mut dyn FnMut(&[u8])) -> anyhow::Result<()>;
}

/// PUBLISH, pipelined.
pub(crate) struct RedisSource {
    connection: redis::Connection,
    /// Commands of a pipeline, at most.
    together: usize,
    channel: String,
    pipeline: redis::Pipeline,
    waiting: usize,
}

impl RedisSource {
    pub(crate) fn new(url: &str, channel: &str, together: usize) -> anyhow::Result<Self> {
        Ok(Self {
            together,
            connection: redis::Client::open(url)?.get_connection()?,
            channel: channel.to_owned(),
            pipeline: redis::pipe(),
            waiting: 0,
        })
    }
}

impl Source for RedisSource {
    fn send(&mut self, payload: &[u8]) -> anyhow::Result<()> {
        self.pipeline.cmd("PUBLISH").arg(&self.channel).arg(payload).ignore();
        self.waiting += 1;
        if self.waiting >= self.together { self.flush() } else { Ok(()) }
    }

    fn flush(&mut self) -> anyhow::Result<()> {
        if self.waiting > 0 {
            self.pipeline.exec(&mut self.connection)?;
            self.pipeline.clear();
            self.waiting = 0;
        }
        Ok(())
    }
}

/// SUBSCRIBE.
pub(crate) struct RedisSink(pub(crate) RedisReader);

impl Sink for RedisSink {
    fn poll(&mut self, found: &mut dyn FnMut(&[u8])) -> anyhow::Result<()> {
        for _ in 0..256 {
            match self.0.poll()? {
                Some(payload) => found(&payload),
                None => break,
            }
        }
        Ok(())
    }
}

/// An idempotent producer.
pub(crate) struct KafkaSource {
    producer: BaseProducer,
    topic: String,
}

impl KafkaSource {
    pub(crate) fn new(bootstrap: &str, topic: &str) -> anyhow::Result<Self> {
        let producer = ClientConfig::new()
            .set("bootstrap.servers", bootstrap)
            .set("enable.idempotence", "true")
            .set("linger.ms", "0")
            .set("message.max.bytes", "17825792")
            .set("socket.nagle.disable", "true")
            .create()?;
        Ok(Self { producer, topic: topic.to_owned() })
    }
}

impl Source for KafkaSource {
    fn send(&mut self, payload: &[u8]) -> anyhow::Result<()> {
        let mut record: BaseRecord<'_, (), [u8]> = BaseRecord::to(&self.topic).payload(payload);
        loop {
            match self.producer.send(record) {
                Ok(()) => break,
                Err((error, back))
                    if error.rdkafka_error_code()
                        == Some(rdkafka::types::RDKafkaErrorCode::QueueFull) =>
                {
                    record = back;
                    self.producer.poll(Duration::from_millis(1));
                }
                Err((error, _)) => return Err(error.into()),
            }
        }
        self.producer.poll(Duration::ZERO);
        Ok(())
    }

    fn flush(&mut self) -> anyhow::Result<()> {
        self.producer.poll(Duration::ZERO);
        Ok(())
    }
}

impl Drop for KafkaSource {
    fn drop(&mut self) {
        let _ = self.producer.flush(Timeout::After(Duration::from_secs(5)));
    }
}

/// A consumer without a group, from the end.
pub(crate) struct KafkaSink {
    consumer: BaseConsumer,
}

impl KafkaSink {
    pub(crate) fn new(bootstrap: &str, topic: &str) -> anyhow::Result<Self> {
        let consumer: BaseConsumer = ClientConfig::new()
            .set("bootstrap.servers", bootstrap)
            .set("group.id", "blaze-bench")
            .set("enable.auto.commit", "false")
            .set("fetch.wait.max.ms", "100")
            .set("fetch.message.max.bytes", "17825792")
            .set("socket.nagle.disable", "true")
            .create()?;
        let (_, end) = consumer.fetch_watermarks(topic, 0, Duration::from_secs(10))?;
        let mut partitions = TopicPartitionList::new();
        partitions.add_partition_offset(topic, 0, Offset::Offset(end))?;
        consumer.assign(&partitions)?;
        Ok(Self { consumer })
    }
}

impl Sink for KafkaSink {
    fn poll(&mut self, found: &mut dyn FnMut(&[u8])) -> anyhow::Result<()> {
        match self.consumer.poll(Duration::from_millis(50)) {
            Some(message) => found(message?.payload().unwrap_or_default()),
            None => return Ok(()),
        }
        for _ in 0..1_000 {
            match self.consumer.poll(Duration::ZERO) {
                Some(message) => found(message?.payload().unwrap_or_default()),
                None => break,
            }
        }
        Ok(())
    }
}
