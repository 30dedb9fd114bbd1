//! A participant whose interface or whose RustDDS goes away.

use std::net::Ipv4Addr;
use std::time::Duration;

use blaze_brokers::dds::layer::DdsBroker;
use blaze_brokers::dds::{DdsError, Fault, Participant, ParticipantConfig, Profile};
use blaze_brokers::{
    Broker, BrokerError, Content, Health, PublishOutcome, PublisherOptions, Received,
    SubscribeOptions,
};
use blaze_domain::node_file::DdsLayerBroker as Section;

use super::support::{DEADLINE, Domain, eventually, frame, wait_for};

#[tokio::test]
async fn a_missing_interface_is_down_with_its_reason() {
    let domain = Domain::start();
    let section = Section {
        // Reserved for documentation: no interface has it.
        interface: Ipv4Addr::new(192, 0, 2, 1),
        ..domain.section()
    };
    let broker = DdsBroker::open(&section).unwrap();
    let detail = wait_for(&broker, Health::Down).await;
    assert!(detail.contains("192.0.2.1"), "{detail}");
    let topic = "t".parse().unwrap();
    let refused = broker.subscribe(&topic, SubscribeOptions::default()).await;
    assert!(matches!(refused, Err(BrokerError::Away(why)) if why.contains("192.0.2.1")));
    let publisher = broker.publisher(&topic, PublisherOptions::default()).unwrap();
    assert_eq!(publisher.publish(&frame(&topic, 1, 1, 1), None), PublishOutcome::Dropped);
    broker.close().await;
    assert_eq!(broker.status().borrow().health, Health::Closed);
}

#[test]
fn addresses_that_are_no_interface_are_refused() {
    for interface in [Ipv4Addr::UNSPECIFIED, Ipv4Addr::BROADCAST, Ipv4Addr::new(239, 255, 0, 1)] {
        assert!(DdsBroker::open(&Section { domain: 1, interface }).is_err(), "{interface}");
    }
    let interface = Ipv4Addr::LOCALHOST;
    assert!(DdsBroker::open(&Section { domain: 101, interface }).is_err());
}

/// There is room for ten writers that the event loop did not take yet: one more waits for it.
#[test]
fn a_writer_that_cannot_be_made_holds_nobody_up() {
    let domain = Domain::start();
    let config = ParticipantConfig::new(domain.id, Ipv4Addr::LOCALHOST);
    let participant = Participant::start(config).unwrap();
    participant.inject(Fault::Hang).unwrap();
    assert!(participant.is_alive());
    let mut made = Vec::new();
    let refused = loop {
        assert!(made.len() < 64, "{} writers are made", made.len());
        match participant.writer("late", Profile::best_effort(1)) {
            Ok(writer) => made.push(writer),
            Err(error) => break error,
        }
    };
    assert_eq!(refused, DdsError::Hangs("writer"));
    assert!(!participant.is_alive());
    // Their end would wait for the event loop, too.
    std::mem::forget((made, participant));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_participant_that_dies_is_built_anew_and_goes_on() {
    let domain = Domain::start();
    let (mortal, other) = (domain.open().await, domain.open().await);
    let topic = "faults".parse().unwrap();
    let mut there = other.subscribe(&topic, SubscribeOptions::default()).await.unwrap();
    let mut here = mortal.subscribe(&topic, SubscribeOptions::default()).await.unwrap();
    let options = PublisherOptions { reliable: true, ..PublisherOptions::default() };
    let publishers =
        [mortal.publisher(&topic, options).unwrap(), other.publisher(&topic, options).unwrap()];
    let mut sequence = 0;
    for (round, fault) in (0..).zip([None, Some(Fault::Panic), Some(Fault::Hang)]) {
        if let Some(fault) = fault {
            mortal.inject(fault);
            eventually("it is built anew", || (mortal.counts().rebuilds == round).then_some(()))
                .await;
            wait_for(&mortal, Health::Up).await;
        }
        // Each still hears the other, on the publishers and subscriptions of before.
        for (subscription, writer) in [(&mut there, 1), (&mut here, 2)] {
            let begin = sequence;
            let hears = async {
                let mut batch = Vec::new();
                loop {
                    sequence += 1;
                    for (number, publisher) in (1..).zip(&publishers) {
                        publisher.publish(&frame(&topic, number, sequence, 10), None);
                    }
                    // What a participant publishes it hears itself at once, so hearing something is
                    // no pace.
                    let next = tokio::time::Instant::now() + Duration::from_millis(20);
                    while tokio::time::timeout_at(next, subscription.receive(&mut batch, 64))
                        .await
                        .is_ok()
                    {}
                    let is_new = |content: &Content| match content {
                        Content::Frame(frame) => {
                            frame.writer().0[0] == writer && frame.sequence() > begin
                        }
                        other => panic!("{other:?}"),
                    };
                    if batch.drain(..).any(|received| is_new(&received.content)) {
                        return;
                    }
                }
            };
            let heard = tokio::time::timeout(DEADLINE, hears).await;
            assert!(heard.is_ok(), "after {fault:?} writer {writer} is not heard");
        }
    }
    assert_eq!(other.counts().rebuilds, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_published_while_it_is_built_anew_arrives() {
    const MESSAGES: u64 = 200;
    let domain = Domain::start();
    let (mortal, other) = (domain.open().await, domain.open().await);
    let topic = "meanwhile".parse().unwrap();
    let mut there = other.subscribe(&topic, SubscribeOptions::default()).await.unwrap();
    let options = PublisherOptions { reliable: true, ..PublisherOptions::default() };
    let publisher = mortal.publisher(&topic, options).unwrap();
    mortal.inject(Fault::Panic);
    wait_for(&mortal, Health::Down).await;
    for sequence in 1..=MESSAGES {
        assert_eq!(publisher.publish(&frame(&topic, 1, sequence, 1), None), PublishOutcome::Taken);
    }
    let mut batch = Vec::new();
    while batch.len() < MESSAGES as usize {
        let received = tokio::time::timeout(DEADLINE, there.receive(&mut batch, 64)).await;
        assert!(received.is_ok_and(|count| count > 0), "{} have come", batch.len());
    }
    let sequence = |received: Received| match received.content {
        Content::Frame(frame) => frame.sequence(),
        other => panic!("{other:?}"),
    };
    let found: Vec<u64> = batch.into_iter().map(sequence).collect();
    assert_eq!(found, (1..=MESSAGES).collect::<Vec<u64>>());
}
