//! What a worker of BlazeConfig does on its server beside messages.

use std::sync::Arc;

use blaze_brokers::kafka::KafkaBroker;
use blaze_brokers::{
    Broker as _, BrokerError, Health, KeyedMessage, PublisherOptions, Role, WorkerSide, WriteError,
};
use blaze_domain::names::ChannelName;
use blaze_tests::plain::{KafkaReader, Record};
use blaze_tests::servers::KafkaServer;
use bytes::Bytes;

use super::plain::{delete_topic, has_topic, make_topic, topic_setting, topic_uuid};
use super::{
    DEADLINE, Flow, Reader, WITH_KEPT, eventually, health, open, reader, section, start_server,
    subscribe,
};

struct Worker {
    broker: KafkaBroker,
    side: Arc<dyn WorkerSide>,
}

impl Worker {
    async fn open(server: &KafkaServer, prefix: &str) -> Self {
        let broker = KafkaBroker::open(&section(server, prefix), &Role::Worker).unwrap();
        health(&broker, Health::Up).await;
        let side = broker.worker_side().unwrap();
        Self { broker, side }
    }

    /// Writes as soon as the server takes it.
    async fn write(&self, messages: &[KeyedMessage]) {
        eventually("it is written", async || match self.side.write(messages).await {
            Ok(()) => true,
            Err(WriteError::Broker(BrokerError::Away(_)) | WriteError::NotYet { .. }) => false,
            Err(error) => panic!("{error}"),
        })
        .await;
    }
}

fn channel(service: &str) -> ChannelName {
    format!("blaze/config/changed/{service}").parse().unwrap()
}

fn said(service: &str, key: &str, value: &'static str) -> KeyedMessage {
    KeyedMessage {
        channel: channel(service),
        key: key.to_owned(),
        value: Some(Bytes::from_static(value.as_bytes())),
    }
}

fn taken_away(service: &str, key: &str) -> KeyedMessage {
    KeyedMessage { value: None, ..said(service, key, "") }
}

async fn texts(reader: &mut Reader, count: usize) -> Vec<String> {
    let mut texts = Vec::new();
    for _ in 0..count {
        let (payload, _) = reader.next_bare().await;
        texts.push(String::from_utf8(payload.to_vec()).unwrap());
    }
    texts
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_makes_its_topics_beside_a_flow_and_neither_disturbs_the_other() {
    let server = start_server();
    let worker = Worker::open(&server, "").await;
    for topic in ["blaze.config.get", "blaze.config.ack", "blaze.reply", "blaze.watchdog"] {
        assert!(has_topic(&server.bootstrap(), topic), "{topic}");
    }
    assert!(!has_topic(&server.bootstrap(), "blaze.flow.control"), "it is the flow's");
    assert!(worker.broker.flow_side().is_none());
    worker.side.prepare(&channel("slam")).unwrap();
    let flow = Flow::open(&server).await;
    assert!(flow.broker.worker_side().is_none());
    assert!(open(&server, &Role::Service).worker_side().is_none());
    let user = flow.channel("imu", 0).await;
    worker.write(&[said("slam", "0", "{}")]).await;
    // Both read and write the one topic that both make, and others' topics do not matter to them.
    let mut replies = reader(&flow.broker, &ChannelName::shared_reply()).await;
    let by_worker =
        worker.broker.publisher(&ChannelName::shared_reply(), PublisherOptions::default()).unwrap();
    by_worker.publish_bare(&Bytes::from_static(br#"{"id":"7"}"#), None);
    assert_eq!(texts(&mut replies, 1).await, [r#"{"id":"7"}"#]);
    assert!(has_topic(&server.bootstrap(), user.as_str()));
    assert!(flow.side.load_leases().await.unwrap().is_empty());
    assert!(flow.side.take_collisions().is_empty());
    let status = |broker: &KafkaBroker| broker.status().borrow().health;
    assert_eq!((status(&worker.broker), status(&flow.broker)), (Health::Up, Health::Up));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_last_notice_of_each_key_stays_and_plain_clients_see_it_as_it_is() {
    let server = start_server();
    let worker = Worker::open(&server, "edge-1.").await;
    let client = KafkaBroker::open(&section(&server, "edge-1."), &Role::Service).unwrap();
    health(&client, Health::Up).await;
    // Whoever listens before anything was said hears everything.
    worker.side.prepare(&channel("slam")).unwrap();
    let mut early = reader(&client, &channel("slam")).await;
    let long = "0197c1d27f3a7b649c1e2f6f0a4e8d11";
    worker.write(&[said("slam", "", r#"{"n":1}"#), said("slam", "0", r#"{"n":2}"#)]).await;
    worker.write(&[said("slam", long, r#"{"n":3}"#), said("slam", "0", r#"{"n":4}"#)]).await;
    worker.write(&[said("slam", "9", r#"{"n":5}"#), taken_away("slam", "9")]).await;
    let all: Vec<String> = (1..=5).map(|number| format!(r#"{{"n":{number}}}"#)).collect();
    assert_eq!(texts(&mut early, 5).await, all);
    assert!(early.is_silent().await, "taking away is no message");
    let mut late = subscribe(&client, &channel("slam"), WITH_KEPT).await;
    assert_eq!(texts(&mut late, 3).await, [r#"{"n":1}"#, r#"{"n":3}"#, r#"{"n":4}"#]);
    assert!(late.is_silent().await);

    let topic = "edge-1.blaze.config.changed.slam";
    assert_eq!(topic_setting(&server, topic, "cleanup.policy").await, "compact");
    let plain = KafkaReader::from_beginning(&server.bootstrap(), topic).unwrap();
    let records: Vec<Record> = (0..6).map(|_| plain.next(DEADLINE).unwrap()).collect();
    let keys: Vec<_> = records.iter().map(|record| String::from_utf8_lossy(&record.key)).collect();
    assert_eq!(keys, ["", "0", long, "0", "9", "9"]);
    assert_eq!(records[0].text(), r#"{"n":1}"#, "pure JSON");
    assert!(records.iter().all(|record| record.headers.is_empty()));
    assert!(records[5].payload.is_empty());
    worker.broker.close().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_topic_that_vanishes_is_made_again_and_one_that_cannot_be_made_holds_up_nobody() {
    let server = start_server();
    make_topic(&server, "blaze_config.changed.nav", 1, &[]).await;
    make_topic(&server, "blaze.config.changed.old", 1, &[("retention.ms", "1000000")]).await;
    let worker = Worker::open(&server, "").await;
    assert!(matches!(
        worker.side.write(&[said("slam", "0", "early")]).await,
        Err(WriteError::Broker(BrokerError::Name { .. }))
    ));
    assert_eq!(worker.side.write(&[taken_away("slam", "0")]).await, Ok(()), "nothing is there");
    for service in ["slam", "old"] {
        worker.side.prepare(&channel(service)).unwrap();
    }
    assert!(matches!(worker.side.prepare(&channel("nav")), Err(BrokerError::Collision { .. })));
    worker.write(&[said("slam", "0", "1"), said("old", "0", "1")]).await;
    eventually("a topic that was there keeps the last values from now on", async || {
        topic_setting(&server, "blaze.config.changed.old", "cleanup.policy").await == "compact"
    })
    .await;
    let retention = topic_setting(&server, "blaze.config.changed.old", "retention.ms").await;
    assert_eq!(retention, "1000000", "its other settings stay");
    // More than the topic takes.
    let large = KeyedMessage {
        value: Some(Bytes::from(vec![b'x'; 3 * 1024 * 1024])),
        ..said("slam", "0", "")
    };
    let refused = worker.side.write(&[large]).await;
    assert!(matches!(refused, Err(WriteError::TooLarge { bytes: 3_145_728, .. })), "{refused:?}");
    let mut slam = reader(&worker.broker, &channel("slam")).await;
    let first = topic_uuid(&server, "blaze.config.changed.slam");
    delete_topic(&server, "blaze.config.changed.slam").await;
    eventually("it is made again", async || {
        let found = topic_uuid(&server, "blaze.config.changed.slam");
        found != first && has_topic(&server.bootstrap(), "blaze.config.changed.slam")
    })
    .await;
    worker.write(&[said("slam", "0", "2")]).await;
    eventually("its readers hear", async || slam.next_bare().await.0 == "2").await;
    worker.side.release(&channel("slam"));
    delete_topic(&server, "blaze.config.changed.slam").await;
    // The broker deletes a topic some time after it has confirmed that.
    eventually("a deleted topic is not written to", async || {
        matches!(
            worker.side.write(&[said("slam", "0", "3")]).await,
            Err(WriteError::Broker(BrokerError::Name { .. }))
        )
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_killed_server_did_not_acknowledge_is_not_taken_for_written() {
    let server = start_server();
    let worker = Worker::open(&server, "").await;
    worker.side.prepare(&channel("slam")).unwrap();
    worker.write(&[said("slam", "0", "1")]).await;
    server.kill().unwrap();
    let refused = worker.side.write(&[said("slam", "0", "2")]).await;
    assert!(matches!(refused, Err(WriteError::Broker(BrokerError::Away(_)))), "{refused:?}");
    health(&worker.broker, Health::Down).await;
    assert!(worker.side.write(&[said("slam", "0", "3")]).await.is_err());
    server.restart().unwrap();
    worker.write(&[said("slam", "0", "4")]).await;
    let mut late = subscribe(&worker.broker, &channel("slam"), WITH_KEPT).await;
    assert_eq!(texts(&mut late, 1).await, ["4"]);
}
