//! `blaze-flow` and its options: faults of the node file with their places, exit codes, live reload.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Duration;

use blaze_tests::admin::Admin;
use blaze_tests::process::{Process, binary};
use blaze_tests::wait;
use serde_json::Value;

pub(crate) const DEADLINE: Duration = Duration::from_secs(20);

/// The node file of the contract, as users copy it.
const CONTRACT: &str = include_str!("contract.yaml");

pub(crate) fn flow_binary(arguments: &[&str], environment: &[(&str, &str)]) -> Output {
    let mut command = Command::new(binary("blaze-flow").unwrap());
    command
        .args(arguments)
        .env_remove("BLAZE_CONFIG")
        .envs(environment.iter().copied())
        .output()
        .unwrap()
}

pub(crate) fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn written(folder: &Path, name: &str, content: &str) -> String {
    let path = folder.join(name);
    std::fs::write(&path, content).unwrap();
    path.display().to_string()
}

/// A node file without an inter scope, with a limit.
pub(crate) fn small_file(state: &Path, limit: &str) -> String {
    format!(
        "layer: {{ name: edge, kind: edge }}\nnode: {{ name: robot-1 }}\nbrokers: {{ node: {{ memory: {{}} }} }}\n\
         admin: {{ flow: \"127.0.0.1:0\" }}\nstate_dir: \"{}\"\nflow:\n  bandwidth: {{ limit_mbps: {limit} }}\n",
        state.display()
    )
}

#[test]
fn the_example_of_the_contract_passes_with_warnings() {
    let folder = tempfile::tempdir().unwrap();
    let path = written(folder.path(), "blaze.yaml", CONTRACT);
    let output = flow_binary(&["--config", &path, "--check"], &[]);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    assert_eq!(text(&output.stdout), "");
    let warnings = text(&output.stderr);
    let of = |section: &str| {
        let start = format!("warning: {path}:");
        let places = warnings.lines().filter_map(|line| line.strip_prefix(&start));
        let places = places.map(|rest| rest.trim_start_matches(|digit: char| digit.is_ascii_digit()));
        places
            .filter(|rest| rest.starts_with(&format!(": {section}: ")))
            .count()
    };
    for section in ["brokers.plugins", "monitor"] {
        assert_eq!(of(section), 1, "one warning for {section}:\n{warnings}");
    }
    for section in ["config", "cache", "database", "worker"] {
        assert_eq!(of(section), 0, "{section} is in effect:\n{warnings}");
    }
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
        let output = flow_binary(arguments, &[]);
        assert_eq!(output.status.code(), Some(64), "{output:?}");
        assert_eq!(text(&output.stdout), "");
        let faults = text(&output.stderr);
        assert_eq!(faults.lines().count(), places.len(), "{faults}");
        for (line, place) in faults.lines().zip(places) {
            assert!(line.starts_with(&format!("{path}:{place}")), "{line} is not of {place}");
        }
    }
}

#[test]
fn what_kafka_cannot_use_is_a_fault_with_its_place() {
    let folder = tempfile::tempdir().unwrap();
    for (kafka, place) in [
        ("prefix: \"a:b\"", "4: brokers.layer.kafka.prefix: "),
        (
            "properties: { acks: \"1\" }",
            "4: brokers.layer.kafka.properties.acks: ",
        ),
        (
            "properties: { \"no.such\": \"1\" }",
            "4: brokers.layer.kafka.properties.no.such: ",
        ),
    ] {
        let content = format!(
            "layer: {{ name: fog, kind: fog }}\nnode: {{ name: server-1 }}\nbrokers:\n  \
             layer: {{ kafka: {{ bootstrap: [\"127.0.0.1:9\"], {kafka} }} }}\n"
        );
        let path = written(folder.path(), "blaze.yaml", &content);
        for arguments in [&["--config", &path, "--check"][..], &["--config", &path][..]] {
            let output = flow_binary(arguments, &[]);
            let told = text(&output.stderr);
            assert_eq!(output.status.code(), Some(64), "{told}");
            assert!(told.starts_with(&format!("{path}:{place}")), "{told}");
        }
    }
}

#[test]
fn files_that_are_none_are_faults_of_the_configuration() {
    let folder = tempfile::tempdir().unwrap();
    let good = small_file(folder.path(), "40");
    let deep = format!("flow: {}{}", "[".repeat(100_000), "]".repeat(100_000));
    let bomb = "a: &a [1,1,1,1,1,1,1,1,1]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a,*a]\nc: &c [*b,*b,*b,*b,*b,*b,*b,*b,*b]\n\
                d: &d [*c,*c,*c,*c,*c,*c,*c,*c,*c]\ne: &e [*d,*d,*d,*d,*d,*d,*d,*d,*d]\nf: &f [*e,*e,*e,*e,*e,*e,*e,*e]\n\
                g: &g [*f,*f,*f,*f,*f,*f,*f,*f]\nh: &h [*g,*g,*g,*g,*g,*g,*g,*g]\ni: [*h,*h,*h,*h,*h,*h,*h,*h]\n";
    let large = format!("{good}# {}\n", "x".repeat(64 * 1024 * 1024));
    for (name, content) in [
        ("empty", ""),
        ("syntax", "a: [1\nb: }"),
        ("scalar", "hello"),
        ("list", "- 1\n- 2\n"),
        (
            "twice",
            "layer: { name: edge, kind: edge }\nlayer: { name: edge, kind: edge }\n",
        ),
        ("binary", "\u{0}\u{1}\u{2}\u{7f}"),
        ("tab", "layer:\n\tname: edge\n"),
        ("deep", deep.as_str()),
        ("bomb", bomb),
        ("large", large.as_str()),
    ] {
        let path = written(folder.path(), name, content);
        let output = flow_binary(&["--config", &path, "--check"], &[]);
        let told = text(&output.stderr);
        assert_eq!(output.status.code(), Some(64), "{name}: {told}");
        assert!(told.lines().all(|line| line.starts_with(&path)), "{name}: {told}");
        assert!(!told.is_empty() && told.len() < 16_384, "{name}: {} bytes", told.len());
    }
    let missing = folder.path().join("missing.yaml").display().to_string();
    let folder_name = folder.path().display().to_string();
    for path in [missing, folder_name] {
        let output = flow_binary(&["--config", &path, "--check"], &[]);
        assert_eq!(output.status.code(), Some(64), "{path}");
        assert!(text(&output.stderr).starts_with(&path), "{output:?}");
    }
}

#[test]
fn options_and_environment_go_before_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = written(folder.path(), "blaze.yaml", &small_file(folder.path(), "40"));
    for wrong in [
        &["--nonsense"][..],
        &["--log-format", "xml"],
        &["--set", "x"],
        &["--config"],
        &["extra"],
    ] {
        let output = flow_binary(wrong, &[]);
        assert_eq!(output.status.code(), Some(2), "{wrong:?}: {output:?}");
    }
    let check = |environment: &[(&str, &str)], more: &[&str]| {
        let arguments = [&["--config", path.as_str(), "--check"], more].concat();
        let output = flow_binary(&arguments, environment);
        (output.status.code().unwrap(), text(&output.stderr))
    };
    let limit = "BLAZE__FLOW__BANDWIDTH__LIMIT_MBPS";
    assert_eq!(check(&[(limit, "7")], &[]).0, 0);
    let (code, told) = check(&[(limit, "fast")], &[]);
    assert_eq!(code, 64);
    assert!(
        told.contains(limit) && told.contains("flow.bandwidth.limit_mbps"),
        "{told}"
    );
    assert_eq!(
        check(&[(limit, "fast")], &["--set", "flow.bandwidth.limit_mbps=7"]).0,
        0,
        "an option goes before"
    );
    assert_eq!(check(&[], &["--set", "flow.bandwidth.limit_mbps=x"]).0, 64);
    assert_eq!(check(&[], &["--set", "flow.nonsense=1"]).0, 64);
    assert_eq!(
        flow_binary(&["--check"], &[("BLAZE_CONFIG", &path)]).status.code(),
        Some(0)
    );
    for (option, wanted) in [("--version", "blaze-flow "), ("--help", "Usage")] {
        let output = flow_binary(&[option], &[]);
        assert_eq!(output.status.code(), Some(0));
        assert!(text(&output.stdout).contains(wanted), "{output:?}");
    }
}

#[test]
fn an_instance_that_can_be_none_is_a_fault_of_the_configuration() {
    let folder = tempfile::tempdir().unwrap();
    let server = "config: { server: \"http://127.0.0.1:9\" }\n";
    let content = small_file(folder.path(), "40").replace("memory: {}", "redis: { url: \"redis://127.0.0.1:9\" }");
    let path = written(folder.path(), "blaze.yaml", &(content + server));
    for program in ["blaze-flow", "blaze-worker"] {
        let run = |arguments: &[&str], instance: &str| {
            let mut command = Command::new(binary(program).unwrap());
            let output = command
                .args(arguments)
                .env("BLAZE_INSTANCE", instance)
                .output()
                .unwrap();
            (output.status.code(), text(&output.stderr))
        };
        let check = ["--config", path.as_str(), "--check"];
        assert_eq!(run(&check, "left").0, Some(0), "{program}: {:?}", run(&check, "left"));
        for arguments in [&check[..], &check[..2]] {
            let (code, told) = run(arguments, "Left!");
            assert_eq!(code, Some(64), "{program}: {told}");
            assert!(told.contains("environment BLAZE_INSTANCE: "), "{program}: {told}");
        }
    }
    let mut dev = Command::new(binary("blaze").unwrap());
    let output = dev
        .args(["dev", "--broker", "memory"])
        .env("BLAZE_INSTANCE", "Left!")
        .output();
    let output = output.unwrap();
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    assert!(
        text(&output.stderr).contains("environment BLAZE_INSTANCE: "),
        "{output:?}"
    );
}

/// A `blaze-flow` that has printed its ready line.
pub(crate) fn started(arguments: &[&str]) -> (Process, Admin) {
    let process = Process::start("blaze-flow", arguments, None).unwrap();
    let line = wait::until_some(
        "the ready line",
        DEADLINE,
        || process.stdout().into_iter().find(|line| line.starts_with("ready ")),
        || process.tail(),
    )
    .unwrap();
    let address = line
        .split_whitespace()
        .find_map(|pair| pair.strip_prefix("admin="))
        .unwrap();
    let admin = Admin {
        address: address.parse().unwrap(),
        namespace: None,
    };
    (process, admin)
}

fn limit(admin: &Admin) -> Option<f64> {
    admin.json("/v1/allocation").ok()?["limit_mbps"].as_f64()
}

fn limit_becomes(admin: &Admin, wanted: f64) {
    wait::until(
        "the limit",
        DEADLINE,
        || limit(admin) == Some(wanted),
        || format!("{:?}", limit(admin)),
    )
    .unwrap();
}

fn config_check(admin: &Admin) -> (u16, Value) {
    let (status, body) = admin.get("/readyz").unwrap();
    let body: Value = serde_json::from_str(&body).unwrap();
    (status, body["checks"]["config"].clone())
}

#[test]
fn the_limit_changes_while_the_flow_runs() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("blaze.yaml");
    let write = |value: &str| std::fs::write(&file, small_file(folder.path(), value)).unwrap();
    write("40");
    let (mut process, admin) = started(&["--config", &file.display().to_string()]);
    limit_becomes(&admin, 40.0);

    write("41");
    limit_becomes(&admin, 41.0);
    // As editors do: a new file, moved over the old one.
    let other = folder.path().join("other");
    std::fs::write(&other, small_file(folder.path(), "42")).unwrap();
    std::fs::rename(&other, &file).unwrap();
    limit_becomes(&admin, 42.0);

    // A faulty file changes nothing and shows; so does one that is gone.
    write("-1");
    let failed = || config_check(&admin).1["status"] == "failed";
    wait::until("the check config", DEADLINE, failed, || {
        format!("{:?}", config_check(&admin))
    })
    .unwrap();
    let (status, check) = config_check(&admin);
    assert_eq!(status, 200, "the status stays");
    assert!(
        check["detail"]
            .as_str()
            .unwrap()
            .contains("blaze.yaml:7: flow.bandwidth.limit_mbps: "),
        "{check}"
    );
    assert_eq!(limit(&admin), Some(42.0));
    write("43");
    limit_becomes(&admin, 43.0);
    let well = || config_check(&admin).1["status"] == "ok";
    wait::until("the check config is well", DEADLINE, well, || {
        format!("{:?}", config_check(&admin))
    })
    .unwrap();
    std::fs::remove_file(&file).unwrap();
    wait::until("a missing file shows", DEADLINE, failed, || {
        format!("{:?}", config_check(&admin))
    })
    .unwrap();
    assert_eq!((config_check(&admin).0, limit(&admin)), (200, Some(43.0)));
    write("44");
    limit_becomes(&admin, 44.0);

    // SIGHUP reads it again, also when it says the same.
    let reloads = |process: &Process| {
        let is_reload = |line: &&String| line.contains("configuration reloaded");
        process.stderr().iter().filter(is_reload).count()
    };
    let before = reloads(&process);
    super::signals::send(&process, "HUP");
    wait::until(
        "SIGHUP reloads",
        DEADLINE,
        || reloads(&process) > before,
        || process.tail(),
    )
    .unwrap();
    assert!(process.runs());
    assert_eq!(process.stdout().len(), 1, "ready comes once: {:?}", process.stdout());
    assert_eq!(process.terminate(DEADLINE).unwrap(), Some(0));
}

#[test]
fn a_config_map_that_swaps_a_symlink_is_seen() {
    // blaze.yaml → ..data/blaze.yaml, ..data → ..1; Kubernetes makes ..2 and renames a new ..data over the old one.
    let folder = tempfile::tempdir().unwrap();
    let version = |name: &str, value: &str| -> PathBuf {
        let version = folder.path().join(name);
        std::fs::create_dir(&version).unwrap();
        std::fs::write(version.join("blaze.yaml"), small_file(folder.path(), value)).unwrap();
        version
    };
    let data = folder.path().join("..data");
    version("..1", "50");
    std::os::unix::fs::symlink("..1", &data).unwrap();
    let file = folder.path().join("blaze.yaml");
    std::os::unix::fs::symlink("..data/blaze.yaml", &file).unwrap();
    let (_process, admin) = started(&["--config", &file.display().to_string()]);
    limit_becomes(&admin, 50.0);
    for (name, value) in [("..2", 51.0), ("..3", 52.0)] {
        version(name, &value.to_string());
        let swap = folder.path().join("..data_tmp");
        std::os::unix::fs::symlink(name, &swap).unwrap();
        std::fs::rename(&swap, &data).unwrap();
        limit_becomes(&admin, value);
    }
}
