//! Users, passwords, TLS, sockets and prefixes.

use blaze_brokers::redis::RedisBroker;
use blaze_brokers::{Broker, BrokerError, Health, OpenError, Role, SubscribeOptions};
use blaze_tests::servers::{RedisKind, RedisOptions};
use serde_json::json;

use super::support::{
    Server, channel, next_number, publish, publisher, section_of, settled, subscribe, wait_for,
};

const USERS: [&str; 2] =
    ["default on >master ~* &* +@all", "edge on >hunter2 ~b:* &b:* +@all -@dangerous"];

fn with_users() -> Server {
    Server::with(
        RedisKind::Redis,
        RedisOptions {
            acl: USERS.iter().map(|user| (*user).to_owned()).collect(),
            ..RedisOptions::default()
        },
    )
}

fn open(section: &serde_json::Value, role: &Role) -> Result<RedisBroker, OpenError> {
    RedisBroker::open(&section_of(section), role)
}

/// A user with few rights does all that a flow and a service do; foreign channels are refused by
/// name.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_user_of_the_access_list_is_enough() {
    let server = with_users();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("password");
    std::fs::write(&file, "hunter2\n").unwrap();
    let mut section = json!({
        "url": server.server.url(),
        "user": "edge",
        "password_file": file,
        "prefix": "b:",
    });
    let role = Role::Flow { flow: "edge/robot-1".parse().unwrap(), epoch: 1 };
    let flow = open(&section, &role).unwrap();
    assert_eq!(wait_for(&flow, Health::Up).await, "redis (version not told)");
    let mut reader = subscribe(&flow, "imu").await;
    let publisher = publisher(&flow, "imu", 1);
    publish(publisher.as_ref(), 1, 1);
    assert_eq!(next_number(&mut reader).await, (1, 1));
    settled(publisher.as_ref()).await;

    section["prefix"] = json!("c:");
    let elsewhere = open(&section, &Role::Service).unwrap();
    wait_for(&elsewhere, Health::Up).await;
    let refused = elsewhere.subscribe(&channel("imu"), SubscribeOptions::default()).await;
    let Err(BrokerError::Name { channel, reason }) = refused else {
        panic!("it may not be read");
    };
    assert!(channel == "c:imu" && reason.to_uppercase().contains("PERM"), "{channel}: {reason}");
}

/// A refused login is told in the server's words, without the password.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_refused_login_is_told() {
    let server = with_users();
    let url = format!("redis://edge:wrong-secret@127.0.0.1:{}", server.server.port());
    let broker = open(&json!({ "url": url }), &Role::Service).unwrap();
    let detail = wait_for(&broker, Health::Down).await;
    assert!(detail.to_lowercase().contains("invalid username-password"), "{detail}");
    assert!(!detail.contains("secret"), "{detail}");
    let nobody = open(&json!({ "url": server.server.url() }), &Role::Service).unwrap();
    let detail = wait_for(&nobody, Health::Down).await;
    assert!(detail.to_lowercase().contains("auth"), "{detail}");
}

/// TLS with a private authority; without that authority the server is not trusted.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tls_is_spoken_and_checked() {
    use blaze_brokers::open_node;
    use blaze_domain::node_file::NodeBroker;

    let server =
        Server::with(RedisKind::Redis, RedisOptions { tls: true, ..RedisOptions::default() });
    let authority = server.server.authority().unwrap();
    for url in [server.server.url(), server.server.url().replace("rediss:", "redis:")] {
        let section = section_of(&json!({ "url": url, "tls": { "ca_file": authority } }));
        let broker = open_node(&NodeBroker::Redis(section), &Role::Service).unwrap();
        assert_eq!(wait_for(broker.as_ref(), Health::Up).await, "redis 7.0.15");
        let mut reader = subscribe(broker.as_ref(), "imu").await;
        publish(publisher(broker.as_ref(), "imu", 0).as_ref(), 1, 1);
        assert_eq!(next_number(&mut reader).await, (1, 1));
    }
    let distrustful = open(&json!({ "url": server.server.url() }), &Role::Service).unwrap();
    let detail = super::support::eventually("the certificate is refused", || {
        let status = distrustful.status().borrow().clone();
        assert_ne!(status.health, Health::Up);
        status.detail.contains("ertificate").then_some(status.detail)
    })
    .await;
    assert!(detail.contains("ertificate"), "{detail}");
}

/// A socket file in place of a port.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_unix_socket_is_as_good() {
    let folder = tempfile::tempdir().unwrap();
    let socket = folder.path().join("redis.sock");
    let _server = Server::with(
        RedisKind::Redis,
        RedisOptions {
            extra: vec![format!("unixsocket {}", socket.display())],
            ..RedisOptions::default()
        },
    );
    let broker =
        open(&json!({ "url": format!("redis+unix://{}", socket.display()) }), &Role::Service)
            .unwrap();
    wait_for(&broker, Health::Up).await;
    let mut reader = subscribe(&broker, "imu").await;
    publish(publisher(&broker, "imu", 0).as_ref(), 1, 1);
    assert_eq!(next_number(&mut reader).await, (1, 1));
}

/// What can never work is an error at once, and says which key is at fault.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn bad_settings_are_told_at_once() {
    let cases = [
        (
            json!({ "url": "redis://h:1", "password_file": "/nowhere/password" }),
            "redis.password_file",
        ),
        (json!({ "url": "redis://user:secret@h/first" }), "redis.url"),
        (json!({ "url": "redis+unix:///s", "tls": {} }), "redis.tls"),
        (
            json!({ "url": "rediss://h:1", "tls": { "ca_file": "/nowhere/ca" } }),
            "redis.tls.ca_file",
        ),
    ];
    for (section, expected) in cases {
        match open(&section, &Role::Service).err() {
            Some(OpenError::Setting { key, reason }) => {
                assert_eq!(key, expected, "{reason}");
                assert!(!reason.contains("secret"), "{reason}");
            }
            other => panic!("{section}: {other:?}"),
        }
    }
}
