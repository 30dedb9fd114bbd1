//! `blaze dev`.

use std::ffi::OsStr;
use std::net::SocketAddr;
use std::sync::Arc;

use blaze_brokers::Role;
use blaze_domain::Scope;
use blaze_domain::node_file::{NodeBroker, NodeFile};
use blaze_sdk::{ConfigSource, ServiceManager, ServiceOptions};
use blaze_tests::process::{Process, Signal};
use blaze_tests::servers::{RedisKind, RedisServer};
use blaze_tests::wait;
use serde_json::{Value, json};
use tokio::sync::mpsc;

use crate::cli::stage::{PATIENCE, Stage, ready};

/// Ports that nobody else has.
const ANY: [&str; 11] = [
    "dev",
    "--rest",
    "127.0.0.1:0",
    "--grpc",
    "127.0.0.1:0",
    "--set",
    "admin.flow=127.0.0.1:0",
    "--set",
    "admin.worker=127.0.0.1:0",
    "--set",
    "admin.monitor=127.0.0.1:0",
];
const ANY_MAIN: [&str; 2] = ["--set", "control_plane.admin.listen=127.0.0.1:0"];

pub(crate) fn dev(arguments: &[&str], path: Option<&OsStr>) -> Process {
    let words: Vec<&str> = ANY.iter().chain(&ANY_MAIN).chain(arguments).copied().collect();
    let environment: Vec<(&str, &OsStr)> = path.map(|path| ("PATH", path)).into_iter().collect();
    Process::start_with("blaze", &words, &environment).unwrap()
}

/// `blaze dev` with a Redis of its own.
pub(crate) fn dev_on_redis(arguments: &[&str]) -> Process {
    let path = RedisServer::program_folder(RedisKind::Redis).unwrap();
    let path = format!("{}:/usr/bin:/bin", path.display());
    let words = [&["--broker", "redis"], arguments].concat();
    dev(&words, Some(OsStr::new(&path)))
}

/// A service of another process than the one of `blaze dev`.
async fn service(url: &str) -> ServiceManager {
    let file = json!({ "brokers": { "node": { "redis": { "url": url } } } });
    let Some(section @ NodeBroker::Redis(_)) = NodeFile::read(&file).unwrap().0.brokers.node else {
        panic!("{file}");
    };
    let broker = blaze_brokers::open_node(&section, &Role::Service).unwrap();
    let options = ServiceOptions::new(
        "edge".parse().unwrap(),
        "slam".parse().unwrap(),
        Arc::clone(&broker),
        Scope::Node,
    );
    ServiceManager::start(options.on_node("dev-1".parse().unwrap())).await.unwrap()
}

pub(crate) async fn put(rest: &str, path: &str, body: &Value) -> u64 {
    let request = reqwest::Client::new().put(format!("http://{rest}/api/v1{path}"));
    let answer = request.header("if-match", "*").json(body).send().await.unwrap();
    let (status, text) = (answer.status(), answer.text().await.unwrap());
    assert!(status.is_success(), "{status} {text}");
    serde_json::from_str::<Value>(&text).unwrap()["revision"].as_u64().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_change_over_rest_is_heard_by_a_service() {
    let stage = Stage::new();
    let file =
        stage.write("slam.yaml", "kind: Service\nname: slam\nspec: { config: { rate_hz: 10 } }\n");
    let mut process = dev_on_redis(&["-f", file.to_str().unwrap()]);
    let places = ready(&process);
    for (name, place) in places.iter().filter(|(name, _)| *name != "broker") {
        assert!(place.parse::<SocketAddr>().unwrap().ip().is_loopback(), "{name}={place}");
    }
    let service = service(&places["broker"]).await;
    let config = service.config();
    let (told, mut hears) = mpsc::channel(16);
    let _listener = config.on_change(move |change| {
        let _ = told.try_send((change.revision, change.new.clone()));
    });
    config.ready(PATIENCE).await.unwrap();
    assert_eq!(
        (config.value().as_deref(), config.source()),
        (Some(&json!({ "rate_hz": 10 })), Some(ConfigSource::Main))
    );
    let revision =
        put(&places["rest"], "/services/slam", &json!({ "spec": { "config": { "rate_hz": 25 } } }))
            .await;
    let heard = async {
        loop {
            let (at, new) = hears.recv().await.expect("the service runs");
            if at >= revision {
                return new;
            }
        }
    };
    let heard = tokio::time::timeout(PATIENCE, heard).await.expect("it hears of the change");
    assert_eq!(heard.as_deref(), Some(&json!({ "rate_hz": 25 })));
    service.shutdown().await;

    process.signal(Signal::INT).unwrap();
    assert_eq!(process.exit(PATIENCE).unwrap(), Some(0), "{}", process.tail());
    // Its Redis goes with it.
    let redis: SocketAddr = places["broker"].trim_start_matches("redis://").parse().unwrap();
    wait::until(
        "the end of its Redis",
        PATIENCE,
        || std::net::TcpStream::connect(redis).is_err(),
        || "it still listens".to_owned(),
    )
    .unwrap();
}

#[test]
fn what_is_kept_is_there_again_and_what_is_there_is_left_as_it_is() {
    let stage = Stage::new();
    let data = stage.path("data");
    let data = ["--broker", "memory", "--data", data.to_str().unwrap()];
    let mut first = dev(&data, None);
    let places = ready(&first);
    let server = format!("http://{}", places["rest"]);
    let patch =
        ["patch", "node", "dev-1", "-p", "{\"labels\":{\"mine\":\"yes\"}}", "--server", &server];
    let changed = stage.run("blaze", &patch);
    assert_eq!(changed.code, 0, "{changed:?}");
    assert_eq!(first.terminate(PATIENCE).unwrap(), Some(0), "{}", first.tail());
    let mut second = dev(&data, None);
    let places = ready(&second);
    let server = format!("http://{}", places["rest"]);
    let node =
        stage.run("blaze", &["get", "node", "dev-1", "-o", "json", "--server", &server]).json();
    assert_eq!(node["labels"], json!({ "mine": "yes" }), "{node}");
    assert_eq!(second.terminate(PATIENCE).unwrap(), Some(0), "{}", second.tail());
}

#[test]
fn what_cannot_be_started_is_told_with_what_to_do() {
    let stage = Stage::new();
    let nowhere = stage.path("");
    let mut without = dev(&["--broker", "redis"], Some(nowhere.as_os_str()));
    assert_eq!(without.exit(PATIENCE).unwrap(), Some(2), "{}", without.tail());
    assert!(without.tail().contains("--broker redis://HOST:PORT"), "{}", without.tail());

    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let taken = taken.local_addr().unwrap();
    let setting = format!("control_plane.rest.listen={taken}");
    let held = std::net::TcpListener::bind(taken);
    let mut busy = dev(&["--broker", "memory", "--set", &setting], None);
    assert_eq!(busy.exit(PATIENCE).unwrap(), Some(1), "{}", busy.tail());
    assert!(busy.tail().contains(&taken.port().to_string()), "{}", busy.tail());
    drop(held);

    let mut open =
        dev(&["--broker", "memory", "--set", "control_plane.rest.listen=0.0.0.0:0"], None);
    assert_eq!(open.exit(PATIENCE).unwrap(), Some(2), "{}", open.tail());

    let bad = stage.write("bad.yaml", "kind: Node\nname: x\nspec: { layer: nowhere }\n");
    let mut refused = dev(&["--broker", "memory", "-f", bad.to_str().unwrap()], None);
    assert_eq!(refused.exit(PATIENCE).unwrap(), Some(7), "{}", refused.tail());
    assert!(refused.tail().contains("bad.yaml:1"), "{}", refused.tail());
}
