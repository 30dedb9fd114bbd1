//! `blaze apply --wait` with a real worker.

use blaze_tests::process::{Process, Signal};
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer};
use blaze_tests::wait;

use crate::cli::stage::{PATIENCE, Stage, ready};

const DOCUMENTS: &str = "kind: Layer\nname: edge\nspec: { kind: edge }\n---\nkind: Node\nname: robot-1\nspec: { layer: edge }\n---\nkind: Service\nname: slam\nspec: { config: { rate_hz: 10 } }\n";

#[test]
fn it_waits_for_workers_that_are_connected_and_for_no_others() {
    let stage = Stage::new();
    let main = stage.dev_main();
    let first = stage.write("first.yaml", DOCUMENTS);
    let alone = stage.blaze(&main, &format!("apply -f {} --wait 10s", first.display()));
    assert_eq!(alone.code, 0, "{alone:?}");
    assert!(alone.stderr.contains("no worker concerned is connected"), "{alone:?}");

    let redis = RedisServer::start(RedisKind::Redis, RedisOptions::default()).unwrap();
    let node_file = format!(
        "layer: {{ name: edge, kind: edge }}\nnode: {{ name: robot-1 }}\nbrokers: {{ node: {{ redis: {{ url: \"{}\" }} }} }}\n\
         config: {{ server: \"http://{}\" }}\nadmin: {{ worker: \"127.0.0.1:0\" }}\nworker: {{ state_dir: {:?} }}\n",
        redis.url(),
        main.grpc,
        stage.path("worker")
    );
    let node_file = stage.write("robot-1.yaml", &node_file);
    let worker =
        Process::start("blaze-worker", &["--config", node_file.to_str().unwrap()], None).unwrap();
    ready(&worker);
    let connected =
        || stage.blaze(&main, "workers -o json").json()["items"][0]["connected"] == true;
    wait::until("the worker is known", PATIENCE, connected, || worker.tail()).unwrap();

    let second = stage
        .write("second.yaml", "kind: Service\nname: slam\nspec: { config: { rate_hz: 20 } }\n");
    let second = format!("apply -f {} --wait 20s", second.display());
    let reached = stage.blaze(&main, &second);
    assert_eq!(reached.code, 0, "{reached:?}");
    assert!(reached.stderr.contains("1 worker concerned: all have revision"), "{reached:?}");
    let revision = stage.blaze(&main, "get svc slam -o json").json()["revision"].as_u64().unwrap();
    let has =
        stage.blaze(&main, "workers -o json").json()["items"][0]["revision"].as_u64().unwrap();
    assert!(has >= revision, "{has} of {revision}");

    // One that stands still has nothing yet: also when the same is applied again, which changes
    // nothing.
    worker.signal(Signal::STOP).unwrap();
    let third =
        stage.write("third.yaml", "kind: Service\nname: slam\nspec: { config: { rate_hz: 30 } }\n");
    let third = format!("apply -f {}", third.display());
    for action in ["updated", "unchanged"] {
        let late = stage.blaze(&main, &format!("{third} --wait 500ms -o json"));
        assert_eq!(
            (late.code, &late.json()["results"][0]["action"]),
            (1, &action.into()),
            "{late:?}"
        );
        assert!(late.stderr.contains("edge/robot-1"), "{late:?}");
    }
    worker.signal(Signal::CONT).unwrap();
    let caught_up = stage.blaze(&main, &format!("{third} --wait 20s"));
    assert_eq!(caught_up.code, 0, "{caught_up:?}");
    assert!(caught_up.stderr.contains("1 worker concerned"), "{caught_up:?}");

    // A layer that it is not of is no concern of it.
    worker.signal(Signal::STOP).unwrap();
    let fog = stage.write("fog.yaml", "kind: Layer\nname: fog\nspec: { kind: fog }\n");
    let elsewhere = stage.blaze(&main, &format!("apply -f {} --wait 5s", fog.display()));
    assert_eq!(elsewhere.code, 0, "{elsewhere:?}");
    worker.signal(Signal::CONT).unwrap();
}
