use super::*;
use crate::args::tests::config;
use crate::config::{ConfigCommand, NodeCommand};

fn options(line: &str) -> JoinOptions {
    match config(&format!("node join robot-1 --layer edge {line}")).unwrap() {
        ConfigCommand::Node(NodeCommand::Join(options)) => *options,
        other => panic!("{other:?}"),
    }
}

fn file(line: &str, kind: &str) -> Result<(Value, Vec<String>), CliError> {
    let options = options(line);
    file_of(&options, kind, &options.addresses, false)
}

fn file_of(
    options: &JoinOptions,
    kind: &str,
    addresses: &[IpAddr],
    shows_certificate: bool,
) -> Result<(Value, Vec<String>), CliError> {
    let server = "https://10.0.3.1:8443".parse().unwrap();
    let around = Around {
        server: &server,
        ca_file: Some(Path::new("/etc/blaze/ca.pem")),
        shows_certificate,
        kind,
        token_file: Some(Path::new("/etc/blaze/token")),
        addresses,
    };
    node_file(options, &around)
}

#[test]
fn an_edge_node_has_redis_and_fog_and_cloud_have_kafka() {
    let (edge, notes) = file("--address 10.0.1.1 --peer 10.0.3.1", "edge").unwrap();
    assert_eq!(
        edge["brokers"],
        json!({
            "node": { "redis": { "url": "redis://127.0.0.1:6379" } },
            "layer": { "dds": { "domain": 10, "interface": "10.0.1.1" } },
            "inter": { "dds": { "domain": 20, "listen": "10.0.1.1", "peers": ["10.0.3.1"] } },
        })
    );
    assert_eq!(
        edge["config"],
        json!({
            "server": "https://10.0.3.1:50051",
            "ca_file": "/etc/blaze/ca.pem",
            "token_file": "/etc/blaze/token",
        })
    );
    assert!(notes.is_empty(), "{notes:?}");
    for kind in ["fog", "cloud"] {
        let (file, notes) = file("", kind).unwrap();
        assert_eq!(
            file["brokers"],
            json!({ "layer": { "kafka": { "bootstrap": ["127.0.0.1:9092"] } } })
        );
        assert!(notes[0].contains("--address"), "{notes:?}");
    }
}

#[test]
fn whoever_joins_again_without_an_address_gets_the_same_file() {
    let first = "--address fe80::1 --address 10.0.1.1 --peer 10.0.3.1";
    let there = document(&options(first), None).unwrap().body;
    let addresses = addresses_of(&there);
    let again = file_of(&options("--peer 10.0.3.1"), "edge", &addresses, false).unwrap();
    assert_eq!(again, file(first, "edge").unwrap());
    for none in [json!({}), json!({ "spec": { "addresses": ["robot-1.local", 7] } })] {
        assert_eq!(addresses_of(&none), [] as [IpAddr; 0]);
    }
}

#[test]
fn a_worker_has_a_certificate_of_its_own_or_it_is_said_that_it_needs_one() {
    let (file, notes) = file_of(&options("--address 10.0.1.1"), "edge", &[], true).unwrap();
    assert_eq!(file["config"].get("cert_file"), None);
    assert!(notes.iter().any(|note| note.contains("--cert-path")), "{notes:?}");
    let line = "--address 10.0.1.1 --cert-path /etc/blaze/own.pem --key-path /etc/blaze/own.key";
    let (file, notes) = file_of(&options(line), "edge", &[], true).unwrap();
    assert_eq!(
        (&file["config"]["cert_file"], &file["config"]["key_file"]),
        (&json!("/etc/blaze/own.pem"), &json!("/etc/blaze/own.key"))
    );
    assert!(!notes.iter().any(|note| note.contains("--cert-path")), "{notes:?}");
    assert!(config("node join robot-1 --layer edge --cert-path /own.pem").is_err());
}

#[test]
fn options_win_and_what_the_programs_refuse_is_refused() {
    let line = "--node-broker none --layer-broker kafka:a:1,b:2 --grpc https://main:7 --token-path \
        /t --ca-path /c";
    let (file_, _) = file(line, "edge").unwrap();
    assert_eq!(file_["brokers"], json!({ "layer": { "kafka": { "bootstrap": ["a:1", "b:2"] } } }));
    assert_eq!(
        file_["config"],
        json!({ "server": "https://main:7", "ca_file": "/c", "token_file": "/t" })
    );
    for (line, why) in [
        ("--node-broker none", "brokers"),
        ("--layer-broker dds:3", "brokers.layer.dds.interface"),
        ("--layer-broker dds:20 --address 10.0.1.1", "20 is also"),
        ("--layer-broker dds:101 --address 10.0.1.1", "brokers.layer.dds.domain"),
    ] {
        let error = file(line, "edge").unwrap_err();
        assert_eq!(error.exit() as u8, 7, "{line}");
        assert!(error.to_string().contains(why), "{line}: {error}");
    }
    let clear = file("--grpc http://10.0.3.1:50051", "edge").unwrap_err();
    assert_eq!(clear.exit() as u8, 2);
    let (_, notes) = file("--grpc http://127.0.0.1:50051 --address 10.0.1.1", "edge").unwrap();
    assert!(notes[0].contains("this machine"), "{notes:?}");
}

#[test]
fn what_a_document_has_stays_but_for_what_is_said() {
    let new =
        document(&options("--type mobile --address 10.0.1.1 --label site=lab"), None).unwrap();
    assert_eq!(new.action, "created");
    assert_eq!(
        new.body,
        json!({
            "labels": { "site": "lab" },
            "spec": { "layer": "edge", "type": "mobile", "addresses": ["10.0.1.1"] },
        })
    );
    let there = json!({
        "kind": "Node", "name": "robot-1", "labels": { "a": "b" }, "annotations": { "c": "d" },
        "revision": 4,
        "spec": { "layer": "edge", "type": "gateway", "config": { "x": 1 } },
    });
    assert_eq!(document(&options(""), Some(&there)).unwrap().action, "unchanged");
    assert_eq!(
        document(&options("--type gateway --label a=b"), Some(&there)).unwrap().action,
        "unchanged"
    );
    let changed = document(&options("--type static --label site=lab"), Some(&there)).unwrap();
    assert_eq!(changed.action, "updated");
    assert_eq!(
        changed.body,
        json!({
            "labels": { "a": "b", "site": "lab" }, "annotations": { "c": "d" },
            "spec": { "layer": "edge", "type": "static", "config": { "x": 1 } },
        })
    );
    let elsewhere = json!({ "labels": {}, "spec": { "layer": "fog" } });
    let error = document(&options(""), Some(&elsewhere)).unwrap_err();
    assert_eq!(error.exit() as u8, 7);
    assert!(error.to_string().contains("stands in layer fog"), "{error}");
}
