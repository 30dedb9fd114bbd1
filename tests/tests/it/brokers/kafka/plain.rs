//! Clients that know nothing of BlazeAIoT.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use blaze_tests::servers::KafkaServer;
use rdkafka::ClientConfig;
use rdkafka::admin::{AdminClient, AdminOptions, NewTopic, ResourceSpecifier, TopicReplication};
use rdkafka::client::DefaultClientContext;
use rdkafka::consumer::{BaseConsumer, Consumer as _};
use rdkafka::producer::{BaseProducer, BaseRecord, Producer as _};

const TIMEOUT: Duration = Duration::from_secs(20);

fn config(server: &KafkaServer) -> ClientConfig {
    let mut config = ClientConfig::new();
    config.set("bootstrap.servers", server.bootstrap());
    config
}

fn admin(server: &KafkaServer) -> AdminClient<DefaultClientContext> {
    config(server).create().unwrap()
}

pub(crate) async fn make_topic(
    server: &KafkaServer,
    name: &str,
    partitions: i32,
    settings: &[(&str, &str)],
) {
    let topic = NewTopic::new(name, partitions, TopicReplication::Fixed(1));
    let topic = settings.iter().fold(topic, |topic, (key, value)| topic.set(key, value));
    let made = admin(server).create_topics([&topic], &AdminOptions::new()).await.unwrap();
    assert_eq!(made, [Ok(name.to_owned())]);
}

/// A setting of a topic.
pub(crate) async fn topic_setting(server: &KafkaServer, topic: &str, name: &str) -> String {
    let found = admin(server)
        .describe_configs([&ResourceSpecifier::Topic(topic)], &AdminOptions::new())
        .await
        .unwrap();
    let config = found.into_iter().next().unwrap().unwrap();
    config.get(name).unwrap().value.clone().unwrap()
}

/// Whether the server has a topic.
pub(crate) fn has_topic(bootstrap: &str, name: &str) -> bool {
    let client: BaseConsumer =
        ClientConfig::new().set("bootstrap.servers", bootstrap).create().unwrap();
    let metadata = client.fetch_metadata(Some(name), TIMEOUT).unwrap();
    metadata.topics().iter().any(|topic| {
        topic.name() == name && topic.error().is_none() && !topic.partitions().is_empty()
    })
}

pub(crate) async fn delete_topic(server: &KafkaServer, name: &str) {
    let deleted = admin(server).delete_topics(&[name], &AdminOptions::new()).await.unwrap();
    assert_eq!(deleted, [Ok(name.to_owned())]);
}

/// Writes records and waits until the server has them.
pub(crate) struct PlainProducer(BaseProducer);

impl PlainProducer {
    pub(crate) fn new(server: &KafkaServer) -> Self {
        Self(config(server).create().unwrap())
    }

    pub(crate) fn write(&self, topic: &str, partition: i32, values: &[&str]) {
        for value in values {
            let record = BaseRecord::<str, str>::to(topic).partition(partition);
            // Without a value, as some clients write an empty one.
            let record = if value.is_empty() { record } else { record.payload(value) };
            self.0.send(record).map_err(|(error, _)| error).unwrap();
        }
        self.0.flush(TIMEOUT).unwrap();
    }
}

/// The server's identity of a topic in Kafka's text form, asked of the server itself (metadata,
/// version 12).
pub(crate) fn topic_uuid(server: &KafkaServer, topic: &str) -> String {
    let mut body = vec![0, 3, 0, 12, 0, 0, 0, 9, 0xFF, 0xFF, 0];
    body.extend([2]); // one topic: without its identity, by name
    body.extend([0; 16]);
    body.push(u8::try_from(topic.len() + 1).unwrap());
    body.extend(topic.as_bytes());
    body.extend([0, 0, 0, 0]);
    let mut stream = TcpStream::connect(server.bootstrap()).unwrap();
    stream.set_read_timeout(Some(TIMEOUT)).unwrap();
    stream.write_all(&u32::try_from(body.len()).unwrap().to_be_bytes()).unwrap();
    stream.write_all(&body).unwrap();
    let mut length = [0; 4];
    stream.read_exact(&mut length).unwrap();
    let mut answer = vec![0; u32::from_be_bytes(length) as usize];
    stream.read_exact(&mut answer).unwrap();
    // The identity follows the topic's name.
    let name = answer.windows(topic.len()).position(|window| window == topic.as_bytes()).unwrap();
    URL_SAFE_NO_PAD.encode(&answer[name + topic.len()..][..16])
}
