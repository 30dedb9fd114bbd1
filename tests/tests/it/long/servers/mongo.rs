//! MongoDB of one test.

use std::time::{Duration, Instant};

use blaze_tests::servers::{
    MongoOptions, MongoServer, drop_mongo_database, mongo_command, mongo_insert, shared_mongo, unique_name,
};
use serde_json::json;

fn count(uri: &str, database: &str) -> i64 {
    let answer = mongo_command(uri, database, &json!({ "count": "kept" })).unwrap();
    i64::from(answer.get_i32("n").unwrap())
}

#[test]
fn what_was_acknowledged_is_there_after_a_kill_and_a_frozen_server_goes_on() {
    let server = MongoServer::start(MongoOptions::default()).unwrap();
    let (port, uri) = (server.port(), server.uri());
    assert_eq!(uri, format!("mongodb://127.0.0.1:{port}/?replicaSet=rs0"));
    assert!(server.is_writable() && server.pid().is_some());
    assert!(server.rss_kib().unwrap() > 20_000);
    for number in 0..100 {
        mongo_insert(&uri, "test", "kept", &json!({ "_id": number })).unwrap();
    }
    mongo_insert(&uri, "test", "kept", &json!({ "_id": 7 })).expect_err("it is there");

    server.kill().unwrap();
    assert!(!server.is_writable());
    server.rss_kib().expect_err("a process that has gone has no memory");

    let begin = Instant::now();
    server.restart().unwrap();
    println!("back {:?} after a kill", begin.elapsed());
    assert_eq!(server.uri(), uri);
    assert_eq!(count(&uri, "test"), 100);

    server.freeze().unwrap();
    assert!(!server.is_writable());
    server.thaw().unwrap();
    server.wait_ready().unwrap();
    assert_eq!(count(&uri, "test"), 100);
}

#[test]
fn a_server_may_be_alone_and_a_refused_argument_is_told_with_the_log() {
    let alone = MongoOptions {
        alone: true,
        ..MongoOptions::default()
    };
    let server = MongoServer::start(alone).unwrap();
    assert_eq!(server.uri(), format!("mongodb://127.0.0.1:{}/", server.port()));
    let hello = mongo_command(&server.uri(), "admin", &json!({ "hello": 1 })).unwrap();
    assert!(!hello.contains_key("setName"), "{hello}");

    let begin = Instant::now();
    let options = MongoOptions {
        extra: vec!["--no-such-option".to_owned()],
        ..MongoOptions::default()
    };
    let error = MongoServer::start(options).err().expect("refused");
    assert!(error.to_string().contains("no-such-option"), "{error}");
    assert!(begin.elapsed() < Duration::from_secs(10), "{:?}", begin.elapsed());
}

#[test]
fn all_tests_get_the_same_server() {
    let uri = shared_mongo().unwrap();
    assert_eq!(shared_mongo().unwrap(), uri);
    let database = unique_name("harness");
    mongo_insert(&uri, &database, "kept", &json!({ "_id": 1 })).unwrap();
    assert_eq!(count(&uri, &database), 1);
    drop_mongo_database(&uri, &database).unwrap();
    assert_eq!(count(&uri, &database), 0);
}
