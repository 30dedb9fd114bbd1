//! How fast a store writes; shown, not judged.

use std::time::Instant;

use blaze_config::store::{CommitLog, CommitRecord, MongoStore, SqliteStore};
use blaze_runtime::Supervisor;

use super::support::{record, server};

async fn rates(what: &str, store: &dyn CommitLog) {
    let mut head = store.head().await.unwrap();
    for size in [1_u64, 16, 64, 256] {
        let (begin, mut groups) = (Instant::now(), 0_u32);
        while begin.elapsed().as_secs() < 2 {
            let group: Vec<CommitRecord> = (1..=size)
                .map(|step| record(head + step, &format!("batch-{head}")))
                .collect();
            store.commit(&group).await.unwrap();
            head += size;
            groups += 1;
        }
        let seconds = begin.elapsed().as_secs_f64();
        let commits = f64::from(groups) * f64::from(u32::try_from(size).unwrap());
        println!(
            "{what}: groups of {size}: {:.0} commits/s, {:.2} ms a group",
            commits / seconds,
            seconds * 1e3 / f64::from(groups)
        );
    }
    let (begin, mut reads) = (Instant::now(), 0_u32);
    while begin.elapsed().as_secs() < 1 {
        store.head().await.unwrap();
        reads += 1;
    }
    println!("{what}: {reads} reads of the head/s");
    let begin = Instant::now();
    let documents = store.load().await.unwrap().documents.len();
    println!("{what}: {documents} documents loaded in {:?}", begin.elapsed());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "shows rates, for a quiet machine"]
async fn commits_per_second() {
    let folder = tempfile::tempdir().unwrap();
    let sqlite = SqliteStore::open(&folder.path().join("store.db"), &Supervisor::new("rates"))
        .await
        .unwrap();
    rates("SQLite", &sqlite).await;
    let server = server();
    let mongo = MongoStore::open(&server.uri(), "blaze_test").await.unwrap();
    rates("MongoDB", &mongo).await;
}
