//! Main service, broker and database are killed while many write. Soon after the last one is back,
//! every worker has exactly what the main service has, and services are told exactly that.

use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::redis::RedisKeys;
use blaze_domain::node_file::{NodeBroker, NodeFile};
use blaze_tests::fleet::{
    Api, MainService, MainStore, Worker, WorkerProcess, WorkerSpec, wait_equal,
};
use blaze_tests::process::usage;
use blaze_tests::servers::{MongoOptions, MongoServer, RedisKind, RedisOptions, RedisServer};
use blaze_tests::{wait, within};
use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use serde_json::Value;
use tokio::task::{JoinSet, block_in_place};

use super::writer::{Progress, SERVICES, Writer, service_name};
use super::{LAYER, PATIENCE, count, make_nodes, node, start_workers};

const WRITERS: usize = 4;
/// All must be equal so soon after the last part answers again and the last write was made.
const EQUAL: Duration = Duration::from_secs(5);
/// Workers in this process whose services are looked at in the end.
const LOOKED_AT: usize = 3;

/// What is killed, in turns; the first one last, as all workers depend on it.
const VICTIMS: [Victim; 3] = [Victim::Main, Victim::Broker, Victim::Database];

#[derive(Debug, Clone, Copy)]
enum Victim {
    Main,
    Broker,
    Database,
}

/// What can be killed.
struct Parts {
    main: MainService,
    redis: RedisServer,
    mongo: MongoServer,
}

impl Parts {
    fn kill(&mut self, victim: Victim) {
        match victim {
            Victim::Main => self.main.start_again().unwrap(),
            Victim::Broker => self.redis.restart().unwrap(),
            Victim::Database => self.mongo.restart().unwrap(),
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_kills_in_the_middle_of_writes_all_workers_have_what_the_main_service_has() {
    let (inside, outside) = (count(200, 20), count(5, 2));
    let (kills, goal) = (count(20, 3), count(5_000, 300));
    let folder = tempfile::tempdir().unwrap();
    let mongo = MongoServer::start(MongoOptions::default()).unwrap();
    let redis = RedisServer::start(RedisKind::Redis, RedisOptions::default()).unwrap();
    let store = MainStore::Mongo { uri: mongo.uri(), database: "main".to_owned() };
    let main = MainService::start(folder.path(), &store).unwrap();
    let api = main.api().unwrap();
    let names: Vec<String> = (0..inside).map(node).chain((0..outside).map(process_node)).collect();
    make_nodes(&api, names.clone()).await;
    let workers = start_workers(&main, folder.path(), inside).await;
    let processes: Vec<(String, WorkerProcess)> = (0..outside)
        .map(|number| {
            let name = process_node(number);
            let spec = WorkerSpec::on_memory(LAYER, &name, &main.server()).on_redis(&redis.url());
            (name, WorkerProcess::start(folder.path(), &spec).unwrap())
        })
        .collect();
    wait_equal(&api, &workers, PATIENCE).await.unwrap();
    println!("{inside} workers in this process: {}", usage(std::process::id()).unwrap());

    let begun = Instant::now();
    let progress = Arc::new(Progress::new(goal));
    let mut writers = JoinSet::new();
    for number in 0..WRITERS {
        let own = names.iter().skip(number).step_by(WRITERS).cloned().collect();
        writers.spawn(Writer::new(api.clone(), number, own, Arc::clone(&progress)).run());
    }
    let mut parts = Parts { main, redis, mongo };
    block_in_place(|| kill_all(&mut parts, kills, goal, &progress));
    while let Some(written) = writers.join_next().await {
        written.unwrap();
    }
    assert_eq!(progress.fault(), None);
    let ended = Instant::now();
    all_equal(&api, &workers, &processes).await;
    let (unknown, refused) = progress.others();
    println!(
        "{} writes ({unknown} unknown, {refused} of what was gone) and {kills} kills in {:?}; all \
         equal after {:?}; {}",
        progress.done(),
        ended - begun,
        ended.elapsed(),
        usage(std::process::id()).unwrap()
    );
    services_are_told_that(&api, &workers, &processes, &parts.redis).await;
}

fn process_node(number: usize) -> String {
    format!("process-{number}")
}

/// Kills one after the other, in the middle of the writes; each is back before the next.
fn kill_all(parts: &mut Parts, kills: usize, goal: usize, progress: &Progress) {
    let mut random = StdRng::seed_from_u64(7);
    for index in 0..kills {
        let victim = VICTIMS[(kills - 1 - index) % VICTIMS.len()];
        // The last one when all is written: then all must be equal soon after it answers again.
        let due = goal * (index + 1) / kills;
        wait::until(
            &format!("{due} writes"),
            Duration::from_secs(600),
            || progress.done() >= due || progress.fault().is_some(),
            || format!("there are {}", progress.done()),
        )
        .unwrap();
        // Not on a condition: it is to hit any point of a commit.
        std::thread::sleep(Duration::from_micros(random.random_range(0..10_000)));
        parts.kill(victim);
    }
}

/// Waits until all have what the main service has.
async fn all_equal(api: &Api, workers: &[Worker], processes: &[(String, WorkerProcess)]) {
    let begun = Instant::now();
    // The main service may have lost its store only just now.
    let digest = loop {
        match api.digest(LAYER).await {
            Ok(digest) => break digest,
            Err(error) => assert!(begun.elapsed() < within(EQUAL), "{error:#}"),
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    };
    if let Err(error) =
        wait_equal(api, workers, within(EQUAL).saturating_sub(begun.elapsed())).await
    {
        panic!("{error:#}");
    }
    for (name, process) in processes {
        loop {
            let status = block_in_place(|| process.status()).unwrap();
            if status["digest"] == digest.as_str()
                && status["connected"] == true
                && status["source"] == "main"
            {
                break;
            }
            assert!(begun.elapsed() < within(EQUAL), "{name} has not {digest}: {status}");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
}

/// What services on a node have by the main service, against what they are told: by the worker, and
/// by the keys in Redis.
async fn services_are_told_that(
    api: &Api,
    workers: &[Worker],
    processes: &[(String, WorkerProcess)],
    redis: &RedisServer,
) {
    let begun = Instant::now();
    for worker in workers.iter().take(LOOKED_AT) {
        for name in all_services() {
            let expected = hash(api, &name, worker.node().as_str()).await;
            // What has come just now is told within 20 ms.
            while told(worker, &name).await != expected {
                assert!(
                    begun.elapsed() < within(EQUAL),
                    "{name} at {} was not told {expected}",
                    worker.node()
                );
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        }
    }
    for (node, _) in processes {
        let keys = keys(&redis.url(), node);
        for name in all_services() {
            let expected = hash(api, &name, node).await;
            let begun = Instant::now();
            // A notice waits until the broker takes it.
            loop {
                let found = keys.get(&format!("blaze:config:{name}")).await;
                let found = found.map(|key| {
                    key.map_or(Value::Null, |key| serde_json::from_slice::<Value>(&key).unwrap())
                });
                if found.as_ref().is_ok_and(|key| key["hash"] == expected) {
                    break;
                }
                assert!(
                    begun.elapsed() < within(EQUAL),
                    "key of {name} at {node}: {found:?}, not {expected}"
                );
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        }
    }
}

/// Hash of what the service without instance was told last; null: nothing, or that it is gone.
async fn told(worker: &Worker, service: &str) -> Value {
    let status = worker.running().status().await.unwrap();
    let rows = status.json["services"].as_array().unwrap();
    let row = rows.iter().find(|row| row["service"] == service && row["instance"].is_null());
    row.map(|row| row["hash"].clone()).unwrap_or_default()
}

fn all_services() -> impl Iterator<Item = String> {
    (0..WRITERS).flat_map(|writer| (0..SERVICES).map(move |number| service_name(writer, number)))
}

/// By the main service; null: there is no such service.
async fn hash(api: &Api, service: &str, node: &str) -> Value {
    let path = format!("/effective?service={service}&node={node}");
    match api.send(reqwest::Method::GET, &path, None).await {
        blaze_tests::fleet::Told::Done(answer) => answer["hash"].clone(),
        blaze_tests::fleet::Told::Refused { status: 404, .. } => Value::Null,
        other => panic!("{path}: {other:?}"),
    }
}

fn keys(url: &str, node: &str) -> RedisKeys {
    let file = serde_json::json!({ "brokers": { "node": { "redis": { "url": url,
        "prefix": format!("{node}:") } } } });
    match NodeFile::read(&file).unwrap().0.brokers.node {
        Some(NodeBroker::Redis(section)) => RedisKeys::open(&section).unwrap(),
        other => panic!("{other:?}"),
    }
}
