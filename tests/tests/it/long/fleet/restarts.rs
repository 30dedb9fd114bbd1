//! The main service goes and comes under many workers: they come back one after the other, and
//! users do not wait for them.

use std::time::Duration;

use blaze_tests::fleet::{MainService, MainStore, restart, wait_equal};
use blaze_tests::within;
use serde_json::json;

use super::{PATIENCE, count, make_nodes, node, service, start_workers};

/// After so long each worker waits for up to two seconds before it tries again.
const AWAY: Duration = Duration::from_secs(4);
/// The longest that a worker waits, and time for what it does then.
const BACK: Duration = Duration::from_secs(5);
/// A user's GET at the 99th percentile.
const GET: Duration = Duration::from_secs(1);
/// In any such time at most half of the workers come back; of two seconds, an eighth does on
/// average.
const QUARTER: Duration = Duration::from_millis(250);

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn workers_come_back_one_after_the_other_and_users_do_not_wait_for_them() {
    let workers = count(200, 40);
    let folder = tempfile::tempdir().unwrap();
    let mut main = MainService::start(folder.path(), &MainStore::Sqlite).unwrap();
    let api = main.api().unwrap();
    make_nodes(&api, (0..workers).map(node)).await;
    let others: Vec<_> = (0..50)
        .map(|number| service(&format!("s{number}"), &json!({ "number": number })))
        .collect();
    api.apply(&others).await.unwrap();
    let workers = start_workers(&main, folder.path(), workers).await;
    wait_equal(&api, &workers, PATIENCE).await.unwrap();

    let mut restarted = restart(&mut main, &workers, AWAY, "/services/s7").await.unwrap();
    restarted.gets.sort_unstable();
    let p99 = restarted.gets[restarted.gets.len() * 99 / 100];
    let (first, last) = (restarted.back[0], restarted.back[restarted.back.len() - 1]);
    println!(
        "{} workers back between {first:?} and {last:?}; {} GETs, p99 {p99:?}, {} not answered; \
         away for {:?}",
        workers.len(),
        restarted.gets.len(),
        restarted.refused,
        restarted.away
    );
    assert!(p99 <= within(GET), "a user's GET took {p99:?}");
    // Who is not answered hears so at once, and nobody is refused once the main service is back.
    assert!(restarted.slowest_refusal <= within(GET), "{:?}", restarted.slowest_refusal);
    assert_eq!(restarted.refused_since, 0);
    assert!(last <= within(BACK), "the last worker came back after {last:?}");
    let most = restarted.back.iter().enumerate().map(|(number, begin)| {
        let close = restarted.back[number..].iter().take_while(|time| **time < *begin + QUARTER);
        close.count()
    });
    let most = most.max().unwrap();
    // Those that come back before anybody saw the main service again count as one moment, longer
    // where others run beside.
    let share = if blaze_tests::long() { 0.5 } else { 0.75 };
    assert!(
        most as f64 <= share * workers.len() as f64,
        "{most} of {} workers came back within {QUARTER:?}: {:?}",
        workers.len(),
        restarted.back
    );
    wait_equal(&api, &workers, within(BACK)).await.unwrap();
}
