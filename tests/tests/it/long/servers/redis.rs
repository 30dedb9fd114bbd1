//! Redis and Valkey of one test.

use std::time::{Duration, Instant};

use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer};
use blaze_tests::wait;

fn start(options: RedisOptions) -> RedisServer {
    RedisServer::start(RedisKind::Redis, options).unwrap()
}

#[test]
fn it_answers_until_killed_and_comes_back_on_the_same_port() {
    for kind in [RedisKind::Redis, RedisKind::Valkey] {
        let options = RedisOptions {
            extra: vec!["appendonly yes".to_owned()],
            ..RedisOptions::default()
        };
        let server = RedisServer::start(kind, options).unwrap();
        let (port, url) = (server.port(), server.url());
        assert_eq!(url, format!("redis://127.0.0.1:{port}"));
        assert_eq!(server.cli(&["SET", "kept", "yes"]).unwrap(), "OK");
        assert!(server.rss_kib().unwrap() > 1000);

        server.kill().unwrap();
        assert!(!server.ping());
        server.rss_kib().expect_err("a process that has gone has no memory");
        server.cli(&["GET", "kept"]).expect_err("nobody answers");

        server.restart().unwrap();
        assert_eq!(server.url(), url);
        assert_eq!(server.cli(&["GET", "kept"]).unwrap(), "yes");
    }
}

#[test]
fn nothing_is_kept_unless_asked_for() {
    let server = start(RedisOptions::default());
    server.cli(&["SET", "lost", "yes"]).unwrap();
    server.restart().unwrap();
    assert_eq!(server.cli(&["EXISTS", "lost"]).unwrap(), "0");
}

#[test]
fn the_kinds_are_what_they_say() {
    let redis = start(RedisOptions::default());
    assert!(redis.cli(&["INFO", "server"]).unwrap().contains("redis_version:7.0.15"));
    let valkey = RedisServer::start(RedisKind::Valkey, RedisOptions::default()).unwrap();
    assert!(valkey.cli(&["INFO", "server"]).unwrap().contains("valkey_version:9.1"));
    let tls = RedisOptions {
        tls: true,
        ..RedisOptions::default()
    };
    assert!(RedisServer::start(RedisKind::Valkey, tls).is_err());
}

#[test]
fn frozen_it_answers_nothing_and_thawed_it_goes_on() {
    let server = start(RedisOptions::default());
    server.cli(&["SET", "kept", "yes"]).unwrap();
    server.freeze().unwrap();
    assert!(!server.ping());
    server.thaw().unwrap();
    let answers = || server.ping();
    wait::until("an answer", Duration::from_secs(5), answers, String::new).unwrap();
    assert_eq!(server.cli(&["GET", "kept"]).unwrap(), "yes");
    // A frozen process ends, too.
    server.freeze().unwrap();
    server.kill().unwrap();
    assert!(!server.ping());
}

#[test]
fn users_have_only_their_rights() {
    let server = start(RedisOptions {
        acl: vec![
            "default off".to_owned(),
            "edge on >secret ~b:* &b:* +@all -@dangerous".to_owned(),
        ],
        ..RedisOptions::default()
    });
    assert!(server.ping(), "a refusal is an answer");
    let run = |password: &str, command: &[&str]| {
        let user = ["--user", "edge", "--pass", password, "--no-auth-warning"];
        server.cli(&[&user[..], command].concat())
    };
    assert_eq!(run("secret", &["SET", "b:x", "1"]).unwrap(), "OK");
    for (password, command, refusal) in [
        ("secret", &["SET", "other", "1"][..], "NOPERM"),
        ("secret", &["FLUSHALL"], "NOPERM"),
        ("guess", &["GET", "b:x"], "NOAUTH"),
    ] {
        let error = run(password, command).unwrap_err().to_string();
        assert!(error.contains(refusal), "{command:?}: {error}");
    }
}

#[test]
fn with_tls_only_those_who_trust_its_authority_get_in() {
    let server = start(RedisOptions {
        tls: true,
        ..RedisOptions::default()
    });
    assert_eq!(server.url(), format!("rediss://127.0.0.1:{}", server.port()));
    assert!(server.authority().is_some_and(std::path::Path::exists));
    assert_eq!(server.cli(&["PING"]).unwrap(), "PONG");
    // The last options win: no trust in the server's authority.
    let stranger = server.cli(&["--cacert", "/dev/null", "PING"]);
    assert!(stranger.is_err(), "{stranger:?}");
    // Its key and certificate are made for each server.
    server.restart().unwrap();
    assert!(server.ping());
}

#[test]
fn a_refused_configuration_is_told_at_once_with_the_log() {
    let begin = Instant::now();
    let options = RedisOptions {
        extra: vec!["no-such-directive yes".to_owned()],
        ..RedisOptions::default()
    };
    let error = RedisServer::start(RedisKind::Redis, options).err().expect("refused");
    assert!(error.to_string().contains("no-such-directive"), "{error}");
    assert!(begin.elapsed() < Duration::from_secs(5), "{:?}", begin.elapsed());
}

#[test]
fn a_port_may_be_chosen_and_a_taken_one_is_an_error() {
    let first = start(RedisOptions::default());
    let options = RedisOptions {
        port: first.port(),
        ..RedisOptions::default()
    };
    let error = RedisServer::start(RedisKind::Redis, options.clone()).err();
    let error = error
        .expect("the first one's answers are not taken for the second one's")
        .to_string();
    assert!(error.contains("in use"), "{error}");
    assert!(first.ping());
    drop(first);
    assert_eq!(start(options.clone()).port(), options.port);
}
