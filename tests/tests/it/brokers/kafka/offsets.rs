//! Subscriptions that begin at an offset of the topic.

use blaze_brokers::{Begin, Broker, ConsumerOffset, SubscribeOptions};
use blaze_domain::names::ChannelName;
use blaze_tests::servers::unique_name;

use super::plain::{PlainProducer, make_topic};
use super::{Flow, Reader, WITH_KEPT, frame, publish, publisher, reader, start_server, subscribe};

async fn from(broker: &dyn Broker, channel: &ChannelName, begin: Begin) -> (Reader, Vec<i64>) {
    let subscription = broker.subscribe_from(channel, SubscribeOptions::default(), begin).await;
    let subscription = subscription.unwrap();
    let starts = subscription.starts().to_vec();
    let reader = Reader { subscription, waiting: Vec::new() };
    (reader, starts)
}

/// Receives frames and asserts that they are these.
async fn expect(
    reader: &mut Reader,
    sequences: std::ops::RangeInclusive<u64>,
) -> Vec<ConsumerOffset> {
    let mut places = Vec::new();
    for sequence in sequences {
        let received = reader.next().await;
        places.extend(received.place);
        match received.content {
            blaze_brokers::Content::Frame(frame) => assert_eq!(frame.sequence(), sequence),
            other => panic!("{other:?}"),
        }
    }
    places
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_reader_begins_where_it_is_told_and_the_others_get_nothing_twice() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    let channel = flow.channel("places", 0).await;
    let writer = publisher(&flow.broker, &channel, 0);
    let mut first = reader(&flow.broker, &channel).await;
    for sequence in 1..=10 {
        publish(writer.as_ref(), &frame(&channel, 1, sequence));
    }
    let places = expect(&mut first, 1..=10).await;
    assert!(
        places
            .iter()
            .map(|place| (place.partition, place.offset))
            .eq((0..10).map(|offset| (0, offset)))
    );

    // By offset, while another reader is beyond it.
    let (mut again, starts) = from(&flow.broker, &channel, Begin::At([3].into())).await;
    assert_eq!(starts, [3]);
    expect(&mut again, 4..=10).await;
    // By time, and no later than a bound.
    let appended_ms = places[5].appended_ms.unwrap();
    let since = |latest: &[i64]| Begin::Since { appended_ms, latest: latest.into() };
    let (mut timed, starts) = from(&flow.broker, &channel, since(&[])).await;
    let start = usize::try_from(starts[0]).unwrap();
    assert!(start <= 5 && places[start].appended_ms >= Some(appended_ms), "{starts:?} {places:?}");
    expect(&mut timed, starts[0].unsigned_abs() + 1..=10).await;
    // All ten may have been appended in one millisecond; then the time leads to the first.
    let (mut bound, starts) = from(&flow.broker, &channel, since(&[2])).await;
    assert_eq!(starts, [start.min(2) as i64]);
    expect(&mut bound, start.min(2) as u64 + 1..=10).await;
    // After the last record a time is the end.
    let later =
        Begin::Since { appended_ms: places[9].appended_ms.unwrap() + 60_000, latest: [].into() };
    let (mut later, starts) = from(&flow.broker, &channel, later).await;
    assert_eq!(starts, [10]);
    // What the server does not have is moved to the nearest.
    let (mut beyond, starts) = from(&flow.broker, &channel, Begin::At([1000].into())).await;
    assert_eq!(starts, [10]);
    let (mut before, starts) = from(&flow.broker, &channel, Begin::At([-5].into())).await;
    assert_eq!(starts, [0]);
    expect(&mut before, 1..=10).await;

    publish(writer.as_ref(), &frame(&channel, 1, 11));
    for reader in
        [&mut first, &mut again, &mut timed, &mut bound, &mut later, &mut beyond, &mut before]
    {
        expect(reader, 11..=11).await;
        assert!(reader.is_silent().await);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_gets_what_is_kept_is_told_where_it_goes_on_too() {
    let server = start_server();
    let flow = Flow::open(&server).await;
    let name = unique_name("keptplaces");
    make_topic(&server, &name, 3, &[]).await;
    let channel: ChannelName = name.parse().unwrap();
    let plain = PlainProducer::new(&server);
    plain.write(&name, 0, &["one", "two"]);
    plain.write(&name, 2, &["one"]);
    let mut reader = subscribe(&flow.broker, &channel, WITH_KEPT).await;
    assert_eq!(reader.subscription.starts(), [2, 0, 1]);
    for (partition, offset) in [(2, 1), (1, 0), (0, 2)] {
        plain.write(&name, partition, &["live"]);
        let place = reader.next().await.place.unwrap();
        assert_eq!((place.partition, place.offset), (usize::try_from(partition).unwrap(), offset));
    }
}
