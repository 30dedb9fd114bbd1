//! etcd of one test.

use std::time::{Duration, Instant};

use blaze_tests::servers::{EtcdOptions, EtcdServer};

#[test]
fn it_answers_until_killed_and_comes_back_on_the_same_port() {
    let server = EtcdServer::start(EtcdOptions::default()).unwrap();
    let address = server.address();
    assert!(server.is_healthy() && server.pid().is_some());
    assert!(server.rss_kib().unwrap() > 5_000);

    server.kill().unwrap();
    assert!(!server.is_healthy());
    server.rss_kib().expect_err("a process that has gone has no memory");

    server.restart().unwrap();
    assert_eq!(server.address(), address);
    assert!(server.is_healthy());
}

#[test]
fn its_folder_may_be_chosen_and_goes_with_it() {
    let folder = tempfile::tempdir().unwrap();
    let options = EtcdOptions {
        folder: Some(folder.path().to_owned()),
        ..EtcdOptions::default()
    };
    let server = EtcdServer::start(options).unwrap();
    let inside = || std::fs::read_dir(folder.path()).unwrap().count();
    assert_eq!(inside(), 1);
    drop(server);
    assert_eq!(inside(), 0);
}

#[test]
fn a_refused_argument_is_told_at_once_with_the_log() {
    let begin = Instant::now();
    let options = EtcdOptions {
        extra: vec!["--election-timeout=1".to_owned()],
        ..EtcdOptions::default()
    };
    let error = EtcdServer::start(options).err().expect("refused");
    assert!(error.to_string().contains("election-timeout[1ms]"), "{error}");
    assert!(begin.elapsed() < Duration::from_secs(10), "{:?}", begin.elapsed());
    assert!(EtcdServer::version().unwrap().contains("3.4"));
}
