//! Shared servers, and servers whose test dies.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer, shared_redis, shared_valkey, unique_name};
use blaze_tests::wait;

/// Set for the process that [`a_server_ends_with_a_test_that_aborts`] starts.
const VICTIM: &str = "BLAZE_TEST_ABORTS_WITH_A_SERVER";

#[test]
fn all_tests_get_the_same_server() {
    for (ask, name) in [
        (shared_redis as fn() -> anyhow::Result<String>, "redis"),
        (shared_valkey as fn() -> _, "valkey"),
    ] {
        let url = ask().unwrap();
        assert_eq!(ask().unwrap(), url);
        let client = ::redis::Client::open(url).unwrap();
        let mut connection = client.get_connection().unwrap();
        let key = unique_name("harness");
        let answer: String = ::redis::cmd("SET").arg(&key).arg("1").query(&mut connection).unwrap();
        assert_eq!(answer, "OK");
        let info: String = ::redis::cmd("INFO").arg("server").query(&mut connection).unwrap();
        assert_eq!(info.contains("valkey_version"), name == "valkey", "{info}");
        let removed: u32 = ::redis::cmd("DEL").arg(&key).query(&mut connection).unwrap();
        assert_eq!(removed, 1);
    }
}

#[test]
fn names_are_never_given_twice() {
    let names: std::collections::BTreeSet<String> = (0..1000).map(|_| unique_name("x")).collect();
    assert_eq!(names.len(), 1000);
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
    assert!(names.iter().all(|name| name.chars().all(allowed)));
}

#[test]
fn a_server_ends_with_a_test_that_aborts() {
    let output = Command::new(std::env::current_exe().unwrap())
        .args([
            "--ignored",
            "--exact",
            "--nocapture",
            "long::servers::shared::aborts_while_its_server_runs",
        ])
        .env(VICTIM, "1")
        .stdin(Stdio::null())
        .output()
        .unwrap();
    assert!(!output.status.success());
    let text = String::from_utf8_lossy(&output.stdout);
    let word = |name: &str| {
        let word = text.split_whitespace().find_map(|word| word.strip_prefix(name));
        word.unwrap_or_else(|| panic!("{name} in {text}")).to_owned()
    };
    let (pid, folder) = (word("server-pid="), word("server-folder="));
    let process = format!("/proc/{pid}");
    let gone = || !Path::new(&process).exists() && !Path::new(&folder).exists();
    wait::until("the server's end", Duration::from_secs(10), gone, || process.clone()).unwrap();
}

#[test]
#[ignore = "started by a_server_ends_with_a_test_that_aborts, which needs its death"]
fn aborts_while_its_server_runs() {
    if std::env::var_os(VICTIM).is_none() {
        return;
    }
    let server = RedisServer::start(RedisKind::Redis, RedisOptions::default()).unwrap();
    let info = server.cli(&["INFO", "server"]).unwrap();
    let pid = info
        .lines()
        .find_map(|line| line.strip_prefix("process_id:"))
        .unwrap()
        .trim();
    let folder = server.cli(&["CONFIG", "GET", "dir"]).unwrap();
    println!("\nserver-pid={pid} server-folder={}", folder.lines().nth(1).unwrap());
    std::process::abort();
}
