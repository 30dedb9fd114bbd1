//! What is handed on to the engine, and what is not.

use blaze_domain::node_file::{NodeBroker, NodeFile};
use tokio::task::JoinSet;

use super::*;

#[tokio::test(start_paused = true)]
async fn that_the_broker_is_away_is_said_each_second_and_once_more_when_it_is_back() {
    let status =
        |health| BrokerStatus { health, detail: String::new(), since: std::time::Instant::now() };
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
    let file =
        serde_json::json!({ "brokers": { "node": { "redis": { "url": "redis://127.0.0.1:1" } } } });
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
