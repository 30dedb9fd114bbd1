//! Kafka of one test.

use std::time::{Duration, Instant};

use blaze_tests::servers::{KafkaOptions, KafkaServer, shared_kafka, shared_kafka_cloud, unique_name};
use rdkafka::ClientConfig;
use rdkafka::admin::{AdminClient, AdminOptions, NewTopic, TopicReplication};
use rdkafka::client::DefaultClientContext;
use rdkafka::consumer::{BaseConsumer, Consumer};
use rdkafka::error::RDKafkaErrorCode;
use rdkafka::message::Message;
use rdkafka::producer::{BaseProducer, BaseRecord, Producer};
use rdkafka::{Offset, TopicPartitionList};

const DEADLINE: Duration = Duration::from_secs(30);

fn client(bootstrap: &str) -> ClientConfig {
    let mut config = ClientConfig::new();
    config.set("bootstrap.servers", bootstrap);
    config.set("reconnect.backoff.ms", "50");
    config.set("reconnect.backoff.max.ms", "200");
    config
}

async fn make_topic(bootstrap: &str, topic: &str) {
    let admin: AdminClient<DefaultClientContext> = client(bootstrap).create().unwrap();
    let new = NewTopic::new(topic, 1, TopicReplication::Fixed(1));
    let options = AdminOptions::new().operation_timeout(Some(DEADLINE));
    let made = admin.create_topics([&new], &options).await.unwrap();
    assert_eq!(made, [Ok(topic.to_owned())]);
}

fn produce(bootstrap: &str, topic: &str, count: usize) {
    let producer: BaseProducer = client(bootstrap).set("enable.idempotence", "true").create().unwrap();
    for number in 0..count {
        let payload = number.to_string();
        producer
            .send(BaseRecord::<(), _>::to(topic).payload(&payload))
            .map_err(|(error, _)| error)
            .unwrap();
    }
    producer.flush(DEADLINE).unwrap();
}

/// The payloads from the start on, until there are `count`.
fn consume(bootstrap: &str, topic: &str, count: usize) -> Vec<String> {
    let consumer: BaseConsumer = client(bootstrap).set("group.id", "unused").create().unwrap();
    let mut all = TopicPartitionList::new();
    all.add_partition_offset(topic, 0, Offset::Beginning).unwrap();
    consumer.assign(&all).unwrap();
    let begin = Instant::now();
    let mut found = Vec::new();
    while found.len() < count && begin.elapsed() < DEADLINE {
        match consumer.poll(Duration::from_millis(100)) {
            Some(Ok(message)) => found.push(String::from_utf8_lossy(message.payload().unwrap()).into_owned()),
            Some(Err(error)) => assert!(error.rdkafka_error_code().is_some(), "{error}"),
            None => {}
        }
    }
    found
}

fn cluster_id(bootstrap: &str) -> String {
    let consumer: BaseConsumer = client(bootstrap).create().unwrap();
    consumer.client().fetch_cluster_id(DEADLINE).unwrap()
}

fn answers(bootstrap: &str) -> bool {
    let consumer: BaseConsumer = client(bootstrap).create().unwrap();
    consumer.fetch_metadata(None, Duration::from_secs(2)).is_ok()
}

#[tokio::test]
async fn what_was_acknowledged_is_there_after_a_kill_and_a_frozen_broker_goes_on() {
    let server = KafkaServer::start(KafkaOptions::default()).unwrap();
    let bootstrap = server.bootstrap();
    let cluster = cluster_id(&bootstrap);
    make_topic(&bootstrap, "kept").await;
    produce(&bootstrap, "kept", 1000);
    assert!(server.rss_kib().unwrap() > 50_000);

    server.kill().unwrap();
    assert!(!answers(&bootstrap));
    server.rss_kib().expect_err("a process that has gone has no memory");

    let begin = Instant::now();
    server.restart().unwrap();
    println!("back {:?} after a kill", begin.elapsed());
    assert_eq!(server.bootstrap(), bootstrap);
    assert_eq!(cluster_id(&bootstrap), cluster);
    let expected: Vec<String> = (0..1000).map(|number| number.to_string()).collect();
    assert_eq!(consume(&bootstrap, "kept", 1000), expected);

    server.freeze().unwrap();
    assert!(!answers(&bootstrap));
    server.thaw().unwrap();
    server.wait_ready().unwrap();
    produce(&bootstrap, "kept", 1);
    assert_eq!(consume(&bootstrap, "kept", 1001).len(), 1001);
}

#[tokio::test]
async fn the_shared_brokers_are_two_clusters_that_make_no_topic_by_themselves() {
    let (fog, cloud) = (shared_kafka().unwrap(), shared_kafka_cloud().unwrap());
    assert_eq!(shared_kafka().unwrap(), fog);
    assert_ne!(fog, cloud);
    assert_ne!(cluster_id(&fog), cluster_id(&cloud));

    let topic = unique_name("harness");
    let producer: BaseProducer = client(&fog).set("message.timeout.ms", "1000").create().unwrap();
    producer
        .send(BaseRecord::<(), str>::to(&topic).payload("x"))
        .map_err(|(error, _)| error)
        .unwrap();
    // The delivery report is dropped by the default context; what counts is that no topic appears.
    let flushed = producer.flush(DEADLINE);
    assert!(flushed.is_ok(), "{flushed:?}");
    let consumer: BaseConsumer = client(&fog).set("allow.auto.create.topics", "true").create().unwrap();
    let metadata = consumer.fetch_metadata(Some(&topic), DEADLINE).unwrap();
    let error = metadata.topics()[0].error().map(RDKafkaErrorCode::from);
    assert_eq!(error, Some(RDKafkaErrorCode::UnknownTopicOrPartition));

    make_topic(&fog, &topic).await;
    produce(&fog, &topic, 10);
    assert_eq!(consume(&fog, &topic, 10).len(), 10);
}

#[test]
fn a_refused_configuration_is_told_at_once_with_the_log() {
    let begin = Instant::now();
    let options = KafkaOptions {
        extra: vec!["num.io.threads=none".to_owned()],
        ..KafkaOptions::default()
    };
    let error = KafkaServer::start(options).err().expect("refused");
    assert!(error.to_string().contains("num.io.threads"), "{error}");
    assert!(begin.elapsed() < Duration::from_secs(30), "{:?}", begin.elapsed());
}
