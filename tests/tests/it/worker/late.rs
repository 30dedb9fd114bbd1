//! A database that answers only when the worker serves its file already.

use blaze_tests::proxy::Proxy;
use blaze_tests::servers::{MongoOptions, MongoServer};
use serde_json::{Value, json};

use super::kit::Robot;
use super::stage::{PATIENCE, Stage, next};

fn rate(rate_hz: u64) -> Value {
    json!({ "config": { "camera": { "rate_hz": rate_hz } } })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_late_database_has_newer_is_served_and_not_written_over() {
    let mongo = MongoServer::start(MongoOptions {
        alone: true,
        ..MongoOptions::default()
    })
    .unwrap();
    let stage = Stage::new();
    let _main = stage.main();
    stage.robot().await;
    let main_at = stage.grpc;
    // It has a runtime of its own, which cannot be started on a thread of this one.
    let link = tokio::task::spawn_blocking(move || Proxy::start(main_at).unwrap())
        .await
        .unwrap();
    let robot = Robot::new(&stage, "robot-1").with(&json!({
        "config": { "server": format!("http://{}", link.address()) },
        "database": { "mongodb": { "uri": mongo.uri(), "database": "copy" } },
    }));
    let worker = robot.worker(&stage);
    stage.put("/services/slam", rate(7)).await;
    stage.equal(&worker, PATIENCE).await;
    worker.has_kept_all(2).await;
    let file = stage.path("robot-1").join("last-known-good");
    let older = std::fs::read(&file).unwrap();
    let newest = stage.put("/services/slam", rate(8)).await;
    stage.equal(&worker, PATIENCE).await;
    worker.has_kept_all(2).await;

    // As if it had been killed before the file was written, with the main service out of reach.
    link.stall();
    worker.kill();
    std::fs::write(&file, older).unwrap();
    mongo.freeze().unwrap();
    let worker = robot.worker(&stage);
    let mut service = robot.service().await;
    let mut slam = service.listen("slam").await;
    let asks = json!({ "service": "slam", "instance": "0" });
    let served = |answer: &Value| (answer["config"]["camera"]["rate_hz"].clone(), answer["source"].clone());
    let answer = service.ask(asks.clone(), PATIENCE).await;
    assert_eq!(served(&answer), (json!(7), json!("copy")));
    mongo.thaw().unwrap();
    while next(&mut slam).await["config"]["camera"]["rate_hz"] != 8 {}
    let answer = service.ask(asks.clone(), PATIENCE).await;
    assert_eq!(served(&answer), (json!(8), json!("copy")));
    let status = worker.status().await;
    assert_eq!(
        (&status["connected"], status["revision"].as_u64()),
        (&json!(false), Some(newest))
    );

    // The database still has it, alone.
    worker.has_kept_all(2).await;
    worker.kill();
    std::fs::remove_file(&file).unwrap();
    let worker = robot.worker(&stage);
    let answer = robot.service().await.ask(asks, PATIENCE).await;
    assert_eq!(served(&answer), (json!(8), json!("copy")));
    link.heal();
    stage.equal(&worker, PATIENCE).await;
}
