//! Whatever is away, services have what they had; whatever comes back, they get what has become of it, once.

use std::time::Duration;

use blaze_tests::within;
use serde_json::{Value, json};

use super::stage::{PATIENCE, Stage, next, rest};

/// Everything that matters must be equal so soon after the last part answers again.
const EQUAL: Duration = Duration::from_secs(5);

fn rate(rate_hz: u64) -> Value {
    json!({ "config": { "camera": { "rate_hz": rate_hz } } })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_the_main_service_everything_is_answered_and_afterwards_all_is_made_up_for() {
    let stage = Stage::new();
    let mut main = stage.main();
    stage.robot().await;
    let worker = stage.worker("robot-1");
    stage.equal(&worker, PATIENCE).await;
    let mut service = stage.service().await;
    let (mut slam, mut nav) = (service.listen("slam").await, service.listen("nav").await);
    main.kill().unwrap();
    worker
        .until("the outage is noticed", |status| status["connected"] == false)
        .await;
    let answer = service
        .ask(json!({ "service": "slam", "instance": "0" }), PATIENCE)
        .await;
    assert_eq!(
        (&answer["source"], &answer["config"]["camera"]["rate_hz"]),
        (&json!("copy"), &json!(30))
    );
    rest(&mut slam).await;
    rest(&mut nav).await;

    // It comes back with changes that the worker sees only from their result.
    let main = stage.main();
    for rate_hz in [1, 2, 3] {
        stage.put("/services/slam", rate(rate_hz)).await;
    }
    stage.send(reqwest::Method::DELETE, "/services/nav", None).await;
    stage.equal(&worker, within(EQUAL)).await;
    let mut last = next(&mut slam).await;
    while last["config"]["camera"]["rate_hz"] != 3 {
        last = next(&mut slam).await;
    }
    assert_eq!(next(&mut nav).await["deleted"], true);
    drop(main);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_everything_was_killed_services_get_their_last_configuration_at_once() {
    let stage = Stage::new();
    let mut main = stage.main();
    stage.robot().await;
    let worker = stage.worker("robot-1");
    stage.put("/services/slam", rate(7)).await;
    stage.send(reqwest::Method::DELETE, "/services/nav", None).await;
    stage.equal(&worker, PATIENCE).await;
    let mut service = stage.service().await;
    let asks = json!({ "service": "slam", "instance": "0" });
    // What came in the last 20 ms is shown with what comes until then.
    let shown = tokio::time::Instant::now();
    let before = loop {
        let answer = service.ask(asks.clone(), PATIENCE).await;
        if answer["config"]["camera"]["rate_hz"] == 7 {
            break answer;
        }
        assert!(shown.elapsed() < PATIENCE, "{answer}");
    };
    let newest = stage.get("/digest?layer=edge").await["revision"].as_u64().unwrap();
    worker.has_kept_all(1).await;
    main.kill().unwrap();
    worker.kill();
    stage.redis.kill().unwrap();
    stage.redis.restart().unwrap();
    let worker = stage.worker("robot-1");
    let mut service = stage.service().await;
    let answer = service.ask(asks, within(Duration::from_secs(2))).await;
    assert_eq!(
        (&answer["hash"], &answer["config"]),
        (&before["hash"], &before["config"])
    );
    assert_eq!(answer["source"], "copy");
    // What was told is noted shortly after the broker has taken it. Whoever is killed in between goes on from where the store
    // stood: never older than what was told, and nothing that does not exist.
    let revision = |answer: &Value| answer["revision"].as_u64().unwrap();
    let promised = revision(&before)..=newest;
    assert!(promised.contains(&revision(&answer)), "{answer} is not of {promised:?}");
    let gone = service.ask(json!({ "service": "nav" }), PATIENCE).await;
    assert_eq!(gone["error"]["code"], "not_found", "what was deleted stays deleted");
    worker.until("the key is back", |_| true).await;
    let key = stage
        .keys()
        .get("blaze:config:slam:0")
        .await
        .unwrap()
        .expect("the key is there again");
    assert!(String::from_utf8_lossy(&key).contains(before["hash"].as_str().unwrap()));

    let _main = stage.main();
    stage.equal(&worker, within(EQUAL)).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_anything_the_mounted_file_serves_until_the_main_service_is_there() {
    let stage = Stage::new();
    let defaults = stage.path("defaults.yaml");
    let file = |rate_hz: u64| {
        format!(
            "kind: Layer\nname: edge\nspec: {{ kind: edge }}\n---\nkind: Service\nname: slam\nspec: {{ config: {{ camera: {{ rate_hz: {rate_hz} }} }} }}\n"
        )
    };
    std::fs::write(&defaults, file(1)).unwrap();
    let worker = stage.worker_with("robot-1", json!({ "defaults_file": defaults }));
    let mut service = stage.service().await;
    let asks = json!({ "service": "slam", "instance": "0" });
    let answer = service.ask(asks.clone(), PATIENCE).await;
    assert_eq!(
        (&answer["source"], &answer["config"]["camera"]["rate_hz"]),
        (&json!("file"), &json!(1))
    );
    let mut slam = service.listen("slam").await;
    std::fs::write(&defaults, file(2)).unwrap();
    assert_eq!(next(&mut slam).await["config"]["camera"]["rate_hz"], 2);
    std::fs::write(&defaults, "kind: [").unwrap();
    let start = tokio::time::Instant::now();
    while !worker.text("/readyz").await.contains("defaults.yaml") {
        assert!(start.elapsed() < PATIENCE, "{}", worker.text("/readyz").await);
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert_eq!(
        service.ask(asks.clone(), PATIENCE).await["config"]["camera"]["rate_hz"],
        2
    );

    let _main = stage.main();
    stage.robot().await;
    stage.equal(&worker, PATIENCE).await;
    let answer = service.ask(asks, PATIENCE).await;
    assert_eq!(
        (&answer["source"], &answer["config"]["camera"]["rate_hz"]),
        (&json!("main"), &json!(30))
    );
}
