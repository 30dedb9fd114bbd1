//! What a worker of BlazeConfig does on DDS beside messages.

use std::collections::BTreeSet;
use std::net::Ipv4Addr;
use std::sync::Arc;

use blaze_brokers::dds::{Participant, ParticipantConfig, Profile};
use blaze_brokers::{
    Broker as _, BrokerError, Content, KeyedMessage, SubscribeOptions, Subscription, WriteError,
};
use blaze_domain::names::ChannelName;
use bytes::Bytes;
use parking_lot::Mutex;

use super::support::{DEADLINE, Domain, WITH_KEPT, eventually};

fn said(channel: &ChannelName, text: &str) -> KeyedMessage {
    KeyedMessage {
        channel: channel.clone(),
        key: "0".to_owned(),
        value: Some(Bytes::copy_from_slice(text.as_bytes())),
    }
}

/// Payloads until one is the given.
async fn until(subscription: &mut Subscription, last: &str) -> Vec<String> {
    let mut texts: Vec<String> = Vec::new();
    while texts.last().map(String::as_str) != Some(last) {
        let mut batch = Vec::new();
        let received = tokio::time::timeout(DEADLINE, subscription.receive(&mut batch, 1)).await;
        assert_eq!(received, Ok(1), "after {texts:?}");
        match &batch[0].content {
            Content::Bare { payload, .. } => {
                texts.push(String::from_utf8(payload.to_vec()).unwrap());
            }
            other => panic!("{other:?}"),
        }
    }
    texts
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whoever_comes_late_gets_the_last_notices_as_they_are() {
    let domain = Domain::start();
    let worker = domain.open().await;
    let side = worker.worker_side().unwrap();
    let channel: ChannelName = "blaze/config/changed/slam".parse().unwrap();
    let unknown = side.write(&[said(&channel, "early")]).await;
    assert!(matches!(unknown, Err(WriteError::Broker(BrokerError::Name { .. }))), "{unknown:?}");
    side.prepare(&channel).unwrap();
    let early = domain.open().await;
    let mut listening = early.subscribe(&channel, SubscribeOptions::default()).await.unwrap();
    side.write(&[said(&channel, "1"), said(&channel, "2")]).await.unwrap();
    let away = KeyedMessage { value: None, ..said(&channel, "") };
    assert_eq!(side.write(&[away]).await, Ok(()), "there are no keys");
    assert_eq!(until(&mut listening, "2").await, ["1", "2"]);

    // Who comes late by this adapter, and a plain program.
    let late = domain.open().await;
    let mut kept = late.subscribe(&channel, WITH_KEPT).await.unwrap();
    assert_eq!(until(&mut kept, "2").await, ["1", "2"]);
    let plain = Participant::start(ParticipantConfig::new(domain.id, Ipv4Addr::LOCALHOST)).unwrap();
    let profile =
        Profile { reliable: true, transient_local: true, window: 0, ..Profile::best_effort(64) };
    let heard = Arc::new(Mutex::new(BTreeSet::new()));
    let noted = Arc::clone(&heard);
    let sink = Box::new(move |_, octets: Bytes| {
        noted.lock().insert(octets);
    });
    let _reader = plain.reader(channel.as_str(), profile, sink).unwrap();
    eventually("a plain program has them", || (heard.lock().len() == 2).then_some(())).await;

    side.write(&[said(&channel, "3")]).await.unwrap();
    for reader in [&mut listening, &mut kept] {
        assert_eq!(until(reader, "3").await, ["3"]);
    }
    side.release(&channel);
    assert!(side.write(&[said(&channel, "4")]).await.is_err());
    worker.close().await;
    assert_eq!(
        side.write(&[said(&channel, "5")]).await,
        Err(WriteError::Broker(BrokerError::Closed))
    );
}
