//! A main service that takes only tokens, and only from clients with a certificate: the whole way
//! by the commands that an administrator types, up to a worker that syncs.

use std::process::{Command, Output};

use blaze_auth::{Algorithm, generate_key};
use blaze_tests::process::{Process, binary};
use blaze_tests::servers::Certificates;
use serde_json::{Value, json};

use super::kit::Starting;
use super::stage::{PATIENCE, Stage, Worker, addresses, next};

/// The text of a secret, which comes only over a connection that nobody else can read.
const SECRET: &str = "opens-the-gate";

struct Secured {
    stage: Stage,
    certificates: Certificates,
}

impl Secured {
    fn new() -> Self {
        let stage = Stage::new();
        let certificates = Certificates::write(stage.folder.path()).unwrap();
        let key = generate_key(Algorithm::EdDsa).unwrap();
        std::fs::write(stage.path("k1.key"), key.private.as_bytes()).unwrap();
        Self { stage, certificates }
    }

    fn main(&self) -> Process {
        let file = self.stage.write(
            "main.yaml",
            &json!({
                "control_plane": {
                    "rest": { "listen": self.stage.rest }, "grpc": { "listen": self.stage.grpc },
                    "admin": { "listen": "127.0.0.1:0" },
                    "store": { "sqlite": { "path": self.stage.path("main.db") } },
                    "auth": { "keys": [{ "id": "k1", "alg": "EdDSA",
                        "file": self.stage.path("k1.key"), "sign": true }] },
                    "encryption": { "keys": [{ "id": "e1", "file": self.stage.path("enc.key") }] },
                    "tls": {
                        "cert_file": self.certificates.certificate,
                        "key_file": self.certificates.key,
                        "client_ca_file": self.certificates.authority,
                    },
                },
            }),
        );
        let process = Process::start("blaze-config", &["--config", &file], None).unwrap();
        addresses(&process).unwrap();
        process
    }

    /// Runs `blaze` in the folder.
    fn blaze(&self, arguments: &[&str]) -> Output {
        let mut command = Command::new(binary("blaze").unwrap());
        command.args(arguments).current_dir(self.stage.folder.path());
        // Nothing of whoever runs the tests.
        command.env("HOME", self.stage.folder.path()).output().unwrap()
    }

    /// The same as an administrator; must succeed.
    fn admin(&self, arguments: &[&str]) -> String {
        let server = format!("https://{}", self.stage.rest);
        let mut all = arguments.to_vec();
        all.extend([
            "--server",
            &server,
            "--ca-file",
            "authority.pem",
            "--token-file",
            "admin.token",
        ]);
        all.extend(["--client-cert", "client.pem", "--client-key", "client.key"]);
        let output = self.blaze(&all);
        assert!(output.status.success(), "{arguments:?}: {output:?}");
        String::from_utf8(output.stdout).unwrap()
    }

    /// What `blaze node join` prints, with these options besides.
    fn join(&self, more: &[&str]) -> Value {
        let (grpc, redis) = (format!("https://{}", self.stage.grpc), self.stage.redis.url());
        let mut arguments =
            vec!["node", "join", "robot-1", "--layer", "edge", "--grpc", &grpc, "-o", "json"];
        arguments.extend(["--node-broker", &redis, "--layer-broker", "none"]);
        arguments.extend(more);
        serde_json::from_str::<Value>(&self.admin(&arguments)).unwrap()["node_file"].take()
    }

    /// The worker of a node file, which may never be ready.
    fn worker(&self, file: &Value) -> Worker {
        let mut file = file.clone();
        file["admin"] = json!({ "worker": "127.0.0.1:0" });
        file["state_dir"] = json!(self.stage.path("robot-1"));
        let file = self.stage.write("robot-1.yaml", &file);
        Starting::of(Process::start("blaze-worker", &["--config", &file], None).unwrap())
            .listening()
    }
}

fn has_reason(words: &str) -> impl Fn(&Value) -> bool {
    move |status| status["reason"].as_str().is_some_and(|reason| reason.contains(words))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_with_a_certificate_and_a_token_gets_secrets_and_one_without_is_told_what_is_missing()
 {
    let world = Secured::new();
    let _main = world.main();
    let own_key = ["--key-file", "k1.key", "--alg", "EdDSA", "--key-id", "k1"];
    let token = ["token", "create", "--subject", "admin", "--role", "admin", "--expires", "1h"];
    let token = world.blaze(&[&token[..], &own_key[..]].concat());
    assert!(token.status.success(), "{token:?}");
    std::fs::write(world.stage.path("admin.token"), token.stdout).unwrap();
    let documents = json!([
        { "kind": "Layer", "name": "edge", "spec": { "kind": "edge" } },
        {
            "kind": "Service",
            "name": "gate",
            "spec": { "config": { "rate_hz": 5, "password": { "$secret": SECRET } } },
        },
    ]);
    let documents = world.stage.write("documents.yaml", &documents);
    world.admin(&["apply", "-f", &documents]);

    let without = world.join(&[]);
    let worker = world.worker(&without);
    let status = worker.until("why it is refused", has_reason("config.cert_file")).await;
    assert_eq!(status["connected"], false);
    worker.kill();

    let files = ["--cert-path", "client.pem", "--key-path", "client.key"];
    let file = world.join(&files);
    let mut worker = world.worker(&file);
    worker.until("it is in sync", |status| status["source"] == "main").await;
    let mut service = world.stage.service().await;
    let answer = service.ask(json!({ "service": "gate" }), PATIENCE).await;
    assert_eq!(answer["config"], json!({ "rate_hz": 5, "password": SECRET }));
    let mut changes = service.listen("gate").await;
    world.admin(&["patch", "service", "gate", "-p", r#"{"spec":{"config":{"rate_hz":9}}}"#]);
    let notice = next(&mut changes).await;
    assert_eq!(notice["config"], json!({ "rate_hz": 9, "password": SECRET }));

    // A key that is not of the certificate: what served goes on.
    std::fs::copy(&world.certificates.key, &world.certificates.client_key).unwrap();
    let ended = tokio::task::block_in_place(|| worker.process.terminate(PATIENCE)).unwrap();
    assert_eq!(ended, Some(0));
    let worker = world.worker(&file);
    worker.until("why there is no connection", has_reason("no connection")).await;
    let answer = service.ask(json!({ "service": "gate" }), PATIENCE).await;
    assert_eq!((&answer["config"]["rate_hz"], &answer["source"]), (&json!(9), &json!("copy")));
    std::fs::write(&world.certificates.client_key, "nothing").unwrap();
    worker.until("which file it is", has_reason("config.key_file")).await;
}
