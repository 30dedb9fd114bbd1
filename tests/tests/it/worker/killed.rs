//! Behind a cut link the worker, its broker and its database are killed, all at once. Services have
//! their last configuration two seconds after the broker is there again, whichever of the copies is
//! left.

use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::Role;
use blaze_brokers::redis::RedisBroker;
use blaze_domain::Scope;
use blaze_sdk::{ConfigSource, ServiceManager, ServiceOptions};
use blaze_tests::proxy::Proxy;
use blaze_tests::servers::{MongoOptions, MongoServer};
use blaze_tests::within;
use reqwest::Method;
use serde_json::{Value, json};
use tokio::time::Instant;

use super::kit::{Robot, content, next_that};
use super::stage::{PATIENCE, Stage, Worker, section};

/// After the broker accepts connections.
const SERVED: Duration = Duration::from_secs(2);
/// After the link is whole again.
const EQUAL: Duration = Duration::from_secs(5);

fn rate(rate_hz: u64) -> Value {
    json!({ "config": { "camera": { "rate_hz": rate_hz } } })
}

/// A service that uses the SDK.
async fn with_sdk(robot: &Robot) -> ServiceManager {
    let broker = Arc::new(RedisBroker::open(&section(&robot.redis), &Role::Service).unwrap());
    let options =
        ServiceOptions::new("edge".parse().unwrap(), "slam".parse().unwrap(), broker, Scope::Node);
    ServiceManager::start(options.on_node(robot.node.parse().unwrap())).await.unwrap()
}

/// What services had before the fall, and must have after it.
struct Last {
    hash: String,
    /// Of the configuration, and of the store.
    revisions: (u64, u64),
}

impl Last {
    /// A plain client, a key and a service with the SDK have it, from the copy. `up`: when the
    /// broker came back.
    async fn is_served(&self, robot: &Robot, up: Instant, what: &str) {
        let mut plain = robot.service().await;
        let served = within(SERVED);
        let left = || served.saturating_sub(up.elapsed());
        let answer = plain.ask(json!({ "service": "slam", "instance": "0" }), left()).await;
        let took = up.elapsed();
        assert!(took <= served, "{what}: {took:?}");
        println!("{what}: answered {took:?} after the broker was back");
        assert_eq!(
            (&answer["hash"], &answer["source"]),
            (&json!(self.hash), &json!("copy")),
            "{what}"
        );
        assert_eq!(answer["config"]["camera"]["rate_hz"], 7, "{what}");
        let (oldest, newest) = self.revisions;
        let revision = answer["revision"].as_u64().unwrap();
        assert!(
            (oldest..=newest).contains(&revision),
            "{what}: {revision} of {oldest} to {newest}"
        );
        let service = with_sdk(robot).await;
        service.config().ready(PATIENCE).await.unwrap();
        assert_eq!(service.config().hash().as_deref(), Some(self.hash.as_str()), "{what}");
        assert_eq!(service.config().source(), Some(ConfigSource::Copy), "{what}");
        service.shutdown().await;
        let gone = plain.ask(json!({ "service": "nav" }), PATIENCE).await;
        assert_eq!(gone["error"]["code"], "not_found", "{what}: what was deleted stays deleted");
        let key = loop {
            match robot.key("blaze:config:slam:0").await {
                Some(key) => break key,
                None => assert!(up.elapsed() < PATIENCE, "{what}: the key is not there again"),
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        };
        assert_eq!(key["hash"], self.hash.as_str(), "{what}");
        assert_eq!(robot.key("blaze:config:nav").await, None, "{what}");
    }
}

async fn all_is_killed_and_comes_back(alone: bool) {
    let mongo = MongoServer::start(MongoOptions { alone, ..MongoOptions::default() }).unwrap();
    let stage = Stage::new();
    let _main = stage.main();
    stage.robot().await;
    let main_at = stage.grpc;
    // It has a runtime of its own, which cannot be started on a thread of this one.
    let link = tokio::task::spawn_blocking(move || Proxy::start(main_at).unwrap()).await.unwrap();
    // Something weaker is at hand all the time, and says something else.
    let defaults = stage.path("defaults.yaml");
    let weaker = "kind: Layer\nname: edge\nspec: { kind: edge }\n---\nkind: Service\nname: slam\nspec: { config: { camera: { rate_hz: 1 } } }\n---\nkind: Service\nname: nav\nspec: {}\n";
    std::fs::write(&defaults, weaker).unwrap();
    let robot = Robot::new(&stage, "robot-1").with(&json!({
        "config": { "server": format!("http://{}", link.address()) },
        "database": { "mongodb": { "uri": mongo.uri(), "database": "copy" } },
        "worker": { "defaults_file": defaults },
    }));
    let worker = robot.worker(&stage);
    stage.put("/services/slam", rate(7)).await;
    stage.send(Method::DELETE, "/services/nav", None).await;
    stage.equal(&worker, PATIENCE).await;
    worker.has_kept_all(2).await;
    let before =
        robot.service().await.ask(json!({ "service": "slam", "instance": "0" }), PATIENCE).await;
    assert_eq!(before["config"]["camera"]["rate_hz"], 7);
    let lived = with_sdk(&robot).await;
    lived.config().ready(PATIENCE).await.unwrap();
    worker.has_kept_all(2).await;
    let last = Last {
        hash: before["hash"].as_str().unwrap().to_owned(),
        revisions: (
            before["revision"].as_u64().unwrap(),
            stage.get("/digest?layer=edge").await["revision"].as_u64().unwrap(),
        ),
    };

    // What the main service has from now on does not come through.
    link.stall();
    stage.put("/services/slam", rate(8)).await;
    worker.kill();
    robot.redis.kill().unwrap();
    mongo.kill().unwrap();
    // The database stays away, the file is there. The worker waits for the broker.
    let worker = robot.worker_unready(&stage).listening();
    let readiness = worker.text("/readyz").await;
    assert!(readiness.contains("not_ready") && readiness.contains("node_broker"), "{readiness}");
    robot.redis.restart().unwrap();
    last.is_served(&robot, Instant::now(), "the file alone").await;
    // The other way round: the broker waits for the worker, which has to come up within the time.
    worker.kill();
    robot.redis.restart().unwrap();
    let up = Instant::now();
    let worker = robot.worker(&stage);
    last.is_served(&robot, up, "the file alone, the worker last").await;
    // Who lived through all that has what it had.
    assert_eq!(lived.config().hash().as_deref(), Some(last.hash.as_str()));

    // Now the database alone.
    mongo.restart().unwrap();
    worker.has_kept_all(2).await;
    worker.kill();
    robot.redis.kill().unwrap();
    std::fs::remove_file(stage.path("robot-1").join("last-known-good")).unwrap();
    let worker = robot.worker_unready(&stage).listening();
    robot.redis.restart().unwrap();
    last.is_served(&robot, Instant::now(), "the database alone").await;
    assert_eq!(worker.status().await["connected"], false);

    let listener = robot.service().await;
    let mut notices = listener.listen("slam").await;
    link.heal();
    let healed = Instant::now();
    stage.equal(&worker, within(EQUAL)).await;
    println!("equal {:?} after the link was whole", healed.elapsed());
    let notice = next_that(&mut notices, |notice| notice["instance"] == "0").await;
    assert_eq!(
        (&notice["config"]["camera"]["rate_hz"], &notice["previous_hash"]),
        (&json!(8), &before["hash"]),
        "one notice, of the final state"
    );
    let start = Instant::now();
    while lived.config().value().unwrap()["camera"]["rate_hz"] != 8 {
        assert!(start.elapsed() < PATIENCE, "{:?}", lived.config().value());
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    lived.shutdown().await;
    if alone {
        a_late_database_has_something_newer(&stage, &robot, &link, &mongo, worker).await;
    }
}

/// The database answers only when the worker already serves its file, which is older: as if it had
/// been killed before that was written.
async fn a_late_database_has_something_newer(
    stage: &Stage,
    robot: &Robot,
    link: &Proxy,
    mongo: &MongoServer,
    worker: Worker,
) {
    const NEWER: &str = "\"rate_hz\":9";
    worker.has_kept_all(2).await;
    let file = stage.path("robot-1").join("last-known-good");
    let older = std::fs::read(&file).unwrap();
    let newest = stage.put("/services/slam", rate(9)).await;
    stage.equal(&worker, PATIENCE).await;
    worker.has_kept_all(2).await;
    link.stall();
    worker.kill();
    std::fs::write(&file, older).unwrap();
    assert!(!content(&file).contains(NEWER));
    mongo.freeze().unwrap();
    let worker = robot.worker(stage);
    let mut service = robot.service().await;
    let mut notices = service.listen("slam").await;
    let asks = json!({ "service": "slam", "instance": "0" });
    let served =
        |answer: &Value| (answer["config"]["camera"]["rate_hz"].clone(), answer["source"].clone());
    let answer = service.ask(asks.clone(), PATIENCE).await;
    assert_eq!(served(&answer), (json!(8), json!("copy")));

    mongo.thaw().unwrap();
    next_that(&mut notices, |notice| notice["config"]["camera"]["rate_hz"] == 9).await;
    let answer = service.ask(asks.clone(), PATIENCE).await;
    assert_eq!(served(&answer), (json!(9), json!("copy")));
    let status = worker.status().await;
    assert_eq!((&status["connected"], status["revision"].as_u64()), (&json!(false), Some(newest)));
    worker.has_kept_all(2).await;
    assert!(content(&file).contains(NEWER), "the file has it as well");
    // And the database still has it.
    worker.kill();
    std::fs::remove_file(&file).unwrap();
    let _worker = robot.worker(stage);
    let answer = service.ask(asks, PATIENCE).await;
    assert_eq!(served(&answer), (json!(9), json!("copy")));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn with_a_database_that_is_alone() {
    all_is_killed_and_comes_back(true).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn with_a_database_that_is_a_replica_set() {
    all_is_killed_and_comes_back(false).await;
}
