//! What is handed on to the engine, and what is not.

use blaze_brokers::memory::MemoryHub;
use blaze_brokers::{Publisher, PublisherOptions};
use blaze_domain::node_file::{NodeBroker, NodeFile};
use tokio::task::JoinSet;

use super::*;

async fn publisher(broker: &dyn Broker, channel: &str) -> Arc<dyn Publisher> {
    broker
        .publisher(&channel.parse().unwrap(), PublisherOptions::default())
        .unwrap()
}

async fn within<T>(work: impl Future<Output = T>) -> T {
    tokio::time::timeout(Duration::from_secs(20), work)
        .await
        .expect("within 20 s")
}

#[tokio::test]
async fn what_comes_on_a_channel_is_handed_on_in_its_order() {
    let hub = MemoryHub::new("edge");
    let (broker, other): (Arc<dyn Broker>, Arc<dyn Broker>) = (Arc::new(hub.broker()), Arc::new(hub.broker()));
    let (send, mut heard) = mpsc::channel(4);
    let mut tasks = JoinSet::new();
    tasks.spawn(listen(Arc::clone(&broker), ACK, send, Sign::Ack, Arc::default()));
    let (acks, elsewhere) = (publisher(&*other, ACK).await, publisher(&*other, GET).await);
    // Until it listens nobody hears.
    let first = async {
        loop {
            acks.publish_bare(&Bytes::from("0"), None);
            if let Ok(Some(sign)) = tokio::time::timeout(Duration::from_millis(20), heard.recv()).await {
                return sign;
            }
        }
    };
    assert!(matches!(within(first).await, Sign::Ack(bytes) if bytes == "0"));
    elsewhere.publish_bare(&Bytes::from("of another channel"), None);
    for number in 1..=100 {
        acks.publish_bare(&Bytes::from(number.to_string()), None);
    }
    let mut last = 0;
    while last < 100 {
        let Some(Sign::Ack(bytes)) = within(heard.recv()).await else {
            panic!("something else was handed on");
        };
        let number: u32 = std::str::from_utf8(&bytes).unwrap().parse().unwrap();
        assert!(number == last + 1 || number == 0, "{number} after {last}");
        last = last.max(number);
    }
}

#[tokio::test(start_paused = true)]
async fn that_the_broker_is_away_is_said_each_second_and_once_more_when_it_is_back() {
    let status = |health| BrokerStatus {
        health,
        detail: String::new(),
        since: std::time::Instant::now(),
    };
    let (set, seen) = watch::channel(status(Health::Up));
    let (send, mut heard) = mpsc::channel(64);
    let mut tasks = JoinSet::new();
    tasks.spawn(notice_deafness(seen, send));
    let count = async |heard: &mut mpsc::Receiver<Sign>| {
        tokio::time::sleep(Duration::from_millis(10_500)).await;
        let mut count = 0;
        while let Ok(sign) = heard.try_recv() {
            assert!(matches!(sign, Sign::Deaf));
            count += 1;
        }
        count
    };
    assert_eq!(count(&mut heard).await, 0, "a broker that is up is no news");
    set.send_replace(status(Health::Down));
    let away = count(&mut heard).await;
    assert!((10..=12).contains(&away), "{away}");
    set.send_replace(status(Health::Up));
    let back = count(&mut heard).await;
    assert!((1..=2).contains(&back), "services need their time: {back}");
    assert_eq!(count(&mut heard).await, 0);
}

#[tokio::test(start_paused = true)]
async fn a_redis_that_is_away_is_never_taken_for_one_without_records() {
    let file = serde_json::json!({ "brokers": { "node": { "redis": { "url": "redis://127.0.0.1:1" } } } });
    let Some(NodeBroker::Redis(section)) = NodeFile::read(&file).unwrap().0.brokers.node else {
        panic!("no Redis in {file}");
    };
    let keys = Arc::new(RedisKeys::open(&section).unwrap());
    let (send, mut heard) = mpsc::channel(64);
    let mut tasks = JoinSet::new();
    tasks.spawn(scan(keys, send));
    tokio::time::sleep(SCAN * 5).await;
    assert!(heard.try_recv().is_err(), "nothing was found because nobody could look");
}
