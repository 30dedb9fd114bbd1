//! A server that wants to know who speaks, over TLS.

use std::path::{Path, PathBuf};

use blaze_brokers::kafka::KafkaBroker;
use blaze_brokers::{Broker as _, Health, OpenError};
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::{LayerBroker, NodeFile};
use blaze_tests::servers::{Certificates, KafkaOptions, KafkaServer, free_port};
use serde_json::{Value, json};

use super::{Section, flow_role, frame, health, publish, publisher, reader};

/// Gives the server its certificate and the password of the account, for its next start.
fn hand_out(files: &Certificates, password: &str) -> [PathBuf; 2] {
    let (store, passwords) = (
        files.certificate.with_file_name("keystore.pem"),
        files.certificate.with_file_name("passwords.properties"),
    );
    let read = |path| std::fs::read_to_string(path).unwrap();
    std::fs::write(&store, read(&files.key) + &read(&files.certificate)).unwrap();
    std::fs::write(&passwords, format!("robot={password}\n")).unwrap();
    [store, passwords]
}

/// A server with a second listener, which takes the account `robot` over TLS alone, and its port.
fn start_server(files: &Certificates) -> (KafkaServer, u16) {
    let port = free_port().unwrap();
    let [store, passwords] = hand_out(files, "right");
    let module = "org.apache.kafka.common.security.plain.PlainLoginModule";
    let own = "PLAINTEXT://127.0.0.1:@PORT@";
    let accounts = format!("ACCOUNTS://127.0.0.1:{port}");
    let extra = vec![
        format!("listeners={own},CONTROLLER://127.0.0.1:@CONTROLLER_PORT@,{accounts}"),
        format!("advertised.listeners={own},{accounts}"),
        "listener.security.protocol.map=PLAINTEXT:PLAINTEXT,CONTROLLER:PLAINTEXT,ACCOUNTS:SASL_SSL"
            .to_owned(),
        "listener.name.accounts.sasl.enabled.mechanisms=PLAIN".to_owned(),
        "config.providers=file".to_owned(),
        "config.providers.file.class=org.apache.kafka.common.config.provider.FileConfigProvider"
            .to_owned(),
        format!(
            "listener.name.accounts.plain.sasl.jaas.config={module} required \
             user_robot=\"${{file:{}:robot}}\";",
            passwords.display()
        ),
        "listener.name.accounts.ssl.keystore.type=PEM".to_owned(),
        format!("listener.name.accounts.ssl.keystore.location={}", store.display()),
    ];
    (KafkaServer::start(KafkaOptions { extra, ..KafkaOptions::default() }).unwrap(), port)
}

fn section(port: u16, password_file: Option<&Path>, properties: &Value) -> Section {
    let tree = json!({
        "layer": {"name": "fog", "kind": "fog"},
        "node": {"name": "server-1"},
        "brokers": {"layer": {"kafka": {
            "bootstrap": [format!("127.0.0.1:{port}")],
            "password_file": password_file,
            "properties": properties,
        }}},
    });
    match NodeFile::read(&tree).unwrap().0.brokers.layer {
        Some(LayerBroker::Kafka(kafka)) => kafka,
        other => panic!("{other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_account_over_tls_is_let_in_and_a_wrong_password_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let files = Certificates::write(folder.path()).unwrap();
    let (_server, port) = start_server(&files);
    let properties = |password: &str, authority: &str| {
        json!({
            "security.protocol": "SASL_SSL",
            "sasl.mechanisms": "PLAIN",
            "sasl.username": "robot",
            "sasl.password": password,
            "ssl.ca.location": authority,
        })
    };
    let authority = files.authority.to_str().unwrap();
    let open = |password: &str, authority: &str| {
        KafkaBroker::open(&section(port, None, &properties(password, authority)), &flow_role())
    };

    let right = open("right", authority).unwrap();
    health(&right, Health::Up).await;
    right.close().await;

    let wrong = open("s3cret", authority).unwrap();
    let mut status = wrong.status();
    let told = status.wait_for(|status| status.detail.contains("uthentication"));
    let told = tokio::time::timeout(super::DEADLINE, told).await.unwrap().unwrap().clone();
    assert_ne!(told.health, Health::Up);
    assert!(!format!("{told:?}").contains("s3cret"), "{told:?}");
    wrong.close().await;

    // A file that is not there is told before anything starts.
    match open("right", "/nowhere/ca.pem") {
        Err(OpenError::Setting { key, reason }) => {
            assert_eq!(key, "kafka.properties");
            assert!(reason.contains("ssl.ca.location"), "{reason}");
        }
        other => panic!("{:?}", other.map(|_| ())),
    }
}

/// Another password and other certificates: what the files hold now counts, without a new start.
#[tokio::test(flavor = "multi_thread")]
async fn a_password_and_an_authority_that_are_replaced_are_read_again() {
    let folder = tempfile::tempdir().unwrap();
    let files = Certificates::write(folder.path()).unwrap();
    let (server, port) = start_server(&files);
    let (password, authority) = (folder.path().join("password"), folder.path().join("trusted.pem"));
    let hand_to_client = |text: &str| {
        std::fs::write(&password, format!("{text}\n")).unwrap();
        std::fs::copy(&files.authority, &authority).unwrap();
    };
    hand_to_client("right");
    let properties = json!({
        "security.protocol": "SASL_SSL",
        "sasl.mechanisms": "PLAIN",
        "sasl.username": "robot",
        "ssl.ca.location": authority,
    });
    let flow =
        KafkaBroker::open(&section(port, Some(&password), &properties), &flow_role()).unwrap();
    health(&flow, Health::Up).await;
    let side = flow.flow_side().unwrap();
    let channel: ChannelName = "imu".parse().unwrap();
    side.prepare(&channel, 8).unwrap();
    let mut reader = reader(&flow, &channel).await;
    let publisher = publisher(&flow, &channel, 8);
    publish(publisher.as_ref(), &frame(&channel, 1, 1));
    assert_eq!(reader.next_frame().await.sequence(), 1);

    server.kill().unwrap();
    let files = Certificates::write(folder.path()).unwrap();
    hand_out(&files, "another");
    server.restart().unwrap();
    health(&flow, Health::Down).await;

    hand_to_client("another");
    health(&flow, Health::Up).await;
    publish(publisher.as_ref(), &frame(&channel, 1, 2));
    assert_eq!(reader.next_frame().await.sequence(), 2);
    flow.close().await;
}
