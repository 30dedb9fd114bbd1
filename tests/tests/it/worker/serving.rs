//! What services are told, and who is not; what the mounted file serves.

use std::time::Duration;

use serde_json::json;

use super::stage::{PATIENCE, Stage, next, rest};

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
    let worker = stage.worker_with("robot-1", &json!({ "defaults_file": defaults }));
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
    assert_eq!(service.ask(asks.clone(), PATIENCE).await["config"]["camera"]["rate_hz"], 2);

    let _main = stage.main();
    stage.robot().await;
    stage.equal(&worker, PATIENCE).await;
    let answer = service.ask(asks, PATIENCE).await;
    assert_eq!(
        (&answer["source"], &answer["config"]["camera"]["rate_hz"]),
        (&json!("main"), &json!(30))
    );
}

mod quick {
    use super::*;

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_change_reaches_whom_it_concerns_and_nobody_else() {
        let stage = Stage::new();
        let _main = stage.main();
        stage.robot().await;
        let worker = stage.worker("robot-1");
        stage.equal(&worker, PATIENCE).await;
        let mut service = stage.service().await;
        let (mut slam, mut nav) = (service.listen("slam").await, service.listen("nav").await);

        let answer = service.ask(json!({ "service": "slam", "instance": "0" }), PATIENCE).await;
        assert_eq!(answer["config"], json!({ "camera": { "rate_hz": 30 }, "verbosity": "info" }));
        assert_eq!((&answer["source"], &answer["node"]), (&json!("main"), &json!("robot-1")));
        let effective = stage.get("/effective?service=slam&instance=0").await;
        assert_eq!(
            (&answer["hash"], &answer["config"]),
            (&effective["hash"], &effective["config"])
        );
        let again = json!({ "service": "slam", "instance": "0", "hash": answer["hash"] });
        assert_eq!(service.ask(again, PATIENCE).await["unchanged"], true);
        let misspelt = service.ask(json!({ "service": "slamm" }), PATIENCE).await;
        assert_eq!(misspelt["error"]["code"], "not_found");
        assert!(misspelt["error"]["detail"].as_str().unwrap().contains("slam?"), "{misspelt}");

        rest(&mut slam).await;
        rest(&mut nav).await;
        let instance = json!({ "node": "robot-1", "config": { "camera": { "rate_hz": 10 } } });
        let revision = stage.put("/services/slam/instances/0", instance).await;
        let notice = next(&mut slam).await;
        assert_eq!((&notice["revision"], &notice["instance"]), (&json!(revision), &json!("0")));
        assert_eq!(
            (&notice["paths"], &notice["scopes"]),
            (&json!(["/camera/rate_hz"]), &json!(["instance"]))
        );
        assert_eq!(notice["previous_hash"], answer["hash"]);
        assert_eq!(notice["config"]["camera"]["rate_hz"], 10);
        // The key was written no later than the notice.
        let key = stage.keys().get("blaze:config:slam:0").await.unwrap().expect("the key is there");
        let key: serde_json::Value = serde_json::from_slice(&key).unwrap();
        assert_eq!((&key["hash"], &key["config"]), (&notice["hash"], &notice["config"]));

        let of_nav = rest(&mut nav).await;
        assert!(of_nav.is_empty(), "it concerns nobody else: {of_nav:?}");

        let known = stage.get("/workers").await;
        let known = &known["items"][0];
        assert_eq!(
            (&known["layer"], &known["node"], &known["connected"]),
            (&json!("edge"), &json!("robot-1"), &json!(true))
        );
        let metrics = worker.text("/metrics").await;
        for line in ["blaze_worker_connected 1", "blaze_worker_source{source=\"main\"} 1"] {
            assert!(metrics.lines().any(|found| found == line), "{line} is not in\n{metrics}");
        }
        worker.stop();
    }
}
