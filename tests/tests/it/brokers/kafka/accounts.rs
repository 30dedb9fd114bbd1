//! A server that wants to know who speaks, over TLS.

use blaze_brokers::kafka::KafkaBroker;
use blaze_brokers::{Broker as _, Health, OpenError};
use blaze_domain::node_file::{LayerBroker, NodeFile};
use blaze_tests::servers::{Certificates, KafkaOptions, KafkaServer, free_port};
use serde_json::{Value, json};

use super::{Section, flow_role, health};

/// A server with a second listener, which takes the account `robot` over TLS alone, and its port.
fn start_server(files: &Certificates) -> (KafkaServer, u16) {
    let port = free_port().unwrap();
    let store = files.certificate.with_file_name("keystore.pem");
    let read = |path| std::fs::read_to_string(path).unwrap();
    std::fs::write(&store, read(&files.key) + &read(&files.certificate)).unwrap();
    let module = "org.apache.kafka.common.security.plain.PlainLoginModule";
    let own = "PLAINTEXT://127.0.0.1:@PORT@";
    let accounts = format!("ACCOUNTS://127.0.0.1:{port}");
    let extra = vec![
        format!("listeners={own},CONTROLLER://127.0.0.1:@CONTROLLER_PORT@,{accounts}"),
        format!("advertised.listeners={own},{accounts}"),
        "listener.security.protocol.map=PLAINTEXT:PLAINTEXT,CONTROLLER:PLAINTEXT,ACCOUNTS:SASL_SSL"
            .to_owned(),
        "listener.name.accounts.sasl.enabled.mechanisms=PLAIN".to_owned(),
        format!(
            "listener.name.accounts.plain.sasl.jaas.config={module} required user_robot=\"right\";"
        ),
        "listener.name.accounts.ssl.keystore.type=PEM".to_owned(),
        format!("listener.name.accounts.ssl.keystore.location={}", store.display()),
    ];
    (KafkaServer::start(KafkaOptions { extra, ..KafkaOptions::default() }).unwrap(), port)
}

fn section(port: u16, properties: &Value) -> Section {
    let tree = json!({
        "layer": {"name": "fog", "kind": "fog"},
        "node": {"name": "server-1"},
        "brokers": {"layer": {"kafka": {
            "bootstrap": [format!("127.0.0.1:{port}")],
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
        KafkaBroker::open(&section(port, &properties(password, authority)), &flow_role())
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
