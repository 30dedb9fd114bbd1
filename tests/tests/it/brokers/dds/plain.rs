//! Writers that keep samples for late joiners, plain DDS programs among them, whose clocks nobody
//! knows.

use std::net::Ipv4Addr;
use std::time::{Duration, Instant};

use blaze_brokers::dds::{Participant, ParticipantConfig, Profile, Written, octet_sequence};
use blaze_brokers::{Broker, Content, PublisherOptions, Received, SubscribeOptions, Subscription};
use rustdds::{Timestamp, WriteOptionsBuilder};

use super::support::{DEADLINE, Domain, WITH_KEPT, eventually, frame};

/// Takes what has come.
async fn drain(subscription: &mut Subscription, found: &mut Vec<Received>) {
    let wait = subscription.receive(found, usize::MAX);
    let _ = tokio::time::timeout(Duration::from_millis(1), wait).await;
}

fn text(received: &Received) -> &[u8] {
    match &received.content {
        Content::Bare { payload, .. } => payload,
        other => panic!("{other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_plain_program_whose_clock_is_an_hour_behind_is_heard() {
    const LIVE: usize = 10;
    let domain = Domain::start();
    let plain = Participant::start(ParticipantConfig::new(domain.id, Ipv4Addr::LOCALHOST)).unwrap();
    let profile =
        Profile { reliable: true, transient_local: true, window: 1024, ..Profile::best_effort(4) };
    let writer = plain.writer("bt/clock", profile).unwrap();
    let write = |octets: &'static [u8], seconds: i32| {
        let written = Timestamp::now() - rustdds::Duration::from_secs(3_600 + seconds);
        let options = WriteOptionsBuilder::new().source_timestamp(written);
        let result = writer.write_cdr(octet_sequence(&[octets]).unwrap(), options);
        assert!(matches!(result, Written::Taken(_)), "{result:?}");
    };
    for seconds in [4, 3, 2, 1] {
        write(b"kept", seconds);
    }
    let broker = domain.open().await;
    let topic = "clock".parse().unwrap();
    let mut volatile = broker.subscribe(&topic, SubscribeOptions::default()).await.unwrap();
    let mut late = broker.subscribe(&topic, WITH_KEPT).await.unwrap();
    let (mut by_volatile, mut by_late) = (Vec::new(), Vec::new());
    let until = Instant::now() + DEADLINE;
    let count =
        |found: &[Received]| found.iter().filter(|received| text(received) == b"live").count();
    // A pause would end the wait for what is kept, so there is none.
    while count(&by_volatile) < LIVE || count(&by_late) < LIVE {
        assert!(Instant::now() < until, "{} and {} came", by_volatile.len(), by_late.len());
        write(b"live", 0);
        tokio::time::sleep(Duration::from_millis(20)).await;
        drain(&mut volatile, &mut by_volatile).await;
        drain(&mut late, &mut by_late).await;
    }
    assert!(by_volatile.iter().all(|received| text(received) == b"live"));
    let kept = by_late.iter().take_while(|received| text(received) == b"kept").count();
    assert_eq!(kept, 4, "what is kept comes first");
    let oldest = by_late.iter().map(|received| received.broker_age_us).max();
    assert!(oldest < Some(60_000_000), "{oldest:?}");
    assert_eq!((volatile.take_dropped(), late.take_dropped()), (0, 0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_late_joiner_gets_what_is_kept_though_another_topic_never_pauses() {
    let domain = Domain::start();
    let (speaker, listener) = (domain.open().await, domain.open().await);
    let (latched, busy) = ("latched".parse().unwrap(), "busy".parse().unwrap());
    let keeps = PublisherOptions { depth: 1, reliable: true, large: false };
    let keeper = speaker.publisher(&latched, keeps).unwrap();
    keeper.publish(&frame(&latched, 1, 1, 10), None);
    eventually("it is written", || (keeper.later().queued == 0).then_some(())).await;
    tokio::time::sleep(Duration::from_millis(100)).await;
    let options = PublisherOptions { depth: 0, ..keeps };
    let talker = speaker.publisher(&busy, options).unwrap();
    let mut chatter = listener.subscribe(&busy, SubscribeOptions::default()).await.unwrap();
    let mut late = listener.subscribe(&latched, WITH_KEPT).await.unwrap();
    let (mut heard, mut found) = (Vec::new(), Vec::new());
    let until = Instant::now() + DEADLINE;
    let mut sequence = 0;
    while found.is_empty() || heard.is_empty() {
        assert!(Instant::now() < until, "{} kept, {} others", found.len(), heard.len());
        sequence += 1;
        talker.publish(&frame(&busy, 2, sequence, 10), None);
        tokio::time::sleep(Duration::from_millis(5)).await;
        drain(&mut chatter, &mut heard).await;
        drain(&mut late, &mut found).await;
    }
    assert!(found[0].kept);
}
