//! Servers that tests start: they end with a test that dies, and one that cannot start says why.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer};
use blaze_tests::wait;

/// Set for the process that [`a_server_ends_with_a_test_that_aborts`] starts.
const VICTIM: &str = "BLAZE_TEST_ABORTS_WITH_A_SERVER";

#[test]
fn a_server_ends_with_a_test_that_aborts() {
    let output = Command::new(std::env::current_exe().unwrap())
        .args(["--ignored", "--exact", "--nocapture"])
        .arg("long::servers::aborts_while_its_server_runs")
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
    let mut lines = info.lines();
    let pid = lines.find_map(|line| line.strip_prefix("process_id:")).unwrap().trim();
    let folder = server.cli(&["CONFIG", "GET", "dir"]).unwrap();
    println!("\nserver-pid={pid} server-folder={}", folder.lines().nth(1).unwrap());
    std::process::abort();
}

#[test]
fn a_server_that_cannot_start_says_why_at_once() {
    let first = RedisServer::start(RedisKind::Redis, RedisOptions::default()).unwrap();
    let begin = Instant::now();
    let taken = RedisOptions { port: first.port(), ..RedisOptions::default() };
    let faulty =
        RedisOptions { extra: vec!["no-such-directive yes".to_owned()], ..RedisOptions::default() };
    for (options, why) in [(taken, "in use"), (faulty, "no-such-directive")] {
        let error = RedisServer::start(RedisKind::Redis, options).err().expect("refused");
        assert!(error.to_string().contains(why), "{error}");
    }
    assert!(begin.elapsed() < Duration::from_secs(10), "{:?}", begin.elapsed());
}
