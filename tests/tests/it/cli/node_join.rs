//! `blaze node join`.

use blaze_tests::process::Process;
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer};
use blaze_tests::wait;
use serde_json::json;

use crate::cli::stage::{PATIENCE, Stage, mode, ready};

#[test]
fn a_node_that_joins_has_a_node_file_with_which_its_worker_is_taken() {
    let stage = Stage::new();
    let main = stage.main_with_tokens();
    let redis = RedisServer::start(RedisKind::Redis, RedisOptions::default()).unwrap();
    let join = format!(
        "node join robot-1 --layer edge --type mobile --label site=lab --node-broker {} --grpc \
         http://{} --state-dir {}",
        redis.url(),
        main.grpc,
        stage.path("state").display()
    );

    // Without the layer there is nothing to join, and nothing is left behind.
    let early = stage.blaze(&main, &join);
    assert_eq!(early.code, 4, "{early:?}");
    assert!(early.stderr.contains("blaze apply -f -"), "{early:?}");
    assert!(!stage.path("robot-1.token").exists());
    let layer = stage.write("edge.yaml", "kind: Layer\nname: edge\nspec: { kind: edge }\n");
    assert_eq!(stage.blaze(&main, &format!("apply -f {}", layer.display())).code, 0);

    // A trial changes nothing.
    let trial = stage.blaze(&main, &format!("{join} --dry-run -o json"));
    assert_eq!(trial.code, 0, "{trial:?}");
    assert_eq!(
        (&trial.json()["node"]["action"], &trial.json()["token"]["action"]),
        (&json!("created"), &json!("created"))
    );
    assert_eq!(stage.blaze(&main, "get node robot-1").code, 4);
    assert!(!stage.path("robot-1.token").exists());

    let joined = stage.blaze(&main, &join);
    assert_eq!(joined.code, 0, "{joined:?}");
    let token = std::fs::read_to_string(stage.path("robot-1.token")).unwrap();
    assert_eq!(mode(&stage.path("robot-1.token")), 0o600);
    for said in [&joined.stdout, &joined.stderr] {
        assert!(!said.contains(token.trim()), "the text of the token is shown");
    }
    let node = stage.blaze(&main, "get node robot-1 -o json").json();
    assert_eq!(node["spec"], json!({ "layer": "edge", "type": "mobile" }));
    assert_eq!(node["labels"], json!({ "site": "lab" }));

    // What it printed is fit for the programs of the node.
    let file = stage.write("blaze.yaml", &joined.stdout);
    let file = file.to_str().unwrap();
    for program in ["blaze-flow", "blaze-worker"] {
        let checked = stage.run(program, &["--check", "--config", file]);
        assert_eq!(checked.code, 0, "{program}: {checked:?}");
    }
    let worker = Process::start(
        "blaze-worker",
        &["--config", file, "--set", "admin.worker=127.0.0.1:0"],
        None,
    )
    .unwrap();
    ready(&worker);
    wait::until(
        "the worker is known",
        PATIENCE,
        || {
            let workers = stage.blaze(&main, "workers -o json").json();
            let worker = &workers["items"][0];
            worker["node"] == "robot-1" && worker["connected"] == true
        },
        || worker.tail(),
    )
    .unwrap();

    // Again: nothing changes, the token stays.
    let again = stage.blaze(&main, &join);
    assert_eq!((again.code, &again.stdout), (0, &joined.stdout), "{again:?}");
    assert!(again.stderr.contains("unchanged") && again.stderr.contains("--renew"), "{again:?}");
    assert_eq!(std::fs::read_to_string(stage.path("robot-1.token")).unwrap(), token);
    assert_eq!(stage.blaze(&main, "get node robot-1 -o json").json()["revision"], node["revision"]);

    let renewed = stage.blaze(&main, &format!("{join} --renew -o json"));
    assert_eq!(renewed.code, 0, "{renewed:?}");
    assert_eq!(renewed.json()["token"]["text"], json!(null));
    assert_ne!(std::fs::read_to_string(stage.path("robot-1.token")).unwrap(), token);

    // A token for standard output alone is what is there alone.
    let lone = stage.blaze(&main, &format!("{join} --token-out - --node-file other.yaml"));
    assert_eq!(lone.code, 0, "{lone:?}");
    assert_eq!(lone.stdout.trim().split('.').count(), 3, "a token and nothing else");
    let other = join.replace("--type mobile", "--type gateway");
    let there = stage.blaze(
        &main,
        &format!("{other} --peer 10.0.0.1 --address 10.0.0.2 --node-file other.yaml"),
    );
    assert_eq!(there.code, 1, "{there:?}");
    assert!(there.stderr.contains("nothing was changed"), "{there:?}");
    assert_eq!(stage.blaze(&main, "get node robot-1 -o json").json()["spec"]["type"], "mobile");

    // Another layer's token.
    let fog = stage.write("fog.yaml", "kind: Layer\nname: fog\nspec: { kind: fog }\n");
    assert_eq!(stage.blaze(&main, &format!("apply -f {}", fog.display())).code, 0);
    let foreign = stage.blaze(&main, "node join fog-1 --layer fog --token-out robot-1.token");
    assert_eq!(foreign.code, 7, "{foreign:?}");
    assert!(foreign.stderr.contains("for layer edge"), "{foreign:?}");
    assert_eq!(stage.blaze(&main, "get node fog-1").code, 4, "what is refused changes nothing");
}

#[test]
fn a_server_that_signs_nothing_is_told_what_to_do_about_it() {
    let stage = Stage::new();
    let main = stage.dev_main();
    let layer = stage.write("edge.yaml", "kind: Layer\nname: edge\nspec: { kind: edge }\n");
    assert_eq!(stage.blaze(&main, &format!("apply -f {}", layer.display())).code, 0);
    let refused = stage.blaze(&main, "node join robot-1 --layer edge");
    assert_eq!(refused.code, 5, "{refused:?}");
    assert!(
        refused.stderr.contains("--no-token") && refused.stderr.contains("--key-file"),
        "{refused:?}"
    );
    assert!(!stage.path("robot-1.token").exists());
    // It goes on from there.
    let without = stage.blaze(&main, "node join robot-1 --layer edge --no-token -o json");
    assert_eq!(without.code, 0, "{without:?}");
    assert_eq!(without.json()["node"]["action"], "unchanged");
    assert_eq!(without.json()["node_file"]["config"].get("token_file"), None);
    let key = stage.path("own.key");
    let key = key.to_str().unwrap();
    assert_eq!(stage.run("blaze", &["token", "keygen", "--alg", "EdDSA", "--out", key]).code, 0);
    let signed =
        stage.blaze(&main, &format!("node join robot-1 --layer edge --key-file {key} --alg EdDSA"));
    assert_eq!(signed.code, 0, "{signed:?}");
    assert_eq!(mode(&stage.path("robot-1.token")), 0o600);
    let inspected = stage.run("blaze", &["token", "inspect", "robot-1.token", "-o", "json"]).json();
    assert_eq!(inspected["claims"]["roles"], json!(["worker"]));
    assert_eq!(inspected["claims"]["layer"], "edge");
}
