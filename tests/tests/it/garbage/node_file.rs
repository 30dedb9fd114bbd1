//! `blaze-flow` and its options: faults of the node file with their places, exit codes, live
//! reload.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use blaze_tests::admin::Admin;
use blaze_tests::process::{Process, Signal, binary};
use blaze_tests::wait;
use serde_json::Value;

const DEADLINE: Duration = Duration::from_secs(20);

/// Exit code, stdout and stderr of a program that ends by itself.
fn output(
    program: &str,
    arguments: &[&str],
    environment: &[(&str, &str)],
) -> (Option<i32>, String, String) {
    let mut command = Command::new(binary(program).unwrap());
    command.args(arguments).env_remove("BLAZE_CONFIG");
    let output = command.envs(environment.iter().copied()).output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code(), text(&output.stdout), text(&output.stderr))
}

fn written(folder: &Path, name: &str, content: &str) -> String {
    let path = folder.join(name);
    std::fs::write(&path, content).unwrap();
    path.display().to_string()
}

/// A node file without an inter scope, with a limit.
fn small_file(state: &Path, limit: &str) -> String {
    format!(
        "layer: {{ name: edge, kind: edge }}\nnode: {{ name: robot-1 }}\nbrokers: {{ node: {{ memory: {{}} }} }}\n\
         admin: {{ flow: \"127.0.0.1:0\" }}\nstate_dir: \"{}\"\nflow:\n  bandwidth: {{ limit_mbps: {limit} }}\n",
        state.display()
    )
}

#[test]
fn all_faults_are_told_at_once_with_their_places() {
    let folder = tempfile::tempdir().unwrap();
    let content = "layer: { name: Edge, kind: edge }\nnode: { name: robot-1 }\nbrokers:\n  node: { memory: {} }\n  \
                   inter: { dds: { domain: 300, listen: \"10.0.0.1\", mtuu: 9 } }\nflow:\n  bandwidth:\n    \
                   limit_mbps: -1\n  topics:\n    - { match: \"a//b\", max_rate_hz: 0 }\nnonsense: 1\n";
    let path = written(folder.path(), "blaze.yaml", content);
    let places = [
        "1: layer.name: ",
        "5: brokers.inter.dds.domain: ",
        "5: brokers.inter.dds.mtuu: ",
        "8: flow.bandwidth.limit_mbps: ",
        "10: flow.topics[0].match: ",
        "10: flow.topics[0].max_rate_hz: ",
        "11: nonsense: ",
    ];
    for arguments in [&["--config", &path, "--check"][..], &["--config", &path][..]] {
        let (code, printed, faults) = output("blaze-flow", arguments, &[]);
        assert_eq!((code, printed.as_str()), (Some(64), ""), "{faults}");
        assert_eq!(faults.lines().count(), places.len(), "{faults}");
        for (line, place) in faults.lines().zip(places) {
            assert!(line.starts_with(&format!("{path}:{place}")), "{line} is not of {place}");
        }
    }
}

#[test]
fn files_that_are_none_are_faults_of_the_configuration() {
    let folder = tempfile::tempdir().unwrap();
    let kafka = "layer: { name: fog, kind: fog }\nnode: { name: server-1 }\nbrokers:\n  \
                 layer: { kafka: { bootstrap: [\"127.0.0.1:9\"], properties: { acks: \"1\" } } }\n";
    let password = "layer: { name: fog, kind: fog }\nnode: { name: server-1 }\nbrokers: { node: { memory: {} } }\n\
                    database: { mongodb: { uri: \"mongodb://me@h\",\n  password_file: /nowhere/password } }\n";
    let uri = "layer: { name: fog, kind: fog }\nnode: { name: server-1 }\nbrokers: { node: { memory: {} } }\n\
               database: { mongodb: {\n  uri: \"mongodb://h/?nonsense=1\" } }\n";
    let store = "control_plane: { auth: { issuer: i, jwks: { url: \"https://127.0.0.1:9/k\" } }, store: { mongodb: {\n  \
                 password_file: /nowhere/password, uri: \"mongodb://me@h\" } } }\n";
    for (program, name, content, place) in [
        ("blaze-flow", "empty", "", ""),
        ("blaze-flow", "syntax", "a: [1\nb: }", ""),
        ("blaze-flow", "kafka", kafka, ":4: brokers.layer.kafka.properties.acks: "),
        ("blaze-worker", "password", password, ":5: database.mongodb.password_file: "),
        ("blaze-worker", "uri", uri, ":5: database.mongodb.uri: "),
        ("blaze-config", "store", store, ":2: control_plane.store.mongodb.password_file: "),
    ] {
        let path = written(folder.path(), name, content);
        let (code, _, faults) = output(program, &["--config", &path, "--check"], &[]);
        assert_eq!(code, Some(64), "{name}: {faults}");
        assert!(faults.starts_with(&format!("{path}{place}")), "{name}: {faults}");
    }
    let missing = folder.path().join("missing.yaml").display().to_string();
    let (code, _, faults) = output("blaze-flow", &["--config", &missing, "--check"], &[]);
    assert_eq!(code, Some(64), "{faults}");
    assert!(faults.starts_with(&missing), "{faults}");
}

#[test]
fn options_and_environment_go_before_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = written(folder.path(), "blaze.yaml", &small_file(folder.path(), "40"));
    for wrong in [&["--nonsense"][..], &["--log-format", "xml"], &["--set", "x"]] {
        assert_eq!(output("blaze-flow", wrong, &[]).0, Some(2), "{wrong:?}");
    }
    let (limit, key) = ("BLAZE__FLOW__BANDWIDTH__LIMIT_MBPS", "flow.bandwidth.limit_mbps");
    let check = |value: &str, more: &[&str]| {
        let arguments = [&["--check"][..], more].concat();
        output("blaze-flow", &arguments, &[("BLAZE_CONFIG", path.as_str()), (limit, value)])
    };
    assert_eq!(check("7", &[]).0, Some(0));
    let (code, _, faults) = check("fast", &[]);
    assert_eq!(code, Some(64));
    assert!(faults.contains(limit) && faults.contains(key), "{faults}");
    let set = |value: &str| check("fast", &["--set", &format!("{key}={value}")]).0;
    assert_eq!((set("7"), set("x")), (Some(0), Some(64)), "an option goes before");
}

#[test]
fn an_instance_that_can_be_none_is_a_fault_of_the_configuration() {
    let folder = tempfile::tempdir().unwrap();
    let content = small_file(folder.path(), "40")
        .replace("memory: {}", "redis: { url: \"redis://127.0.0.1:9\" }");
    let server = "config: { server: \"http://127.0.0.1:9\" }\n";
    let path = written(folder.path(), "blaze.yaml", &(content + server));
    for (program, arguments, expected) in [
        ("blaze-flow", &["--config", &path][..], 64),
        ("blaze-worker", &["--config", &path], 64),
        ("blaze", &["dev", "--broker", "memory"], 2),
    ] {
        let (code, _, faults) = output(program, arguments, &[("BLAZE_INSTANCE", "Left!")]);
        assert_eq!(code, Some(expected), "{program}: {faults}");
        assert!(faults.contains("environment BLAZE_INSTANCE: "), "{program}: {faults}");
    }
    for program in ["blaze-flow", "blaze-worker"] {
        let check = ["--config", &path, "--check"];
        let (code, _, faults) = output(program, &check, &[("BLAZE_INSTANCE", "left")]);
        assert_eq!(code, Some(0), "{program}: {faults}");
    }
}

/// A `blaze-flow` that has printed its ready line.
fn started(path: &str) -> (Process, Admin) {
    let process = Process::start("blaze-flow", &["--config", path], None).unwrap();
    let admin = Admin { address: process.ready_at("admin", DEADLINE).unwrap(), namespace: None };
    (process, admin)
}

fn limit(admin: &Admin) -> Option<f64> {
    admin.json("/v1/allocation").ok()?["limit_mbps"].as_f64()
}

fn config_check(admin: &Admin) -> (u16, Value) {
    let (status, body) = admin.get("/readyz").unwrap();
    let body: Value = serde_json::from_str(&body).unwrap();
    (status, body["checks"]["config"].clone())
}

/// Waits until the limit in effect and the status of the check `config` are these.
fn becomes(admin: &Admin, wanted: f64, status: &str) {
    wait::until(
        &format!("limit {wanted}, config {status}"),
        DEADLINE,
        || limit(admin) == Some(wanted) && config_check(admin).1["status"] == status,
        || format!("{:?} {:?}", limit(admin), config_check(admin)),
    )
    .unwrap();
}

#[test]
fn the_limit_changes_while_the_flow_runs() {
    let folder = tempfile::tempdir().unwrap();
    let write =
        |value: &str| written(folder.path(), "blaze.yaml", &small_file(folder.path(), value));
    let path = write("40");
    let (mut process, admin) = started(&path);
    becomes(&admin, 40.0, "ok");
    write("41");
    becomes(&admin, 41.0, "ok");
    // A faulty file changes nothing and shows; so does one that is gone.
    write("-1");
    becomes(&admin, 41.0, "failed");
    let (status, check) = config_check(&admin);
    assert_eq!(status, 200, "the status stays");
    let detail = check["detail"].as_str().unwrap();
    assert!(detail.contains("blaze.yaml:7: flow.bandwidth.limit_mbps: "), "{check}");
    write("42");
    becomes(&admin, 42.0, "ok");
    std::fs::remove_file(&path).unwrap();
    becomes(&admin, 42.0, "failed");
    write("43");
    becomes(&admin, 43.0, "ok");
    // SIGHUP reads it again, also when it says the same.
    let reloads = || {
        let lines = process.stderr();
        lines.iter().filter(|line| line.contains("configuration reloaded")).count()
    };
    let before = reloads();
    process.signal(Signal::HUP).unwrap();
    wait::until("SIGHUP reloads", DEADLINE, || reloads() > before, || process.tail()).unwrap();
    assert_eq!(process.stdout().len(), 1, "ready comes once: {:?}", process.stdout());
    assert_eq!(process.terminate(DEADLINE).unwrap(), Some(0), "{}", process.tail());
}
